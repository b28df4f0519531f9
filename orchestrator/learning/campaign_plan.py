"""Plans and strategy settings: a resolved campaign as plain values.

- `CampaignPlan`, `CalibrationPlan` and `DeploymentPlan` hold the scenes, spaces, budgets and seeds that the YAML file
  defines.
- `StrategySettings` is the base of the settings of all strategies. Its two subclasses, `CalibrationSettings` and
  `DeploymentSettings`, check the settings and build the strategy.
- `RecordedPour`, `MeasuredPour`, `RecordSet` and `ExistingPours` hold weighed pours.

A settings class is defined in the module of its strategy. It is registered as an entry point of the group
`decant.strategies` under the value of its field `strategy`. The YAML keys with their errors, the JSON schema, the
tables of the documentation, the run's record and its fingerprint are derived from this class.

This module does not read files and runs no strategy.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import WRITTEN_IF_SET, BenchOffset, Linear, SceneEvidence
from orchestrator.learning.calibration.campaign_memory import CampaignMemory
from orchestrator.learning.deployment.objectives import Objective
from orchestrator.learning.strategy import plural
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import MINIMUM_POURED, Loss
from sim_engine.prediction_band import CalibrationResidual
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import (
    NOT_IN_FINGERPRINT,
    FilePath,
    PourCount,
    Problems,
    Settings,
    Switch,
)

LEAST_TRAINING_POURS = 2
"""Least number of training pours with enough poured that a calibration can use."""

if TYPE_CHECKING:
    from collections.abc import Sequence

    from orchestrator.learning.strategy import Strategy


class StrategySettings(Settings):
    """Settings that all strategies have in common."""

    tag: ClassVar[str] = "strategy"
    plugins: ClassVar[str] = "decant.strategies"

    strategy: str = ""
    """Name of the strategy: a literal in each class, equal to the name of its entry point."""

    @classmethod
    def like(cls, other: StrategySettings, without: Sequence[str] = (), **changes: Any) -> Self:
        """Build settings from those of another strategy: shared fields are copied, the others keep their defaults.

        Args:
            without: names of fields that keep their defaults.
            changes: values of further fields.
        """
        shared = cls.model_fields.keys() & type(other).model_fields.keys() - {"strategy", *without}
        return cls().model_copy(update={name: getattr(other, name) for name in shared} | changes)


class CalibrationSettings(StrategySettings):
    """Settings of a calibration, which fits θ to the weighed spills."""

    default_tag: ClassVar[str] = "C4"

    has_prior: ClassVar[bool] = False
    """Whether the strategy averages over a prior of actions, so that `actions` may define one."""

    def settled(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Fill in all numbers. Problems are added to `complaints`, and the result is then None.

        Args:
            searched: names of the searched θ.
            train: number of training pours on which a θ can be simulated; 0 if another problem leaves it unknown.
        """
        return self

    @property
    def makes_posterior(self) -> bool:
        """Whether the result has draws of θ given the pours."""
        return False

    @abstractmethod
    def simulations_on(self, train: int) -> int:
        """Number of single simulated pours that the strategy may spend on `train` training pours."""

    @abstractmethod
    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """Build the strategy."""


class DeploymentSettings(StrategySettings):
    """Settings of a deployment, which pours into vessels that calibration has not used."""

    learns_on_pours: ClassVar[bool] = True
    """Whether the strategy learns from real pours, including existing ones. If not, `pours: 0` makes it plan only."""

    simulates: ClassVar[bool] = True
    """Whether the strategy depends on θ."""

    pours: PourCount | None = None
    """Real pours per receiver."""

    def check(self, complaints: Problems) -> None:
        """Add a problem for each combination of values that is invalid."""
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
    def learns_offsets(self) -> bool:
        """Whether the strategy uses estimates of the bench from calibration or from pours into another receiver."""
        return False

    @property
    def simulations(self) -> int:
        """Maximum number of simulations per receiver."""
        return 0

    @property
    def simulations_before(self) -> int:
        """Simulations before the first pour."""
        return self.simulations

    @property
    def simulations_beside(self) -> int:
        """Simulations that run during each pour."""
        return 0

    @property
    def spending(self) -> str:
        """The budget per receiver, as text."""
        return plural(self.pours or 0, "pour")

    @abstractmethod
    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""


