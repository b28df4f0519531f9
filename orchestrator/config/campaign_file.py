"""Campaigns as written in files: the sections, their keys and what they mean. `resolve` makes plans of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field, create_model

from orchestrator.config.action_ranges import Actions as ActionsModel
from orchestrator.config.action_ranges import Motion as MotionModel
from orchestrator.config.laboratory_file import LaboratoryFile
from orchestrator.config.parameter_ranges import Parameters as ParametersModel
from orchestrator.config.vessel_file import LiquidFile, VesselFile
from orchestrator.strategies.campaign_plan import CalibrationSettings, DeploymentSettings, Design, StrategySettings
from orchestrator.strategies.strategy_registry import OBJECTIVES, STRATEGIES, calibrations, deployments
from sim_engine.outcome import LossName
from sim_engine.settings.model import (
    MADE,
    FilePath,
    Name,
    PathOr,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    PourCount,
    Section,
    Seed,
    SimulationCount,
    Switch,
    Text,
    tagged,
)
from sim_engine.settings.quantity import Quantity

# Built at import from the declarations in sim_engine; a type checker sees them as Any.
Actions: Any = ActionsModel
Motion: Any = MotionModel
Parameters: Any = ParametersModel


class TransferSection(Section):
    """Weighed pours in another scene, for scoring what was calibrated; never fitted."""

    required: ClassVar[dict[str, str]] = {"from": "transfer.csv", "receiver": "cone.yaml"}

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file."""

    receiver: PathOr[VesselFile] | None = None
    """Its receiver."""

    motion: Motion | None = None
    """What its motion has otherwise than calibration's."""


class PoursSection(Section):
    """Pours to calibrate on: to be made (`count`), or weighed already (`from`, `from_run`)."""

    count: PositivePourCount | None = None
    """Pours to make on the bench."""

    holdout: PourCount | None = None
    """How many of them are kept for testing; an eighth unless given."""

    design: Design = "stratified"
    """stratified: spread evenly over the actions; active: each by what it will tell about what is to be deployed."""

    simulations: PositiveSimulationCount | None = None
    """active: simulations to learn from what pours would tell; 64 unless given."""

    holdout_receivers: list[PathOr[VesselFile]] | None = None
    """Receivers that those kept for testing go into, by turns: how well calibration carries over to other vessels."""

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file of weighed pours; its column `split` says which are kept for testing."""

    from_run: FilePath | None = None
    """Folder of a former run: its weighed pours in the same scene, with the splits that they had there."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, where the CSV has lip_to_receiver_axis_mm in place of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {name that Decant knows: name in the file}."""

    transfer: TransferSection | None = None
    """Weighed pours in another scene, scored only."""


class CalibrationSection(Section):
    """Which parameters of the simulator reproduce the weighed spills: what every calibration has."""

    required: ClassVar[dict[str, str]] = {"pours": "{count: 32, holdout: 4}"}

    pourer: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers, into which calibration pours are made by turns."""

    motion: Motion | None = None
    """What has other values than in the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    pours: PoursSection | None = None
    """Pours to calibrate on."""

    random_baseline: SimulationCount = 0
    """Random parameters that are scored for comparison."""

    @property
    def settings(self) -> CalibrationSettings:
        """What belongs to the strategy."""
        return settings_in(self, CalibrationSettings)  # type: ignore[type-abstract]


class DataSection(Section):
    """Pours of before the campaign that deployment learns from: in a CSV file, or made by a former run."""

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file of weighed pours, with the columns of calibration's `pours`; `split` may be left out."""

    run: FilePath | None = None
    """Folder of a former run: its weighed pours in the same scenes, whatever they were made for."""

    receiver: Text | None = None
    """Name of the receiver that the CSV file is about, where there are several."""

    counts: Switch = False
    """Whether these pours count against the budget."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, where the CSV has lip_to_receiver_axis_mm in place of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {name that Decant knows: name in the file}."""


class LossSection(Section):
    """What deployment minimises."""

    name: LossName = "spilled_and_retained"
    """(spilled + w·retained) / loaded; or the paper's: normalised, grams, particles."""

    retained_weight: Annotated[float, Quantity("1", "1.0", 0.0, 100.0)] | None = None
    """w; 1 unless given."""


AnyObjective: Any = tagged(OBJECTIVES.all)


