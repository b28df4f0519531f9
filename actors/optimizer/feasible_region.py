"""The feasible region of proposals: integer axes, linear constraints, and a model of refused requests.

`Region` contains the allowed points; `Feasibility` estimates the probability that a request is not refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import log_ndtr
from scipy.stats import qmc

from actors.optimizer.covariance import Covariance, HyperPrior
from actors.optimizer.gaussian_process import GaussianProcess
from actors.optimizer.questions import Linear
from sim_engine.search_space import Axis, Space

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LABEL_PRIOR = HyperPrior(length=(0.3, 0.5), signal=(1.0, 0.3), noise=(0.1, 0.5))
_CHANCE_PRIOR = HyperPrior(length=(0.7, 0.5), signal=(1.0, 0.3), noise=(0.7, 0.5))
_SLACK = 1e-9
_SAME = 1e-9
_MOST_DRAWN = 2**15


class Region:
    """The part of the unit cube that may contain proposals.

    An integer axis has as many places as values: values are rounded before they enter the surrogate.

    Source: Garrido-Merchán & Hernández-Lobato, Dealing with categorical and integer-valued variables in Bayesian
    optimization with Gaussian processes, Neurocomputing 2020.
    """

    def __init__(self, space: Space, constraints: Sequence[Linear]) -> None:
        self._space = space
        self._integers = [(i, axis) for i, axis in enumerate(space.axes) if axis.integer]
        index = {name: i for i, name in enumerate(space.names)}
        self._rows = [([(index[name], weight) for name, weight in c.weights], c.upper) for c in constraints]

    def snap(self, points: Array) -> Array:
        """Points (m, ≥ dimension) with integer axes rounded; further coordinates are unchanged."""
        if not self._integers:
            return points
        snapped = points.copy()
        for i, axis in self._integers:
            # v = round(v(u)), u' = u(v), within the cube: rounding can leave the range of the axis
            snapped[:, i] = np.clip(_units(axis, np.rint(_values(axis, points[:, i]))), 0.0, 1.0)
        return snapped

    def allows(self, points: Array) -> Mask:
        """Which points (m, dimension) satisfy all constraints: (m,)."""
        allowed = np.ones(len(points), dtype=np.bool_)
        for weights, upper in self._rows:
            # Σ weight · value ≤ upper + slack, of decoded values; the slack is for their rounding
            parts = [weight * self._decoded(i, points[:, i]) for i, weight in weights]
            slack = _SLACK * (abs(upper) + sum(abs(weight) for _, weight in weights))
            allowed &= np.sum(parts, axis=0) <= upper + slack
        return allowed

    def draw(
        self, count: int, rng: np.random.Generator, *, even: bool, law: Callable[[Array], Array] | None = None
    ) -> Array:
        """(count, dimension) allowed points: of a scrambled Sobol sequence if `even`, otherwise independent ones.

        Args:
            count: number of points.
            rng: random number generator.
            even: whether to use a Sobol sequence.
            law: transforms uniform points (m, dimension) to another distribution.

        Raises:
            ValueError: too few points of the space satisfy all constraints.
        """
        d = self._space.dimension
        sequence = qmc.Sobol(d, scramble=True, rng=rng) if even else None
        attempts, accepted = 0, np.empty((0, d))
        while len(accepted) < count:
            if attempts >= _MOST_DRAWN:
                raise ValueError(
                    f"of {attempts} points of the space {len(accepted)} meet all constraints; {count} are needed"
                )
            # A power of two, as Sobol sequences need, and at least as many as so far: attempts double.
            batch = 2 ** max(0, math.ceil(math.log2(max(count, attempts, 1))))
            points = rng.random((batch, d)) if sequence is None else np.asarray(sequence.random(batch))
            attempts += batch
            points = self.snap(points if law is None else law(points))
            accepted = np.concatenate([accepted, points[self.allows(points)]])
        return accepted[:count]

    def _decoded(self, index: int, units: Array) -> Array:
        axis = self._space.axes[index]
        values = _values(axis, units)
        return np.rint(values) if axis.integer else values


@dataclass(frozen=True)
class RequestGroup:
    """Requests of one kind.

    Attributes:
        fulfilled: places (n, dimension).
        refused: places (k ≥ 1, dimension); a place in both counts as refused.
        by_chance: whether the same request may succeed one time and fail the next.
    """

    fulfilled: Array
    refused: Array
    by_chance: bool = False


class Feasibility:
    """Probability that a request is not refused, estimated from fulfilled and refused requests.

    The model is a GP of the label (1 fulfilled, −1 refused) with prior mean 1: unexplored places count as allowed. The
    probability is that of a positive latent label. Several kinds of requests may be refused for different reasons;
    their probabilities are multiplied.

    Source: least-squares classification, Rasmussen & Williams, chapter 6.5; as a weight of an acquisition: Gardner et
    al., Bayesian optimization with inequality constraints, ICML 2014.
    """

    def __init__(self, *kinds: RequestGroup) -> None:
        """Fit."""
        self._processes = [_labelled(kind) for kind in kinds]
        self._chancy = [process for process, kind in zip(self._processes, kinds, strict=True) if kind.by_chance]
        self._refused = np.concatenate([kind.refused for kind in kinds])

    def log_probability(self, points: Array) -> Array:
        """(m,) at points (m, dimension)."""
        return _log_positive(self._processes, points)

    def made(self, points: Array) -> Array:
        """Probabilities (m,) at points (m, dimension) that no random failure occurs; 1 without random failures."""
        return np.exp(_log_positive(self._chancy, points))

    def likely(self, points: Array) -> Mask:
        """Which points (m, dimension) were not refused and have a probability above 0.5 of not being refused: (m,).

        If there is none, all points that were not refused; if there is none either, all points.
        """
        other = cdist(points, self._refused).min(axis=1) > _SAME
        # P > 1/2 as ln P > −ln 2
        likely = other & (self.log_probability(points) > -math.log(2.0))
        return likely if likely.any() else (other if other.any() else np.ones(len(points), dtype=np.bool_))


def _log_positive(processes: Sequence[GaussianProcess], points: Array) -> Array:
    """Logarithms (m,) of the probability that all labels at points (m, dimension) are positive."""
    # P = Π_k Φ(m_k / √(s_k² + n_k²)): Rasmussen & Williams, section 6.5, with the label's noise as the width of Φ.
    total = np.zeros(len(points))
    for process in processes:
        mean, deviation = process.predict(points)
        total += log_ndtr(mean / np.hypot(deviation, process.noise))
    return total


def _labelled(kind: RequestGroup) -> GaussianProcess:
    """GP of the label."""
    fulfilled, refused = kind.fulfilled, kind.refused
    if len(fulfilled):
        fulfilled = fulfilled[cdist(fulfilled, refused).min(axis=1) > _SAME]
    points = np.concatenate([fulfilled, refused])
    # y = 1 (fulfilled), −1 (refused), with prior mean 1: far from refusals nothing counts as refused
    labels = np.where(np.arange(len(points)) < len(fulfilled), 1.0, -1.0)
    prior = _CHANCE_PRIOR if kind.by_chance else _LABEL_PRIOR
    return GaussianProcess(labels, Covariance(points, prior), mean=lambda x: np.ones(len(x)), scale=1.0)


def _values(axis: Axis, units: Array) -> Array:
    """Vectorised `Axis.decode` without rounding."""
    u = np.clip(units, 0.0, 1.0)
    if axis.scale == "log":
        # v = v₀ (v₁ / v₀)^u
        return np.asarray(np.exp(math.log(axis.lower) + u * (math.log(axis.upper) - math.log(axis.lower))))
    return np.asarray(axis.lower + u * (axis.upper - axis.lower))


def _units(axis: Axis, values: Array) -> Array:
    """Vectorised `Axis.encode`."""
    if axis.scale == "log":
        # u = ln(v / v₀) / ln(v₁ / v₀)
        values = np.maximum(values, 1e-300)
        return np.asarray((np.log(values) - math.log(axis.lower)) / (math.log(axis.upper) - math.log(axis.lower)))
    return np.asarray((values - axis.lower) / (axis.upper - axis.lower))
