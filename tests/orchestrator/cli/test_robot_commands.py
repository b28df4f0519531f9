"""`robot_commands`: `decant robot check` before a bench in every wrong state: it says what is wrong and what to do,
and nothing moves.
"""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from math import degrees, radians
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import decant
from actors.arm.arm_interface import ArmRefusedError, NotAcceptedError
from actors.arm.arm_settings import arm_kind
from actors.arm.ur import commissioning
from actors.arm.ur import controller_readout as look
from actors.arm.ur.controller_readout import read_exchange
from actors.arm.ur.robot_models import MODELS
from actors.arm.ur.ur_driver import require_accepted
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.emulators.ur_controller.controller_process import VirtualController
from actors.emulators.ur_controller.safety_system import SafetyConfiguration
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.cli.app import app
from orchestrator.runs.bench_check import check_bench
from orchestrator.runs.motion_approval import SafetyRecordError, accepted_checksum, read_record, record_path
from tests.support import hardware_laboratory
from tests.support.loopback import free_address
from tests.support.waiting import wait_for

JOINTS = [radians(q) for q in hardware_laboratory.HOME]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """How even the packages come is measured for a quarter of the time: here nobody's network is judged."""
    monkeypatch.setattr(look, "read_exchange", partial(read_exchange, seconds=0.25))


@pytest.fixture(scope="module")
def controller() -> Iterator[VirtualController]:
    with VirtualController.start(free_address(), "ur10", joints=JOINTS) as started:
        hardware_laboratory.install(started)
        yield started


@pytest.fixture(scope="module")
def balance() -> Iterator[VirtualSerialBalance]:
    started = VirtualSerialBalance.start("kcp", baud=0)
    yield started
    started.close()


@pytest.fixture
def laboratory(tmp_path: Path, controller: VirtualController) -> Path:
    return hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", controller.address)


def doctor(path: Path, *options: str) -> Result:
    return CliRunner().invoke(app, ["robot", "check", str(path), *options], catch_exceptions=False)


def checked(path: Path, *options: str) -> dict[str, dict[str, Any]]:
    """The table by name, the first line of each."""
    record = read_record(path) if record_path(path).exists() else None
    table = check_bench(load_laboratory(path), path, record, tare="--tare" in options).checks
    return {check.name: dataclasses.asdict(check) for check in reversed(table)}


def when_not_overloaded(path: Path, *options: str) -> Result:
    """What doctor says once this machine, which may be busy, keeps up with the controller's packages."""
    found = doctor(path, *options)
    for _ in range(20):
        if "FAIL  connection" not in found.stdout:
            break
        found = doctor(path, *options)
    return found


@pytest.mark.realtime
def test_a_bench_that_is_ready_has_its_settings_accepted_once_and_is_told_so(
    tmp_path: Path, controller: VirtualController, balance: VirtualSerialBalance
) -> None:
    path = hardware_laboratory.write_laboratory(
        tmp_path / "rig.yaml", controller.address, f"balance: {{placement: tray, port: {balance.port}}}"
    )
    before = controller.fault("state")
    refused = doctor(path)
    assert refused.exit_code == 1
    assert "not accepted yet" in refused.stdout
    assert f"decant robot check {path} --accept-safety" in refused.stdout
    accepted = when_not_overloaded(path, "--accept-safety")
    assert accepted.exit_code == 0, accepted.output
    record = json.loads(record_path(path).read_text())
    assert record["checksum"] == before["checksum"]
    assert record["serial"] == "2016300123"
    assert set(record) == {"checksum", "serial", "model", "software", "date", "accepted_by"}
    again = when_not_overloaded(path)
    assert again.exit_code == 0
    assert "ready" in again.stderr
    for line in ("PolyScope 3.15", "at home", "kcp", "0 g, stable", "not tried"):
        assert line.lower() in again.stdout.lower()
    after = controller.fault("state")
    assert after["joints"] == before["joints"]
    assert balance.state()["heard"].count("T") == 0 if "heard" in balance.state() else True


def test_a_program_gets_the_report_that_the_command_prints(laboratory: Path) -> None:
    report = decant.doctor(laboratory)
    printed, checks = doctor(laboratory).stdout, {check.name: check for check in report.checks}
    del checks["connection"]  # which changes on a busy machine
    assert all(check.found in printed and check.advice in printed for check in checks.values())
    assert not report.ready  # nobody has accepted its safety settings
    assert "not accepted yet" in str(report)
    assert "not accepted yet" in report._repr_html_()
    with pytest.raises(decant.InvalidArgumentError, match="has no 'arm'"):
        decant.doctor("configs/laboratories/planning.yaml")


