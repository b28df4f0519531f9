"""`kinematics`: kinematics of whole paths agree with the virtual controller's, which works out one pose at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from actors.arm.ur.ur_kinematics import MODELS, beyond_reach, forward, inverse, link_points, posture, singularities
from actors.emulators.ur_controller.robot import MODELS as CONTROLLED
from actors.emulators.ur_controller.robot import calibrated
from actors.emulators.ur_controller.robot_kinematics import Kinematics
from tests.support.hypothesis_examples import examples
from tests.support.planning_cell import SPEC, turned

MODEL = MODELS["ur10e"]
joints = arrays(float, 6, elements=st.floats(-3.1, 3.1))
bent = st.floats(0.4, 2.7) | st.floats(-2.7, -0.4)
regular = st.builds(lambda q, elbow, wrist: np.array([*q[:2], elbow, q[3], wrist, q[5]]), joints, bent, bent)
"""Joints that are far from the singularities of elbow and wrist."""


@pytest.mark.parametrize("name", MODELS)
@given(q=joints)
@settings(max_examples=examples(50), deadline=None)
def test_the_flange_is_where_the_controller_has_it(name, q):
    rotation, position = forward(q, MODELS[name])
    theirs, at = Kinematics(MODELS[name]).flange(q)
    np.testing.assert_allclose(rotation.ravel(), theirs, atol=1e-12)
    np.testing.assert_allclose(position, at, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@given(q=regular)
@settings(max_examples=examples(50), deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
def test_a_calibrated_robot_is_where_its_controller_has_it_and_is_led_back_there(name, q):
    model = calibrated(CONTROLLED[name])
    rotation, position = forward(q[None], model)
    theirs, at = Kinematics(model).flange(q)
    np.testing.assert_allclose(rotation[0].ravel(), theirs, atol=1e-12)
    np.testing.assert_allclose(position[0], at, atol=1e-11)
    # Closer by, a pose may be beyond the nominal reach, or two solutions within the calibration.
    assume(singularities(q, MODELS[name]).min() > 0.3)
    found = inverse(rotation, position, model)[0]
    reached = found[np.isfinite(found).all(axis=1)]
    assert np.abs(np.exp(1j * reached) - np.exp(1j * q)).max(axis=1).min() < 1e-7
    back, there = forward(reached, model)
    assert turned(back, rotation).max() < 1e-6
    assert np.abs(there - position).max() < 1e-7


@given(q=joints)
@settings(max_examples=examples(100), deadline=None)
def test_what_is_within_reach_has_joints_and_nothing_else_has(q):
    assume(singularities(q, MODEL).min() > 1e-4)
    rotation, position = forward(q[None], MODEL)
    for shift in (0.0, 0.4, 1.0):
        moved = position + shift
        beyond = beyond_reach(rotation, moved, MODEL)
        reached = np.isfinite(inverse(rotation, moved, MODEL)).all(axis=-1)
        clearly = np.abs(beyond) > 1e-6
        assert not reached[clearly].any()
        assert reached[beyond == 0.0].all()


@given(q=joints)
@settings(max_examples=examples(100), deadline=None)
def test_every_posture_leads_back_to_the_pose(q):
    assume(singularities(q, MODEL).min() > 1e-4)  # there joint 6 may be anything, and 0 need not be in reach
    rotation, position = forward(q[None], MODEL)
    found = inverse(rotation, position, MODEL)[0]
    back, at = forward(found[np.isfinite(found).all(axis=1)], MODEL)
    assert turned(back, rotation).max() < 1e-5  # a singular wrist costs digits
    assert np.abs(at - position).max() < 1e-6


@given(q=joints)
@settings(max_examples=examples(100), deadline=None)
def test_a_posture_is_the_one_that_the_joints_are_in(q):
    assume(singularities(q, MODEL).min() > 1e-3)  # two postures meet there
    found = inverse(*forward(q[None], MODEL), MODEL)[0]
    apart = np.abs(np.exp(1j * found[posture(q, MODEL)]) - np.exp(1j * q))
    assert apart.max() < 1e-6


def test_links_end_at_the_axes_of_the_joints():
    q = np.array(SPEC.home.angles)
    points = link_points(q, MODEL)
    _, axes = Kinematics(MODEL).axes(q)
    np.testing.assert_allclose(points[[0, 5, 6]], [axes[1], axes[4], axes[5]], atol=1e-12)
    np.testing.assert_allclose(points[7], Kinematics(MODEL).flange(q)[1], atol=1e-12)
    # the upper arm runs beside the elbow's axis point, along that axis
    assert np.linalg.norm(points[2] - np.array(axes[2])) == pytest.approx(MODEL.d4)


@pytest.mark.parametrize("more", [0.05, 0.5])
def test_what_is_beyond_reach_is_told_by_how_much(more):
    stretched = np.array([[0.0, -0.5, 0.0, 0.2, -1.5, 0.0]])
    rotation, position = forward(stretched, MODEL)
    along = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    assert beyond_reach(rotation, position, MODEL)[0].min() == pytest.approx(0.0, abs=1e-9)
    farther = position + more * along
    assert np.isnan(inverse(rotation, farther, MODEL)).all()
    stretching = posture(stretched[0] + [0, 0, 1e-3, 0, 0, 0], MODEL)
    assert beyond_reach(rotation, farther, MODEL)[0, stretching] == pytest.approx(more, rel=0.02)


def test_a_flange_inside_the_base_s_own_cylinder_is_too_near():
    rotation, _ = forward(np.array([SPEC.home.angles]), MODEL)
    wrist_at_axis = MODEL.d6 * rotation[:, :, 2] + np.array([0.05, 0.0, 0.6])
    np.testing.assert_allclose(beyond_reach(rotation, wrist_at_axis, MODEL)[0], 0.05 - MODEL.d4, atol=1e-9)


@pytest.mark.parametrize(("joint", "angle", "which"), [(2, 0.0, 1), (4, 0.0, 2), (4, np.pi, 2)])
def test_a_straight_elbow_and_a_straight_wrist_are_singular(joint, angle, which):
    q = np.array(SPEC.home.angles)
    q[joint] = angle
    assert singularities(q, MODEL)[which] == pytest.approx(0.0, abs=1e-12)


@given(q=joints)
@settings(max_examples=examples(100), deadline=None)
def test_singular_is_where_no_joint_moves_the_flange_some_way(q):
    # a Jacobian by differences: near a singularity it loses rank, and only there
    h = 1e-6
    columns = []
    for k in range(6):
        plus, minus = q.copy(), q.copy()
        plus[k], minus[k] = q[k] + h, q[k] - h
        (r1, p1), (r0, p0) = forward(plus, MODEL), forward(minus, MODEL)
        spin = (r1 - r0) @ forward(q, MODEL)[0].T / (2 * h)
        columns.append([*((p1 - p0) / (2 * h)), spin[2, 1], spin[0, 2], spin[1, 0]])
    determinant = abs(np.linalg.det(np.array(columns)))
    shoulder, elbow, wrist = singularities(q, MODEL)
    length = abs(MODEL.a2) + abs(MODEL.a3)
    assert determinant == pytest.approx(shoulder * elbow * wrist * length * abs(MODEL.a2 * MODEL.a3), abs=1e-6)
