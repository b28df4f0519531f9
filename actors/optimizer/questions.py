"""Questions to the optimiser and its answers: plain values that are sent between processes, journalled and replayed.

`SuggestionQuery` is a question, with one type for each kind, and `Suggestion` its answer. `ModelDiscrepancy` and
`DiscrepancyFound` describe how a bench may differ from its simulator,
`PosteriorQuestion` and `DesignQuestion` the calibration by weighed pours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_engine.search_space import Space
from sim_engine.settings.model import WRITTEN_IF_SET as WRITTEN_IF_SET  # noqa: PLC0414  others import it from here

Array = NDArray[np.float64]

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class OffsetPrior:
    """Prior of the bench offset along one axis, as standard deviations.

    Attributes:
        shift: of an offset, in units of the axis' unit interval.
        factor: of the logarithm of a factor on the axis' value.
        origin: lower bound over range, so that a factor f moves u to f u + (f − 1) origin.
    """

    shift: float = 0.0
    factor: float = 0.0
    origin: float = 0.0


@dataclass(frozen=True)
class BenchOffset:
    """The simulator's action scales · u + shifts corresponds to the bench's action u; in units of the cube."""

    scales: Numbers
    shifts: Numbers


@dataclass(frozen=True)
class Limit:
    """Exclude pours whose loss exceeds `loss` (in the cost's unit) with more than `probability`."""

    loss: float
    probability: float


FOUND = 0.25
"""Cost of a good action, relative to the largest observed one, at most. Without any, a search has not ended."""


def found_good(costs: Iterable[float]) -> bool:
    """Whether one of some costs is that of a good action."""
    observed = tuple(costs)
    return min(observed, default=0.0) < FOUND * max(observed, default=0.0)


@dataclass(frozen=True)
class SceneEvidence:
    """Weighed pours of a calibration in one scene, each with its simulation by the θ that the simulations use.

    Attributes:
        points: of the actions, in the unit cube of the query's space; actions may lie outside.
        costs: weighed.
        simulated: costs that the simulator predicts without the pour itself.
        power: exponent of the likelihood of these pours, 0 < power ≤ 1: how much they say about another scene.
            1: made before the observations in their scene.
        misled: probability that they say nothing about the bench; pours with the same one are right or wrong together.
            None: of a calibration just before the observations.
    """

    points: tuple[Point, ...]
    costs: Numbers
    simulated: Numbers
    power: float
    misled: float | None = field(default=None, metadata=WRITTEN_IF_SET)


@dataclass(frozen=True)
class ModelDiscrepancy:
    """The ways in which the simulator may be wrong, and the budget of pours.

    Attributes:
        offset_priors: prior of the bench offset along each axis.
        drawn: bench offsets that are more likely than others, equally likely among themselves: from a calibration, or
            from pours into another receiver.
        uninformative: prior probability that the simulator contains no information about this bench.
        worst: largest cost.
        pours_left: number of real observations after the proposed one.
        limit: kept by proposals, if any action keeps it.
        lookahead: whether the next observation may be chosen for its information about other places.
        calibration: pours of calibrations, which weigh the hypotheses before the first observation; None without any.
    """

    offset_priors: tuple[OffsetPrior, ...]
    drawn: tuple[BenchOffset, ...] = ()
    uninformative: float = 0.08
    worst: float = 1.0
    pours_left: int = 0
    limit: Limit | None = None
    lookahead: bool = True
    calibration: tuple[SceneEvidence, ...] | None = field(default=None, metadata=WRITTEN_IF_SET)


@dataclass(frozen=True)
class DiscrepancyFound:
    """Conclusions about the simulator.

    Attributes:
        uninformative: probability that the simulator contains no information about this bench.
        shifts: difference of the simulator's action at the cube's centre; mean over all other hypotheses.
        deviations: of these shifts.
        factor: real over simulated cost, the median of those hypotheses.
        gain: expected decrease of the least expected cost by one more observation; None before any observation, and if
            no action keeps the limit.
        exceedances: at the proposals: probabilities that an observation is above the limit; empty without one.
        least_exceedance: smallest probability over all actions; None without a limit.
        drawn: bench offsets drawn from the posterior, for another receiver; only with `count=0`.
        since_change: number of observations since the bench has behaved differently; None if it does not.
        drifts: change of the shifts per observation, 0 where its sign is uncertain; None unless the bench probably
            drifts.
    """

    uninformative: float
    shifts: Numbers
    deviations: Numbers
    factor: float
    gain: float | None = None
    exceedances: Numbers = ()
    least_exceedance: float | None = None
    drawn: tuple[BenchOffset, ...] = ()
    since_change: int | None = None
    drifts: Numbers | None = field(default=None, metadata=WRITTEN_IF_SET)


Point = tuple[float, ...]
"""A point of the unit cube."""

MeanName = Literal["constant", "zero"]
AcquisitionName = Literal["lcb", "posterior_minimum"]
"""'lcb' minimises m(x) − κ s(x). 'posterior_minimum' minimises m(x); further points of the same answer use the
penalised 'lcb'."""


@dataclass(frozen=True)
class Data:
    """Observations of a cost to be minimised.

    Attributes:
        points: in the unit cube, one tuple of `Space.dimension` numbers each.
        costs: one number each; the strategy leaves failed trials out or penalises them.
    """

    points: tuple[Point, ...] = ()
    costs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.points) != len(self.costs):
            raise ValueError(f"{len(self.points)} points but {len(self.costs)} costs")

    def __len__(self) -> int:
        return len(self.points)

    def added(self, point: Point, cost: float) -> Data:
        """Return a copy with one more observation."""
        return Data((*self.points, tuple(float(u) for u in point)), (*self.costs, float(cost)))


