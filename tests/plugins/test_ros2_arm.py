"""The example's arm with a ROS 2 driver, against a rosbridge server of the protocol's document: no ROS was tried."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pinocchio")
pytest.importorskip("roslibpy")
pytest.importorskip("websockets")

from actors.contract_tests.contract_calls import Call
from decant.plugins import ArmLostError, ArmRefusedError, ArmStoppedError, JointArm, RobotCell
from decant.plugins.testing import ArmBench, ArmContract
from tests.plugins.decant_example.ros2_arm import JOINTS, Ros2Kind, Ros2Robot, Ros2Settings
from tests.plugins.decant_example.simulated_robot import SimulatedRobot
from tests.plugins.test_stand import ACTION, SCENE
from tests.support.other_arm import SEVEN_JOINTS
from tests.support.rosbridge import Rosbridge
from tests.support.waiting import PATIENCE, wait_for

SCALE = 1.0
CELL = RobotCell(receiver={"x": "700 mm", "y": "0 mm", "z": "150 mm"}, direction="90 deg")  # type: ignore[arg-type]
SETTINGS = Ros2Settings.model_validate({**SEVEN_JOINTS, "cell": CELL}).in_laboratory(CELL, SCALE)
KIND = Ros2Kind(SETTINGS)


@pytest.fixture(scope="module")
def path():
    return KIND.plan(SCENE, ACTION)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside busy processes the joints of this arm, which has the wall clock, come late."""
    monkeypatch.setattr("actors.arm.joint_driver.SILENCE", PATIENCE)
    monkeypatch.setattr("tests.plugins.decant_example.ros2_arm.SILENCE", PATIENCE)


@pytest.fixture
def bridge() -> Iterator[Rosbridge]:
    bridge = Rosbridge(SimulatedRobot(SETTINGS.home, SCALE))
    yield bridge
    bridge.close()


@pytest.fixture
def arm(bridge: Rosbridge) -> Iterator[JointArm]:
    arm = JointArm(SETTINGS.with_values(port=bridge.port), Ros2Robot)
    yield arm
    arm.close()


@pytest.mark.slow
@pytest.mark.realtime
class TestRos2Arm(ArmContract):
    """Without `cut`: a controller goes on with a trajectory whose client has gone."""

    @pytest.fixture
    def bench(self, path, bridge: Rosbridge, arm: JointArm) -> ArmBench:
        robot = bridge.robot

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            robot.measure()
            seen = [reading for reading in list(robot.readings) if reading[0] > since]
            joints = np.array([joints for _, joints in seen]).reshape(-1, 7)
            poses = KIND.figure().pourer(joints) if seen else np.zeros((0, 7))
            return np.array([moment for moment, _ in seen]), poses

        return ArmBench(
            arm,
            path,
            SCALE,
            jog=("joint 6", math.radians(2.0), math.radians(20.0)),
            trip=lambda: setattr(robot, "tripped", True),
            mend=lambda: setattr(robot, "tripped", False),
            true_poses=true_poses,
            tool_speed=2.0,
            tilt_speed=math.radians(180.0),
            disturb=lambda: setattr(robot, "slip", 0.2),
            stops_within=1.0,
        )


def test_joints_are_those_of_the_message_by_name(bridge: Rosbridge, arm: JointArm) -> None:
    """Drivers publish joints in orders of their own, and other nodes publish theirs on the same topic."""
    assert arm.connect().problem == ""
    assert arm.where().joints == pytest.approx(SETTINGS.home)


def test_a_goal_is_a_trajectory_of_named_joints_with_increasing_times(path, bridge: Rosbridge, arm: JointArm) -> None:
    arm.connect()
    arm.robot.begin(path.pour)  # type: ignore[union-attr]
    wait_for(lambda: bool(bridge.goals), "no goal has arrived")
    trajectory = bridge.goals[0]["trajectory"]
    assert trajectory["joint_names"] == JOINTS
    assert trajectory["points"][-1]["positions"] == pytest.approx(path.pour.joints[-1])
    last = trajectory["points"][-1]["time_from_start"]
    assert last["sec"] + 1e-9 * last["nanosec"] == pytest.approx(path.pour.duration)


def test_a_rosbridge_that_would_read_a_stop_after_the_motion_only_is_refused() -> None:
    """Its default; see issue 909 of rosbridge_suite."""
    bridge = Rosbridge(SimulatedRobot(SETTINGS.home, SCALE), threads=False)
    arm = JointArm(SETTINGS.with_values(port=bridge.port), Ros2Robot)
    with pytest.raises(ArmRefusedError, match=r"start rosbridge with send_action_goals_in_new_thread:=true"):
        arm.connect()
    arm.close()
    bridge.close()


@pytest.mark.parametrize(
    ("status", "text"),
    [
        ({"status": 0}, "its controller has given the motion up: no action server"),
        ({}, "the arm ended .* away from the end of its path"),
    ],
)
def test_a_goal_that_rosbridge_cannot_send_ends_with_an_error(
    status: dict[str, int], text: str, path, bridge: Rosbridge, arm: JointArm
) -> None:
    """Newer servers report a status, older ones none, which roslibpy drops: see issue 141 of roslibpy."""
    arm.connect()
    arm.release()
    bridge.failure = {"values": "no action server", "result": False, **status}
    with pytest.raises(ArmStoppedError, match=text):
        arm.move_to_start(path)


def test_without_rosbridge_there_is_an_error(bridge: Rosbridge, arm: JointArm) -> None:
    bridge.close()
    with pytest.raises(ArmLostError, match=rf"no rosbridge at 127\.0\.0\.1:{bridge.port}"):
        arm.connect()


def test_a_lost_connection_is_an_error_that_says_that_the_robot_goes_on(path, bridge: Rosbridge, arm: JointArm) -> None:
    """See issue 1291 of rosbridge_suite; the trajectory ends with an upright cup."""
    arm.connect()
    arm.release()
    arm.move_to_start(path)
    pouring = Call(arm.execute, path)
    wait_for(lambda: arm.state().tilt > 0.3, "it does not pour")
    bridge.close()
    assert isinstance(pouring.ended(), ArmLostError)
    arm.release()
    with pytest.raises(ArmLostError, match="The robot may go on to the end of its motion; look at it"):
        arm.untilt(path)
    wait_for(lambda: np.abs(bridge.robot.measure()[1] - path.pour.joints[-1]).max() < 1e-3, "the robot does not go on")
    bridge.start()
    arm.connect()
    arm.release()
    arm.retreat(path)
    assert arm.where().joints == pytest.approx(SETTINGS.home, abs=0.01)
