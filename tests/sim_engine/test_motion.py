"""`motion`: the pourer's motion: what the arm executes and the solver replays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import PourMotion, plan_motion
from sim_engine.scene import Pivot, SampledMotion, Scene
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.hypothesis_examples import examples

CUP = cylinder("cup", inner_radius=0.04, inner_height=0.10)
GLASS = cylinder("glass", inner_radius=0.045, inner_height=0.09)
POURER, RECEIVER = build_vessel(CUP), build_vessel(GLASS)
SCENE = Scene("scene", CUP, GLASS, Liquid(mass=0.2))


def motion(scene: Scene = SCENE, **changes: float | None) -> PourMotion:
    values: dict[str, float | None] = {
        "angular_velocity": 40 * DEG,
        "x_offset": 0.1,
        "height": 0.06,
        "max_angle": 110 * DEG,
        "hold_time": 1.0,
        **changes,
    }
    return plan_motion(scene, Action.compose({}, values), POURER, RECEIVER)  # type: ignore[arg-type]


def in_world(poses: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point of the vessel's frame in the world, for poses that only turn about y."""
    tilt = 2 * np.arctan2(poses[:, 5], poses[:, 3])
    cos, sin = np.cos(tilt), np.sin(tilt)
    x = poses[:, 0] + cos * point[0] + sin * point[2]
    z = poses[:, 2] - sin * point[0] + cos * point[2]
    return np.column_stack([x, poses[:, 1] + point[1], z])


def test_the_lip_stays_where_it_is_while_the_cup_turns_about_it() -> None:
    m = motion()
    lip = in_world(m.sample(np.linspace(0, m.duration, 200)), POURER.lip_point(0.0))
    assert np.ptp(lip, axis=0) == pytest.approx([0, 0, 0], abs=1e-12)
    assert lip[0, 2] - RECEIVER.rim_height == pytest.approx(0.06)
    assert lip[0, 0] == pytest.approx(-0.1 + 0.04)


def test_another_pivot_stays_where_it_is_instead() -> None:
    grip = Scene("grip", CUP, GLASS, Liquid(mass=0.2), Pivot("point", 0.0, 0.05))
    poses = motion(grip).sample(np.linspace(0, 3, 100))
    assert np.ptp(in_world(poses, np.array([0.0, 0.0, 0.05])), axis=0) == pytest.approx([0, 0, 0], abs=1e-12)
    assert np.ptp(in_world(poses, POURER.lip_point(0.0))[:, 2]) > 0.03


def test_positive_tilt_tips_towards_the_receiver() -> None:
    m = motion()
    axis_top = in_world(m.sample(np.array([0.0, m.phases[0].end])), np.array([0.0, 0.0, 0.1]))
    base = in_world(m.sample(np.array([0.0, m.phases[0].end])), np.zeros(3))
    assert (axis_top - base)[0] == pytest.approx([0, 0, 0.1])
    assert (axis_top - base)[1, 0] > 0.09


def test_the_cup_holds_and_comes_back_upright() -> None:
    m = motion()
    assert [p.name for p in m.phases] == ["tilt", "hold", "return"]
    tilt, hold, back = m.phases
    assert m.tilt(np.array([tilt.end, hold.end])) == pytest.approx([110 * DEG] * 2)
    assert hold.end - hold.start == pytest.approx(1.0)
    assert m.tilt(np.array([back.end, back.end + 5.0])) == pytest.approx([0, 0], abs=1e-9)


@settings(deadline=None, max_examples=examples(60))
@given(
    speed=st.floats(5, 300),
    angle=st.floats(10, 170),
    acceleration=st.floats(50, 5000),
)
def test_speed_and_acceleration_are_never_exceeded(speed: float, angle: float, acceleration: float) -> None:
    m = motion(angular_velocity=speed * DEG, max_angle=angle * DEG, angular_acceleration=acceleration * DEG)
    t = np.linspace(0, m.duration, 4001)
    rate = np.gradient(m.tilt(t), t)
    assert np.max(np.abs(rate)) <= max(speed, 90) * DEG * (1 + 1e-6)
    assert np.max(m.tilt(t)) == pytest.approx(angle * DEG)
    # A finite difference over a corner of the acceleration may see both sides of it.
    assert np.max(np.abs(np.gradient(rate, t))) <= acceleration * DEG * 1.01
    assert rate == pytest.approx(m.angular_velocity(t), abs=acceleration * DEG * (t[1] - t[0]))


def test_recorded_pours_start_and_stop_at_once_and_do_not_return() -> None:
    m = motion(angular_acceleration=None, return_velocity=None, hold_time=1.2)
    assert m.tilt(np.array([1.0])) == pytest.approx([40 * DEG])
    assert m.duration == pytest.approx(110 / 40 + 1.2)


def test_a_hold_until_the_flow_ends_is_longer_for_a_fast_turn_and_never_beyond_the_cap() -> None:
    def hold(m: PourMotion) -> float:
        return m.phases[1].end - m.phases[1].start

    fast = motion(hold_time=None, angular_velocity=120 * DEG)
    slow = motion(hold_time=None, angular_velocity=15 * DEG)
    assert 0.0 <= hold(slow) < hold(fast) <= SCENE.max_hold_time
    short = Scene("short", CUP, GLASS, Liquid(mass=0.2), max_hold_time=0.2)
    assert hold(motion(short, hold_time=None, angular_velocity=120 * DEG)) == pytest.approx(0.2)


def test_what_an_arm_did_can_be_replayed() -> None:
    m = motion()
    times = np.arange(0, m.duration + 0.01, 0.008)  # an arm's 125 Hz
    replay = SampledMotion(times, m.sample(times))
    between = np.linspace(0, m.duration, 777)
    assert replay.tilt(between) == pytest.approx(m.tilt(between), abs=2e-4)
    assert replay.sample(between)[:, :3] == pytest.approx(m.sample(between)[:, :3], abs=5e-5)


def test_a_broken_recording_is_refused() -> None:
    with pytest.raises(ValueError, match="increase"):
        SampledMotion(np.array([0.0, 0.0]), np.zeros((2, 7)))
    with pytest.raises(ValueError, match="finite"):
        SampledMotion(np.array([0.0, 1.0]), np.full((2, 7), np.nan))
