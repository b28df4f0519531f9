"""`propose`: from a question to an answer. Pure: the same question gets the same answer on the same machine.

`describe`, `posterior_of` and `design_of` compute the parts of an answer: predictions, best observation, map, draws of
θ. `slices` returns the surrogate over every pair of its axes, for plots of spaces with more than two.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from actors.optimizer import acquisition
from actors.optimizer.experimental_design import WeighedDesign, expected_reductions
from actors.optimizer.feasible_region import Feasibility, Region
from actors.optimizer.knowledge_gradient import KnowledgeGradient, found, most_instructive, proposals
from actors.optimizer.question_checks import Asked, array, check, tuples
from actors.optimizer.questions import (
    DesignQuestion,
    Point,
    Posterior,
    PosteriorQuestion,
    Suggestion,
    SuggestProblem,
    SurrogateMap,
)
from actors.optimizer.risk_measures import RiskProcess
from actors.optimizer.surrogate_models import Model, fit
from actors.optimizer.theta_posterior import DISCREPANCY_PRIOR, drawn_beforehand, sample_posterior
from sim_engine.prediction_band import LEVEL

Array = NDArray[np.float64]

WORST = 8
"""Number of worst disturbances of a request in an answer."""


def describe(
    problem: SuggestProblem, asked: Asked, model: Model, points: Array, feasibility: Feasibility | None
) -> dict[str, object]:
    """Return the surrogate's results about the proposals, the observations and further points."""
    known = asked.known if len(asked.known) else asked.simulated
    if problem.risk is not None:
        known = asked.region.snap(array(problem.predict_at, problem.space.dimension))
    elif feasibility is not None:
        known = known[feasibility.likely(known)]
    if problem.risk is None and (allowed := asked.region.allows(known)).any():
        known = known[allowed]  # prior data may lie outside the current constraints
    means, deviations = model.surrogate.predict(points) if len(points) else (np.empty(0), np.empty(0))
    at_known, known_deviations = model.surrogate.predict(known)
    expected = at_known
    if problem.risk is None and feasibility is not None and len(asked.costs):
        made = feasibility.made(known)
        expected = made * at_known + (1.0 - made) * asked.costs.max()
    best = int(np.argmin(expected))
    process = model.process
    description: dict[str, object] = {
        "means": tuple(map(float, means)),
        "deviations": tuple(map(float, deviations)),
        "noises": () if problem.beside or problem.risk else tuple(map(float, model.noise_at(points))),
        "best_point": tuple(map(float, known[best])),
        "best_mean": float(at_known[best]),
        "best_deviation": float(known_deviations[best]),
        "best_noise": None if problem.beside or problem.risk else float(model.noise_at(known[best : best + 1])[0]),
        "hyperparameters": {
            "signal": process.signal,
            "noise": process.noise,
            **process.hyperparameters,
            **({} if model.averaged is None else model.averaged.hyperparameters),
            **dict(zip((f"length.{name}" for name in _axis_names(problem)), map(float, process.lengths), strict=True)),
        },
    }
    if model.averaged is not None and len(points):
        description["bands"] = tuples(model.averaged.bands(points, LEVEL))
    if problem.predict_at:
        predictions, spreads = model.surrogate.predict(
            asked.region.snap(array(problem.predict_at, problem.space.dimension))
        )
        description["predictions"] = tuple(map(float, predictions))
        description["prediction_deviations"] = tuple(map(float, spreads))
        if isinstance(model.surrogate, RiskProcess):
            description["risk"] = model.surrogate.answer(known, WORST)
    if problem.map_resolution and problem.space.dimension >= 2:
        sought = problem.acquisition == "posterior_minimum" and len(points) > 0
        at = np.array(problem.map_at) if problem.map_at else points[0] if sought else known[best]
        across, up = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:2])
        description["surrogate"] = mapped(problem, asked.region, model, at, (across, up), problem.map_resolution)
    return description


def posterior_of(
    problem: SuggestProblem, question: PosteriorQuestion, region: Region, model: Model, rng: np.random.Generator
) -> Posterior:
    """Return draws of θ given weighed pours."""
    contexts = array(question.contexts, model.process.points.shape[1] - problem.space.dimension)
    if not len(contexts):
        drawn = drawn_beforehand(question.count, problem.space.dimension, array(question.prior, 2), rng)
        lack = (DISCREPANCY_PRIOR[0],) * question.count
        return Posterior(tuples(region.snap(drawn)), lack, float(question.count))
    sampled = sample_posterior(
        model.process,
        contexts,
        np.array(question.offsets),
        noise=question.noise,
        count=question.count,
        snap=region.snap,
        rng=rng,
        prior=array(question.prior, 2),
    )
    return Posterior(tuples(sampled.points), tuple(map(float, sampled.discrepancies)), sampled.effective)


