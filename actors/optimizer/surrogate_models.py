"""The surrogate models of the queries: `fit` returns the fitted `Model` of a query.

`QueryArrays` holds a query as arrays; `array` and `tuples` convert points. `AbsoluteProcess` is the mean absolute value
of a signed surrogate over a context that is not searched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer.feasible_region import Feasibility, Region, RequestGroup
from actors.optimizer.gaussian_process import (
    CONSTANT_PRIOR,
    OBLIQUE_PRIOR,
    GaussianProcess,
    Surrogate,
    constant_mean_process,
    simulated_mean_process,
    zero_mean_process,
)
from actors.optimizer.model_discrepancy import ModelAveragedProcess
from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    MinimumQuery,
    Point,
    PourQuery,
    ProposalQuery,
    RegressionQuery,
    SurrogateQuery,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class QueryArrays:
    """A query as arrays; integer axes are rounded. Their order does not depend on the order of the answers, except that
    the pours of a query with a discrepancy keep theirs: the bench may change.

    Attributes:
        points: (n, dimension and context) of the observations, with their costs (n,).
        known: (n, dimension), the same without context.
        simulated: (k, dimension), with their costs (k,).
        busy: (b, dimension), pending.
        infeasible: (i, dimension), refused for any kind of request.
        really_refused: (r, dimension), refused real requests.
        failed: (f, dimension), real requests that failed during execution.
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

    @classmethod
    def of(cls, query: SurrogateQuery) -> QueryArrays:
        """Convert a query."""
        dimension = query.space.dimension
        region = Region(query.space, query.constraints)
        ordered = isinstance(query, PourQuery) and query.discrepancy is not None
        points, costs = (_arrays if ordered else _sorted)(query.data, dimension + query.context_dimension)
        simulations = query.simulated if isinstance(query, PourQuery) else Data()
        simulated, simulated_costs = _sorted(simulations, dimension)
        points = region.snap(points)

        def snapped(places: Sequence[Point]) -> Array:
            return region.snap(array(sorted(places), dimension))

        return cls(
            region,
            points,
            costs,
            points[:, :dimension],
            region.snap(simulated),
            simulated_costs,
            snapped(query.pending if isinstance(query, ProposalQuery) else ()),
            snapped(query.infeasible),
            snapped(query.refused),
            snapped(query.failed),
        )

    @property
    def seen(self) -> Array:
        """Places where the cost was observed, really or in simulation; (n + k, dimension)."""
        return np.concatenate([self.known, self.simulated])

    @property
    def refused(self) -> Array:
        """Places of all refusals: (i + r, dimension)."""
        return np.concatenate([self.infeasible, self.really_refused])

    @property
    def taken(self) -> Array:
        """Places that a point which fills the space avoids: tried, pending and refused ones."""
        return np.concatenate([self.known, self.busy, self.refused])

    def feasibility(self) -> Feasibility | None:
        """Model of refusals and failures; None if there were none."""
        kinds = [
            RequestGroup(self.seen, self.infeasible),
            RequestGroup(self.known, self.really_refused),
            RequestGroup(self.known, self.failed, by_chance=True),
        ]
        present = [kind for kind in kinds if len(kind.refused)]
        return Feasibility(*present) if present else None


def _arrays(data: Data, dimension: int) -> tuple[Array, Array]:
    """Points (n, dimension) and costs (n,)."""
    return array(data.points, dimension), np.array(data.costs, dtype=np.float64)


def _sorted(data: Data, dimension: int) -> tuple[Array, Array]:
    """The same, sorted by their numbers."""
    pairs = sorted(zip(data.points, data.costs, strict=True))
    return _arrays(Data(tuple(point for point, _ in pairs), tuple(cost for _, cost in pairs)), dimension)


def array(points: Sequence[Point], dimension: int) -> Array:
    """Points as an array (n, dimension), also for n = 0."""
    return np.array(points, dtype=np.float64).reshape(len(points), dimension)


