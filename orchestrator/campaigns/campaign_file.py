"""File sections of a campaign: keys, types, defaults and their descriptions.

`CampaignFile` is the whole file. Sections of calibration and deployment combine the common keys with the settings of
each installed strategy. The classes only describe the file; `orchestrator.campaigns.campaign_resolution` converts them
to a plan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, create_model
from pydantic_core import PydanticCustomError

from actors.laboratory_settings import LaboratorySettings
from actors.places import PlaceName, UnattendedSettings
from orchestrator.campaigns.campaign_prior import AnyPrior
from orchestrator.campaigns.file_references import VesselFile
from orchestrator.campaigns.search_ranges import Actions, Motion, Parameters
from orchestrator.learning.calibration.campaign_memory import CampaignMemory
from orchestrator.learning.campaign_plan import (
    LEAST_TRAINING_POURS,
    CalibrationSettings,
    DeploymentSettings,
    Design,
    MissPolicy,
    OutputSettings,
    StrategySettings,
)
from orchestrator.learning.strategy_registry import OBJECTIVES, STRATEGIES, calibrations, deployments
from sim_engine.liquids import LiquidSettings, SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.scene import MIRRORED_FROM
from sim_engine.settings.model import (
    Example,
    FilePath,
    Name,
    PathOr,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    PourCount,
    Problems,
    Seed,
    Settings,
    SimulationCount,
    Switch,
    Text,
    tagged,
)
from sim_engine.settings.quantity import Quantity, QuantityError, parse_quantity, plain_number


class TableSource(Settings):
    """Weighed pours in a file."""

    source: FilePath | None = Field(default=None, alias="from")
    """Table of weighed pours (CSV or .xlsx). Columns of other names are kept as remarks."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, if the file has lip_to_receiver_axis_mm instead of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the file: {Decant's name: name in the file}."""

    def check_exclusive(self, problems: Problems, keys: Sequence[str], text: str) -> None:
        """Refuse keys that have a value."""
        for key in keys:
            if self.value(key) not in (None, {}):
                problems.add(text, key, key=True)


class TransferSettings(Settings):
    """Weighed pours in another scene, used only to evaluate the calibration."""

    source: Annotated[FilePath, Example("transfer.csv")] = Field(alias="from")
    """Table of weighed pours (CSV or .xlsx)."""

    receiver: Annotated[PathOr[VesselFile], Example("cone.yaml")]
    """Receiver of these pours."""

    motion: Motion | None = None
    """Values of the motion that differ from calibration's."""


