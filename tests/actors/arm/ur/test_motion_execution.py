"""`motion_execution`: whole pours on the virtual controller, as the founder of a campaign would see them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.arm.arm_interface import ArmLostError, ArmNotReleasedError, ArmRefusedError, ArmStoppedError
from actors.arm.ur.motion_execution import MotionMonitor
from actors.arm.ur.rtde_client import RtdeClient
from actors.runtime.bench_clock import SharedClock
from tests.actors.arm.ur.conftest import Call, Rig
from tests.support.ur_pours import HOME, START, pour_path

Make = Callable[..., Rig]


@pytest.mark.realtime
def test_a_whole_pour_comes_back_home_and_tells_what_was_done(make_rig: Make) -> None:
    path = pour_path(angle=math.radians(40.0), speed=math.radians(80.0), hold=0.3)
    rig = make_rig(path, time_scale=1.0, frequency=500.0)
    rig.to_start()
    began = rig.now
    executed = rig.arm.execute(path)
    rig.arm.retreat(path)
    assert rig.joints == pytest.approx(HOME, abs=1e-4)
    assert executed.completed
    assert executed.times[0] == 0.0
    assert np.all(np.diff(executed.times) > 0.0)
    assert path.pour.duration < executed.times[-1] < path.pour.duration + 1.0
    # what it says was done is what the controller knows was done, on the same clock up to a constant
    times, joints = rig.history(began)
    moving = np.flatnonzero(np.abs(joints[:, 5] - START[5]) > 0.3)
    said = np.flatnonzero(np.abs(executed.joints[:, 5] - START[5]) > 0.3)
    lasted = times[moving[-1]] - times[moving[0]]
    assert executed.times[said[-1]] - executed.times[said[0]] == pytest.approx(lasted, abs=0.05)
    assert executed.joints[:, 5].max() == pytest.approx(joints[: moving[-1], 5].max(), abs=1e-3)
    # servoj's filter follows with its lookahead of 30 ms, and rounds what changes within that
    assert executed.tracking["lag"] == pytest.approx(0.032, abs=0.01)
    assert executed.tracking["rms_angle"] < math.radians(0.1)
    assert executed.tracking["max_angle"] < math.radians(0.3)
    assert executed.tracking["max_tool"] < 1e-3
    assert len(executed.times) > 60.0 * path.pour.duration  # 125 Hz on a machine with nothing else to do


@pytest.mark.realtime
def test_what_was_executed_at_scaled_time_is_the_same_pour(rig: Rig) -> None:
    rig.to_start()
    executed = rig.arm.execute(rig.path)
    lag = executed.tracking["lag"]
    assert np.abs(executed.joints - rig.path.pour.at(executed.times - lag)).max() < math.radians(0.5)
    assert executed.tracking["longest_gap"] > 0.05  # ten times as far apart as at time scale 1


@pytest.mark.realtime
def test_the_older_generation_pours_too(make_rig: Make) -> None:
    rig = make_rig(there="ur10", model="ur10")
    assert rig.arm.facts().remote is None  # it knows no such thing
    rig.to_start()
    executed = rig.arm.execute(rig.path)
    rig.arm.retreat(rig.path)
    assert executed.completed
    assert rig.joints == pytest.approx(HOME, abs=1e-4)


@pytest.mark.realtime
def test_tool_and_payload_are_set_whatever_was_there_before(rig: Rig) -> None:
    rig.to_start()
    state = rig.fault("state")
    assert state["tcp"] == pytest.approx(rig.arm._spec.tool.as_list)
    assert (state["payload"], state["cog"]) == (1.2, [0.0, 0.0, 0.08])


@pytest.mark.realtime
def test_a_payload_that_the_controller_refuses_keeps_the_arm_still(make_rig: Make) -> None:
    rig = make_rig(payload=50.0)
    rig.arm.release()
    began = rig.now
    with pytest.raises(ArmRefusedError, match="payload of 50"):
        rig.arm.move_to_start(rig.path)
    assert rig.moved(began) == 0.0


# ---- consent


@pytest.mark.realtime
def test_nothing_moves_before_an_operator_has_released_the_arm(resting: Rig) -> None:
    for motion in (resting.arm.move_to_start, resting.arm.execute, resting.arm.retreat, resting.arm.untilt):
        with pytest.raises(ArmNotReleasedError):
            motion(resting.path)
    with pytest.raises(ArmNotReleasedError):
        resting.arm.jog("joint 6", 0.1, 0.1)
    with pytest.raises(ArmNotReleasedError):
        resting.arm.recover()
    assert resting.fault("state")["messages"] == []  # not even a program was started


@pytest.mark.realtime
def test_movement_begins_after_the_announced_delay(make_rig: Make) -> None:
    rig = make_rig(warning_time=8.0)
    began = rig.now
    rig.to_start()
    times, joints = rig.history(began)
    moving = times[np.abs(joints - joints[0]).max(axis=1) > 1e-4]
    assert moving[0] - began > 7.0  # of the controller's seconds: its clock may lag a little


@pytest.mark.realtime
def test_movement_of_which_everybody_was_warned_begins_at_once(make_rig: Make) -> None:
    rig = make_rig(warning_time=30.0)
    began = rig.now
    rig.arm.release(warned=True)
    rig.arm.move_to_start(rig.path)
    times, joints = rig.history(began)
    moving = times[np.abs(joints - joints[0]).max(axis=1) > 1e-4]
    assert moving[0] - began < 20.0  # of the controller's seconds; uploading the program takes some


@pytest.mark.realtime
def test_a_stop_while_movement_is_announced_keeps_the_arm_still(make_rig: Make) -> None:
    rig = make_rig(warning_time=30.0)
    began = rig.now
    rig.arm.release()
    moving = Call(rig.arm.move_to_start, rig.path)
    rig.await_phase("announced")
    rig.arm.stop()
    with pytest.raises(ArmStoppedError) as stopped:
        moving.result()
    assert (stopped.value.kind, stopped.value.phase) == ("operator", "announced")
    assert rig.moved(began) == 0.0


@pytest.mark.realtime
def test_no_program_runs_while_hands_are_in(rig: Rig) -> None:
    rig.to_start()
    rig.arm.hands_in()
    assert rig.fault("state")["runtime_state"] == "STOPPED"
    with pytest.raises(ArmNotReleasedError):
        rig.arm.execute(rig.path)


@pytest.mark.slow
@pytest.mark.realtime
def test_hands_in_ends_somebody_else_s_program(rig: Rig) -> None:
    _upload(rig, "while True:\n sync()\n end")
    rig.arm.hands_in()
    assert rig.fault("state")["runtime_state"] == "STOPPED"


@pytest.mark.slow
@pytest.mark.realtime
def test_hands_are_not_invited_by_a_controller_that_says_nothing(rig: Rig) -> None:
    rig.fault("stall")
    with pytest.raises(ArmLostError):
        rig.arm.hands_in()


def _upload(rig: Rig, statements: str) -> None:
    import socket

    with socket.create_connection((rig.controller.address, 30003), timeout=5) as connection:
        connection.sendall(f"def other():\n {statements}\nend\n".encode())
        rig.await_that(lambda: "program other started" in str(rig.fault("state")["messages"]), "start of the program")


@pytest.mark.realtime
def test_a_motion_begins_after_the_worker_was_late_and_the_clock_stood(
    make_rig: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The worker waited for a newer package then, and the clock for the worker: 300 s, on a busy host only."""
    rig = make_rig(clock=str(tmp_path / "clock"))
    orders: list[Any] = []
    ask = rig.arm._session.ask

    def kept(method: str, *arguments: Any, **options: Any) -> Any:
        if method == "run":
            orders.append(arguments[0])
            raise ArmRefusedError("kept for the test")
        return ask(method, *arguments, **options)

    monkeypatch.setattr(rig.arm._session, "ask", kept)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="kept"):
        rig.arm.move_to_start(rig.path)
    rig.arm.close()  # frees the inputs that its worker wrote

    clock = SharedClock(tmp_path / "clock")
    spec = rig.arm._spec
    client = RtdeClient(rig.controller.address, spec.rate, 10.0, spec.registers, clock)
    monitor = MotionMonitor(client, rig.controller.address, orders[0], lambda _: None, lambda: clock.now)
    ready = monitor._until_ready

    def late(primary: Any) -> str:
        refusal = ready(primary)
        before = clock.now - 1.0
        while clock.now != before:
            before = clock.now
            time.sleep(0.2)  # longer than a clock that goes on stands still
        return refusal

    monkeypatch.setattr(monitor, "_until_ready", late)
    outcome = Call(monitor.run).result()
    assert outcome.kind == "completed", outcome.text
