"""A campaign with everything resolved: scenes, spaces, budgets, seeds as plain values. What the YAML means.

What a strategy declares of itself: one class with its settings, their checks, and how it is made.

The class stands beside the strategy and is registered at the door `decant.strategies` under its `strategy`. From it
come the YAML keys with their errors, the JSON schema, the tables of the docs, the run's record and its fingerprint.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from actors.laboratory_settings import LaboratorySpec
from actors.optimizer.questions import BenchOffset, Linear, Point
from orchestrator.strategies.deployment.objectives import Objectives
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import MINIMUM_POURED, Loss
from sim_engine.scene import PoseError, Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import FREE, PourCount, Problems, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from orchestrator.requests import Order
    from orchestrator.strategies.strategy import Strategy


class StrategySettings(Section):
    """What the settings of all strategies have in common."""

    tag: ClassVar[str] = "strategy"

    strategy: str = ""
    """Which strategy; a literal in each class, and its name at the door."""

    @classmethod
    def like(cls, other: StrategySettings, without: Sequence[str] = (), **changes: Any) -> Self:
        """Settings with what another strategy has of the same name, and defaults for the rest.

        Args:
            without: names that keep their defaults.
            changes: values of further names.
        """
        shared = cls.model_fields.keys() & type(other).model_fields.keys() - {"strategy", *without}
        return cls().model_copy(update={name: getattr(other, name) for name in shared} | changes)

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Which plug-in would have it, if it could be loaded."""
        strategies = resolve_name("orchestrator.strategies.strategy_registry:STRATEGIES")
        return next((str(broken) for broken in strategies.broken if broken.name == word), "")


