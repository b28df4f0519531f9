"""What runs have left on the disk, read for the API. Takes a moment, and no event loop."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from orchestrator.codec import CodecError, decode_outcome, decode_request
from orchestrator.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.journal_file import JournalError
from orchestrator.plan import CampaignPlan
from orchestrator.report import style
from orchestrator.report.names import receiver_name
from orchestrator.report.run_page import REPORT_NAME as REPORT
from orchestrator.report.units import is_calibration, loss_of_pour, unit_of_pour
from orchestrator.requests import Failed, Pour, Poured

__all__ = ["REPORT", "pours_of", "summary_of"]


def pours_of(plan: CampaignPlan, directory: Path) -> list[dict[str, Any]]:
    """The pours of a run that were asked for, in order: what was predicted, and what was weighed."""
    pours: dict[int, dict[str, Any]] = {}
    requests: dict[int, Pour] = {}
    try:
        with JournalReader(directory / JOURNAL_NAME) as journal:
            kinds = [Kind.REQUESTED, Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED]
            for entry in journal.entries(kinds=kinds):
                key = entry.body["id"]
                if entry.kind == Kind.REQUESTED:
                    if entry.body["request"]["type"] == Pour.__name__:
                        request = decode_request(entry.body["request"])
                        assert isinstance(request, Pour)
                        requests[key], pours[key] = request, _asked(plan, entry.stage, request)
                    continue
                if entry.kind == Kind.POUR_FINISHED:
                    outcome = decode_outcome(entry.body["outcome"])
                    pours[key] |= {"time": entry.t, **_outcome(plan, requests[key], outcome)}
                else:
                    begun = entry.kind == Kind.POUR_STARTED
                    pours[key] |= {"state": "under way" if begun else "asked", "time": entry.t}
    except (JournalError, CodecError, OSError):
        return list(pours.values())  # a run that is just being made, or another version's
    return list(pours.values())


def _asked(plan: CampaignPlan, stage: str, pour: Pour) -> dict[str, Any]:
    section = plan.calibration if is_calibration(plan, pour) else plan.deployment
    names = section.actions.names if section is not None else ("angular_velocity", "x_offset")
    predicted = "" if pour.predicted is None else unit_of_pour(plan, pour).prediction(pour.predicted)
    return {
        "stage": stage,
        "number": pour.number,
        "receiver": receiver_name(plan, pour.scene),
        "action": style.display_values({name: getattr(pour.action, name) for name in names}),
        "predicted": predicted,
        "measured": "",
        "spillage": None,
        "state": "asked",
        "time": None,
    }


def _outcome(plan: CampaignPlan, pour: Pour, outcome: object) -> dict[str, Any]:
    if isinstance(outcome, Poured):
        loss = loss_of_pour(plan, pour, outcome.measurement)
        measured = "too little was poured" if loss is None else unit_of_pour(plan, pour).text(loss)
        return {"state": "weighed", "measured": measured, "spillage": outcome.measurement.fractions.spilled}
    reason = outcome.reason if isinstance(outcome, Failed) else ""
    return {"state": "failed", "measured": reason}


def summary_of(directory: Path) -> dict[str, Any] | None:
    """A run's `summary.json`; None before it is published."""
    try:
        found: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found
