"""The JSON output of commands with `--json`: one model for each command, as documentation and as schema.

`OUTPUTS` lists the models by command. The commands print plain dictionaries; tests validate them against the schema
(`decant schema output`). Quantities are in SI units unless a name has a unit: `spilled_g`, `capacity_mL`.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, create_model

from actors.arm.arm_interface import PathReport
from actors.interfaces import DeviceCheck
from orchestrator.campaigns.campaign_prior import KnownPosterior
from orchestrator.catalogue.run_reading import PreviousPour, PreviousRun, PreviousRunDetail, RunComparison
from orchestrator.daemon.schemas import CampaignDetailOut, CampaignOut, QuestionOut, StatusOut
from orchestrator.daemon.station_schemas import AccountOut, BatchOut, ContentOut, PourOut
from orchestrator.learning.dispense import Dose
from orchestrator.learning.single_action import WeighedPour
from orchestrator.reports.run_summary import PLANNED, ReceiverSummary, RunSummary
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics
from sim_engine.settings.model import DescribedSchema, meanings


class _Output(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True, arbitrary_types_allowed=True)


class CalibrateOutput(BaseModel):
    """Result of a calibration. Further keys are `test_discrepancy_NAME` and `transfer_discrepancy_NAME` of other θ."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)

    theta: SimulationParameters
    """θ to simulate with: θ*, or the uncalibrated θ if the weighed pours do not justify θ*."""

    calibrated_theta: SimulationParameters
    """θ*."""

    calibration_gain: dict[str, Any] | None
    """Whether the weighed pours justify θ*; null if θ* was not compared with the uncalibrated θ."""

    train_discrepancy: float | None
    """Mean |r − c_s| of θ* on the pours of the calibration."""

    test_discrepancy: float | None
    """The same on pours that were kept for testing."""

    transfer_discrepancy: float | None
    """The same on pours into another receiver."""

    simulations: int
    calibration_simulations: int
    """Simulations without those of the evaluation."""

    cpu_s: float
    run: str
    """Folder of the run."""

    figures: dict[str, Path]
    recording: Path | None
    report: Path | None


class _PlannedParts(_Output):
    receiver: str
    """Name of the receiver."""

    action: dict[str, Any]
    """The recommended action, in deg, deg/s, mm and s."""

    action_si: dict[str, float | None]
    predicted_loss: float | None
    predicted_deviation: float | None
    predicted_spillage: float | None
    """Mean spilled / poured of the simulations with further seeds."""

    predicted_spillage_deviation: float | None
    loss: str
    """Name of the loss that was minimised."""


def _part(model: type[BaseModel], names: Any) -> dict[str, Any]:
    """Fields of another model, for `create_model`."""
    found = {}
    for name in names:
        field = copy(model.model_fields[name])
        field.description = meanings(model)[name] or None
        found[name] = (field.annotation, field)
    return found


PlannedOutput = create_model(
    "PlannedOutput",
    __base__=_PlannedParts,
    __doc__="The planned action for one receiver.",
    **_part(ReceiverSummary, PLANNED),
)
PlanOutput = create_model(
    "PlanOutput",
    __base__=PlannedOutput,
    __doc__="The planned action for the first receiver, and for all of them if there are several.",
    theta=(SimulationParameters, Field(description="θ of the simulations.")),
    simulations=(int, ...),
    cpu_s=(float, ...),
    run=(str, Field(description="Folder of the run.")),
    plans=(list[PlannedOutput], Field(default=[], description="All receivers, if there are several.")),  # type: ignore[valid-type]
)
RunOutput = create_model(
    "RunOutput",
    __base__=_Output,
    __doc__="Summary of a run: `summary.json` without results, decisions and notes.",
    **_part(RunSummary, [name for name in RunSummary.model_fields if name not in ("results", "decisions", "notes")]),
    report=(Path | None, Field(description="The report, report.html.")),
)


class IntervalOutput(_Output):
    """Prediction interval of r = spilled / poured for a single pour."""

    low: float
    high: float
    level: float
    """Probability, such as 0.9."""

    deviations: dict[str, float | None]
    """Standard deviations by source: simulations, discrepancy, resolution."""


