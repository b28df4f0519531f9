"""Publishing of a run: its figures, result document, θ* and report are written into its folder."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.catalogue.run_reading import read_run
from orchestrator.learning.calibration.calibration_base import CalibratedTheta
from orchestrator.learning.calibration.calibration_scores import (
    UNCALIBRATED,
    Scores,
    calibration_residual,
    recommended_theta,
)
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import check_journal
from orchestrator.records.run_record import CampaignResult, read_record, read_result
from orchestrator.records.states import State
from orchestrator.reports.html_report import REPORT_NAME, run_page
from orchestrator.reports.mixture_report import with_unfinished, write_mixtures
from orchestrator.reports.run_figures import draw_figures
from orchestrator.reports.run_summary import SUMMARY_NAME, RunFiles, RunSummary, Totals, write_summary
from orchestrator.reports.stage_views import evaluation_of, theta_of
from orchestrator.reports.summarise import pool_use, summarise, summarise_record
from orchestrator.reports.validity_warnings import best_action_warnings, campaign_warnings, worked_out
from orchestrator.runs.run_folder import FIGURES, RECORDING, read_versions
from sim_engine.settings.plugin_registry import own_extras

if TYPE_CHECKING:
    from orchestrator.runs.run_service import RunHandle, RunRequest

THETA_FILE = "theta.json"

KEPT_THETAS = 50
"""Draws of the posterior in that file."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Published:
    """The files that were written about a run.

    Attributes:
        figures: by name.
        theta: the file of the recommended θ, for `--parameters`; None where nothing was calibrated.
        report: the page about the run, for people; None where it could not be written.
    """

    summary: RunSummary
    figures: dict[str, Path]
    recording: Path | None = None
    theta: Path | None = None
    report: Path | None = None


def publish(
    plan: CampaignPlan, result: CampaignResult, recording: Path | None = None, dropped_events: int = 0
) -> Published:
    """Write a run's figures and recorded pours (if the plan wants any), `theta.json`, `summary.json` and the report.

    A run that has not finished may be published, too: its report describes its state. Safe to call again: the files
    are then written again.

    Args:
        plan: of the campaign.
        result: of the run, as `run_campaign` or `read_result` returns it.
        recording: its file, closed; by default the one in the run's folder, if there is one.
        dropped_events: missing in the recording.

    Raises:
        OSError: a file can't be written.
    """
    directory, result = result.directory, with_unfinished(plan, result)
    figures = draw_figures(directory / FIGURES, plan, result.results) if plan.outputs.figures else {}
    if plan.outputs.pour_recordings:
        exports = own_extras("decant.documents")
        if not exports:
            _log.warning("not recorded: this installation has no package that writes recorded pours")
        for export in exports.values():
            for reason in export(directory, plan=plan)[1]:
                _log.warning("not recorded: %s", reason)
    summary = summary_of(plan, result, RunFiles(figures=figures, recording=recording, dropped_events=dropped_events))
    write_summary(directory, summary)
    write_mixtures(result)
    best = theta_of(result.results)
    theta = None if best is None else directory / THETA_FILE
    if theta is not None and best is not None:
        written = theta_file(best, evaluation_of(result.results), plan.calibration)
        theta.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
    report: Path | None = directory / REPORT_NAME
    try:
        _write_page(directory / REPORT_NAME, run_page(summary, plan.resolved))
    except Exception as error:  # days of pouring don't end in a traceback about a page
        _log.warning("the report was not written: %s: %s", type(error).__name__, error)
        report = None
    return Published(summary, figures, summary.files.recording, theta, report)


def publish_run(handle: RunHandle) -> Published:
    """Close the recording of a finished run, and publish the run. Blocks for seconds.

    Raises:
        OSError: a file can't be written.
    """
    assert handle.result is not None, "publish_run() follows wait()"
    handle.close()
    recorded = () if handle.recorder is None else (handle.recorder.path, handle.recorder.dropped)
    return publish(handle.campaign, handle.result, *recorded)


def publish_so_far(request: RunRequest) -> Published | None:
    """Publish a run that has stopped, from its journal.

    Args:
        request: with the folder of the run.

    Returns:
        None if the run has no journal.

    Raises:
        RunError: the journal can't be read.
        OSError: a file can't be written.
    """
    if request.folder is None or not (request.folder / JOURNAL_NAME).is_file():
        return None
    return publish(request.campaign, read_result(request.folder))


def publish_if_missing(plan: CampaignPlan, result: CampaignResult) -> bool:
    """Publish a finished run whose process ended before `summary.json` or `theta.json` was written.

    A `summary.json` that was written while the run was interrupted, or that can't be read, counts as missing.

    Returns:
        Whether anything was missing.

    Raises:
        OSError: a file can't be written.
    """
    if result.state is not State.FINISHED:
        return False
    try:
        summary = json.loads((result.directory / SUMMARY_NAME).read_text(encoding="utf-8"))
        current = summary["state"] == result.state
    except (FileNotFoundError, ValueError, LookupError, TypeError):
        current = False
    if current and (theta_of(result.results) is None or (result.directory / THETA_FILE).is_file()):
        return False
    publish(plan, result)
    return True


