"""`robot_kinematics`: forward kinematics against the product of Denavit–Hartenberg matrices; the inverse against
the forward.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from actors.arm.ur.robot_models import RobotModel
from actors.emulators.ur_controller.robot import HOME, MODELS, Robot
from actors.emulators.ur_controller.robot_kinematics import (
    IDENTITY,
    Kinematics,
    angle_between,
    compose,
    distance,
    invert,
    multiply,
    pose_of,
    rotation_matrix,
    rotation_vector,
    transform_of,
    transpose,
)
from actors.emulators.ur_controller.safety_system import SafetyConfiguration

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


@pytest.mark.slow
@each_model
@given(q=joints)
@example(q=(0.0, 0.0, 0.0, 0.0, 6.3e-07, 0.0))
def test_every_solution_puts_the_flange_where_it_was_wanted(model: RobotModel, q: tuple[float, ...]) -> None:
    kinematics = Kinematics(model)
    wanted = kinematics.flange(q)
    for solution in kinematics.inverse(wanted, q[5]):
        found = kinematics.flange(solution)
        assert distance(found[1], wanted[1]) < 1e-6
        # A wrist within a millionth of straight counts as straight, whichever way it bends: that much on either side.
        assert angle_between(found[0], wanted[0]) < 2.1e-6


def test_shoulder_wrist_and_elbow_give_eight_solutions() -> None:
    kinematics = Kinematics(MODELS["ur10e"])
    solutions = list(kinematics.inverse(kinematics.flange((0.3, -1.2, 1.4, -1.7, -1.1, 0.4))))
    assert len({tuple(round(x, 6) for x in s) for s in solutions}) == 8


@given(q=joints)
def test_the_nearest_solution_is_the_one_it_came_from(q: tuple[float, ...]) -> None:
    kinematics = Kinematics(MODELS["ur10e"])
    found = kinematics.nearest(kinematics.flange(q), q)
    assert found is not None
    # Where the arm is stretched or folded two solutions fall together, and rounding decides: the pose still is right.
    flange = kinematics.flange(found)
    assert distance(flange[1], kinematics.flange(q)[1]) < 1e-6
    if abs(math.sin(q[2])) > 1e-3 and abs(math.sin(q[4])) > 1e-3:
        assert sum((a - b) ** 2 for a, b in zip(found, q, strict=True)) < 1e-6


def test_solutions_stay_near_joints_beyond_half_a_turn() -> None:
    kinematics = Kinematics(MODELS["ur10e"])
    q = (3.5, -1.2, 1.4, -1.7, -1.1, -6.0)
    assert kinematics.nearest(kinematics.flange(q), q) == pytest.approx(q)


def test_with_a_straight_wrist_the_last_joint_stays_as_it_was() -> None:
    kinematics = Kinematics(MODELS["ur10e"])
    q = (0.3, -1.2, 1.4, -1.7, 0.0, 0.9)
    assert kinematics.nearest(kinematics.flange(q), q) == pytest.approx(q, abs=1e-6)


@pytest.mark.parametrize("point", [(2.0, 0.0, 0.5), (0.05, 0.0, 0.5), (0.0, 0.0, 0.0)])
def test_out_of_reach_there_is_no_solution(point: tuple[float, float, float]) -> None:
    down = rotation_matrix((math.pi, 0.0, 0.0))
    assert Kinematics(MODELS["ur10e"]).nearest((down, point), HOME) is None


@given(q=joints, rates=joints)
def test_velocity_is_how_fast_the_flange_moves(q: tuple[float, ...], rates: tuple[float, ...]) -> None:
    kinematics, h = Kinematics(MODELS["ur10e"]), 1e-6
    before = kinematics.flange([a - h * b for a, b in zip(q, rates, strict=True)])
    after = kinematics.flange([a + h * b for a, b in zip(q, rates, strict=True)])
    moved = [(b - a) / (2 * h) for a, b in zip(before[1], after[1], strict=True)]
    turned = [x / (2 * h) for x in rotation_vector(multiply(after[0], transpose(before[0])))]
    velocity = kinematics.velocity(q, rates, kinematics.flange(q)[1])
    assert velocity == pytest.approx([*moved, *turned], abs=1e-6)


@given(q=joints)
def test_the_last_link_s_frame_is_the_flange(q: tuple[float, ...]) -> None:
    kinematics = Kinematics(MODELS["ur10e"])
    last, flange = kinematics.links(q)[5], kinematics.flange(q)
    assert distance(last[1], flange[1]) < 1e-9
    assert angle_between(last[0], flange[0]) < 1e-6


@given(q=joints)
def test_holding_torques_are_what_raising_the_arm_by_a_joint_costs(q: tuple[float, ...]) -> None:
    robot = Robot(MODELS["ur10e"], q, SafetyConfiguration.of(MODELS["ur10e"]))
    robot.payload, robot.cog = 2.0, (0.01, 0.02, 0.1)

    def energy(joints: list[float]) -> float:
        frames = robot.kinematics.links(joints)
        heights = [compose(f, (IDENTITY, c))[1][2] for f, c in zip(frames, MODELS["ur10e"].centres, strict=True)]
        load = compose(frames[5], (IDENTITY, robot.cog))[1][2]
        return 9.82 * (sum(m * h for m, h in zip(MODELS["ur10e"].masses, heights, strict=True)) + robot.payload * load)

    torques, h = robot.holding_torques, 1e-5
    for i in range(6):
        up, down = ([a + (s * h if k == i else 0.0) for k, a in enumerate(q)] for s in (1, -1))
        assert torques[i] == pytest.approx((energy(up) - energy(down)) / (2 * h), abs=1e-5)


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


@given(pose=st.tuples(small, small, small, small, small, small))
def test_a_frame_undone_is_no_frame_at_all(pose: tuple[float, ...]) -> None:
    frame = transform_of(pose)
    assert pose_of(compose(frame, invert(frame))) == pytest.approx((0.0,) * 6, abs=1e-9)
