"""Dependence of the spillage on the number of particles: nineteen pours, each compared with fine particles.

The pours were chosen before any of them was used to evaluate a change of the solver: seven that showed how much the
spillage depended on the number of particles, and twelve more to cover receivers, speeds and distances. Liquid: 200 mL
of water from a straight glass (R 40 mm, H 100 mm) that turns about its lip from a step, and holds; no surface tension,
little viscosity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import ProfileShape, VesselSpec, cylinder

from .case_result import Figure, Measurement, Series, at_most, reported
from .whole_pours import simulated

LIP_RADIUS = 0.04
POURER = cylinder("beaker", inner_radius=LIP_RADIUS, inner_height=0.10)


def _profile(name: str, wall: float, *inner: tuple[float, float]) -> VesselSpec:
    """A vessel of revolution from millimetres."""
    points = tuple((1e-3 * r, 1e-3 * z) for r, z in inner)
    return VesselSpec(name=name, shape=ProfileShape(unit="m", inner=points, wall=1e-3 * wall, floor=0.004))


TUMBLER = cylinder("tumbler", inner_radius=0.032, inner_height=0.10)
NARROW = _profile("narrow", 3.0, (0, 0), (20, 1), (25, 4), (27, 9), (27, 115))
CONE = _profile("cone", 4.0, (0, 0), (40, 0), (47, 80))
BOWL = _profile("bowl", 4.0, (0, 0), (25, 2), (40, 10), (48, 25), (52, 55))
HEIGHTS = {"tumbler": 0.09, "narrow": 0.11, "cone": 0.06, "bowl": 0.06}
"""Lip above the receiver's rim [m]."""


@dataclass(frozen=True)
class ConvergencePour:
    """One of the pours.

    Attributes:
        receiver: its name; its rim is `HEIGHTS` below the lip.
        speed: of the turn [deg/s].
        distance: of the lip from the receiver's axis [mm].
        angle: at which the turn stops [deg].
    """

    receiver: VesselSpec
    speed: float
    distance: float
    angle: float = 120.0

    @property
    def name(self) -> str:
        """Name in tables."""
        stop = "" if self.angle == 120.0 else f" to {self.angle:g}°"
        return f"{self.receiver.name} {self.speed:g} °/s{stop}, {self.distance:g} mm"

    def task(self, parameters: SimulationParameters, seed: int) -> PourTask:
        """The task of its simulation."""
        scene = Scene(self.name, POURER, self.receiver, Liquid(mass=0.1996))
        return PourTask(scene, self.action(HEIGHTS[self.receiver.name]), parameters, seed)

    def action(self, height: float) -> Action:
        """The action: a step in speed, a hold, no return."""
        return Action(
            angular_velocity=self.speed * DEG,
            max_angle=self.angle * DEG,
            angular_acceleration=None,
            hold_time=1.2,
            return_velocity=None,
            x_offset=LIP_RADIUS + 1e-3 * self.distance,
            height=height,
        )


FOUND = (
    ConvergencePour(TUMBLER, 30, 44, 110),
    ConvergencePour(TUMBLER, 100, 44),
    ConvergencePour(NARROW, 40, 75),
    ConvergencePour(NARROW, 90, 70),
    ConvergencePour(NARROW, 60, 55),
    ConvergencePour(CONE, 30, 90),
    ConvergencePour(CONE, 80, 95),
)
CHOSEN = (
    ConvergencePour(TUMBLER, 20, 60),
    ConvergencePour(TUMBLER, 60, 70),
    ConvergencePour(TUMBLER, 15, 48),
    ConvergencePour(TUMBLER, 45, 60, 95),
    ConvergencePour(BOWL, 40, 95),
    ConvergencePour(BOWL, 110, 85),
    ConvergencePour(BOWL, 25, 65),
    ConvergencePour(CONE, 50, 80),
    ConvergencePour(CONE, 110, 60),
    ConvergencePour(NARROW, 25, 45),
    ConvergencePour(NARROW, 75, 60, 100),
    ConvergencePour(NARROW, 115, 45),
)
POURS = FOUND + CHOSEN


def spillage(
    simulator: PourSimulator,
    pour: ConvergencePour,
    parameters: SimulationParameters,
    seed: int,
    mirrored: bool = False,
) -> tuple[float, float]:
    """Spilled over poured of one pour, whole or by half, and its CPU time [s]."""
    outcome = simulated(simulator, pour.task(parameters, seed), mirrored).outcome
    if outcome.invalid is not None:
        raise ArithmeticError(f"{pour.name}, {parameters.particles} particles: {outcome.invalid}")
    return outcome.spilled / max(outcome.fractions.poured, 1e-9), outcome.cpu_s


FINE: dict[str, tuple[float, float]] = {
    "tumbler 30 °/s to 110°, 44 mm": (0.001, 0.001),
    "tumbler 100 °/s, 44 mm": (0.234, 0.216),
    "narrow 40 °/s, 75 mm": (0.070, 0.083),
    "narrow 90 °/s, 70 mm": (0.034, 0.082),
    "narrow 60 °/s, 55 mm": (0.100, 0.081),
    "cone 30 °/s, 90 mm": (0.221, 0.220),
    "cone 80 °/s, 95 mm": (0.146, 0.149),
    "tumbler 20 °/s, 60 mm": (0.011, 0.011),
    "tumbler 60 °/s, 70 mm": (0.017, 0.019),
    "tumbler 15 °/s, 48 mm": (0.001, 0.000),
    "tumbler 45 °/s to 95°, 60 mm": (0.005, 0.006),
    "bowl 40 °/s, 95 mm": (0.146, 0.154),
    "bowl 110 °/s, 85 mm": (0.144, 0.264),
    "bowl 25 °/s, 65 mm": (0.000, 0.000),
    "cone 50 °/s, 80 mm": (0.028, 0.029),
    "cone 110 °/s, 60 mm": (0.000, 0.013),
    "narrow 25 °/s, 45 mm": (0.029, 0.026),
    "narrow 75 °/s to 100°, 60 mm": (0.021, 0.049),
    "narrow 115 °/s, 45 mm": (0.928, 0.938),
}
"""Spillage of the pours with 10,000 and with 40,000 particles, from `benchmarks/convergence.py`."""

