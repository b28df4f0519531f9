"""The value of the next pour and of simulations: knowledge gradient, and decisions with a fixed budget of pours.

`proposals` chooses the next pour and simulations for a `ModelAveragedProcess`, with `least_loss`, `looked_ahead` and
`instructive`; `found` describes the result.

**Loss of a pour** (`least_loss`). Let H be the number of pours to follow (4 at most), b the least expected cost of a
poured action, and f the cost by `ModelAveragedProcess`. The next pour minimises its expected loss minus the expected
savings in the following pours:

    E clip(f(x), 0, 1) − H E (b − f(x)⁺)⁺

A corner that may spill the whole load is therefore tried only if its possible advantage exceeds the spill. While no
poured action is good (b is large), much is tried. Before the first pour, H counts as 0. With a limit, only actions
count whose probability of exceeding it is small enough; if there is none, the action with the smallest probability
counts.

**Lookahead** (`looked_ahead`). After the first pour, the place found by `least_loss` competes with places that are
informative about other places: a pour on the slope of the valley distinguishes the hypotheses, one on a plateau hardly
does, whatever their losses. With H pours to follow (4 at most), the next pour minimises

    E c(x) − H (min_x′ E c(x′) − E_y min_x′ E[c(x′) | y at x]),    c = clip(f, 0, 1)

The outcome y is discretised to a few values. Each value reweights the hypotheses and shifts their expectations at other
places. The minimum over x′ is taken over poured places, the best place of each hypothesis, and places all over the
region.

Source: knowledge gradient, Frazier et al. 2009; the extension to hypotheses is this project's own.
Limitations: looks one pour ahead; the places are not refined, so the best one by `least_loss` is included.

**Gain of one more pour** (`pour_gains`). It considers differences to the best poured action x̂, because better
knowledge of both helps only if it changes their order, and no cost is below 0:

    g(x) = Σ_j w_j min(E d⁺, E (b_j − f_j(x)⁺)⁺),    d ~ N(m_j(x̂)⁺ − m_j(x)⁺, s⁴ / (s² + n²))

s² = Var(f_j(x̂) − f_j(x)), n is a pour's noise, w_j the weight of hypothesis j.

**Simulations next to pours** (`instructive`). A simulation is made where it reduces the uncertainty of the heaviest
hypotheses most, at the poured places, which distinguish the hypotheses, and at the best places for the next pours. Each
hypothesis maps these places to other places of the simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer import acquisition
from actors.optimizer.feasible_region import Feasibility, Region
from actors.optimizer.model_discrepancy import LEAST_CHANCE, RESOLUTION, ModelAveragedProcess, clipped_mean, shortfall
from actors.optimizer.questions import BenchOffset, DiscrepancyFound, ModelDiscrepancy, PourQuery, found_good
from actors.optimizer.surrogate_models import QueryArrays, tuples

Array = NDArray[np.float64]
Indices = NDArray[np.int_]

SHOWN = np.array([0.0, 0.02, 0.06, 0.14, 0.28, 0.46, 0.66, 0.84, 1.0])
"""Discretised outcomes of a pour, in units of the largest cost: denser at small losses, where decisions are made."""

SOME = 8
"""Number of places considered for their low expected loss, and of those considered for their disputed cost."""

HEAVIEST, EVEN = 16, 16
"""Number of heaviest hypotheses whose best places are considered; number of places all over the region."""

TARGETS = 64
"""Number of places all over the region at which the least loss afterwards is searched, in addition to the best of each
hypothesis."""


def looked_ahead(
    process: ModelAveragedProcess,
    pour: Array,
    candidates: Array,
    poured: Array,
    pours_left: int,
    allowed: Callable[[Array, Array], Array],
    feasibility: Feasibility | None,
) -> Array:
    """Return the place (dimension,) of the next pour.

    Args:
        process: of the cost.
        pour: (dimension,), the best by its own loss and savings.
        candidates: (m, dimension), the first of them all over the region.
        poured: (k, dimension), actions that were poured and may be again; k ≥ 0.
        pours_left: H.
        allowed: applies limits and refusals to values (p,) of pours at places (p, dimension).
        feasibility: of requests; None if no request was refused.
    """
    if pours_left == 0:
        return pour
    means, deviations, noises = process.components(candidates)
    costs = clipped_mean(means, deviations)
    # Disputed: variance of the means between hypotheses, Var_j m_j(x), over a pour's noise.
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
    targets = np.unique(np.concatenate([places, poured, candidates[others]]), axis=0)
    if feasibility is not None and (likely := feasibility.likely(targets)).any():
        targets = targets[likely]
    # E c(x) − H (min_x′ E c(x′) − E_y min_x′ E[c(x′) | y at x]): less H knowledge gradients (Frazier et al. 2009)
    now = float(process.predict(targets)[0].min())
    value = process.predict(places)[0] - pours_left * (
        now - process.worst * predicted_minimum(process, places, targets)
    )
    return np.asarray(places[int(np.argmin(allowed(value / process.worst, places)))])


def predicted_minimum(process: ModelAveragedProcess, places: Array, targets: Array) -> Array:
    """Least expected cost (p,) over targets (m, dimension), in units of the worst, after a pour at places (p, ·)."""
    means, deviations, _ = process.components(targets)
    place_means, place_deviations, noises = process.components(places)
    spreads = np.hypot(place_deviations, noises)
    covariances = process.covariances(places, targets)
    edges = np.concatenate([[-np.inf], 0.5 * (SHOWN[1:] + SHOWN[:-1]), [np.inf]])
    minima = []
    # After y at place i, hypothesis j has (Rasmussen & Williams, equations 2.25 and 2.26 with one observation more)
    #     m_j(x′) + slope (y − m_j(x_i)),  s_j²(x′) − slope cov_j,    slope = cov_j(x_i, x′) / (s_j²(x_i) + n_j²)
    # and y = SHOWN[k] with the probability chances[k, j]; Σ_k min_x′ Σ_j w_j chances[k, j] E clip(f_j(x′)) is E_y min.
    for i in range(len(places)):
        chances = np.diff(ndtr((edges[:, None] - place_means[:, i]) / spreads[:, i]), axis=0)  # (shown, components)
        slope = covariances[:, i] / spreads[:, i, None] ** 2
        posterior_deviations = np.sqrt(np.maximum(deviations**2 - slope * covariances[:, i], 1e-10))
        weights = chances * process.mixture
        k, c = np.nonzero(weights > LEAST_CHANCE)  # pairs (p,): most hypotheses expect only a few of the outcomes
        moved = means[c] + slope[c] * (SHOWN[k] - place_means[c, i])[:, None]
        costs = weights[k, c, None] * clipped_mean(moved, posterior_deviations[c])
        minima.append(float(np.add.reduceat(costs, np.flatnonzero(np.diff(k, prepend=-1))).min(axis=1).sum()))
    return np.array(minima)


Score = Callable[[Array], Array]

LATEST = 8
"""Number of poured places, and of places for the next pours, that simulations are made for."""

FORESIGHT = 4
"""Largest number of pours whose savings count: later pours could find the same otherwise."""

GAIN_AT = 256
"""Number of places all over the region at which the gain of one more pour is computed."""

DRAWN = 64
"""Number of bench offsets that are passed on to another receiver."""

FORBIDDEN = 1e3
"""Penalty per unit of probability above a limit's, in units of the largest cost."""


