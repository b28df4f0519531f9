"""What one more simulation would teach about where the real cost is least: the knowledge gradient over two sources.

Let m be the posterior mean of the real cost at the places X that may be its minimiser. A simulation at a, with noise
n_s, will move it by σ̃(a) Z, where Z ~ N(0, 1) is what nobody knows beforehand:

    σ̃(a, x) = Cov(f_s(a), f_r(x)) / √(Var f_s(a) + n_s²)
    v(a) = min_x m(x) − E min_x (m(x) + σ̃(a, x) Z)                                        ≥ 0, in the cost's unit

A real observation is worth the same expression with f_r and n_r in place of f_s and n_s. Where what is in doubt is the
simulator's discrepancy, σ̃ of a simulation is nearly the same at all of X and v vanishes: only pours tell.

Observations that are under way are taken into account by what they will do to the covariance, which does not depend on
what they come to; the mean is left as it is.

Source: Frazier, Powell & Dayanik, The knowledge-gradient policy for correlated normal beliefs, INFORMS Journal on
    Computing 2009; Poloczek, Wang & Frazier, Multi-information source optimization, NeurIPS 2017.
Limitations: one step ahead: two simulations that only teach something together are worth nothing each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.core.problem import SuggestProblem
from actors.optimizer.core.region import Feasibility
from actors.optimizer.core.surrogate import GaussianProcess

Array = NDArray[np.float64]

LEADERS = 32
"""Places that may be the minimiser: so many with the lowest bounds, and as many with the lowest means."""
ELSEWHERE = 96
"""Further places at which a simulation is considered."""

_Z = np.linspace(-4.0, 4.0, 41)
_WEIGHTS = np.exp(-0.5 * _Z**2) / np.exp(-0.5 * _Z**2).sum()
"""Symmetric about 0, so that no value is negative whatever the steps."""


@dataclass(frozen=True)
class Knowledge:
    """What simulations are worth.

    Attributes:
        points: (count, dimension), where the next ones pay most, each given those before it.
        values: (count,), what each of them is worth, ≥ 0.
        pour_value: what the real observation that pays most is worth, ≥ 0.
    """

    points: Array
    values: Array
    pour_value: float


def most_instructive(
    problem: SuggestProblem,
    process: GaussianProcess,
    candidates: Array,
    busy: Array,
    pouring: Array,
    feasibility: Feasibility | None,
) -> Knowledge:
    """Choose `problem.count` places for simulations.

    Args:
        problem: for its count and κ.
        process: of the real cost, from simulations.
        candidates: (m, dimension), m ≥ 1, places to think about.
        busy: (b, dimension), simulations under way.
        pouring: (p, dimension), real observations under way.
        feasibility: of requests; a place is worth less where a refusal is likely.
    """
    mean, deviation = process.predict(candidates)
    by_bound = np.argsort(mean - problem.kappa * deviation, kind="stable")
    leaders = np.array(list(dict.fromkeys([*by_bound[:LEADERS], *np.argsort(mean, kind="stable")[:LEADERS]])))
    others = by_bound[LEADERS : LEADERS + ELSEWHERE]
    places = candidates[np.concatenate([leaders, others])]
    belief = _Belief(process, np.concatenate([places, busy]), np.concatenate([candidates[leaders], pouring]))
    reals = len(places) + len(busy)
    here, targets = np.arange(len(places)), reals + np.arange(len(leaders))
    for index in range(len(places), reals):
        belief.observe(index, process.simulated_noise)
    for index in range(reals + len(leaders), reals + len(leaders) + len(pouring)):
        belief.observe(index, process.noise)

    m = mean[leaders]
    pours = belief.values(targets, targets, m, process.noise)
    allowed = np.ones(len(places)) if feasibility is None else np.exp(feasibility.log_probability(places))
    chosen, values = [], []
    for _ in range(problem.count):
        worth = belief.values(here, targets, m, process.simulated_noise) * allowed
        best = int(np.argmax(worth))
        chosen.append(places[best])
        values.append(float(worth[best]))
        belief.observe(best, process.simulated_noise)
    points = np.array(chosen).reshape(problem.count, candidates.shape[1])
    return Knowledge(points, np.array(values), float(pours.max()))


class _Belief:
    """Joint covariance of the simulated cost at some places and the real one at others, as observations come in."""

    def __init__(self, process: GaussianProcess, simulated: Array, real: Array) -> None:
        self._covariance = process.joint_covariance(simulated, real)
        self._least = (1e-6 * process.scale) ** 2

    def observe(self, index: int, noise: float) -> None:
        """Take an observation of one of the quantities into account, whatever it comes to."""
        column = self._covariance[:, index].copy()
        self._covariance -= np.outer(column, column) / self._variance(np.array([index]), noise)[0]

    def values(self, observed: NDArray[np.int_], targets: NDArray[np.int_], mean: Array, noise: float) -> Array:
        """What observing each of some quantities (k,) is worth for the least of the targets', (m,) with means: (k,)."""
        moves = self._covariance[np.ix_(observed, targets)] / np.sqrt(self._variance(observed, noise))[:, None]
        least = (mean[None, :, None] + moves[:, :, None] * _Z).min(axis=1)
        return np.asarray(np.maximum(mean.min() - least @ _WEIGHTS, 0.0))

    def _variance(self, indices: NDArray[np.int_], noise: float) -> Array:
        """Of an observation; bounded below, since rounding may leave less than nothing."""
        return np.maximum(self._covariance[indices, indices], 0.0) + noise**2 + self._least