class PredictionOutput(BaseModel):
    """Prediction over seeds: `SampleStatistics` by quantity, such as received, spilled, retained and spillage."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)

    band: IntervalOutput | None
    seeds: list[int]
    __pydantic_extra__: dict[str, SampleStatistics]


class SimulateOutput(_Output):
    """A simulated pour. Fractions are of the load: received + spilled + retained + in_flight + escaped = 1."""

    received: float
    spilled: float
    retained: float
    in_flight: float
    """Fraction in the air at the end."""

    escaped: float
    """Fraction that left the simulated box."""

    dribbled: float
    """Fraction that ran down the outside of the pourer; part of received and spilled."""

    particles: int
    spacing_mm: float
    density_error: float
    simulated_time_s: float
    steps: int
    cpu_s: float
    seed: int
    curve: dict[str, list[float]]
    """Poured and spilled fractions over time: `time_s`, `poured`, `spilled`."""

    invalid: str | None
    """Why the outcome must not be used; null if it is valid."""

    action: dict[str, float | None]
    theta: SimulationParameters
    thetas: int
    """Number of posterior draws of θ."""

    scene: str
    delivered_g: float | None
    """Mean mass in the receiver."""

    delivered_ml: float | None
    prediction: PredictionOutput
    regimes: dict[str, Any] | None
    """Flow at the lip and in the stream: Reynolds, Weber and Bond numbers, thickness, velocity."""

    not_covered: list[dict[str, Any]]
    """Effects of this pour that are not simulated: `kind`, `share`, `text`."""


class ScoredPourOutput(_Output):
    """A weighed pour of the table with its prediction."""

    line: int
    """Line in the table."""

    split: str
    action: dict[str, float | None]
    measured: float | None
    """r = spilled / poured as weighed; null if it is undefined."""

    predicted: SampleStatistics | None
    band: IntervalOutput | None
    inside: bool | None
    """Whether the measured value is inside the interval."""


class ScoresOutput(_Output):
    """Agreement of predictions and weighed pours."""

    pours: int
    mean_error: float | None
    """Mean absolute difference of r."""

    spearman: float | None
    """Rank correlation."""

    held: int
    """Number of pours inside their interval."""

    share_held: float | None


class SimulateTableOutput(_Output):
    """Predictions for a table of weighed pours (`--from`)."""

    scene: str
    from_: Path = Field(alias="from")
    scores: dict[str, ScoresOutput]
    """By split, and for all."""

    level: float
    """Level of the intervals."""

    theta: SimulationParameters
    thetas: int
    simulations: int
    cpu_s: float
    bands: dict[str, float | None]
    """Standard deviations of the shifts in the intervals."""

    pours: list[ScoredPourOutput]


class DryRunOutput(_Output):
    """A planned pour (`--dry-run`)."""

    mode: str
    action: dict[str, float | None]
    report: PathReport
    phases: list[dict[str, Any]]
    """Phases of the tilt: `name`, `start` and `end` [s]."""

    at_home: bool | None
    """Whether the arm stands at home; null without `--connect`."""


class EmptyPourOutput(_Output):
    """A cycle with an empty pourer (`--empty`), as in pour.json."""

    run: str
    mode: str
    laboratory: str
    date: str
    robot: dict[str, str]
    action: dict[str, float | None]
    slow: float
    planned: PathReport
    tracking: dict[str, float]
    """Deviations of the executed motion from the planned one."""

    executed_s: float
    """Duration of the pour."""


class PourOutput(WeighedPour):
    """A weighed pour."""

    run: str
    mode: str
    action: dict[str, float | None]


class ReportOutput(_Output):
    """A written report."""

    report: Path
    figures: list[Path]


class CheckOutput(_Output):
    """Checks of a laboratory."""

    laboratory: str
    mode: str
    ready: bool
    """Whether no check fails."""

    checks: list[DeviceCheck]


class BalanceCheckOutput(_Output):
    """Checks of a balance."""

    balance: str
    """The balance as it was named on the command line."""

    ready: bool
    """Whether no check fails."""

    checks: list[DeviceCheck]


class RefusedLinesOutput(_Output):
    """A line that a dialect does not understand."""

    line: str
    """Its bytes, with escapes for those that are no text."""

    count: int
    reason: str


class ExplainedDialectOutput(_Output):
    """What one dialect reads in the lines of a balance."""

    dialect: str
    title: str
    understood: int
    """Lines that it understands."""

    weights: int
    """Lines that it reads as a weight."""

    reads: list[str]
    """The stable weights as read, without repetition."""

    marks: list[str]
    """Marks of the weights: net, gross."""

    states: dict[str, int]
    """A state without a weight (an overload), or a number that is no mass (`12 pcs`), and its lines."""

    others: dict[str, int]
    """Another quantity than the weight, such as a tare, and its lines."""

    refused: list[RefusedLinesOutput]


class BalanceExplainOutput(_Output):
    """The lines of a balance as the dialects read them."""

    file: Path
    lines: int
    recorded: dict[str, Any]
    """What the recording says of itself; empty for a plain file of lines."""

    notes: list[str]
    best: list[str]
    """Dialects that read most weights."""

    dialects: list[ExplainedDialectOutput]


class ArchiveOutput(_Output):
    """Replay of the recordings of a commissioning day."""

    archive: str
    ready: bool
    """Whether all recordings are read as on the day."""

    checks: list[DeviceCheck]


class ValidateSolverOutput(_Output):
    """Results of the solver's validation cases."""

    solver: str
    """Fingerprint of the solver's source."""

    full: bool
    cases: dict[str, dict[str, Any]]
    """By case: title, cpu_s, figure, and measurements with value, bounds and whether they passed."""


