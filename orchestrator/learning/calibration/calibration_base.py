"""Base of the calibration strategies, with their results and the settings that they share.

- `Calibration` makes the requests, records the outcomes, drops failed simulations and reports θ*.
- `Calibrated` is the result; `TriedOnAll` and `TriedOnce` describe one θ each.
- `DesignSettings` derives the number of θ of C1 to C3 and checks it against the budget of simulations.

The choice of the next θ belongs to the subclasses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Generic, Literal, Self, TypeVar, cast

from pydantic import Field

from actors.optimizer.questions import Point, Posterior, Suggestion
from orchestrator.learning.calibration.campaign_memory import (
    CONTRADICTED,
    MemoryFound,
    memory_found,
    unit_memory,
    verdicts,
)
from orchestrator.learning.calibration.posterior_summary import PosteriorFound, posterior_found
from orchestrator.learning.campaign_plan import (
    LEAST_TRAINING_POURS,
    CalibrationPlan,
    CalibrationSettings,
    MeasuredPour,
)
from orchestrator.learning.requests import Decision, Outcome, Request, Simulate, Simulated, Slots, Suggest
from orchestrator.learning.run_errors import LearningError
from orchestrator.learning.stage_result import DisplayedMap, ResultPart, StageResult, displayed_map
from orchestrator.learning.strategy import Progress, is_sound
from orchestrator.learning.trials import OptimizerQueries, SeedStream, Trial, Trials
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import MINIMUM_POURED
from sim_engine.settings.model import MOST_SIMULATIONS, PositiveSimulationCount, Problems
from sim_engine.settings.quantity import Quantity

THETA_MAP_RESOLUTION = 30
"""Points per axis of the map that a calibration concludes with."""

S = TypeVar("S", bound=CalibrationSettings)
"""Settings of a calibration."""


class CalibrationTrial(ResultPart):
    """A θ with the discrepancy between simulator and pours."""

    theta: dict[str, float]
    """Searched parameters."""

    discrepancy: float | None
    """Mean |r − c_s|, or |r − c_s| of a single action; None if nothing could be compared."""


class TriedOnAll(CalibrationTrial):
    """C1 to C3: a θ that was simulated on every training pour."""

    defined: int
    """Number of pours with a discrepancy."""

    largest: float | None
    """Largest |r − c_s| of these pours."""

    differences: tuple[float | None, ...] = ()
    """|r − c_s| on every usable training pour; None where it was not simulated, or has none."""


class TriedOnce(CalibrationTrial):
    """C4: a θ that was simulated at one action."""

    action_si: dict[str, float]
    """Searched dimensions of the action."""

    measured: float
    """Spillage c_r at the action, as predicted by the regression of the weighed pours."""

    difference: float | None
    """c_r − c_s with its sign if the surrogate includes the action; otherwise None."""


class CalibratedTheta(ResultPart):
    """θ* with its expected discrepancy and its posterior."""

    theta: SimulationParameters
    """All parameters, including those that were not searched."""

    searched: tuple[str, ...]
    """Names of the searched parameters."""

    predicted_discrepancy: float
    """Expected mean |r − c_s| of θ*."""

    predicted_deviation: float
    """Standard deviation of the expected mean."""

    hyperparameters: dict[str, float] | None
    """Hyperparameters of the surrogate; None without a surrogate."""

    map: DisplayedMap | None
    """The discrepancy over the two most influential parameters."""

    posterior: PosteriorFound | None = None
    """Posterior of the θ that fit the pours; C4 only."""


class Calibrated(StageResult):
    """Result of a calibration."""

    kind: Literal["calibration"] = "calibration"

    strategy: str
    """'C1' to 'C4', or the name of another strategy."""

    simulations: int
    """Number of simulations with an answer."""

    lost: int
    """Number of answered simulations without a discrepancy."""

    undefined: int
    """Number of simulations that poured too little to define a spillage."""

    training_pours: int
    """Number of weighed pours that were used for training."""

    trials: tuple[TriedOnAll | TriedOnce, ...]
    """Every θ with all answers, in request order."""

    found: CalibratedTheta | None = None
    """θ*; None until the end."""

    ended: str | None = None
    """Reason of the end of an automatic calibration."""

    pour_seeds: tuple[int, ...] = ()
    """Seeds of the simulations of the usable training pours, if the evaluation repeats these simulations."""

    memory: MemoryFound | None = Field(default=None, exclude_if=lambda found: found is None)
    """Prior from earlier campaigns, and its agreement with the pours; without `prior` in the campaign it is absent."""


class Calibration(ABC, Generic[S]):
    """Base of C1 to C4. Subclasses choose the next trial (`_next`) and convert a simulation to a cost (`_discrepancy`).

    Only pours of the split 'train' are used. A simulation that failed, or that poured too little to define c_s, is
    dropped.
    """

    def __init__(self, plan: CalibrationPlan, measured: Sequence[MeasuredPour], seed: int) -> None:
        """Plan the calibration.

        Raises:
            LearningError: fewer than two usable pours.
        """
        self._train = [pour for pour in measured if pour.split == "train"]
        self._usable = [pour for pour in self._train if pour.spillage is not None]
        if len(self._usable) < LEAST_TRAINING_POURS:
            raise LearningError(
                f"calibration needs at least {LEAST_TRAINING_POURS} training pours with ≥ {MINIMUM_POURED:.0%} poured, "
                f"got {len(self._usable)} of {len(self._train)}; make more pours, or let them tilt farther (max_angle)"
            )
        self._plan = plan
        self._settings = cast(S, plan.settings)
        self._seeds = SeedStream(seed, plan.strategy)
        self._questions = OptimizerQueries(self._seeds)
        self._trials = Trials()
        self._width_known = False
        self._undefined = 0
        self._best: Point | None = None
        self._expected: tuple[float, float] = (0.0, 0.0)
        self._final: Suggestion | None = None
        self._posterior: Posterior | None = None
        self._alone: Posterior | None = None
        self._memory = unit_memory(plan.memory, plan.parameters)
        self._shares: dict[str, float] = {}
        self.decisions = [Decision(line) for line in (() if plan.memory is None else plan.memory.lines)]

    # -- asking ----------------------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether θ* is known."""
        return self._best is not None and not self._questions.out

    def ask(self, slots: Slots) -> list[Request]:
        """Return the queued requests, and the next ones as soon as the data they depend on is complete."""
        if not self._width_known and slots.simulations > 0:
            self._trials.width, self._width_known = self._trials_at_once(slots.simulations), True
        simulations = self._trials.issue(slots.simulations)
        if not self.finished and not self._questions.out and not self._trials.queued:
            self._next()
            simulations += self._trials.issue(slots.simulations - len(simulations))
        # queries come first: with outcomes in request order, a query then does not wait for simulations
        return [*self._questions.issue(), *simulations]

    @abstractmethod
    def _next(self) -> None:
        """Put the next query, queue trials, or conclude. It is called when nothing is queued and no query is
        pending."""

    def _trials_at_once(self, slots: int) -> int:
        """Number of trials that run at the same time."""
        return slots

    # -- outcomes --------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a query or a simulation."""
        if isinstance(request, Suggest):
            self._questions.answer(request, outcome)
        elif isinstance(request, Simulate):
            self._trials.settle(request, self._cost(request, outcome))
        else:
            raise ValueError(f"calibration asks for no {type(request).__name__}")

    def _cost(self, request: Simulate, outcome: Outcome) -> float | None:
        if not isinstance(outcome, Simulated) or outcome.outcome.invalid is not None:
            return None
        if not is_sound(outcome.outcome.fractions):
            return None
        simulated = outcome.outcome.fractions.spillage
        if simulated is None:
            self._undefined += 1
            return None
        return self._discrepancy(request, simulated)

    @abstractmethod
    def _discrepancy(self, request: Simulate, simulated: float) -> float:
        """Contribution to Δ of a simulation with the result c_s(a, θ)."""

    def _settle(self, point: Point, mean: float, deviation: float) -> None:
        """Set θ*, with the mean and standard deviation of its expected discrepancy."""
        self._best, self._expected = point, (mean, deviation)
        text = f"θ* {described(self._values(point))}: |Δ| {max(mean, 0.0):.3f} ± {deviation:.3f}"
        self.decisions.append(Decision(text, {"mean": mean, "sd": deviation}))

    def _settle_at_minimum(self, suggestion: Suggestion) -> None:
        """Set θ* to the suggested minimiser of the posterior mean."""
        if not suggestion.means:
            raise self._no_discrepancies()
        self._final = suggestion
        self._settle(suggestion.points[0], suggestion.means[0], suggestion.deviations[0])

    def _no_discrepancies(self) -> LearningError:
        return LearningError(
            f"calibration learnt nothing: of {self._trials.answered} simulations {self._trials.lost} gave no "
            "discrepancy (see their reasons in the journal)"
        )

    # -- results ---------------------------------------------------------------------------------------------------

    def parameters_at(self, point: Point) -> SimulationParameters:
        """θ_s at a point of the unit cube, with the plan's fixed values."""
        return SimulationParameters.from_values({**self._plan.fixed_parameters, **self._values(point)})

    @property
    def theta(self) -> SimulationParameters:
        """θ*.

        Raises:
            RuntimeError: the calibration isn't finished.
        """
        if self._best is None:
            raise RuntimeError("the calibration isn't finished")
        return self.parameters_at(self._best)

    def _values(self, point: Point) -> dict[str, float]:
        return self._plan.parameters.decode(point)

    @property
    @abstractmethod
    def _budget(self) -> int:
        """Total number of simulations."""

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        return Progress(self._trials.answered, self._budget)

    @abstractmethod
    def _row(self, number: int, trial: Trial) -> TriedOnAll | TriedOnce:
        """Convert a trial to its row in the result."""

    def _contradicts(self, posterior: Posterior) -> bool:
        """Whether a posterior contradicts the memory of a group; no memory is used from then on."""
        if self._memory is None or self._plan.memory is None:
            return False
        self._shares = dict(zip(self._plan.memory.groups, posterior.held or (), strict=True))
        lost = {group: share for group, share in self._shares.items() if share < CONTRADICTED}
        if lost:
            self.decisions += verdicts(self._plan.memory, lost)
            self._memory = None
        return bool(lost)

    def _remember(self, alone: Posterior | None) -> None:
        """Record the posterior from the pours alone, and the agreement of the memory with the pours.

        Args:
            alone: None if no memory is used, because the posterior is then that of the pours alone.
        """
        self._alone = self._posterior if alone is None else alone
        if self._memory is not None and self._plan.memory is not None:
            self.decisions += verdicts(self._plan.memory, self._shares)

    def _posterior_found(self) -> PosteriorFound | None:
        """Posterior of the θ that fit the pours, if the strategy has one."""
        return None if self._posterior is None else posterior_found(self._posterior, self._plan.parameters)

    def result(self) -> Calibrated:
        """θ* with its expected discrepancy, all trials, and the map of the discrepancy over the two most influential
        θ."""
        return Calibrated(
            strategy=self._plan.strategy,
            simulations=self._trials.answered,
            lost=self._trials.lost,
            undefined=self._undefined,
            training_pours=len(self._usable),
            trials=tuple(self._row(i, trial) for i, trial in enumerate(self._trials.all) if trial.closed),
            found=self._found() if self.finished else None,
            memory=memory_found(self._plan.memory, self._shares, self._alone, self._plan.parameters),
        )

    def _found(self) -> CalibratedTheta:
        mean, deviation = self._expected
        final = self._final
        return CalibratedTheta(
            theta=self.theta,
            searched=self._plan.parameters.names,
            predicted_discrepancy=mean,
            predicted_deviation=deviation,
            hyperparameters=None if final is None else final.hyperparameters,
            map=None if final is None else displayed_map(final.surrogate, self._plan.parameters),
            posterior=self._posterior_found(),
        )


