"""`trajectory`: steps in speed become ramps that joints can make; waypoints stand where something changes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.arm.planning.trajectory import STEEPEST, followable, pour_times, trapezoid
from sim_engine.action import DEG
from sim_engine.motion import Phase, PourMotion, Segment
from tests.support.hypothesis_examples import examples
from tests.support.planning_cell import ACTION, motion

STEP = ACTION.with_values(angular_acceleration=None, angular_velocity=100 * DEG)


def test_a_motion_that_joints_can_make_stays_as_it_is():
    planned = motion()
    assert followable(planned) is planned


@pytest.mark.parametrize("acceleration", [None, 20_000 * DEG])
def test_a_step_becomes_a_ramp_and_what_follows_is_later_by_it(acceleration):
    asked = motion(STEP.with_values(angular_acceleration=acceleration))
    made = followable(asked)
    times = np.linspace(0.0, made.duration, 20_001)
    speed = made.angular_velocity(times)
    assert np.abs(np.diff(speed) / np.diff(times)).max() < STEEPEST * 1.001
    assert np.abs(speed).max() == pytest.approx(100 * DEG)
    assert made.tilt(times).max() == pytest.approx(ACTION.max_angle)
    assert made.tilt(times)[-1] == pytest.approx(0.0, abs=1e-9)
    before, after = asked.phases[0], made.phases[0]
    already = 0.0 if acceleration is None else 100 * DEG / acceleration
    assert after.end - before.end == pytest.approx(100 * DEG / STEEPEST - already, rel=1e-6)
    assert [p.name for p in made.phases] == [p.name for p in asked.phases]
    assert made.phases[1].end - made.phases[1].start == pytest.approx(ACTION.hold_time)
    for first, second in pairwise(made.phases):
        assert second.start == first.end
    assert made.tilt(np.array([made.phases[1].start, made.phases[1].end])) == pytest.approx(ACTION.max_angle)


def test_a_step_at_one_end_alone_is_one_too():
    asked = PourMotion((Segment(0.0, 1.0, 0.0, 1.0, -1.0),), (Phase("tilt", 0.0, 1.0),), (0.0,) * 3, (0.0,) * 3)
    made = followable(asked)
    assert made.angular_velocity(np.zeros(1))[0] == 0.0
    assert made.tilt(np.array([made.duration]))[0] == pytest.approx(0.5)


def test_a_pour_that_ends_tilted_still_does():
    made = followable(motion(STEP.with_values(return_velocity=None)))
    assert made.tilt(np.array([made.duration]))[0] == pytest.approx(ACTION.max_angle)
    assert [p.name for p in made.phases] == ["tilt", "hold"]


@given(
    speed=st.floats(2, 150), angle=st.floats(10, 135), acceleration=st.floats(15, 990),
    hold=st.just(0.0) | st.floats(1e-3, 10), back=st.floats(5, 150),
)  # fmt: skip
@settings(max_examples=examples(60), deadline=None)
def test_phases_end_at_waypoints_and_chords_stay_close(speed, angle, acceleration, hold, back):
    made = motion(
        ACTION.with_values(
            angular_velocity=speed * DEG,
            max_angle=angle * DEG,
            angular_acceleration=acceleration * DEG,
            hold_time=hold,
            return_velocity=back * DEG,
        )
    )
    times = pour_times(made)
    assert times[0] == 0.0
    assert np.diff(times).min() > 0.0
    for phase in made.phases:
        assert phase.start in times
        assert phase.end in times
    assert len(times) <= 1200
    dense = np.linspace(0.0, made.duration, 5000)
    assert np.abs(np.interp(dense, times, made.tilt(times)) - made.tilt(dense)).max() < 0.011 * DEG


@given(length=st.floats(1e-3, 2.0), speed=st.floats(0.01, 2.0), acceleration=st.floats(0.1, 5.0))
@settings(max_examples=examples(60), deadline=None)
def test_a_way_is_made_from_rest_to_rest_within_speed_and_acceleration(length, speed, acceleration):
    times, way = trapezoid(length, speed, acceleration, 0.02)
    assert (times[0], way[0], way[-1]) == (0.0, 0.0, length)
    assert np.diff(times).min() > 0.0
    rates = np.diff(way) / np.diff(times)
    assert rates.min() >= 0.0
    assert rates.max() <= speed * (1 + 1e-6)
    middles = 0.5 * (times[1:] + times[:-1])
    assert np.abs(np.diff(rates) / np.diff(middles)).max(initial=0.0) <= acceleration * (1 + 1e-6)
    # half of the first and last chord's rate: from and to rest
    assert max(rates[0] / (times[1] - times[0]), rates[-1] / (times[-1] - times[-2])) <= acceleration
