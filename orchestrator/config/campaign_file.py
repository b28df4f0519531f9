"""File sections of a campaign: keys, types, defaults and their descriptions.

`CampaignFile` is the whole file. Sections of calibration and deployment combine the common keys with the settings of
each installed strategy. The classes only describe the file; `orchestrator.config.campaign_resolution` converts them to
a plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import Field, create_model

from actors.laboratory_settings import LaboratorySettings
from orchestrator.config.search_ranges import Actions, Motion, Parameters
from orchestrator.config.vessel_file import VesselFile
from orchestrator.strategies.campaign_plan import (
    CalibrationSettings,
    DeploymentSettings,
    Design,
    OutputSettings,
    StrategySettings,
)
from orchestrator.strategies.strategy_registry import OBJECTIVES, STRATEGIES, calibrations, deployments
from sim_engine.liquids import LiquidSettings
from sim_engine.outcome import Loss
from sim_engine.settings.model import (
    MADE,
    FilePath,
    Name,
    PathOr,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    PourCount,
    Seed,
    Settings,
    SimulationCount,
    Switch,
    Text,
    tagged,
)
from sim_engine.settings.quantity import Quantity


class TransferSection(Settings):
    """Weighed pours in another scene, used only to evaluate the calibration."""

    required: ClassVar[dict[str, str]] = {"from": "transfer.csv", "receiver": "cone.yaml"}

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file."""

    receiver: PathOr[VesselFile] | None = None
    """Receiver of these pours."""

    motion: Motion | None = None
    """Values of the motion that differ from calibration's."""


class PoursSection(Settings):
    """Pours to calibrate on: to be made (`count`), or weighed already (`from`, `from_run`)."""

    count: PositivePourCount | None = None
    """Pours to make on the bench."""

    holdout: PourCount | None = None
    """Number of these pours that are kept for testing; an eighth unless given."""

    design: Design = "stratified"
    """stratified: spread evenly over the actions; active: each chosen by its information about the deployment."""

    simulations: PositiveSimulationCount | None = None
    """active: simulations to estimate that information; 64 unless given."""

    holdout_receivers: list[PathOr[VesselFile]] | None = None
    """Receivers for the test pours, used in turn: they measure how well calibration transfers to other vessels."""

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file of weighed pours; its column `split` marks the test pours."""

    from_run: FilePath | None = None
    """Folder of a previous run: its weighed pours in the same scene, with their splits."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, if the CSV has lip_to_receiver_axis_mm instead of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {Decant's name: name in the file}."""

    transfer: TransferSection | None = None
    """Weighed pours in another scene, used only for evaluation."""


class CalibrationSection(Settings):
    """Common keys of every calibration, which finds the simulation parameters that reproduce the weighed spillage."""

    required: ClassVar[dict[str, str]] = {"pours": "{count: 32, holdout: 4}"}

    pourer: PathOr[VesselFile] | None = None
    """Pourer; the campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """Receiver; the campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers, used in turn for calibration pours."""

    motion: Motion | None = None
    """Values that differ from the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    pours: PoursSection | None = None
    """Pours to calibrate on."""

    random_baseline: SimulationCount = 0
    """Number of random parameter sets that are evaluated for comparison."""

    @property
    def settings(self) -> CalibrationSettings:
        """The strategy's own settings."""
        return settings_in(self, CalibrationSettings)  # type: ignore[type-abstract]


class DataSection(Settings):
    """Pours from before the campaign that deployment uses as data: from a CSV file, or from a previous run."""

    source: FilePath | None = Field(default=None, alias="from")
    """CSV file of weighed pours, with the columns of calibration's `pours`; `split` may be left out."""

    run: FilePath | None = None
    """Folder of a previous run: its weighed pours in the same scenes, from any stage."""

    receiver: Text | None = None
    """Name of the receiver of the CSV file's pours, if there are several receivers."""

    counts: Switch = False
    """Whether these pours count against the budget."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, if the CSV has lip_to_receiver_axis_mm instead of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {Decant's name: name in the file}."""


AnyObjective: Any = tagged(OBJECTIVES.all)