CONVERGED = 0.02
"""Largest change from 10,000 to 40,000 particles of a pour that counts as converged."""


def has_converged(pour: ConvergencePour) -> bool:
    """Whether the pour's spillage hardly changes with more particles. Splashes without surface tension do not converge:
    the finer the particles, the more spray leaves the receiver."""
    fine, finest = FINE[pour.name]
    return abs(finest - fine) <= CONVERGED


TOLERANCES = {500: (0.03, math.inf)}
"""Largest mean and single distance from 10,000 particles by number of particles; for other numbers 0.02 and 0.04."""

QUICK = (FOUND[1], FOUND[4], FOUND[5])
"""The pours of the quick run."""


def convergence(
    simulator: PourSimulator,
    chosen: tuple[ConvergencePour, ...],
    numbers: tuple[int, ...],
    seeds: int,
    parameters: SimulationParameters,
    mirrored: bool = False,
) -> tuple[list[Measurement], Figure]:
    """Spillage at some resolutions, compared with 10,000 particles. Pours that have not converged are only reported.

    Args:
        simulator: of this process.
        chosen: some of `POURS`.
        numbers: of particles, increasing.
        seeds: number of seeds for each.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    measurements: list[Measurement] = []
    curves: list[Series] = []
    spillages = np.array(
        [
            [
                np.mean(
                    [
                        spillage(simulator, pour, parameters.model_copy(update={"particles": n}), seed, mirrored)[0]
                        for seed in range(1, seeds + 1)
                    ]
                )
                for n in numbers
            ]
            for pour in chosen
        ]
    )
    fine, finest = np.array([FINE[pour.name] for pour in chosen]).T
    judged = np.array([has_converged(pour) for pour in chosen])
    for column, n in enumerate(numbers):
        off, further = (np.abs(spillages[:, column] - reference)[judged] for reference in (fine, finest))
        for row, pour in enumerate(chosen):
            measurements.append(
                reported(
                    f"spilled over poured, {pour.name}",
                    float(spillages[row, column]),
                    reference=float(fine[row]),
                    particles=n,
                )
            )
        mean, largest = TOLERANCES.get(n, (0.02, 0.04))
        name = f"distance from 10,000 particles, mean of {len(off)} pours that have converged"
        measurements.append(at_most(name, float(off.mean()), mean, criterion=f"at most {mean:g}", particles=n))
        name = "… and the largest"
        if math.isfinite(largest):
            measurements.append(at_most(name, float(off.max()), largest, criterion=f"at most {largest:g}", particles=n))
        else:
            measurements.append(reported(name, float(off.max()), particles=n))
        measurements.append(reported("distance from 40,000 particles, mean", float(further.mean()), particles=n))
        measurements.append(reported(name, float(further.max()), particles=n))
    shares = tuple((np.arange(judged.sum()) + 1.0) / judged.sum())
    for n, column in zip(numbers, spillages.T, strict=True):
        curves.append(Series(f"{n:,} particles", tuple(np.sort(np.abs(column - fine)[judged]).tolist()), shares))
    figure = Figure(
        ("How far pours are from 10,000 particles",),
        ("distance of spilled / poured",),
        ("share of the pours that are nearer",),
        tuple(curves),
    )
    return measurements, figure


AGREEMENT = 0.003
"""Largest difference of the mean spillage between mirrored and whole pours that was allowed before it was measured."""


def halves(
    simulator: PourSimulator,
    chosen: tuple[ConvergencePour, ...],
    number: int,
    seeds: int,
    parameters: SimulationParameters,
) -> tuple[list[Measurement], None]:
    """Mean spillage of mirrored pours, compared with whole ones.

    Args:
        simulator: of this process.
        chosen: some of `POURS`.
        number: of particles, at least `MIRRORED_FROM`.
        seeds: number of seeds for each, at least 2.
        parameters: θ; its number of particles is replaced.
    """
    theta = parameters.model_copy(update={"particles": number})
    spillages = np.array(
        [
            [
                [spillage(simulator, pour, theta, seed, half)[0] for half in (False, True)]
                for seed in range(1, seeds + 1)
            ]
            for pour in chosen
        ]
    )  # (pour, seed, whole or mirrored)
    means = spillages.mean(axis=1)
    differences = means[:, 1] - means[:, 0]
    errors = np.sqrt((spillages.var(axis=1, ddof=1) / seeds).sum(axis=1))
    scatter = np.sqrt(spillages.var(axis=1, ddof=1).mean(axis=0))
    measurements = [
        reported(f"spilled over poured, {pour.name}", float(mean[1]), reference=float(mean[0]), particles=number)
        for pour, mean in zip(chosen, means, strict=True)
    ]
    largest = int(np.argmax(np.abs(differences)))
    for name, difference in (
        ("difference from the whole pours, mean", differences.mean()),
        ("… and the largest", differences[largest]),
    ):
        size, criterion = float(abs(difference)), f"at most {AGREEMENT:g}"
        measurements.append(at_most(name, size, AGREEMENT, criterion=criterion, particles=number))
    measurements += [
        reported("… its standard error", float(errors[largest]), particles=number),
        reported("scatter between seeds, mirrored over whole", float(scatter[1] / scatter[0]), particles=number),
    ]
    return measurements, None
