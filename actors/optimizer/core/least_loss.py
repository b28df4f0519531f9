"""Where to pour when every pour counts, and where to simulate for it.

With H pours to follow (4 at most), b the least expected cost of an action that was poured, and f the cost by
`AveragedProcess`, the next pour minimises what it loses less what it may save in all that follow:

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

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.core import acquisition
from actors.optimizer.core.asked import Asked, tuples
from actors.optimizer.core.averaged import AveragedProcess, clipped_moments, shortfall
from actors.optimizer.core.lookahead import looked_ahead
from actors.optimizer.core.mismatch import Displacement, Mismatch, MismatchFound
from actors.optimizer.core.problem import SuggestProblem
from actors.optimizer.core.region import Feasibility, Region

Array = NDArray[np.float64]
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
    process: AveragedProcess, mismatch: Mismatch, known: Array, feasibility: Feasibility | None = None
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
    process: AveragedProcess, mismatch: Mismatch, feasibility: Feasibility | None
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


def worth(process: AveragedProcess, points: Array, known: Array) -> Array:
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
    process: AveragedProcess,
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
    process: AveragedProcess,
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
    process: AveragedProcess,
    points: Array,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> MismatchFound:
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
    drawn: tuple[Displacement, ...] = ()
    if problem.count == 0:
        drawn = tuple(Displacement(*pair) for pair in zip(*map(tuples, process.drawn(DRAWN)), strict=True))
    return MismatchFound(
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
