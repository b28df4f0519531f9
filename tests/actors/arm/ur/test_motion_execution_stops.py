"""`motion_execution`: stops, from wherever they come: the arm holds, says where it stands, and waits for an
operator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from actors.arm.arm_interface import ArmNotReleasedError, ArmRefusedError, ArmStoppedError
from actors.arm.ur.ur_driver import AcceptedArm
from actors.arm.ur.urscript_writer import SETTLING
from actors.arm.ur.worker_messages import may_move, safety_mode
from tests.actors.arm.ur.conftest import Call, Rig
from tests.support.ur_pours import HOME, START, pour_path
from tests.support.waiting import wait_for

Make = Callable[..., Rig]
DEG = math.radians(1.0)
LONG_HOLD = pour_path(hold=8.0)
"""Long enough to be met in its hold, ten times as fast as time."""


def stopped(call: Call) -> ArmStoppedError:
    with pytest.raises(ArmStoppedError) as caught:
        call.result()
    return caught.value


def holds_until_released(rig: Rig) -> None:
    """Nothing moves without a word of the operator's."""
    rig.await_rest()
    began = rig.now
    assert rig.arm.state().stopped
    for motion in (rig.arm.execute, rig.arm.retreat, rig.arm.move_to_start, rig.arm.untilt):
        with pytest.raises(ArmNotReleasedError):
            motion(rig.path)
    rig.await_that(lambda: rig.now > began + 2.0, "time")
    assert rig.moved(began) < 1e-6
    assert rig.fault("state")["runtime_state"] == "STOPPED"


def comes_home(rig: Rig) -> None:
    """Upright by the way it came, slowly; then home."""
    began, tilt = rig.now, rig.joints[5] - START[5]
    rig.arm.release()
    rig.arm.untilt()
    times, joints = rig.history(began)
    assert joints[:, 5].max() - START[5] < tilt + 0.02  # never more tilted than it was
    speeds = np.abs(np.diff(joints[:, 5])) / np.diff(times)
    assert speeds.max() < 1.3 * rig.arm._spec.upright_speed
    assert rig.joints == pytest.approx(START, abs=1e-3)
    assert rig.arm.state().tilt == pytest.approx(0.0, abs=0.01)
    with pytest.raises(ArmNotReleasedError):
        rig.arm.retreat(rig.path)
    rig.arm.release()
    rig.arm.retreat(rig.path)
    assert rig.joints == pytest.approx(HOME, abs=1e-3)


# ---- on request


@pytest.mark.slow
@pytest.mark.realtime
def test_a_stop_while_tilting_takes_effect_at_once_and_can_be_untilted(make_rig: Make) -> None:
    rig = make_rig(time_scale=1.0, frequency=500.0)
    pouring = rig.pouring()
    rig.await_tilt(25.0 * DEG)
    began = rig.now
    took = rig.arm.stop()
    error = stopped(pouring)
    assert (error.kind, error.phase) == ("operator", "tilt")
    times, joints = rig.history(began)
    at_rest = times[np.abs(joints - joints[-1]).max(axis=1) > 1e-4][-1] - began
    assert 0.05 < at_rest < 0.8  # 50 deg/s is braked in 0.15 s; the rest is on its way, or a busy machine
    assert took == pytest.approx(at_rest, abs=0.3)
    assert math.degrees(error.tilt) == pytest.approx((joints[-1][5] - START[5]) / DEG, abs=1.0)
    assert error.executed is not None
    assert not error.executed.completed
    assert error.executed.joints[-1] == pytest.approx(joints[-1], abs=2e-3)
    holds_until_released(rig)
    rig.arm.release()
    rig.arm.stop()  # not before the slow part: un-tilting 25 deg takes three seconds


@pytest.mark.slow  # what follows protective stops is the same, and is tried in every phase below
@pytest.mark.parametrize("phase", ["tilt", "hold", "return"])
def test_after_a_stop_in_any_phase_the_pourer_is_brought_upright_slowly(make_rig: Make, phase: str) -> None:
    rig = make_rig(LONG_HOLD)
    pouring = rig.pouring()
    rig.await_phase(phase)
    rig.await_that(lambda: phase == "hold" or 0.2 < rig.arm.state().tilt < 1.1, "a tilt in between")
    rig.arm.stop()
    error = stopped(pouring)
    assert error.phase == phase
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.slow
@pytest.mark.realtime
def test_an_arm_stopped_on_its_way_to_the_pour_goes_back_the_way_it_came(rig: Rig) -> None:
    rig.fault("protective_stop", joint=0, above=6.0 * DEG)
    rig.arm.release()
    error = stopped(Call(rig.arm.move_to_start, rig.path))
    assert (error.kind, error.phase, error.tilt) == ("protective stop", "approach", 0.0)
    holds_until_released(rig)
    rig.arm.release()
    rig.arm.recover()
    rig.arm.release()
    rig.arm.retreat(rig.path)
    assert rig.joints == pytest.approx(HOME, abs=1e-3)


