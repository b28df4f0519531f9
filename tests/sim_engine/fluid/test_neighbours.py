"""`neighbours`: images of a mirrored scene: half of a symmetric liquid moves as beside the other half."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.validation.container_runs import EMPTY_SPACE, block, run, stir
from sim_engine.action import DEG, Action
from sim_engine.fluid.engine import engine
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder

MIRROR = np.array([1.0, -1.0, 1.0], np.float32)
SCENE = Scene(
    "scene",
    cylinder("cup", inner_radius=0.03, inner_height=0.08),
    cylinder("glass", inner_radius=0.045, inner_height=0.09),
    Liquid(mass=0.15),
)
FAST = Action(angular_velocity=200 * DEG, max_angle=110 * DEG, x_offset=0.1, height=0.12, angular_acceleration=None)
SPIN = 10.0
"""About the direction across the plane [rad/s]."""


@pytest.mark.parametrize(
    ("cohesion", "viscosity", "time", "agreement"),
    [(0.0, 0.0, 0.02, 2e-4), (0.07, 0.0, 0.02, 2e-4), (0.07, 0.2, 0.01, 1e-3)],
)
def test_half_of_a_symmetric_liquid_moves_as_it_does_beside_the_other_half(
    simulator: PourSimulator, cohesion: float, viscosity: float, time: float, agreement: float
) -> None:
    """In every pass over pairs: density, displacements, viscosity of thin and of thick liquids, cohesion. The two
    halves of the whole liquid differ by as much, by rounding."""
    liquid = SCENE.liquid.model_copy(update={"dynamic_viscosity": viscosity} if viscosity else {})
    task = PourTask(replace(SCENE, liquid=liquid), FAST, SimulationParameters(particles=600, cohesion=cohesion), 1)
    half = replace(simulator.setup(task, simulator.prepare(task), 0.0, True), apart=0.0, settling=0.0, gravity=0.0)
    whole = replace(half, positions=np.concatenate([half.positions, half.positions * MIRROR]), mirrored=False)
    fluid, n = engine(), len(half.positions)
    fluid.load([half, whole])
    velocities = fluid.state.v.to_numpy()
    for begin, setup in ((0, half), (2 * n, whole)):
        x, _, z = (setup.positions - half.positions.mean(axis=0)).T
        velocities[begin : begin + len(x)] = SPIN * np.column_stack([z, 0.0 * x, -x])
    fluid.state.v.from_numpy(velocities)
    for scene in (0, 1):
        fluid.advance(time, scene)
    assert fluid.steps(0) == fluid.steps(1) >= 3
    assert np.abs(fluid.particles(0)[0] - fluid.particles(1)[0][:n]).max() < agreement * half.spacing
    assert np.abs(fluid.velocities(0) - fluid.velocities(1)[:n]).max() < agreement  # of 0.5 m/s


@pytest.mark.parametrize(("cohesion", "viscosity"), [(0.0, 0.0), (0.07, 0.0), (0.0, 1e-3)])
def test_momentum_passes_the_plane_as_it_does_within_a_whole_liquid(
    simulator: PourSimulator, cohesion: float, viscosity: float
) -> None:
    """Halves of a cube meet at 0.3 m/s and slide along the plane at 0.2 m/s: pressure stops them, and nothing else."""
    side, theta = np.full(3, 0.02), SimulationParameters(cohesion=cohesion)
    start, d = block(-side, side, 1000, 1, mirrored=True)
    means: dict[bool, np.ndarray] = {}
    for mirrored in (False, True):
        for k, liquid in run(
            start, d, EMPTY_SPACE, theta, np.array([1e-6, 0.03]), gravity=0.0, viscosity=viscosity, mirrored=mirrored
        ):
            if k == 0:
                stir(lambda x: np.column_stack([0.2 + 0.0 * x[:, 0], -0.3 * np.sign(x[:, 1]), 0.0 * x[:, 2]]))
            means[mirrored] = liquid.velocities[liquid.positions[:, 1] > 0.0].mean(axis=0)
    assert means[True][0] == pytest.approx(0.2, abs=2e-3)
    assert means[True] == pytest.approx(means[False], abs=0.01)


def test_spray_that_crosses_the_plane_goes_on_as_its_image(simulator: PourSimulator) -> None:
    d, theta = 5e-3, SimulationParameters(cohesion=0.0, xsph_rate=0.0, smagorinsky_constant=0.0)
    start = np.array([[6.0 * d * k, 0.6 * d, 0.0] for k in range(5)])
    for k, _ in run(start, d, EMPTY_SPACE, theta, np.array([1e-6, 0.1]), gravity=0.0, mirrored=True):
        if k == 0:
            stir(lambda x: np.array([0.0, -0.3, 0.0]) + 0.0 * x)
    positions, _ = engine().particles()  # of the half that is simulated
    assert positions == pytest.approx(start * [1.0, -1.0, 1.0] + [0.0, 0.03, 0.0], abs=2e-3)  # it stirs after a step
    assert engine().velocities()[:, 1] == pytest.approx(0.3, abs=1e-3)


def test_a_thick_liquid_that_turns_within_the_plane_is_held_back_as_little_as_a_whole_one(
    simulator: PourSimulator,
) -> None:
    side, theta, left = np.full(3, 0.02), SimulationParameters(cohesion=0.0), []
    start, d = block(-side, side, 1000, 1, mirrored=True)
    for mirrored in (False, True):
        for k, liquid in run(
            start, d, EMPTY_SPACE, theta, np.array([1e-6, 0.03]), gravity=0.0, viscosity=1e-2, mirrored=mirrored
        ):
            x, v = liquid.positions, liquid.velocities
            if k == 0:
                stir(lambda x: SPIN * np.column_stack([x[:, 2], 0.0 * x[:, 1], -x[:, 0]]))
                begun = SPIN * np.sum(x[:, 0] ** 2 + x[:, 2] ** 2)
        left.append(np.sum(v[:, 0] * x[:, 2] - v[:, 2] * x[:, 0]) / begun)
    assert left[1] == pytest.approx(left[0], abs=0.01)


def test_a_scene_gives_beside_another_one_what_it_gives_alone(simulator: PourSimulator) -> None:
    """Their vessels, poses and cavities differ, and lie one after another in the same tables."""
    other = replace(SCENE, pourer=cylinder("flask", inner_radius=0.04, inner_height=0.12))
    tasks = [PourTask(scene, FAST, SimulationParameters(particles=200), 1) for scene in (SCENE, other)]
    setups = [simulator.setup(task, simulator.prepare(task), 0.0, False) for task in tasks]
    fluid, alone = engine(), []
    for setup in setups:
        fluid.load([setup])
        fluid.advance(0.3)
        alone.append((fluid.particles()[0], fluid.census()))
    fluid.load(setups)
    for scene in (0, 1):
        fluid.advance(0.3, scene)
        assert np.array_equal(fluid.particles(scene)[0], alone[scene][0])
        assert np.array_equal(fluid.census(scene), alone[scene][1])