class DeploymentSection(Section):
    """How to pour into vessels that calibration never saw: what every deployment has."""

    pourer: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers, one after the other."""

    motion: Motion | None = None
    """What has other values than in the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    loss: LossSection | None = None
    """What is minimised."""

    objectives: list[AnyObjective] | None = None
    """Several things wanted at once, in place of a loss."""

    pareto: Switch | None = None
    """Look for all compromises between the objectives that nothing beats; the weights then choose one of them."""

    floor: Annotated[float, Quantity("1", "0.5", 0.01, 1.0)] | None = None
    """Share of the load (of the target volume) that a pour must deliver to be better than none; 0.5 unless given."""

    confirm: PourCount = 0
    """Pours of the recommended action at the end, which take no part in choosing it: what to expect of it."""

    @property
    def settings(self) -> DeploymentSettings:
        """What belongs to the strategy."""
        return settings_in(self, DeploymentSettings)  # type: ignore[type-abstract]


class LearningSection(DeploymentSection):
    """A deployment that learns on real pours."""

    data: DataSection | None = None
    """Pours of before the campaign."""


T = TypeVar("T", bound=StrategySettings)


def settings_in(section: Section, kind: type[T]) -> T:
    """The settings of the strategy that a section is about, without the keys that all strategies have."""
    model = next(base for base in type(section).__mro__ if issubclass(base, kind) and base in STRATEGIES.all.values())
    values = {name: getattr(section, name) for name in model.model_fields}
    return model.model_construct(section.model_fields_set & model.model_fields.keys(), **values)


def _variants(settings: Mapping[str, type[StrategySettings]], base: type[Section]) -> dict[str, type[Section]]:
    """The sections of all strategies: their settings, and the keys that all of a kind have."""
    found: dict[str, type[Section]] = {}
    for name, own in settings.items():
        learns = issubclass(own, DeploymentSettings) and own.learns_on_pours
        bases = (own, LearningSection if learns else base)
        found[name] = create_model(f"{name}Section", __base__=bases, __doc__=own.__doc__, __cls_kwargs__=MADE)
        found[name].required = own.required | base.required
    return found


CALIBRATIONS = _variants(calibrations(), CalibrationSection)
DEPLOYMENTS = _variants(deployments(), DeploymentSection)
"""Sections of all strategies that are installed, by name."""

AnyCalibration: Any = tagged(CALIBRATIONS, default="C4")
AnyDeployment: Any = tagged(DEPLOYMENTS)


class SimulatorSection(Section):
    """The simulator."""

    parameters: Parameters | None = None
    """Parameters θ: a value fixes one, a range has it searched by calibration; the others have their defaults."""


class OutputsSection(Section):
    """What is written beside the journal."""

    directory: FilePath | None = None
    """Where runs go; 'runs' in the working directory unless given."""

    rrd: Switch = True
    """Write a recording for the viewer."""

    figures: Switch = True
    """Write figures at the end."""

    record_rate: Annotated[float, Quantity("1/s", "10 1/s", 0.0, 10.0)] = 10.0
    """Frames of particles per simulated second."""

    recorded_simulations: SimulationCount = 6
    """How many simulations are recorded with their particles."""


class CampaignFile(Section):
    """A campaign: calibrate the simulator, deploy what was learnt, or both."""

    required: ClassVar[dict[str, str]] = {
        "name": "narrow-cup",
        "laboratory": "../laboratories/virtual.yaml",
        "liquid": "{name: water, mass: 200 g}",
    }

    name: Name | None = None
    """Its name in run directories and figures."""

    seed: Seed = 0
    """Seed of every random choice: same campaign, seed and outcomes → same requests."""

    laboratory: PathOr[LaboratoryFile] | None = None
    """Where it runs."""

    liquid: PathOr[LiquidFile] | None = None
    """What is poured."""

    pourer: PathOr[VesselFile] | None = None
    """The vessel in the robot's hand."""

    receiver: PathOr[VesselFile] | None = None
    """The vessel on the table."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers for deployment, one after the other."""

    motion: Motion | None = None
    """Values of the motion that are not searched, for all sections."""

    actions: Actions | None = None
    """Searched dimensions, for sections that name none of their own."""

    simulator: SimulatorSection = SimulatorSection()
    """The simulator."""

    calibration: AnyCalibration | None = None
    """Which parameters of the simulator reproduce the weighed spills."""

    deployment: AnyDeployment | None = None
    """How to pour into vessels that calibration never saw."""

    on_unknown: Literal["ask", "repeat"] = "ask"
    """What happens on resume to a pour that had started and has no outcome; 'repeat' on a virtual bench only."""

    parallel_simulations: Annotated[PositiveCount, Field(le=256)] = 2
    """Logical slots of the simulation lane, whatever the machine: the same seed asks for the same things anywhere."""

    outputs: OutputsSection = OutputsSection()
    """What is written beside the journal."""
