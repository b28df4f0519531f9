"""Checks of a question to the optimiser, and its conversion to arrays.

`check` rejects invalid questions; `Asked` holds a question as arrays. `array` and `tuples` convert points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.feasible_region import Feasibility, Kind, Region
from actors.optimizer.questions import Data, ModelDiscrepancy, Point, SuggestProblem

MAX_OBSERVATIONS = 2_000
"""Above it a fit takes minutes (O(n³)); a campaign that needs more should not use a dense GP."""
MAX_COUNT = 256
MAX_RESOLUTION = 200
MAX_PREDICTIONS = 100_000
MAX_DISTURBANCES = 512


def check(problem: SuggestProblem) -> None:
    """Reject questions that would lead to NaN or an endless computation.

    Raises:
        ValueError: names the invalid number and the valid range.
    """
    dimension = problem.space.dimension
    contexts = {len(point) for point in problem.context}
    if len(contexts) > 1:
        raise ValueError(f"context points of different lengths: {sorted(contexts)}")
    if problem.context and problem.mean != "constant":
        raise ValueError(f"a context needs mean='constant', not {problem.mean!r}")
    _check_points("context", problem.context, contexts.pop() if contexts else 0)
    _check_risk(problem)
    contextual = dimension + problem.beside
    _check_points("data", problem.data.points, contextual)
    _check_points("simulated", problem.simulated.points, dimension)
    _check_points("pending", problem.pending, dimension)
    _check_points("infeasible", problem.infeasible, dimension)
    _check_points("refused", problem.refused, dimension)
    _check_points("failed", problem.failed, dimension)
    _check_points("predict_at", problem.predict_at, dimension)
    _check_points("map_at", (problem.map_at,) if problem.map_at else (), dimension)
    _check_points("pouring", problem.pouring, dimension)
    for name, data in (("data", problem.data), ("simulated", problem.simulated)):
        for index, cost in enumerate(data.costs):
            if not math.isfinite(cost) or abs(cost) > 1e12:
                raise ValueError(f"{name}: cost {index} is {cost}; leave failed trials out, or penalise them")
    observations = len(problem.data) + len(problem.simulated) + len(problem.infeasible) + len(problem.refused)
    if observations > MAX_OBSERVATIONS:
        raise ValueError(f"{observations} observations and refusals, but at most {MAX_OBSERVATIONS} can be fitted")
    for name, value, limit in (
        ("count", problem.count, MAX_COUNT),
        ("map_resolution", problem.map_resolution, MAX_RESOLUTION),
        ("len(predict_at)", len(problem.predict_at), MAX_PREDICTIONS),
    ):
        if not 0 <= value <= limit:
            raise ValueError(f"{name} = {value} is outside 0 … {limit}")
    if not (math.isfinite(problem.kappa) and 0.0 <= problem.kappa <= 100.0):
        raise ValueError(f"kappa = {problem.kappa} is outside 0 … 100")
    if problem.acquisition == "knowledge" and problem.mean not in ("simulated", "scaled"):
        raise ValueError(f"acquisition='knowledge' is over simulations, and mean={problem.mean!r} knows none")
    if (problem.mean == "adaptive") != (problem.mismatch is not None):
        raise ValueError("mean='adaptive' needs a mismatch, and no other mean knows one")
    if problem.mismatch is not None:
        _check_mismatch(problem.mismatch, dimension)
    _check_effort(problem)
    _check_posterior(problem)
    _check_constraints(problem)


def _check_risk(problem: SuggestProblem) -> None:
    risk = problem.risk
    if risk is None:
        return
    if problem.context or problem.mean != "constant":
        raise ValueError(f"a risk needs mean='constant' and no context, not {problem.mean!r}")
    if not 1 <= len(risk.disturbances) <= MAX_DISTURBANCES:
        raise ValueError(f"risk: {len(risk.disturbances)} disturbances are outside 1 … {MAX_DISTURBANCES}")
    if not 0.0 <= risk.level < 1.0:
        raise ValueError(f"risk: level = {risk.level} is outside [0, 1)")
    if len(problem.data) > 1 and not problem.predict_at:
        raise ValueError("risk: predict_at must name the requests that the best is one of")
    for index, one in enumerate(risk.disturbances):
        sizes = len(one.scales), len(one.shifts), len(one.context)
        if sizes != (problem.space.dimension, problem.space.dimension, problem.beside):
            raise ValueError(f"risk: disturbance {index} has {sizes} numbers, which fit neither space nor the others")
        if not all(math.isfinite(value) for value in (*one.scales, *one.shifts, *one.context)):
            raise ValueError(f"risk: disturbance {index} is not finite")


def _check_mismatch(mismatch: ModelDiscrepancy, dimension: int) -> None:
    sizes = {len(mismatch.play), *(len(part) for one in mismatch.drawn for part in (one.scales, one.shifts))}
    if sizes != {dimension}:
        raise ValueError(f"mismatch: play and displacements have {sorted(sizes)} axes, the space has {dimension}")
    if not (0.0 < mismatch.ignorance < 1.0 and 0.0 < mismatch.worst < math.inf and mismatch.left >= 0):
        raise ValueError("mismatch: ignorance must be inside 0 … 1, the worst cost above 0, and left not below")


def _check_effort(problem: SuggestProblem) -> None:
    effort = problem.effort
    if effort is None:
        return
    if problem.noise == "varying" and effort.start:
        raise ValueError("effort: a start is for noise='constant' only")
    if not 0 <= effort.iterations <= 1000:
        raise ValueError(f"effort: iterations = {effort.iterations} is outside 0 … 1000")
    if not all(math.isfinite(value) for start in effort.start for value in start):
        raise ValueError("effort: the start must be finite")


def _check_posterior(problem: SuggestProblem) -> None:
    question = problem.posterior
    if question is None:
        if problem.design is not None:
            raise ValueError("a design needs a posterior: what is known of the searched parameters")
        return
    if not problem.context:
        raise ValueError("a posterior needs a context: differences at actions, with which pours can be compared")
    _check_points("posterior", question.contexts, len(problem.context[0]))
    for name, points in (
        ("candidates", () if problem.design is None else problem.design.candidates),
        ("targets", () if problem.design is None else problem.design.targets),
    ):
        _check_points(name, points, len(problem.context[0]))
        if problem.design is not None and not points:
            raise ValueError(f"design: no {name}")
    nothing_weighed = problem.design is not None and not question.offsets
    if len(question.offsets) != len(question.contexts) or not (question.contexts or nothing_weighed):
        raise ValueError(f"posterior: {len(question.contexts)} pours but {len(question.offsets)} offsets")
    if not all(math.isfinite(value) for value in (*question.offsets, question.noise)) or question.noise < 0.0:
        raise ValueError("posterior: offsets and noise must be finite, the noise not negative")
    if not 1 <= question.count <= 2000:
        raise ValueError(f"posterior: count = {question.count} is outside 1 … 2000")


def _check_constraints(problem: SuggestProblem) -> None:
    for index, constraint in enumerate(problem.constraints):
        for name, weight in constraint.weights:
            if name not in problem.space.names:
                raise ValueError(
                    f"constraints: {index} names {name!r}, but the axes are {', '.join(problem.space.names)}"
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


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Asked:
    """A problem as arrays. Their order does not depend on the order of the answers; integer axes are rounded.

    Attributes:
        points: (n, dimension and context) of the observations, with their costs (n,).
        known: (n, dimension), the same without context.
        simulated: (k, dimension), with their costs (k,).
        busy: (b, dimension), pending.
        infeasible: (i, dimension), refused for any kind of request.
        really_refused: (r, dimension), refused real requests.
        failed: (f, dimension), real requests that failed during execution.
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
    failed: Array
    pouring: Array

    @classmethod
    def of(cls, problem: SuggestProblem) -> Asked:
        """Convert a problem."""
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
            region.snap(array(sorted(problem.pending), dimension)),
            region.snap(array(sorted(problem.infeasible), dimension)),
            region.snap(array(sorted(problem.refused), dimension)),
            region.snap(array(sorted(problem.failed), dimension)),
            region.snap(array(sorted(problem.pouring), dimension)),
        )

    @property
    def seen(self) -> Array:
        """Places where the cost was observed, really or in simulation; (n + k, dimension)."""
        return np.concatenate([self.known, self.simulated])

    @property
    def refused(self) -> Array:
        """Places of all refusals: (i + r, dimension)."""
        return np.concatenate([self.infeasible, self.really_refused])

    def feasibility(self) -> Feasibility | None:
        """Model of refusals and failures; None if there were none."""
        kinds = [
            Kind(self.seen, self.infeasible),
            Kind(self.known, self.really_refused),
            Kind(self.known, self.failed, by_chance=True),
        ]
        told = [kind for kind in kinds if len(kind.refused)]
        return Feasibility(*told) if told else None


def _sorted(data: Data, dimension: int) -> tuple[Array, Array]:
    """Points (n, dimension) and costs (n,), sorted by their numbers."""
    pairs = sorted(zip(data.points, data.costs, strict=True))
    return array([point for point, _ in pairs], dimension), np.array([cost for _, cost in pairs], dtype=np.float64)


def array(points: Sequence[Point], dimension: int) -> Array:
    """Points as an array (n, dimension), also for n = 0."""
    return np.array(points, dtype=np.float64).reshape(len(points), dimension)


def tuples(rows: Array | Sequence[Array]) -> tuple[tuple[float, ...], ...]:
    """Rows as tuples of plain floats, for a message."""
    return tuple(tuple(map(float, row)) for row in rows)
