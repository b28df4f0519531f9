"""Questions to the optimiser and its answers: plain values that travel, are journalled and replayed.

How a bench may differ from its simulator, as a question says it and an answer tells it: plain values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sim_engine.search_space import Space

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Play:
    """How far one axis may be off, as standard deviations.

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
    """The simulator's action scales · u + shifts does what u does on the bench; in units of the cube."""

    scales: Numbers
    shifts: Numbers


@dataclass(frozen=True)
class Limit:
    """No pour whose loss is above `loss` (in the cost's unit) with more than `probability`."""

    loss: float
    probability: float


@dataclass(frozen=True)
class ModelDiscrepancy:
    """For `mean='adaptive'`: the ways in which the simulator may be wrong, and what a pour is worth.

    Attributes:
        play: of each axis.
        drawn: displacements that are likelier than others, equally likely: what a calibration, or pours into another
            receiver, said about the bench.
        ignorance: prior probability that the simulator says nothing of this bench.
        worst: largest cost.
        left: real observations that follow the one that is proposed.
        limit: that proposals keep, if any action does.
        looks_ahead: whether the next observation may be made for what it tells of other places.
    """

    play: tuple[Play, ...]
    drawn: tuple[BenchOffset, ...] = ()
    ignorance: float = 0.08
    worst: float = 1.0
    left: int = 0
    limit: Limit | None = None
    looks_ahead: bool = True


@dataclass(frozen=True)
class DiscrepancyFound:
    """What the observations say about the simulator.

    Attributes:
        ignorance: probability that the simulator says nothing of this bench.
        shifts: of the cube's centre, by which the simulator's action differs; mean over all other hypotheses.
        deviations: of these shifts.
        factor: real over simulated cost, the median of those hypotheses.
        gain: by how much one more observation is expected to lower the least expected cost; None before any was made,
            and where no action keeps the limit.
        exceedances: at the proposals: probabilities that an observation is above the limit; empty without one.
        least_exceedance: the smallest that any action has; None without a limit.
        drawn: displacements drawn from the posterior, for another receiver; only with `count=0`.
    """

    ignorance: float
    shifts: Numbers
    deviations: Numbers
    factor: float
    gain: float | None = None
    exceedances: Numbers = ()
    least_exceedance: float | None = None
    drawn: tuple[BenchOffset, ...] = ()


Point = tuple[float, ...]
"""A point of the unit cube."""

MeanName = Literal["constant", "zero", "simulated", "scaled", "adaptive"]
AcquisitionName = Literal["lcb", "posterior_minimum", "random", "sobol", "knowledge", "least_loss"]
NoiseName = Literal["constant", "varying"]


@dataclass(frozen=True)
class Data:
    """Observations of a cost to be minimised.

    Attributes:
        points: in the unit cube, one tuple of `Space.dimension` numbers each.
        costs: one number each; failed trials are left out by the strategy or penalised by it.
    """

    points: tuple[Point, ...] = ()
    costs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.points) != len(self.costs):
            raise ValueError(f"{len(self.points)} points but {len(self.costs)} costs")

    def __len__(self) -> int:
        return len(self.points)

    def added(self, point: Point, cost: float) -> Data:
        """A copy with one more observation."""
        return Data((*self.points, tuple(float(u) for u in point)), (*self.costs, float(cost)))


@dataclass(frozen=True)
class Linear:
    """A constraint Σ weight · value ≤ upper on the values of named axes.

    Attributes:
        weights: pairs of an axis' name and its weight.
        upper: largest allowed sum, in the unit that weights and values [SI] give.
    """

    weights: tuple[tuple[str, float], ...]
    upper: float


@dataclass(frozen=True)
class PosteriorQuestion:
    """Weighed pours, for what they say about θ.

    Attributes:
        contexts: actions of the pours, in the context's unit cube.
        offsets: weighed minus regressed spillage at each; the regressed one is in the differences that were observed.
        noise: standard deviation of a weighed pour.
        count: of draws wanted.
        prior: centre and standard deviation along every axis of the unit cube, of normals that its faces cut off; where
            a deviation is 0, all values are alike. Empty: they are along all axes.
    """

    contexts: tuple[Point, ...]
    offsets: tuple[float, ...]
    noise: float
    count: int = 200
    prior: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class DesignQuestion:
    """Which pour would tell most about others; asked beside a `PosteriorQuestion`, which may then have no pours yet.

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
        discrepancies: of each, the standard deviation of what it still lacks.
        effective: how many independent draws the chain was worth.
    """

    points: tuple[Point, ...]
    discrepancies: tuple[float, ...]
    effective: float


