"""What runs have left on the disk, read for the API. Takes a moment, and no event loop.

What arm and balance show after a crash: read, never moved or tared, for the person who says what came of a pour.

Which recordings are kept: journals, figures and summaries always are.
"""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from pathlib import Path
from threading import Lock
from typing import Any

from actors.balance.balance_settings import look_at_balance
from actors.interfaces import LaboratoryError
from actors.laboratory import reached
from actors.laboratory_settings import LaboratorySpec
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
    """Pours of runs. Each journal is read on from where it was left: people look again at every event.

    Args:
        keep: runs that are remembered, the latest that were looked at. May be asked from several threads.
    """

    def __init__(self, keep: int = 16) -> None:
        self._keep = keep
        self._read: OrderedDict[Path, _Read] = OrderedDict()
        self._guard = Lock()

    def of(self, directory: Path, plan: Callable[[], CampaignPlan]) -> list[dict[str, Any]]:
        """The pours of a run that were asked for, in order: what was predicted, and what was weighed.

        Args:
            directory: of the run.
            plan: makes its campaign's plan, once. What it raises is passed on.
        """
        with self._guard:
            read = self._read.pop(directory, None) or _Read(plan())
            try:
                read.on(directory)
            except (JournalError, CodecError, OSError):
                return read.rows()  # a run that is just being made, or another version's: begun anew next time
            self._read[directory] = read
            if len(self._read) > self._keep:
                self._read.popitem(last=False)
            return read.rows()


class _Read:
    """What was read of one run."""

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
                self._requests[key], self._pours[key] = request, _asked(self._plan, entry.stage, request)
        elif entry.kind == Kind.POUR_FINISHED:
            outcome = decode_outcome(entry.body["outcome"])
            self._pours[key] |= {"time": entry.t, **_outcome(self._plan, self._requests[key], outcome)}
        else:
            begun = entry.kind == Kind.POUR_STARTED
            self._pours[key] |= {"state": "under way" if begun else "asked", "time": entry.t}


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
    """A run's `summary.json`; None before it is published."""
    try:
        found: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def found_at(spec: LaboratorySpec) -> dict[str, str]:
    """What is found at a bench, in words. Takes seconds.

    Args:
        spec: of the laboratory.

    Returns:
        By what was looked at; what could not be read says so.
    """
    if spec.arm is None:
        return {"bench": "made of numbers: it has no arm and no balance that could be read"}
    found: dict[str, str] = {}
    try:
        with reached(spec) as ready:
            assert ready.arm is not None
            checks = ready.arm.look().checks(None, accept="", virtual=True) + look_at_balance(ready.balance, tare=False)
    except (LaboratoryError, OSError, ValueError) as error:
        return {"bench": f"can't be read: {error}"}
    for check in checks:
        found[check.name] = check.found
    if spec.mode == "virtual":
        found["note"] = "arm and balance are virtual and were started anew: they show nothing of the pour"
    return found


def prune_recordings(settings: DaemonSettings, busy: Collection[str] = (), now: float | None = None) -> list[Path]:
    """Remove recordings that are too many or too old.

    Args:
        settings: say which.
        busy: names of runs that are being written.
        now: seconds since 1970.

    Returns:
        What was removed.
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
