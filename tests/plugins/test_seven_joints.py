"""The example's arm with seven joints does what every arm has to do."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from decant.plugins import InvalidActionError, RobotCell, plan_pour
from decant.plugins.testing import ArmBench, ArmContract
from tests.plugins.decant_example.seven_joints import (
    HOME,
    SevenJointArm,
    SevenJointKind,
    SevenJointPour,
    SevenJointSettings,
    SimulatedRobot,
)
from tests.plugins.test_stand import ACTION, SCENE

SCALE = 2.0
CELL = RobotCell(receiver={"x": "700 mm", "y": "0 mm", "z": "150 mm"}, direction="90 deg")  # type: ignore[arg-type]
SETTINGS = SevenJointSettings().in_laboratory(CELL, SCALE)


@pytest.fixture(scope="module")
def path() -> SevenJointPour:
    return SevenJointKind(SETTINGS).plan(SCENE, ACTION)


@pytest.mark.slow
class TestSevenJoints(ArmContract):
    @pytest.fixture
    def bench(self, path: SevenJointPour) -> Iterator[ArmBench]:
        robot = SimulatedRobot(SCALE)

        def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            robot.measure()
            seen = [reading for reading in robot.readings if reading[0] > since]
            joints = np.array([joints for _, joints in seen]).reshape(-1, 7)
            return np.array([moment for moment, _ in seen]), SETTINGS.poses(joints)

        def cable(plugged: bool) -> None:
            robot.plugged = plugged

        def protective_stop(active: bool) -> None:
            robot.tripped = active

        bench = ArmBench(
            SevenJointArm(SETTINGS, robot),
            path,
            SCALE,
            jog=("joint 6", math.radians(2.0), math.radians(20.0)),
            trip=lambda: protective_stop(True),
            mend=lambda: protective_stop(False),
            true_poses=true_poses,
            tool_speed=2.0,
            tilt_speed=math.radians(180.0),
            disturb=lambda: setattr(robot, "slip", 0.2),
            cut=lambda: cable(False),
            restore=lambda: cable(True),
            lost_within=5.0,
            stops_within=1.0,
        )
        yield bench
        bench.arm.close()


pytestmark = pytest.mark.realtime


def test_its_plan_is_the_pour_that_was_asked_for(path: SevenJointPour) -> None:
    wanted = plan_pour(SCENE, ACTION).sample(path.pour.times)
    found = SETTINGS.poses(path.pour.joints)
    assert np.abs(found[:, :3] - wanted[:, :3]).max() < 1e-6
    assert np.abs(np.sum(found[:, 3:] * wanted[:, 3:], axis=1)).min() == pytest.approx(1.0, abs=1e-9)
    assert np.abs(path.approach.joints[0] - HOME).max() < 1e-6
    assert np.abs(path.approach.joints[-1] - path.pour.joints[0]).max() < 1e-6


def test_a_pour_beyond_its_reach_is_refused_with_the_cure() -> None:
    far = RobotCell(receiver={"x": "1300 mm", "y": "0 mm", "z": "150 mm"}, direction="90 deg")  # type: ignore[arg-type]
    with pytest.raises(InvalidActionError, match=r"does not reach x = .*; move the receiver nearer"):
        SevenJointKind(SETTINGS.in_laboratory(far, SCALE)).plan(SCENE, ACTION)


def test_its_figure_draws_the_links_where_the_joints_put_them(path: SevenJointPour) -> None:
    figure = SevenJointKind(SETTINGS).figure()
    ends = figure.ends(path.pour.joints[:3])
    assert ends.shape == (3, len(figure.bars), 2, 3)
    lengths = np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1)
    assert lengths == pytest.approx(np.tile([0.34, 0.40, 0.40, 0.126], (3, 1)))
