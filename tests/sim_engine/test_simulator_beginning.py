"""`simulator`: when a simulation has to begin."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine import simulator as pour_module
from sim_engine.action import DEG, Action
from sim_engine.hydrostatics import level
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.motion import plan_motion
from sim_engine.scene import PourTask, SampledMotion, Scene
from sim_engine.simulator import (
    CALM,
    FREEBOARD,
    SLICE,
    STEP,
    PourSimulator,
    TimeLoop,
    calm_until,
    liquid_velocity,
    wave_height,
)
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.hypothesis_examples import examples

SCENE = Scene(
    "calm",
    cylinder("cup", inner_radius=0.04, inner_height=0.1),
    cylinder("glass", inner_radius=0.045, inner_height=0.09),
    Liquid(mass=0.2),
)
POURER, RECEIVER = build_vessel(SCENE.pourer), build_vessel(SCENE.receiver)
VOLUME = SCENE.liquid.volume


def action(speed: float, max_angle: float = 120.0) -> Action:
    return Action(
        angular_velocity=speed * DEG,
        x_offset=0.08,
        height=0.11,
        max_angle=max_angle * DEG,
        angular_acceleration=None,
        hold_time=1.0,
        return_velocity=None,
    )


def begin(speed: float, max_angle: float = 120.0) -> float:
    return calm_until(plan_motion(SCENE, action(speed, max_angle), POURER, RECEIVER), POURER, VOLUME)


def test_a_simulation_begins_between_two_slices() -> None:
    # A begin within a slice would be rounded to another time than the liquid was laid for.
    motion = plan_motion(SCENE, action(20.0), POURER, RECEIVER)
    task = PourTask(SCENE, action(20.0), SimulationParameters(), seed=0)
    start = calm_until(motion, POURER, VOLUME)
    assert start > 0.0
    assert TimeLoop(task, motion, start).clock == pytest.approx(start)
    with pytest.raises(ValueError, match="multiple of"):
        TimeLoop(task, motion, start + 0.5 * SLICE)


@settings(max_examples=examples(25), deadline=None)
@given(st.floats(5.0, 180.0))
def test_nothing_is_near_the_lip_when_the_simulation_begins(speed: float) -> None:
    start = begin(speed)
    assert start >= 0.0
    assert start / STEP == pytest.approx(round(start / STEP))
    motion = plan_motion(SCENE, action(speed), POURER, RECEIVER)
    if start > 0.0:
        tilt = float(motion.tilt(np.array([start]))[0])
        assert level(POURER, VOLUME, tilt) < -FREEBOARD * POURER.opening_radius


def test_slow_pours_begin_late_and_fast_ones_at_once() -> None:
    assert begin(30.0) > 1.2
    assert begin(15.0) > 2.0 * begin(30.0)
    assert begin(120.0) == 0.0


def test_a_motion_that_never_spills_ends_before_it_begins_late() -> None:
    motion = plan_motion(SCENE, action(10.0, max_angle=46.0), POURER, RECEIVER)
    assert 0.0 <= calm_until(motion, POURER, VOLUME) <= motion.duration


def test_a_sudden_start_raises_the_wave_of_the_first_mode() -> None:
    # u / ω with ω² = 1.84 g / R: 0.1 m/s in a cup of 40 mm makes 4.7 mm
    frequency = math.sqrt(1.841 * 9.81 / 0.04)
    at_once = np.tile([0.1, 0.0, 0.0], (100, 1))
    assert wave_height(at_once, 0.02, 0.04) == pytest.approx(0.1 / frequency)
    times = 0.001 * np.arange(2000)
    steadily = np.column_stack([0.5 * times, 0.0 * times, 0.0 * times])
    assert wave_height(steadily, 0.001, 0.04) == pytest.approx(2.0 * 0.5 / frequency**2, rel=0.02)
    # up and down does not slosh, and a slow ramp hardly does
    assert wave_height(at_once[:, ::-1], 0.02, 0.04) == 0.0
    gently = np.column_stack([0.05 * np.minimum(times, 1.0), 0.0 * times, 0.0 * times])
    assert wave_height(gently, 0.001, 0.04) < CALM * 0.04


def test_a_ramp_of_the_arm_does_not_keep_a_slow_pour_from_beginning_late() -> None:
    ramped = dataclasses.replace(action(30.0), angular_acceleration=1000.0 * DEG)
    assert calm_until(plan_motion(SCENE, ramped, POURER, RECEIVER), POURER, VOLUME) > 1.2


def test_the_liquid_moves_off_with_the_cup() -> None:
    motion = plan_motion(SCENE, action(30.0), POURER, RECEIVER)
    velocity = liquid_velocity(motion, POURER, 1.0)
    pivot_to_middle = math.hypot(0.04, 0.05)
    assert np.linalg.norm(velocity) == pytest.approx(30 * DEG * pivot_to_middle, rel=0.05)
    assert velocity[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_leaving_the_beginning_out_changes_the_pour_by_less_than_seeds_do(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = PourSimulator()
    tasks = [PourTask(SCENE, action(30.0), SimulationParameters(particles=1000), seed) for seed in (1, 2, 3)]
    times = np.arange(1.8, 3.6, 0.1)

    def left() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        runs = [simulator.simulate(task).outcome for task in tasks]
        return np.array([1.0 - np.interp(times, o.curve_times, o.curve_poured) for o in runs])

    late = left()
    monkeypatch.setattr(pour_module, "calm_until", lambda *_: 0.0)
    whole = left()
    assert np.max(np.abs(late.mean(axis=0) - whole.mean(axis=0))) < 0.02


def test_the_tremor_of_an_arm_that_was_read_back_does_not_move_the_begin() -> None:
    motion = plan_motion(SCENE, action(40.0), POURER, RECEIVER)
    times = np.arange(0.0, motion.duration, 0.008)
    poses = motion.sample(times)
    poses[:, :3] += np.random.default_rng(1).normal(0.0, 2e-5, (len(times), 3))
    poses[:, 5] += np.random.default_rng(2).normal(0.0, 5e-5, len(times))
    done = SampledMotion(times, poses)
    planned = calm_until(motion, POURER, VOLUME)
    assert planned > 0.0
    assert calm_until(done, POURER, VOLUME) == pytest.approx(planned, abs=2.5 * STEP)
