"""Reads run folders and benches for the API; every function may take seconds and must not run in an event loop.

- `Pours` and `summary_of` read the pours and the summary of a run.
- `found_at` reads the arm and the balance after a crash, for the operator who decides the outcome of a pour. Nothing is
  moved or tared.
- `prune_recordings` deletes old recordings; journals, figures and summaries are always kept.
"""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from pathlib import Path
from threading import Lock
from typing import Any

from actors.balance.balance_settings import balance_diagnostics
from actors.interfaces import LaboratoryError
from actors.laboratory import reached
from actors.laboratory_settings import LaboratorySettings
from orchestrator.daemon.daemon_settings import DaemonSettings
from orchestrator.journal.codec import CodecError, decode_outcome, decode_request
from orchestrator.journal.journal import JOURNAL_NAME, Entry, JournalReader, Kind
from orchestrator.journal.journal_file import JournalError
from orchestrator.requests import Failed, Pour, Poured
from orchestrator.results import figure_style as style
from orchestrator.results.html_report import REPORT_NAME as REPORT
from orchestrator.results.loss_units import is_calibration, loss_of_pour, unit_of_pour
from orchestrator.results.stage_views import receiver_name
from orchestrator.states import RESTING, State
from orchestrator.strategies.campaign_plan import CampaignPlan

__all__ = ["REPORT", "Pours", "summary_of"]


class Pours:
    """Pours of runs. Each journal is read from its last position, since pages query again at every event.

    May be called from several threads.

    Args:
        keep: number of runs to cache, the most recently queried ones.
    """

    def __init__(self, keep: int = 16) -> None:
        self._keep = keep
        self._read: OrderedDict[Path, _Read] = OrderedDict()
        self._guard = Lock()

    def of(self, directory: Path, plan: Callable[[], CampaignPlan]) -> list[dict[str, Any]]:
        """Return the requested pours of a run in order, with predictions and measurements.

        Args:
            directory: folder of the run.
            plan: makes the campaign's plan; called once. Its errors are passed on.
        """
        with self._guard:
            read = self._read.pop(directory, None) or _Read(plan())
            try:
                read.on(directory)
            except (JournalError, CodecError, OSError):
                return read.rows()  # being created, or of another version: read from its start at the next call
            self._read[directory] = read
            if len(self._read) > self._keep:
                self._read.popitem(last=False)
            return read.rows()


class _Read:
    """The state read from one run's journal."""

    def __init__(self, plan: CampaignPlan) -> None:
        self._plan, self._last = plan, 0
        self._pours: dict[int, dict[str, Any]] = {}
        self._requests: dict[int, Pour] = {}

    def rows(self) -> list[dict[str, Any]]:
        return [dict(pour) for pour in self._pours.values()]

    def on(self, directory: Path) -> None:
        kinds = [*(Kind.REQUESTED, Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED, Kind.CAMPAIGN_STATE)]
        with JournalReader(directory / JOURNAL_NAME) as journal:
            for entry in journal.entries(after=self._last, kinds=kinds):
                self._take(entry)
                self._last = entry.seq

    def _take(self, entry: Entry) -> None:
        if entry.kind == Kind.CAMPAIGN_STATE:
            if entry.body["after"] in (*RESTING, State.PREPARING):  # the process that poured has ended
                for pour in self._pours.values():
                    if pour["state"] == "under way":
                        pour["state"] = "unknown"
            return
        key = entry.body["id"]
        if entry.kind == Kind.REQUESTED:
            if entry.body["request"]["type"] == Pour.__name__:
                request = decode_request(entry.body["request"])
                assert isinstance(request, Pour)
                self._requests[key], self._pours[key] = request, _requested(self._plan, entry.stage, request)
        elif entry.kind == Kind.POUR_FINISHED:
            outcome = decode_outcome(entry.body["outcome"])
            self._pours[key] |= {"time": entry.t, **_outcome(self._plan, self._requests[key], outcome)}
        else:
            begun = entry.kind == Kind.POUR_STARTED
            self._pours[key] |= {"state": "under way" if begun else "asked", "time": entry.t}


def _requested(plan: CampaignPlan, stage: str, pour: Pour) -> dict[str, Any]:
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
        "loss": unit_of_pour(plan, pour).meaning,
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
    """Return a run's `summary.json`, or None before it is published."""
    try:
        found: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def found_at(spec: LaboratorySettings) -> dict[str, str]:
    """Describe the state of a bench for the operator. Takes seconds.

    Args:
        spec: settings of the laboratory.

    Returns:
        Findings by device; a device that can't be read has an entry with the reason.
    """
    if spec.arm is None:
        return {"bench": "simulated: it has no arm and no balance that could be read"}
    found: dict[str, str] = {}
    try:
        with reached(spec) as ready:
            assert ready.arm is not None
            checks = ready.arm.diagnostics().checks(None, accept="", virtual=True) + balance_diagnostics(
                ready.balance, tare=False
            )
    except (LaboratoryError, OSError, ValueError) as error:
        return {"bench": f"can't be read: {error}"}
    for check in checks:
        found[check.name] = check.found
    if spec.mode == "virtual":
        found["note"] = "arm and balance are virtual and were started anew: they show nothing of the pour"
    return found


def prune_recordings(settings: DaemonSettings, busy: Collection[str] = (), now: float | None = None) -> list[Path]:
    """Delete recordings that exceed the configured number or age.

    Args:
        settings: limits and folder.
        busy: names of runs in progress.
        now: time in seconds since 1970.

    Returns:
        The deleted files.
    """
    if settings.keep_recordings is None and settings.recording_age is None:
        return []
    now = time.time() if now is None else now
    runs: dict[Path, float] = {}
    for path in settings.runs.glob("*/*.rrd"):
        runs[path.parent] = max(runs.get(path.parent, 0.0), path.stat().st_mtime)
    newest = sorted(runs, key=lambda run: runs[run], reverse=True)
    removed = []
    for index, run in enumerate(newest):
        many = settings.keep_recordings is not None and index >= settings.keep_recordings
        old = settings.recording_age is not None and now - runs[run] > settings.recording_age
        if (many or old) and run.name not in busy:
            for path in run.glob("*.rrd"):
                path.unlink()
                removed.append(path)
    return removed