@pytest.mark.realtime
def test_virtual_laboratory_is_started_looked_at_and_called_virtual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commissioning, "LONGEST_GAP", 0.0)  # as on a busy machine, for which a virtual bench waits
    result = doctor(Path("configs/laboratories/virtual.yaml"))
    assert result.exit_code == 0, result.output
    assert "virtual: no robot, no balance" in result.stderr
    assert "of a virtual controller, which needs no acceptance" in result.stdout
    assert "this computer is busy" in result.stdout


def test_a_bench_of_numbers_and_a_bad_file_are_refused_with_exit_code_2(tmp_path: Path) -> None:
    numbers = doctor(Path("configs/laboratories/twin.yaml"))
    assert numbers.exit_code == 2
    assert "laboratory twin has no 'arm', its bench is simulated: looked at are an arm" in " ".join(
        numbers.stderr.split()
    )
    assert doctor(tmp_path / "nowhere.yaml").exit_code == 2
    (tmp_path / "bad.yaml").write_text("name: x\nmode: hardwear\n")
    bad = doctor(tmp_path / "bad.yaml")
    assert bad.exit_code == 2
    assert "hardwear" in bad.stderr


@pytest.mark.realtime
def test_nobody_at_the_address(tmp_path: Path) -> None:
    path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", free_address())  # loopback: every port refuses
    network = checked(path)["network"]
    assert network["state"] == "fail"
    assert "closed" in network["found"]
    assert "Services" in network["advice"]
    path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", "no-such-robot.invalid")
    assert "is the name of no machine" in checked(path)["address"]["found"]


@pytest.mark.realtime
def test_one_closed_port_is_named_with_what_it_is_for(tmp_path: Path) -> None:
    address = free_address()
    servers = [socket.create_server((address, port)) for port in (30001, 30003, 30004)]
    path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", address)
    try:
        table = checked(path)
    finally:
        for server in servers:
            server.close()
    assert table["port 29999"]["state"] == "fail"
    assert "dashboard: refused" in table["port 29999"]["found"]
    assert table["port 30004"]["state"] == "ok"
    assert table["answers"]["state"] == "fail"  # the others accept, and say nothing


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("model", "options", "name", "found", "advice"),
    [
        ("ur10e", {"local": True}, "remote control", "off", "Remote"),
        ("ur10", {"state": "off"}, "arm", "power off", "brakes"),
        ("ur10", {"state": "idle"}, "arm", "idle", "brakes"),
        ("ur10e", {}, "model", "UR10E", "correct 'model'"),
        ("ur10", {"joints": [0.0, -1.5, 1.5, -1.5, -1.5, 0.0]}, "position", "not at home", "jog"),
    ],
)
def test_a_controller_that_was_started_otherwise(
    tmp_path: Path, model: str, options: dict[str, Any], name: str, found: str, advice: str
) -> None:
    with VirtualController.start(free_address(), model, **options) as started:
        path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", started.address)
        line = checked(path)[name]
    assert line["state"] == ("warn" if name == "position" else "fail")
    assert found in line["found"]
    assert advice in line["advice"]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("options", "why"),
    [({"local": True}, "remote control: off"), ({"polyscope_x": True, "local": True}, "remote control: off")],
    ids=["e-Series", "PolyScope X"],
)
def test_an_arm_in_local_control_is_not_called_ready(tmp_path: Path, options: dict[str, Any], why: str) -> None:
    with VirtualController.start(free_address(), "ur10e", joints=JOINTS, **options) as started:
        path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", started.address)
        path.write_text(path.read_text().replace("model: ur10", "model: ur10e"))
        motion = checked(path)["motion"]
    assert motion["state"] == "fail"
    assert why in motion["found"]
    assert "switch from Local to Remote" in motion["advice"]


