"""The inner profile of a vessel of revolution from several kinds of evidence, with its uncertainty.

The radius r(z) at heights between floor and rim is a Gaussian process. Each piece of evidence constrains it with a
standard deviation: a radius at a height, the volume below a level, the volume that a tilted vessel retains. The profile
is the most likely one given all of them (Gauss–Newton); its covariance is that of the linearised problem.
`find_outline` returns a `FittedOutline`.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2 and 3.4 (Laplace).

Limitations: a surface of revolution whose inner wall nowhere turns back below itself; the floor is flat or rises
towards the wall as r(z) does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.profile import volume
from sim_engine.vessel.shapes import NARROWEST, ProfileShape, VesselError

Floats = NDArray[np.float64]

NODES = 48
"""Number of heights at which the radius is estimated."""

CROWDING = 1.5
"""Power by which they are concentrated near the floor, where profiles bend."""

LENGTHS = (0.15, 0.4, 1.2)
"""Length scales of a profile's changes, as fractions of the height; the evidence selects one."""

BENDS = (0.01, 0.06, 0.3)
"""Standard deviations of the radius about its mean, as fractions of that mean; likewise."""

LEVEL = 0.5
"""Prior standard deviation of that mean, as a fraction of the first guess."""

KEPT = 0.9
"""Fraction of the radii's variance that a vessel's file keeps."""

ITERATIONS = 30


class Evidence(Protocol):
    """A measurement of a vessel."""

    @property
    def name(self) -> str:
        """Name in messages: 'callipers'."""
        ...

    @property
    def observed(self) -> Floats:
        """The measured values, shape (n,)."""
        ...

    @property
    def deviations(self) -> Floats:
        """Standard deviations of the values, shape (n,)."""
        ...

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """The values predicted from a profile, shape (n,).

        Args:
            heights: above the inner floor, ascending from 0 to the rim, shape (k,) [m].
            radii: at these heights, shape (k,) [m].
        """
        ...


@dataclass(frozen=True)
class EvidenceFit:
    """Agreement of one piece of evidence with the fitted profile.

    Attributes:
        count: of measurements.
        rms: of the differences, in standard deviations of the measurements; about 1 if these were stated correctly.
    """

    name: str
    count: int
    rms: float


@dataclass(frozen=True)
class FittedOutline:
    """An inner profile with its uncertainty.

    Attributes:
        heights: above the inner floor, from 0 to the rim, shape (k,) [m].
        radii: there, shape (k,) [m].
        covariance: of the radii, shape (k, k) [m²].
        wall, floor: thickness [m].
        fits: of all evidence.
        height_deviation: standard deviation of the height of the rim [m].
        likelihood: logarithm of the probability of the measurements, up to a constant that depends on their deviations.
    """

    heights: Floats
    radii: Floats
    covariance: Floats
    wall: float
    floor: float
    fits: tuple[EvidenceFit, ...]
    height_deviation: float = 0.0
    likelihood: float = 0.0

    @property
    def deviations(self) -> Floats:
        """Standard deviations of the radii, shape (k,) [m]."""
        result: Floats = np.sqrt(np.diag(self.covariance))
        return result

    @property
    def capacity(self) -> float:
        """Brimful volume [m³]."""
        return float(volume_below(self.heights, self.radii, self.heights[-1:])[0])

    @property
    def capacity_deviation(self) -> float:
        """Standard deviation of the brimful volume [m³]."""
        slope = _jacobian(lambda radii: volume_below(self.heights, radii, self.heights[-1:]), self.radii)[0]
        rim = np.pi * self.radii[-1] ** 2 * self.height_deviation
        return float(np.sqrt(slope @ self.covariance @ slope + rim**2))

    @property
    def radius_deviation(self) -> float:
        """Standard deviation of the radius, mean over the height [m]."""
        return float(np.sqrt(np.trapezoid(self.deviations**2, self.heights) / self.heights[-1]))

    def shape(self, tolerance: float = 5e-5) -> ProfileShape:
        """The shape as a vessel's file contains it: as few points as possible within a tolerance [m] of the curve and
        its deviations.

        The deviations are the leading eigenvectors of the covariance, as many as contain `KEPT` of the variance at each
        height.
        """
        from sim_engine.vessel.profile import simplified

        variances, ways = np.linalg.eigh(self.covariance)
        variances, ways = variances[::-1], ways[:, ::-1]
        rows = np.sqrt(np.maximum(variances, 0.0))[:, None] * ways.T
        held = np.cumsum(rows**2, axis=0) >= KEPT * self.deviations**2 - tolerance**2
        rows = rows[: 1 + int(np.argmax(held.all(axis=1)))]
        curve = np.vstack([[0.0, 0.0], np.column_stack([self.radii, self.heights])])
        z = simplified(curve, tolerance)[1:, 1]
        for row in rows:
            z = np.union1d(z, simplified(np.column_stack([row, self.heights]), tolerance)[:, 1])

        def at(values: Floats) -> list[float]:
            return [float(x) for x in np.round(np.interp(z, self.heights, values), 5)]

        points = [(0.0, 0.0), *zip(at(self.radii), at(self.heights), strict=True)]
        deviations = tuple((0.0, *at(row)) for row in rows)
        return ProfileShape(
            unit="m",
            inner=tuple(points),
            wall=self.wall,
            floor=self.floor,
            radius_deviations=tuple(row for row in deviations if any(row)),
            height_deviation=self.height_deviation,
        )


