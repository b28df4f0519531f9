"""`collision`: contact between vessels: found before anything moves, described in words, quick enough to ask for
every action.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.collision import (
    WAY,
    clearance,
    contact_during,
    describe_contact,
    first_contact,
    poses_along,
    rotations,
    way_of,
)
from sim_engine.liquids import Liquid
from sim_engine.motion import Motion, PourMotion, plan_motion
from sim_engine.scene import Pivot, PoseError, SampledMotion, Scene
from sim_engine.simulator import InvalidSceneError, check_motion
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.counted_calls import counted_calls
from tests.support.hypothesis_examples import examples

A = build_vessel(cylinder("a", inner_radius=0.04, inner_height=0.1, wall=0.002, floor=0.002))
B = build_vessel(cylinder("b", inner_radius=0.05, inner_height=0.08, wall=0.002, floor=0.002))
THIN = build_vessel(cylinder("thin", inner_radius=0.03, inner_height=0.08, wall=0.001, floor=0.001))

Poses = NDArray[np.float64]


def upright(*places: tuple[float, float, float]) -> Poses:
    return np.array([[*place, 1.0, 0.0, 0.0, 0.0] for place in places])


def tilting(tilts: Poses, x_offset: float, height: float) -> Poses:
    """About the inner lip's point of A, which starts `height` above B's rim."""
    pivot, world = A.lip_point(), np.array([0.04 - x_offset, 0.0, B.rim_height + height])
    poses = np.zeros((len(tilts), 7))
    poses[:, 3], poses[:, 5] = np.cos(tilts / 2), np.sin(tilts / 2)
    poses[:, :3] = world - rotations(poses) @ pivot
    return poses


def inverse(poses: Poses) -> Poses:
    result = poses.copy()
    result[:, 4:] *= -1.0
    result[:, :3] = -np.einsum("tji,tj->ti", rotations(poses), poses[:, :3])
    return result


def test_cups_side_by_side_touch_when_their_walls_meet() -> None:
    assert first_contact(A, B, upright((-0.0955, 0.0, 0.0))) is None
    contact = first_contact(A, B, upright((-0.0925, 0.0, 0.0)))
    assert contact is not None
    assert contact.depth == pytest.approx(0.0015, abs=0.0008)  # overlap of 94 mm − 92.5 mm
    assert contact.point[0] == pytest.approx(-0.051, abs=0.002)


def test_clearance_is_the_gap_between_the_walls() -> None:
    gaps = clearance(A, B, upright((-0.1, 0.0, 0.0), (-0.2, 0.0, 0.0), (0.01, 0.0, 0.09)))
    np.testing.assert_allclose(gaps, [0.006, 0.106, 0.008], atol=5e-4)


def test_lip_inside_the_opening_without_touching_is_no_contact() -> None:
    small = upright((0.0, 0.0, 0.02))  # the narrow cup stands inside the wide one, 18 mm above its floor
    assert first_contact(A, B, small) is None
    assert clearance(A, B, small)[0] == pytest.approx(0.008, abs=5e-4)


def test_first_contact_is_the_first() -> None:
    poses = upright(*[(-0.12 + 0.001 * k, 0.0, 0.0) for k in range(60)])
    contact = first_contact(A, B, poses)
    assert contact is not None
    assert contact.index == 27  # outer radii 42 mm and 52 mm: −94 mm is index 26, still a touch without overlap


def test_pouring_motion_that_hits_the_rim_is_described_with_its_tilt() -> None:
    tilts = np.radians(np.linspace(0.0, 170.0, 171))
    assert first_contact(A, B, tilting(tilts, 0.1, 0.03)) is None
    poses = tilting(tilts, 0.1, -0.01)  # past 120° the far side of the rim comes down on the receiver's
    contact = first_contact(A, B, poses)
    assert contact is not None
    tilt = tilts[contact.index]
    assert 120.0 < math.degrees(tilt) < 170.0
    text = describe_contact(contact, tilt=tilt, pourer="the beaker", receiver="the glass")
    assert text.startswith(f"cups touch: at tilt {math.degrees(tilt):.0f}° the beaker (its ")
    assert "enters the glass by" in text
    assert text.endswith(" mm")
    assert clearance(A, B, poses[: contact.index]).min() > -0.0005


@settings(max_examples=examples(40), deadline=None)
@given(
    st.floats(-0.11, 0.11), st.floats(-0.11, 0.11), st.floats(-0.02, 0.12),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(v * v for v in q) > 0.1),
)  # fmt: skip
def test_contact_does_not_depend_on_which_vessel_stands_still(
    x: float, y: float, z: float, q: tuple[float, ...]
) -> None:
    poses = np.array([[x, y, z, *q]])
    one, other = first_contact(A, B, poses), first_contact(B, A, inverse(poses))
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert one.depth == pytest.approx(other.depth, abs=1e-9)
        # the same material point, once seen from the receiver, once from the pourer
        assert rotations(poses)[0] @ other.point + poses[0, :3] == pytest.approx(one.point, abs=1e-9)
    assert clearance(A, B, poses) == pytest.approx(clearance(B, A, inverse(poses)), abs=1e-9)


@settings(max_examples=examples(30), deadline=None)
@given(st.floats(0.0, 2 * math.pi), st.floats(-0.08, 0.075), st.floats(0.02, 0.95))
def test_crossing_thin_walls_never_go_unseen(direction: float, z: float, inside: float) -> None:
    # two upright thin cups whose walls cross: the axes are closer than twice the outer radius, farther than the play
    distance = 0.0015 + inside * (0.062 - 0.003)
    pose = upright((distance * math.cos(direction), distance * math.sin(direction), z))
    assert first_contact(THIN, THIN, pose) is not None


def test_far_vessels_are_not_even_looked_at() -> None:
    assert first_contact(A, B, upright((1.0, 0.0, 0.0), (0.0, 0.0, 3.0))) is None
    assert first_contact(A, B, np.zeros((0, 7))) is None


@pytest.mark.parametrize(
    ("poses", "message"),
    [(np.zeros((3, 6)), "shape"), (np.zeros((1, 7)), "length 0"), (np.full((1, 7), np.nan), "finite")],
)
def test_poses_that_are_none_are_refused(poses: Poses, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        first_contact(A, B, poses)


def test_a_whole_motion_is_checked_with_little_work() -> None:
    poses = tilting(np.radians(np.linspace(0.0, 120.0, 120)), 0.098, 0.005)
    first_contact(A, B, poses)  # samples are drawn once per vessel
    with counted_calls() as calls:
        first_contact(A, B, poses)
    assert calls.count < 60 * len(poses)


def swung(rng: np.random.Generator) -> tuple[Scene, Action, PourMotion]:
    """A quick pour of A into B about a point of the pourer, held for a minute."""
    pivot = Pivot("point", x=float(rng.uniform(-0.06, 0.06)), z=float(rng.uniform(-0.02, 0.14)))
    scene = Scene("a into b", A.spec, B.spec, Liquid(mass=0.2), pivot)
    action = Action(
        angular_velocity=rng.uniform(90.0, 360.0) * DEG,
        x_offset=rng.uniform(0.03, 0.12),
        height=rng.uniform(0.02, 0.12),
        max_angle=rng.uniform(90.0, 175.0) * DEG,
        hold_time=60.0,
    )
    return scene, action, plan_motion(scene, action, A, B)


@pytest.mark.slow
def test_no_touch_of_a_pour_is_missed_however_long_it_is_held() -> None:
    # Poses evenly spaced in time, 121 of them, let six of these 140 touches go unseen, up to 1 mm deep.
    rng = np.random.default_rng(0)
    touched = 0
    for _ in range(189):
        scene, action, motion = swung(rng)
        try:
            check_motion(motion, scene, action, A, B, PoseError())
        except InvalidSceneError:
            touched += 1
            continue
        fine = motion.sample(np.linspace(0.0, motion.phases[0].end, 500))  # 0.8 mm of way at most from one to the next
        assert first_contact(A, B, fine) is None, action.display()
    assert touched == 140


@pytest.mark.parametrize("read_back", [False, True])
def test_no_point_of_the_pourer_moves_far_between_two_poses_that_are_looked_at(read_back: bool) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        _, _, planned = swung(rng)
        motion: Motion = planned
        if read_back:
            times = np.arange(0.0, planned.duration, 0.008)
            motion = SampledMotion(times, planned.sample(times))
        times, poses = poses_along(motion, A, motion.duration)
        assert (times[0], times[-1]) == (0.0, motion.duration)
        points = np.einsum("tij,pj->tpi", rotations(poses), A.solid_vertices) + poses[:, None, :3]
        ways = np.linalg.norm(np.diff(points, axis=0), axis=-1)
        assert ways.max() <= WAY
        assert len(times) < 1.5 * way_of(poses, A)[-1] / WAY  # and no more poses than that takes


def test_a_motion_that_jumps_is_looked_at_on_both_sides_of_the_jump() -> None:
    # 'step' in recorded data: an arm that was read back may have moved 20 mm from one sample to the next.
    apart = SampledMotion(np.array([0.0, 1e-10, 1.0]), upright((-0.2, 0.0, 0.0), (-0.09, 0.0, 0.0), (-0.09, 0.0, 0.0)))
    found = contact_during(apart, A, B)
    assert found is not None
    assert found[0].depth > 0.0
