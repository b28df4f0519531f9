"""`propose`: from a query to a suggestion. Pure: the same query has the same answer on the same machine.

`check` rejects invalid queries. `describe`, `posterior_of` and `design_of` compute the parts of an answer: predictions,
best observation, map, draws of θ. `slices` returns the surrogate over every pair of its axes, for plots of spaces with
more than two.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from actors.optimizer import acquisition
from actors.optimizer.feasible_region import Feasibility, Region
from actors.optimizer.knowledge_gradient import found, proposals
from actors.optimizer.prediction_intervals import observation_intervals
from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    DesignQuestion,
    MinimumQuery,
    ModelDiscrepancy,
    Point,
    Posterior,
    PosteriorQuestion,
    PourQuery,
    ProposalQuery,
    SpaceFillingQuery,
    Suggestion,
    SuggestionQuery,
    SurrogateMap,
    SurrogateQuery,
    found_good,
)
from actors.optimizer.surrogate_models import Model, QueryArrays, array, fit, tuples
from actors.optimizer.theta_posterior import (
    DISCREPANCY_PRIOR,
    WeighedDesign,
    drawn_beforehand,
    expected_reductions,
    sample_posterior,
)
from sim_engine.prediction_band import LEVEL

Array = NDArray[np.float64]

MOST_AVERAGED = 100
"""Largest number of observations with intervals averaged over hyperparameters; more determine them well."""


def describe(
    query: SurrogateQuery, arrays: QueryArrays, model: Model, points: Array, feasibility: Feasibility | None
) -> dict[str, object]:
    """Return the surrogate's results about the proposals, the observations and further points."""
    observed = _recommendable(arrays, feasibility)
    means, deviations = model.surrogate.predict(observed)
    best, ranges = _best(query, arrays, model, observed, means, feasibility)
    description = _about_proposals(query, model, points)
    description |= _about_best(query, model, observed[best], float(means[best]), float(deviations[best]))
    if ranges is not None:
        description["equal_ranges"] = ranges
    if query.predict_at:
        places = arrays.region.snap(array(query.predict_at, query.space.dimension))
        predictions, spreads = model.surrogate.predict(places)
        description["predictions"] = tuple(map(float, predictions))
        description["prediction_deviations"] = tuple(map(float, spreads))
    if query.map_resolution and query.space.dimension >= 2:
        sought = _seeks_minimum(query) and len(points) > 0
        at = np.array(query.map_at) if query.map_at else points[0] if sought else observed[best]
        across, up = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:2])
        description["surrogate"] = mapped(query, arrays.region, model, at, (across, up), query.map_resolution)
    return description


def _recommendable(arrays: QueryArrays, feasibility: Feasibility | None) -> Array:
    """Places (n, dimension) that the best one is chosen from: observed ones that can probably be executed."""
    observed = arrays.known if len(arrays.known) else arrays.simulated
    if feasibility is not None:
        observed = observed[feasibility.likely(observed)]
    allowed = arrays.region.allows(observed)
    return observed[allowed] if allowed.any() else observed  # prior data may lie outside the current constraints


def _best(
    query: SurrogateQuery,
    arrays: QueryArrays,
    model: Model,
    observed: Array,
    means: Array,
    feasibility: Feasibility | None,
) -> tuple[int, tuple[tuple[float, float], ...] | None]:
    """Index of the best of the observed places (n, dimension) with posterior means (n,).

    With `SurrogateQuery.equality`, also the ranges that are equal to it.
    """
    expected = means
    if feasibility is not None and len(arrays.costs):
        # E = P m(x) + (1 − P) · (largest observed cost), P that the pour does not fail
        probability = feasibility.made(observed)
        expected = probability * means + (1.0 - probability) * arrays.costs.max()
    best = int(np.argmin(expected))
    if query.equality is None:
        return best, None
    # between observations a surrogate falls below every cost, which makes no point better than the best observed
    costs = arrays.costs if len(arrays.costs) else arrays.simulated_costs
    limit = max(float(expected[best]), float(costs.min())) + query.equality.tolerance
    equal = _EqualPoints(limit, query.equality.speed, query.space.names, arrays.region, model, feasibility)
    best = equal.gentlest(observed, expected, query.seed)
    return best, equal.ranges(observed[best])


