"""`propose`: from a question to an answer. Pure: the same question gets the same answer on the same machine."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from actors.optimizer.core import acquisition
from actors.optimizer.core.problem import Point, Suggestion, SuggestProblem, SurrogateMap
from actors.optimizer.core.surrogate import (
    AbsoluteProcess,
    GaussianProcess,
    Surrogate,
    constant_mean_process,
    simulated_mean_process,
    zero_mean_process,
)

Array = NDArray[np.float64]

MAX_OBSERVATIONS = 2_000
"""Above it a fit takes minutes (O(n³)); a campaign that needs more should not use a dense GP."""
MAX_COUNT = 256
MAX_RESOLUTION = 200
MAX_PREDICTIONS = 100_000


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
    _check(problem)
    with threadpool_limits(1):  # matrices this small only lose by threads, and sums in a fixed order are repeatable
        return _answer(problem)


def _answer(problem: SuggestProblem) -> Suggestion:
    started = time.process_time()
    rng = np.random.default_rng(problem.seed)
    known = _observed(problem)
    busy = _array(problem.pending, problem.space.dimension)
    model = _fit(problem)

    if problem.acquisition == "random":
        points = rng.random((problem.count, problem.space.dimension))
    elif problem.acquisition == "sobol" or model is None:
        points = acquisition.spread_out(problem.count, np.concatenate([known, busy]), problem.space.dimension, rng)
    else:
        points = _search(problem, model.surrogate, known, busy, rng)

    answer: dict[str, object] = {}
    if model is not None:
        answer = _describe(problem, model, known, points)
    return Suggestion(
        points=_tuples(points),
        seconds=time.process_time() - started,
        **answer,  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class _Model:
    """A fitted surrogate.

    Attributes:
        surrogate: of what is minimised.
        process: with the observations in it.
        lengths: (dimension,) lengthscales of the searched axes. Around a simulated mean they are the simulations':
            a handful of pours says little about what the pours' remainder depends on.
    """

    surrogate: Surrogate
    process: GaussianProcess
    lengths: Array


def _fit(problem: SuggestProblem) -> _Model | None:
    """The surrogate that the problem asks for; None with too few observations."""
    dimension = problem.space.dimension
    contextual = dimension + (len(problem.context[0]) if problem.context else 0)
    points, costs = _array(problem.data.points, contextual), np.array(problem.data.costs, dtype=np.float64)
    if problem.mean == "simulated" and len(problem.simulated) >= 2:
        process = constant_mean_process(
            _array(problem.simulated.points, dimension), np.array(problem.simulated.costs, dtype=np.float64)
        )
        lengths = process.lengths
        if len(problem.data):
            process = simulated_mean_process(process, points, costs)
        return _Model(process, process, lengths)
    if len(problem.data) < 2:
        return None
    process = zero_mean_process(points, costs) if problem.mean == "zero" else constant_mean_process(points, costs)
    if problem.context:
        context = _array(problem.context, contextual - dimension)
        return _Model(AbsoluteProcess(process, context), process, process.lengths[:dimension])
    return _Model(process, process, process.lengths)


def _search(
    problem: SuggestProblem, surrogate: Surrogate, known: Array, busy: Array, rng: np.random.Generator
) -> Array:
    """`count` minimisers of the acquisition, each keeping away from the busy points and its forerunners."""
    chosen: list[Array] = []
    if problem.count:
        means = surrogate.predict(known)[0]
        around = [known[i] for i in np.argsort(means, kind="stable")[:4]]
        candidates = acquisition.search_candidates(problem.space.dimension, around, rng)
    for index in range(problem.count):
        taken = np.concatenate([busy, np.array(chosen).reshape(-1, problem.space.dimension)])
        if problem.acquisition == "posterior_minimum" and index == 0:
            score = acquisition.lower_confidence_bound(surrogate, 0.0)
        else:
            score = acquisition.lower_confidence_bound(surrogate, problem.kappa)
            score = acquisition.penalised(score, surrogate, taken, candidates)
        chosen.append(acquisition.minimise(score, candidates, rng))
    return np.array(chosen).reshape(problem.count, problem.space.dimension)


def _describe(problem: SuggestProblem, model: _Model, known: Array, points: Array) -> dict[str, object]:
    """What the surrogate says about the proposals, the observations and the rest."""
    means, deviations = model.surrogate.predict(points) if len(points) else (np.empty(0), np.empty(0))
    at_known, known_deviations = model.surrogate.predict(known)
    best = int(np.argmin(at_known))
    process = model.process
    description: dict[str, object] = {
        "means": tuple(map(float, means)),
        "deviations": tuple(map(float, deviations)),
        "best_point": tuple(map(float, known[best])),
        "best_mean": float(at_known[best]),
        "best_deviation": float(known_deviations[best]),
        "hyperparameters": {
            "signal": process.signal,
            "noise": process.noise,
            **dict(zip((f"length.{name}" for name in _axis_names(problem)), map(float, process.lengths), strict=True)),
        },
    }
    if problem.predict_at:
        predictions, spreads = model.surrogate.predict(_array(problem.predict_at, problem.space.dimension))
        description["predictions"] = tuple(map(float, predictions))
        description["prediction_deviations"] = tuple(map(float, spreads))
    if problem.map_resolution and problem.space.dimension >= 2:
        sought = problem.acquisition == "posterior_minimum" and len(points) > 0
        description["surrogate"] = _map(problem, model, points[0] if sought else known[best])
    return description


def _axis_names(problem: SuggestProblem) -> list[str]:
    contexts = len(problem.context[0]) if problem.context else 0
    return [*problem.space.names, *(f"context{i + 1}" for i in range(contexts))]


def _map(problem: SuggestProblem, model: _Model, at: Array) -> SurrogateMap:
    """The surrogate on the plane through `at` (dimension,) that its two most important axes span."""
    across, up = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:2])
    places = np.linspace(0.0, 1.0, problem.map_resolution)
    first, second = np.meshgrid(places, places)
    grid = np.tile(at, (first.size, 1))
    grid[:, across], grid[:, up] = first.ravel(), second.ravel()
    mean, deviation = model.surrogate.predict(grid)
    shape, names = first.shape, problem.space.names
    cut: tuple[tuple[str, ...], Point] = ((), ())
    if problem.space.dimension > 2:
        cut = (names[across], names[up]), tuple(map(float, at))
    return SurrogateMap(_tuples(mean.reshape(shape)), _tuples(deviation.reshape(shape)), *cut)


def _observed(problem: SuggestProblem) -> Array:
    """Observed points of the searched space, without their context: (n, dimension)."""
    data = problem.data if len(problem.data) or problem.mean != "simulated" else problem.simulated
    return _array([point[: problem.space.dimension] for point in data.points], problem.space.dimension)


def _array(points: Sequence[Point], dimension: int) -> Array:
    return np.array(points, dtype=np.float64).reshape(len(points), dimension)


def _tuples(rows: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in rows)


def _check(problem: SuggestProblem) -> None:
    """Refuse what would end in NaN or never end; say which number is wrong."""
    dimension = problem.space.dimension
    contexts = {len(point) for point in problem.context}
    if len(contexts) > 1:
        raise ValueError(f"context points of different lengths: {sorted(contexts)}")
    if problem.context and problem.mean != "constant":
        raise ValueError(f"a context needs mean='constant', not {problem.mean!r}")
    _check_points("context", problem.context, contexts.pop() if contexts else 0)
    contextual = dimension + (len(problem.context[0]) if problem.context else 0)
    _check_points("data", problem.data.points, contextual)
    _check_points("simulated", problem.simulated.points, dimension)
    _check_points("pending", problem.pending, dimension)
    _check_points("predict_at", problem.predict_at, dimension)
    for name, data in (("data", problem.data), ("simulated", problem.simulated)):
        for index, cost in enumerate(data.costs):
            if not math.isfinite(cost) or abs(cost) > 1e12:
                raise ValueError(f"{name}: cost {index} is {cost}; leave failed trials out, or penalise them")
        if len(data) > MAX_OBSERVATIONS:
            raise ValueError(f"{name}: {len(data)} observations, but at most {MAX_OBSERVATIONS} can be fitted")
    for name, value, limit in (
        ("count", problem.count, MAX_COUNT),
        ("map_resolution", problem.map_resolution, MAX_RESOLUTION),
        ("len(predict_at)", len(problem.predict_at), MAX_PREDICTIONS),
    ):
        if not 0 <= value <= limit:
            raise ValueError(f"{name} = {value} is outside 0 … {limit}")
    if not (math.isfinite(problem.kappa) and 0.0 <= problem.kappa <= 100.0):
        raise ValueError(f"kappa = {problem.kappa} is outside 0 … 100")


def _check_points(name: str, points: Sequence[Point], dimension: int) -> None:
    for index, point in enumerate(points):
        if len(point) != dimension:
            raise ValueError(f"{name}: point {index} has {len(point)} coordinates, expected {dimension}")
        if not all(math.isfinite(u) and -10.0 <= u <= 11.0 for u in point):
            raise ValueError(f"{name}: point {index} = {point} is not finite, or far outside the unit cube")