@dataclass(frozen=True)
class Linear:
    """A constraint Σ weight · value ≤ upper on the values of named axes.

    Attributes:
        weights: pairs of an axis' name and its weight.
        upper: largest allowed sum, in the unit that results from weights and values [SI].
    """

    weights: tuple[tuple[str, float], ...]
    upper: float


@dataclass(frozen=True)
class RememberedGroup:
    """Prior of some axes from earlier campaigns: independent normals, truncated to the unit cube, or else uniform.

    Attributes:
        axes: indices of the axes.
        centres, deviations: of the normals, one for each axis.
        weight: prior probability of the normals; the axes are uniform with the rest.
    """

    axes: tuple[int, ...]
    centres: Numbers
    deviations: Numbers
    weight: float

    def density(self, points: Array) -> Array:
        """Density (m,) of the normals at points (m, at least the dimension)."""
        from scipy.special import ndtr  # slow import

        centres, deviations = np.array(self.centres), np.array(self.deviations)
        # Π_a N(u_a; c_a, s_a²) / (Φ((1 − c_a)/s_a) − Φ(−c_a/s_a)): normals that are truncated to [0, 1]
        z = (points[:, list(self.axes)] - centres) / deviations
        inside = ndtr((1.0 - centres) / deviations) - ndtr(-centres / deviations)
        norms = np.log(deviations * np.maximum(inside, 1e-9)) + 0.5 * math.log(2.0 * math.pi)
        return np.asarray(np.exp(-0.5 * (z**2).sum(axis=1) - norms.sum()))

    def moved(self, points: Array) -> Array:
        """Points (m, at least the dimension) of an even design, moved to the same quantiles of the normals."""
        shifted = points.copy()
        for axis, centre, deviation in zip(self.axes, self.centres, self.deviations, strict=True):
            shifted[:, axis] = truncated_quantiles(points[:, axis], centre, deviation)
        return shifted


def truncated_quantiles(uniform: Array, mean: float, deviation: float, lower: float = 0.0, upper: float = 1.0) -> Array:
    """Quantiles (m,) of a normal distribution that is truncated to [lower, upper].

    Args:
        uniform: levels (m,), 0 … 1.
        mean, deviation: before the truncation.
        lower, upper: bounds.
    """
    from scipy.special import ndtr, ndtri  # slow import

    # Inverse distribution function: m + s Φ⁻¹(Φ(l) + u (Φ(h) − Φ(l))), l and h the bounds in deviations from m
    below, above = np.asarray(ndtr((np.array([lower, upper]) - mean) / deviation))
    return np.asarray(np.clip(mean + deviation * ndtri(below + uniform * (above - below)), lower, upper))