Design = Literal["stratified", "active"]
"""How calibration pours are chosen: spread evenly, or each by its expected information about deployment."""


@dataclass(frozen=True)
class RecordedPour:
    """A weighed pour read from a file.

    Attributes:
        poured, spilled, retained: masses [kg].
        split: 'train', 'test' or 'transfer'.
        scene: name of the scene of this pour; '' for the scene of its `RecordSet`.
        line: line of the file; None for a pour of a run.
        remarks: other columns of the file, {name: text}.
    """

    action: Action
    poured: float
    spilled: float
    retained: float
    split: str
    scene: str = ""
    line: Annotated[int | None, NOT_IN_FINGERPRINT] = None
    remarks: Annotated[dict[str, str], NOT_IN_FINGERPRINT] = field(default_factory=dict)

    @property
    def poured_fraction(self) -> float:
        """Poured mass divided by loaded mass."""
        return self.poured / (self.poured + self.retained)

    @property
    def spillage(self) -> float | None:
        """r = spilled / poured; None if too little was poured to define it."""
        return None if self.poured_fraction < MINIMUM_POURED else self.spilled / self.poured


@dataclass(frozen=True)
class MeasuredPour:
    """A weighed pour in the form that calibration and evaluation use.

    Attributes:
        spillage: r = spilled / poured; None below 5 % poured, where it is undefined.
        poured: fraction of the load that left the pourer.
        split: 'train', 'test' or 'transfer'.
        scene: name of the scene of this pour; '' for the first scene of its calibration.
        line, remarks: as in `RecordedPour`.
    """

    action: Action
    spillage: float | None
    poured: float
    split: str = "train"
    scene: str = ""
    line: int | None = None
    remarks: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_record(cls, record: RecordedPour) -> MeasuredPour:
        """Convert one row of a file of recorded pours."""
        return cls(
            record.action,
            record.spillage,
            record.poured_fraction,
            record.split,
            record.scene,
            record.line,
            record.remarks,
        )


@dataclass(frozen=True)
class KnownSimulation:
    """A simulation from before a calibration, in one of its scenes.

    Attributes:
        theta: values of the searched parameters.
        spillage: simulated spillage c_s.
    """

    theta: dict[str, float]
    scene: str
    action: Action
    spillage: float


@dataclass(frozen=True)
class RecordSet:
    """Weighed pours in one scene.

    Attributes:
        path: the CSV file, or the journal of the run that made the pours.
        lip_radius: radius used to convert the file's lip_to_receiver_axis_mm to x_offset [m]; None if the file has
            x_offset_mm.
        columns: renamed columns, {Decant's name: name in the file}.
        assumed: one sentence on how the file was read, if it is not in the plain form.
    """

    scene: Scene
    pours: tuple[RecordedPour, ...]
    path: Annotated[Path, NOT_IN_FINGERPRINT]
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)
    assumed: Annotated[str, NOT_IN_FINGERPRINT] = ""

    @property
    def training_pours(self) -> int:
        """Number of training pours on which a θ can be simulated and compared."""
        return sum(pour.split == "train" and pour.spillage is not None for pour in self.pours)


@dataclass(frozen=True)
class ExistingPours:
    """Pours weighed before the campaign. Deployment learns from them as from its own pours.

    Attributes:
        pours: pours by name of their scene; all lie inside the action space.
        path: the CSV file, or the journal of the run that made the pours.
        counts: whether the pours count against the pour budget.
        left_out: reasons why other pours of the file or run are not used, one text each.
        lip_radius, columns, assumed: as in `RecordSet`.
    """

    pours: dict[str, tuple[RecordedPour, ...]]
    path: Annotated[Path, NOT_IN_FINGERPRINT]
    counts: bool = False
    left_out: tuple[str, ...] = ()
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)
    assumed: Annotated[str, NOT_IN_FINGERPRINT] = ""


@dataclass(frozen=True)
class NormalPrior:
    """Prior along one dimension of an action or of θ: a normal distribution, truncated to the dimension's range.

    Attributes:
        name: name of the dimension or parameter.
        mean, deviation: moments of the normal distribution before truncation, in SI units.
    """

    name: str
    mean: float
    deviation: float


