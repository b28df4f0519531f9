"""`ur_driver`: lines that are cut, processes that die, controllers that are not what they should be."""

from __future__ import annotations

import contextlib
import json
import math
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from actors.arm.arm_interface import ArmError, ArmLostError, ArmNotReleasedError, ArmRefusedError, ArmStoppedError
from actors.arm.planned_pour import JointPath
from actors.arm.ur import rtde, worker_messages
from actors.arm.ur.rtde_client import has_library
from actors.arm.ur.ur_driver import UrArm
from actors.arm.ur.urscript_writer import path_program
from actors.arm.ur.worker_messages import MotionSettings
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import child_environment
from tests.actors.arm.ur.conftest import Call, Rig
from tests.support.loopback import free_address
from tests.support.ur_pours import START, pour_path, settings
from tests.support.waiting import PATIENCE, alive

Make = Callable[..., Rig]
LONG_TILT = pour_path(angle=math.radians(80.0), speed=math.radians(15.0), hold=20.0)
"""Ten seconds of tilting: there is time for a fault in the middle of it."""

FASTER = 3.0
"""Time scale where what is waited for goes by the clock: heartbeats, and silence."""


def lost(call: Call) -> ArmLostError:
    with pytest.raises(ArmLostError) as caught:
        call.result()
    return caught.value


def stood_soon(rig: Rig, since: float, limit: float) -> None:
    """The arm came to rest by itself, tilted, within so many seconds of the clock, and stays so."""
    rig.await_rest()
    times, joints = rig.history(since)
    moving = times[np.abs(joints - joints[-1]).max(axis=1) > 1e-5]
    at_rest = moving[-1] - since if len(moving) else 0.0
    assert at_rest < limit * rig.arm._spec.time_scale
    assert 0.05 < joints[-1][5] - START[5] < 1.3
    later = rig.now
    rig.await_time(later + 0.3 * rig.arm._spec.time_scale)
    assert rig.moved(later) < 1e-6
    assert rig.fault("state")["runtime_state"] == "STOPPED"


def goes_on_only_by_an_operator(rig: Rig) -> None:
    began = rig.now
    with pytest.raises(ArmError):
        rig.arm.untilt()
    rig.arm.connect()
    with pytest.raises(ArmNotReleasedError):
        rig.arm.untilt()
    assert rig.moved(began) < 1e-6
    rig.arm.release()
    rig.arm.untilt()
    assert rig.joints == pytest.approx(START, abs=1e-3)


def answers(rig: Rig) -> bool:
    """Whether the controller accepts connections of the driver."""
    try:
        socket.create_connection((rig.controller.address, 30004), timeout=5.0).close()
    except OSError:
        return False
    return True


def connections(rig: Rig) -> set[int]:
    """Ports of the worker's connections for RTDE."""
    found = psutil.Process(rig.worker).net_connections()
    return {one.laddr.port for one in found if one.raddr and one.raddr.port == rtde.PORT}


# ---- lines


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("fault", [pytest.param("drop", marks=pytest.mark.slow), "stall"])
def test_a_lost_line_ends_the_pour_and_the_arm_stands_until_released(make_rig: Make, fault: str) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER)
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    began = rig.now
    rig.fault(fault)
    error = lost(pouring)
    assert "tilt" in str(error)
    assert fault == "drop" or "nothing new" in str(error)  # by its timestamps, long before the library notices
    assert error.executed is not None
    assert len(error.executed.times) > 20
    stood_soon(rig, began, 1.5)
    rig.fault("clear")
    goes_on_only_by_an_operator(rig)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.skipif(not has_library(), reason="without ur-rtde, nothing gives up")
