"""Many pours in one call, and where they run."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from actors.runtime.child_process import child_environment
from sim_engine.action import DEG, Action
from sim_engine.errors import InvalidSceneError, SimulationCancelled
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


def test_a_batch_pours_what_each_pour_does_alone_bit_for_bit(simulator: PourSimulator) -> None:
    tasks = [
        task(1),
        task(2, speed=60.0, xsph_rate=8.0),
        task(3, particles=450, cohesion=0.06),
        task(4, scene=OTHER, friction=0.2),
        task(1),
    ]
    together = [run.outcome for run in simulator.simulate_many(tasks)]
    for asked, outcome in zip(tasks, together, strict=True):
        alone = simulator.simulate(asked).outcome
        same = {"cpu_s": 0.0}
        assert dataclasses.replace(outcome, **same) == dataclasses.replace(alone, **same)
    assert dataclasses.replace(together[0], cpu_s=0.0) == dataclasses.replace(together[4], cpu_s=0.0)
    assert len({outcome.received for outcome in together}) > 1


def test_more_pours_than_fit_into_memory_at_once_are_split(
    simulator: PourSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sim_engine.fluid.engine import FluidEngine

    loads: list[int] = []
    load = FluidEngine.load

    def counted(self: FluidEngine, setups: list[object]) -> None:
        loads.append(len(setups))
        load(self, setups)  # type: ignore[arg-type]

    simulator.simulate(task(1))
    monkeypatch.setattr(FluidEngine, "load", counted)
    from sim_engine.fluid.engine import engine

    monkeypatch.setattr(engine(), "pool", 700)
    outcomes = [run.outcome for run in simulator.simulate_many([task(seed) for seed in (1, 2, 3)])]
    assert loads == [2, 1]
    assert [outcome.seed for outcome in outcomes] == [1, 2, 3]


def test_a_bad_pour_refuses_the_whole_batch_before_anything_is_simulated(simulator: PourSimulator) -> None:
    bad = task(2)
    bad = dataclasses.replace(bad, action=dataclasses.replace(bad.action, x_offset=0.0, height=0.001))
    with pytest.raises(InvalidSceneError):
        simulator.simulate_many([task(1), bad])


def test_a_batch_can_be_given_up(simulator: PourSimulator) -> None:
    asked = 0

    def enough() -> bool:
        nonlocal asked
        asked += 1
        return asked > 3

    with pytest.raises(SimulationCancelled):
        simulator.simulate_many([task(1), task(2)], cancelled=enough)
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
    assert (done.returncode, done.stderr) == (0, "")
