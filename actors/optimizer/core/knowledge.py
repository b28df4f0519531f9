"""What one more simulation would teach about where the real cost is least.

Let x̂ be the minimiser of the posterior mean m of the real cost f_r, and x another place that may be better. To know the
difference of the two would be worth the expected improvement

    EI(x) = E max(f_r(x̂) − f_r(x), 0) = s φ(u) + (m(x̂) − m(x)) Φ(u)
    s² = Var(f_r(x) − f_r(x̂)),    u = (m(x̂) − m(x)) / s

A simulation at a, with noise n_s, leaves of that doubt

    s′² = s² − Cov(f_s(a), f_r(x) − f_r(x̂))² / (Var f_s(a) + n_s²)

whatever it comes to, and is worth the share that it removes of the improvement most at stake:

    v(a) = max_x EI(x) (1 − s′/s)        0 ≤ v ≤ max EI, in the cost's unit

A real observation is worth the same expression with f_r and n_r in place of f_s and n_s. Doubt that would change no
decision counts for nothing; nor does doubt about what simulations lack: it is of no use to them, and only pours tell.

Observations that are under way are taken into account by what they will do to the covariance; the mean is left as it
is.

Source: expected improvement, Jones, Schonlau & Welch, Efficient global optimization of expensive black-box functions,
    J. Global Optim. 1998; several sources by value over price, Poloczek, Wang & Frazier, NeurIPS 2017. Their knowledge
    gradient asks whether *one* observation changes the decision, and is nothing where it takes two: with a tight valley
    and a doubtful corner it ended simulations after 27, and a real pour went to see what was in that corner.
Limitations: alternatives are looked at one by one, each against x̂.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer.core.problem import SuggestProblem
from actors.optimizer.core.region import Feasibility
from actors.optimizer.core.surrogate import GaussianProcess

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

LEADERS = 32
"""Places that may be the minimiser: so many with the lowest bounds, and as many with the lowest means."""
ELSEWHERE = 96
"""Further places at which a simulation is considered."""


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

    def values(self, observed: Indices, targets: Indices, mean: Array, noise: float) -> Array:
        """What observing each of some quantities (k,) is worth where targets (m,) with means (m,) compete: (k,)."""
        G, best = self._covariance, int(targets[np.argmin(mean)])
        doubt = G[targets, targets] + G[best, best] - 2.0 * G[targets, best]
        doubt = np.sqrt(np.maximum(doubt, self._least))
        gain = mean.min() - mean
        u = gain / doubt
        improvement = np.maximum(doubt * np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi) + gain * ndtr(u), 0.0)
        improvement[targets == best] = 0.0
        told = G[np.ix_(observed, targets)] - G[observed, best][:, None]
        removed = np.minimum(told**2 / self._variance(observed, noise)[:, None] / doubt**2, 1.0)
        return np.asarray((improvement * (1.0 - np.sqrt(1.0 - removed))).max(axis=1))

    def _variance(self, indices: Indices, noise: float) -> Array:
        """Variance of an observation; bounded below, since rounding may leave less than nothing."""
        return np.maximum(self._covariance[indices, indices], 0.0) + noise**2 + self._least