@pytest.mark.parametrize("late", ["controller", "worker"])
def test_a_pour_is_completed_though_the_library_gave_up_on_a_late_host(
    make_rig: Make, tmp_path: Path, late: str
) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER, clock=str(tmp_path / "clock"))
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    before = connections(rig)
    stopped = rig.controller.pid if late == "controller" else rig.worker
    os.kill(stopped, signal.SIGSTOP)
    if late == "controller":
        rig.await_that(lambda: not before <= connections(rig), "the library's end of the connection")
    else:
        time.sleep(3.5)  # more than the 2.5 s after which the library gives up, also where its own thread was stopped
    os.kill(stopped, signal.SIGCONT)
    assert pouring.result() is not None
    assert rig.joints == pytest.approx(START, abs=1e-3)


@pytest.mark.realtime
@pytest.mark.skipif(not has_library(), reason="without ur-rtde, nothing gives up")
def test_an_arm_that_nobody_looked_at_for_long_moves_though_the_library_gave_up_on_a_late_host(
    make_rig: Make, tmp_path: Path
) -> None:
    rig = make_rig(pour_path(hold=0.1), time_scale=FASTER, clock=str(tmp_path / "clock"))
    rig.await_time(rig.now + 250.0 * worker_messages.SILENCE)  # as while kernels for a dose are compiled
    before = connections(rig)
    os.kill(rig.controller.pid, signal.SIGSTOP)
    rig.await_that(lambda: not before <= connections(rig), "the library's end of the connection")
    os.kill(rig.controller.pid, signal.SIGCONT)
    assert rig.pouring().result() is not None
    assert rig.joints == pytest.approx(START, abs=1e-3)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_connection_that_is_cut_ends_the_pour_on_a_virtual_bench_as_well(make_rig: Make, tmp_path: Path) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER, clock=str(tmp_path / "clock"))
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    rig.fault("drop")
    assert "tilt" in str(lost(pouring))


@pytest.mark.slow
@pytest.mark.realtime
def test_after_a_reboot_in_mid_pour_tool_and_payload_are_set_again(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT)
    rig.fault("reboot", seconds=4.0, joint=5, above=START[5] + 0.4)
    lost(rig.pouring())
    with pytest.raises(ArmLostError):
        rig.arm.connect()
    rig.await_that(lambda: answers(rig), "controller after its reboot")
    facts = rig.arm.connect()
    assert (facts.robot_mode, facts.payload) == ("off", 0.0)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="off"):
        rig.arm.untilt()
    rig.arm.release()
    assert "brakes released" in rig.arm.recover()
    assert rig.joints[5] - START[5] > 0.3
    rig.arm.release()
    rig.arm.untilt()
    assert rig.fault("state")["payload"] == 1.2
    assert rig.joints == pytest.approx(START, abs=1e-3)


@pytest.mark.realtime
def test_nobody_there_is_told_with_what_to_look_at() -> None:
    with pytest.raises(ArmLostError, match=r"no robot at 127\..*RTDE.*Is the controller on"):
        UrArm(settings(free_address())).connect()


@pytest.mark.realtime
def test_a_controller_that_accepts_and_says_nothing_does_not_hang_the_driver() -> None:
    address = free_address()
    with contextlib.ExitStack() as stack:
        for port in (30004, 29999, 30001):
            server = stack.enter_context(socket.create_server((address, port)))
            server.listen()
        arm = UrArm(settings(address))
        with pytest.raises(ArmLostError):
            arm.connect()


# ---- processes


@pytest.mark.slow
@pytest.mark.realtime
def test_killing_the_worker_in_mid_pour_stops_the_arm(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER)
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    began = rig.now
    os.kill(rig.worker, signal.SIGKILL)
    error = lost(pouring)
    assert "died" in str(error)
    assert "tilted by" in str(error)
    assert "the program on the controller ends by its watchdog" in str(error)
    stood_soon(rig, began, 1.5)
    goes_on_only_by_an_operator(rig)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_program_that_a_stop_left_paused_never_goes_on(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT)
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    os.kill(rig.worker, signal.SIGSTOP)
    rig.fault("protective_stop")
    os.kill(rig.worker, signal.SIGKILL)  # nobody is left to end the program: neither the worker nor the watchdog
    lost(pouring)
    rig.await_rest()
    assert rig.fault("state")["runtime_state"] == "PAUSED"
    began = rig.now
    rig.arm.release()
    rig.arm.recover()
    assert rig.fault("state")["runtime_state"] == "STOPPED"
    assert rig.moved(began) < 1e-6
    rig.arm.release()
    rig.arm.untilt()
    assert rig.joints == pytest.approx(START, abs=1e-3)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_stop_takes_effect_while_the_worker_hangs(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER)
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    os.kill(rig.worker, signal.SIGSTOP)
    began = rig.now
    with pytest.raises(ArmLostError, match="was not seen to stand still"):
        rig.arm.stop()
    lost(pouring)
    stood_soon(rig, began, 1.5)