@dataclass(frozen=True)
class CalibrationEvidence:
    """What the weighed pours of calibrations show about the simulator, for a deployment in one scene.

    Attributes:
        pours: by scene of the calibrations; may be empty.
        lines: the used pours, and the reasons why others are not used, one text each.
    """

    pours: tuple[SceneEvidence, ...] = ()
    lines: tuple[str, ...] = ()

    def __add__(self, other: CalibrationEvidence) -> CalibrationEvidence:
        return CalibrationEvidence(self.pours + other.pours, self.lines + other.lines)


@dataclass(frozen=True)
class StagePlan:
    """Base of the plans for one strategy.

    Attributes:
        settings: the settings, which also name the strategy.
    """

    settings: StrategySettings

    @property
    def strategy(self) -> str:
        """Name of the strategy."""
        return self.settings.strategy

    def with_settings(self, **changes: Any) -> Self:
        """Copy the plan with changed settings of the same strategy."""
        return replace(self, settings=self.settings.model_copy(update=changes))


@dataclass(frozen=True)
class CalibrationPlan(StagePlan):
    """Plan of a calibration: find the θ_s that reproduces the weighed spills.

    Attributes:
        actions: space in which calibration pours are designed and from which the prior g draws.
        parameters: searched θ_s.
        fixed_parameters: values of the θ_s that are not searched.
        pour_count: pours to be made on the bench (0 with `records`).
        holdout: number of these pours that are kept for testing.
        records: existing weighed pours to calibrate on instead of new ones (split 'train' and 'test').
        transfer: weighed pours in another scene; they are scored only.
        random_baseline: number of random θ that are scored for comparison.
        constraints: constraints on actions in addition to the bounds of their space.
        prior: dimensions along which g is not uniform.
        parameter_prior: searched parameters that were measured before, each with its tolerance.
        further: scenes in addition to the first one, with other receivers; pours alternate between all of them.
        tested: scenes of the pours that are kept for testing; empty: the same scenes.
        design: how the pours are chosen.
        design_simulations: simulations spent on choosing the pours of an active design.
        known: existing simulations that are added when the calibration begins.
        memory: prior of searched parameters from earlier campaigns.
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
    memory: CampaignMemory | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """All scenes that calibration learns from."""
        return (self.scene, *self.further)

    @property
    def poured(self) -> tuple[Scene, ...]:
        """All scenes of calibration pours, including those that are used for scoring only."""
        return (*self.scenes, *self.tested)

    @property
    def uncalibrated(self) -> SimulationParameters:
        """θ that is used without a calibration: the fixed values, and those that were measured or learned before."""
        measured = {prior.name: prior.mean for prior in self.parameter_prior}
        means = {} if self.memory is None else self.memory.means
        for axis in self.parameters.axes:
            if axis.name in means:
                measured[axis.name] = min(max(means[axis.name], axis.lower), axis.upper)
        return SimulationParameters.from_values(self.fixed_parameters | measured)

    @property
    def simulations(self) -> int:
        """Number of single simulated pours that the strategy may spend. Pours that are still to be made may partly be
        lost."""
        records = self.records
        return self.settings.simulations_on(
            self.pour_count - self.holdout if records is None else records.training_pours
        )


@dataclass(frozen=True)
class DeploymentPlan(StagePlan):
    """Plan of a deployment: pour into vessels that calibration has not used.

    Attributes:
        scenes: one per receiver.
        actions: searched action space.
        data: pours from before the campaign.
        objective: minimised instead of the loss.
        constraints: constraints on actions in addition to the bounds of their space.
        confirm: number of repetitions of the recommended action in each scene after the strategy has ended.
        thetas: equally likely draws of a posterior, which simulations use in turn. They are given if no calibration of
            the same campaign provides them; without any, all simulations use θ*.
        bench: equally likely offsets of the bench from the simulator; empty if nothing is known about it.
        left_over: residual of a calibration, given in the same case as `thetas`; None if unknown. A strategy
            gets it for its scene.
        memory: what earlier campaigns tell, if no calibration of the same campaign uses it.
        evidence: pours of the preceding calibration and of earlier campaigns; None without any, and for strategies that
            do not learn offsets.
    """

    settings: DeploymentSettings
    scenes: tuple[Scene, ...]
    actions: Space
    loss: Loss
    data: ExistingPours | None = None
    objective: Objective | None = None
    constraints: tuple[Linear, ...] = ()
    confirm: int = 0
    thetas: tuple[SimulationParameters, ...] = ()
    bench: tuple[BenchOffset, ...] = ()
    left_over: CalibrationResidual | None = None
    memory: CampaignMemory | None = field(default=None, metadata=WRITTEN_IF_SET)
    evidence: CalibrationEvidence | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def pours(self) -> int:
        """Real pours per scene."""
        return self.settings.pours or 0

    def wanted(self, scene: Scene) -> float:
        """Volume that should arrive in a scene's receiver [m³]: the whole load unless the objective requests less."""
        share = 1.0 if self.objective is None else self.objective.wanted(scene)
        return share * scene.liquid.volume

    @property
    def loss_name(self) -> str:
        """Name of the minimised quantity in results."""
        return self.loss.name if self.objective is None else self.objective.name