def _about_proposals(query: SurrogateQuery, model: Model, points: Array) -> dict[str, object]:
    """Predictions at the proposals (m, dimension)."""
    means, deviations = model.surrogate.predict(points) if len(points) else (np.empty(0), np.empty(0))
    noises = () if isinstance(query, CalibrationQuery) else tuple(map(float, model.noise_at(points)))
    description: dict[str, object] = {
        "means": tuple(map(float, means)),
        "deviations": tuple(map(float, deviations)),
        "noises": noises,
    }
    if model.averaged is not None and len(points):
        description["bands"] = tuples(model.averaged.bands(points, LEVEL))
    elif _announces_pours(query) and len(points) and len(model.process.points) <= MOST_AVERAGED:
        description["bands"] = tuples(observation_intervals(model.process, points, LEVEL))
    return description


def _about_best(query: SurrogateQuery, model: Model, place: Array, mean: float, deviation: float) -> dict[str, object]:
    """The best place (dimension,) with its posterior mean and deviation, and the fitted values."""
    process = model.process
    lengths = zip((f"length.{name}" for name in _axis_names(query)), map(float, process.lengths), strict=True)
    return {
        "best_point": tuple(map(float, place)),
        "best_mean": mean,
        "best_deviation": deviation,
        "best_noise": None if isinstance(query, CalibrationQuery) else float(model.noise_at(place[None, :])[0]),
        "hyperparameters": {
            "signal": process.signal,
            "noise": process.noise,
            **({} if model.averaged is None else model.averaged.hyperparameters),
            **dict(lengths),
        },
    }


EQUAL_PLACES = 1024
"""Number of points of the region by which its equal part is known."""

EQUAL_STEPS = 101
"""Number of places along an axis at which equality is tested."""


@dataclass(frozen=True)
class _EqualPoints:
    """The points of a region whose expected cost is equal to the smallest one.

    Attributes:
        limit: largest expected cost that counts as equal.
        speed: see `Equality`.
    """

    limit: float
    speed: str
    names: Sequence[str]
    region: Region
    model: Model
    feasibility: Feasibility | None

    def gentlest(self, observed_points: Array, expected: Array, seed: int) -> int:
        """Index of the gentlest of the observed points (n, dimension) with an expected cost (n,) equal to the smallest.

        It is no faster than the middle of the equal part of the region, if possible, and the nearest to this middle.
        """
        equal = np.flatnonzero(expected <= self.limit)
        places = self.region.draw(EQUAL_PLACES, np.random.default_rng(seed), even=True)
        middle = np.concatenate([observed_points[equal], places[self._equal(places)]]).mean(axis=0)
        candidates = equal
        if self.speed:
            speed = self.names.index(self.speed)
            slow = equal[observed_points[equal, speed] <= middle[speed]]
            candidates = slow if len(slow) else equal
        return int(candidates[np.argmin(((observed_points[candidates] - middle) ** 2).sum(axis=1))])

    def ranges(self, point: Array) -> tuple[tuple[float, float], ...]:
        """By axis, the ends of the equal interval around a point (dimension,)."""
        ends = []
        for axis in range(len(point)):
            steps = np.unique(np.append(np.linspace(0.0, 1.0, EQUAL_STEPS), point[axis]))
            line = np.tile(point, (len(steps), 1))
            line[:, axis] = steps
            at = int(np.searchsorted(steps, point[axis]))
            equal = self._equal(line)
            equal[at] = True
            below, above = np.flatnonzero(~equal[:at]), np.flatnonzero(~equal[at:])
            first = int(below[-1]) + 1 if len(below) else 0
            last = at + int(above[0]) - 1 if len(above) else len(steps) - 1
            ends.append((float(steps[first]), float(steps[last])))
        return tuple(ends)

    def _equal(self, points: Array) -> NDArray[np.bool_]:
        """Which points (m, dimension) are equal to the minimiser: (m,)."""
        snapped = self.region.snap(points)
        means = self.model.surrogate.predict(snapped)[0]
        equal = self.region.allows(snapped) & (means <= self.limit)
        return equal if self.feasibility is None else equal & self.feasibility.likely(snapped)


