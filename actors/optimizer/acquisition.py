"""Acquisition functions: lower confidence bound, local penalisation of pending points, search for the minimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr

from actors.optimizer.feasible_region import Feasibility, Region
from actors.optimizer.gaussian_process import Surrogate

Array = NDArray[np.float64]
Score = Callable[[Array], Array]


PLACES = 512
"""Number of places at which holes between points are measured."""


def lower_confidence_bound(surrogate: Surrogate, kappa: float) -> Score:
    """m(x) − κ s(x), to be minimised.

    Source: Srinivas et al. 2010 (as upper bound of a reward), with a constant κ as in the CoRL 2017 paper.
    """

    def score(points: Array) -> Array:
        mean, deviation = surrogate.predict(points)
        return mean - kappa * deviation

    return score


RESOLVED = 2.0
"""Posterior deviation, in units of the noise, below which a further observation is a replicate."""


def without_replicates(score: Score, surrogate: Surrogate, noise: float) -> Score:
    """Return a score that prefers places (to be minimised) which the surrogate does not know to within the noise.

    Among places that are all known so well, the one with the largest deviation has the lowest score.

    Source: Binois et al., Replication or exploration? Sequential design for stochastic simulation experiments,
    Technometrics 2019: a replicate pays only if the noise dominates.
    """

    def changed(points: Array) -> Array:
        deviation = surrogate.predict(points)[1]
        return np.where(deviation >= RESOLVED * noise, score(points), _REPLICATE - deviation / noise)

    return changed


_REPLICATE = 1e9
"""Score of a replicate, larger than that of any other place."""


def penalised(
    score: Score, surrogate: Surrogate, busy: Array, candidates: Array, feasibility: Feasibility | None = None
) -> Score:
    """Return a score that also avoids pending points, and likely refusals and failures.

    Each pending point has a ball that cannot contain the minimum, according to the surrogate's steepest slope. The
    score is divided by the probability of being outside all balls, and by the probability of not being refused. Pending
    and refused points therefore need no invented cost.

    Args:
        score: to be minimised.
        surrogate: of the cost.
        busy: pending points (b, dimension).
        candidates: (m, dimension), for the estimates of slope, lowest mean and the score's range.
        feasibility: of requests; None if no request was refused.

    Returns:
        A new score to be minimised: −log(softplus(−score)) − Σ log φ_j − log P, score in units of its spread.

    Source: González et al., Batch Bayesian Optimization via Local Penalization, AISTATS 2016.
    """
    if len(busy) == 0 and feasibility is None:
        return score
    # González et al. 2016 maximise g Π_j φ_j with a positive reward g = log(1 + e^(−(score − centre)/spread)); here
    # −log of the product is minimised.
    base = score(candidates)
    centre, spread = float(np.median(base)), max(float(np.std(base)), 1e-12)
    outside = _outside(surrogate, busy, candidates) if len(busy) else None

    def divided(points: Array) -> Array:
        reward = np.logaddexp(0.0, -(score(points) - centre) / spread)  # softplus: positive, as a product needs
        result = -np.log(np.maximum(reward, 1e-300))
        if outside is not None:
            result = result - outside(points)
        if feasibility is not None:
            result = result - feasibility.log_probability(points)
        return np.asarray(result)

    return divided


def _outside(surrogate: Surrogate, busy: Array, candidates: Array) -> Score:
    """Logarithm of the probability of being outside all balls."""
    # The minimum is at least r_j = (f(x_j) − M) / L from x_j, if L bounds |∇f| and M is its value. With
    # f(x_j) ~ N(m, s²), P(|x − x_j| > r_j) = Φ((L |x − x_j| − (m − M)) / s) (González et al. 2016, for a maximum).
    mean, deviation = surrogate.predict(busy)
    all_means = surrogate.predict(candidates)[0]
    lowest = min(float(all_means.min()), float(mean.min()))
    slope = _steepest_slope(surrogate, candidates[:: max(1, len(candidates) // 64)])
    relief = float(all_means.max()) - lowest
    slope = max(slope, relief / np.sqrt(candidates.shape[1]), 1e-9)
    # if the surrogate's deviation is near 0, the ball would vanish and two identical trials would be proposed
    deviation = np.maximum(deviation, max(0.05 * relief, 1e-9))

    def log_probability(points: Array) -> Array:
        distance = np.linalg.norm(points[:, None, :] - busy[None, :, :], axis=2)
        return np.asarray(log_ndtr((slope * distance - (mean - lowest)[None, :]) / deviation[None, :]).sum(axis=1))

    return log_probability


def spread_out(
    count: int, taken: Array, region: Region, rng: np.random.Generator, feasibility: Feasibility | None = None
) -> Array:
    """(count, dimension) Sobol points; given taken points (k, dimension), the points farthest from them.

    With refusals, the distance is weighted by the probability of not being refused.
    """
    if len(taken) == 0:
        return region.draw(count, rng, even=True)
    candidates = region.draw(max(64, 4 * count), rng, even=True)
    weight = 1.0 if feasibility is None else np.exp(feasibility.log_probability(candidates))
    # Greedy maximin design: argmax_x P(x) min_j |x − x_j|, one point after the other (Johnson, Moore & Ylvisaker 1990).
    chosen: list[Array] = []
    distance = _round_the_cube(candidates, taken).min(axis=1)
    for _ in range(count):
        point = candidates[int(np.argmax(distance * weight))]
        chosen.append(point)
        distance = np.minimum(distance, _round_the_cube(candidates, point[None, :])[:, 0])
    return np.array(chosen).reshape(count, candidates.shape[1])


def between(
    count: int, taken: Array, region: Region, rng: np.random.Generator, feasibility: Feasibility | None = None
) -> Array:
    """(count, dimension) points that leave the smallest holes: each reduces the mean squared distance from a place to
    the nearest point most, taken points (k, dimension) included, k ≥ 1. Unlike the farthest points, they are not on the
    faces.

    Source: greedy minimisation of the quantisation error, Graf & Luschgy, Foundations of Quantization, 2000.
    """
    candidates = region.draw(PLACES, rng, even=True)
    weight = 1.0 if feasibility is None else np.exp(feasibility.log_probability(candidates))
    # A point x decreases the quantisation error Σ_z min_j |z − x_j|² over all places z by
    # Σ_z max(nearest(z) − |z − x|², 0).
    apart = cdist(candidates, candidates, "sqeuclidean")
    nearest = cdist(candidates, taken, "sqeuclidean").min(axis=1)
    chosen = []
    for _ in range(count):
        best = int(np.argmax(weight * np.maximum(nearest - apart, 0.0).sum(axis=1)))
        chosen.append(candidates[best])
        nearest = np.minimum(nearest, apart[best])
    return np.array(chosen).reshape(count, candidates.shape[1])


def _round_the_cube(points: Array, others: Array) -> Array:
    """(m, k) distances on a torus, where opposite faces touch; otherwise the farthest points would all be corners."""
    gap = np.abs(points[:, None, :] - others[None, :, :])
    return np.asarray(np.linalg.norm(np.minimum(gap, 1.0 - gap), axis=2))


def search_candidates(region: Region, dimension: int, around: Sequence[Array], rng: np.random.Generator) -> Array:
    """Candidates to score first: Sobol points over the region, and clouds around known good points. (m, dimension)."""
    cover = region.draw(512 if dimension <= 2 else 1024, rng, even=True)
    clouds = [_cloud(region, point, spread, 16, rng) for point in around for spread in (0.1, 0.02)]
    return np.concatenate([cover, *clouds])


def minimise(score: Score, candidates: Array, region: Region, rng: np.random.Generator) -> Array:
    """Minimise a score over the region: the best candidates, then shrinking clouds around them. (dimension,)."""
    values = score(candidates)
    leaders = candidates[np.argsort(values, kind="stable")[:3]]
    best, lowest = leaders[0], float(values.min())
    for spread in (0.04, 0.015, 0.005, 0.0015):
        cloud = np.concatenate([_cloud(region, leader, spread, 24, rng) for leader in leaders])
        if len(cloud) == 0:
            continue
        values = score(cloud)
        if float(values.min()) < lowest:
            best, lowest = cloud[int(np.argmin(values))], float(values.min())
        leaders = np.concatenate([best[None, :], cloud[np.argsort(values, kind="stable")[:2]]])
    return np.asarray(best)


def _cloud(region: Region, point: Array, spread: float, count: int, rng: np.random.Generator) -> Array:
    """At most `count` allowed points around a point."""
    cloud = region.snap(np.clip(point + spread * rng.standard_normal((count, len(point))), 0.0, 1.0))
    return cloud[region.allows(cloud)]


def _steepest_slope(surrogate: Surrogate, points: Array, step: float = 1e-3) -> float:
    """Largest slope of the posterior mean at some points [cost per unit of the cube], by forward differences."""
    # ∂m/∂x_i ≈ (m(x + step e_i) − m(x)) / step at every point
    m, dimension = points.shape
    moved = (points[:, None, :] + step * np.eye(dimension)[None, :, :]).reshape(-1, dimension)
    means = surrogate.predict(np.concatenate([points, moved]))[0]
    slopes = (means[m:].reshape(m, dimension) - means[:m, None]) / step
    return float(np.linalg.norm(slopes, axis=1).max())
