"""The JSON output of commands with `--json`: `OUTPUTS` has one model for each command.

The models of `command_results` are joined here with those that have parts of runs, of the catalogue or of the daemon's
API. What the daemon or the catalogue returns is printed as it is.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, create_model

from orchestrator.catalogue.run_reading import PreviousPour, PreviousRun, PreviousRunDetail
from orchestrator.cli.command_results import (
    CalibrateOutput,
    CommandOutput,
    PluginsOutput,
    SimulateOutput,
)
from orchestrator.daemon.api.schemas import CampaignDetailOut, CampaignOut, StatusOut
from orchestrator.daemon.state.daemon_store import QuestionOut
from orchestrator.records.journal_check import JournalCheck
from orchestrator.reports.run_summary import PLANNED, ReceiverSummary, RunSummary
from sim_engine.liquids import SimulationParameters
from sim_engine.settings.model import DescribedSchema, meanings


class _PlannedParts(CommandOutput):
    receiver: str
    """Name of the receiver."""

    action: dict[str, Any]
    """The recommended action, in deg, deg/s, mm and s."""

    action_si: dict[str, float | None]
    equal_ranges: dict[str, tuple[float, float]] | None
    """Ends of the ranges in which the expected loss is as small [SI], one dimension changed at a time."""

    predicted_loss: float | None
    predicted_deviation: float | None
    predicted_spillage: float | None
    """Mean spilled / poured of the simulations with further seeds."""

    predicted_spillage_deviation: float | None
    """Standard deviation of spilled / poured over their seeds."""

    loss: str
    """Name of the loss that was minimised."""


def _part(model: type[BaseModel], names: Any) -> dict[str, Any]:
    """Fields of another model, for `create_model`."""
    fields = {}
    for name in names:
        field = copy(model.model_fields[name])
        field.description = meanings(model)[name] or None
        fields[name] = (field.annotation, field)
    return fields


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
    __base__=CommandOutput,
    __doc__="Summary of a run: `summary.json` without results and log.",
    **_part(RunSummary, [name for name in RunSummary.model_fields if name not in ("results", "log")]),
    report=(Path | None, Field(description="The report, report.html.")),
)


class RunsOutput(CommandOutput):
    """Runs, newest first."""

    runs: list[PreviousRun]  # type: ignore[valid-type]


class PoursOutput(CommandOutput):
    """Pours, oldest first."""

    pours: list[PreviousPour]  # type: ignore[valid-type]


class QueueOutput(CommandOutput):
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


OUTPUTS: dict[str, Any] = {
    "run": RunOutput,
    "calibrate": CalibrateOutput,
    "plan": PlanOutput,
    "simulate": SimulateOutput,
    "plugins": PluginsOutput,
    "runs list": RunsOutput,
    "runs pours": PoursOutput,
    "runs show": PreviousRunDetail,
    "runs check": JournalCheck,
    "queue submit": CampaignOut,
    "queue list": QueueOutput | CampaignDetailOut,
    "queue logs": EventOutput,
}
"""Models of the output, by command."""


def output_schema() -> dict[str, Any]:
    """JSON schema of all outputs: the properties are the commands."""
    fields: dict[str, Any] = {name: (model, ...) for name, model in OUTPUTS.items()}
    model = create_model("Output", __doc__="Output of commands with --json, by command.", **fields)
    schema = model.model_json_schema(mode="serialization", schema_generator=DescribedSchema)
    return {**{name: entry for name, entry in schema.items() if name != "required"}, "title": "Output"}