@dataclass(frozen=True)
class PosteriorQuestion:
    """Weighed pours, for the posterior of θ.

    Attributes:
        contexts: actions of the pours, in the context's unit cube.
        offsets: weighed minus regressed spillage at each; the regressed one is part of the observed differences.
        noise: standard deviation of a weighed pour.
        count: number of requested draws.
        prior: centre and standard deviation of a normal along every axis of the unit cube, truncated at its faces; with
            a deviation of 0 the axis is uniform. Empty: all axes are uniform.
        memory: priors from earlier campaigns, each a factor on `prior`; None without any.
    """

    contexts: tuple[Point, ...]
    offsets: tuple[float, ...]
    noise: float
    count: int = 200
    prior: tuple[tuple[float, float], ...] = ()
    memory: tuple[RememberedGroup, ...] | None = field(default=None, metadata=WRITTEN_IF_SET)


@dataclass(frozen=True)
class DesignQuestion:
    """Which pour would be most informative about others; in addition to a `PosteriorQuestion`, which may have no pours
    yet.

    Attributes:
        candidates: contexts at which a pour could be weighed.
        targets: contexts at which the spillage is to be predicted.
    """

    candidates: tuple[Point, ...]
    targets: tuple[Point, ...]


@dataclass(frozen=True)
class Posterior:
    """Draws of θ given weighed pours, equally weighted.

    Attributes:
        points: in the unit cube.
        discrepancies: standard deviation of the remaining discrepancy of each draw.
        effective: effective number of independent draws of the chain.
        held: probability of each group of the question's memory; None without any.
    """

    points: tuple[Point, ...]
    discrepancies: tuple[float, ...]
    effective: float
    held: Numbers | None = field(default=None, metadata=WRITTEN_IF_SET)


@dataclass(frozen=True)
class Equality:
    """When a recommended point is equal to others, so that the gentlest of them is taken.

    Attributes:
        tolerance: points whose posterior means are larger than the smallest one by at most this are equal; a smallest
            one below all observed costs counts as the smallest of these.
        speed: name of the axis on which smaller values are gentler; '' without any.
    """

    tolerance: float
    speed: str


@dataclass(frozen=True)
class SpaceFillingQuery:
    """Points that fill the space evenly, far from known ones: the start of a search, without a surrogate.

    Attributes:
        space: searched box.
        known: points that were tried before.
        pending: requested points without an answer yet.
        count: number of requested points.
        seed: of every random choice in the answer.
        constraints, infeasible, refused, failed: see `SurrogateQuery`.
    """

    space: Space
    known: tuple[Point, ...] = ()
    pending: tuple[Point, ...] = ()
    count: int = 1
    seed: int = 0
    constraints: tuple[Linear, ...] = ()
    infeasible: tuple[Point, ...] = ()
    refused: tuple[Point, ...] = ()
    failed: tuple[Point, ...] = ()


@dataclass(frozen=True)
class SurrogateQuery:
    """Parts of every query that is answered by a surrogate of observations. Use one of its subclasses.

    A query contains everything that the answer depends on; the optimiser actor keeps no relevant state.

    Attributes:
        space: searched box.
        data: observations of the cost.
        seed: of every random choice in the answer.
        kappa: κ of the lower confidence bound, constant as in the paper.
        map_resolution: if > 0 and the space has at least two dimensions, the answer includes the surrogate on a square
            grid over the two most important axes.
        map_at: point of the unit cube through which the grid passes; by default the minimum, see `SurrogateMap.at`.
        predict_at: further points for posterior predictions.
        constraints: kept by every proposal and by the best point.
        infeasible: places where a request was refused. They contain no information about the cost; proposals avoid
            places with a likely refusal.
        refused: the same for real requests: a simulation does not show that a place can be executed.
        failed: places of real requests that failed during execution, for example because the vessels touched. They are
            among `data` too, with the cost of the failure. Proposals avoid places with a likely failure, and the best
            point is one that is likely to succeed.
        equality: the best point is the gentlest of equal ones; None: the minimiser.
    """

    space: Space
    data: Data
    _: KW_ONLY
    seed: int = 0
    kappa: float = 2.0
    map_resolution: int = 0
    map_at: Point = ()
    predict_at: tuple[Point, ...] = ()
    constraints: tuple[Linear, ...] = ()
    infeasible: tuple[Point, ...] = ()
    refused: tuple[Point, ...] = ()
    failed: tuple[Point, ...] = ()
    equality: Equality | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def context_dimension(self) -> int:
        """Number of coordinates of an observation in addition to the space's."""
        return 0


