"""`pour_planner`: an arm on a wall, under a ceiling, or turned on its table: the same pour in the room, other
joints.
"""

from __future__ import annotations

import numpy as np
import pytest

from actors.arm.planning.kinematics import cell_transforms, flange_poses, pourer_motion, pourer_transforms
from actors.arm.planning.path_checks import check_limits
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.ur_kinematics import MODELS, inverse, singularities
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Box, JointAngles, Mount, Point, RobotCell
from actors.interfaces import InvalidActionError
from sim_engine.action import DEG
from tests.support.planning_cell import SPEC, motion, vessel

MOUNTS = {"wall": Mount(tilt=90 * DEG), "ceiling": Mount(tilt=180 * DEG, turn=30 * DEG), "tilt": Mount(tilt=-35 * DEG)}
RECEIVERS = {"wall": (0.2, 0.75, 0.3), "ceiling": (0.2, 0.75, -0.8), "tilt": (0.75, 0.1, 0.1)}


def mounted(name: str) -> UrArmSettings:
    """A cell for that mount, with a home that has the pourer upright beside the receiver."""
    limits = SPEC.limits.with_values(box=Box(low=Point.of(-1.5, -1.5, -1.5), high=Point.of(1.5, 1.5, 1.5)))
    for direction in np.arange(0.0, 360.0, 15.0) * DEG:
        cell = RobotCell(receiver=Point.of(*RECEIVERS[name]), direction=float(direction), table=-1.5)
        spec = SPEC.with_values(limits=limits, cell=cell, mount=MOUNTS[name])
        flange = flange_poses(np.array([[-0.2, 0.0, 0.25, 1.0, 0.0, 0.0, 0.0]]), spec)
        found = inverse(flange.rotation, flange.position, MODELS[spec.model])[0]
        for q in found[np.isfinite(found).all(axis=1)]:
            if singularities(q[None], MODELS[spec.model]).min() < 0.3:
                continue
            spec = spec.with_values(home=JointAngles.of(*map(float, q)))
            try:
                plan_path(motion(), spec, vessel("beaker"), vessel("tumbler"))
            except InvalidActionError:  # out of reach, too fast: another direction or posture
                continue
            return spec
    raise AssertionError("no such cell")


@pytest.mark.parametrize("name", MOUNTS)
def test_wherever_the_robot_hangs_the_pourer_does_in_the_room_what_was_asked_for(name):
    spec = mounted(name)
    assert check_limits(spec) == []
    path = plan_path(motion(), spec, vessel("beaker"), vessel("tumbler"))
    done = pourer_motion(path.pour.joints, path.pour.times, spec)
    np.testing.assert_allclose(done.tilt(path.pour.times), path.tilts, atol=0.2 * DEG)
    upright = pourer_transforms(np.array([spec.home.angles]), spec).rotation[0, :, 2]
    np.testing.assert_allclose(upright, [0.0, 0.0, 1.0], atol=1e-6)
    forgotten = check_limits(spec.with_values(mount=Mount()))
    assert any("the pourer leans" in problem for problem in forgotten)


def test_a_robot_that_is_turned_on_its_table_turns_its_base_back():
    turned = SPEC.with_values(
        mount=Mount(turn=30 * DEG), home=JointAngles.of(SPEC.home.angles[0] - 30 * DEG, *SPEC.home.angles[1:])
    )
    straight, back = (plan_path(motion(), spec, vessel("beaker"), vessel("tumbler")) for spec in (SPEC, turned))
    np.testing.assert_allclose(back.pour.joints[:, 0], straight.pour.joints[:, 0] - 30 * DEG, atol=1e-9)
    np.testing.assert_allclose(back.pour.joints[:, 1:], straight.pour.joints[:, 1:], atol=1e-9)


def test_up_in_the_base_s_frame_is_what_controllers_call_gravity():
    assert Mount().up == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(Mount(tilt=180 * DEG).up, (0.0, 0.0, -1.0), atol=1e-12)
    for mount in MOUNTS.values():
        base = SPEC.with_values(mount=mount)
        np.testing.assert_allclose(cell_transforms(base).base.rotation.T @ [0.0, 0.0, 1.0], mount.up, atol=1e-12)
