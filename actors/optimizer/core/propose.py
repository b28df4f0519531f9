"""`propose`: from a question to an answer. Pure: the same question gets the same answer on the same machine."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits

from actors.optimizer.core import acquisition
from actors.optimizer.core.checks import check
from actors.optimizer.core.folded import AbsoluteProcess
from actors.optimizer.core.knowledge import Knowledge, most_instructive
from actors.optimizer.core.posterior import sample_posterior
from actors.optimizer.core.problem import (
    Data,
    Point,
    Posterior,
    PosteriorQuestion,
    Suggestion,
    SuggestProblem,
    SurrogateMap,
)
from actors.optimizer.core.region import Feasibility, Region
from actors.optimizer.core.risk import RiskProcess
from actors.optimizer.core.surrogate import (
    AFRESH,
    GaussianProcess,
    Search,
    Surrogate,
    constant_mean_process,
    joint_process,
    simulated_mean_process,
    zero_mean_process,
)

Array = NDArray[np.float64]


WORST = 8
"""Disturbances that an answer names as the worst of a request."""

FILL_EVERY = 3
STRUCTURE = 2.0
"""Gain of the log-likelihood from which the costs are more than noise."""

SETTLED = 0.5
"""Share of κ that is left once the costs are more than noise."""


def propose(problem: SuggestProblem) -> Suggestion:
    """Answer a `SuggestProblem`.

    With fewer than two observations there is no surrogate and the points are Sobol points, far from those known.
    Points asked for and not answered yet are avoided by local penalisation, as are the other points of the same
    answer.

    Raises:
        ValueError: the question can't be answered: numbers that are not finite, wrong dimensions, sizes beyond what
            a dense GP is for.

    Limitations: linear algebra differs between machines in the last bits, so proposals do too: journal the answer.
    """
    check(problem)
    with threadpool_limits(1):  # matrices this small only lose by threads, and sums in a fixed order are repeatable
        return _answer(problem)


def _answer(problem: SuggestProblem) -> Suggestion:
    started = time.process_time()
    rng = np.random.default_rng(problem.seed)
    asked = _Asked.of(problem)
    model = _fit(problem, asked)
    feasibility = asked.feasibility()

    knowledge: Knowledge | None = None
    if problem.acquisition == "random":
        points = asked.region.draw(problem.count, rng, even=False)
    elif problem.acquisition == "sobol" or model is None:
        taken = np.concatenate([asked.known, asked.busy, asked.refused])
        points = acquisition.spread_out(problem.count, taken, asked.region, rng, feasibility)
    elif problem.acquisition == "knowledge":
        candidates = _candidates(problem, asked, model, rng)
        knowledge = most_instructive(problem, model.process, candidates, asked.busy, asked.pouring, feasibility)
        points = knowledge.points
    else:
        points = _search(problem, asked, model, feasibility, rng)

    answer: dict[str, object] = {}
    if model is not None:
        answer = _describe(problem, asked, model, points, feasibility)
    if model is not None and problem.posterior is not None:
        answer["posterior"] = _posterior(problem, problem.posterior, asked.region, model, rng)
    if model is not None and problem.effort is not None:
        answer["fitted"] = _tuples([process.theta for process in model.fitted])
    if knowledge is not None:
        answer |= {"values": tuple(map(float, knowledge.values)), "pour_value": knowledge.pour_value}
    if feasibility is not None and len(points):
        answer["feasibilities"] = tuple(map(float, np.exp(feasibility.log_probability(points))))
    return Suggestion(
        points=_tuples(points),
        seconds=time.process_time() - started,
        **answer,  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class _Asked:
    """A problem as arrays, in an order that doesn't depend on who answered first, integer axes at whole numbers.

    Attributes:
        points: (n, dimension and context) of the observations, with their costs (n,).
        known: (n, dimension), the same without context.
        simulated: (k, dimension), with their costs (k,).
        busy: (b, dimension).
        infeasible: (i, dimension), refused of any kind of request.
        really_refused: (r, dimension), of real ones.
        pouring: (p, dimension).
    """

    region: Region
    points: Array
    costs: Array
    known: Array
    simulated: Array
    simulated_costs: Array
    busy: Array
    infeasible: Array
    really_refused: Array
    pouring: Array

    @classmethod
    def of(cls, problem: SuggestProblem) -> _Asked:
        """Read a problem."""
        dimension = problem.space.dimension
        contextual = dimension + problem.beside
        region = Region(problem.space, problem.constraints)
        points, costs = _sorted(problem.data, contextual)
        simulated, simulated_costs = _sorted(problem.simulated, dimension)
        points = region.snap(points)
        return cls(
            region,
            points,
            costs,
            points[:, :dimension],
            region.snap(simulated),
            simulated_costs,
            region.snap(_array(sorted(problem.pending), dimension)),
            region.snap(_array(sorted(problem.infeasible), dimension)),
            region.snap(_array(sorted(problem.refused), dimension)),
            region.snap(_array(sorted(problem.pouring), dimension)),
        )

    @property
    def seen(self) -> Array:
        """Where the cost was observed: really or in simulation; (n + k, dimension)."""
        return np.concatenate([self.known, self.simulated])

    @property
    def refused(self) -> Array:
        """Where anything was refused: (i + r, dimension)."""
        return np.concatenate([self.infeasible, self.really_refused])

    def feasibility(self) -> Feasibility | None:
        """How likely requests are not refused; None while none was."""
        kinds = [(self.seen, self.infeasible), (self.known, self.really_refused)]
        told = [(fulfilled, refused) for fulfilled, refused in kinds if len(refused)]
        return Feasibility(*told) if told else None


@dataclass(frozen=True)
class _Model:
    """A fitted surrogate.

    Attributes:
        surrogate: of what is minimised.
        process: with the observations in it.
        lengths: (dimension,) lengthscales of the searched axes. Around a simulated mean they are the simulations':
            a handful of pours says little about what the pours' remainder depends on.
        fitted: all processes that were fitted, in order.
    """

    surrogate: Surrogate
    process: GaussianProcess
    lengths: Array
    fitted: tuple[GaussianProcess, ...]


def _fit(problem: SuggestProblem, asked: _Asked) -> _Model | None:
    """The surrogate that the problem asks for; None with too few observations."""
    points, costs = asked.points, asked.costs
    informed = problem.mean in ("simulated", "pooled", "scaled") and len(asked.simulated) >= 2
    varying = problem.noise == "varying"
    first = _search_for(problem, 0)
    if informed and problem.mean == "simulated":
        simulated = constant_mean_process(asked.simulated, asked.simulated_costs, search=first)
        if not len(points):
            return _Model(simulated, simulated, simulated.lengths, (simulated,))
        second = _search_for(problem, 1)
        process = simulated_mean_process(simulated, points, costs, varying=varying, search=second)
        return _Model(process, process, simulated.lengths, (simulated, process))
    if informed:
        process = joint_process(
            asked.simulated,
            asked.simulated_costs,
            points,
            costs,
            scaled=problem.mean == "scaled",
            varying=varying,
            widening=problem.widening,
            search=first,
        )
        return _Model(process, process, process.lengths, (process,))
    if len(points) < 2:
        return None
    build = zero_mean_process if problem.mean == "zero" else constant_mean_process
    process = build(points, costs, varying=varying, search=first)
    dimension = problem.space.dimension
    if problem.risk is not None:
        return _Model(RiskProcess.of(process, problem.risk), process, process.lengths[:dimension], (process,))
    if problem.context:
        context = _array(problem.context, points.shape[1] - dimension)
        return _Model(AbsoluteProcess(process, context), process, process.lengths[:dimension], (process,))
    return _Model(process, process, process.lengths, (process,))


def _search_for(problem: SuggestProblem, number: int) -> Search:
    """How the `number`-th process looks for its hyperparameters."""
    effort = problem.effort
    if effort is None or number >= len(effort.start):
        return AFRESH
    return Search(np.array(effort.start[number], dtype=np.float64), effort.iterations)


def _candidates(problem: SuggestProblem, asked: _Asked, model: _Model, rng: np.random.Generator) -> Array:
    """Places to think about: all over the region, and around the best of those observed."""
    seen = asked.seen if problem.mean in ("simulated", "pooled", "scaled") else asked.known
    if problem.risk is not None:
        seen = np.clip(seen, 0.0, 1.0)  # what was executed may lie beside the box
    means = model.surrogate.predict(seen)[0]
    around = [seen[i] for i in np.argsort(means, kind="stable")[:4]]
    return acquisition.search_candidates(asked.region, problem.space.dimension, around, rng)


def _search(
    problem: SuggestProblem,
    asked: _Asked,
    model: _Model,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> Array:
    """`count` minimisers of the acquisition, each keeping away from the busy points and its forerunners."""
    chosen: list[Array] = []
    surrogate = model.surrogate
    if problem.count:
        candidates = _candidates(problem, asked, model, rng)
    for index in range(problem.count):
        taken = np.concatenate([asked.busy, np.array(chosen).reshape(-1, problem.space.dimension)])
        if _looks_round(problem, asked, model, index):
            avoided = np.concatenate([asked.known, taken, asked.refused])
            chosen.append(acquisition.spread_out(1, avoided, asked.region, rng, feasibility)[0])
            continue
        conclude = problem.acquisition == "posterior_minimum" and index == 0
        score = acquisition.lower_confidence_bound(surrogate, 0.0 if conclude else _kappa(problem, model))
        score = acquisition.penalised(score, surrogate, taken[:0] if conclude else taken, candidates, feasibility)
        chosen.append(acquisition.minimise(score, candidates, asked.region, rng))
    return np.array(chosen).reshape(problem.count, problem.space.dimension)


def _looks_round(problem: SuggestProblem, asked: _Asked, model: _Model, index: int) -> bool:
    """Whether the next point only fills space: every third one, while the costs could as well be noise.

    On a plateau the luckiest pours look like a slope, and following them, mostly along the faces of the cube, would
    take the whole budget. The same holds where every pour came to more than half of all simulations did, and pours
    alone show no structure: what simulation promised isn't there. The paper's models, contexts and risks are left
    alone.
    """
    number = len(asked.known) + len(asked.busy) + index
    if problem.acquisition != "lcb" or problem.context or problem.risk or number % FILL_EVERY != FILL_EVERY - 1:
        return False
    if problem.mean == "constant":
        return model.process.evidence < STRUCTURE
    if problem.mean not in ("pooled", "scaled") or len(asked.known) < 2 or len(asked.simulated) < 2:
        return False
    if asked.costs.min() <= _promised(problem, asked):
        return False
    return constant_mean_process(asked.points, asked.costs).evidence < STRUCTURE


def _kappa(problem: SuggestProblem, model: _Model) -> float:
    """κ of the next point: half of it once the costs show structure.

    A constant κ goes on visiting what is merely unknown when the valley has long been found, and a budget of twenty
    ends before its bottom is reached. The paper's models, and contexts, are left alone.
    """
    settled = problem.mean == "constant" and not problem.context and model.process.evidence >= STRUCTURE
    return problem.kappa * (SETTLED if settled else 1.0)


def _promised(problem: SuggestProblem, asked: _Asked) -> float:
    """What pours should at least come to, by the simulations.

    That is their median. Where they are made by what they are worth (`effort`), most of them lie in the valley: there
    each counts for the part of the region that it is nearest to, and it is half-way from the least to the median.
    """
    if problem.effort is None:
        return float(np.median(asked.simulated_costs))
    everywhere = asked.region.draw(256, np.random.default_rng(0), even=True)
    typical = np.median(asked.simulated_costs[cdist(everywhere, asked.simulated).argmin(axis=1)])
    return 0.5 * float(asked.simulated_costs.min() + typical)


def _describe(
    problem: SuggestProblem, asked: _Asked, model: _Model, points: Array, feasibility: Feasibility | None
) -> dict[str, object]:
    """What the surrogate says about the proposals, the observations and the rest."""
    known = asked.known if len(asked.known) else asked.simulated
    if problem.risk is not None:
        known = asked.region.snap(_array(problem.predict_at, problem.space.dimension))
    elif feasibility is not None:
        known = known[feasibility.likely(known)]
    means, deviations = model.surrogate.predict(points) if len(points) else (np.empty(0), np.empty(0))
    at_known, known_deviations = model.surrogate.predict(known)
    best = int(np.argmin(at_known))
    process = model.process
    description: dict[str, object] = {
        "means": tuple(map(float, means)),
        "deviations": tuple(map(float, deviations)),
        "noises": () if problem.beside or problem.risk else tuple(map(float, process.noise_at(points))),
        "best_point": tuple(map(float, known[best])),
        "best_mean": float(at_known[best]),
        "best_deviation": float(known_deviations[best]),
        "best_noise": None if problem.beside or problem.risk else float(process.noise_at(known[best : best + 1])[0]),
        "hyperparameters": {
            "signal": process.signal,
            "noise": process.noise,
            **process.hyperparameters,
            **dict(zip((f"length.{name}" for name in _axis_names(problem)), map(float, process.lengths), strict=True)),
        },
    }
    if problem.predict_at:
        predictions, spreads = model.surrogate.predict(
            asked.region.snap(_array(problem.predict_at, problem.space.dimension))
        )
        description["predictions"] = tuple(map(float, predictions))
        description["prediction_deviations"] = tuple(map(float, spreads))
        if isinstance(model.surrogate, RiskProcess):
            description["risk"] = model.surrogate.answer(known, WORST)
    if problem.map_resolution and problem.space.dimension >= 2:
        sought = problem.acquisition == "posterior_minimum" and len(points) > 0
        description["surrogate"] = _map(problem, asked.region, model, points[0] if sought else known[best])
    return description


def _posterior(
    problem: SuggestProblem, question: PosteriorQuestion, region: Region, model: _Model, rng: np.random.Generator
) -> Posterior:
    contexts = _array(question.contexts, model.process.points.shape[1] - problem.space.dimension)
    sampled = sample_posterior(
        model.process,
        contexts,
        np.array(question.offsets),
        noise=question.noise,
        count=question.count,
        snap=region.snap,
        rng=rng,
    )
    return Posterior(_tuples(sampled.points), tuple(map(float, sampled.discrepancies)), sampled.effective)


def _axis_names(problem: SuggestProblem) -> list[str]:
    return [*problem.space.names, *(f"context{i + 1}" for i in range(problem.beside))]


def _map(problem: SuggestProblem, region: Region, model: _Model, at: Array) -> SurrogateMap:
    """The surrogate on the plane through `at` (dimension,) that its two most important axes span."""
    across, up = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:2])
    places = np.linspace(0.0, 1.0, problem.map_resolution)
    first, second = np.meshgrid(places, places)
    grid = np.tile(at, (first.size, 1))
    grid[:, across], grid[:, up] = first.ravel(), second.ravel()
    mean, deviation = model.surrogate.predict(region.snap(grid))
    shape, names = first.shape, problem.space.names
    cut: tuple[tuple[str, ...], Point] = ((), ())
    if problem.space.dimension > 2:
        cut = (names[across], names[up]), tuple(map(float, at))
    return SurrogateMap(_tuples(mean.reshape(shape)), _tuples(deviation.reshape(shape)), *cut)


def _sorted(data: Data, dimension: int) -> tuple[Array, Array]:
    """Points (n, dimension) and costs (n,), by their numbers."""
    pairs = sorted(zip(data.points, data.costs, strict=True))
    return _array([point for point, _ in pairs], dimension), np.array([cost for _, cost in pairs], dtype=np.float64)


def _array(points: Sequence[Point], dimension: int) -> Array:
    return np.array(points, dtype=np.float64).reshape(len(points), dimension)


def _tuples(rows: Array | Sequence[Array]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in rows)
