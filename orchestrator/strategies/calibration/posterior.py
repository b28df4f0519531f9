"""What the weighed pours say about θ, for people: a region of each parameter, and which make up for each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from actors.optimizer.core.problem import Posterior
from orchestrator.strategies.learnt import Part
from sim_engine.space import Space

LEVEL = 0.9
"""Of the reported regions."""

WIDE = 0.75
"""Share of a searched range from which a region says next to nothing."""

FLAT = 0.5
"""Variance along a direction, in that of a uniform draw, from which the pours leave it open."""

TIED = 0.6
"""|Correlation| from which two parameters make up for each other."""

_PART = 0.35
"""Component of a unit direction from which a parameter belongs to it."""


class RemainingDiscrepancy(Part):
    """How far θ that fit stay from the pours: the region's ends and the median of mean |r − c_s|."""

    low: float
    median: float
    high: float


class PosteriorSummary(Part):
    """Which θ fit the weighed pours, without the draws.

    Correlations and directions are those of the searched box' unit cube, where logarithmic axes are by their logarithm.
    """

    level: float
    """Share of the posterior in the regions."""

    mean: dict[str, float]
    """Mean of the draws."""

    region: dict[str, tuple[float, float]]
    """Both ends of each parameter's region."""

    open: tuple[str, ...]
    """Parameters of which the pours say next to nothing."""

    correlation: tuple[tuple[float, ...], ...]
    """Rows and columns in the parameters' order."""

    directions: tuple[str, ...]
    """What is left open, in words."""

    remaining_discrepancy: RemainingDiscrepancy

    effective: float
    """How many independent draws they are worth."""


class PosteriorFound(PosteriorSummary):
    """Which θ fit the weighed pours."""

    thetas: tuple[dict[str, float], ...]
    """Draws of the searched parameters, of equal weight."""

    def summary(self) -> PosteriorSummary:
        """The same without the draws."""
        return PosteriorSummary.model_validate(self.model_dump(exclude={"thetas"}))


def posterior_found(posterior: Posterior, space: Space) -> PosteriorFound:
    """What draws of a posterior say.

    Args:
        posterior: draws in the unit cube.
        space: searched θ.
    """
    points = np.array(posterior.points)
    low, high = np.quantile(points, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    lower, upper, names = space.decode(tuple(low)), space.decode(tuple(high)), space.names
    correlation = _correlation(points)
    lacking = np.quantile(posterior.discrepancies, [(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2])
    return PosteriorFound(
        level=LEVEL,
        mean=space.decode(tuple(points.mean(axis=0))),
        region={name: (lower[name], upper[name]) for name in names},
        open=tuple(name for name, width in zip(names, high - low, strict=True) if width > WIDE * LEVEL),
        correlation=tuple(tuple(row) for row in correlation.tolist()),
        directions=tuple(directions(points, names)),
        remaining_discrepancy=RemainingDiscrepancy(
            low=float(lacking[0]), median=float(lacking[1]), high=float(lacking[2])
        ),
        effective=posterior.effective,
        thetas=tuple(space.decode(tuple(point)) for point in posterior.points),
    )


def directions(points: Any, names: tuple[str, ...]) -> list[str]:
    """What the pours leave open, in words: 'particles and friction make up for each other: more of one, …'.

    Args:
        points: (count, dimension) draws in the unit cube.
        names: of the axes.
    """
    found = []
    correlation = _correlation(points)
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if abs(correlation[i, j]) > TIED:
                way = "more" if correlation[i, j] > 0.0 else "less"
                found.append(
                    f"{names[i]} and {names[j]} make up for each other: more of one, {way} of the other "
                    f"(correlation {correlation[i, j]:+.2f})"
                )
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(points.T)))
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        share = 12.0 * float(value)
        parts = [name for name, weight in zip(names, vector, strict=True) if abs(weight) > _PART]
        if share > FLAT:
            known = f"{100 * min(share, 1.0):.0f} % of the variance of not knowing"
            found.append(f"the pours say next to nothing along {' and '.join(parts)} ({known})")
    return found


def _correlation(points: Any) -> Any:
    """(d, d); an axis that doesn't vary is correlated with nothing."""
    centred = points - points.mean(axis=0)
    spread = np.sqrt((centred**2).mean(axis=0))
    spread = np.where(spread > 0.0, spread, 1.0)
    correlation = (centred.T @ centred) / len(points) / np.outer(spread, spread)
    np.fill_diagonal(correlation, 1.0)
    return correlation