@dataclass(frozen=True)
class PlannedDose:
    """One wanted amount.

    Attributes:
        amount, limit: see `actors.interfaces.DoseTarget` [kg].
        receiver: name of the receiver's vessel.
        position: name of the receiver's place; '' if there is only one.
        liquid: poured from the sources that hold it; None: from any source.
    """

    amount: float
    limit: float
    receiver: str
    position: str = ""
    liquid: str | None = field(default=None, metadata=WRITTEN_IF_SET)


MissPolicy = Literal["accept", "repeat", "ask"]
"""What follows a dose beyond its tolerance: the next components are corrected, the mixture is poured again, or the
operator decides."""


@dataclass(frozen=True)
class MixturePlan:
    """What makes a series of doses a series of mixtures: the doses of one cup follow each other.

    Attributes:
        cups: the doses of each cup by liquid, in the order of pouring; by the names of the cups' positions.
        on_miss: see `MissPolicy`.
        spares: positions of empty cups that replace one whose mixture is poured again.
        max_open: longest time from the first dose into a cup to its last one [s]; None: unlimited.
        batches: of the liquids, by name, if they are stated.
        proposals: positions of empty cups for mixtures that are proposed while the run goes on.
        order: of the liquids in every cup; None: the smallest amount first.
    """

    cups: dict[str, dict[str, PlannedDose]]
    on_miss: MissPolicy = "accept"
    spares: tuple[str, ...] = ()
    max_open: float | None = None
    batches: dict[str, str] = field(default_factory=dict, metadata=WRITTEN_IF_SET)
    proposals: tuple[str, ...] | None = field(default=None, metadata=WRITTEN_IF_SET)
    order: tuple[str, ...] | None = field(default=None, metadata=WRITTEN_IF_SET)


@dataclass(frozen=True)
class DispensePlan:
    """Plan of a series of doses.

    Attributes:
        scenes: one for each source and each receiver vessel; the source is the scene's pourer, its load the content
            of a full source.
        doses: in the order of pouring.
        refill_below: a source that would hold less after a dose is not used before it is filled again [kg].
        as_left: whether the series begins with what earlier runs left in the sources; otherwise they are filled.
        laboratory: part of the names under which the content of the vessels is tracked; '' in an ordered pour.
        vessels: sources, and the cup of an ordered pour, that are vessels of the station, with their ids.
        mixtures: cups of the doses; None: each dose has a receiver of its own.
    """

    scenes: tuple[Scene, ...]
    doses: tuple[PlannedDose, ...]
    refill_below: float
    as_left: bool
    laboratory: str
    vessels: Annotated[Mapping[str, str], NOT_IN_FINGERPRINT] = field(default_factory=dict)
    mixtures: MixturePlan | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources, in the order of use."""
        return tuple(dict.fromkeys(scene.pourer.name for scene in self.scenes))

    def sources_of(self, dose: PlannedDose) -> tuple[str, ...]:
        """Names of the sources that a dose may be poured from, in the order of use."""
        return tuple(name for name in self.sources if dose.liquid in (None, self.liquid(name)))

    def scene(self, source: str, receiver: str) -> Scene:
        """The scene of a source and a receiver."""
        return next(s for s in self.scenes if (s.pourer.name, s.receiver.name) == (source, receiver))

    @property
    def accounted(self) -> bool:
        """Whether its run enters the contents in the account of the vessels."""
        return bool(self.laboratory or self.vessels)

    def tracked(self, name: str) -> str:
        """Name of a source or cup in the account of the vessels: its id at the station, or laboratory and vessel."""
        return self.vessels.get(name) or f"{self.laboratory}/{name}"

    def liquid(self, source: str) -> str:
        """Name of a source's liquid."""
        return next(s.liquid.name for s in self.scenes if s.pourer.name == source)


