"""Test costs for optimisers: two standard functions, and four that resemble spillage over actions.

`optimiser_rivals.py` imports this module with only numpy and scipy installed, so it imports nothing of Decant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

Floats = np.ndarray[Any, np.dtype[np.float64]]

INITIAL = 5
"""Evaluations at scrambled Sobol points before an optimiser is queried; the same points for all optimisers."""


@dataclass(frozen=True)
class Coordinate:
    """One axis of a problem: bounds, scale, integer or not."""

    lower: float
    upper: float
    log: bool = False
    integer: bool = False

    def value(self, unit: float) -> float:
        """Return the value at a position in the unit interval."""
        u = min(max(float(unit), 0.0), 1.0)
        value = self.lower * (self.upper / self.lower) ** u if self.log else self.lower + u * (self.upper - self.lower)
        return float(round(value)) if self.integer else min(max(value, self.lower), self.upper)

    def unit(self, value: float) -> float:
        """Inverse of `value`."""
        if self.log:
            return math.log(value / self.lower) / math.log(self.upper / self.lower)
        return (value - self.lower) / (self.upper - self.lower)


REAL = Coordinate(0.0, 1.0)


@dataclass(frozen=True)
class Problem:
    """A cost function, its noise, and its budget of evaluations.

    Attributes:
        coordinates: the axes.
        budget: total evaluations.
        width: half axes of the valley without spillage, in units of the cube; 0: a standard function.
        about: description for the page.
    """

    name: str
    coordinates: tuple[Coordinate, ...]
    budget: int
    about: str
    width: float = 0.0

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return len(self.coordinates)


PROBLEMS = (
    Problem("branin", (REAL,) * 2, 20, "Branin, noise-free"),
    Problem("hartmann6", (REAL,) * 6, 25, "Hartmann 6-D, noise-free"),
    Problem("spill2", (REAL,) * 2, 15, "2-D, nothing spilled on 6 % of the actions, all on 58 %", 0.13),
    Problem("narrow2", (REAL,) * 2, 15, "2-D, nothing spilled on 1 %, all on 70 %", 0.055),
    Problem("spill4", (REAL,) * 4, 25, "4-D, nothing spilled on 2 %, all on 76 %", 0.25),
    Problem(
        "mixed3",
        (REAL, Coordinate(1, 8, integer=True), Coordinate(1e-3, 1.0, log=True)),
        20,
        "3-D with an integer and a log axis, nothing spilled on 2 %, all on 71 %",
        0.17,
    ),
)
BY_NAME = {problem.name: problem for problem in PROBLEMS}

_A = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)
_P = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


class Instance:
    """One instance of a problem: the seed draws the valley's position and shape, the first points and the noise.

    Spillage-like costs are 0 in an ellipsoid, rise steeply around it and saturate at 1: 1 − exp(−(8 w (r − 1))^1.5),
    where w is the valley's width and r = 1 on its edge. An observation scatters by 0.01 + 0.12 of its cost, and is
    clipped to [0, 1].

    Source: Branin and Hartmann as in Surjanovic & Bingham, Virtual Library of Simulation Experiments.
    """

    def __init__(self, problem: Problem, seed: int) -> None:
        self.problem, self.seed = problem, seed
        rng = np.random.default_rng([seed, problem.dimension, problem.budget])
        d = problem.dimension
        self._centre = rng.uniform(0.2, 0.8, d)
        self._turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
        stretch = np.exp(rng.uniform(-0.5, 0.5, d))
        self._half_axes = problem.width * stretch / np.exp(np.mean(np.log(stretch)))
        self.initial: Floats = qmc.Sobol(d, scramble=True, rng=rng).random(8)[:INITIAL]
        self._noise = rng.standard_normal(problem.budget)

    def true(self, unit: Floats) -> float:
        """Return noise-free regret at a point of the unit cube (dimension,): 0 at best."""
        coordinates = self.problem.coordinates
        u = np.clip(np.asarray(unit, dtype=float), 0.0, 1.0)
        if self.problem.name == "branin":
            x, y = 15 * u[0] - 5, 15 * u[1]
            bent = y - 5.1 * x**2 / (4 * math.pi**2) + 5 * x / math.pi - 6
            return float(bent**2 + 10 * (1 - 1 / (8 * math.pi)) * math.cos(x) + 10 - 0.397887)
        if self.problem.name == "hartmann6":
            return float(3.32237 - np.array([1.0, 1.2, 3.0, 3.2]) @ np.exp(-(_A * (u - _P) ** 2).sum(axis=1)))
        u = np.array([c.unit(c.value(x)) for c, x in zip(coordinates, u, strict=True)])
        centre = np.array([c.unit(c.value(x)) for c, x in zip(coordinates, self._centre, strict=True)])
        radius = float(np.linalg.norm(self._turn @ (u - centre) / self._half_axes))
        return 1.0 - math.exp(-((8.0 * self.problem.width * max(radius - 1.0, 0.0)) ** 1.5))

    def observe(self, unit: Floats, index: int) -> float:
        """Return the observation of evaluation `index` at a point of the unit cube (dimension,)."""
        cost = self.true(unit)
        if not self.problem.width:
            return cost
        return min(max(cost + (0.01 + 0.12 * cost) * float(self._noise[index]), 0.0), 1.0)
