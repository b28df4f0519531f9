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

What a pour is worth by what it will tell: the least loss that may be expected once it has been weighed.

A pour on the slope of the valley tells which hypothesis is right, one on a plateau hardly anything, whatever either
loses. With H pours to follow (4 at most) the next one minimises

    E c(x) − H (min_x′ E c(x′) − E_y min_x′ E[c(x′) | y at x]),    c = clip(f, 0, 1)

What y may be is dealt to a few values; each reweighs the hypotheses and moves what each of them expects elsewhere. The
minimum over x′ is one over places: what was poured, the best of each hypothesis, and some all over the region.

Source: knowledge gradient, Frazier et al. 2009; over hypotheses, ours.
Limitations: one pour ahead; the places are not polished, so the best one by `least_loss` is among them.

Where to pour when every pour counts, and where to simulate for it.

With H pours to follow (4 at most), b the least expected cost of an action that was poured, and f the cost by
`ModelAveragedProcess`, the next pour minimises what it loses less what it may save in all that follow:

    E clip(f(x), 0, 1) − H E (b − f(x)⁺)⁺

so that a corner that would spill the load is looked at only where it may be better by more than the spill, and with
nothing in hand much is tried. Its place competes with those that tell of others, too (`lookahead.py`). With a limit
only actions count whose probability of exceeding it is small enough; where there is none, the one with the smallest.

What one more pour at x would be worth looks at differences to the best poured action x̂, for knowing both better helps
only where it changes which is better, and no cost is below 0:

    g(x) = Σ_j w_j min(E d⁺, E (b_j − f_j(x)⁺)⁺),    d ~ N(m_j(x̂)⁺ − m_j(x)⁺, s⁴ / (s² + n²))

s² = Var(f_j(x̂) − f_j(x)), n is a pour's noise, w_j the weight of hypothesis j.

A simulation is made where it takes most doubt from what the heavy hypotheses say of the poured places, by which they
are told apart, and of the best of those to come: each sees them at another place of the simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer import acquisition
from actors.optimizer.feasible_region import Feasibility, Region
from actors.optimizer.gaussian_process import GaussianProcess
from actors.optimizer.model_discrepancy import ModelAveragedProcess, clipped_moments, shortfall
from actors.optimizer.question_checks import Asked, tuples
from actors.optimizer.questions import BenchOffset, DiscrepancyFound, ModelDiscrepancy, SuggestProblem

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

LEADERS = 32
"""Places that may be the minimiser: so many with the lowest bounds, and as many with the lowest means."""
ELSEWHERE = 96
"""Further places at which a simulation is considered."""


@dataclass(frozen=True)
class KnowledgeGradient:
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
) -> KnowledgeGradient:
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
    return KnowledgeGradient(points, np.array(values), float(pours.max()))


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


SHOWN = np.array([0.0, 0.02, 0.06, 0.14, 0.28, 0.46, 0.66, 0.84, 1.0])
"""What a pour may show, in units of the largest cost: closer where little is lost, for there decisions are made."""

SOME = 8
"""Places that are thought about because little is expected to be lost there, and as many that are disputed most."""

HEAVIEST, EVEN = 16, 16
"""Heavy hypotheses whose best places are thought about; places all over the region."""

TARGETS = 64
"""Places all over the region at which the least loss afterwards is looked for, beside the best of each hypothesis."""


def looked_ahead(
    process: ModelAveragedProcess,
    pour: Array,
    candidates: Array,
    known: Array,
    left: int,
    allowed: Callable[[Array, Array], Array],
    feasibility: Feasibility | None,
) -> Array:
    """The place (dimension,) of the next pour.

    Args:
        process: of the cost.
        pour: (dimension,), the best by what it loses and saves itself.
        candidates: (m, dimension), the first of them all over the region.
        known: (k, dimension), poured actions that may be poured again; k ≥ 0.
        left: H.
        allowed: what values (p,) of pours at places (p, dimension) become by limits and refusals.
        feasibility: of requests; None while nothing was refused.
    """
    if left == 0:
        return pour
    means, deviations, noises = process.components(candidates)
    costs = clipped_moments(means, deviations)[0]
    between = process.mixture @ means**2 - (process.mixture @ means) ** 2
    disputed = np.sqrt(np.maximum(between, 0.0)) / (process.mixture @ noises)
    heavy = np.argsort(-process.mixture, kind="stable")[:HEAVIEST]
    chosen = [
        np.argsort(process.mixture @ costs, kind="stable")[:SOME],
        np.argsort(-disputed, kind="stable")[:SOME],
        costs[heavy].argmin(axis=1),
        np.arange(min(EVEN, len(candidates))),
    ]
    places = np.concatenate([pour[None, :], candidates[np.unique(np.concatenate(chosen))]])
    others = np.concatenate([costs.argmin(axis=1), np.arange(min(TARGETS, len(candidates)))])
    targets = np.unique(np.concatenate([places, known, candidates[others]]), axis=0)
    if feasibility is not None and (likely := feasibility.likely(targets)).any():
        targets = targets[likely]
    now = float(process.predict(targets)[0].min())
    value = process.predict(places)[0] - left * (now - process.worst * foreseen(process, places, targets))
    return np.asarray(places[int(np.argmin(allowed(value / process.worst, places)))])