@dataclass(frozen=True)
class Disturbance:
    """One way in which requests are executed: x becomes scales · x + shifts, beside coordinates that no request has.

    Attributes:
        scales, shifts: one number for each axis of the space.
        context: errors of execution that are not a change of an axis.
    """

    scales: Point
    shifts: Point
    context: Point = ()


@dataclass(frozen=True)
class Risk:
    """What is minimised over disturbances: the mean, or the CVaR, which is the mean of the worst share 1 − level.

    Attributes:
        disturbances: equally likely.
        level: β of CVaR, 0 ≤ β < 1; 0: the mean of all.
    """

    disturbances: tuple[Disturbance, ...]
    level: float = 0.0


@dataclass(frozen=True)
class RiskAnswer:
    """What the surrogate says over the disturbances, at each of `SuggestProblem.predict_at`.

    Attributes:
        expected: means over the disturbances.
        spreads: standard deviations over them.
        worst: indices of the worst disturbances, the worst first; empty tuples for a mean.
    """

    expected: tuple[float, ...]
    spreads: tuple[float, ...]
    worst: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class SearchEffort:
    """How much a fit may cost. Without one it starts afresh and takes the time it needs.

    Attributes:
        start: hyperparameters to begin with, of each process in the order of fitting: `Suggestion.fitted` of an
            earlier answer. A process without an entry is fitted afresh.
        iterations: of the search for better ones, for processes that have a start; 0 takes them as they are.
    """

    start: tuple[tuple[float, ...], ...] = ()
    iterations: int = 0


@dataclass(frozen=True)
class SuggestProblem:
    """Everything that a proposal depends on; the optimiser actor keeps no state that matters.

    Attributes:
        space: searched box.
        data: what was observed of the cost.
        pending: points asked for and not answered yet.
        count: how many points are wanted; 0 asks for `best_point`, map and predictions only.
        seed: of every random choice in the answer.
        mean: prior mean of the surrogate: 'constant' (fitted), 'zero' (the paper's), 'simulated' (posterior mean of a
            GP over `simulated`, the paper's D3), 'scaled' (real cost = ρ · simulated cost + remainder, fitted at once:
            for 'knowledge'), 'adaptive' (an average over the ways in which the simulator may be wrong, see `mismatch`).
        simulated: cheap observations of the same cost, for the last three.
        acquisition: 'lcb' minimises m(x) − κ s(x); 'posterior_minimum' minimises m(x) (further points of the same
            answer the penalised 'lcb'); 'random' and 'sobol' only draw. 'knowledge' looks for *simulations*: where one
            more of them would teach most about which action is best (a mean that knows simulations is needed).
            'least_loss' (for 'adaptive'): the first point is a pour that loses little on the way to a good action, the
            others are simulations that tell in which way the simulator is wrong.
        kappa: κ of the lower confidence bound, constant as in the paper.
        map_resolution: if > 0 and the space has at least two dimensions, the answer carries the surrogate on a square
            grid over the two axes that matter most.
        map_at: place of the unit cube that the grid goes through; without one it is the least that is known, see
            `SurrogateMap.at`.
        predict_at: further points at which the posterior is wanted (a regression, with `count=0`).
        context: if given, the observations are signed differences that also depend on coordinates which nobody chooses
            (in calibration: c_r − c_s, and the action that was simulated), and what is minimised is the mean of their
            absolute values over these places of the context's unit cube. The points of `data` then have
            `space.dimension` coordinates followed by those of the context.
        infeasible: places where a request was refused. They say nothing about the cost; proposals keep away from places
            where another refusal is likely.
        refused: the same of real requests: what was only simulated does not say that a place can really be had.
        failed: places of real requests that went wrong under way, where the vessels touched after all, say. They are
            among `data` too, at what that costs. Proposals keep away from where that is likely again, and the best
            point is one that is likely to be made.
        constraints: that every proposal meets.
        noise: of real observations: 'constant', or 'varying' with the expected cost where the observations show it.
        posterior: with a context: weighed pours, for draws of the searched parameters given them.
        design: with a posterior: which pour to weigh next.
        risk: if given, the observations are of requests as they were executed, disturbances included: points of `data`
            have `space.dimension` coordinates (which may leave the cube) followed by the disturbances' context. What is
            minimised, predicted and mapped is the measure over the disturbances of a request.
        pouring: 'knowledge': places of real observations whose outcome is out; `pending` are simulations then.
        effort: limits the fit, and has the answer carry what was fitted.
        mismatch: 'adaptive': how the simulator may be wrong, and how many pours follow.
        plain: 'lcb' as it stands in the paper: κ is kept, and no point only fills space on a plateau.
    """

    space: Space
    data: Data
    pending: tuple[Point, ...] = ()
    count: int = 1
    seed: int = 0
    mean: MeanName = "constant"
    simulated: Data = Data()
    acquisition: AcquisitionName = "lcb"
    kappa: float = 2.0
    map_resolution: int = 0
    map_at: Point = ()
    predict_at: tuple[Point, ...] = ()
    context: tuple[Point, ...] = ()
    infeasible: tuple[Point, ...] = ()
    refused: tuple[Point, ...] = ()
    failed: tuple[Point, ...] = ()
    constraints: tuple[Linear, ...] = ()
    noise: NoiseName = "constant"
    posterior: PosteriorQuestion | None = None
    design: DesignQuestion | None = None
    risk: Risk | None = None
    pouring: tuple[Point, ...] = ()
    effort: SearchEffort | None = None
    plain: bool = False
    mismatch: ModelDiscrepancy | None = None

    @property
    def beside(self) -> int:
        """Coordinates of an observation that are none of the space's."""
        if self.risk is not None and self.risk.disturbances:
            return len(self.risk.disturbances[0].context)
        return len(self.context[0]) if self.context else 0