@dataclass(frozen=True, kw_only=True)
class RegressionQuery(SurrogateQuery):
    """No proposal: the best point, predictions and the map.

    Attributes:
        mean: prior mean of the surrogate. 'constant' is fitted; 'zero' is the paper's.
    """

    mean: MeanName = "constant"


@dataclass(frozen=True, kw_only=True)
class ProposalQuery(SurrogateQuery):
    """Parts of every query that requests points.

    Attributes:
        pending: requested points without an answer yet.
        count: number of requested points; 0 requests only the best point, map and predictions.
    """

    pending: tuple[Point, ...] = ()
    count: int = 1


@dataclass(frozen=True, kw_only=True)
class MinimumQuery(ProposalQuery):
    """Minimise a cost of which `data` are direct observations.

    Attributes:
        acquisition: see `AcquisitionName`.
        mean: prior mean of the surrogate. 'constant' is fitted; 'zero' is the paper's.
        plain: 'lcb' as in the paper: κ is constant, and no point only fills space on a plateau.
        replicates: whether a proposal may repeat an observation. Without replicates the observations describe the whole
            cost: one point in three fills space (two, until a good one was found), the others are where the surrogate
            is uncertain, and its lengthscales may be oblique to the axes.
    """

    acquisition: AcquisitionName = "lcb"
    mean: MeanName = "constant"
    plain: bool = False
    replicates: bool = True


@dataclass(frozen=True, kw_only=True)
class CalibrationQuery(ProposalQuery):
    """Minimise the mean absolute value of signed differences over contexts that are not searched.

    In a calibration the differences are c_r − c_s, and a context is the simulated action. Points of `data` have
    `space.dimension` coordinates followed by those of the context.

    Attributes:
        contexts: points of the context's unit cube over which the absolute values are averaged.
        posterior: weighed pours, for draws of the searched parameters given them.
        design: with a posterior: which pour to weigh next.
    """

    contexts: tuple[Point, ...]
    posterior: PosteriorQuestion | None = None
    design: DesignQuestion | None = None

    @property
    def context_dimension(self) -> int:
        """See `SurrogateQuery.context_dimension`."""
        return len(self.contexts[0]) if self.contexts else 0


@dataclass(frozen=True, kw_only=True)
class PourQuery(ProposalQuery):
    """Choose the next real pour, given pours (`data`) and simulations of the same cost. Pending points are simulations.

    Attributes:
        simulated: cheap observations.
        acquisition: see `AcquisitionName`; or 'least_loss', with a `discrepancy`: the first point is a pour with a
            small loss on the way to a good action, the others are simulations that show in which way the simulator is
            wrong.
        discrepancy: average over the ways in which the simulator may be wrong. None: the prior mean is the posterior
            mean of a GP of the simulations, the paper's D3.
    """

    simulated: Data
    acquisition: Literal["lcb", "posterior_minimum", "least_loss"] = "lcb"
    discrepancy: ModelDiscrepancy | None = None


SuggestionQuery = SpaceFillingQuery | RegressionQuery | MinimumQuery | CalibrationQuery | PourQuery
"""A question to the optimiser; journals tag it with the name of its type."""