class PoursSettings(TableSource):
    """Pours to calibrate on: to be made (`count`), or weighed already (`from`, `from_run`)."""

    count: PositivePourCount | None = None
    """Pours to make on the bench."""

    holdout: PourCount | None = None
    """Number of these pours that are kept for testing; an eighth unless given. A file with a column `split` has no
    use for it."""

    design: Design | None = None
    """stratified: spread evenly over the actions; active: each chosen by its information about the deployment. Unless
    given, stratified; active with a `prior` that knows something, so that the pours can contradict it."""

    simulations: PositiveSimulationCount | None = None
    """active: simulations to estimate that information; 64 unless given. If the parameters move the bench, eight more
    check each pour."""

    holdout_receivers: list[PathOr[VesselFile]] | None = None
    """Receivers for the test pours, used in turn: they measure how well calibration transfers to other vessels."""

    from_run: FilePath | None = None
    """Folder of a previous run: its weighed pours in the same scene, with their splits."""

    transfer: TransferSettings | None = None
    """Weighed pours in another scene, used only for evaluation."""

    def check_values(self, problems: Problems) -> None:
        """Check that the pours are from one source, and that some are left to fit."""
        if self.source is None:
            text = "belongs to pours that are read 'from' a CSV file"
            self.check_exclusive(problems, ("lip_radius", "transfer", "columns"), text)
        if not self.are_made:
            origin = "a file" if self.source is not None else "a run"
            text = f"belongs to pours that are still to be made; these are read 'from' {origin}"
            further = ["design"] if self.design == "active" else []
            further += ["holdout"] if self.source is None else []
            self.check_exclusive(problems, ("count", "holdout_receivers", *further, "simulations"), text)
            if self.source is not None and self.from_run is not None:
                problems.add("stands beside 'from'; keep one of them", "from_run", key=True)
            return
        if self.simulations is not None and self.design != "active":
            problems.add("belongs to 'design: active'; remove it, or add that", "simulations", key=True)
        if self.count is None and problems.valid("count", "from", "from_run"):
            text = "needs 'count' (pours to make on the bench), 'from' (a CSV file of weighed pours) or 'from_run'"
            problems.add(text, key=True)
        if self.count is not None and (left := max(0, self.count - self.held_out)) < LEAST_TRAINING_POURS:
            text = (
                f"keeps {self.held_out} of {self.count} pours for testing, so that {left or 'none'} is left to fit; a "
                f"calibration needs {LEAST_TRAINING_POURS}"
            )
            problems.add(text, "count" if self.holdout is None else "holdout")

    @property
    def are_made(self) -> bool:
        """Whether the pours are made on the bench; otherwise they are read."""
        return self.source is None and self.from_run is None

    @property
    def held_out(self) -> int:
        """Number of pours to be made that are kept for testing."""
        count = self.count or 0
        return max(1, count // 8) if self.holdout is None and count > 1 else self.holdout or 0

    def designed(self, memory: CampaignMemory | None) -> tuple[Design, int]:
        """How the pours are chosen, and the number of simulations that an active design spends on its choice."""
        told = memory is not None and bool(memory.parameters)
        if not self.count or (self.design or ("active" if told else "stratified")) == "stratified":
            return "stratified", 0
        return "active", self.simulations or 64


class StageSettings(Settings):
    """Keys of calibration and deployment that replace those of the campaign."""

    pourer: PathOr[VesselFile] | None = None
    """Pourer; the campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """Receiver; the campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers: calibration pours alternate between them, deployment treats one after the other."""

    motion: Motion | None = None
    """Values that differ from the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""


class CalibrationSection(StageSettings):
    """Common keys of every calibration, which finds the simulation parameters that reproduce the weighed spillage."""

    pours: Annotated[PoursSettings, Example("{count: 32, holdout: 4}")]
    """Pours to calibrate on."""

    random_baseline: SimulationCount = 0
    """Number of random parameter sets that are evaluated for comparison."""

    @property
    def settings(self) -> CalibrationSettings:
        """The strategy's own settings."""
        return settings_in(self, CalibrationSettings)  # type: ignore[type-abstract]


class DataSettings(TableSource):
    """Pours from before the campaign that deployment uses as data: from a file, or from a previous run."""

    source: FilePath | None = Field(default=None, alias="from")
    """Table of weighed pours (CSV or .xlsx), with the columns of calibration's `pours`; `split` may be left out."""

    run: FilePath | None = None
    """Folder of a previous run: its weighed pours in the same scenes, from any stage."""

    receiver: Text | None = None
    """Name of the receiver of the file's pours, if there are several receivers."""

    counts: Switch = False
    """Whether these pours count against the budget."""

    def check_values(self, problems: Problems) -> None:
        """Check that the pours are from one source."""
        if self.source is not None and self.run is not None:
            problems.add("stands beside 'from'; keep one of them", "run", key=True)
        elif self.run is not None:
            text = "belongs to a CSV file; a run knows it"
            self.check_exclusive(problems, ("receiver", "lip_radius", "columns"), text)
        elif self.source is None and problems.valid("from", "run"):
            text = "needs 'from' (a CSV file of weighed pours) or 'run' (the folder of a former run)"
            problems.add(text, key=True)


AnyObjective: Any = tagged(OBJECTIVES.all)


class DeploymentSection(StageSettings):
    """Common keys of every deployment, which finds actions for vessels that calibration did not use."""

    loss: Loss | None = None
    """Loss that is minimised."""

    objective: AnyObjective | None = None
    """Objective that is minimised instead of a loss."""

    confirm: PourCount = 0
    """Pours of the recommended action at the end, which measure its outcome and do not influence the choice."""

    def check_values(self, problems: Problems) -> None:
        """Check that the objective replaces the loss."""
        super().check_values(problems)
        if self.objective is not None and self.loss is not None:
            problems.add("is given as well as 'objective'; keep one of them", "loss", key=True)

    @property
    def settings(self) -> DeploymentSettings:
        """The strategy's own settings."""
        return settings_in(self, DeploymentSettings)  # type: ignore[type-abstract]


class LearningSettings(DeploymentSection):
    """A deployment that learns from real pours."""

    data: DataSettings | None = None
    """Pours from before the campaign."""


T = TypeVar("T", bound=StrategySettings)


def settings_in(section: Settings, kind: type[T]) -> T:
    """The settings of a section's strategy, without the keys that all strategies have."""
    model = next(base for base in type(section).__mro__ if issubclass(base, kind) and base in STRATEGIES.all.values())
    values = {name: getattr(section, name) for name in model.model_fields}
    return model.model_construct(section.model_fields_set & model.model_fields.keys(), **values)


def _variants(settings: Mapping[str, type[StrategySettings]], base: type[Settings]) -> dict[str, type[Settings]]:
    """The sections of all strategies: their settings, with the common keys of their kind."""
    variants: dict[str, type[Settings]] = {}
    for name, strategy in settings.items():
        learns = issubclass(strategy, DeploymentSettings) and strategy.learns_on_pours
        bases = (strategy, LearningSettings if learns else base)
        variants[name] = create_model(f"{name}Settings", __base__=bases, __doc__=strategy.__doc__)
        variants[name].required = strategy.required | base.required
    return variants


CALIBRATIONS = _variants(calibrations(), CalibrationSection)
DEPLOYMENTS = _variants(deployments(), DeploymentSection)
"""Sections of all installed strategies, by name."""

AnyCalibration: Any = tagged(CALIBRATIONS)
AnyDeployment: Any = tagged(DEPLOYMENTS)


DoseAmount = Annotated[float, Quantity("kg", "50 g", 0.0, 10.0, positive=True)]


class DoseSettings(Settings):
    """One wanted amount."""

    amount: Annotated[DoseAmount, Example("50 g")]
    """Wanted in the receiver."""

    position: Text | None = None
    """Name of the receiver's place; the operator puts this receiver on the balance."""

    tolerance: DoseAmount | None = None
    """Excess to avoid; the series' unless given."""

    receiver: PathOr[VesselFile] | None = None
    """Receiver; the campaign's unless given."""


class DoseSeriesSettings(Settings):
    """Keys of every series of doses: the tilt of each dose is decided from the balance while the liquid flows."""

    tolerance: DoseAmount = 1e-3
    """Excess to avoid: the cup turns back as soon as more has an estimated probability of 1 %."""

    refill_below: Annotated[float, Quantity("kg", "80 g", 0.0, 10.0)] = 0.0
    """A source that would hold less than this after a dose is filled before."""

    start: Literal["filled", "as_left"] = "filled"
    """Whether the sources are filled at the beginning, or hold what earlier runs in this laboratory have left."""

    motion: Motion | None = None
    """Values that differ from the campaign's `motion`."""


class DispenseSettings(DoseSeriesSettings):
    """A series of wanted amounts: the tilt of each dose is decided from the balance while the liquid flows."""

    doses: Annotated[list[DoseSettings], Example("[{amount: 50 g, position: A1}]")]
    """The amounts, with their receivers."""

    sources: list[PathOr[VesselFile]] | None = None
    """Source vessels, in the order of use, each with the campaign's liquid; the campaign's pourer unless given."""

    def check_values(self, problems: Problems) -> None:
        """Check that there are doses, and that each is larger than its tolerance."""
        if problems.valid("doses") and not self.doses:
            problems.add("is empty; name at least one, for example '- {amount: 50 g}'", "doses")
        for i, dose in enumerate(self.doses or ()):
            limit = self.tolerance if dose.tolerance is None else dose.tolerance
            if dose.amount is not None and limit is not None and dose.amount <= limit:
                problems.add("should be larger than the tolerance", "doses", i, "amount")
        if self.sources is not None and not self.sources:
            problems.add("is empty; name at least one vessel, or remove it", "sources")


def parse_amount(value: Any) -> tuple[float, Literal["kg", "m^3", "1"]]:
    """Magnitude and SI unit of an amount in a mixture: a mass, a volume, or a percentage.

    Raises:
        QuantityError: it is none of them, is negative, or has no unit.
    """
    text = str(value).strip()
    if isinstance(value, int | float) or plain_number(text):
        raise QuantityError(f"{text} has no unit; write '{text} g', '{text} mL' or '{text} %'")
    if text.endswith("%"):
        amount = parse_quantity(text, "1", "25 %"), "1"
    else:
        try:
            amount = parse_quantity(text, "m^3", "15 mL"), "m^3"
        except QuantityError:
            amount = parse_quantity(text, "kg", "15 g"), "kg"
    if amount[0] < 0.0:
        raise QuantityError(f"{text} is negative")
    return amount  # type: ignore[return-value]


def _amount_text(value: Any) -> str:
    try:
        parse_amount(value)
    except QuantityError as error:
        raise PydanticCustomError("amount", "{text}", {"text": str(error)}) from None
    return str(value)


MixedAmount = Annotated[str, BeforeValidator(_amount_text), WithJsonSchema({"type": "string", "examples": ["15 g"]})]


class MixedLiquidSettings(Settings):
    """A liquid of mixtures, and the vessels that it is poured from."""

    name: Annotated[Name, Example("water")]
    """Its name in the table of amounts and in the account of vessels."""

    liquid: Annotated[PathOr[LiquidSettings], Example("{name: water, mass: 350 g}")]
    """The liquid, with the content of a full source."""

    source: PathOr[VesselFile] | None = None
    """Source vessel; the campaign's pourer unless given."""

    stands: list[PlaceName] | None = None
    """Names of the sources with this liquid, in the order of use, such as 'source/water'; 'source/' and the name of the
    liquid unless given."""

    tolerance: DoseAmount | None = None
    """Tolerance of its doses; that of all mixtures unless given."""

    batch: Text | None = None
    """Its batch or lot, for the table of results, such as 'L-2026-117'."""


class CupsSettings(Settings):
    """The cups that mixtures are poured into."""

    vessel: PathOr[VesselFile] | None = None
    """Their vessel; the campaign's receiver unless given."""

    rack: Name = "rack"
    """Name of their rack: cup A1 stands at 'rack/A1'."""

    spares: list[Text] | None = None
    """Empty cups into which mixtures are poured again, such as [D5, D6]; for `on_miss: repeat` or `ask`."""

    proposals: list[Text] | None = None
    """Empty cups for further mixtures, such as [B1, B2], which an optimiser proposes when the others are poured: no
    amount smaller than the smallest one of the table, and no mixture heavier than its heaviest one."""


class MixturesSettings(DoseSeriesSettings):
    """Mixtures: several liquids in each cup. All doses of a cup follow each other, the smallest amount first."""

    liquids: Annotated[list[MixedLiquidSettings], Example("[{name: water, liquid: {name: water, mass: 350 g}}]")]
    """The liquids, with their sources."""

    cups: CupsSettings = CupsSettings()
    """The cups."""

    wanted: dict[Text, dict[Text, MixedAmount]] | None = None
    """Wanted amounts by cup and liquid, each with its unit: a mass, a volume, or a percentage of `total` by mass; for
    example 'A1: {water: 40 g, oil: 5 mL}'. Or give `from`."""

    source: FilePath | None = Field(default=None, alias="from")
    """Table of the wanted amounts (CSV or .xlsx): a column `cup`, and one for each liquid with its unit, such as
    'water_g', 'water [mL]' or 'water [%]'; an empty cell is none of it. Or give `wanted`."""

    total: DoseAmount | None = None
    """Mass of each mixture, if amounts are percentages of it."""

    on_miss: MissPolicy = "accept"
    """What follows a dose beyond its tolerance. accept: the amounts that the cup still lacks are corrected so that the
    ratios hold, if there is room; repeat: the mixture is poured again, into a spare cup, or without spares up to twice
    into the same one, which is emptied at the waste place or by the operator; ask: the operator decides."""

    order: list[Text] | None = None
    """Order of the liquids in every cup; the smallest amount first unless given."""

    max_open: Annotated[float, Quantity("s", "30 min", 0.0, 86400.0, positive=True)] | None = None
    """Longest expected time from the first dose into a cup until its last one."""

    def check_values(self, problems: Problems) -> None:
        """Check that the table is given once, and that there are spare cups if mixtures are poured again."""
        if self.wanted is not None and self.source is not None:
            problems.add("stands beside 'from'; keep one of them", "wanted", key=True)
        elif self.wanted is None and self.source is None and problems.valid("wanted", "from"):
            problems.add("needs 'wanted' (amounts by cup and liquid), or 'from' (a table of them)", key=True)
        for key in ("wanted", "liquids"):
            if problems.valid(key) and self.value(key) is not None and not self.value(key):
                problems.add("is empty; name at least one", key)
        names = [liquid.name for liquid in self.liquids or ()]
        for i, name in enumerate(names):
            if name in names[:i] and problems.within("liquids", i).valid("name"):
                problems.add(f"another liquid is called '{name}'; each needs a name of its own", "liquids", i, "name")
        for i, name in enumerate(self.order or ()):
            if name not in names and problems.valid("liquids"):
                problems.add(f"'{name}' is no liquid of the mixtures: {', '.join(names)}", "order", i)
            elif name in (self.order or [])[:i]:
                problems.add(f"'{name}' stands twice", "order", i)
        if self.order is not None and problems.valid("order", "liquids") and len(self.order) < len(names):
            missing = ", ".join(name for name in names if name not in self.order)
            problems.add(f"lacks {missing}; name every liquid, or remove it", "order")
        if self.on_miss == "accept" and self.cups.spares:
            problems.add("belongs to 'on_miss: repeat' or 'on_miss: ask'", "cups", "spares", key=True)


class SimulatorSettings(Settings):
    """The simulator."""

    parameters: Parameters | None = None
    """Parameters θ: a value fixes one, a range makes calibration search it; the others have their defaults."""

    symmetry: Literal["auto", "off"] = "auto"
    """auto: one half is simulated of a pour that is its own mirror image, from 2000 particles on; its mean spillage
    differed by up to 0.8 points from that of whole pours. off: always all."""

    @property
    def mirrors(self) -> bool:
        """Whether pours may be mirrored: every θ has enough particles, and no sideways displacement is searched."""
        theta = Parameters() if self.parameters is None else self.parameters
        searched, values = theta.searched(), SimulationParameters().model_dump() | theta.fixed()
        fewest = searched["particles"].lower if "particles" in searched else values["particles"]
        return self.symmetry == "auto" and fewest >= MIRRORED_FROM and "receiver_y" not in searched


class CampaignFile(Settings):
    """A campaign: calibrate the simulator, deploy with the calibrated parameters, pour wanted amounts, or several."""

    model_config = ConfigDict(json_schema_extra={"anyOf": [{"required": ["liquid"]}, {"required": ["mixtures"]}]})

    name: Annotated[Name, Example("narrow-cup")]
    """Its name in run directories and figures."""

    seed: Seed = 0
    """Seed of every random choice: same campaign, seed and outcomes → same requests."""

    laboratory: Annotated[PathOr[LaboratorySettings], Example("../laboratories/virtual.yaml")]
    """Laboratory in which it runs."""

    liquid: Annotated[PathOr[LiquidSettings] | None, Example("{name: water, mass: 200 g}")] = None
    """Liquid that is poured; required unless the campaign has only `mixtures`, which name their own."""

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

    simulator: SimulatorSettings = SimulatorSettings()
    """The simulator."""

    calibration: AnyCalibration | None = None
    """Calibration: find the simulation parameters that reproduce the weighed spillage."""

    deployment: AnyDeployment | None = None
    """Deployment: find actions for vessels that calibration did not use."""

    dispense: DispenseSettings | None = None
    """A series of wanted amounts."""

    mixtures: MixturesSettings | None = None
    """Mixtures of several liquids, in cups."""

    pour: Switch | None = None
    """A single pour with the values of `motion`."""

    prior: AnyPrior | None = None
    """Prior of the parameters from earlier campaigns: 'catalogue' for all that fit, or a list of runs and files of
    posteriors. A run's record has the resolved one."""

    on_unknown: Literal["ask", "repeat"] = "ask"
    """A pour that had started and has no outcome: 'ask' on resume; 'repeat' it, on a virtual bench only."""

    unattended: UnattendedSettings | None = None
    """Pours without a person, after one consent; needs a laboratory with places and a safeguard."""

    parallel_simulations: Annotated[PositiveCount, Field(le=256)] = 2
    """Logical slots for parallel simulations, independent of the machine: the same seed gives the same requests on any
    machine."""

    outputs: OutputSettings = OutputSettings()
    """Outputs in addition to the journal."""

    def check_values(self, problems: Problems) -> None:
        """Check that there is something to do, and that calibration searches the ranges of parameters."""
        calibration, sections = self.calibration, ("calibration", "deployment", "dispense", "mixtures", "pour")
        if problems.valid(*sections) and not any(self.value(section) for section in sections):
            problems.add("there is nothing to do; add a 'calibration', 'deployment', 'dispense' or 'mixtures' section")
        if self.mixtures is not None and self.dispense is not None:
            problems.add("can't be combined with 'dispense'; give each a campaign of its own", "mixtures", key=True)
        others = self.dispense is not None or calibration is not None or self.deployment is not None or self.pour
        alone = self.mixtures is not None and not others
        if self.liquid is None and not alone and problems.valid("liquid"):
            problems.add("key 'liquid' is missing; add for example 'liquid: {name: water, mass: 200 g}'", key=True)
        elif self.liquid is not None and alone:
            problems.add("has no effect: each liquid of 'mixtures' is described there; remove it", "liquid", key=True)
        ranges = {} if self.simulator.parameters is None else self.simulator.parameters.ranges()
        at = ("simulator", "parameters")
        inner = problems.within(*at)
        if calibration is None and problems.valid("calibration"):
            for name in ranges:
                if inner.valid(name):
                    text = "is a range, and nothing searches it; write one value, or add a 'calibration' section"
                    inner.add(text, name)
        if calibration is None:
            return
        if not ranges and problems.within("simulator").valid("parameters"):
            text = (
                "has nothing to search; give a range to at least one of simulator.parameters, for example "
                "'cohesion: [0 N/m, 0.1 N/m]'"
            )
            problems.within("calibration").add(text, key=True)
        if not calibration.settings.has_prior:
            text = f"belongs to {owners_of_priors()}; {calibration.strategy} takes all values for alike. Write a range"
            for name, section in ranges.items():
                if section.measured is not None:
                    inner.add(text, name, "measured", key=True)


def owners_of_priors() -> str:
    """Names of the calibrations that average over a prior."""
    return " and ".join(name for name, settings in calibrations().items() if settings.has_prior)
