"""`path_of`: one check of an action, with the lengths of the drawing and with those of the robot."""

from __future__ import annotations

import math

import pytest

import decant
from actors.arm.pour_feasibility import path_of
from actors.arm.ur.robot_models import MODELS
from actors.arm_geometry import Pose
from actors.emulators.ur_controller.robot import calibrated
from actors.interfaces import InvalidActionError


def test_a_pour_at_the_limit_is_made_by_the_robot_as_by_its_drawing() -> None:
    plan = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml"))
    (scene,), drawing = plan.deployment.scenes, plan.laboratory.arm  # type: ignore[union-attr]
    robot = drawing.with_values(calibration=calibrated(MODELS[drawing.model]).calibration)  # type: ignore[union-attr]
    limit = drawing.limits.joint_speed  # type: ignore[union-attr]
    action = scene.action({"angular_velocity": limit, "x_offset": 0.09982})
    planned, executed = path_of(scene, action, drawing), path_of(scene, action, robot)
    assert planned is not None
    assert executed is not None
    assert planned.report.joint_speed == pytest.approx(limit)
    assert executed.report.joint_speed > 1.0005 * limit
    # the last joint tilts the pourer, unless it is held obliquely
    assert drawing.tilt_speed_limit == robot.tilt_speed_limit == limit < drawing.limits.tilt_speed  # type: ignore[union-attr]
    oblique = drawing.with_values(grip=Pose(y=-0.06, rx=math.radians(-60)))  # type: ignore[union-attr]
    assert oblique.tilt_speed_limit == drawing.limits.tilt_speed  # type: ignore[union-attr]
    for arm, factor in ((drawing, 1.001), (robot, 1.01)):
        with pytest.raises(InvalidActionError, match=r"joint 6 \(wrist 3\) would turn at"):
            path_of(scene, action.with_values(angular_velocity=factor * limit), arm)


def test_an_action_of_the_wrong_kind_is_refused_without_an_arm_too() -> None:
    plan = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml"))
    (scene,) = plan.deployment.scenes  # type: ignore[union-attr]
    with pytest.raises(InvalidActionError):
        path_of(
            scene, scene.action({"angular_velocity": math.radians(60), "x_offset": 0.02}).with_values(height=2e-3), None
        )