@pytest.mark.realtime
@pytest.mark.parametrize("greets", [True, False], ids=["at the first question", "before its greeting"])
def test_a_dashboard_that_closes_the_connection_is_told_with_what_to_do(tmp_path: Path, greets: bool) -> None:
    """As after a restart, where the first connection is closed (Universal_Robots_ROS_Driver #262)."""

    class Closing(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            if greets:
                self.request.sendall(b"Connected: Universal Robots Dashboard Server\n")
                self.request.recv(100)

    address = free_address()
    server = socketserver.ThreadingTCPServer((address, 29999), Closing)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", address)
    try:
        line = checked(path)["answers"]
    finally:
        server.shutdown()
        server.server_close()
    assert line["state"] == "fail"
    assert f"the dashboard at {address}:29999 closed the connection" in line["found"]
    assert "PolyscopeVersion" in line["found"] if greets else "before its greeting" in line["found"]
    for remedy in ("booting", "local and remote", "Settings, Security", "try again", "restart the controller"):
        assert remedy in line["found"]


@pytest.mark.realtime
def test_stops_are_named_and_never_unlocked(tmp_path: Path) -> None:
    with VirtualController.start(free_address(), "ur10", joints=JOINTS) as started:
        path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", started.address)
        started.fault("protective_stop", reason="a test")
        line = checked(path)["safety"]
        assert (line["state"], line["found"]) == ("fail", "protective stop")
        assert "find the cause" in line["advice"]
        assert "PROTECTIVE" in str(started.fault("state")["safety_mode"])
        started.fault("emergency_stop")
        assert checked(path)["safety"]["found"] == "robot emergency stop"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("fault", "arguments", "line", "why"),
    [
        ("reduced", {}, "safety", "reduced mode is in force"),
        ("slider", {"fraction": 0.5}, "motion", "the speed slider is at 50 %; a pour needs 100 %"),
    ],
)
def test_doctor_fails_for_the_reason_for_which_the_driver_refuses(
    tmp_path: Path, fault: str, arguments: dict[str, Any], line: str, why: str
) -> None:
    with VirtualController.start(free_address(), "ur10", joints=JOINTS) as started:
        hardware_laboratory.install(started)
        path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", started.address)
        ready = checked(path)["motion"]
        assert (ready["state"], ready["found"]) == ("ok", "the arm is ready to move")
        started.fault(fault, **arguments)
        table = checked(path)
        assert table[line]["state"] == "fail"
        assert (table["motion"]["state"], table["motion"]["found"]) == ("fail", why)
        spec = load_laboratory(path).arm
        assert spec is not None
        cls, given = arm_kind(spec).driver(None)
        arm = cls(*given)
        try:
            assert arm.connect().problem == why
            arm.release()
            with pytest.raises(ArmRefusedError, match=why):
                arm.jog("joint 6", 0.02, 0.1)
        finally:
            arm.close()


@pytest.mark.realtime
def test_joints_are_numbered_from_1_everywhere(tmp_path: Path) -> None:
    away = [*JOINTS[:4], JOINTS[4] + 0.3, JOINTS[5]]
    with VirtualController.start(free_address(), "ur10", joints=away) as started:
        path = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", started.address)
        assert "joint 5 (wrist 2) is 17.2 deg away" in checked(path)["position"]["found"]
    assert joints_violation(9.0) == f"joint 5 (wrist 2) is at {degrees(9.0):.1f} deg, outside -363 … 363 deg"


def joints_violation(angle: float) -> str | None:
    q = [0.0, 0.0, 0.0, 0.0, angle, 0.0]
    return SafetyConfiguration.of(MODELS["ur10"]).joints_violation(q)