def foreseen(process: ModelAveragedProcess, places: Array, targets: Array) -> Array:
    """Least expected cost (p,) over targets (m, dimension), in units of the worst, after a pour at places (p, ·)."""
    means, deviations, _ = process.components(targets)
    at, its, noises = process.components(places)
    spreads = np.hypot(its, noises)
    covariances = process.covariances(places, targets)
    edges = np.concatenate([[-np.inf], 0.5 * (SHOWN[1:] + SHOWN[:-1]), [np.inf]])
    found = []
    for i in range(len(places)):
        chances = np.diff(ndtr((edges[:, None] - at[:, i]) / spreads[:, i]), axis=0)  # (shown, components)
        slope = covariances[:, i] / spreads[:, i, None] ** 2
        left = np.sqrt(np.maximum(deviations**2 - slope * covariances[:, i], 1e-10))
        moved = means + slope * (SHOWN[:, None] - at[:, i])[:, :, None]  # (shown, components, targets)
        costs = clipped_moments(moved, np.broadcast_to(left, moved.shape))[0]
        found.append(float(np.einsum("kc,c,kcm->km", chances, process.mixture, costs).min(axis=1).sum()))
    return np.array(found)


Score = Callable[[Array], Array]

LATEST = 8
"""Poured places, and as many to come, that simulations are made for."""

FORESIGHT = 4
"""Most pours whose savings count: what is found later could be found otherwise."""

WORTH_AT = 256
"""Places all over the region at which the worth of one more pour is looked at."""

DRAWN = 64
"""Displacements that are handed on to another receiver."""

FORBIDDEN = 1e3
"""Added for each per cent by which a limit is exceeded, in units of the largest cost."""


def least_loss(
    process: ModelAveragedProcess, mismatch: ModelDiscrepancy, known: Array, feasibility: Feasibility | None = None
) -> Score:
    """The score of a pour, to be minimised.

    Args:
        process: of the cost.
        mismatch: for H and the limit.
        known: (k, dimension), poured actions that may be poured again; k ≥ 0.
        feasibility: of requests; None while nothing was refused. What can't be made is as bad as the worst.
    """
    best = float(process.predict(known)[0].min()) / process.worst if len(known) else 0.0
    left = min(mismatch.left, FORESIGHT) if len(known) else 0
    allowed = _allowed(process, mismatch, feasibility)

    def score(points: Array) -> Array:
        means, deviations, _ = process.components(points)
        saved = shortfall(best, means, deviations) - shortfall(0.0, means, deviations)
        return allowed(process.mixture @ (clipped_moments(means, deviations)[0] - left * saved), points)

    return score


def _allowed(
    process: ModelAveragedProcess, mismatch: ModelDiscrepancy, feasibility: Feasibility | None
) -> Callable[[Array, Array], Array]:
    """What values (m,) of pours at points (m, dimension) become by the limit and by what may be refused."""

    def changed(value: Array, points: Array) -> Array:
        if mismatch.limit is not None:
            over = process.exceedance(points, mismatch.limit.loss) - mismatch.limit.probability
            value = value + FORBIDDEN * np.maximum(over, 0.0)
        if feasibility is not None:
            made = np.exp(feasibility.log_probability(points))
            value = made * value + (1.0 - made)
        return np.asarray(value)

    return changed


def worth(process: ModelAveragedProcess, points: Array, known: Array) -> Array:
    """g (m,) of one more pour at points (m, dimension), poured ones being known (k ≥ 1, dimension); the cost's unit."""
    place = known[int(np.argmin(process.predict(known)[0]))]
    means, deviations, noises = process.components(points)
    at_best, its_deviation, _ = (part[:, 0] for part in process.components(place[None, :]))
    best = shortfall(0.0, -at_best, its_deviation)[:, None]  # E f⁺ of each component
    doubt = process.differences(points, place)
    doubt = doubt**2 / np.hypot(doubt, noises)
    expected = shortfall(0.0, -means, deviations)
    gains = np.minimum(
        shortfall(best, expected, np.maximum(doubt, 1e-9)),
        shortfall(best, means, deviations) - shortfall(0.0, means, deviations),
    )
    return np.asarray(process.worst * (process.mixture @ np.maximum(gains, 0.0)))


