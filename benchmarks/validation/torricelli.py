"""Torricelli: a cup drains through a hole in its bottom, T = (A / (C_d A₀)) √(2H / g), with C_d between 0.61 and 1.

The cup stands closed until the liquid is at rest; then the hole is opened. √V falls linearly with time, and its slope
between 0.8 and 0.2 of the load gives C_d, independent of the start of the flow and of the last drops.
"""

from __future__ import annotations

import math

import numpy as np

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import SimulationParameters

from .case_result import Figure, Measurement, Series, within
from .container_runs import block, holed_cup, run
from .hydrostatic_cases import HEIGHT, RADIUS, VOLUME

HOLE = 0.010
FLOOR = 0.003
GRID = 0.001
FIT = (0.8, 0.2)
SHARP = 0.61
"""Contraction of a sharp-edged hole's jet: the lower bound of C_d; the upper one is 1."""

RATIO = (RADIUS / HOLE) ** 2
FASTEST = RATIO * math.sqrt(2.0 * HEIGHT / GRAVITY)
"""Drain time for C_d = 1: 1.44 s."""


def settled(
    particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], float]:
    """Positions of a load that has come to rest in the closed cup, (N, 3) [m], and the spacing [m]."""
    d = float(np.cbrt(VOLUME / particles))
    half = np.array([RADIUS, RADIUS, 0.0])
    tall = 1.4 * HEIGHT
    count = round((2 * RADIUS) ** 2 * tall / d**3)
    lattice, _ = block(-half, half + np.array([0.0, 0.0, tall]), count, 1, mirrored)
    places = lattice[np.hypot(lattice[:, 0], lattice[:, 1]) < RADIUS - 0.45 * d]
    places = places[np.argsort(places[:, 2], kind="stable")][:particles]
    closed = holed_cup(RADIUS, 0.10, 0.0, FLOOR, GRID)
    ((_, liquid),) = run(places, d, closed, parameters, np.array([0.8]), mirrored=mirrored)
    return liquid.positions, d


def torricelli(
    particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[list[Measurement], list[Series], float]:
    """Drain the cup.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.

    Returns:
        Measurements, curves and C_d.
    """
    start, d = settled(particles, parameters, mirrored)
    times = np.arange(0.02, 2.0 * FASTEST, 0.02)
    left = np.empty(len(times))
    cup = holed_cup(RADIUS, 0.10, HOLE, FLOOR, GRID)
    for k, liquid in run(start, d, cup, parameters, times, spill_level=-0.02, mirrored=mirrored):
        left[k] = np.mean(liquid.positions[:, 2] > 0.0)
    fitted = (left <= FIT[0]) & (left >= FIT[1])
    slope = float(np.polyfit(times[fitted], np.sqrt(left[fitted]), 1)[0]) if fitted.sum() > 2 else math.nan
    duration = -1.0 / slope
    discharge = FASTEST / duration
    measurements = [
        within(
            "time to drain",
            duration,
            (FASTEST + FASTEST / SHARP) / 2.0,
            (FASTEST / SHARP - FASTEST) / 2.0,
            unit="s",
            criterion=f"C_d from {SHARP:g} to 1: {FASTEST:.2f} to {FASTEST / SHARP:.2f} s",
            particles=particles,
        )
    ]
    curve = Series(f"{particles:,} particles, C_d {discharge:.2f}", tuple(times.tolist()), tuple(left.tolist()))
    return measurements, [curve], discharge


def steadiness(discharges: dict[int, float]) -> Measurement:
    """Change of C_d from the coarsest to the finest resolution."""
    coarse, fine = min(discharges), max(discharges)
    change = abs(discharges[fine] / discharges[coarse] - 1.0)
    name = f"change of C_d from N = {coarse:,}"
    return within(name, change, 0.0, 0.10, criterion="at most 10 %", particles=fine)


def torricelli_figure(curves: list[Series]) -> Figure:
    """Curves of all resolutions between the two bounds."""
    bounds = []
    for discharge in (1.0, SHARP):
        t = np.linspace(0.0, FASTEST / discharge, 60)
        left = (1.0 - t * discharge / FASTEST) ** 2
        bounds.append(Series(f"theory, C_d {discharge:g}", tuple(t.tolist()), tuple(left.tolist()), "reference"))
    return Figure(("Draining through a hole",), ("time [s]",), ("left in the cup",), (*curves, *bounds))