def find_outline(
    height: float, evidence: Sequence[Evidence], wall: float, floor: float, *, height_deviation: float
) -> FittedOutline:
    """The most likely profile given all measurements.

    If the measurements scatter more than stated, the uncertainty grows accordingly.

    Args:
        height: from the inner floor to the rim [m].
        evidence: at least one piece.
        wall: thickness of the wall [m].
        floor: thickness of the floor [m].
        height_deviation: standard deviation of the height [m].

    Raises:
        VesselError: there are no measurements, or no profile fits them.
    """
    if not evidence or sum(len(piece.observed) for piece in evidence) == 0:
        raise VesselError("nothing says how wide the vessel is; give diameters or a fill table")
    share = np.linspace(0.0, 1.0, NODES)
    heights = height * share**CROWDING
    observed = np.concatenate([piece.observed for piece in evidence])
    deviations = np.concatenate([piece.deviations for piece in evidence])

    def predict(radii: Floats) -> Floats:
        return np.concatenate([piece.predict(heights, radii) for piece in evidence])

    middle = _first_guess(height, evidence, heights)
    problem = _Problem(predict, observed, deviations, middle)
    gaps = np.abs(share[:, None] - share[None, :])
    best = max(
        (problem.solve(length, bend, gaps) for length in LENGTHS for bend in BENDS), key=lambda each: each.likelihood
    )
    excess = float(best.residual @ best.residual) / max(len(observed) - best.determined, 1.0)
    fits = tuple(_fits(evidence, best.residual))
    covariance = best.covariance * max(excess, 1.0)
    return FittedOutline(heights, best.radii, covariance, wall, floor, fits, height_deviation, best.likelihood)


@dataclass(frozen=True)
class _Solution:
    """The most likely radii under one prior.

    Attributes:
        residual: observed − predicted, in standard deviations.
        determined: number of degrees of freedom that the measurements have determined.
        likelihood: logarithm of the evidence, up to a constant.
    """

    radii: Floats
    covariance: Floats
    residual: Floats
    determined: float
    likelihood: float