@pytest.mark.realtime
def test_killing_the_driver_s_process_in_mid_pour_stops_the_arm(make_rig: Make, tmp_path: Path) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER, connect=False)
    (tmp_path / "pour").write_bytes(pickle.dumps((rig.arm._spec, rig.path)))
    program = (
        "import pickle, sys; from actors.arm.ur.ur_driver import UrArm\n"
        f"spec, path = pickle.load(open({str(tmp_path / 'pour')!r}, 'rb'))\n"
        "arm = UrArm(spec); arm.connect(); arm.release(); arm.move_to_start(path)\n"
        "print(arm._session.pid, flush=True); arm.execute(path)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=child_environment()
    )
    try:
        assert process.stdout is not None
        worker = int(process.stdout.readline())
        rig.await_tilt(0.15)
        began = rig.now
        process.kill()
        process.wait()
        stood_soon(rig, began, 1.5)
        rig.await_that(lambda: not alive(worker), "the worker's end")
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


@pytest.mark.slow
def test_a_driver_that_hangs_in_mid_pour_stops_the_arm(make_rig: Make, tmp_path: Path) -> None:
    rig = make_rig(LONG_TILT, time_scale=1.0, connect=False)
    (tmp_path / "pour").write_bytes(pickle.dumps((rig.arm._spec, rig.path)))
    program = (
        "import pickle, sys; from actors.arm.ur.ur_driver import UrArm\n"
        f"spec, path = pickle.load(open({str(tmp_path / 'pour')!r}, 'rb'))\n"
        "arm = UrArm(spec); arm.connect(); arm.release(); arm.move_to_start(path); arm.execute(path)"
    )
    process = subprocess.Popen([sys.executable, "-c", program], env=child_environment())
    try:
        rig.await_tilt(0.15)
        began = rig.now
        process.send_signal(signal.SIGSTOP)
        rig.await_that(lambda: rig.fault("state")["runtime_state"] == "STOPPED", "the program's end")
        stood_soon(rig, began, 5.0)
    finally:
        process.kill()
        process.wait()


@pytest.mark.realtime
def test_an_interrupt_at_the_keyboard_stops_the_arm(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT, time_scale=FASTER)
    rig.to_start()
    tilted = Call(rig.await_tilt, 0.15)

    def interrupt() -> None:
        tilted.result()
        os.kill(os.getpid(), signal.SIGINT)

    interrupting = Call(interrupt)
    with pytest.raises(KeyboardInterrupt):
        rig.arm.execute(rig.path)
    interrupting.result()
    stood_soon(rig, rig.now, 1.0)
    with pytest.raises(ArmNotReleasedError):
        rig.arm.untilt()


# ---- others at the same robot


@pytest.mark.slow
@pytest.mark.realtime
def test_somebody_else_s_program_ends_the_pour(make_rig: Make) -> None:
    rig = make_rig(LONG_TILT)
    pouring = rig.pouring()
    rig.await_tilt(0.15)
    _upload(rig, "sync()")
    with pytest.raises(ArmStoppedError) as caught:
        pouring.result()
    assert caught.value.kind == "program ended"
    assert "other" in str(caught.value)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_program_that_runs_already_is_not_replaced(rig: Rig) -> None:
    _upload(rig, "while True:\n  sync()\n end")
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="a program runs"):
        rig.arm.move_to_start(rig.path)
    assert rig.fault("state")["program"] == "other"


