"""Where to look next: lower confidence bound, local penalisation of busy places, and the search for its minimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr
from scipy.stats import qmc

from actors.optimizer.core.surrogate import Surrogate

Array = NDArray[np.float64]
Score = Callable[[Array], Array]


def lower_confidence_bound(surrogate: Surrogate, kappa: float) -> Score:
    """m(x) − κ s(x), to be minimised.

    Source: Srinivas et al. 2010 (as upper bound of a reward), with a constant κ as in the CoRL 2017 paper.
    """

    def score(points: Array) -> Array:
        mean, deviation = surrogate.predict(points)
        return mean - kappa * deviation

    return score


def penalised(score: Score, surrogate: Surrogate, busy: Array, candidates: Array) -> Score:
    """A score that also stays away from points whose answers are still out.

    Around each busy point lies a ball in which, judging by the surrogate's steepest slope, the minimum can't be; the
    score is divided by the probability of being outside it. No cost has to be invented for the busy points.

    Args:
        score: to be minimised.
        surrogate: of the cost.
        busy: (b, dimension).
        candidates: (m, dimension), from which slope, lowest mean and the score's range are estimated.

    Returns:
        A new score to be minimised: −log(softplus(−score)) − Σ log φ_j, score in units of its spread.

    Source: González et al., Batch Bayesian Optimization via Local Penalization, AISTATS 2016.
    """
    if len(busy) == 0:
        return score
    base = score(candidates)
    centre, spread = float(np.median(base)), max(float(np.std(base)), 1e-12)
    mean, deviation = surrogate.predict(busy)
    all_means = surrogate.predict(candidates)[0]
    lowest = min(float(all_means.min()), float(mean.min()))
    slope = _steepest_slope(surrogate, candidates[:: max(1, len(candidates) // 64)])
    relief = float(all_means.max()) - lowest
    slope = max(slope, relief / np.sqrt(candidates.shape[1]), 1e-9)
    # where the surrogate is sure of itself the ball would vanish, and two identical trials be asked for
    deviation = np.maximum(deviation, max(0.05 * relief, 1e-9))

    def divided(points: Array) -> Array:
        reward = np.logaddexp(0.0, -(score(points) - centre) / spread)  # softplus: positive, as a product needs
        distance = np.linalg.norm(points[:, None, :] - busy[None, :, :], axis=2)
        outside = log_ndtr((slope * distance - (mean - lowest)[None, :]) / deviation[None, :])
        return np.asarray(-np.log(np.maximum(reward, 1e-300)) - outside.sum(axis=1))

    return divided


def sobol_points(count: int, dimension: int, rng: np.random.Generator) -> Array:
    """(count, dimension) points of a scrambled Sobol sequence."""
    exponent = max(0, int(np.ceil(np.log2(max(count, 1)))))
    return np.asarray(qmc.Sobol(dimension, scramble=True, rng=rng).random_base2(exponent)[:count], dtype=np.float64)


def spread_out(count: int, taken: Array, dimension: int, rng: np.random.Generator) -> Array:
    """(count, dimension) Sobol points; where points are taken already (k, dimension), those farthest from them."""
    if len(taken) == 0:
        return sobol_points(count, dimension, rng)
    candidates = sobol_points(max(64, 4 * count), dimension, rng)
    chosen: list[Array] = []
    distance = np.linalg.norm(candidates[:, None, :] - taken[None, :, :], axis=2).min(axis=1)
    for _ in range(count):
        point = candidates[int(np.argmax(distance))]
        chosen.append(point)
        distance = np.minimum(distance, np.linalg.norm(candidates - point, axis=1))
    return np.array(chosen).reshape(count, dimension)


def search_candidates(dimension: int, around: Sequence[Array], rng: np.random.Generator) -> Array:
    """Places to score first: a Sobol cover of the cube, and clouds around known good points. (m, dimension)."""
    cover = sobol_points(512 if dimension <= 2 else 1024, dimension, rng)
    clouds = [_cloud(point, spread, 16, rng) for point in around for spread in (0.1, 0.02)]
    return np.concatenate([cover, *clouds])


def minimise(score: Score, candidates: Array, rng: np.random.Generator) -> Array:
    """Minimiser of a score over the cube: the best candidates, then shrinking clouds around them. (dimension,)."""
    values = score(candidates)
    leaders = candidates[np.argsort(values, kind="stable")[:3]]
    best, lowest = leaders[0], float(values.min())
    for spread in (0.04, 0.015, 0.005, 0.0015):
        cloud = np.concatenate([_cloud(leader, spread, 24, rng) for leader in leaders])
        values = score(cloud)
        if float(values.min()) < lowest:
            best, lowest = cloud[int(np.argmin(values))], float(values.min())
        leaders = np.concatenate([best[None, :], cloud[np.argsort(values, kind="stable")[:2]]])
    return np.asarray(best)


def _cloud(point: Array, spread: float, count: int, rng: np.random.Generator) -> Array:
    return np.clip(point + spread * rng.standard_normal((count, len(point))), 0.0, 1.0)


def _steepest_slope(surrogate: Surrogate, points: Array, step: float = 1e-3) -> float:
    """Largest slope of the posterior mean at some points [cost per unit of the cube], by forward differences."""
    m, dimension = points.shape
    moved = (points[:, None, :] + step * np.eye(dimension)[None, :, :]).reshape(-1, dimension)
    means = surrogate.predict(np.concatenate([points, moved]))[0]
    slopes = (means[m:].reshape(m, dimension) - means[:m, None]) / step
    return float(np.linalg.norm(slopes, axis=1).max())
