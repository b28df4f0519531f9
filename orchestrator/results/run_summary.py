"""The summary of a run for programs: `summary.json` and its JSON schema.

`RunSummary` is the content of the file. `orchestrator.results.summarise` creates it, and
`orchestrator.results.console_view` displays it.
"""

from __future__ import annotations

import re
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import Field, SerializeAsAny, create_model
from pydantic.json_schema import GenerateJsonSchema

from orchestrator.journal.stage_results import kinds
from orchestrator.strategies.calibration.calibration_scores import CalibrationGain
from orchestrator.strategies.calibration.posterior_summary import PosteriorSummary
from orchestrator.strategies.deployment.deployment_result import ParetoAction, RiskFound
from orchestrator.strategies.deployment.model_monitoring import Believed
from orchestrator.strategies.deployment.real_pours import PredictionCheck
from orchestrator.strategies.deployment.safe_window import WindowFound
from orchestrator.strategies.single_action import Confirmed
from orchestrator.strategies.stage_result import ResultPart, StageResult
from sim_engine.liquids import SimulationParameters
from sim_engine.model_validity import NotCovered
from sim_engine.prediction_band import PredictionInterval, SampleStatistics

SUMMARY_NAME = "summary.json"


class PoolUse(ResultPart):
    """Use of the simulator pool in a stage with pours."""

    pool_busy: float | None
    """Busy share of the pool while it had useful work."""

    pool_useful: float | None
    """Share of the time in which the pool had useful work."""

    arm_longest_wait_s: float | None
    """Longest wait of the arm for a decision between two pours."""

    arm_mean_wait_s: float | None
    """Mean of all these waits."""


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


class NotSimulated(ResultPart):
    """An effect that is not simulated in part of an action space."""

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
    first_loss: float | None
    first_spillage: float | None
    best_loss: float | None
    best_spillage: float | None
    best_pour: int | None
    """Number of the pour with the smallest loss."""

    best_delivered_g: float | None
    """Mass in the receiver after this pour."""

    best_delivered_ml: float | None
    """Volume in the receiver, from the liquid's density."""

    best_measured_action: dict[str, float | None] | None
    """Action of this pour in display units."""

    best_action: dict[str, float | None] | None
    """The recommended action in display units."""

    best_action_si: dict[str, float] | None
    predicted_loss: float | None
    """Expected loss of the recommended action."""

    predicted_deviation: float | None
    predicted_scatter: float | None
    predicted_spillage: float | None
    predicted_spillage_deviation: float | None
    untrustworthy_simulation: bool
    trust: PredictionCheck | Believed
    gave_up: str | None
    ended: str | None
    front: tuple[ParetoAction, ...] | None
    risk: RiskFound | None
    window: WindowFound | None
    prediction: dict[str, SampleStatistics] | None
    """Result of repeated simulations of the recommended action with new seeds, by quantity."""

    prediction_band: PredictionInterval | None
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


class RunSummary(Totals):
    """Summary of a run; missing parts are null or empty."""

    campaign: str
    seed: int
    theta: SimulationParameters | None
    """θ to simulate with: θ*, or the uncalibrated θ if the weighed pours do not justify θ*."""

    calibrated_theta: SimulationParameters | None
    """θ*."""

    calibration_gain: CalibrationGain | None
    """Whether the weighed pours justify θ*; null if θ* was not compared with the uncalibrated θ."""

    predicted_discrepancy: float | None
    """Expected mean |r − c_s| of θ*."""

    predicted_deviation: float | None
    posterior: PosteriorSummary | None
    discrepancy: dict[str, dict[str, float | None]]
    """Mean |r − c_s| by split and predictor, as fractions of the poured liquid."""

    loss: str | None
    """Name of the loss that deployments minimise."""

    receivers: dict[str, ReceiverSummary]
    """By scene."""

    not_covered: dict[str, tuple[NotSimulated, ...]]
    """Effects that are not simulated in the action spaces, by scene."""

    figures: dict[str, Path]
    recording: Path | None
    dropped_events: int
    """Number of events missing in the recording."""

    results: dict[str, SerializeAsAny[StageResult]]
    """Results of the stages, in order."""


class _NoTitles(GenerateJsonSchema):
    """JSON schema without titles, which only repeat the keys."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """Always false."""
        return False


def summary_schema() -> dict[str, Any]:
    """JSON schema of `summary.json`, with all kinds of results of the installed packages."""
    tagged: Any = Annotated[reduce(or_, cast("Any", kinds())), Field(discriminator="kind")]
    documented = create_model("RunSummary", __base__=RunSummary, __doc__=RunSummary.__doc__, results=dict[str, tagged])
    schema = documented.model_json_schema(mode="serialization", schema_generator=_NoTitles)
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
    """JSON of a summary for commands: without the stages' results, which are in its file."""
    return summary.model_dump(mode="json", exclude={"results"})