def _announces_pours(query: SurrogateQuery) -> bool:
    """Whether the proposals are pours whose prediction a user sees: with a map, if the query is not for pours only."""
    return isinstance(query, PourQuery) or (
        isinstance(query, MinimumQuery) and query.map_resolution > 0 and not query.plain
    )


def posterior_of(
    query: CalibrationQuery, question: PosteriorQuestion, region: Region, model: Model, rng: np.random.Generator
) -> Posterior:
    """Return draws of θ given weighed pours."""
    contexts = array(question.contexts, query.context_dimension)
    if not len(contexts):
        prior, memory = array(question.prior, 2), question.memory or ()
        draws = drawn_beforehand(question.count, query.space.dimension, prior, rng, memory)
        discrepancies = (DISCREPANCY_PRIOR[0],) * question.count
        held = None if question.memory is None else tuple(group.weight for group in memory)
        return Posterior(tuples(region.snap(draws)), discrepancies, float(question.count), held)
    sampled = sample_posterior(
        model.process,
        contexts,
        np.array(question.offsets),
        noise=question.noise,
        count=question.count,
        snap=region.snap,
        rng=rng,
        prior=array(question.prior, 2),
        memory=question.memory or (),
    )
    held = None if question.memory is None else sampled.held
    return Posterior(tuples(sampled.points), tuple(map(float, sampled.discrepancies)), sampled.effective, held)


def design_of(
    query: CalibrationQuery, question: DesignQuestion, pours: PosteriorQuestion, model: Model, posterior: Posterior
) -> dict[str, object]:
    """Return the expected information of weighing a pour at each candidate, in addition to those made."""
    context_dimension = query.context_dimension
    gains, variance = expected_reductions(
        model.process,
        np.array(posterior.points),
        np.array(posterior.discrepancies),
        WeighedDesign(array(pours.contexts, context_dimension), np.array(pours.offsets), pours.noise),
        array(question.candidates, context_dimension),
        array(question.targets, context_dimension),
    )
    return {"gains": tuple(map(float, gains)), "uncertainty": variance}


def _axis_names(query: SurrogateQuery) -> list[str]:
    return [*query.space.names, *(f"context{i + 1}" for i in range(query.context_dimension))]


def mapped(
    query: SurrogateQuery, region: Region, model: Model, at: Array, axes: tuple[int, int], resolution: int
) -> SurrogateMap:
    """The surrogate on the plane through `at`, shape (dimension,), that two axes of the space span."""
    across, up = axes
    # x(u, v) = at, but with u and v, both 0 … 1, on the axes `across` and `up`
    places = np.linspace(0.0, 1.0, resolution)
    first, second = np.meshgrid(places, places)
    grid = np.tile(at, (first.size, 1))
    grid[:, across], grid[:, up] = first.ravel(), second.ravel()
    mean, deviation = model.surrogate.predict(region.snap(grid))
    shape, names = first.shape, query.space.names
    cut: tuple[tuple[str, ...], Point] = ((), ())
    if query.space.dimension > 2:
        cut = (names[across], names[up]), tuple(map(float, at))
    return SurrogateMap(tuples(mean.reshape(shape)), tuples(deviation.reshape(shape)), *cut)


