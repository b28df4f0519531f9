"""The result document of a run: `summary.json` and its JSON schema.

`RunSummary` has everything that is shown of a run, in numbers and in words with units. `orchestrator.reports.summarise`
creates it. Console, report, HTTP API and library render it, and read no journal.
"""

from __future__ import annotations

import re
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import Field, SerializeAsAny, create_model

from orchestrator.learning.calibration.calibration_scores import CalibrationGain
from orchestrator.learning.calibration.posterior_summary import PosteriorSummary
from orchestrator.learning.deployment.deployment_result import Recommended
from orchestrator.learning.deployment.model_monitoring import Believed
from orchestrator.learning.deployment.real_pours import DeploymentRow, PredictionCheck
from orchestrator.learning.single_action import Confirmed
from orchestrator.learning.stage_result import ResultPart, StageResult, WeighedMasses
from orchestrator.learning.strategy_registry import result_kinds
from orchestrator.records.run_record import PourState
from orchestrator.records.verdict import Verdict
from sim_engine.liquids import SimulationParameters
from sim_engine.model_validity import NotCovered
from sim_engine.prediction_band import PredictionInterval, SampleStatistics
from sim_engine.settings.model import DescribedSchema

SUMMARY_NAME = "summary.json"


class PoolUse(ResultPart):
    """Use of the simulator pool in a stage with pours."""

    pool_busy: float | None
    """Busy share of the pool."""

    arm_longest_wait_s: float | None
    """Longest wait of the arm for a decision between two pours."""

    arm_mean_wait_s: float | None
    """Mean of all these waits."""

    text: str
    """The same in words."""


class Totals(ResultPart):
    """Costs of a run."""

    mode: str = "none"
    """Mode of the bench: 'virtual', 'hardware', or 'none' without one."""

    simulations: int = 0
    """Number of finished simulations, including failed ones."""

    pours: int = 0
    """Number of finished pours, including failed ones."""

    cpu_s: float = 0.0
    """CPU seconds of all simulations and suggestions."""

    seconds: float = 0.0
    """Wall time of the process that ended the run."""

    occupancy: dict[str, PoolUse] = Field(default_factory=dict)
    """By stage, for stages with both simulations and pours."""


class StageSummary(ResultPart):
    """Progress of a stage."""

    stage: str
    state: Literal["open", "closed"]
    pours: int
    """Number of finished pours, including failed ones."""

    simulations: int
    """Number of finished simulations."""

    unusable_simulations: int


class PourSummary(WeighedMasses):
    """A requested pour."""

    stage: str
    number: int
    receiver: str
    """Display name of the scene."""

    state: PourState
    """'unknown': the run ended during the pour, so it has no outcome."""

    calibration: bool
    """Whether the pour is compared with simulations instead of minimised."""

    action: str
    """The searched dimensions with their units."""

    action_si: dict[str, float | None]
    """All dimensions."""

    predicted: str
    """The predicted loss; '' without a prediction."""

    measured: str
    """The measured loss, for a dose the received mass, or the reason of a failure; '' until then."""

    loss: str
    """Meaning of `predicted` and `measured`, such as 'spilled / poured': each loss has its own denominator."""

    best: bool
    """Whether its loss is the smallest one of its stage."""

    remark: str
    """Remarks: the reason of a failure, an unknown outcome, the operator's answer."""

    time: float | None
    """When it began, or ended: seconds since 1970."""

    seconds: float | None
    """Its duration, operator and balance included."""

    @property
    def line(self) -> str:
        """'pour 3 into narrow: 1.20 % (12.0 g spilled, 3.4 g left in the pourer)', once it is weighed."""
        spilled = "spilled mass not weighed" if self.spilled_g is None else f"{self.spilled_g:.1f} g spilled"
        weights = f"{spilled}, {self.retained_g or 0.0:.1f} g left in the pourer"
        return f"pour {self.number} into {self.receiver}: {self.measured} ({weights})"


class QuestionSummary(ResultPart):
    """A question to the operator."""

    time: float
    """Seconds since 1970."""

    stage: str
    question: str
    answer: str | None


