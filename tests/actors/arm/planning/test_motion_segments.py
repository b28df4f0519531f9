"""`motion_segments`: what needs no controller: programs from paths, ways back, how a path was followed, bytes from
a stranger.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as example_settings
from hypothesis import strategies as st

from actors.arm.arm_interface import ArmRefusedError
from actors.arm.planned_pour import JointPath, pack, unpack
from actors.arm.planning.motion_segments import jog_path, leans, rejoin, upright_way, way_home
from actors.arm.ur.executed_motion import executed_path
from actors.arm.ur.primary_interface import PrimaryError, split
from actors.arm.ur.urscript_writer import path_program, thinned
from actors.arm.ur.worker_messages import MotionSettings
from tests.support.hypothesis_examples import examples
from tests.support.ur_pours import HOME, START, pour_path, settings, smooth

NO_TOOL = MotionSettings((0.0,) * 6, 0.0, (0.0,) * 3, 43)
POUR = pour_path()


# ---- programs


@given(seed=st.integers(0, 10_000))
@example_settings(max_examples=examples(30), deadline=None)
def test_leaving_points_out_changes_no_joint_by_more_than_the_tolerance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.001, 0.05, 200))])
    steps = np.where(rng.random((201, 6)) < 0.3, rng.normal(0.0, 0.01, (201, 6)), 0.0)
    path = JointPath(times, np.cumsum(steps, axis=0))
    thin = thinned(path, 1e-3)
    assert np.abs(thin.at(times) - path.joints).max() <= 1e-3 + 1e-12
    assert (thin.times[0], thin.times[-1]) == (times[0], times[-1])


def test_a_hold_takes_two_points_however_long_it_is() -> None:
    times = np.linspace(0.0, 100.0, 10_001)
    assert len(thinned(JointPath(times, np.tile(START, (10_001, 1)))).times) == 2


def test_a_long_pour_fits_in_two_thousand_lines_and_a_longer_one_is_refused() -> None:
    rng = np.random.default_rng(0)
    rough = JointPath(np.arange(1_700) * 0.01, rng.normal(0.0, 0.1, (1_700, 6)))
    assert path_program(rough, NO_TOOL, 1, cb3=False).count("\n") < 2_000
    rougher = JointPath(np.arange(2_500) * 0.01, rng.normal(0.0, 0.1, (2_500, 6)))
    with pytest.raises(ArmRefusedError, match="2500 points; a program takes 1800"):
        path_program(rougher, NO_TOOL, 1, cb3=False)


def test_the_older_generation_is_not_asked_for_what_it_does_not_know() -> None:
    assert "get_steptime" not in path_program(POUR.pour, NO_TOOL, 1, cb3=True)


# ---- ways back


@given(share=st.floats(0.0, 1.0), noise=st.integers(0, 100))
@example_settings(max_examples=examples(60), deadline=None)
def test_un_tilting_ends_upright_never_tilts_further_and_is_slow(share: float, noise: int) -> None:
    spec = settings()
    here = share * POUR.pour.duration
    joints = POUR.pour.at(np.array([here]))[0] + np.random.default_rng(noise).normal(0.0, 2e-4, 6)
    tilt = float(np.interp(here, POUR.pour.times, POUR.tilts))
    way, tilts = upright_way(POUR, joints, spec)
    assert way.joints[0] == pytest.approx(joints)
    assert tilts.max() <= tilt + 1e-3
    assert tilts[-1] == pytest.approx(0.0, abs=1e-6)
    assert way.joints[-1] == pytest.approx(START, abs=1e-6)
    speeds = np.abs(np.diff(way.joints, axis=0)) / np.diff(way.times)[:, None]
    assert speeds[:, 5].max() < 1.05 * spec.upright_speed + 0.01
    assert speeds.max() < spec.approach_speed
    # from rest to rest
    assert max(speeds[0].max(), speeds[-1].max()) < 0.05


def test_a_pourer_that_was_coming_up_goes_on_coming_up() -> None:
    here = POUR.phases[2][1] + 0.6 * (POUR.phases[2][2] - POUR.phases[2][1])
    way, _ = upright_way(POUR, POUR.pour.at(np.array([here]))[0], settings())
    assert rejoin(POUR.pour, way.joints[len(way.times) // 2])[1] < 1e-3
    assert way.joints[-1] == pytest.approx(POUR.pour.joints[-1])


def test_the_way_home_from_the_pour_s_end_is_the_planned_one() -> None:
    assert way_home(POUR, POUR.pour.joints[-1], settings()) is POUR.retreat


@pytest.mark.parametrize("way", ["approach", "retreat"])
def test_the_way_home_from_a_stop_follows_the_checked_way(way: str) -> None:
    checked = getattr(POUR, way)
    joints = checked.at(np.array([0.4 * checked.duration]))[0]
    home = way_home(POUR, joints, settings())
    assert home.joints[0] == pytest.approx(joints)
    assert home.joints[-1] == pytest.approx(HOME, abs=1e-6)
    assert max(rejoin(checked, q)[1] for q in home.joints) < 1e-3


def test_a_way_home_that_begins_tilted_is_taken_slowly() -> None:
    spec = settings()
    tilted = POUR.pour.at(np.array([POUR.phases[1][1]]))[0]
    retreat = smooth(tilted, HOME, 3.0)
    path = replace(POUR, retreat=retreat)
    way = way_home(path, retreat.at(np.array([0.8]))[0], spec)
    turning = np.abs(np.diff(leans(way.joints, spec))) / np.diff(way.times)
    assert turning.max() < 1.1 * spec.upright_speed


# ---- how a path was followed


def test_a_constant_lag_is_found_and_taken_out() -> None:
    times = np.arange(0.0, POUR.pour.duration + 0.3, 0.008)
    late = POUR.pour.at(times - 0.047)
    clock = np.minimum(times, POUR.pour.duration)
    samples = [(100.0 + t, tuple(q), c) for t, q, c in zip(times, late, clock, strict=True)]
    executed = executed_path(samples, POUR.pour, settings(), completed=True)
    assert executed.tracking["lag"] == pytest.approx(0.047, abs=5e-4)
    assert executed.tracking["max_angle"] < 1e-3
    assert executed.times[0] == 0.0


@pytest.mark.parametrize("late", [0.0, 1e-12, 1e-9, 3e-6, 8e-6, 2e-5])
def test_no_two_readings_of_a_record_are_read_with_the_same_time(late: float) -> None:
    """A slow pour of the first day was not recorded: its first readings, 0 and some 1e-13 s, were one time on disk."""
    clock = np.arange(-2, 100) * 0.008 + late
    joints = POUR.pour.at(clock)
    samples = [(100.0 + t, tuple(q), max(t, 0.0)) for t, q in zip(clock, joints, strict=True)]
    executed = executed_path(samples, POUR.pour, settings(), completed=True)
    read = unpack(pack(executed))
    assert np.diff(read.times).min() > 0.0
    assert len(read.times) >= len(executed.times) - 1
    assert len(read.joints) == len(read.times)


def test_what_differs_beyond_the_lag_is_told_in_angle_and_at_the_tool() -> None:
    times = np.arange(0.0, POUR.pour.duration + 0.3, 0.008)
    off = POUR.pour.at(times) + np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    clock = np.minimum(times, POUR.pour.duration)
    samples = [(t, tuple(q), c) for t, q, c in zip(times, off, clock, strict=True)]
    tracking = executed_path(samples, POUR.pour, settings(), completed=True).tracking
    assert tracking["max_angle"] == pytest.approx(0.01, rel=0.05)
    assert tracking["rms_angle"] == pytest.approx(0.01 / math.sqrt(6.0), rel=0.05)
    assert 0.004 < tracking["max_tool"] < 0.01  # a hundredth of the distance from the base's axis


def test_missed_packages_show_as_a_gap() -> None:
    times = np.array([t for t in np.arange(0.0, POUR.pour.duration, 0.008) if not 1.0 < t < 1.5])
    samples = [(t, tuple(q), t) for t, q in zip(times, POUR.pour.at(times), strict=True)]
    tracking = executed_path(samples, POUR.pour, settings(), completed=True).tracking
    assert tracking["longest_gap"] == pytest.approx(0.504, abs=0.01)


def test_an_arm_whose_readings_were_lost_has_followed_its_path() -> None:
    """A virtual arm at thirty times its speed next to busy processes: three readings of a whole pour."""
    tilting = np.array([0.0, 0.05, POUR.pour.duration - 0.1])
    samples = [(t, tuple(q), t) for t, q in zip(tilting, POUR.pour.at(tilting), strict=True)]
    executed = executed_path(samples, POUR.pour, settings(), completed=True)
    assert np.abs(executed.joints - POUR.pour.at(executed.times)).max() < 1e-6
    assert np.diff(executed.times).max() < 0.013
    assert executed.tracking["longest_gap"] == pytest.approx(np.diff(tilting).max())
    straight = JointPath(tilting, POUR.pour.at(tilting)).at(executed.times)
    assert np.abs(straight - executed.joints).max() > 1.0, "the readings alone would have told the same motion"


def test_an_arm_that_was_off_its_path_next_to_a_gap_is_not_taken_to_have_followed_it() -> None:
    times = np.array([t for t in np.arange(0.0, POUR.pour.duration, 0.008) if not 0.7 < t < 1.3])
    joints = POUR.pour.at(np.where(times > 1.0, times - 0.6, times))
    samples = [(t, tuple(q), t) for t, q in zip(times, joints, strict=True)]
    executed = executed_path(samples, POUR.pour, settings(), completed=True)
    assert np.diff(executed.times).max() == pytest.approx(0.6, abs=0.02)


# ---- small steps


def test_a_step_of_the_tool_is_straight_and_keeps_its_orientation() -> None:
    from actors.arm.planning.kinematics import pourer_transforms

    spec = settings()
    path = jog_path(spec, HOME, "y", 0.04, 0.08)  # type: ignore[arg-type]
    frames = pourer_transforms(path.joints, spec)
    moved = frames.position - frames.position[0]
    assert moved[-1] == pytest.approx([0.0, 0.04, 0.0], abs=1e-6)
    assert np.abs(moved[:, [0, 2]]).max() < 1e-6
    assert np.abs(frames.rotation - frames.rotation[0]).max() < 1e-6
    speeds = np.linalg.norm(np.diff(frames.position, axis=0), axis=1) / np.diff(path.times)
    assert speeds.max() <= 0.08 * (1.0 + 1e-3)


def test_a_step_into_the_table_is_refused_and_one_out_of_it_is_not() -> None:
    spec = settings()
    high = spec.with_values(cell=spec.cell.with_values(table=2.0))  # the arm is below it already
    jog_path(high, HOME, "z", 0.02, 0.05)  # type: ignore[arg-type]
    with pytest.raises(ArmRefusedError, match="below the table"):
        jog_path(high, HOME, "z", -0.02, 0.05)  # type: ignore[arg-type]


# ---- bytes


def test_packages_may_come_in_pieces_and_sizes_that_can_not_be_are_refused() -> None:
    package = struct.pack(">iB", 9, 16) + b"1234"
    assert split(package + package[:6]) == ([(16, b"1234")], package[:6])
    for size in (-1, 0, 4, 2_000_000):
        with pytest.raises(PrimaryError):
            split(struct.pack(">iB", size, 16))