class CalibrationSettings(StrategySettings):
    """Settings of a calibration: which θ reproduces the weighed spills."""

    has_prior: ClassVar[bool] = False
    """Whether it averages over a prior of actions, so that `actions` may have one."""

    def settled(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """The settings with every number filled in; what is wrong is complained of, and then there are none.

        Args:
            searched: names of the searched θ.
            train: pours that a θ can be simulated on; 0 where that is not known, because something else is wrong.
        """
        return self

    @property
    def makes_posterior(self) -> bool:
        """Whether its result has draws of θ given the pours."""
        return False

    @abstractmethod
    def simulations_on(self, train: int) -> int:
        """Single simulated pours that it may spend on so many training pours."""

    @abstractmethod
    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """The strategy itself."""


@dataclass(frozen=True)
class Premises:
    """What of a deployment its settings may be checked against.

    Attributes:
        actions: that are searched; None where something is wrong with them.
        objectives: whether there are objectives in place of a loss.
    """

    actions: Space | None
    objectives: bool


class DeploymentSettings(StrategySettings):
    """Settings of a deployment: how to pour into vessels that calibration never saw."""

    learns_on_pours: ClassVar[bool] = True
    """Whether real pours, also those of before, enter what it knows; if not, it may also only plan (`pours: 0`)."""

    simulates: ClassVar[bool] = True
    """Whether θ matters to it."""

    pours: PourCount | None = None
    """Real pours per receiver."""

    noise: Literal["constant", "varying"] = "constant"
    """Scatter of a pour: the same everywhere, or varying with the action where at least 20 observations show it."""

    on_failed_pour: Literal["penalise", "ignore"] = "penalise"
    """How a failed pour enters the data."""

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Complain of what does not make sense together."""
        if not self.learns_on_pours:
            return
        if self.pours is None:
            complaints.add(
                f"key 'pours' is missing; {self.strategy} learns on real pours, add for example 'pours: 15'",
                key=True,
                of="pours",
            )
        elif self.pours == 0:
            complaints.add(f"{self.strategy} learns on real pours; at least 1 (D1 plans without any)", "pours")

    @property
    def order(self) -> Order:
        """The order in which outcomes are told: 'completion' only where the clock takes part in the decisions."""
        return "logical"

    @property
    def needs_posterior(self) -> bool:
        """Whether it plans with draws of θ given the pours of a calibration."""
        return False

    @property
    def learns_of_benches(self) -> bool:
        """Whether it goes by what calibration, or pours into another receiver, said about the bench."""
        return False

    def draws(self, plan: DeploymentPlan, parameters: SimulationParameters, count: int, seed: int) -> Sequence[Draw]:
        """Ways in which what it recommends may go otherwise than planned, for a prediction; none: as planned."""
        return ()

    @property
    def simulations(self) -> int:
        """Simulations that it makes into one receiver, at most."""
        return 0

    @property
    def simulations_before(self) -> int:
        """Those of them before the first pour."""
        return self.simulations

    @property
    def simulations_beside(self) -> int:
        """Those beside every pour."""
        return 0

    @property
    def spending(self) -> str:
        """What it spends into one receiver, in words."""
        return f"{self.pours} pours"

    @abstractmethod
    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""


Design = Literal["stratified", "active"]
"""How calibration pours are chosen: spread evenly, or each by what it will tell about deployment."""


@dataclass(frozen=True)
class RecordedPour:
    """One weighed pour read from a file.

    Attributes:
        poured, spilled, retained: masses [kg].
        split: 'train', 'test' or 'transfer'.
        scene: name of the one that it was made in; '' for that of its `RecordSet`.
    """

    action: Action
    poured: float
    spilled: float
    retained: float
    split: str
    scene: str = ""

    @property
    def poured_fraction(self) -> float:
        """Poured over loaded."""
        return self.poured / (self.poured + self.retained)

    @property
    def normalised_spillage(self) -> float | None:
        """r = spilled / poured, None where too little was poured for it."""
        return None if self.poured_fraction < MINIMUM_POURED else self.spilled / self.poured


@dataclass(frozen=True)
class MeasuredPour:
    """A weighed pour as calibration and evaluation need it.

    Attributes:
        spillage: r = spilled / poured; None below 5 % poured, where it is undefined.
        poured: fraction of the load that left the pourer.
        split: 'train', 'test' or 'transfer'.
        scene: name of the one that it was made in; '' for the first of its calibration.
    """

    action: Action
    spillage: float | None
    poured: float
    split: str = "train"
    scene: str = ""

    @classmethod
    def from_record(cls, record: RecordedPour) -> MeasuredPour:
        """From a row of a file of recorded pours."""
        return cls(record.action, record.normalised_spillage, record.poured_fraction, record.split, record.scene)


@dataclass(frozen=True)
class KnownSimulation:
    """One that was made before a calibration, in one of its scenes.

    Attributes:
        theta: values of the searched parameters.
        spillage: c_s.
    """

    theta: dict[str, float]
    scene: str
    action: Action
    spillage: float


@dataclass(frozen=True)
class RecordSet:
    """Weighed pours in one scene.

    Attributes:
        path: the CSV file, or the journal of the run that made them.
        lip_radius: what turned the file's lip_to_receiver_axis_mm into x_offset [m]; None if it has x_offset_mm.
        columns: columns that have another name in the file, {name that Decant knows: name in the file}.
    """

    scene: Scene
    pours: tuple[RecordedPour, ...]
    path: Annotated[Path, FREE]
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)

    @property
    def training_pours(self) -> int:
        """Pours that a θ can be simulated and compared on."""
        return sum(pour.split == "train" and pour.normalised_spillage is not None for pour in self.pours)


@dataclass(frozen=True)
class ExistingPours:
    """Pours weighed before the campaign, from which deployment learns as from its own.

    Attributes:
        pours: by the name of the scene they were made in; all inside the action space.
        path: the CSV file, or the journal of the run that made them.
        counts: whether they count against the budget of pours.
        left_out: why others of the file or run were not used, one text each.
        lip_radius, columns: as in `RecordSet`.
    """

    pours: dict[str, tuple[RecordedPour, ...]]
    path: Annotated[Path, FREE]
    counts: bool = False
    left_out: tuple[str, ...] = ()
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class NormalPrior:
    """A prior along one dimension of an action or of θ: normal, cut off at the ends of its range.

    Attributes:
        name: of the dimension or parameter.
        mean, deviation: of the normal before it is cut off, in SI.
    """

    name: str
    mean: float
    deviation: float


@dataclass(frozen=True)
class StagePlan:
    """What all plans for one strategy have in common.

    Attributes:
        settings: which strategy, and its own settings.
    """

    settings: StrategySettings

    @property
    def strategy(self) -> str:
        """Name of the strategy."""
        return self.settings.strategy

    def with_settings(self, **changes: Any) -> Self:
        """The plan with other settings of the same strategy."""
        return replace(self, settings=self.settings.model_copy(update=changes))


@dataclass(frozen=True)
class CalibrationPlan(StagePlan):
    """Which θ_s reproduces the weighed spills.

    Attributes:
        actions: space in which calibration pours are designed and the prior g draws.
        parameters: searched θ_s.
        fixed_parameters: θ_s values that are not searched.
        pour_count: pours to be made on the bench (0 with `records`).
        holdout: how many of them are kept for testing.
        records: weighed pours to calibrate on in place of new ones (split 'train' and 'test').
        transfer: weighed pours in another scene, scored only.
        random_baseline: how many random θ are scored for comparison.
        constraints: on actions, beside the bounds of their space.
        prior: dimensions along which g is not uniform.
        parameter_prior: searched parameters that were measured beforehand, each with its tolerance.
        further: scenes beside the first one, with other receivers, into which pours are made by turns.
        tested: scenes that the pours kept for testing are made in; none: in the same.
        design: how the pours are chosen.
        design_simulations: made to choose them, where they are chosen actively.
        known: simulations that were made before, filled in when the calibration begins.
    """

    settings: CalibrationSettings
    scene: Scene
    actions: Space
    parameters: Space
    fixed_parameters: dict[str, float]
    pour_count: int = 0
    holdout: int = 0
    records: RecordSet | None = None
    transfer: RecordSet | None = None
    random_baseline: int = 0
    constraints: tuple[Linear, ...] = ()
    prior: tuple[NormalPrior, ...] = ()
    parameter_prior: tuple[NormalPrior, ...] = ()
    further: tuple[Scene, ...] = ()
    tested: tuple[Scene, ...] = ()
    design: Design = "stratified"
    design_simulations: int = 0
    known: tuple[KnownSimulation, ...] = ()

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes that calibration learns in."""
        return (self.scene, *self.further)

    @property
    def poured(self) -> tuple[Scene, ...]:
        """All scenes that calibration pours are made in, those that only score it too."""
        return (*self.scenes, *self.tested)

    @property
    def simulations(self) -> int:
        """Single simulated pours that the strategy may spend; of pours still to be made some may be lost."""
        records = self.records
        return self.settings.simulations_on(
            self.pour_count - self.holdout if records is None else records.training_pours
        )


@dataclass(frozen=True)
class DeploymentPlan(StagePlan):
    """How to pour into vessels that calibration never saw.

    Attributes:
        scenes: one per receiver.
        actions: searched action space.
        data: pours of before the campaign.
        objectives: what is minimised in place of the loss.
        constraints: on actions, beside the bounds of their space.
        confirm: how often the recommended action is poured again in each scene, after the strategy has ended.
        thetas: draws of a posterior, equally likely, for settings that need them, where no calibration of the same
            campaign makes them.
        bench: how the bench may differ from the simulator, equally likely, as far as anything is known of it.
        left_over: shift that a calibration left (`sim_engine.prediction_band`), likewise; None where nobody knows.
    """

    settings: DeploymentSettings
    scenes: tuple[Scene, ...]
    actions: Space
    loss: Loss
    data: ExistingPours | None = None
    objectives: Objectives | None = None
    constraints: tuple[Linear, ...] = ()
    confirm: int = 0
    thetas: tuple[SimulationParameters, ...] = ()
    bench: tuple[BenchOffset, ...] = ()
    left_over: float | None = None

    @property
    def pours(self) -> int:
        """Real pours per scene."""
        return self.settings.pours or 0

    def wanted(self, scene: Scene) -> float:
        """Volume that should arrive in a scene's receiver [m³]: the load, unless less is asked for."""
        share = 1.0 if self.objectives is None else self.objectives.wanted(scene)
        return share * scene.liquid.volume

    @property
    def loss_name(self) -> str:
        """What results call that which is minimised."""
        return self.loss.name if self.objectives is None else "objectives"


@dataclass(frozen=True)
class OutputPlan:
    """What is written beside the journal.

    Attributes:
        directory: in which each run gets a folder.
        rrd, figures: whether the recording, the figures are made.
        record_rate: frames of a recorded simulation per simulated second [1/s]; 0 records none.
        recorded_simulations: how many of a stage keep their frames.
    """

    directory: Path
    rrd: bool = True
    figures: bool = True
    record_rate: float = 10.0
    recorded_simulations: int = 6


@dataclass(frozen=True)
class CampaignPlan:
    """A whole campaign.

    Attributes:
        source: the YAML file.
        laboratory_source: the file that describes the laboratory; None where that is the campaign's own.
        parameters: θ_s in force where nothing is calibrated.
        parallel_simulations: logical slots of the simulation lane; part of the plan (not of the machine), so that the
            same seed asks for the same things anywhere.
        on_unknown: what happens on resume to a pour that had started and has no outcome.
        resolved: the YAML with everything filled in, JSON-ready, as kept with the run.
    """

    name: str
    seed: int
    source: Annotated[Path, FREE]
    laboratory: LaboratorySpec
    parameters: SimulationParameters
    calibration: CalibrationPlan | None
    deployment: DeploymentPlan | None
    outputs: Annotated[OutputPlan, FREE]
    parallel_simulations: int = 2
    on_unknown: Annotated[Literal["ask", "repeat"], FREE] = "ask"
    resolved: Annotated[dict[str, Any], FREE] = field(default_factory=dict)
    laboratory_source: Annotated[Path | None, FREE] = field(default=None, compare=False)


@dataclass(frozen=True)
class Draw:
    """One way in which a pour may go otherwise than planned.

    Attributes:
        error: of execution; None: as planned.
        z: standardised errors, those of `Disturbances.errors`.
    """

    error: PoseError | None
    parameters: SimulationParameters
    z: Point
