"""How spillage depends on the number of particles: three receivers, several seeds. For choosing N, not for judging."""

from __future__ import annotations

import numpy as np

from sim_engine.action import DEG, Action
from sim_engine.liquid import Liquid, SimulationParameters
from sim_engine.pour import PourSimulator
from sim_engine.task import PourTask, Scene
from sim_engine.validation.result import Figure, Measurement, Series, reported
from sim_engine.vessel.spec import ProfileShape, VesselSpec, cylinder

POURER = cylinder("cup", inner_radius=0.04, inner_height=0.10)
BOWL = VesselSpec(
    name="bowl",
    shape=ProfileShape(
        inner=((0.0, 0.0), (0.025, 0.002), (0.040, 0.010), (0.048, 0.025), (0.052, 0.055)), wall=0.004, floor=0.004
    ),
)
RECEIVERS = (
    cylinder("slim cup", inner_radius=0.027, inner_height=0.115),
    cylinder("tumbler", inner_radius=0.032, inner_height=0.10),
    BOWL,
)
ACTION = Action(
    angular_velocity=80 * DEG, max_angle=120 * DEG, hold_time=0.4, return_velocity=None, x_offset=0.105, height=0.05
)


def spillage(
    simulator: PourSimulator, receiver: VesselSpec, particles: int, parameters: SimulationParameters, seed: int
) -> float:
    """Spilled over poured of one pour."""
    scene = Scene("convergence", POURER, receiver, Liquid(mass=0.1996, density=998.0))
    theta = parameters.model_copy(update={"particles": particles})
    outcome = simulator.simulate(PourTask(scene, ACTION, theta, seed)).outcome
    return outcome.spilled / max(outcome.fractions.poured, 1e-9)


def convergence(
    simulator: PourSimulator, numbers: tuple[int, ...], seeds: int, parameters: SimulationParameters
) -> tuple[list[Measurement], Figure]:
    """Spillage over N.

    Args:
        numbers: of particles, increasing.
        seeds: how many each, at least two.
        parameters: θ; its number of particles is replaced.
    """
    measurements: list[Measurement] = []
    curves: list[Series] = []
    finest = numbers[-1]
    for receiver in RECEIVERS:
        table = np.array(
            [[spillage(simulator, receiver, n, parameters, seed) for seed in range(1, seeds + 1)] for n in numbers]
        )
        means, spreads = table.mean(axis=1), table.std(axis=1, ddof=1)
        for n, mean, spread in zip(numbers, means, spreads, strict=True):
            name = f"spilled over poured, {receiver.name}, mean of {seeds} seeds"
            reference = None if n == finest else float(means[-1])
            measurements.append(reported(name, float(mean), reference=reference, particles=n))
            measurements.append(reported("… and their standard deviation", float(spread), particles=n))
        curves.append(Series(receiver.name, tuple(float(n) for n in numbers), tuple(means.tolist())))
    figure = Figure(
        ("Spillage over resolution",), ("number of particles",), ("spilled / poured",), tuple(curves), log_x=True
    )
    return measurements, figure