@pytest.mark.realtime
def test_a_second_driver_is_told_that_somebody_has_the_robot(resting: Rig) -> None:
    second = UrArm(resting.arm._spec)
    with pytest.raises(ArmError, match="another client writes input_int_register_43"):
        second.connect()
    assert resting.arm.facts().program == "STOPPED"  # the first doesn't mind


@pytest.mark.slow
@pytest.mark.realtime
def test_another_robot_than_set_up_is_refused(make_rig: Make) -> None:
    rig = make_rig(connect=False, model="ur10")
    with pytest.raises(ArmRefusedError, match=r"is a UR10E.*set up as UR10"):
        rig.arm.connect()


@pytest.mark.realtime
def test_a_controller_that_did_not_take_the_payload_keeps_the_arm_still(
    resting: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def heavier(path: JointPath, asked: MotionSettings, number: int, *, cb3: bool) -> str:
        return path_program(path, replace(asked, payload=3.3), number, cb3=cb3)

    monkeypatch.setattr("actors.arm.ur.ur_driver.path_program", heavier)
    resting.arm.release()
    with pytest.raises(ArmRefusedError, match=r"were set to .*1\.2.*; the controller has .*3\.3"):
        resting.arm.move_to_start(resting.path)


def _upload(rig: Rig, statements: str) -> None:
    with socket.create_connection((rig.controller.address, 30003), timeout=5) as connection:
        connection.sendall(f"def other():\n {statements}\nend\n".encode())
        rig.await_that(lambda: "program other started" in str(rig.fault("state")["messages"]), "start of the program")


# ---- what is asked for


@pytest.mark.parametrize(
    ("times", "joints"),
    [
        ([0.0, 1.0], np.zeros((2, 3))),
        ([0.0, 1.0], np.zeros((3, 6))),
        ([0.0, math.nan], np.zeros((2, 6))),
        ([0.0, 1.0], np.full((2, 6), math.inf)),
        ([0.0, 0.0], np.zeros((2, 6))),
        ([0.5, 1.0], np.zeros((2, 6))),
        ([0.0], np.zeros((1, 6))),
    ],
)
def test_what_is_no_path_is_refused_before_it_reaches_the_robot(times: Any, joints: Any) -> None:
    arm = UrArm(settings(free_address()))
    arm.release()
    with pytest.raises(ArmRefusedError, match="path"):
        arm.move_to_start(replace(pour_path(), approach=JointPath(np.array(times), joints)))


@pytest.mark.realtime
def test_a_path_that_leaves_the_box_is_refused(resting: Rig) -> None:
    resting.arm.release()
    low = np.array(START) + np.array([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])
    way = JointPath(np.linspace(0.0, 4.0, 41), np.linspace(resting.arm.joints(), low, 41))
    with pytest.raises(LaboratoryError, match=r"table|box"):
        resting.arm.move_to_start(replace(pour_path(), approach=way))


def test_values_arrive_whole_between_messages_and_what_an_older_controller_lacks_is_left_out() -> None:
    """The controller refuses a recipe that names an unknown value, and sends text messages at any time."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        text = rtde.package(rtde.TEXT_MESSAGE, b"\5hello\4test\1")
        theirs.sendall(rtde.package(rtde.REQUEST_PROTOCOL_VERSION, b"\1") + text)
        theirs.sendall(rtde.package(rtde.SETUP_OUTPUTS, b"\0DOUBLE,NOT_FOUND,VECTOR6D,INT32"))
        theirs.sendall(rtde.package(rtde.SETUP_OUTPUTS, b"\1DOUBLE,VECTOR6D,INT32"))
        theirs.sendall(text + rtde.package(rtde.START, b"\1") + text)
        outputs = rtde.Outputs(rtde.Requests(ours), ("timestamp", "ft_raw_wrench", "actual_q", "robot_mode"), 125.0)
        assert outputs.fields == ("timestamp", "actual_q", "robot_mode")
        whole = rtde.package(rtde.DATA_PACKAGE, struct.pack(">B7di", 1, 12.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -1))
        theirs.sendall(whole[:9])
        sending = threading.Timer(0.05, theirs.sendall, [whole[9:] + text + whole])
        sending.start()
        values = {"timestamp": (12.5,), "actual_q": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), "robot_mode": (-1,)}
        assert [outputs.values(outputs.next()) for _ in range(2)] == [values, values]
        sending.join()
        theirs.sendall(rtde.package(rtde.DATA_PACKAGE, b"\1 of another recipe"))
        with pytest.raises(rtde.PackageError, match="19 instead of 61 bytes"):
            outputs.next()


BOTH_READERS = """
import sys
from actors.arm.ur.rtde_client import LibraryReader, OutputReader, has_library
assert has_library()
with_library, own = LibraryReader(sys.argv[1], 125.0), OutputReader(sys.argv[1], 125.0)
(_, first), (_, second) = with_library.latest(), own.latest()
assert first.keys() == second.keys(), first.keys() ^ second.keys()
for name in first.keys() - {"timestamp"}:
    assert len(first[name]) == len(second[name]), name
    assert all(abs(a - b) < 1e-6 for a, b in zip(first[name], second[name])), (name, first[name], second[name])
assert with_library.lost == own.lost == ""
"""


@pytest.mark.ur_rtde
@pytest.mark.realtime
def test_the_library_and_the_reader_without_it_read_the_same_values(resting: Rig) -> None:
    program = [sys.executable, "-c", BOTH_READERS, resting.controller.address]
    ended = subprocess.run(program, capture_output=True, text=True, timeout=PATIENCE, env=child_environment())
    assert ended.returncode == 0, ended.stderr


@pytest.mark.realtime
def test_an_arm_is_reached_without_the_client_library(
    make_rig: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(connect=False)
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['rtde_receive'] = None")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    rig.arm.connect()
    assert len(rig.arm.joints()) == 6


@pytest.mark.realtime
def test_the_driver_does_not_load_the_client_library() -> None:
    program = (
        "import sys, actors.arm.ur.ur_driver; "
        "print([m for m in sys.modules if m.startswith('rtde') or m.startswith('dashboard_client')])"
    )
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, env=child_environment()
    )
    assert said.stdout.strip() == "[]"


def test_errors_survive_the_way_between_processes() -> None:
    error = ArmStoppedError("stopped", "operator", "tilt", 1.5, 0.4, None)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.kind, again.phase, again.time, again.tilt) == ("stopped", "operator", "tilt", 1.5, 0.4)
    assert str(pickle.loads(pickle.dumps(ArmLostError("gone")))) == "gone"
    assert json.dumps(str(again))


# ---- small steps


@pytest.mark.slow
@pytest.mark.realtime
def test_a_step_moves_the_tool_as_asked_and_needs_a_word_each_time(rig: Rig) -> None:
    rig.arm.release()
    before = np.array(rig.fault("state")["pose"])
    rig.arm.jog("z", 0.03, 0.1)
    after = np.array(rig.fault("state")["pose"])
    # the tool is set with the first step: compare with where the tool was
    assert after[2] - before[2] == pytest.approx(0.03 - 0.15, abs=0.002)
    with pytest.raises(ArmNotReleasedError):
        rig.arm.jog("z", 0.03, 0.1)
    rig.arm.release()
    before = np.array(rig.fault("state")["pose"])
    rig.arm.jog("rx", 0.1, 0.3)
    assert np.array(rig.fault("state")["pose"])[:3] == pytest.approx(before[:3], abs=1e-4)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("axis", "amount", "speed"),
    [("joint 6", 0.2, 0.1), ("x", 0.06, 0.05), ("x", 0.01, 0.5), ("joint 7", 0.1, 0.1), ("y", math.nan, 0.05)],
)
def test_steps_too_far_or_too_fast_are_refused(resting: Rig, axis: str, amount: float, speed: float) -> None:
    resting.arm.release()
    with pytest.raises(ArmRefusedError):
        resting.arm.jog(axis, amount, speed)