@dataclass(frozen=True)
class _Problem:
    predict: Callable[[Floats], Floats]
    observed: Floats
    deviations: Floats
    middle: float

    def solve(self, length: float, bend: float, gaps: Floats) -> _Solution:
        """Gauss–Newton with halved steps, then Laplace's approximation.

        Args:
            length, bend: see `LENGTHS` and `BENDS`.
            gaps: between nodes, along the height from floor to rim, shape (k, k).
        """
        scaled = np.sqrt(5.0) * gaps / length
        kernel = (1.0 + scaled + scaled**2 / 3.0) * np.exp(-scaled)
        prior = self.middle**2 * (bend**2 * kernel + LEVEL**2 + 1e-8 * np.eye(len(gaps)))
        precision = np.linalg.inv(prior)
        radii, damping = np.full(len(gaps), self.middle), 1.0
        cost = self._cost(radii, precision)
        for _ in range(ITERATIONS):
            slope, residual = self._slope(radii), self._residual(radii)
            pull = slope.T @ residual - precision @ (radii - self.middle)
            step = np.linalg.solve(slope.T @ slope + precision, pull)
            damping = min(1.0, 4.0 * damping)
            while (tried_cost := self._cost(tried := np.maximum(radii + damping * step, NARROWEST), precision)) > cost:
                damping /= 2.0
                if damping < 1e-4:
                    break
            if damping < 1e-4:
                break
            change, radii, cost = float(np.abs(tried - radii).max()), tried, tried_cost
            if change < 1e-6:
                break
        slope = self._slope(radii)
        curvature = slope.T @ slope + precision
        covariance: Floats = np.linalg.inv(curvature).astype(np.float64)
        likelihood = -0.5 * (cost + np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(precision)[1])
        determined = float(np.trace(slope @ covariance @ slope.T))
        return _Solution(radii, covariance, self._residual(radii), determined, float(likelihood))

    def _residual(self, radii: Floats) -> Floats:
        return (self.observed - self.predict(radii)) / self.deviations

    def _slope(self, radii: Floats) -> Floats:
        return _jacobian(self.predict, radii) / self.deviations[:, None]

    def _cost(self, radii: Floats, precision: Floats) -> float:
        residual, offset = self._residual(radii), radii - self.middle
        return float(residual @ residual + offset @ precision @ offset)


def _fits(evidence: Sequence[Evidence], residual: Floats) -> list[EvidenceFit]:
    fits, begin = [], 0
    for piece in evidence:
        count = len(piece.observed)
        residual_of_source = residual[begin : begin + count]
        fits.append(EvidenceFit(piece.name, count, float(np.sqrt(np.mean(residual_of_source**2))) if count else 0.0))
        begin += count
    return fits


def _first_guess(height: float, evidence: Sequence[Evidence], heights: Floats) -> float:
    """The radius of the cylinder that fits best [m]."""
    tried = np.geomspace(0.05 * height, 3.0 * height, 60)
    costs = [
        sum(
            float(np.sum(((p.predict(heights, np.full(NODES, radius)) - p.observed) / p.deviations) ** 2))
            for p in evidence
        )
        for radius in tried
    ]
    return float(tried[int(np.argmin(costs))])


def _jacobian(predict: Callable[[Floats], Floats], radii: Floats) -> Floats:
    step = 1e-6
    base = predict(radii)
    columns = []
    for k in range(len(radii)):
        moved = radii.copy()
        moved[k] += step
        columns.append((predict(moved) - base) / step)
    return np.stack(columns, axis=1)


def volume_below(heights: Floats, radii: Floats, levels: Floats) -> Floats:
    """Volume of the cavity below levels [m³].

    Args:
        heights: ascending from 0, shape (k,) [m].
        radii: at these heights, shape (k,) [m]; linear in between.
        levels: between 0 and the rim, shape (n,) [m].

    Returns:
        Shape (n,).
    """
    volumes = np.empty(len(levels))
    for i, level in enumerate(np.clip(levels, 0.0, heights[-1])):
        inside = heights < level
        z = np.append(heights[inside], level)
        r = np.append(radii[inside], np.interp(level, heights, radii))
        volumes[i] = volume(np.column_stack([r, z])) if len(z) > 1 else 0.0
    return volumes