def design_of(
    problem: SuggestProblem, question: DesignQuestion, made: PosteriorQuestion, model: Model, posterior: Posterior
) -> dict[str, object]:
    """Return the expected information of weighing a pour at each candidate, in addition to those made."""
    beside = model.process.points.shape[1] - problem.space.dimension
    gains, variance = expected_reductions(
        model.process,
        np.array(posterior.points),
        np.array(posterior.discrepancies),
        WeighedDesign(array(made.contexts, beside), np.array(made.offsets), made.noise),
        array(question.candidates, beside),
        array(question.targets, beside),
    )
    return {"gains": tuple(map(float, gains)), "uncertainty": variance}


def _axis_names(problem: SuggestProblem) -> list[str]:
    return [*problem.space.names, *(f"context{i + 1}" for i in range(problem.beside))]


def mapped(
    problem: SuggestProblem, region: Region, model: Model, at: Array, axes: tuple[int, int], resolution: int
) -> SurrogateMap:
    """The surrogate on the plane through `at`, shape (dimension,), that two axes of the space span."""
    across, up = axes
    places = np.linspace(0.0, 1.0, resolution)
    first, second = np.meshgrid(places, places)
    grid = np.tile(at, (first.size, 1))
    grid[:, across], grid[:, up] = first.ravel(), second.ravel()
    mean, deviation = model.surrogate.predict(region.snap(grid))
    shape, names = first.shape, problem.space.names
    cut: tuple[tuple[str, ...], Point] = ((), ())
    if problem.space.dimension > 2:
        cut = (names[across], names[up]), tuple(map(float, at))
    return SurrogateMap(tuples(mean.reshape(shape)), tuples(deviation.reshape(shape)), *cut)


FILL_EVERY = 3
"""One proposal in this many only fills space while the costs may be pure noise."""

STRUCTURE = 2.0
"""Gain of the log-likelihood above which the costs are more than noise."""

SETTLED = 0.5
"""Factor on κ once the costs are more than noise."""


def propose(problem: SuggestProblem) -> Suggestion:
    """Answer a `SuggestProblem`.

    With fewer than two observations there is no surrogate, and the points are Sobol points far from the known ones.
    Local penalisation avoids pending points and the other points of the same answer.

    Raises:
        ValueError: the question cannot be answered: numbers that are not finite, wrong dimensions, sizes too large for
            a dense GP.

    Limitations: linear algebra differs between machines in the last bits, and so do proposals: journal the answer.
    """
    check(problem)
    with threadpool_limits(1):  # threads only slow down matrices this small, and sums in a fixed order are repeatable
        return _answer(problem)


def _answer(problem: SuggestProblem) -> Suggestion:
    started = time.process_time()
    rng = np.random.default_rng(problem.seed)
    asked = Asked.of(problem)
    model = fit(problem, asked)
    feasibility = asked.feasibility()

    knowledge: KnowledgeGradient | None = None
    if problem.acquisition == "random":
        points = asked.region.draw(problem.count, rng, even=False)
    elif problem.acquisition == "sobol" or model is None:
        taken = np.concatenate([asked.known, asked.busy, asked.refused])
        points = acquisition.spread_out(problem.count, taken, asked.region, rng, feasibility)
    elif problem.acquisition == "knowledge":
        candidates = _candidates(problem, asked, model, rng)
        knowledge = most_instructive(problem, model.process, candidates, asked.busy, asked.pouring, feasibility)
        points = knowledge.points
    elif problem.acquisition == "least_loss" and model.averaged is not None:
        points = proposals(problem, asked, model.averaged, _candidates(problem, asked, model, rng), feasibility, rng)
    else:
        points = _search(problem, asked, model, feasibility, rng)

    answer: dict[str, object] = {}
    if model is not None:
        answer = describe(problem, asked, model, points, feasibility)
    if model is not None and problem.posterior is not None:
        posterior = posterior_of(problem, problem.posterior, asked.region, model, rng)
        answer["posterior"] = posterior
        if problem.design is not None:
            answer |= design_of(problem, problem.design, problem.posterior, model, posterior)
    if model is not None and problem.effort is not None:
        answer["fitted"] = tuples([process.theta for process in model.fitted])
    if knowledge is not None:
        answer |= {"values": tuple(map(float, knowledge.values)), "pour_value": knowledge.pour_value}
    if model is not None and model.averaged is not None:
        answer["mismatch"] = found(problem, asked, model.averaged, points, feasibility, rng)
    if feasibility is not None and len(points):
        answer["feasibilities"] = tuple(map(float, np.exp(feasibility.log_probability(points))))
    return Suggestion(
        points=tuples(points),
        seconds=time.process_time() - started,
        **answer,  # type: ignore[arg-type]
    )