class LogEntry(ResultPart):
    """A note for the operator, or a reason for a strategy's requests."""

    time: float
    """Seconds since 1970."""

    stage: str
    text: str


NOT_SEARCHED = "not searched"
"""`ParameterSummary.searched` of a parameter with a fixed value."""


class ParameterSummary(ResultPart):
    """A parameter of θ* in words with units."""

    name: str
    value: str
    region: str
    """Where the parameter lies in most θ that fit the pours; '—' if this was not computed."""

    searched: str


class Advice(ResultPart):
    """Recommendation of a deployment for one receiver, in words with units."""

    receiver: str
    action: dict[str, str]
    """The searched dimensions; empty without a recommendation."""

    fixed: dict[str, str]
    """The other dimensions, as in the campaign."""

    sentences: tuple[str, ...]
    """Recommendation and expected result."""

    open: tuple[str, ...]
    """Warnings and open questions."""


class NotSimulated(ResultPart):
    """An effect that is not simulated in part of an action space."""

    receiver: str
    """Display name of the scene."""

    kind: str
    """'dribbling', 'wetting', 'viscous', 'thin_stream', 'glugging' or 'airtight'."""

    share: float
    """Share of the poured liquid that leaves under such conditions, for the worst of the actions tried."""

    text: str
    """Description and advice."""

    action_si: dict[str, float]
    """The worst action."""

    hit: int
    """Number of tried actions that are affected."""

    tried: int


# More than 20 fields: a flat JSON object that programs read.
class ReceiverSummary(ResultPart):
    """Result of a deployment in one scene. Losses are in the loss's own unit, r = spilled / poured."""

    receiver: str
    """Display name of the scene."""

    strategy: str
    pours: int
    """Number of weighed pours."""

    failed_pours: int
    failures: tuple[str, ...]
    """Reasons of the failures, in order: 'pour 2: the gripper slipped'."""

    refused_pours: int
    simulations: int
    first: DeploymentRow | None
    """The first weighed pour."""

    best: DeploymentRow | None
    """The pour with the smallest loss."""

    recommended: Recommended | None
    """The recommended action and its predicted loss."""

    model_check: PredictionCheck | Believed
    gave_up: str | None
    ended: str | None
    prediction: dict[str, SampleStatistics] | None
    """Result of repeated simulations of the recommended action with new seeds, by quantity."""

    prediction_interval: PredictionInterval | None
    """Prediction interval of r for a single pour with it: includes seeds, θ, the residual of calibration, and
    resolution."""

    at_bounds: tuple[str, ...]
    """Dimensions of the recommended action at an end of their ranges, as text."""

    predicted_delivered_g: float | None
    """Mean mass in the receiver over these simulations."""

    predicted_delivered_ml: float | None
    """Mean volume in the receiver, from the liquid's density."""

    confirmed: Confirmed | None
    """Result of repeated pours of the recommended action; null if not requested."""

    not_covered: tuple[NotCovered, ...]
    """Effects that are not simulated for the recommended action."""

    texts: dict[str, str]
    """The losses and masses above with their units, by the heads of a table."""


PLANNED = (
    "prediction",
    "prediction_interval",
    "at_bounds",
    "predicted_delivered_g",
    "predicted_delivered_ml",
    "not_covered",
)
"""Fields of a receiver's summary that a plan for it gives beside the action."""


class RunOutcome(ResultPart):
    """Pours of a run, and the actions that it recommends."""

    stages: tuple[StageSummary, ...] = ()
    pours_made: tuple[PourSummary, ...] = ()
    questions: tuple[QuestionSummary, ...] = ()
    advice: tuple[Advice, ...] = ()
    """For each receiver."""

    without_advice: tuple[str, ...] = ()
    """Outcome of a run that recommends no action."""

    open_questions: tuple[str, ...] = ()
    """Open questions that do not depend on the receiver."""

    loss: str | None = None
    """Name of the loss that deployments minimise."""

    loss_label: str = ""
    """Its meaning and unit."""

    receivers: dict[str, ReceiverSummary] = Field(default_factory=dict)
    """By scene."""

    not_covered: dict[str, tuple[NotSimulated, ...]] = Field(default_factory=dict)
    """Effects that are not simulated in the action spaces, by scene."""