class OutputSettings(Settings):
    """Outputs in addition to the journal."""

    directory: FilePath | None = None
    """Folder of the runs; 'runs' in the working directory unless given."""

    recording: Switch = True
    """Write a recording for the viewer, with the particles of some simulations of each stage."""

    figures: Switch = True
    """Write figures at the end."""

    pour_recordings: Switch = False
    """Write each weighed pour and dose as a recorded pour into the folder 'recordings' of the run."""

    @property
    def folder(self) -> Path:
        """Parent of the runs' folders; absolute in the plan of a campaign."""
        return Path(self.directory or "runs")


@dataclass(frozen=True)
class CampaignPlan:
    """A whole campaign.

    Attributes:
        source: the YAML file.
        laboratory_source: the file that describes the laboratory; None if the campaign's file does.
        parameters: θ_s that is used if nothing is calibrated.
        parallel_simulations: number of logical simulation slots. It belongs to the plan and not to the machine, so that
            a seed leads to the same requests on every machine.
        on_unknown: treatment, on resume, of a pour that had started and has no outcome.
        resolved: the YAML file with all defaults filled in, ready for JSON, as stored with the run.
        dispense: the series of doses; None without one.
        pour: scene of a single pour, whose motion is complete; None without one.
    """

    name: str
    seed: int
    source: Annotated[Path, NOT_IN_FINGERPRINT]
    laboratory: LaboratorySettings
    parameters: SimulationParameters
    calibration: CalibrationPlan | None
    deployment: DeploymentPlan | None
    outputs: Annotated[OutputSettings, NOT_IN_FINGERPRINT]
    parallel_simulations: int = 2
    on_unknown: Annotated[Literal["ask", "repeat"], NOT_IN_FINGERPRINT] = "ask"
    resolved: Annotated[dict[str, Any], NOT_IN_FINGERPRINT] = field(default_factory=dict)
    laboratory_source: Annotated[Path | None, NOT_IN_FINGERPRINT] = field(default=None, compare=False)
    dispense: DispensePlan | None = field(default=None, metadata=WRITTEN_IF_SET)
    pour: Scene | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def memory(self) -> CampaignMemory | None:
        """The prior from earlier campaigns, of the stage that uses it."""
        stages = (stage for stage in (self.calibration, self.deployment) if stage is not None)
        return next((stage.memory for stage in stages if stage.memory is not None), None)


def receiver_names(plan: CampaignPlan) -> dict[str, str]:
    """Names for displays, by scenes' own names, which are the keys in the journal and for programs: the receiver's
    name, or the scene's own if two deployment scenes have receivers with the same name.
    """
    names: dict[str, str] = {}
    if plan.deployment is not None:
        scenes = plan.deployment.scenes
        distinct = len({scene.receiver.name for scene in scenes}) == len(scenes)
        names = {scene.name: scene.receiver.name if distinct else scene.name for scene in scenes}
    if plan.calibration is not None:
        for pours in (plan.calibration.records, plan.calibration.transfer):
            if pours is not None:
                names.setdefault(pours.scene.name, pours.scene.receiver.name)
        for scene in plan.calibration.poured:
            names.setdefault(scene.name, scene.receiver.name)
    for scene in (*(() if plan.dispense is None else plan.dispense.scenes), *filter(None, [plan.pour])):
        names.setdefault(scene.name, scene.receiver.name)
    return names


def receiver_name(plan: CampaignPlan, scene: str) -> str:
    """Display name of a scene; its own name if the plan does not contain it."""
    return receiver_names(plan).get(scene, scene)