@dataclass(frozen=True)
class SurrogateMap:
    """The surrogate on a square grid over two axes of the space, for plots.

    Attributes:
        mean: posterior means, row i at the second axis' i-th place in 0 … 1.
        deviation: their standard deviations.
        axes: names of the two axes, in the space's order: those with the shortest fitted lengthscales. Empty for a
            space with two axes only.
        at: point of the unit cube through which the grid passes: every other axis is held at its value there. It is
            `SurrogateQuery.map_at`, or the minimum of the posterior mean: the minimiser that 'posterior_minimum' found,
            otherwise `Suggestion.best_point`.
    """

    mean: tuple[tuple[float, ...], ...]
    deviation: tuple[tuple[float, ...], ...]
    axes: tuple[str, ...] = ()
    at: Point = ()

    def plane(self, space: Space) -> Space:
        """The two axes of the grid as a space: the first is horizontal, the second vertical."""
        return Space(tuple(axis for axis in space.axes if not self.axes or axis.name in self.axes))

    def held(self, space: Space) -> dict[str, float]:
        """Values of the axes that the grid does not show [SI]; empty if it shows them all."""
        shown = self.plane(space).names
        return {name: value for name, value in space.decode(self.at).items() if name not in shown} if self.at else {}


# More than 20 fields: one answer for all kinds of questions; fields that a question does not need are absent.
@dataclass(frozen=True)
class Suggestion:
    """An answer.

    Attributes:
        points: `count` proposals in the unit cube.
        means: posterior means there; NaN-free; empty if no surrogate was fitted (too few data, or drawn points only).
        deviations: posterior standard deviations of the noise-free cost there.
        best_point: minimiser of the posterior mean over the observed points (the simulated ones if there are no
            others), except those that were refused or probably are. After failures, the minimised quantity is the
            expectation with a failure of the estimated probability, at the largest observed cost. With
            `SurrogateQuery.equality`: the gentlest of equal points. None without a surrogate.
        best_mean: posterior mean there.
        best_deviation: its standard deviation.
        hyperparameters: fitted values by name (for reports and plots); 'noise' and 'signal' in the cost's unit.
        surrogate: see `SurrogateQuery.map_resolution`.
        predictions: posterior means at `SurrogateQuery.predict_at`; empty without a surrogate.
        prediction_deviations: their standard deviations.
        seconds: CPU seconds used.
        noises: standard deviations of single real observations at the proposals; empty without a surrogate.
        bands: shortest intervals that contain single real observations at the proposals with a probability of
            `sim_engine.prediction_band.LEVEL`: for a `PourQuery`, and a `MinimumQuery` with a map that is not `plain`;
            up to 100 observations without a `ModelDiscrepancy`. They may differ from `means` and `deviations`, because
            they are averaged over hyperparameters or hypotheses.
        feasibilities: probabilities that the proposals are neither refused nor fail; empty without any refusal or
            failure.
        posterior: answer to `CalibrationQuery.posterior`; None without a surrogate.
        best_noise: standard deviation of a single real observation at `best_point`; None without a surrogate.
        gains: with a `DesignQuestion`: expected reduction of the variance of predictions by weighing a pour at each
            candidate, averaged over the targets; in the cost's unit, squared.
        uncertainty: with a `DesignQuestion`: the current variance, averaged over the targets.
        discrepancy: with a `ModelDiscrepancy`: the conclusions about the simulator.
        equal_ranges: with `SurrogateQuery.equality`: by axis, the ends of the interval around `best_point` in which
            the points are equal to it, the other axes held; in the unit cube.
    """

    points: tuple[Point, ...]
    means: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()
    best_point: Point | None = None
    best_mean: float | None = None
    best_deviation: float | None = None
    hyperparameters: dict[str, float] | None = None
    surrogate: SurrogateMap | None = None
    seconds: float = 0.0
    predictions: tuple[float, ...] = ()
    prediction_deviations: tuple[float, ...] = ()
    noises: tuple[float, ...] = ()
    bands: tuple[tuple[float, float], ...] = ()
    feasibilities: tuple[float, ...] = ()
    posterior: Posterior | None = None
    best_noise: float | None = None
    gains: tuple[float, ...] = ()
    uncertainty: float | None = None
    discrepancy: DiscrepancyFound | None = None
    equal_ranges: tuple[tuple[float, float], ...] | None = field(default=None, metadata=WRITTEN_IF_SET)