FILL_EVERY = 3
"""One proposal in this many only fills space; see `_fills_space`."""

STRUCTURE = 2.0
"""Gain of the log-likelihood above which the costs are more than noise."""

SETTLED = 0.5
"""Factor on κ once the costs are more than noise."""


def propose(query: SuggestionQuery) -> Suggestion:
    """Answer a query.

    With fewer than two observations there is no surrogate, and the points are Sobol points far from the known ones.
    Local penalisation avoids pending points and the other points of the same answer.

    Raises:
        ValueError: the query cannot be answered: numbers that are not finite, wrong dimensions, sizes too large for a
            dense GP.

    Limitations: linear algebra differs between machines in the last bits, and so do proposals: journal the answer.
    """
    check(query)
    started = time.process_time()
    with threadpool_limits(1):  # threads only slow down matrices this small, and sums in a fixed order are repeatable
        answer = _fill_space(query) if isinstance(query, SpaceFillingQuery) else _answer(query)
    return replace(answer, seconds=time.process_time() - started)


def _fill_space(query: SpaceFillingQuery) -> Suggestion:
    tried = Data(query.known, (0.0,) * len(query.known))
    places = {name: getattr(query, name) for name in ("constraints", "infeasible", "refused", "failed", "pending")}
    arrays = QueryArrays.of(MinimumQuery(query.space, tried, **places))
    feasibility, rng = arrays.feasibility(), np.random.default_rng(query.seed)
    points = acquisition.spread_out(query.count, arrays.taken, arrays.region, rng, feasibility)
    return Suggestion(tuples(points), feasibilities=_feasibilities(feasibility, points))


def _answer(query: SurrogateQuery) -> Suggestion:
    rng = np.random.default_rng(query.seed)
    arrays = QueryArrays.of(query)
    model = fit(query, arrays)
    feasibility = arrays.feasibility()
    answer: dict[str, object] = {}
    points = np.empty((0, query.space.dimension))
    if isinstance(query, ProposalQuery) and model is None:
        points = acquisition.spread_out(query.count, arrays.taken, arrays.region, rng, feasibility)
    elif isinstance(query, PourQuery) and query.acquisition == "least_loss" and model is not None and model.averaged:
        points = proposals(query, arrays, model.averaged, _candidates(arrays, model, rng), feasibility, rng)
    elif isinstance(query, ProposalQuery) and model is not None:
        points = _search(query, arrays, model, feasibility, rng)

    if model is not None:
        answer |= describe(query, arrays, model, points, feasibility)
        if isinstance(query, CalibrationQuery) and query.posterior is not None:
            posterior = posterior_of(query, query.posterior, arrays.region, model, rng)
            answer["posterior"] = posterior
            if query.design is not None:
                answer |= design_of(query, query.design, query.posterior, model, posterior)
        if isinstance(query, PourQuery) and model.averaged is not None:
            answer["discrepancy"] = found(query, arrays, model.averaged, points, feasibility, rng)
    answer["feasibilities"] = _feasibilities(feasibility, points)
    return Suggestion(tuples(points), **answer)  # type: ignore[arg-type]


def _feasibilities(feasibility: Feasibility | None, points: Array) -> tuple[float, ...]:
    if feasibility is None or not len(points):
        return ()
    # P = exp Σ_k ln P_k over the kinds of requests, as in `Feasibility`
    return tuple(map(float, np.exp(feasibility.log_probability(points))))


def _candidates(arrays: QueryArrays, model: Model, rng: np.random.Generator) -> Array:
    """Candidates for the search: all over the region, and around the best observations."""
    seen = arrays.seen
    means = model.surrogate.predict(seen)[0]
    # the seen places with the four smallest m(x)
    around = [seen[i] for i in np.argsort(means, kind="stable")[:4]]
    return acquisition.search_candidates(arrays.region, seen.shape[1], around, rng)


