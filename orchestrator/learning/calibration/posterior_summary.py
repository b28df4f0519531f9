"""Summary of a posterior of θ: a region for each parameter, and the correlations between parameters.

- `posterior_found` summarises draws as a `PosteriorFound`; `PosteriorSummary` is the same without the draws.
- `central` selects the draw that becomes θ*.
- `unit_prior` converts the plan's parameter priors for the optimiser.

The draws themselves are made by the optimiser.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Point, Posterior
from orchestrator.learning.stage_result import ResultPart
from sim_engine.search_space import Space

if TYPE_CHECKING:
    from orchestrator.learning.campaign_plan import CalibrationPlan

Array = NDArray[np.float64]

LEVEL = 0.9
"""Probability level of the reported regions."""

WIDE = 0.75
"""Relative width from which a region counts as undetermined; 1 is the width of a uniform distribution's region."""

TIED = 0.6
"""|Correlation| from which two parameters compensate each other."""


class RemainingDiscrepancy(ResultPart):
    """Mean |r − c_s| of the θ that fit: the ends of the region and the median."""

    low: float
    median: float
    high: float


class PosteriorSummary(ResultPart):
    """The θ that fit the weighed pours, without the draws.

    Correlations refer to the unit cube of the searched box, in which logarithmic axes are represented by their
    logarithm.
    """

    level: float
    """Fraction of the posterior in the regions."""

    mean: dict[str, float]
    """Mean of the draws."""

    region: dict[str, tuple[float, float]]
    """Both ends of each parameter's region."""

    open: tuple[str, ...]
    """Parameters that the pours leave almost undetermined."""

    correlation: tuple[tuple[float, ...], ...]
    """Rows and columns in the order of the parameters."""

    directions: tuple[str, ...]
    """Parameters that compensate each other, as text."""

    remaining_discrepancy: RemainingDiscrepancy

    effective: float
    """Effective number of independent draws."""


class PosteriorFound(PosteriorSummary):
    """The θ that fit the weighed pours."""

    thetas: tuple[dict[str, float], ...]
    """Draws of the searched parameters, of equal weight."""

    def summary(self) -> PosteriorSummary:
        """The same without the draws."""
        return PosteriorSummary.model_validate(self.model_dump(exclude={"thetas"}))


