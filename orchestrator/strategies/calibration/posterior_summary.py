"""What the weighed pours say about θ, for people: a region of each parameter, and which make up for each other."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Point, Posterior
from orchestrator.strategies.stage_result import ResultPart
from sim_engine.search_space import Space

if TYPE_CHECKING:
    from orchestrator.strategies.campaign_plan import CalibrationPlan

Array = NDArray[np.float64]

LEVEL = 0.9
"""Probability level of the reported regions."""

WIDE = 0.75
"""Share of a searched range from which a region says next to nothing, in that of a uniform draw's region."""

TIED = 0.6
"""|Correlation| from which two parameters make up for each other."""


class RemainingDiscrepancy(ResultPart):
    """How far θ that fit stay from the pours: the region's ends and the median of mean |r − c_s|."""

    low: float
    median: float
    high: float


class PosteriorSummary(ResultPart):
    """Which θ fit the weighed pours, without the draws.

    Correlations are those of the searched box' unit cube, where logarithmic axes are by their logarithm.
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
    """Which parameters make up for each other, in words."""

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
    low, high = region(points)
    lower, upper, names = space.decode(tuple(low)), space.decode(tuple(high)), space.names
    lacking = np.quantile(posterior.discrepancies, [(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2])
    return PosteriorFound(
        level=LEVEL,
        mean=space.decode(tuple(points.mean(axis=0))),
        region={name: (lower[name], upper[name]) for name in names},
        open=tuple(_open(points, names)),
        correlation=tuple(tuple(row) for row in _correlation(points).tolist()),
        directions=tuple(_ties(points, names)),
        remaining_discrepancy=RemainingDiscrepancy(
            low=float(lacking[0]), median=float(lacking[1]), high=float(lacking[2])
        ),
        effective=posterior.effective,
        thetas=tuple(space.decode(tuple(point)) for point in posterior.points),
    )


def unit_prior(plan: CalibrationPlan) -> tuple[tuple[float, float], ...]:
    """What is known of the searched θ beforehand, as a `PosteriorQuestion` has it."""
    known = {prior.name: prior for prior in plan.parameter_prior}
    if not known:
        return ()
    rows = []
    for axis in plan.parameters.axes:
        prior = known.get(axis.name)
        alike = (0.5, 0.0)
        rows.append(alike if prior is None else (axis.encode(prior.mean), prior.deviation / (axis.upper - axis.lower)))
    return tuple(rows)


def region(points: Array) -> tuple[Array, Array]:
    """An interval of each axis that holds at least nine tenths of the draws.

    It reaches from the 5 % to the 95 % quantile, which by themselves would leave out the very bounds of the box at
    which draws heap up: so it has the shortest interval that holds nine tenths in it, too.

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


def central(posterior: Posterior) -> Point:
    """The draw in the region that is nearest to all other draws (a medoid), each axis in its own standard deviation.

    A draw, and not the mean: on a curved ridge the mean lies beside what fits.

    Source: Kaufman & Rousseeuw, Clustering by means of medoids, 1987.
    """
    from scipy.spatial.distance import cdist  # for those who only read results it takes long to load

    points = np.array(posterior.points)
    low, high = region(points)
    inside = points[np.all((points >= low) & (points <= high), axis=1)]
    if not len(inside):  # each axis leaves out a tenth: of more than nine parameters perhaps all
        inside = points
    spread = points.std(axis=0)
    spread = np.where(spread > 0.0, spread, 1.0)
    distances = cdist(inside / spread, points / spread).sum(axis=1)
    return tuple(map(float, inside[int(np.argmin(distances))]))


def left_open(posterior: Posterior, names: tuple[str, ...]) -> list[str]:
    """What the pours don't determine, in words: 'the pours leave friction open', 'cohesion and friction make up …'.

    Args:
        posterior: draws in the unit cube.
        names: of the axes.
    """
    points = np.array(posterior.points)
    return [*(f"the pours leave {name} open" for name in _open(points, names)), *_ties(points, names)]


def _open(points: Array, names: tuple[str, ...]) -> list[str]:
    low, high = region(points)
    return [name for name, width in zip(names, high - low, strict=True) if width > WIDE * LEVEL]


def _ties(points: Array, names: tuple[str, ...]) -> list[str]:
    correlation, found = _correlation(points), []
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if abs(correlation[i, j]) > TIED:
                way = "more" if correlation[i, j] > 0.0 else "less"
                found.append(
                    f"{names[i]} and {names[j]} make up for each other: more of one, {way} of the other "
                    f"(correlation {correlation[i, j]:+.2f})"
                )
    return found


def _correlation(points: Array) -> Any:
    """(d, d); an axis that doesn't vary is correlated with nothing."""
    centred = points - points.mean(axis=0)
    spread = np.sqrt((centred**2).mean(axis=0))
    spread = np.where(spread > 0.0, spread, 1.0)
    correlation = (centred.T @ centred) / len(points) / np.outer(spread, spread)
    np.fill_diagonal(correlation, 1.0)
    return correlation
