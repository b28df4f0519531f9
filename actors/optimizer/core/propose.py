"""`propose`: from a question to an answer. Pure: the same question gets the same answer on the same machine."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits

from actors.optimizer.core import acquisition
from actors.optimizer.core.asked import Asked, tuples
from actors.optimizer.core.checks import check
from actors.optimizer.core.describe import describe, design_of, posterior_of
from actors.optimizer.core.knowledge import Knowledge, most_instructive
from actors.optimizer.core.least_loss import found, proposals
from actors.optimizer.core.models import Model, fit
from actors.optimizer.core.problem import Suggestion, SuggestProblem
from actors.optimizer.core.region import Feasibility
from actors.optimizer.core.surrogate import constant_mean_process

Array = NDArray[np.float64]

FILL_EVERY = 3
"""While the costs could as well be noise, one proposal of this many only fills space."""

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
    asked = Asked.of(problem)
    model = fit(problem, asked)
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
    """Places to think about: all over the region, and around the best of those observed."""
    seen = asked.seen if problem.mean in ("simulated", "pooled", "scaled", "adaptive") else asked.known
    if problem.risk is not None:
        seen = np.clip(seen, 0.0, 1.0)  # what was executed may lie beside the box
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


def _looks_round(problem: SuggestProblem, asked: Asked, model: Model, index: int) -> bool:
    """Whether the next point only fills space: every third one, while the costs could as well be noise.

    On a plateau the luckiest pours look like a slope, and following them, mostly along the faces of the cube, would
    take the whole budget. The same holds where every pour came to more than half of all simulations did, and pours
    alone show no structure: what simulation promised isn't there. The paper's ways (`plain`, 'zero', 'simulated'),
    contexts and risks are left alone.
    """
    if problem.plain:
        return False
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


def _kappa(problem: SuggestProblem, model: Model) -> float:
    """κ of the next point: half of it once the costs show structure.

    A constant κ goes on visiting what is merely unknown when the valley has long been found, and a budget of twenty
    ends before its bottom is reached. The paper's ways (`plain`, 'zero', 'simulated'), and contexts, are left alone.
    """
    adapts = problem.mean == "constant" and not problem.context and not problem.plain
    settled = adapts and model.process.evidence >= STRUCTURE
    return problem.kappa * (SETTLED if settled else 1.0)


def _promised(problem: SuggestProblem, asked: Asked) -> float:
    """What pours should at least come to, by the simulations.

    That is their median. Where they are made by what they are worth (`effort`), most of them lie in the valley: there
    each counts for the part of the region that it is nearest to, and it is half-way from the least to the median.
    """
    if problem.effort is None:
        return float(np.median(asked.simulated_costs))
    everywhere = asked.region.draw(256, np.random.default_rng(0), even=True)
    typical = np.median(asked.simulated_costs[cdist(everywhere, asked.simulated).argmin(axis=1)])
    return 0.5 * float(asked.simulated_costs.min() + typical)