class VesselOutput(_Output):
    """A vessel file that was made."""

    file: Path
    picture: Path
    capacity_mL: float  # noqa: N815
    capacity_deviation_mL: float  # noqa: N815
    radius_deviation_mm: float | None
    notes: list[str]
    doubts: list[str]
    """Checks that failed."""


class PluginsOutput(_Output):
    """Plug-ins of installed packages."""

    plugins: list[dict[str, str]]
    """`group`, `name` and `package`."""

    broken: list[dict[str, str]]
    """Plug-ins that can't be used, with the reason."""


class StudyOutput(_Output):
    """A study that was run or reported."""

    study: str
    folder: Path
    page: Path
    cells: int
    finished: int | None
    """Number of finished cells; null for a report."""


class StudyCostOutput(_Output):
    """Unfinished work of a study (`--dry-run`)."""

    cells: list[str]
    left: int
    simulations: int
    pours: int
    cpu_hours: float


class RunsOutput(_Output):
    """Runs, newest first."""

    runs: list[PreviousRun]  # type: ignore[valid-type]


class PoursOutput(_Output):
    """Pours, oldest first."""

    pours: list[PreviousPour]  # type: ignore[valid-type]


class KnownOutput(_Output):
    """What calibrations have found, by run."""

    posteriors: list[KnownPosterior]


class RunCheckOutput(_Output):
    """Check of a run's records."""

    run: Path
    complete: bool
    """Whether the check found no problem."""

    problems: list[str]
    entries: int

    pours: list[str]


class ExportOutput(_Output):
    """Exported tables."""

    files: list[str]
    runs: int
    pours: int


class QueueOutput(_Output):
    """State of the daemon, its campaigns and open questions."""

    status: StatusOut
    campaigns: list[CampaignOut]
    questions: list[QuestionOut]


class EventOutput(BaseModel):
    """One event per line; further keys depend on `type`: see the reference of events."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)

    id: int
    type: str
    time: float
    """Seconds since 1970."""

    campaign: str | None = None


_DOSE = [name for name in Dose.model_fields if name != "signals"]


class DoseOutput(_Output):
    """Doses that were poured."""

    run: str
    """Folder of the run."""

    doses: list[create_model("DoseOut", __base__=_Output, __doc__="One dose.", **_part(Dose, _DOSE))]  # type: ignore[valid-type]
    """Completed doses, in the order made."""


class PredictedDoseOutput(_Output):
    """One dose, predicted."""

    number: int
    wanted_g: float
    position: str
    source: str
    filled: bool
    """Whether the source is filled before."""

    expected_g: float
    interval_g: tuple[float, float]
    """The expected amount lies in it with a probability of 90 %."""

    duration_s: float
    longest_s: float
    """Duration that 95 % of the doses do not exceed."""

    enough: float
    """Probability that the source holds the amount."""

    fine_flow_g_s: float
    """Flow at the end of the dose."""

    clean_flow_g_s: float
    """Smallest flow that leaves the lip cleanly; a slower one may run down the outside."""

    left_g: float
    """Expected content of the source after the dose."""

    reachable_tolerance_g: float
    """Half of the 90 % interval of the dose as weighed with this balance."""

    ends: dict[str, int]
    """Number of predicted doses by their end."""


class DosePredictionOutput(_Output):
    """Doses that were predicted (`--dry-run`)."""

    doses: list[PredictedDoseOutput]


class VesselContentOutput(ContentOut):
    """One vessel of `decant materials list`."""

    id: str
    """Id at the station, or LABORATORY/VESSEL for the source of a campaign."""

    position: str
    """Where it stands; '' if it is unknown."""


class VesselContentsOutput(_Output):
    """Vessels with their contents."""

    vessels: list[VesselContentOutput]


class VesselHistoryOutput(_Output):
    """Entries of a vessel's account, oldest first."""

    entries: list[AccountOut]


class RecordingExportOutput(_Output):
    """Result of the export of a run's pours."""

    recordings: list[Path]
    """Files of the recorded pours (YAML), each with a CSV file of the same name."""

    left_out: list[str]
    """Reasons why pours could not be exported."""


