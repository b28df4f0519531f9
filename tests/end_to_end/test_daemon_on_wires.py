"""A daemon whose rig is 'hardware' at the far end of real wires: armed over the API, killed while liquid flows, asked.

The robot's controller and the balance run on behind a daemon that is killed, as real ones do: what they show afterwards
is what a person who has to answer is shown.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from math import radians
from pathlib import Path
from typing import Any

import pytest

from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.emulators.ur_controller.controller_process import VirtualController
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.state.access_tokens import Role, token_of
from orchestrator.records.journal import Kind
from orchestrator.runs.motion_approval import SafetyRecord, write_record
from tests.end_to_end.test_daemon_killed import Laboratory, opened
from tests.support import hardware_laboratory
from tests.support.command_process import pour_under_way
from tests.support.loopback import free_address

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

SPILLED = 37.2e-3
"""What has run onto the tray when the daemon dies [kg]."""


@pytest.fixture
def controller() -> Iterator[VirtualController]:
    joints = [radians(q) for q in hardware_laboratory.HOME]
    with VirtualController.start(free_address(), "ur10", joints=joints) as started:
        hardware_laboratory.install(started)
        yield started


@pytest.fixture
def balance() -> Iterator[VirtualSerialBalance]:
    started = VirtualSerialBalance.start("kcp", latency=0.002)
    yield started
    started.close()


@pytest.fixture
def laboratory(tmp_path: Path, controller: VirtualController, balance: VirtualSerialBalance) -> Iterator[Laboratory]:
    hardware_laboratory.write_rig(tmp_path, controller.address)
    wired = f"balance: {{placement: tray, port: {balance.port}, dialect: kcp, repeatability: 0.1 g, step: 0.1 g}}"
    person = "operator: {answers: person}"
    hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", controller.address, f"{wired}\n{person}")
    checksum = controller.fault("state")["checksum"]
    record = SafetyRecord(checksum, "2016300123", "ur10", "3.15.8", "2030-01-31", "a person")
    write_record(tmp_path / "rig.yaml", record)
    (tmp_path / "daemon.yaml").write_text("listen: {port: 0}\nrigs: {north: rig.yaml}\nkeep_free: 40 MB\n")
    with opened(tmp_path) as found:
        found.settings = ["daemon.yaml"]
        found.start()
        yield found


def client(laboratory: Laboratory, role: Role = Role.OPERATOR) -> Client:
    token = token_of(laboratory.state / "tokens", role)
    if role is Role.VIEWER:
        line = next(one for one in (laboratory.state / "tokens").read_text().splitlines() if one.startswith("viewer"))
        token = line.split()[2]
    return Client(state=laboratory.state, token=token)


ON_TRAY = {"pourer_empty": 0.2, "pourer_full": 0.3}
"""What somebody puts there when they are asked for it [kg]; nothing otherwise."""


def answer_until(laboratory: Laboratory, people: Client, balance: VirtualSerialBalance, happened: Any) -> None:
    """As somebody at the bench would, who does what is asked."""

    def answered() -> Any:
        if happened():
            return True
        for question in people.get("/questions"):
            said = {"done": "done", "yes or no": "yes", "weight": "0.4 g"}.get(question["wants"])
            if said is not None:
                balance.put(ON_TRAY.get(question["about"], 0.0))
                people.post(f"/questions/{question['id']}/answer", {"answer": said})
        return None

    laboratory.until(answered)


def test_hardware_is_armed_over_the_api_and_after_a_crash_shows_where_it_stands_and_what_was_spilled(
    laboratory: Laboratory, controller: VirtualController, balance: VirtualSerialBalance
) -> None:
    def joints() -> Any:
        return controller.fault("state")["joints"]

    home = joints()
    key = laboratory.decant("queue", "submit", "rigged.yaml").stdout.strip()
    with client(laboratory) as people, client(laboratory, Role.VIEWER) as viewer:
        assert people.get(f"/campaigns/{key}")["needs_enabling"]
        with pytest.raises(DaemonError, match="takes operator"):
            viewer.post(f"/campaigns/{key}/enable", {"laboratory": "rig"})
        moves = people.get(f"/campaigns/{key}/motion")
        assert moves["laboratory"] == "rig"
        assert any("deg" in line for line in moves["lines"])
        with pytest.raises(DaemonError, match="motion is not enabled: 'yes' was typed"):
            people.post(f"/campaigns/{key}/enable", {"laboratory": "yes"})
        time.sleep(0.5)  # an arm that moves would be seen to
        assert joints() == home
        people.post(f"/campaigns/{key}/enable", {"laboratory": "rig"})
        answer_until(laboratory, people, balance, lambda: people.get("/rigs")[0]["checkpoint"] == "tilt")
        time.sleep(0.7)  # into the tilt
        laboratory.kill()
    balance.put(SPILLED)

    def stands() -> bool:
        before = joints()
        time.sleep(0.3)  # an arm that moves would be seen to
        return bool(joints() == before)

    end = time.monotonic() + 20.0
    while not stands():
        assert time.monotonic() < end, "the arm moves on without its program"
    tilted = joints()
    assert tilted != home
    assert pour_under_way(laboratory.entries())

    laboratory.start()
    with client(laboratory) as people:
        assert people.get(f"/campaigns/{key}")["needs_enabling"], "a crash takes the arming away"
        people.post(f"/campaigns/{key}/enable", {"laboratory": "rig"})
        (question,) = laboratory.until(lambda: people.get("/questions"))
        assert question["kind"] == "unknown"
        assert question["options"] == ["lost", "weighed SPILLED RETAINED [LOADED]"]
        shown = " ".join(f"{name}: {text}" for name, text in question["details"].items())
        print(shown)
        assert "37.2" in shown
        assert joints() == tilted, "nothing moves while it is asked"
        people.post(f"/questions/{question['id']}/answer", {"answer": "weighed 37.2 0.4"})
        laboratory.until(lambda: any(e.kind == Kind.OPERATOR_ANSWERED for e in laboratory.entries()))
        people.post(f"/campaigns/{key}/stop")
    assert laboratory.end() == 0
    (outcome,) = [e.body["outcome"] for e in laboratory.entries() if e.kind == Kind.POUR_FINISHED]
    assert outcome["measurement"]["spilled"] == pytest.approx(SPILLED)
