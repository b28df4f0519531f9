"""`motion_actions`: trapezoidal profiles: they cover their length and keep their limits."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.emulators.ur_controller.motion.motion_actions import Profile

lengths = st.floats(1e-4, 10.0)
speeds = st.floats(0.01, 3.0)


@given(length=lengths, speed=speeds, acceleration=speeds)
def test_a_profile_covers_its_length_without_a_jump(length: float, speed: float, acceleration: float) -> None:
    profile = Profile(length, speed, acceleration)
    assert profile.at(0.0) == 0.0
    assert profile.at(profile.duration) == pytest.approx(length)
    steps = 400
    dt = profile.duration / steps
    covered = [profile.at(k * dt) for k in range(steps + 1)]
    rates = [0.0, *((b - a) / dt for a, b in itertools.pairwise(covered)), 0.0]
    assert all(-1e-9 <= rate <= speed + 1e-6 for rate in rates)
    assert all(abs(b - a) <= acceleration * dt + 1e-6 for a, b in itertools.pairwise(rates))


@given(length=lengths, speed=speeds, acceleration=speeds)
def test_from_rest_to_rest_it_accelerates_no_harder_than_allowed(
    length: float, speed: float, acceleration: float
) -> None:
    profile = Profile(length, speed, acceleration)
    assert profile.acceleration == acceleration
    assert profile.peak <= speed
    full = speed * speed / acceleration <= length
    expected = length / speed + speed / acceleration if full else 2.0 * (length / acceleration) ** 0.5
    assert profile.duration == pytest.approx(expected)


@given(length=lengths, duration=st.floats(0.1, 20.0), acceleration=speeds)
def test_a_timed_profile_takes_its_time(length: float, duration: float, acceleration: float) -> None:
    assert Profile.timed(length, duration, acceleration).duration == pytest.approx(duration, rel=1e-6)


def test_no_way_takes_no_time() -> None:
    assert Profile(0.0, 1.0, 1.0).duration == 0.0
