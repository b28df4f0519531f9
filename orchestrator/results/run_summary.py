"""What a run came to, for programs: `summary.json`. `summarise.py` makes it, `table.py` the table for people."""

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
from orchestrator.strategies.deployment.confirmation import Confirmed
from orchestrator.strategies.deployment.deployment_result import ParetoAction, RiskFound
from orchestrator.strategies.deployment.model_monitoring import Believed
from orchestrator.strategies.deployment.real_pours import Foretold
from orchestrator.strategies.deployment.safe_window import WindowFound
from orchestrator.strategies.stage_result import ResultPart, StageResult
from sim_engine.liquids import SimulationParameters
from sim_engine.model_validity import NotCovered
from sim_engine.prediction_band import PredictionInterval, SampleStatistics

SUMMARY_NAME = "summary.json"


class PoolUse(ResultPart):
    """How busy the pool was beside the arm."""

    pool_busy: float | None
    """Busy share of the pool while it had useful work."""

    pool_useful: float | None
    """Share of the time in which it had."""

    arm_longest_wait_s: float | None
    """Longest wait of the arm for a decision between two pours."""

    arm_mean_wait_s: float | None
    """Mean of all these waits."""


class Totals(ResultPart):
    """How much a run took."""

    mode: str = "none"
    """Mode of the bench: 'virtual', 'hardware', or 'none' without one."""

    simulations: int = 0
    """Finished ones, failed ones included."""

    pours: int = 0
    """Finished ones, failed ones included."""

    cpu_s: float = 0.0
    """CPU seconds of all simulations and suggestions."""

    seconds: float = 0.0
    """Wall time of the process that ended the run."""

    occupancy: dict[str, PoolUse] = Field(default_factory=dict)
    """By stage, where both simulations and pours were made."""


class NotSimulated(ResultPart):
    """Something that is not simulated in part of an action space."""

    kind: str
    """'dribbling', 'wetting', 'viscous', 'thin_stream', 'glugging' or 'airtight'."""

    share: float
    """Share of what is poured that leaves under such conditions, at the worst of the actions tried."""

    text: str
    """What it is and what to do about it, for people."""

    action_si: dict[str, float]
    """That action."""

    hit: int
    """Actions that it holds for, of those tried."""

    tried: int


class ReceiverSummary(ResultPart):
    """What a deployment came to in one scene. Losses are in the loss' own unit, r = spilled / poured."""

    receiver: str
    """What people call the scene."""

    strategy: str
    pours: int
    """Those that were weighed."""

    failed_pours: int
    failures: tuple[str, ...]
    """Why these failed, in the order made: 'pour 2: the gripper slipped'."""

    refused_pours: int
    simulations: int
    first_loss: float | None
    first_spillage: float | None
    best_loss: float | None
    best_spillage: float | None
    best_pour: int | None
    """Number of the pour with the least loss."""

    best_delivered_g: float | None
    """That was in the receiver after it."""

    best_delivered_ml: float | None
    """The same by the liquid's density."""

    best_measured_action: dict[str, float | None] | None
    """Its action in display units."""

    best_action: dict[str, float | None] | None
    """The recommended action in display units."""

    best_action_si: dict[str, float] | None
    predicted_loss: float | None
    """Expected of the recommended action."""

    predicted_deviation: float | None
    predicted_scatter: float | None
    predicted_spillage: float | None
    predicted_spillage_deviation: float | None
    untrustworthy_simulation: bool
    trust: Foretold | Believed
    gave_up: str | None
    ended: str | None
    front: tuple[ParetoAction, ...] | None
    risk: RiskFound | None
    window: WindowFound | None
    prediction: dict[str, SampleStatistics] | None
    """What fresh seeds of the recommended action came to, by quantity."""

    prediction_band: PredictionInterval | None
    """In which r of a single pour with it lies: of seeds, θ, what calibration left over, and resolution."""

    at_bounds: tuple[str, ...]
    """Dimensions of the recommended action that lie at an end of what was searched, in words."""

    predicted_delivered_g: float | None
    """Mean over these seeds of what is in the receiver."""

    predicted_delivered_ml: float | None
    """The same by the liquid's density."""

    confirmed: Confirmed | None
    """What came of pouring the recommended action again; null where nobody asked for that."""

    not_covered: tuple[NotCovered, ...]
    """What is not simulated of the recommended action."""


class RunSummary(Totals):
    """A run; whatever it hasn't got is null or empty."""

    campaign: str
    seed: int
    theta: SimulationParameters | None
    """θ to simulate with from now on: θ*, or the uncalibrated θ if the weighed pours do not justify θ*."""

    calibrated_theta: SimulationParameters | None
    """θ*."""

    calibration_gain: CalibrationGain | None
    """Whether the weighed pours justify θ*; null where θ* was not compared with the uncalibrated θ."""

    predicted_discrepancy: float | None
    """Expected mean |r − c_s| of θ*."""

    predicted_deviation: float | None
    posterior: PosteriorSummary | None
    discrepancy: dict[str, dict[str, float | None]]
    """Mean |r − c_s| by split and predictor, as fractions of what was poured."""

    loss: str | None
    """Name of what deployments minimise."""

    receivers: dict[str, ReceiverSummary]
    """By scene."""

    not_covered: dict[str, tuple[NotSimulated, ...]]
    """What is not simulated in the action spaces, by scene."""

    figures: dict[str, Path]
    recording: Path | None
    dropped_events: int
    """Those that are missing in the recording."""

    results: dict[str, SerializeAsAny[StageResult]]
    """What each stage learnt, in order."""


class _NoTitles(GenerateJsonSchema):
    """JSON schema without titles: they only repeat the keys."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        """They are not."""
        return False


def summary_schema() -> dict[str, Any]:
    """JSON schema of `summary.json`, with all kinds of results that installed packages have."""
    tagged: Any = Annotated[reduce(or_, cast("Any", kinds())), Field(discriminator="kind")]
    documented = create_model("RunSummary", __base__=RunSummary, __doc__=RunSummary.__doc__, results=dict[str, tagged])
    schema = documented.model_json_schema(mode="serialization", schema_generator=_NoTitles)
    return {**schema, "title": "Result"}


_NUMBERS = re.compile(r"\[\s+(-?\d[^\[\]{}\"]*?)\s+\]")
"""A list of numbers that was written one to a line."""


def write_summary(directory: Path, summary: RunSummary) -> Path:
    """Write `summary.json`, whole or not at all.

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
    """What a command prints of a summary: all but the stages' results, which are in its file."""
    return summary.model_dump(mode="json", exclude={"results"})