def _search(
    query: ProposalQuery, arrays: QueryArrays, model: Model, feasibility: Feasibility | None, rng: np.random.Generator
) -> Array:
    """`count` minimisers of the acquisition, each avoiding the pending points and the ones before it."""
    chosen: list[Array] = []
    surrogate = model.surrogate
    if query.count:
        candidates = _candidates(arrays, model, rng)
    for index in range(query.count):
        pending = np.concatenate([arrays.busy, np.array(chosen).reshape(-1, query.space.dimension)])
        if _fills_space(query, arrays, model, index):
            avoided = np.concatenate([arrays.known, pending, arrays.refused])
            describes = isinstance(query, MinimumQuery) and not query.replicates
            fill = acquisition.between if describes else acquisition.spread_out
            chosen.append(fill(1, avoided, arrays.region, rng, feasibility)[0])
            continue
        conclude = _seeks_minimum(query) and index == 0
        # m(x) − κ s(x); κ = 0 gives the minimiser of the mean, whatever is pending
        score = acquisition.lower_confidence_bound(surrogate, 0.0 if conclude else _kappa(query, model))
        score = acquisition.penalised(score, surrogate, pending[:0] if conclude else pending, candidates, feasibility)
        if isinstance(query, MinimumQuery) and not query.replicates:
            score = acquisition.without_replicates(score, surrogate, model.process.noise)
        chosen.append(acquisition.minimise(score, candidates, arrays.region, rng))
    return np.array(chosen).reshape(query.count, query.space.dimension)


def _seeks_minimum(query: SurrogateQuery) -> bool:
    """Whether the first proposal is the minimiser of the posterior mean."""
    return isinstance(query, MinimumQuery | PourQuery) and query.acquisition == "posterior_minimum"


def _fills_space(query: ProposalQuery, arrays: QueryArrays, model: Model, index: int) -> bool:
    """Whether the next point only fills space: every third one, while the costs may be pure noise.

    Without replicates, every third one always does, and two of three until a good one was found: a smooth plateau
    would make the surrogate certain that there is no valley.

    On a plateau the best pours look like a slope by chance. Following them, mostly along the faces of the cube, would
    use up the whole budget. Only a `MinimumQuery` does so, without `plain` and with a constant mean.
    """
    if not isinstance(query, MinimumQuery) or query.plain or query.mean != "constant" or _seeks_minimum(query):
        return False
    # `evidence`: log-likelihood ratio of the GP and pure noise; e² : 1 (STRUCTURE) counts as structure.
    number = len(arrays.known) + len(arrays.busy) + index
    if query.replicates:
        return number % FILL_EVERY == FILL_EVERY - 1 and model.process.evidence < STRUCTURE
    return (number % FILL_EVERY == FILL_EVERY - 1) if found_good(arrays.costs) else number % FILL_EVERY != 0


def _kappa(query: ProposalQuery, model: Model) -> float:
    """κ of the next point: half of it once the costs show structure.

    A constant κ continues to explore unknown regions long after the valley has been found, and a budget of twenty ends
    before its bottom is reached. The paper's methods (`plain`, the mean 'zero', pours after simulations), and contexts,
    are excluded.
    """
    adapts = isinstance(query, MinimumQuery) and query.mean == "constant" and not query.plain
    # κ/2 if ln p(y | GP) − ln p(y | noise) ≥ STRUCTURE
    return query.kappa * (SETTLED if adapts and model.process.evidence >= STRUCTURE else 1.0)


MOST_AXES = 4


