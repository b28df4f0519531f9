"""The example's arm with seven joints, of which there is a URDF and a robot alone, does what every arm has to do."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("pinocchio")

from decant.plugins import JointArm, RobotCell
from decant.plugins.testing import ArmBench, ArmContract
from tests.plugins.decant_example.seven_joints import SevenJointKind, SevenJointRobot, SevenJointSettings
from tests.plugins.test_stand import ACTION, SCENE
from tests.support.other_arm import SEVEN_JOINTS

SCALE = 2.0
CELL = RobotCell(receiver={"x": "700 mm", "y": "0 mm", "z": "150 mm"}, direction="90 deg")  # type: ignore[arg-type]
SETTINGS = SevenJointSettings.model_validate({**SEVEN_JOINTS, "cell": CELL}).in_laboratory(CELL, SCALE)
KIND = SevenJointKind(SETTINGS)


@pytest.fixture(scope="module")
def path():
    return KIND.plan(SCENE, ACTION)


class TestSevenJoints(ArmContract):
    pytestmark = pytest.mark.realtime

    @pytest.fixture
    def bench(self, path) -> Iterator[ArmBench]:
        arm = JointArm(SETTINGS, SevenJointRobot)
        robot = arm.robot.cable  # type: ignore[attr-defined]

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            robot.measure()
            seen = [reading for reading in robot.readings if reading[0] > since]
            moments = np.array([moment for moment, _ in seen])
            joints = np.array([joints for _, joints in seen]).reshape(-1, 7)
            return moments, KIND.figure().pourer(joints) if seen else np.zeros((0, 7))

        bench = ArmBench(
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
            cut=lambda: setattr(robot, "plugged", False),
            restore=lambda: setattr(robot, "plugged", True),
            lost_within=5.0,
            stops_within=1.0,
        )
        yield bench
        bench.arm.close()