class RecordingReplayOutput(_Output):
    """The replay of a recorded pour. Masses are without the receiver."""

    recording: Path
    readings: int
    measured_g: float
    """Mass at the end."""

    onset: dict[str, float] | None
    """Time [s] and recorded tilt [deg] at which the readings have risen; null if nothing flowed."""

    arrivals: dict[str, float]
    """How readings arrived: interval, longest gap, step, and number of readings that repeat while the mass rises."""

    fitted: dict[str, Any]
    """Values that differ from the file's, and the recordings that they were fitted on."""

    simulation: dict[str, Any] | None
    """Particle simulation of the recorded tilt: mass at the end, RMS of the readings, onset; null without it."""

    estimator: dict[str, Any]
    """Estimator of doses over the readings: mass and lag with 90 % intervals, innovation, coverage."""

    warnings: list[str]


class RecordingReplaysOutput(_Output):
    """Replays of recorded pours."""

    replays: list[RecordingReplayOutput]


class RecordingFitOutput(_Output):
    """Quantities that were fitted to recorded pours, and predictions of readings that were not."""

    fitted: dict[str, dict[str, Any]]
    """Value, 90 % interval and unit of each quantity, and whether the readings identify it."""

    fitted_on: list[str]
    """Names of the recordings."""

    until_s: float | None
    """Readings after this time were not fitted."""

    rms_g: list[float]
    """RMS of the residuals of each recording."""

    held_readings: list[float] | None
    """Share of the readings that repeat the one before while the mass rises, with its 90 % interval."""

    judged: list[dict[str, Any]]
    """Predicted and measured mass, RMS and coverage of each judged recording."""


class FirstDayOutput(_Output):
    """What the recordings of a first day show."""

    main: str | None
    """Quantity that explains the pours best; null if none does better than the tolerances of a rig in order."""

    describes: bool
    """Whether half of the doses or more are as predicted from the pours."""

    explanations: list[dict[str, Any]]
    """Name, evidence and value of each quantity; empty if fewer than four pours have readings while they flow."""

    doses: list[dict[str, Any]]
    """Predicted mass with its 90 % interval, weighed and wanted mass of each dose."""

    missed_g: float | None
    """Mass in the receiver after the deliberate miss."""

    dose_error_g: list[float] | None
    """Mean and largest distance of the weighed from the wanted amount."""

    replays: list[RecordingReplayOutput]


OUTPUTS: dict[str, Any] = {
    "run": RunOutput,
    "calibrate": CalibrateOutput,
    "plan": PlanOutput,
    "simulate": SimulateOutput | SimulateTableOutput,
    "dose": DoseOutput | DosePredictionOutput,
    "pour": PourOutput | EmptyPourOutput | DryRunOutput,
    "report": ReportOutput,
    "plugins": PluginsOutput,
    **{f"vessel {source}": VesselOutput for source in ("profile", "photo", "points", "depth", "mesh")},
    "validate-solver": ValidateSolverOutput,
    "runs list": RunsOutput,
    "runs pours": PoursOutput,
    "runs show": PreviousRunDetail,
    "runs known": KnownOutput,
    "runs check": RunCheckOutput,
    "runs compare": RunComparison,
    "runs export": ExportOutput,
    "study run": StudyOutput | StudyCostOutput,
    "study report": StudyOutput,
    "robot check": CheckOutput,
    "robot archive": ArchiveOutput,
    "balance check": BalanceCheckOutput,
    "balance explain": BalanceExplainOutput,
    "recording export": RecordingExportOutput,
    "recording replay": RecordingReplaysOutput,
    "recording fit": RecordingFitOutput,
    "recording first-day": FirstDayOutput,
    "queue submit": CampaignOut,
    "queue list": QueueOutput,
    "queue show": CampaignDetailOut,
    "queue logs": EventOutput,
    "queue pour": PourOut,
    "queue batch": BatchOut,
    "queue batch-status": BatchOut,
    "materials list": VesselContentsOutput,
    "materials history": VesselHistoryOutput,
}
"""Models of the output, by command."""


def output_schema() -> dict[str, Any]:
    """JSON schema of all outputs: the properties are the commands."""
    fields: dict[str, Any] = {name: (model, ...) for name, model in OUTPUTS.items()}
    model = create_model("Output", __doc__="Output of commands with --json, by command.", **fields)
    schema = model.model_json_schema(mode="serialization", schema_generator=DescribedSchema)
    return {**{name: part for name, part in schema.items() if name != "required"}, "title": "Output"}