def tuples(rows: Array | Sequence[Array]) -> tuple[tuple[float, ...], ...]:
    """Rows as tuples of plain floats, for a message."""
    return tuple(tuple(map(float, row)) for row in rows)


@dataclass(frozen=True)
class AbsoluteProcess:
    """A surrogate of the mean absolute value over a context, of a signed quantity: 1/J Σ_j |f(x, z_j)|.

    |f| of a normal f is folded normal. The deviation is the mean of the contexts' deviations of |f|, as if their errors
    were fully correlated: an upper bound.

    Source: moments of the folded normal distribution (Leone, Nelson & Nottingham, 1961).
    """

    process: GaussianProcess
    context: Array

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`."""
        m, J = len(points), len(self.context)
        joint = np.concatenate([np.repeat(points, J, axis=0), np.tile(self.context, (m, 1))], axis=1)
        mean, deviation = (values.reshape(m, J) for values in self.process.predict(joint))
        # E|f| = s √(2/π) e^(−m²/2s²) + m (2Φ(m/s) − 1), Var|f| = m² + s² − (E|f|)²
        ratio = mean / deviation
        folded = deviation * math.sqrt(2 / math.pi) * np.exp(-0.5 * ratio**2) + mean * (2 * ndtr(ratio) - 1)
        spread = np.sqrt(np.maximum(mean**2 + deviation**2 - folded**2, 0.0))
        # m̄ = 1/J Σ_j E|f_j|, s̄ = 1/J Σ_j √Var|f_j|
        return folded.mean(axis=1), np.maximum(spread.mean(axis=1), 1e-9 * self.process.scale)


@dataclass(frozen=True)
class Model:
    """A fitted surrogate.

    Attributes:
        surrogate: of the minimised quantity.
        process: with the observations in it; for an average over hypotheses, of the simulations only.
        lengths: (dimension,) lengthscales of the searched axes. Around a simulated mean they are the simulations',
            because a few pours do not determine those of the remainder.
    """

    surrogate: Surrogate
    process: GaussianProcess
    lengths: Array
    averaged: ModelAveragedProcess | None = None

    def noise_at(self, points: Array) -> Array:
        """Standard deviations (m,) of single real observations at points (m, dimension), in the cost's unit."""
        return (self.averaged or self.process).noise_at(points)


def fit(query: SurrogateQuery, arrays: QueryArrays) -> Model | None:
    """Fit the surrogate of a query; None with too few observations."""
    points, costs = arrays.points, arrays.costs
    describes = isinstance(query, MinimumQuery) and not query.replicates
    averages = isinstance(query, PourQuery) and query.discrepancy is not None
    prior = OBLIQUE_PRIOR if describes or averages else CONSTANT_PRIOR
    if isinstance(query, PourQuery) and len(arrays.simulated) >= 2:
        simulated = constant_mean_process(arrays.simulated, arrays.simulated_costs, prior=prior)
        if query.discrepancy is not None:
            averaged = ModelAveragedProcess(simulated, points, costs, query.discrepancy)
            return Model(averaged, simulated, simulated.lengths, averaged)
        if not len(points):
            return Model(simulated, simulated, simulated.lengths)
        # y = m_sim(x) + δ(x) + ε: the mean of the simulations is the prior mean of the pours
        process = simulated_mean_process(simulated, points, costs)
        return Model(process, process, simulated.lengths)
    if len(points) < 2:
        return None
    if isinstance(query, RegressionQuery | MinimumQuery) and query.mean == "zero":
        process = zero_mean_process(points, costs)
    else:
        process = constant_mean_process(points, costs, prior=prior)
    lengths = process.lengths[: query.space.dimension]
    if isinstance(query, CalibrationQuery):
        # the process is of r − c_s(θ, a), and 1/J Σ_j |r − c_s(θ, a_j)| is minimised over θ
        context = array(query.contexts, query.context_dimension)
        return Model(AbsoluteProcess(process, context), process, lengths)
    return Model(process, process, process.lengths)
