"""`simulator`: the simulator of pours: one after another in one process."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from actors.runtime.child_process import child_environment
from sim_engine.action import DEG, Action
from sim_engine.errors import SimulationCancelled
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder
from tests.support.waiting import PATIENCE

SCENE = Scene(
    "batch",
    cylinder("cup", inner_radius=0.04, inner_height=0.1),
    cylinder("glass", inner_radius=0.045, inner_height=0.09),
    Liquid(mass=0.2),
)
OTHER = dataclasses.replace(SCENE, name="other", receiver=cylinder("jar", inner_radius=0.055, inner_height=0.07))


def task(seed: int, *, speed: float = 120.0, particles: int = 300, scene: Scene = SCENE, **theta: float) -> PourTask:
    action = Action(angular_velocity=speed * DEG, x_offset=0.08, height=0.11, max_angle=110 * DEG, hold_time=0.3)
    return PourTask(scene, action, SimulationParameters(particles=particles, **theta), seed)


@pytest.fixture(scope="module")
def simulator() -> PourSimulator:
    return PourSimulator()


def test_a_pour_is_bit_for_bit_the_same_whatever_was_poured_before(simulator: PourSimulator) -> None:
    tasks = [
        task(1),
        task(2, speed=60.0, xsph_rate=8.0),
        task(3, particles=450, cohesion=0.06),
        task(4, scene=OTHER, friction=0.2),
    ]
    first, again = (
        [dataclasses.replace(simulator.simulate(one).outcome, cpu_s=0.0) for one in order]
        for order in (tasks, tasks[::-1])
    )
    assert first == again[::-1]
    assert len({outcome.received for outcome in first}) > 1


def test_a_pour_can_be_given_up(simulator: PourSimulator) -> None:
    asked = 0

    def enough() -> bool:
        nonlocal asked
        asked += 1
        return asked > 3

    with pytest.raises(SimulationCancelled):
        simulator.simulate(task(1), cancelled=enough)
    assert simulator.simulate(task(1)).outcome.invalid is None


def test_a_scene_larger_than_the_pool_says_so(simulator: PourSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    from sim_engine.fluid.engine import engine

    simulator.simulate(task(1))
    monkeypatch.setattr(engine(), "pool", 200)
    with pytest.raises(ValueError, match="300 particles; at most 200"):
        simulator.simulate(task(1))


def test_recorded_frames_show_the_liquid_from_the_start_of_a_slow_pour(simulator: PourSimulator) -> None:
    slow = dataclasses.replace(task(1, speed=20.0), frame_rate=5.0)
    run = simulator.simulate(slow)
    frames = run.frames
    assert frames is not None
    assert frames.times[0] == 0.0
    assert np.all(np.diff(frames.times) > 0.0)
    assert np.max(np.diff(frames.times)) < 0.3
    # the mass centre neither jumps nor leaves the turning cup
    centres = np.array([p.mean(axis=0) for p in frames.positions])
    assert np.max(np.linalg.norm(np.diff(centres[:10], axis=0), axis=1)) < 0.02
    assert run.outcome == dataclasses.replace(simulator.simulate(task(1, speed=20.0)).outcome, cpu_s=run.outcome.cpu_s)


def test_engine_ends_cleanly_without_having_simulated() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from sim_engine.simulator import PourSimulator; PourSimulator().close()"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )
    replaced = "Taichi can't be loaded without " in done.stderr  # one line, where its libraries are missing
    assert (done.returncode, len(done.stderr.splitlines())) == (0, int(replaced)), done.stderr