def slices(query: SurrogateQuery, suggestion: Suggestion, resolution: int = 15) -> tuple[SurrogateMap, ...]:
    """The surrogate over every pair of its axes, the others held as in `suggestion.surrogate`.

    Of more than `MOST_AXES` axes, those with the shortest lengthscales are used.

    Args:
        query: the query to the optimiser.
        suggestion: its answer, with a surrogate.
        resolution: number of places along an axis.

    Returns:
        Pairs in the space's order: (0, 1), (0, 2) … ; empty for a space of two axes.

    Limitations: answers contain one map only, because they are journalled. The surrogate is fitted again here, which
    takes as long as the first fit, and is identical except for the last bits on another machine.
    """
    if suggestion.surrogate is None or query.space.dimension <= 2:
        return ()
    with threadpool_limits(1):
        arrays = QueryArrays.of(query)
        model = fit(query, arrays)
        if model is None:
            return ()
        axes = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:MOST_AXES])
        at = np.array(suggestion.surrogate.at)
        return tuple(
            mapped(query, arrays.region, model, at, pair, resolution) for pair in itertools.combinations(axes, 2)
        )


MAX_OBSERVATIONS = 2_000
"""Above it a fit takes minutes (O(n³)); a campaign that needs more should not use a dense GP."""
MAX_COUNT = 256
MAX_RESOLUTION = 200
MAX_PREDICTIONS = 100_000


def check(query: SuggestionQuery) -> None:
    """Reject queries that would lead to NaN or an endless computation.

    Raises:
        ValueError: names the invalid number and the valid range.
    """
    places = {name: getattr(query, name) for name in ("infeasible", "refused", "failed")}
    counts = []
    if isinstance(query, SpaceFillingQuery | ProposalQuery):
        places["pending"] = query.pending
        counts.append(("count", query.count, MAX_COUNT))
    if isinstance(query, SpaceFillingQuery):
        places["known"] = query.known
    else:
        places |= {"predict_at": query.predict_at, "map_at": (query.map_at,) if query.map_at else ()}
        counts.append(("map_resolution", query.map_resolution, MAX_RESOLUTION))
        counts.append(("len(predict_at)", len(query.predict_at), MAX_PREDICTIONS))
        _check_surrogate(query)
    for name, points in places.items():
        _check_points(name, points, query.space.dimension)
    for name, value, limit in counts:
        if not 0 <= value <= limit:
            raise ValueError(f"{name} = {value} is outside 0 … {limit}")
    _check_constraints(query)


def _check_surrogate(query: SurrogateQuery) -> None:
    dimension = query.space.dimension
    observed = {"data": query.data}
    if isinstance(query, PourQuery):
        observed["simulated"] = query.simulated
        _check_points("simulated", query.simulated.points, dimension)
    if isinstance(query, CalibrationQuery):
        _check_calibration(query)
    if isinstance(query, PourQuery):
        if query.discrepancy is not None:
            _check_discrepancy(query.discrepancy, dimension)
        elif query.acquisition == "least_loss":
            raise ValueError("acquisition='least_loss' needs a discrepancy")
    _check_points("data", query.data.points, dimension + query.context_dimension)
    for name, data in observed.items():
        for index, cost in enumerate(data.costs):
            if not math.isfinite(cost) or abs(cost) > 1e12:
                raise ValueError(f"{name}: cost {index} is {cost}; leave failed trials out, or penalise them")
    observations = sum(map(len, observed.values())) + len(query.infeasible) + len(query.refused)
    if observations > MAX_OBSERVATIONS:
        raise ValueError(f"{observations} observations and refusals, but at most {MAX_OBSERVATIONS} can be fitted")
    if not (math.isfinite(query.kappa) and 0.0 <= query.kappa <= 100.0):
        raise ValueError(f"kappa = {query.kappa} is outside 0 … 100")


def _check_calibration(query: CalibrationQuery) -> None:
    if not query.contexts:
        raise ValueError("contexts: none; differences are averaged over at least one")
    if len(lengths := {len(point) for point in query.contexts}) > 1:
        raise ValueError(f"context points of different lengths: {sorted(lengths)}")
    _check_points("contexts", query.contexts, query.context_dimension)
    _check_posterior(query)