def least_loss(
    process: ModelAveragedProcess, discrepancy: ModelDiscrepancy, poured: Array, feasibility: Feasibility | None = None
) -> Score:
    """Return the score of a pour, to be minimised.

    Args:
        process: of the cost.
        discrepancy: for H and the limit.
        poured: (k, dimension), actions that were poured and may be again; k ≥ 0.
        feasibility: of requests; None if no request was refused. An infeasible pour counts as the worst cost.
    """
    best = float(process.predict(poured)[0].min()) / process.worst if len(poured) else 0.0
    pours_left = min(discrepancy.pours_left, FORESIGHT) if len(poured) else 0
    allowed = _allowed(process, discrepancy, feasibility)

    # E clip(f, 0, 1) − H E (b − f⁺)⁺ by hypothesis, averaged; (b − f⁺)⁺ = (b − f)⁺ − (0 − f)⁺ for b ≥ 0.
    def score(points: Array) -> Array:
        means, deviations, _ = process.components(points)
        saved = shortfall(best, means, deviations) - shortfall(0.0, means, deviations)
        return allowed(process.mixture @ (clipped_mean(means, deviations) - pours_left * saved), points)

    return score


def robust_first_pour(
    process: ModelAveragedProcess,
    discrepancy: ModelDiscrepancy,
    score: Score,
    pour: Array,
    candidates: Array,
    region: Region,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> Array:
    """Return the place (dimension,) of the first pour after a calibration.

    Along a valley many actions are expected to lose nearly the same, and the simulator's small errors choose among
    them. Of those within `RESOLUTION` of the best, this is the one with the least expected loss without calibration.

    Args:
        process: of the cost, with the calibration.
        score: of a pour by the process.
        pour: (dimension,), the best by that score.
        candidates: (m, dimension).

    Source: restricted Bayes solution, Hodges & Lehmann, Annals of Mathematical Statistics 1952.
    """
    unknown = replace(discrepancy, calibration=None, limit=None)
    none = np.empty((0, len(pour)))
    alone = least_loss(ModelAveragedProcess(process.simulated, none, np.empty(0), unknown), unknown, none, feasibility)
    most = float(score(pour[None, :])[0]) + RESOLUTION

    def robust(points: Array) -> Array:
        return alone(points) + FORBIDDEN * np.maximum(score(points) - most, 0.0)

    return acquisition.minimise(robust, np.concatenate([pour[None, :], candidates]), region, rng)


def _allowed(
    process: ModelAveragedProcess, discrepancy: ModelDiscrepancy, feasibility: Feasibility | None
) -> Callable[[Array, Array], Array]:
    """Return a function that applies the limit and the feasibility to values (m,) of pours at points (m, dimension)."""

    def changed(value: Array, points: Array) -> Array:
        # Penalty FORBIDDEN (P(y > loss) − p)⁺, then P value + (1 − P) · 1: a refused pour counts as the worst.
        if discrepancy.limit is not None:
            over = process.exceedance(points, discrepancy.limit.loss) - discrepancy.limit.probability
            value = value + FORBIDDEN * np.maximum(over, 0.0)
        if feasibility is not None:
            probability = np.exp(feasibility.log_probability(points))
            value = probability * value + (1.0 - probability)
        return np.asarray(value)

    return changed


def pour_gains(process: ModelAveragedProcess, points: Array, poured: Array) -> Array:
    """Gain g (m,) of one more pour at points (m, dimension), given poured ones (k ≥ 1, dimension), in cost units."""
    place = poured[int(np.argmin(process.predict(poured)[0]))]
    means, deviations, noises = process.components(points)
    at_best, its_deviation, _ = (component[:, 0] for component in process.components(place[None, :]))
    best = shortfall(0.0, -at_best, its_deviation)[:, None]  # E f⁺ of each component
    # s̃ = s² / √(s² + n²): deviation of the change that a pour makes in the expected difference (Frazier et al. 2009)
    doubt = process.differences(points, place)
    doubt = doubt**2 / np.hypot(doubt, noises)
    expected = shortfall(0.0, -means, deviations)
    # E d⁺ = E (E b⁺ − N(E f⁺, s̃²))⁺, at most E (b_j − f_j⁺)⁺, the gain of perfect knowledge
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
    """Choose places (count, dimension) for simulations.

    Args:
        process: of the real cost.
        count: number of places.
        candidates: (m, dimension), possible places of pours.
        score: of pours.
        pour: (dimension,), the next one.
        pending: (b, dimension), pending simulations.
        region: of the simulations.
    """
    if count == 0:
        return np.empty((0, len(pour)))
    to_come = candidates[np.argsort(score(candidates), kind="stable")[:LATEST]]
    targets = np.concatenate([process.points[-LATEST:], pour[None, :], to_come])
    # Variance of e^{g_j} f̂_s at the places that hypothesis j assigns to the targets: its weight is w_j e^{2 g_j}.
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

    # One more simulation at a: G(x, x′) −= G(x, a) G(a, x′) / (G(a, a) + n²), the posterior covariance
    def observe(index: int) -> None:
        G[:] -= np.outer(G[:, index], G[index]) / (max(float(G[index, index]), 0.0) + noise)

    for index in range(len(places), len(everything)):
        observe(index)
    chosen = []
    for _ in range(count):
        # Reduction by a: Σ_t importance_t G(a, t)² / (G(a, a) + n²) (Cohn 1996), the largest one is taken
        variances = np.maximum(np.diagonal(G[:, : len(everything)])[: len(places)], 0.0) + noise
        removed = (G[: len(places), len(everything) :] ** 2 @ importance) / variances
        best = int(np.argmax(removed))
        chosen.append(places[best])
        observe(best)
    return np.array(chosen).reshape(count, len(pour))


def proposals(
    query: PourQuery,
    arrays: QueryArrays,
    process: ModelAveragedProcess,
    candidates: Array,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> Array:
    """(count, dimension): the next pour, followed by simulations. Candidates (m, dimension), m ≥ 1."""
    if query.count == 0:
        return np.empty((0, query.space.dimension))
    assert query.discrepancy is not None
    poured = pourable(arrays, feasibility)
    score = least_loss(process, query.discrepancy, poured, feasibility)
    candidates = np.concatenate([candidates, poured])
    pour = acquisition.minimise(score, candidates, arrays.region, rng)
    pours_left = min(query.discrepancy.pours_left, FORESIGHT)
    allowed = _allowed(process, query.discrepancy, feasibility)
    if query.discrepancy.calibration is not None and not len(process.points):
        pour = robust_first_pour(process, query.discrepancy, score, pour, candidates, arrays.region, feasibility, rng)
    if query.discrepancy.lookahead and len(poured):
        pour = looked_ahead(process, pour, candidates, poured, pours_left, allowed, feasibility)
    if found_good(arrays.simulated_costs) or found_good(arrays.costs):
        simulations = instructive(process, query.count - 1, candidates, score, pour, arrays.busy, arrays.region)
    else:
        avoided = np.concatenate([arrays.simulated, arrays.busy])
        simulations = acquisition.between(query.count - 1, avoided, arrays.region, rng, feasibility)
    return np.concatenate([pour[None, :], simulations])


def pourable(arrays: QueryArrays, feasibility: Feasibility | None) -> Array:
    """Poured places (k, dimension) that may be poured again."""
    allowed = arrays.known[arrays.region.allows(arrays.known)]
    return allowed if feasibility is None or not len(allowed) else allowed[feasibility.likely(allowed)]


def found(
    query: PourQuery,
    arrays: QueryArrays,
    process: ModelAveragedProcess,
    points: Array,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> DiscrepancyFound:
    """Return the conclusions about the simulator, and the gain of one more pour."""
    assert query.discrepancy is not None
    limit, poured = query.discrepancy.limit, pourable(arrays, feasibility)
    candidates = arrays.region.draw(GAIN_AT, rng, even=True)
    if len(points):
        candidates = np.concatenate([candidates, points[:1], _near(points[0], arrays.region, rng)])
    candidates = np.concatenate([candidates, poured])
    over = np.zeros(len(candidates)) if limit is None else process.exceedance(candidates, limit.loss)
    gain = None
    if len(poured):
        allowed = over <= (1.0 if limit is None else limit.probability)
        gain = float(pour_gains(process, candidates[allowed], poured).max()) if allowed.any() else None
    shifts, deviations, factor = process.displaced()
    drifts = process.drifts
    offsets: tuple[BenchOffset, ...] = ()
    if query.count == 0:
        offsets = tuple(BenchOffset(*pair) for pair in zip(*map(tuples, process.drawn(DRAWN)), strict=True))
    return DiscrepancyFound(
        uninformative=process.uninformative,
        shifts=tuple(map(float, shifts)),
        deviations=tuple(map(float, deviations)),
        factor=factor,
        gain=gain,
        exceedances=() if limit is None else tuple(map(float, process.exceedance(points, limit.loss))),
        least_exceedance=None if limit is None else float(over.min()),
        drawn=offsets,
        since_change=None if process.since is None else len(process.points) - process.since,
        drifts=None if drifts is None else tuple(map(float, drifts)),
    )


def _near(point: Array, region: Region, rng: np.random.Generator) -> Array:
    """Allowed places around a point: the minimum is often close to the next pour."""
    cloud = region.snap(np.clip(point + 0.05 * rng.standard_normal((64, len(point))), 0.0, 1.0))
    return cloud[region.allows(cloud)]
