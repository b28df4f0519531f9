"""`joint_driver`: an arm that takes joint speeds does what every arm has to do, and pours wanted amounts."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmRefusedError, ArmStoppedError
from actors.arm.joint_driver import VelocityArm
from actors.contract_tests.arm_contract import ArmBench, ArmContract
from actors.contract_tests.contract_calls import Call
from sim_engine.action import DEG
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from tests.support.other_arm import OtherArmKind, OtherRobot, SpeedRobot, other_arm
from tests.support.planning_cell import ACTION, vessel
from tests.support.waiting import wait_for

pytestmark = pytest.mark.realtime

SCALE = 2.0
SETTINGS = other_arm(time_scale=SCALE, warning_time=0.2, approach_speed=90 * DEG)
KIND = OtherArmKind(SETTINGS)
SCENE = Scene("s", vessel("beaker").spec, vessel("tumbler").spec, Liquid(name="water", mass=0.2))


@pytest.fixture(scope="module")
def path():
    return KIND.plan(SCENE, ACTION)


class TestVelocityArm(ArmContract):
    @pytest.fixture
    def bench(self, path) -> Iterator[ArmBench]:
        arm = VelocityArm(SETTINGS, OtherRobot)
        robot: SpeedRobot = arm.robot.cable  # type: ignore[attr-defined]

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            robot.measure()
            seen = [reading for reading in robot.readings if reading[0] > since]
            joints = np.array([joints for _, joints in seen]).reshape(-1, 6)
            poses = KIND.figure().pourer(joints) if seen else np.zeros((0, 7))
            return np.array([moment for moment, _ in seen]), poses

        yield ArmBench(
            arm,
            path,
            SCALE,
            jog=("joint 6", math.radians(2.0), math.radians(20.0)),
            trip=lambda: setattr(robot, "tripped", True),
            mend=lambda: setattr(robot, "tripped", False),
            true_poses=true_poses,
            tool_speed=2.0,
            tilt_speed=math.radians(180.0),
            cut=lambda: setattr(robot, "plugged", False),
            restore=lambda: setattr(robot, "plugged", True),
            lost_within=5.0,
            stops_within=1.0,
        )
        arm.close()


@pytest.fixture
def arm() -> Iterator[VelocityArm]:
    arm = VelocityArm(SETTINGS, OtherRobot)
    arm.connect()
    yield arm
    arm.close()


@pytest.mark.parametrize("speed", [20.0, 60.0, 120.0])
def test_the_executed_tilt_is_the_planned_one(speed: float, arm: VelocityArm) -> None:
    path = KIND.plan(SCENE, replace(ACTION, angular_velocity=speed * DEG, return_velocity=speed * DEG))
    arm.release()
    arm.move_to_start(path)
    executed = arm.execute(path)
    lags = np.linspace(-0.02, 0.02, 41)
    errors = [np.abs(path.pour.at(executed.times - lag) - executed.joints).max() for lag in lags]
    assert min(errors) < (0.3 + 2e-3 * speed) * DEG  # a command holds for 10 ms, so that ramps are up to 2 ms off


def test_a_state_is_of_one_reading(arm: VelocityArm, path) -> None:
    """A new tilt at the time of the reading before would be a jump to everyone who compares states."""
    arm.release()
    arm.move_to_start(path)
    tilts: dict[float, set[float]] = {}
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        pouring = Call(arm.execute, path)
        while pouring.is_alive():
            state = arm.state()
            tilts.setdefault(state.time, set()).add(state.tilt)
    finally:
        sys.setswitchinterval(usual)
    assert pouring.ended() is None
    assert {time for time, seen in tilts.items() if len(seen) > 1} <= {0.0}  # before its first reading


def test_a_robot_that_drifts_creeps_on_in_a_dose(arm: VelocityArm, path) -> None:
    """Each command of a dose goes a little farther than the measured tilt."""
    tilts, joints = path.tilt_part
    arm.release()
    arm.move_to_start(path)
    arm.robot.cable.drift = -0.8 * DEG * (joints[1] - joints[0]) / (tilts[1] - tilts[0])  # type: ignore[attr-defined]
    dosing = Call(arm.dose, path, 100.0)
    wait_for(lambda: arm.state().moving, "it does not begin")
    wait_for(lambda: arm.drive(1.0 * DEG, arm.state().tilt + 0.05 * DEG, 1.0).tilt > 2.0 * DEG, "it stands still")
    assert dosing.ended() is None


def test_an_arm_that_was_moved_by_other_means_is_not_moved_blindly(arm: VelocityArm, path) -> None:
    arm.robot.cable._joints[0] += 0.2  # type: ignore[attr-defined]
    arm.release()
    with pytest.raises(ArmRefusedError, match=r"a joint is 11\.5° away from where the approach begins; .*robot home"):
        arm.move_to_start(path)


def test_a_program_that_was_held_up_ends_the_motion(arm: VelocityArm, path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot has stood meanwhile; a driver that catches up would swing the cup."""
    arm.release()
    arm.move_to_start(path)
    robot, calls = arm.robot.cable, 0  # type: ignore[attr-defined]
    measure, robot.stretch = robot.measure, math.inf

    def held_up() -> object:
        nonlocal calls
        calls += 1
        if calls == 60:
            time.sleep(0.5)  # the hold-up itself
        return measure()

    monkeypatch.setattr(robot, "measure", held_up)
    with pytest.raises(ArmStoppedError, match="held up") as error:
        arm.execute(path)
    assert error.value.kind == "watchdog"
