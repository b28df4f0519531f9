"""Liquid at rest in a cup: how high it stands, how dense it is inside, and whether it is really at rest.

200 mL in a straight cup of radius 40 mm stand 39.8 mm high. The height is taken twice from the mass centre (which
averages over all particles and needs no notion of a surface), the density from the Voronoi cells of the inner
particles: the solver's own kernel sum would only say that the solver believes itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Voronoi

from sim_engine.fill import fill, spacing
from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquid import SimulationParameters
from sim_engine.pour import SETTLING
from sim_engine.validation.result import Figure, Measurement, Series, at_most, within
from sim_engine.validation.stage import Container, run
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.spec import cylinder

Floats = NDArray[np.float64]

RADIUS = 0.04
VOLUME = 200e-6
HEIGHT = VOLUME / (math.pi * RADIUS**2)
CUP = cylinder("cup", inner_radius=RADIUS, inner_height=0.10)

INNER = 2.0
"""A particle is an inner one that many spacings from walls and surface: the kernel's support."""

WINDOW = np.arange(1.0, 1.201, 0.02)
"""What is judged is a mean over these times [s]."""


def mean_density(points: Floats, inner: NDArray[np.bool_], d: float) -> float:
    """ρ/ρ₀ of some of the particles: what each stands for, d³, over the mean volume of their Voronoi cells.

    Args:
        points: all of them, (N, 3) [m].
        inner: which ones to take, (N,); their cells must be closed by neighbours.
        d: spacing [m].
    """
    cells = Voronoi(points)
    volumes = []
    for point in np.flatnonzero(inner):
        region = cells.regions[cells.point_region[point]]
        if -1 not in region:
            volumes.append(ConvexHull(cells.vertices[region]).volume)
    return d**3 / float(np.mean(volumes)) if volumes else math.nan


def at_rest(particles: int, parameters: SimulationParameters, seed: int = 1) -> tuple[list[Measurement], Figure]:
    """Fill the cup, let it stand for a second, look at it for a fifth.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        seed: of the initial positions.
    """
    from sim_engine.fluid.engine import engine

    vessel = build_vessel(CUP)
    floor = vessel.inner_floor
    d = spacing(VOLUME, particles)
    start = fill(vessel, VOLUME, particles, seed, parameters.wall_distance).astype(float)
    early = np.arange(0.02, 1.0, 0.02)
    times = np.concatenate([early, WINDOW])
    energy, heights, densities = [], [], []
    for k in run(start, d, Container.of(vessel), parameters, times):
        fluid = engine()
        energy.append(0.5 * float(np.mean(np.sum(fluid.velocities().astype(float) ** 2, axis=1))) / (GRAVITY * HEIGHT))
        if k < len(early):
            continue
        x = fluid.particles()[0].astype(float)
        heights.append(2.0 * float(np.mean(x[:, 2] - floor)))
        if (k - len(early)) % 5 == 0:
            depth = x[:, 2] - floor
            inner = (np.hypot(x[:, 0], x[:, 1]) < RADIUS - INNER * d) & (depth > INNER * d)
            inner &= depth < HEIGHT - INNER * d
            densities.append(mean_density(x, inner, d))
    measurements = [
        within(
            "height of the surface",
            float(np.mean(heights)),
            HEIGHT,
            0.02 * HEIGHT,
            unit="m",
            criterion="within 2 %",
            particles=particles,
        ),
        within(
            "density inside, by Voronoi cells",
            float(np.mean(densities)),
            1.0,
            0.015,
            criterion="within 1.5 %",
            particles=particles,
        ),
        at_most(
            "kinetic energy per mass after 1 s, over g·H",
            float(np.mean(energy[len(early) :])),
            1e-4,
            criterion="below 0.0001",
            particles=particles,
        ),
    ]
    figure = Figure(
        titles=("Coming to rest",),
        x_labels=("time [s]",),
        y_labels=("log₁₀ of kinetic energy per mass over g·H",),
        series=(
            Series(f"{particles:,} particles", tuple(times.tolist()), tuple(np.log10(energy).tolist())),
            Series("limit", (1.0, float(times[-1])), (-4.0, -4.0), "reference"),
        ),
    )
    return measurements, figure


SLIM_RADIUS, SLIM_VOLUME = 0.027, 240e-6
SLIM_HEIGHT = SLIM_VOLUME / (math.pi * SLIM_RADIUS**2)
SLIM_CUP = cylinder("slim cup", inner_radius=SLIM_RADIUS, inner_height=0.115)


def tall_column(particles: int, parameters: SimulationParameters) -> list[Measurement]:
    """A slim cup that is nearly full stands still for a second: many layers of particles, where pressure adds up.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
    """
    from sim_engine.fluid.engine import engine
    from sim_engine.outcome import ParticleState

    vessel = build_vessel(SLIM_CUP)
    d = spacing(SLIM_VOLUME, particles)
    start = fill(vessel, SLIM_VOLUME, particles, 1, parameters.wall_distance).astype(float)
    heights = []
    for _ in run(start, d, Container.of(vessel), parameters, WINDOW, settling=SETTLING):
        x, homes = engine().particles()
        inside = homes == ParticleState.IN_POURER
        heights.append(2.0 * float(np.mean(x[inside, 2].astype(float)) - vessel.inner_floor))
    layers = f"{SLIM_HEIGHT / d:.0f} layers"
    return [
        within(
            f"still in the cup after a second, {layers}",
            float(engine().census()[ParticleState.IN_POURER] / particles),
            1.0,
            0.0,
            criterion="all of it",
            particles=particles,
        ),
        within(
            f"height of the surface, {layers}",
            float(np.mean(heights)),
            SLIM_HEIGHT,
            0.02 * SLIM_HEIGHT,
            unit="m",
            criterion="within 2 %",
            particles=particles,
        ),
    ]