def instructive(
    process: ModelAveragedProcess,
    count: int,
    candidates: Array,
    score: Score,
    pour: Array,
    pending: Array,
    region: Region,
) -> Array:
    """Places (count, dimension) for simulations.

    Args:
        process: of the real cost.
        count: how many.
        candidates: (m, dimension), where pours may come to lie.
        score: of pours.
        pour: (dimension,), the one that comes next.
        pending: (b, dimension), simulations under way.
        region: that they have to lie in.
    """
    if count == 0:
        return np.empty((0, len(pour)))
    to_come = candidates[np.argsort(score(candidates), kind="stable")[:LATEST]]
    targets = np.concatenate([process.points[-LATEST:], pour[None, :], to_come])
    hypotheses, weights = process.heaviest
    seen = hypotheses.moved(targets)
    gains = weights * np.exp(2.0 * hypotheses.gains)
    importance = np.repeat(gains, len(targets))
    seen = np.clip(seen.reshape(-1, len(pour)), 0.0, 1.0)
    places = region.snap(seen)
    allowed = region.allows(places)
    places = places[allowed] if allowed.any() else candidates
    simulated = process.simulated
    everything = np.concatenate([places, pending])
    noise = simulated.noise**2 + 1e-12
    G = simulated.covariance(everything, np.concatenate([everything, seen]))

    def observe(index: int) -> None:
        G[:] -= np.outer(G[:, index], G[index]) / (max(float(G[index, index]), 0.0) + noise)

    for index in range(len(places), len(everything)):
        observe(index)
    chosen = []
    for _ in range(count):
        own = np.maximum(np.diagonal(G[:, : len(everything)])[: len(places)], 0.0) + noise
        removed = (G[: len(places), len(everything) :] ** 2 @ importance) / own
        best = int(np.argmax(removed))
        chosen.append(places[best])
        observe(best)
    return np.array(chosen).reshape(count, len(pour))


def proposals(
    problem: SuggestProblem,
    asked: Asked,
    process: ModelAveragedProcess,
    candidates: Array,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> Array:
    """(count, dimension): the next pour, then simulations beside it. Candidates (m, dimension), m ≥ 1."""
    if problem.count == 0:
        return np.empty((0, problem.space.dimension))
    assert problem.mismatch is not None
    known = pourable(asked, feasibility)
    score = least_loss(process, problem.mismatch, known, feasibility)
    candidates = np.concatenate([candidates, known])
    pour = acquisition.minimise(score, candidates, asked.region, rng)
    left, allowed = min(problem.mismatch.left, FORESIGHT), _allowed(process, problem.mismatch, feasibility)
    if problem.mismatch.looks_ahead:
        pour = looked_ahead(process, pour, candidates, known, left, allowed, feasibility)
    beside = instructive(process, problem.count - 1, candidates, score, pour, asked.busy, asked.region)
    return np.concatenate([pour[None, :], beside])


def pourable(asked: Asked, feasibility: Feasibility | None) -> Array:
    """Poured places (k, dimension) that may be poured again."""
    known = asked.known[asked.region.allows(asked.known)]
    return known if feasibility is None or not len(known) else known[feasibility.likely(known)]


def found(
    problem: SuggestProblem,
    asked: Asked,
    process: ModelAveragedProcess,
    points: Array,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> DiscrepancyFound:
    """What the observations say about the simulator, and what one more pour would be worth."""
    assert problem.mismatch is not None
    limit, known = problem.mismatch.limit, pourable(asked, feasibility)
    candidates = asked.region.draw(WORTH_AT, rng, even=True)
    if len(points):
        candidates = np.concatenate([candidates, points[:1], _near(points[0], asked.region, rng)])
    candidates = np.concatenate([candidates, known])
    over = np.zeros(len(candidates)) if limit is None else process.exceedance(candidates, limit.loss)
    gain = None
    if len(known):
        kept = over <= (1.0 if limit is None else limit.probability)
        gain = float(worth(process, candidates[kept], known).max()) if kept.any() else None
    shifts, deviations, factor = process.displaced()
    drawn: tuple[BenchOffset, ...] = ()
    if problem.count == 0:
        drawn = tuple(BenchOffset(*pair) for pair in zip(*map(tuples, process.drawn(DRAWN)), strict=True))
    return DiscrepancyFound(
        ignorance=process.ignorance,
        shifts=tuple(map(float, shifts)),
        deviations=tuple(map(float, deviations)),
        factor=factor,
        gain=gain,
        exceedances=() if limit is None else tuple(map(float, process.exceedance(points, limit.loss))),
        least_exceedance=None if limit is None else float(over.min()),
        drawn=drawn,
    )


def _near(point: Array, region: Region, rng: np.random.Generator) -> Array:
    """Allowed places around one: where the cost may be least is often beside the next pour."""
    cloud = region.snap(np.clip(point + 0.05 * rng.standard_normal((64, len(point))), 0.0, 1.0))
    return cloud[region.allows(cloud)]