def posterior_found(posterior: Posterior, space: Space) -> PosteriorFound:
    """Summarise the draws of a posterior.

    Args:
        posterior: draws in the unit cube.
        space: searched θ.
    """
    points = np.array(posterior.points)
    low, high = region(points)
    lower, upper, names = space.decode(tuple(low)), space.decode(tuple(high)), space.names
    remaining = np.quantile(posterior.discrepancies, [(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2])
    return PosteriorFound(
        level=LEVEL,
        mean=space.decode(tuple(points.mean(axis=0))),
        region={name: (lower[name], upper[name]) for name in names},
        open=tuple(_open(points, names)),
        correlation=tuple(tuple(row) for row in _correlation(points).tolist()),
        directions=tuple(_ties(points, names)),
        remaining_discrepancy=RemainingDiscrepancy(
            low=float(remaining[0]), median=float(remaining[1]), high=float(remaining[2])
        ),
        effective=posterior.effective,
        thetas=tuple(space.decode(tuple(point)) for point in posterior.points),
    )


def unit_prior(plan: CalibrationPlan) -> tuple[tuple[float, float], ...]:
    """Prior knowledge of the searched θ in the form of a `PosteriorQuestion`: mean and deviation per axis."""
    priors = {prior.name: prior for prior in plan.parameter_prior}
    if not priors:
        return ()
    rows = []
    for axis in plan.parameters.axes:
        prior = priors.get(axis.name)
        alike = (0.5, 0.0)
        rows.append(alike if prior is None else (axis.encode(prior.mean), prior.deviation / (axis.upper - axis.lower)))
    return tuple(rows)


def region(points: Array) -> tuple[Array, Array]:
    """Interval on each axis that holds at least nine tenths of the draws.

    It is the union of two intervals: from the 5 % to the 95 % quantile, and the shortest one that holds nine tenths.
    The quantiles alone would exclude the bounds of the box, where draws can accumulate.

    Args:
        points: (count, dimension) draws in the unit cube.

    Returns:
        (dimension,) lower and upper ends.

    Source: Box & Tiao, Bayesian Inference in Statistical Analysis, 1973, section 2.8 (highest posterior density).
    """
    ordered = np.sort(points, axis=0)
    held = math.ceil(LEVEL * len(points))
    widths = ordered[held - 1 :] - ordered[: len(points) - held + 1]
    first, axes = widths.argmin(axis=0), np.arange(points.shape[1])
    low, high = np.quantile(points, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return np.minimum(low, ordered[first, axes]), np.maximum(high, ordered[first + held - 1, axes])


def posterior_change(before: Posterior, after: Posterior) -> float:
    """Largest distance of two posteriors over all axes and principal axes, in standard deviations.

    The distance along an axis is the 1-Wasserstein distance of the draws, which reacts to position, width and shape.
    The principal axes include the direction across a ridge along which parameters compensate each other.

    Args:
        before, after: equal numbers of draws in the unit cube.

    Source: Vallender, Calculation of the Wasserstein distance between probability distributions on the line, 1974.
    """
    old, new = np.array(before.points), np.array(after.points)
    both = np.concatenate([old - old.mean(axis=0), new - new.mean(axis=0)])
    axes = np.concatenate([np.eye(old.shape[1]), np.linalg.svd(both, full_matrices=False)[2]])
    spread = np.maximum((both @ axes.T).std(axis=0), 1e-9)
    distances = np.abs(np.sort(old @ axes.T, axis=0) - np.sort(new @ axes.T, axis=0)).mean(axis=0)
    return float((distances / spread).max())


def central(posterior: Posterior) -> Point:
    """The medoid: the draw in the region that is nearest to all other draws, each axis in its own standard deviation.

    A draw is used instead of the mean, because on a curved ridge the mean does not fit the pours.

    Source: Kaufman & Rousseeuw, Clustering by means of medoids, 1987.
    """
    from scipy.spatial.distance import cdist  # slow import, not needed to read results

    points = np.array(posterior.points)
    low, high = region(points)
    inside = points[np.all((points >= low) & (points <= high), axis=1)]
    if not len(inside):  # each axis excludes a tenth: with more than nine parameters possibly all draws
        inside = points
    spread = points.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    distances = cdist(inside / spread, points / spread).sum(axis=1)
    return tuple(map(float, inside[int(np.argmin(distances))]))


def left_open(posterior: Posterior, names: tuple[str, ...]) -> list[str]:
    """Parameters that the pours leave undetermined, as text: 'the pours leave friction open', 'cohesion and friction
    compensate each other: …'.

    Args:
        posterior: draws in the unit cube.
        names: names of the axes.
    """
    points = np.array(posterior.points)
    return [*(f"the pours leave {name} open" for name in _open(points, names)), *_ties(points, names)]


def _open(points: Array, names: tuple[str, ...]) -> list[str]:
    low, high = region(points)
    return [name for name, width in zip(names, high - low, strict=True) if width > WIDE * LEVEL]


def _ties(points: Array, names: tuple[str, ...]) -> list[str]:
    correlation, ties = _correlation(points), []
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if abs(correlation[i, j]) > TIED:
                way = "more" if correlation[i, j] > 0.0 else "less"
                ties.append(
                    f"{names[i]} and {names[j]} compensate each other: more of one, {way} of the other "
                    f"(correlation {correlation[i, j]:+.2f})"
                )
    return ties


def _correlation(points: Array) -> Any:
    """Correlation matrix (d, d); a constant axis is uncorrelated with all others."""
    centred = points - points.mean(axis=0)
    spread = np.sqrt((centred**2).mean(axis=0))
    spread = np.where(spread > 0.0, spread, 1.0)
    correlation = (centred.T @ centred) / len(points) / np.outer(spread, spread)
    np.fill_diagonal(correlation, 1.0)
    return correlation