@pytest.mark.slow
@pytest.mark.parametrize(("module", "package"), [("psutil", "psutil"), ("serial", "pyserial"), ("ray", "Ray")])
def test_without_an_extra_doctor_names_package_and_extra_before_it_starts_anything(
    module: str, package: str, tmp_path: Path
) -> None:
    """In a process that can't import the package: what is started is a controller, and it would be started 20 times."""
    (tmp_path / "without.py").write_text(WITHOUT)
    told = subprocess.run(
        [sys.executable, tmp_path / "without.py", module, "robot", "check", "configs/laboratories/virtual.yaml"],
        env=dict(os.environ),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "Traceback" not in told.stderr
    said = " ".join((told.stdout + told.stderr).split())
    assert package in said
    assert "pip install 'decant-pouring[lab]'" in said
    looked = module == "ray"  # which is not needed to read what arm and balance say
    assert ("started: 1" in told.stderr) is looked
    assert told.returncode == (1 if looked else 2)


WITHOUT = """\
import importlib.util, sys
from actors.emulators.ur_controller.controller_process import VirtualController
missing, real, started = sys.argv.pop(1), importlib.util.find_spec, []
importlib.util.find_spec = lambda name, *rest: None if name == missing else real(name, *rest)
sys.modules[missing] = None
start = VirtualController.start.__func__
VirtualController.start = classmethod(lambda cls, *a, **k: (started.append(1), start(cls, *a, **k))[1])
from orchestrator.cli.app import main
try:
    main()
finally:
    print("started:", len(started), file=sys.stderr)
"""


@pytest.mark.realtime
def test_another_tool_or_payload_than_the_file_s(laboratory: Path, controller: VirtualController) -> None:
    hardware_laboratory.install(controller, tool=0.12, payload=0.3)
    try:
        table = checked(laboratory)
    finally:
        hardware_laboratory.install(controller)
    assert table["tool"]["state"] == table["payload"]["state"] == "fail"
    assert "50.0 mm" in table["tool"]["found"]
    assert "0.30 kg on the controller, 1.60 kg in the file" in table["payload"]["found"]
    assert checked(laboratory)["tool"]["state"] == "ok"


@pytest.mark.realtime
def test_changed_safety_settings_are_shown_with_both_checksums(laboratory: Path, controller: VirtualController) -> None:
    doctor(laboratory, "--accept-safety")
    before = accepted_checksum(laboratory)
    controller.fault("checksum", value="DEADBEEF")
    try:
        line = checked(laboratory)["safety checksum"]
    finally:
        controller.fault("checksum")
    assert line["state"] == "fail"
    assert "DEADBEEF" in line["found"]
    assert str(before) in line["found"]


@pytest.mark.realtime
def test_settings_that_were_accepted_for_another_robot_don_t_count(
    laboratory: Path, controller: VirtualController
) -> None:
    doctor(laboratory, "--accept-safety")
    path = record_path(laboratory)
    path.write_text(path.read_text().replace("2016300123", "1999999999"))
    line = checked(laboratory)["safety checksum"]
    assert line["state"] == "fail"
    assert "1999999999" in line["found"]


@pytest.mark.realtime
@pytest.mark.parametrize("content", ["", "[]", '{"checksum": "12345678"}', "{"])
def test_a_spoilt_record_is_an_error_and_not_a_missing_one(laboratory: Path, content: str) -> None:
    record_path(laboratory).write_text(content)
    with pytest.raises(SafetyRecordError, match="accept-safety"):
        read_record(laboratory)
    assert doctor(laboratory).exit_code == 2


@pytest.mark.realtime
def test_balance_that_is_unplugged_or_silent_is_told_with_what_to_do(
    tmp_path: Path, controller: VirtualController, balance: VirtualSerialBalance
) -> None:
    missing = hardware_laboratory.write_laboratory(
        tmp_path / "a.yaml", controller.address, "balance: {placement: tray, port: /dev/serial/by-id/nothing}"
    )
    assert "isn't there" in checked(missing)["balance port"]["found"]
    for port, says in (("/dev/null", "not a serial port"), (tmp_path, "a folder"), (missing, "a file")):
        wrong = hardware_laboratory.write_laboratory(
            tmp_path / "c.yaml", controller.address, f"balance: {{placement: tray, port: {port}}}"
        )
        checks = checked(wrong)
        assert (checks["balance port"]["state"], "balance" in checks) == ("fail", False)
        assert says in checks["balance port"]["found"]
    present = hardware_laboratory.write_laboratory(
        tmp_path / "b.yaml", controller.address, f"balance: {{placement: tray, port: {balance.port}, dialect: kcp}}"
    )
    balance.unplug()
    try:
        assert checked(present)["balance port"]["state"] == "fail"
    finally:
        balance.plug()
    tared = checked(present, "--tare")["balance tare"]
    assert (tared["state"], tared["found"]) == ("ok", "it obeyed, and rests at zero")


def test_nothing_is_poured_with_settings_that_nobody_accepted_or_that_have_changed() -> None:
    require_accepted("22c99aa2", "22C99AA2", "robot")
    with pytest.raises(NotAcceptedError, match="decant robot check"):
        require_accepted(None, "22C99AA2", "robot")
    with pytest.raises(NotAcceptedError, match="have changed: checksum DEADBEEF, accepted was 22C99AA2"):
        require_accepted("22C99AA2", "DEADBEEF", "robot")
    with pytest.raises(NotAcceptedError, match="reports no safety checksum"):
        require_accepted("22C99AA2", None, "robot")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(("up", "state"), [("0, 9.82, 0", "fail"), ("0, 0.5, 9.8", "ok")])
def test_a_robot_that_hangs_where_the_file_has_it_stand_is_told(
    laboratory: Path, controller: VirtualController, up: str, state: str
) -> None:
    """What the tool feels tells where up is."""
    with socket.create_connection((controller.address, 30003), timeout=5.0) as connection:
        connection.sendall(f"def hang():\n set_gravity([{up}])\nend\n".encode())
        wait_for(lambda: "program hang started" in str(controller.fault("state")["messages"]), "the program's start")
    try:
        found = checked(laboratory)["mount"]
    finally:
        with socket.create_connection((controller.address, 30003), timeout=5.0) as connection:
            connection.sendall(b"def stand():\n set_gravity([0, 0, 9.82])\nend\n")
            wait_for(
                lambda: "program stand started" in str(controller.fault("state")["messages"]), "start of the program"
            )
    assert found["state"] == state, found
    if state == "fail":
        assert "tilt 90 deg, turn 0 deg would agree" in found["found"]
        assert "mount" in found["advice"]
