"""A question as arrays, and arrays as parts of an answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.feasible_region import Feasibility, Kind, Region
from actors.optimizer.questions import Data, Point, SuggestProblem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Asked:
    """A problem as arrays, in an order that doesn't depend on who answered first, integer axes at whole numbers.

    Attributes:
        points: (n, dimension and context) of the observations, with their costs (n,).
        known: (n, dimension), the same without context.
        simulated: (k, dimension), with their costs (k,).
        busy: (b, dimension).
        infeasible: (i, dimension), refused of any kind of request.
        really_refused: (r, dimension), of real ones.
        failed: (f, dimension), real ones that went wrong under way.
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
            region.snap(array(sorted(problem.pending), dimension)),
            region.snap(array(sorted(problem.infeasible), dimension)),
            region.snap(array(sorted(problem.refused), dimension)),
            region.snap(array(sorted(problem.failed), dimension)),
            region.snap(array(sorted(problem.pouring), dimension)),
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
        """How likely requests are not refused and don't fail; None while none was or did."""
        kinds = [
            Kind(self.seen, self.infeasible),
            Kind(self.known, self.really_refused),
            Kind(self.known, self.failed, by_chance=True),
        ]
        told = [kind for kind in kinds if len(kind.refused)]
        return Feasibility(*told) if told else None


def _sorted(data: Data, dimension: int) -> tuple[Array, Array]:
    """Points (n, dimension) and costs (n,), by their numbers."""
    pairs = sorted(zip(data.points, data.costs, strict=True))
    return array([point for point, _ in pairs], dimension), np.array([cost for _, cost in pairs], dtype=np.float64)


def array(points: Sequence[Point], dimension: int) -> Array:
    """(n, dimension), also of no points."""
    return np.array(points, dtype=np.float64).reshape(len(points), dimension)


def tuples(rows: Array | Sequence[Array]) -> tuple[tuple[float, ...], ...]:
    """Rows as plain numbers, for a message."""
    return tuple(tuple(map(float, row)) for row in rows)
