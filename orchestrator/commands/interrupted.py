"""What a run that was interrupted or broke off leaves behind, and what to do about it, in words."""

from __future__ import annotations

import contextlib
import errno
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orchestrator.plan import CampaignPlan


def interruption(directory: Path, plan: CampaignPlan, again: str) -> str:
    """Follows 'interrupted': that nothing is lost, or what may be.

    Args:
        directory: of the run, which can be resumed.
        plan: of its campaign.
        again: the command that resumes.
    """
    pours = given_up_pours(directory)
    if not pours:
        return f"; nothing is lost. Go on with: {again}"
    what = " and ".join(pours)
    if plan.laboratory.mode != "virtual":
        rescue = (
            "What it poured is lost unless you weigh it now: wait until the arm stands still, move nothing else, and "
            "weigh what was spilled and what is left in the pourer. Resuming asks what came of it: "
            "'weighed SPILLED RETAINED' (in grams) or 'lost'"
        )
    elif plan.on_unknown == "repeat":
        rescue = "Resuming pours it again with the same chance, as 'on_unknown: repeat' says"
    else:
        rescue = "Resuming asks what came of it: on a virtual bench 'repeat' pours it again with the same chance"
    return (
        f" while {what} was under way: it was given up, and nobody knows what came of it. {rescue}. Everything "
        f"before it is kept. Go on with: {again}"
    )


def finished_without_report(directory: Path) -> str:
    """Follows 'interrupted' if all stages of a run are done and its results may not be published; empty otherwise."""
    from orchestrator.journal import JOURNAL_NAME, JournalReader
    from orchestrator.journal_file import JournalError
    from orchestrator.states import State

    with contextlib.suppress(JournalError), JournalReader(directory / JOURNAL_NAME) as journal:
        if journal.state() is State.FINISHED:
            return (
                " after the last stage, while the results were written; the run is finished, and nothing is lost. "
                f"Write its summary, figures and report with: decant report {directory}"
            )
    return ""


def given_up_pours(directory: Path) -> list[str]:
    """Pours of a run that had begun and have no outcome: 'pour 3 of stage deployment:narrow'."""
    from orchestrator.journal import JOURNAL_NAME, JournalReader, Kind
    from orchestrator.journal_file import JournalError
    from orchestrator.replay import read_history
    from orchestrator.requests import Pour

    found: list[str] = []
    with contextlib.suppress(JournalError), JournalReader(directory / JOURNAL_NAME) as journal:
        for stage in [entry.stage for entry in journal.entries(kinds=[Kind.STAGE_OPENED])]:
            history = read_history(journal, stage)
            for key in history.unknown_pours():
                request = history.request(key)
                assert isinstance(request, Pour)
                found.append(f"pour {request.number} of stage {stage}")
    return found


def report_of_what_stands(plan: CampaignPlan, directory: Path) -> Path | None:
    """Write the report of a run that was interrupted or broke off; None where there is nothing to report on.

    Whatever goes wrong with it, a further Ctrl-C too, is no reason to say less about the run itself.
    """
    from orchestrator.codec import digest
    from orchestrator.fingerprint import fingerprint
    from orchestrator.journal import JOURNAL_NAME, JournalReader
    from orchestrator.publish import FIGURES, summary_of, write_report
    from orchestrator.report.campaign import draw_figures
    from orchestrator.report.run_page import REPORT_NAME
    from orchestrator.run_result import read_result

    with contextlib.suppress(Exception, KeyboardInterrupt), JournalReader(directory / JOURNAL_NAME) as journal:
        if digest(journal.header.fingerprint) != digest(fingerprint(plan)):
            return None  # it was refused, since this is another campaign
        result = read_result(journal, directory)
        figures = draw_figures(directory / FIGURES, plan, result.results) if plan.outputs.figures else {}
        return write_report(directory / REPORT_NAME, plan, summary_of(plan, result, figures), directory)
    return None


def file_trouble(error: OSError, directory: Path) -> str:
    """What went wrong with a file of a run: which one, and how much room there should be where the disk is full."""
    from orchestrator.reserve import MB, TO_BEGIN, free_space

    where = error.filename or directory
    text = f"{where}: {error.strerror}"
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return text
    return (
        f"{text}; {free_space(directory) / MB:.1f} MB are free there. A run needs {TO_BEGIN / MB:.0f} MB to begin, and "
        "more for long ones with recordings"
    )
