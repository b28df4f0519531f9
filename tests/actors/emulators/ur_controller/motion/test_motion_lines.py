"""`motion_lines`: trapezoidal profiles: they cover their length, keep their limits, and their speed is what their
distance says.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.emulators.ur_controller.motion.motion_lines import Profile

lengths = st.floats(1e-4, 10.0)
speeds = st.floats(0.01, 3.0)
ends = st.floats(0.0, 3.0)


@given(length=lengths, speed=speeds, acceleration=speeds, start=ends, end=ends)
def test_a_profile_covers_its_length_without_a_jump(
    length: float, speed: float, acceleration: float, start: float, end: float
) -> None:
    profile = Profile(length, speed, acceleration, start, end)
    assert profile.at(0.0) == 0.0
    assert profile.at(profile.duration) == pytest.approx(length)
    assert profile.speed(0.0) == pytest.approx(profile.start)
    steps = 400
    dt = profile.duration / steps
    previous = 0.0
    for k in range(1, steps + 1):
        covered = profile.at(k * dt)
        rate = (covered - previous) / dt
        assert rate >= -1e-9
        assert rate <= max(speed, start) + 1e-6
        assert rate == pytest.approx(profile.speed((k - 0.5) * dt), abs=1e-6 + profile.acceleration * dt)
        previous = covered


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


@given(share=st.floats(0.01, 0.99), start=st.floats(0.1, 3.0), acceleration=speeds)
def test_a_path_too_short_to_brake_gently_is_braked_hard(share: float, start: float, acceleration: float) -> None:
    length = share * start * start / (2.0 * acceleration)
    profile = Profile(length, start, acceleration, start)
    assert profile.at(profile.duration) == pytest.approx(length)
    assert profile.speed(profile.duration) == 0.0
    assert profile.acceleration == pytest.approx(start * start / (2.0 * length))


def test_no_way_takes_no_time() -> None:
    assert Profile(0.0, 1.0, 1.0).duration == 0.0
