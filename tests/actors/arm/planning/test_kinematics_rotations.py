"""`kinematics`: rotations with numpy alone, held against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation, Slerp

from actors.arm.planning.collision_geometry import hull
from actors.arm.planning.kinematics import about, between, from_vector, to_quaternions
from tests.support.hypothesis_examples import examples
from tests.support.planning_cell import vessel

vectors = st.tuples(*[st.floats(-7.0, 7.0)] * 3)


@given(vector=vectors)
@settings(max_examples=examples(100), deadline=None)
def test_a_rotation_vector_and_its_quaternion_turn_as_scipy_says(vector):
    matrix = from_vector(vector)
    assert matrix == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-14)
    q = to_quaternions(matrix[None])[0]
    expected = np.roll(Rotation.from_rotvec(vector).as_quat(), 1)
    assert abs(float(q @ expected)) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_half_a_turn_about_an_axis_is_not_lost_in_rounding(axis):
    q = to_quaternions(about(axis, np.pi)[None])[0]
    assert np.abs(q) == pytest.approx([0.0, *np.eye(3)["xyz".index(axis)]], abs=1e-15)


@given(first=vectors, second=vectors, share=st.floats(0.0, 1.0))
@settings(max_examples=examples(100), deadline=None)
def test_halfway_between_two_attitudes_is_where_scipy_has_it(first, second, share):
    a, b = (to_quaternions(from_vector(v)[None])[0] for v in (first, second))
    turn = (Rotation.from_rotvec(first).inv() * Rotation.from_rotvec(second)).magnitude()
    found = Rotation.from_quat(np.roll(between(a, b, np.array([share]))[0], -1))
    expected = Slerp([0.0, 1.0], Rotation.from_rotvec([first, second]))(share)
    if turn < 3.1:  # half a turn may go either way
        assert (found.inv() * expected).magnitude() < 1e-7


@pytest.mark.parametrize("name", ["tumbler", "bowl", "cone", "narrow"])
def test_the_outermost_rings_of_a_turned_vessel_are_its_convex_hull(name):
    corners = vessel(name).solid_vertices
    expected = corners[ConvexHull(corners).vertices]
    assert {tuple(p) for p in hull(vessel(name))} == {tuple(p) for p in expected}