def _check_discrepancy(discrepancy: ModelDiscrepancy, dimension: int) -> None:
    offsets = (values for offset in discrepancy.drawn for values in (offset.scales, offset.shifts))
    sizes = {len(discrepancy.offset_priors), *map(len, offsets)}
    if sizes != {dimension}:
        raise ValueError(f"discrepancy: priors and bench offsets have {sorted(sizes)} axes, the space has {dimension}")
    valid = 0.0 < discrepancy.uninformative < 1.0 and 0.0 < discrepancy.worst < math.inf
    if not valid or discrepancy.pours_left < 0:
        raise ValueError("discrepancy: 0 < uninformative < 1, worst > 0 and pours_left ≥ 0 are required")
    for pours in discrepancy.calibration or ():
        _check_points("calibration", pours.points, dimension)
        if not 2 <= len(pours.points) == len(pours.costs) == len(pours.simulated) or not 0.0 < pours.power <= 1.0:
            raise ValueError("calibration: two pours at least, two costs of each and 0 < power ≤ 1 are required")
        if not all(math.isfinite(cost) for cost in (*pours.costs, *pours.simulated)):
            raise ValueError("calibration: a cost is not finite")
        if pours.misled is not None and not 0.0 < pours.misled < 1.0:
            raise ValueError(f"calibration: misled = {pours.misled} is outside (0, 1)")


def _check_posterior(query: CalibrationQuery) -> None:
    question = query.posterior
    if question is None:
        if query.design is not None:
            raise ValueError("a design needs a posterior: what is known of the searched parameters")
        return
    _check_points("posterior", question.contexts, query.context_dimension)
    for name, points in (
        ("candidates", () if query.design is None else query.design.candidates),
        ("targets", () if query.design is None else query.design.targets),
    ):
        _check_points(name, points, query.context_dimension)
        if query.design is not None and not points:
            raise ValueError(f"design: no {name}")
    nothing_weighed = query.design is not None and not question.offsets
    if len(question.offsets) != len(question.contexts) or not (question.contexts or nothing_weighed):
        raise ValueError(f"posterior: {len(question.contexts)} pours but {len(question.offsets)} offsets")
    if not all(math.isfinite(value) for value in (*question.offsets, question.noise)) or question.noise < 0.0:
        raise ValueError("posterior: offsets and noise must be finite, the noise not negative")
    if not 1 <= question.count <= 2000:
        raise ValueError(f"posterior: count = {question.count} is outside 1 … 2000")
    for group in question.memory or ():
        sizes = {len(group.axes), len(group.centres), len(group.deviations)}
        if len(sizes) > 1 or not all(0 <= axis < query.space.dimension for axis in group.axes):
            raise ValueError(f"posterior: the memory of the axes {group.axes} does not fit the space")
        if not (all(deviation > 0.0 for deviation in group.deviations) and 0.0 < group.weight < 1.0):
            raise ValueError("posterior: a memory needs deviations above 0 and a weight between 0 and 1")


def _check_constraints(query: SuggestionQuery) -> None:
    for index, constraint in enumerate(query.constraints):
        for name, weight in constraint.weights:
            if name not in query.space.names:
                raise ValueError(
                    f"constraints: {index} names {name!r}, but the axes are {', '.join(query.space.names)}"
                )
            if not math.isfinite(weight):
                raise ValueError(f"constraints: {index} has the weight {weight} for {name}")
        if not math.isfinite(constraint.upper):
            raise ValueError(f"constraints: {index} has the upper bound {constraint.upper}")


def _check_points(name: str, points: Sequence[Point], dimension: int) -> None:
    for index, point in enumerate(points):
        if len(point) != dimension:
            raise ValueError(f"{name}: point {index} has {len(point)} coordinates, expected {dimension}")
        if not all(math.isfinite(u) and -10.0 <= u <= 11.0 for u in point):
            raise ValueError(f"{name}: point {index} = {point} is not finite, or far outside the unit cube")