# ---- by the safety system


@pytest.mark.realtime
@pytest.mark.parametrize("phase", ["tilt", *(pytest.param(p, marks=pytest.mark.slow) for p in ("hold", "return"))])
def test_a_protective_stop_holds_the_tilted_pourer_until_an_operator_has_looked(
    make_rig: Make, tmp_path: Path, phase: str
) -> None:
    rig = make_rig(LONG_HOLD, clock=str(tmp_path / "clock"))
    if phase == "tilt":
        rig.fault("protective_stop", joint=5, above=START[5] + 0.6)
    pouring = rig.pouring()
    if phase != "tilt":
        rig.await_phase("hold")
        rig.fault("protective_stop", **({} if phase == "hold" else {"joint": 5, "below": START[5] + 0.6}))
    error = stopped(pouring)
    assert (error.kind, error.phase) == ("protective stop", phase)
    assert f"during {phase}" in str(error)
    rig.await_rest()
    tilt = rig.joints[5] - START[5]
    assert tilt > 0.4
    assert error.tilt == pytest.approx(tilt, abs=0.02)
    holds_until_released(rig)
    rig.arm.release()
    began = rig.now
    assert "unlocked" in rig.arm.recover()
    assert rig.moved(began) < 1e-6  # recovering moves nothing
    assert rig.fault("state")["safety_mode"] == "NORMAL"
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.slow
@pytest.mark.realtime
def test_an_emergency_stop_is_recovered_from_once_its_button_is_released(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("emergency_stop", joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert (error.kind, error.phase) == ("emergency stop", "tilt")
    holds_until_released(rig)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="button"):
        rig.arm.recover()
    rig.fault("release_emergency_stop")
    rig.arm.release()
    assert "brakes" in rig.arm.recover()
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_safeguard_stop_does_not_go_on_by_itself_when_it_is_released(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("safeguard", joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert (error.kind, error.phase) == ("safeguard", "tilt")
    rig.await_rest()
    rig.fault("safeguard", active=False)
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.realtime
def test_a_protective_stop_from_before_keeps_the_arm_still(rig: Rig) -> None:
    rig.fault("protective_stop")
    rig.arm.release()
    began = rig.now
    with pytest.raises(ArmRefusedError, match="protective stop is in force"):
        rig.arm.move_to_start(rig.path)
    assert rig.moved(began) == 0.0


# ---- by people at the panel


@pytest.mark.slow
@pytest.mark.realtime
def test_switching_to_local_control_stops_the_pour(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("remote", active=False, joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert (error.kind, error.phase) == ("program ended", "tilt")
    rig.await_rest()
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="switch it to remote control"):
        rig.arm.untilt()
    rig.fault("remote", active=True)
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.realtime
def test_a_slower_slider_is_refused_before_anything_moves(resting: Rig) -> None:
    resting.fault("slider", fraction=0.5)
    resting.arm.release()
    with pytest.raises(ArmRefusedError, match="slider is at 50 %"):
        resting.arm.move_to_start(resting.path)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_slider_moved_during_a_pour_is_told_with_what_was_executed(make_rig: Make) -> None:
    rig = make_rig()
    rig.fault("slider", fraction=0.5, joint=5, above=START[5] + 0.6)
    executed = rig.pouring().result()
    assert executed.completed
    assert executed.tracking["slider"] == 0.5
    # the part behind the place takes twice as long, and the arm follows the path all the same
    planned = rig.path.pour.duration + SETTLING
    lowered = float(rig.path.pour.times[int(np.argmax(rig.path.pour.joints[:, 5] > START[5] + 0.6))])
    assert executed.times[-1] == pytest.approx(lowered + 2.0 * (planned - lowered), abs=0.6)
    assert executed.tracking["max_angle"] < 2.0 * DEG


@pytest.mark.realtime
def test_a_slider_at_0_in_mid_pour_ends_the_program_so_that_nothing_moves_when_it_is_raised(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("slider", fraction=0.0, joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert (error.kind, error.phase) == ("program ended", "tilt")
    assert "at 0 % of their speed (slider 0 %, its own slowing 100 %)" in error.text
    assert "raise it before" in error.text
    assert 0.5 < error.tilt < 1.0
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="slider is at 0 %; nothing would move"):
        rig.arm.untilt(rig.path)
    began = rig.now
    rig.fault("slider", fraction=1.0)
    rig.await_rest()
    assert rig.moved(began) == 0.0
    holds_until_released(rig)
    comes_home(rig)


@pytest.mark.realtime
def test_an_arm_that_stands_elsewhere_is_asked_to_go_home_first(resting: Rig) -> None:
    resting.arm.release()
    with pytest.raises(ArmRefusedError, match="away from where it should be"):
        resting.arm.execute(resting.path)


@pytest.mark.realtime
def test_an_arm_that_was_moved_off_its_way_is_not_moved_blindly(rig: Rig) -> None:
    rig.arm.release()
    rig.arm.jog("joint 2", -9.0 * DEG, 10.0 * DEG)
    rig.arm.release()
    began = rig.now
    with pytest.raises(ArmRefusedError, match="does not stand on the pour's path"):
        rig.arm.untilt(rig.path)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="does not stand on the way home"):
        rig.arm.retreat(rig.path)
    assert rig.moved(began) == 0.0


@pytest.mark.realtime
def test_a_controller_that_slows_programs_by_itself_pours_nothing(resting: Rig) -> None:
    resting.fault("slowing", fraction=0.5)
    resting.arm.release()
    try:
        with pytest.raises(ArmRefusedError, match=r"at 50 % of their speed \(slider 100 %, its own slowing 50 %\)"):
            resting.arm.move_to_start(resting.path)
    finally:
        resting.fault("slowing", fraction=1.0)


@pytest.mark.realtime
def test_reduced_mode_pours_nothing_and_lets_a_stopped_arm_go_home_slowly(rig: Rig) -> None:
    rig.to_start()
    rig.fault("reduced", active=True)
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="reduced mode is in force"):
        rig.arm.execute(rig.path)
    rig.arm.release()
    began = rig.now
    rig.arm.retreat(rig.path)
    rig.await_rest()
    times, joints = rig.history(began)
    assert joints[-1] == pytest.approx(HOME, abs=1e-3)
    fastest = np.abs(np.diff(joints, axis=0) / np.diff(times)[:, None]).max()
    planned = np.abs(np.diff(rig.path.retreat.joints, axis=0) / np.diff(rig.path.retreat.times)[:, None]).max()
    assert fastest < 0.3 * planned


@pytest.mark.parametrize("number", range(1, 23))
def test_every_safety_mode_has_a_name_a_class_and_advice(number: int) -> None:
    mode = safety_mode(number)
    assert mode.text
    assert (mode.kind == "") == may_move(number, pours=False)
    assert (mode.advice == "") == (number == 1)
    assert may_move(number, pours=True) == (number == 1)


# ---- causes, hands, forces


@pytest.mark.slow
@pytest.mark.realtime
def test_a_protective_stop_names_its_code_and_is_unlocked_after_five_seconds(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("protective_stop", code=153, joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert "C153A0 (a joint deviates from its commanded position)" in str(error)
    begun = rig.now
    rig.fault("protective_stop")  # the five seconds begin again
    rig.arm.release()
    assert "unlocked" in rig.arm.recover()
    assert rig.now - begun > 5.0


@pytest.mark.slow
@pytest.mark.realtime
def test_nothing_moves_while_the_freedrive_button_is_pressed(make_rig: Make) -> None:
    rig = make_rig(LONG_HOLD)
    rig.fault("freedrive")
    wait_for(lambda: "freedrive button is pressed" in rig.arm.facts().problem, "the button in the arm's facts")
    rig.arm.release()
    with pytest.raises(ArmRefusedError, match="freedrive button is pressed"):
        rig.arm.move_to_start(rig.path)
    rig.fault("freedrive", active=False)
    rig.fault("freedrive", joint=5, above=START[5] + 0.6)
    error = stopped(rig.pouring())
    assert (error.kind, error.phase) == ("safety", "tilt")
    assert "freedrive button was pressed" in str(error)
    holds_until_released(rig)


@pytest.mark.slow
@pytest.mark.realtime
def test_forces_at_the_tool_and_in_the_wrist_are_recorded(rig: Rig) -> None:
    rig.fault("force", wrench=[0.0, 0.0, -3.0, 0.0, 0.0, 0.0], joint=5, above=START[5] + 0.6)
    rig.to_start()
    rig.arm.release()
    forces = rig.arm.execute(rig.path).record()["forces"]
    external = np.array(forces["external_force"])[:, 2]
    assert (external[0], external[-1]) == (0.0, -3.0)
    wrist = np.array(forces["wrist_force"])[:, 2]
    assert wrist[-1] - wrist[0] == pytest.approx(-3.0, abs=0.02)
    assert np.all(np.diff(forces["times"]) > 0.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_payload_on_the_controller_that_differs_from_the_file_is_refused(make_rig: Make) -> None:
    rig = make_rig(connect=False)
    spec = rig.arm._spec
    arm = AcceptedArm(spec, rig.fault("state")["checksum"])
    try:
        with pytest.raises(ArmRefusedError, match=r"payload 0.00 kg on the controller, .* in the file"):
            arm.connect()
    finally:
        arm.close()