def described(values: Mapping[str, float]) -> str:
    """Format parameters for display: 'particles 1200  cohesion 0.031  receiver_x 3.2 mm'."""
    infos = SimulationParameters.info()
    return "  ".join(
        f"{name} {value / infos[name].factor:.4g}" + (f" {infos[name].shown}" if infos[name].factor != 1.0 else "")
        for name, value in values.items()
    )


Kappa = Annotated[float, Quantity("1", "2.0", 0.0, 100.0)]
"""κ of the lower confidence bound."""


class DesignSettings(CalibrationSettings):
    """Settings of C1, C2 and C3, which simulate a number of θ on all training pours each.

    A key of the strategy gives the number of θ, and `simulations` limits it. If only `simulations` is given, it defines
    the number of θ.
    """

    examples: ClassVar[dict[str, str]] = {}
    """Keys that give the number of θ, each with an example. If all are missing, the error message suggests the last
    one."""

    simulations: PositiveSimulationCount | None = None
    """Single simulated pours: a limit, or, if no other key is given, the number that defines how many θ are tried."""

    @property
    @abstractmethod
    def thetas(self) -> int:
        """Number of θ, once the settings are settled."""

    @abstractmethod
    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Fill in the number of θ that is given or that `simulations` allows."""

    def simulations_on(self, train: int) -> int:
        """Number of simulations: each θ is simulated on all training pours."""
        return self.thetas * train

    def settled(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Derive the number of θ from the single key that gives it."""
        written = [key for key in self.examples if getattr(self, key) is not None]
        if len(written) > 1:
            complaints.add(f"stands beside '{written[0]}'; keep one of them", written[1], key=True)
        if not written and self.simulations is None and not complaints.any:
            wanted, example = list(self.examples.items())[-1]
            complaints.add(f"key '{wanted}' is missing; add for example '{wanted}: {example}'", key=True, of=wanted)
        if complaints.any or train < 1 or not searched or not (written or self.simulations):
            return None
        completed = self.with_thetas(searched, train, complaints)
        if completed is None:
            return None
        key = written[0] if written else "simulations"
        cost, limit = completed.simulations_on(train), self.simulations or MOST_SIMULATIONS
        if cost > limit:
            limited_by = "'simulations' allows" if self.simulations is not None else "at most are possible:"
            text = f"makes {completed.thetas} θ × {train} training pours = {cost} simulations; {limited_by} {limit}"
            complaints.add(text, key)
            return None
        return completed

    def _counted(self, count: int | None, train: int, complaints: Problems) -> int | None:
        """Number of θ that is given or that `simulations` allows."""
        if count is None and (self.simulations or 0) < train:
            text = f"allows not a single θ: each is simulated on all {train} training pours"
            complaints.add(text, "simulations")
            return None
        return (self.simulations or 0) // train if count is None else count


def check_initial(
    settings: CalibrationSettings, initial: int, budget: int, key: str, unit: str, complaints: Problems
) -> None:
    """Check that the random parameters fit into the budget, which `key` gives in `unit`."""
    if initial > budget:
        at = "initial_samples" if "initial_samples" in settings.model_fields_set else key
        complaints.add(f"{initial} random parameters don't fit into {budget} {unit}", at)
