"""Reads run folders and benches for the API; every function may take seconds and must not run in an event loop.

- `RunReadouts`, `summary_of` and `verdict_at` read the pours, the summary and the verdict of a run.
- `found_at` reads the arm and the balance after a crash, for the operator who decides the outcome of a pour. Nothing is
  moved or tared.
- `violated_charts` reads the control charts that are out of control.
- `prune_recordings` deletes old recordings; journals, figures and summaries are always kept.
"""

from __future__ import annotations

import json
import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

from actors.arm.arm_settings import arm_kind
from actors.balance.balance_settings import balance_diagnostics
from actors.bench.night_consent import MOTIONS
from actors.interfaces import LaboratoryError
from actors.laboratory import reached
from actors.laboratory_settings import LaboratorySettings
from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.catalogue.control_charts import LaboratoryChart
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.records.codec import CodecError
from orchestrator.records.journal_file import JournalError
from orchestrator.records.run_record import RunState, read_record
from orchestrator.records.verdict import verdict_of
from orchestrator.reports.html_report import REPORT_NAME as REPORT
from orchestrator.reports.mixture_report import draw_rack, mixed_liquids, mixtures_so_far
from orchestrator.reports.run_summary import PourSummary
from orchestrator.reports.summarise import pour_summaries

__all__ = ["REPORT", "RunReadouts", "summary_of"]

_log = logging.getLogger(__name__)


def violated_charts(state: Path) -> list[LaboratoryChart]:
    """The control charts of all laboratories that have left their limits. Raises RunError and OSError."""
    with Catalogue(state) as catalogue:
        catalogue.refresh()
        return [chart for chart in catalogue.charts({}) if chart.lasting is not None]


class RunReadouts:
    """Pours of runs. Each journal is read from its last position, since pages query again at every event.

    May be called from several threads.

    Args:
        keep: number of runs to cache, the most recently queried ones.
    """

    def __init__(self, keep: int = 16) -> None:
        self._keep = keep
        self._read: OrderedDict[Path, tuple[CampaignPlan, RunState]] = OrderedDict()
        self._guard = Lock()

    def of(self, directory: Path, plan: Callable[[], CampaignPlan], *, live: bool) -> dict[str, Any]:
        """Return the pours of a run and what follows from them, as fields of `CampaignDetailOut`.

        Args:
            directory: folder of the run.
            plan: makes the campaign's plan; called once. Its errors are passed on.
            live: whether the run is in progress.
        """
        with self._guard:
            before = self._read.pop(directory, None)
            planned, earlier = (plan(), None) if before is None else before
            try:
                record = read_record(directory, earlier=earlier)
            except (JournalError, CodecError, OSError):
                return {}  # being created, or of another version: read from its start at the next call
            self._read[directory] = planned, record
            if len(self._read) > self._keep:
                self._read.popitem(last=False)
            pours = pour_summaries(planned, record, live=live)
            seen: dict[str, Any] = {"pours_made": pours, "night": night(record, pours)}
            if (mixtures := mixtures_so_far(planned, record, live=live)) is not None:
                drawing = draw_rack(mixtures, mixed_liquids(planned))
                seen |= {"mixtures": mixtures.components(), "rack": drawing.svg()}
            return seen


_OF_NIGHT = ("consent", "end", "fault", "accounted")
"""What a note may be about besides a question, see `actors.interfaces.Notice`."""


def night(record: RunState, pours: Sequence[PourSummary]) -> list[dict[str, Any]]:
    """The timeline of unattended pours since the first consent: consents, pours, masses, faults, answers.

    Args:
        record: of the run.
        pours: of the run.

    Returns:
        Time [s since 1970], kind and text of each, in order; empty without a consent.
    """
    begun = next((t for t, _, about in record.notes if about == "consent"), math.inf)
    timeline = [
        (t, about if about in _OF_NIGHT else "answer", text)
        for t, text, about in record.notes
        if t >= begun and about not in (None, "unattended", *MOTIONS)
    ]
    for pour in pours:
        if pour.time is not None and pour.time >= begun and pour.state not in ("asked", "under way"):
            timeline.append(
                (pour.time, "pour", pour.line if pour.state == "weighed" else f"pour {pour.number}: {pour.state}")
            )
    return [{"time": t, "kind": kind, "text": text} for t, kind, text in sorted(timeline)]


def summary_of(directory: Path) -> dict[str, Any] | None:
    """Return a run's `summary.json`, or None before it is published."""
    try:
        summary: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return summary


def verdict_at(directory: Path) -> dict[str, Any] | None:
    """Return the verdict of a run, JSON-ready; None if its journal can't be read."""
    try:
        return verdict_of(read_record(directory)).model_dump(mode="json")
    except Exception as error:  # damaged content can cause any error, and must not end the work of a rig
        _log.warning("%s: no verdict: %s: %s", directory.name, type(error).__name__, error)
        return None


def found_at(spec: LaboratorySettings) -> dict[str, str]:
    """Describe the state of a bench for the operator. Takes seconds.

    Args:
        spec: settings of the laboratory.

    Returns:
        Findings by device; a device that can't be read has an entry with the reason.
    """
    if spec.arm is None:
        return {"bench": "simulated: it has no arm and no balance that could be read"}
    findings: dict[str, str] = {}
    try:
        with reached(spec) as ready:
            assert ready.arm is not None
            checks = arm_kind(ready.arm).diagnostics().checks(None, accept="", virtual=True) + balance_diagnostics(
                ready.balance, tare=False
            )
    except (LaboratoryError, OSError, ValueError) as error:
        return {"bench": f"can't be read: {error}"}
    for check in checks:
        if check.name != "balance tare":  # a question must not change what the balance shows
            findings[check.name] = check.found
    if spec.mode == "virtual":
        findings["note"] = "arm and balance are virtual and were restarted: they show nothing of the pour"
    return findings


def prune_recordings(settings: DaemonSettings, busy: Collection[str] = ()) -> list[Path]:
    """Delete the recordings of all runs but the newest ones.

    Args:
        settings: number of runs that keep theirs, and folder.
        busy: names of runs in progress.

    Returns:
        The deleted files.
    """
    if settings.keep_recordings is None:
        return []
    runs: dict[Path, float] = {}
    for path in settings.runs.glob("*/*.rrd"):
        runs[path.parent] = max(runs.get(path.parent, 0.0), path.stat().st_mtime)
    newest = sorted(runs, key=lambda run: runs[run], reverse=True)
    removed = []
    for run in newest[settings.keep_recordings :]:
        if run.name not in busy:
            for path in run.glob("*.rrd"):
                path.unlink()
                removed.append(path)
    return removed