class DeploymentSection(Settings):
    """Common keys of every deployment, which finds actions for vessels that calibration did not use."""

    pourer: PathOr[VesselFile] | None = None
    """Pourer; the campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """Receiver; the campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers, one after the other."""

    motion: Motion | None = None
    """Values that differ from the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    loss: Loss | None = None
    """Loss that is minimised."""

    objectives: list[AnyObjective] | None = None
    """Several objectives instead of a loss."""

    pareto: Switch | None = None
    """Search for all Pareto-optimal actions; the weights then choose one of them."""

    floor: Annotated[float, Quantity("1", "0.5", 0.01, 1.0)] | None = None
    """Minimum share of the load (of the target volume) that a pour must deliver to be better than none; 0.5 unless
    given."""

    confirm: PourCount = 0
    """Pours of the recommended action at the end, which measure its outcome and do not influence the choice."""

    @property
    def settings(self) -> DeploymentSettings:
        """The strategy's own settings."""
        return settings_in(self, DeploymentSettings)  # type: ignore[type-abstract]


class LearningSection(DeploymentSection):
    """A deployment that learns from real pours."""

    data: DataSection | None = None
    """Pours from before the campaign."""


T = TypeVar("T", bound=StrategySettings)


def settings_in(section: Settings, kind: type[T]) -> T:
    """The settings of a section's strategy, without the keys that all strategies have."""
    model = next(base for base in type(section).__mro__ if issubclass(base, kind) and base in STRATEGIES.all.values())
    values = {name: getattr(section, name) for name in model.model_fields}
    return model.model_construct(section.model_fields_set & model.model_fields.keys(), **values)


def _variants(settings: Mapping[str, type[StrategySettings]], base: type[Settings]) -> dict[str, type[Settings]]:
    """The sections of all strategies: their settings, with the common keys of their kind."""
    found: dict[str, type[Settings]] = {}
    for name, own in settings.items():
        learns = issubclass(own, DeploymentSettings) and own.learns_on_pours
        bases = (own, LearningSection if learns else base)
        found[name] = create_model(f"{name}Settings", __base__=bases, __doc__=own.__doc__, __cls_kwargs__=MADE)
        found[name].required = own.required | base.required
    return found


CALIBRATIONS = _variants(calibrations(), CalibrationSection)
DEPLOYMENTS = _variants(deployments(), DeploymentSection)
"""Sections of all installed strategies, by name."""

AnyCalibration: Any = tagged(CALIBRATIONS)
AnyDeployment: Any = tagged(DEPLOYMENTS)


class SimulatorSection(Settings):
    """The simulator."""

    parameters: Parameters | None = None
    """Parameters θ: a value fixes one, a range makes calibration search it; the others have their defaults."""


class CampaignFile(Settings):
    """A campaign: calibrate the simulator, deploy with the calibrated parameters, or both."""

    required: ClassVar[dict[str, str]] = {
        "name": "narrow-cup",
        "laboratory": "../laboratories/virtual.yaml",
        "liquid": "{name: water, mass: 200 g}",
    }

    name: Name | None = None
    """Its name in run directories and figures."""

    seed: Seed = 0
    """Seed of every random choice: same campaign, seed and outcomes → same requests."""

    laboratory: PathOr[LaboratorySettings] | None = None
    """Laboratory in which it runs."""

    liquid: PathOr[LiquidSettings] | None = None
    """Liquid that is poured."""

    pourer: PathOr[VesselFile] | None = None
    """The vessel that the robot holds."""

    receiver: PathOr[VesselFile] | None = None
    """The vessel on the table."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers for deployment, one after the other."""

    motion: Motion | None = None
    """Values of the motion that are not searched, for all sections."""

    actions: Actions | None = None
    """Searched dimensions, for sections without their own."""

    simulator: SimulatorSection = SimulatorSection()
    """The simulator."""

    calibration: AnyCalibration | None = None
    """Calibration: find the simulation parameters that reproduce the weighed spillage."""

    deployment: AnyDeployment | None = None
    """Deployment: find actions for vessels that calibration did not use."""

    on_unknown: Literal["ask", "repeat"] = "ask"
    """Treatment on resume of a pour that had started and has no outcome; 'repeat' on a virtual bench only."""

    parallel_simulations: Annotated[PositiveCount, Field(le=256)] = 2
    """Logical slots for parallel simulations, independent of the machine: the same seed gives the same requests on any
    machine."""

    outputs: OutputSettings = OutputSettings()
    """Outputs in addition to the journal."""