def summary_of(plan: CampaignPlan, result: CampaignResult, files: RunFiles | None = None) -> RunSummary:
    """The result document of a run as its folder holds it, of one that is not finished too.

    Args:
        files: its figures and its recording; by default the recording in the run's folder, if there is one.

    Raises:
        OSError: a file can't be read.
        RunError: the journal can't be read.
    """
    directory = result.directory
    record = read_record(directory, slots=plan.parallel_simulations)
    files, beside = files or RunFiles(), directory / RECORDING
    if files.recording is None and beside.is_file():
        files = files.model_copy(update={"recording": beside})
    return summarise(
        plan,
        result.results,
        record=record,
        run=directory.name,
        versions=read_versions(directory),
        check=check_journal(directory / JOURNAL_NAME),
        files=files,
        not_covered=worked_out(lambda: campaign_warnings(plan)),
        best_not_covered=worked_out(lambda: best_action_warnings(plan, result.results)),
        totals=Totals(
            mode=plan.laboratory.mode if record.pours or plan.laboratory.pours else "none",
            simulations=result.simulations,
            pours=result.pours,
            cpu_s=result.cpu_s,
            seconds=result.seconds,
            occupancy=pool_use(record.occupancies),
        ),
    )


def report_on(
    plan: CampaignPlan,
    result: CampaignResult,
    path: Path | None = None,
    formats: tuple[str, ...] = (".svg",),
    *,
    draw: bool = True,
) -> tuple[Path, dict[str, Path]]:
    """Draw a run's figures again, and write the page about it, wherever the run stands.

    Args:
        path: of the page; in the run's folder unless given.
        formats: of the figures.
        draw: whether figures are drawn; the page has none otherwise.

    Raises:
        OSError: a file can't be written.
        RunError: the journal can't be read.
    """
    result = with_unfinished(plan, result)
    write_mixtures(result)
    figures = draw_figures(result.directory / FIGURES, plan, result.results, formats) if draw else {}
    page = run_page(summary_of(plan, result, RunFiles(figures=figures)), plan.resolved)
    return _write_page(path or result.directory / REPORT_NAME, page), figures


def write_reduced_report(path: Path, directory: Path, reason: str) -> Path:
    """Write the page about a run whose campaign or results can't be read: what its journal has without them.

    Args:
        path: of the page.
        directory: of the run.
        reason: why the whole report can't be made.

    Raises:
        OSError: it can't be written, or a figure can't be read.
        RunError: the journal can't be read.
    """
    figures = {file.stem.replace("-", " "): file for file in sorted((directory / FIGURES).glob("*.png"))}
    summary = summarise_record(
        read_record(directory),
        directory.name,
        reason=reason,
        catalogued=read_run(directory).run,
        versions=read_versions(directory),
        check=check_journal(directory / JOURNAL_NAME),
        files=RunFiles(figures=figures),
    )
    return _write_page(path, run_page(summary))


def _write_page(path: Path, page: str) -> Path:
    draft = path.with_suffix(".html.part")
    draft.write_text(page, encoding="utf-8")
    draft.replace(path)
    return path


def theta_file(
    best: CalibratedTheta, scored: Scores | None = None, plan: CalibrationPlan | None = None
) -> dict[str, Any]:
    """What `theta.json` holds: the recommended θ, what it left over, and where it is known the posterior of θ.

    The posterior is a list of weighted θ, each complete. If the uncalibrated θ is recommended, `calibrated` has θ* and
    `recommended` is 'uncalibrated', so that predictions do not draw from the posterior unless they are asked to.

    Args:
        best: by the calibration.
        scored: θ* on the weighed pours; None: the rest is unknown.
        plan: of the calibration, whose scenes the residual belongs to.
    """
    theta = best.theta.model_dump()
    data: dict[str, Any] = {"theta": recommended_theta(best.theta, scored).model_dump()}
    if scored is not None and scored.gain is not None:
        data |= {"recommended": scored.gain.recommended, "why": scored.gain.text}
        if scored.gain.recommended == UNCALIBRATED:
            data["calibrated"] = theta
    left = None if scored is None else calibration_residual(plan, scored, len(best.searched))
    if left is not None:
        data["remaining_discrepancy"] = {"shift": left.shift, "scenes": list(left.scenes)}
    if best.posterior is not None:
        draws = best.posterior.thetas
        thinned = draws[:: max(len(draws) // KEPT_THETAS, 1)]
        data["posterior"] = [{"theta": theta | values, "weight": 1.0 / len(thinned)} for values in thinned]
    return data
