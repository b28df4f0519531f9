"""`kinematics`: where the pourer is, seen from joints, and where joints have to be, seen from the pourer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.arm.planning.kinematics import flange_poses, pourer_motion, pourer_transforms, quaternions
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur.ur_kinematics import MODELS, inverse
from actors.arm_geometry import Pose
from sim_engine.action import DEG
from sim_engine.collision import rotations
from tests.support.hypothesis_examples import examples
from tests.support.planning_cell import SPEC, motion, placed, turned, vessel

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(("direction", "expected"), [(0.0, (0.65, 0.0)), (90.0, (0.75, -0.1)), (-90.0, (0.75, 0.1))])
def test_the_pourer_stands_against_the_direction_that_is_poured_in(direction, expected):
    spec = placed(direction=direction * DEG).with_values(tool=Pose(), grip=Pose())
    flange = flange_poses(np.array([[-0.1, 0.0, 0.2, *UPRIGHT]]), spec)
    assert tuple(flange.position[0]) == pytest.approx((*expected, 0.26))
    # liquid leaves towards the pourer's x
    assert flange.rotation[0, :2, 0] == pytest.approx([np.cos(direction * DEG), np.sin(direction * DEG)], abs=1e-12)


poses = st.tuples(st.floats(-0.2, 0.0), st.floats(-0.1, 0.1), st.floats(0.05, 0.3), st.floats(0.0, 2.3))


@given(pose=poses, roll=st.floats(-3, 3))
@settings(max_examples=examples(60), deadline=None)
def test_joints_for_a_pose_put_the_pourer_there(pose, roll):
    x, y, z, tilt = pose
    spec = SPEC.with_values(grip=Pose.of(0.01, -0.05, 0.02, -1.2 + 0.1 * roll, 0.3, 0.1))
    wanted = np.array([[x, y, z, np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0]])
    flange = flange_poses(wanted, spec)
    found = inverse(flange.rotation, flange.position, MODELS["ur10e"])[0]
    found = found[np.isfinite(found).all(axis=1)]
    assert len(found)
    seen = pourer_motion(found, np.arange(len(found), dtype=float), spec) if len(found) > 1 else None
    assert seen is not None
    assert np.abs(seen.poses[:, :3] - wanted[:, :3]).max() < 1e-6
    assert turned(rotations(seen.poses), rotations(wanted)).max() < 1e-6


def test_quaternions_do_not_jump_in_a_whole_turn():
    angles = np.linspace(0.0, 4.0 * np.pi, 200)
    c, s, o = np.cos(angles), np.sin(angles), np.zeros(200)
    turning = np.stack([np.stack([c, o, s], -1), np.stack([o, o + 1, o], -1), np.stack([-s, o, c], -1)], axis=-2)
    q = quaternions(turning)
    assert np.abs(np.diff(q, axis=0)).max() < 0.04
    np.testing.assert_allclose(rotations(np.concatenate([np.zeros((200, 3)), q], axis=1)), turning, atol=1e-9)


def test_a_pourer_that_slipped_in_the_fingers_is_tilted_more_about_the_tool_centre_point():
    path = plan_path(motion(), SPEC, vessel("beaker"), vessel("tumbler")).pour
    believed = pourer_motion(path.joints, path.times, SPEC)
    real = pourer_motion(path.joints, path.times, SPEC, grip_tilt=2 * DEG)
    np.testing.assert_allclose(real.tilt(path.times) - believed.tilt(path.times), 2 * DEG, atol=1e-6)
    # what the fingers hold is 60 mm above the underside, and stays where it is
    held = np.array([0.0, 0.0, 0.06])
    for seen, other in zip(real.poses, believed.poses, strict=True):
        np.testing.assert_allclose(
            rotations(seen[None])[0] @ held + seen[:3], rotations(other[None])[0] @ held + other[:3], atol=1e-9
        )


def test_at_home_the_pourer_stands_behind_the_receiver_and_upright():
    frame = pourer_transforms(np.array([SPEC.home.angles]), SPEC)
    assert frame.rotation[0, 2, 2] == pytest.approx(1.0, abs=1e-9)
    assert frame.position[0, 1] < -0.2