class RunLearning(ResultPart):
    """Knowledge of θ; null or empty without a calibration."""

    theta: SimulationParameters | None = None
    """θ to simulate with: θ*, or the uncalibrated θ if the weighed pours do not justify θ*."""

    calibrated_theta: SimulationParameters | None = None
    """θ*."""

    calibration_gain: CalibrationGain | None = None
    """Whether the weighed pours justify θ*; null if θ* was not compared with the uncalibrated θ."""

    predicted_discrepancy: float | None = None
    """Expected mean |r − c_s| of θ*."""

    predicted_deviation: float | None = None
    posterior: PosteriorSummary | None = None
    parameters: tuple[ParameterSummary, ...] = ()
    """θ* with its region."""

    theta_sentences: tuple[str, ...] = ()
    """Knowledge of θ*, and its gaps."""

    discrepancy: dict[str, dict[str, float | None]] = Field(default_factory=dict)
    """Mean |r − c_s| by split and predictor, as fractions of the poured liquid."""


class RunLog(ResultPart):
    """What was written for the operator."""

    notes: tuple[LogEntry, ...] = ()
    decisions: tuple[LogEntry, ...] = ()
    """The most recent ones."""


class RunFiles(ResultPart):
    """Files of a run, besides its records."""

    figures: dict[str, Path] = Field(default_factory=dict)
    recording: Path | None = None
    dropped_events: int = 0
    """Number of events missing in the recording."""


class RunSummary(Totals):
    """Summary of a run; missing parts are null or empty."""

    campaign: str
    seed: int | None = None
    run: str = ""
    """Name of its folder."""

    state: str = "queued"
    """State of the run when the summary was made."""

    verdict: Verdict
    """What was reached of what was wanted."""

    began_at: float | None = None
    """Seconds since 1970."""

    ended_at: float | None = None
    """When the last entry of the journal was written."""

    standing: tuple[str, ...] = ()
    """State of an unfinished run and the next steps, and damage of its records."""

    asked: dict[str, str] = Field(default_factory=dict)
    """The campaign's settings for readers who have not seen its file."""

    cost: dict[str, str] = Field(default_factory=dict)
    """Pours, liquid, time and simulations."""

    settings: dict[str, str] = Field(default_factory=dict)
    """Laboratory, versions, and the check of the records."""

    outcome: RunOutcome = Field(default_factory=RunOutcome)
    learning: RunLearning = Field(default_factory=RunLearning)
    log: RunLog = Field(default_factory=RunLog)
    files: RunFiles = Field(default_factory=RunFiles)
    results: dict[str, SerializeAsAny[StageResult]] = Field(default_factory=dict)
    """Results of the stages, in order."""


def summary_schema() -> dict[str, Any]:
    """JSON schema of `summary.json`, with all kinds of results of the installed packages."""
    tagged: Any = Annotated[reduce(or_, cast("Any", result_kinds())), Field(discriminator="kind")]
    documented = create_model("RunSummary", __base__=RunSummary, __doc__=RunSummary.__doc__, results=dict[str, tagged])
    schema = documented.model_json_schema(mode="serialization", schema_generator=DescribedSchema)
    return {**schema, "title": "Result"}


_NUMBERS = re.compile(r"\[\s+(-?\d[^\[\]{}\"]*?)\s+\]")
"""A list of numbers, written one per line."""


def write_summary(directory: Path, summary: RunSummary) -> Path:
    """Write `summary.json`, completely or not at all.

    Raises:
        OSError: the file can't be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / SUMMARY_NAME
    draft = path.with_suffix(".json.part")
    text = _NUMBERS.sub(lambda found: f"[{' '.join(found[1].split())}]", summary.model_dump_json(indent=2))
    draft.write_text(text + "\n", encoding="utf-8")
    draft.replace(path)
    return path


def summary_json(summary: RunSummary) -> dict[str, Any]:
    """JSON of a summary for commands: without results and log, which are in its file."""
    return summary.model_dump(mode="json", exclude={"results", "log"})