def _candidates(problem: SuggestProblem, asked: Asked, model: Model, rng: np.random.Generator) -> Array:
    """Candidates for the search: all over the region, and around the best observations."""
    seen = asked.seen if problem.mean in ("simulated", "scaled", "adaptive") else asked.known
    if problem.risk is not None:
        seen = np.clip(seen, 0.0, 1.0)  # executed points may lie outside the box
    means = model.surrogate.predict(seen)[0]
    around = [seen[i] for i in np.argsort(means, kind="stable")[:4]]
    return acquisition.search_candidates(asked.region, problem.space.dimension, around, rng)


def _search(
    problem: SuggestProblem,
    asked: Asked,
    model: Model,
    feasibility: Feasibility | None,
    rng: np.random.Generator,
) -> Array:
    """`count` minimisers of the acquisition, each avoiding the pending points and the ones before it."""
    chosen: list[Array] = []
    surrogate = model.surrogate
    if problem.count:
        candidates = _candidates(problem, asked, model, rng)
    for index in range(problem.count):
        taken = np.concatenate([asked.busy, np.array(chosen).reshape(-1, problem.space.dimension)])
        if _fills_space(problem, asked, model, index):
            avoided = np.concatenate([asked.known, taken, asked.refused])
            chosen.append(acquisition.spread_out(1, avoided, asked.region, rng, feasibility)[0])
            continue
        conclude = problem.acquisition == "posterior_minimum" and index == 0
        score = acquisition.lower_confidence_bound(surrogate, 0.0 if conclude else _kappa(problem, model))
        score = acquisition.penalised(score, surrogate, taken[:0] if conclude else taken, candidates, feasibility)
        chosen.append(acquisition.minimise(score, candidates, asked.region, rng))
    return np.array(chosen).reshape(problem.count, problem.space.dimension)


def _fills_space(problem: SuggestProblem, asked: Asked, model: Model, index: int) -> bool:
    """Whether the next point only fills space: every third one, while the costs may be pure noise.

    On a plateau the best pours look like a slope by chance. Following them, mostly along the faces of the cube, would
    use up the whole budget. The paper's methods (`plain`, 'zero', 'simulated'), contexts and risks are excluded.
    """
    if problem.plain:
        return False
    number = len(asked.known) + len(asked.busy) + index
    if problem.acquisition != "lcb" or problem.context or problem.risk or number % FILL_EVERY != FILL_EVERY - 1:
        return False
    return problem.mean == "constant" and model.process.evidence < STRUCTURE


def _kappa(problem: SuggestProblem, model: Model) -> float:
    """κ of the next point: half of it once the costs show structure.

    A constant κ continues to explore unknown regions long after the valley has been found, and a budget of twenty ends
    before its bottom is reached. The paper's methods (`plain`, 'zero', 'simulated'), and contexts, are excluded.
    """
    adapts = problem.mean == "constant" and not problem.context and not problem.plain
    settled = adapts and model.process.evidence >= STRUCTURE
    return problem.kappa * (SETTLED if settled else 1.0)


MOST_AXES = 4


def slices(problem: SuggestProblem, suggestion: Suggestion, resolution: int = 15) -> tuple[SurrogateMap, ...]:
    """The surrogate over every pair of its axes, the others held as in `suggestion.surrogate`.

    Of more than `MOST_AXES` axes, those with the shortest lengthscales are used.

    Args:
        problem: the question to the optimiser.
        suggestion: its answer, with a surrogate.
        resolution: number of places along an axis.

    Returns:
        Pairs in the space's order: (0, 1), (0, 2) … ; empty for a space of two axes.

    Limitations: answers contain one map only, because they are journalled. The surrogate is fitted again here, which
    takes as long as the first fit, and is identical except for the last bits on another machine.
    """
    if suggestion.surrogate is None or problem.space.dimension <= 2:
        return ()
    with threadpool_limits(1):
        asked = Asked.of(problem)
        model = fit(problem, asked)
        if model is None:
            return ()
        axes = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:MOST_AXES])
        at = np.array(suggestion.surrogate.at)
        return tuple(
            mapped(problem, asked.region, model, at, pair, resolution) for pair in itertools.combinations(axes, 2)
        )
