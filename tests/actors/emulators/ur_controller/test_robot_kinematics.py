"""`robot_kinematics`: forward kinematics against the product of Denavit–Hartenberg matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.arm.ur.robot_models import RobotModel
from actors.emulators.ur_controller.robot import MODELS
from actors.emulators.ur_controller.robot_kinematics import (
    Kinematics,
    Matrix,
    multiply,
    rotation_matrix,
    rotation_vector,
)


def transpose(m: Matrix) -> Matrix:
    return (m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8])


def angle_between(a: Matrix, b: Matrix) -> float:
    return math.hypot(*rotation_vector(multiply(transpose(a), b)))


angles = st.floats(-math.pi, math.pi)
joints = st.tuples(angles, angles, angles, angles, angles, angles)
small = st.floats(-2.0, 2.0)
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))


def denavit_hartenberg(model: RobotModel, q: tuple[float, ...]) -> np.ndarray:
    """(4, 4), from the textbook."""
    a = (0.0, model.a2, model.a3, 0.0, 0.0, 0.0)
    d = (model.d1, 0.0, 0.0, model.d4, model.d5, model.d6)
    twist = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
    product = np.eye(4)
    for theta, length, offset, alpha in zip(q, a, d, twist, strict=True):
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        product = product @ [
            [c, -s * ca, s * sa, length * c],
            [s, c * ca, -c * sa, length * s],
            [0.0, sa, ca, offset],
            [0.0, 0.0, 0.0, 1.0],
        ]
    return product


@each_model
@given(q=joints)
def test_the_flange_is_where_the_table_of_lengths_puts_it(model: RobotModel, q: tuple[float, ...]) -> None:
    rotation, point = Kinematics(model).flange(q)
    expected = denavit_hartenberg(model, q)
    assert np.reshape(rotation, (3, 3)) == pytest.approx(expected[:3, :3], abs=1e-12)
    assert point == pytest.approx(expected[:3, 3], abs=1e-12)


def test_a_stretched_arm_is_as_long_as_its_links() -> None:
    # All joints at zero: both links along −x, the wrist beside them, the tool pointing along −y.
    _, point = Kinematics(MODELS["ur10e"]).flange((0.0,) * 6)
    m = MODELS["ur10e"]
    assert point == pytest.approx((m.a2 + m.a3, -m.d4 - m.d6, m.d1 - m.d5))


@given(q=joints, rates=joints)
def test_velocity_is_how_fast_the_flange_moves(q: tuple[float, ...], rates: tuple[float, ...]) -> None:
    kinematics, h = Kinematics(MODELS["ur10e"]), 1e-6
    before = kinematics.flange([a - h * b for a, b in zip(q, rates, strict=True)])
    after = kinematics.flange([a + h * b for a, b in zip(q, rates, strict=True)])
    moved = [(b - a) / (2 * h) for a, b in zip(before[1], after[1], strict=True)]
    turned = [x / (2 * h) for x in rotation_vector(multiply(after[0], transpose(before[0])))]
    velocity = kinematics.velocity(q, rates, kinematics.flange(q)[1])
    assert velocity == pytest.approx([*moved, *turned], abs=1e-6)


@given(rotation=st.tuples(small, small, small))
def test_a_rotation_survives_being_a_matrix(rotation: tuple[float, float, float]) -> None:
    matrix = rotation_matrix(rotation)
    assert angle_between(rotation_matrix(rotation_vector(matrix)), matrix) < 1e-7


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.8, 0), (0.36, 0.48, -0.8)])
@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-7, 1e-5, -1e-9])
def test_a_half_turn_survives_too(axis: tuple[float, float, float], off: float) -> None:
    matrix = rotation_matrix([(math.pi + off) * a for a in axis])
    back = rotation_matrix(rotation_vector(matrix))
    assert max(abs(a - b) for a, b in zip(back, matrix, strict=True)) < 1e-6