@dataclass(frozen=True)
class SurrogateMap:
    """The surrogate on a square grid over two axes of the space, for pictures.

    Attributes:
        mean: posterior means, row i at the second axis' i-th place in 0 … 1.
        deviation: their standard deviations.
        axes: names of the two axes, in the space's order: those with the shortest fitted lengthscales. Empty for a
            space that has no others.
        at: point of the unit cube that the grid goes through: every other axis is held at its value there. It is
            `SuggestProblem.map_at`, or where the posterior mean is least: the minimiser that 'posterior_minimum' found,
            else `Suggestion.best_point`.
    """

    mean: tuple[tuple[float, ...], ...]
    deviation: tuple[tuple[float, ...], ...]
    axes: tuple[str, ...] = ()
    at: Point = ()

    def plane(self, space: Space) -> Space:
        """The two axes of the grid, out of those that were searched: the first across, the second up."""
        return Space(tuple(axis for axis in space.axes if not self.axes or axis.name in self.axes))

    def held(self, space: Space) -> dict[str, float]:
        """Values of the axes that the grid does not show [SI]; empty if it shows them all."""
        shown = self.plane(space).names
        return {name: value for name, value in space.decode(self.at).items() if name not in shown} if self.at else {}


@dataclass(frozen=True)
class Suggestion:
    """An answer.

    Attributes:
        points: `count` proposals in the unit cube.
        means: posterior means there; NaN-free; empty if no surrogate was fitted (too few data, or only drawn).
        deviations: posterior standard deviations of the noise-free cost there.
        best_point: minimiser of the posterior mean over the observed points (the simulated ones while nothing else was
            observed) that were not refused, nor probably are; where requests failed, of what is expected when each
            fails again as likely as it seems, at the cost of the dearest observation; with a risk: over `predict_at`,
            for requests are not what was observed; None without a surrogate.
        best_mean: posterior mean there.
        best_deviation: its standard deviation.
        hyperparameters: fitted values by name (for people and plots); 'noise' and 'signal' in the cost's unit.
        surrogate: see `SuggestProblem.map_resolution`.
        predictions: posterior means at `SuggestProblem.predict_at`; empty without a surrogate.
        prediction_deviations: their standard deviations.
        seconds: CPU seconds it took.
        noises: standard deviations of single real observations at the proposals; empty without a surrogate.
        bands: 'adaptive': shortest intervals that hold single real observations at the proposals with a probability of
            `sim_engine.prediction_band.LEVEL`.
        feasibilities: probabilities that the proposals are not refused and don't fail; empty while nothing was or did.
        posterior: what was asked for with `SuggestProblem.posterior`; None without a surrogate.
        best_noise: standard deviation of a single real observation at `best_point`; None without a surrogate.
        risk: with a risk: what else is known at `SuggestProblem.predict_at`.
        values: 'knowledge': what a simulation at each point is worth, those before it given; in the cost's unit, ≥ 0.
        pour_value: 'knowledge': the same of the one real observation that is worth most.
        gains: 'design': by how much weighing a pour at each candidate is expected to lower the variance of predictions,
            in the mean over the targets; in the cost's unit, squared.
        uncertainty: 'design': that variance as it is, the mean over the targets.
        mismatch: 'adaptive': what the observations say about the simulator.
        fitted: with `SuggestProblem.effort`: hyperparameters of each process, to start the next fit with.
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
    risk: RiskAnswer | None = None
    values: tuple[float, ...] = ()
    pour_value: float | None = None
    fitted: tuple[tuple[float, ...], ...] = ()
    gains: tuple[float, ...] = ()
    uncertainty: float | None = None
    mismatch: DiscrepancyFound | None = None
