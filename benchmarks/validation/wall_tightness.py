"""Tightness of walls: in random pours out of and into thin-walled vessels, at any speed, nothing may cross a wall.

Draws: walls of 1 to 4 mm, straight and conical vessels, 15 to 180 °/s with accelerations up to a step, 500 particles
and more, tilts to 170°. If the vessels touch, or a wall is too thin for its vessel's size, the draw is not a pour and
is repeated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim_engine.action import DEG, Action
from sim_engine.errors import InvalidSceneError
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import PourOutcome
from sim_engine.scene import MIRRORED_FROM, PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import ProfileShape, VesselError, VesselSpec
from sim_engine.vessel.vessel import build_vessel

from .case_result import Measurement, at_most, reported
from .whole_pours import simulated

ATTEMPTS = 40
"""Largest number of draws until one is a possible pour."""


@dataclass(frozen=True)
class Escapes:
    """Results of random pours: their number, and those that leaked or failed."""

    pours: int
    particles: int
    escaped: int
    invalid: int
    unaccounted: float


def random_vessel(rng: np.random.Generator, name: str, radius: tuple[float, float]) -> VesselSpec:
    """A straight or conical cup with a wall of 1 to 4 mm."""
    bottom = float(rng.uniform(*radius))
    top = bottom * float(rng.uniform(1.0, 1.4))
    height = float(rng.uniform(0.06, 0.12))
    shape = ProfileShape(
        unit="m",
        inner=((0.0, 0.0), (bottom, 0.0), (top, height)),
        wall=float(np.exp(rng.uniform(np.log(1e-3), np.log(4e-3)))),
        floor=float(np.exp(rng.uniform(np.log(1e-3), np.log(4e-3)))),
    )
    return VesselSpec(name=name, shape=shape)


def random_task(rng: np.random.Generator, least_particles: int, most_particles: int) -> PourTask:
    """A pour, in which the vessels may touch."""
    pourer = random_vessel(rng, "thin cup", (0.025, 0.04))
    receiver = random_vessel(rng, "thin glass", (0.03, 0.045))
    load = float(rng.uniform(0.3, 0.8)) * build_vessel(pourer).capacity
    action = Action(
        angular_velocity=float(rng.uniform(15, 180)) * DEG,
        angular_acceleration=None if rng.random() < 0.3 else float(rng.uniform(200, 3000)) * DEG,
        max_angle=float(rng.uniform(80, 170)) * DEG,
        hold_time=0.3,
        return_velocity=float(rng.uniform(60, 180)) * DEG,
        x_offset=float(rng.uniform(0.06, 0.14)),
        height=float(rng.uniform(0.01, 0.15)),
    )
    parameters = SimulationParameters(
        particles=round(math.exp(rng.uniform(math.log(least_particles), math.log(most_particles)))),
        cohesion=float(rng.uniform(0.0, 0.1)),
        xsph_rate=float(rng.uniform(0.0, 5.0)),
        friction=float(rng.uniform(0.0, 0.2)),
    )
    scene = Scene("random", pourer, receiver, Liquid(mass=load * 998.0, density=998.0))
    return PourTask(scene, action, parameters, int(rng.integers(1 << 30)))


def _one(rng: np.random.Generator, most_particles: int, mirrored: bool) -> PourOutcome:
    for _ in range(ATTEMPTS):
        try:
            task = random_task(rng, MIRRORED_FROM if mirrored else 500, most_particles)
            # One simulator each: hundreds of vessels must not stay in memory.
            return simulated(PourSimulator(), task, mirrored).outcome
        except (VesselError, InvalidSceneError):
            continue
    raise RuntimeError(f"{ATTEMPTS} draws, and in none could the vessels be kept apart")


def random_pours(pours: int, most_particles: int, seed: int = 1, mirrored: bool = False) -> Escapes:
    """Simulate random pours.

    Args:
        pours: number of pours.
        most_particles: N is drawn between 500, or `MIRRORED_FROM`, and this, uniformly in its logarithm.
        seed: of the draws.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    outcomes = [_one(np.random.default_rng([seed, k]), most_particles, mirrored) for k in range(pours)]
    sums = [o.received + o.spilled + o.retained + o.in_flight + o.escaped for o in outcomes]
    return Escapes(
        pours,
        sum(o.particles for o in outcomes),
        sum(round(o.escaped * o.particles) for o in outcomes),
        sum(o.invalid is not None for o in outcomes),
        max(abs(s - 1.0) for s in sums),
    )


def walls(pours: int, most_particles: int, seed: int = 1, mirrored: bool = False) -> list[Measurement]:
    """Random pours with their criteria."""
    pours_made = random_pours(pours, most_particles, seed, mirrored)
    return [
        reported(f"particles in {pours} random pours", pours_made.particles, particles=most_particles),
        at_most("escaped particles", pours_made.escaped, 0.0, criterion="none", particles=most_particles),
        at_most("pours that failed", pours_made.invalid, 0.0, criterion="none", particles=most_particles),
        at_most(
            "volume unaccounted for, largest", pours_made.unaccounted, 1e-9, criterion="none", particles=most_particles
        ),
    ]
