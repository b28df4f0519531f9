"""What all verbs share: reading a campaign, running one in front of a person."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.commands.speaking import (
    BAD_INPUT,
    FAILED,
    INTERRUPTED,
    RefusalError,
    Refused,
    is_quiet,
    mention,
    say,
    stdout_for_results,
)
from orchestrator.commands.waiting import Waiting

if TYPE_CHECKING:
    from actors.protocols import Laboratory
    from orchestrator.monitor.live import LiveView
    from orchestrator.monitor.monitor import RerunMonitor
    from orchestrator.plan import CampaignPlan
    from orchestrator.publish import Published
    from orchestrator.run_result import CampaignResult
    from orchestrator.stages import StageDefinition


def read_campaign(path: Path, laboratory: Path | None = None, seed: int | None = None) -> CampaignPlan:
    """A campaign's plan, on another laboratory or with another seed if one is given.

    Raises:
        RefusalError: with all problems of its files, exit code 2.
    """
    from orchestrator.config.load import load_campaign
    from orchestrator.config.yaml.errors import ConfigError

    with Refused(ConfigError):
        return load_campaign(path, laboratory, seed)


def check_campaign_can_run(plan: CampaignPlan, *, as_written: bool = True) -> None:
    """Vessels (those of the campaign's file, or others), loads and motions, before anything starts.

    Raises:
        RefusalError: with everything that is wrong, exit code 2.
    """
    from orchestrator.jobs import JobError, check_job

    warned: list[str] = []
    try:
        with Refused(JobError), Waiting() as doing:
            check_job(
                plan, as_written=as_written, warn=lambda problem: warned.append(f"warning: {problem}"), doing=doing
            )
    finally:
        for text in dict.fromkeys(warned):
            mention(text)


def check_laboratory_answers(
    plan: CampaignPlan, stages: Sequence[StageDefinition], *, in_process: bool, brief: bool = False
) -> None:
    """What the laboratory needs, here and from other machines, before anything starts.

    Args:
        plan: with its laboratory.
        stages: that are to run.
        in_process: everything in this process: no other machine is needed.
        brief: see `actors.laboratory.open_laboratory`.

    Raises:
        RefusalError: with what is missing, exit code 2.
    """
    from actors.laboratory import check_laboratory
    from actors.protocols import LaboratoryError

    laboratory = replace(plan.laboratory, in_process=in_process or plan.laboratory.in_process)
    if laboratory.ray is not None and not laboratory.in_process:
        mention(f"looking at the Ray cluster at {laboratory.ray.address} …")
    with Refused(LaboratoryError):
        check_laboratory(laboratory, need_bench=any(stage.pours for stage in stages), brief=brief)


def check_output(path: Path | None, option: str, suffix: str) -> None:
    """A file that a command is to write, before hours are spent on what goes into it.

    Raises:
        RefusalError: it can't be written there, or has the wrong suffix (exit code 2).
    """
    from orchestrator.config.yaml.files import why_unreadable

    if path is None:
        return
    folder = path.absolute().parent
    if why_unreadable(path) == "is a directory; name a file in it":
        problem = "is a folder; name a file in it"
    elif path.suffix.lower() != suffix:
        problem = f"should end in {suffix}"
    elif not folder.is_dir():
        problem = "its folder does not exist"
    elif (why := _why_not_opened(path)) is not None:
        problem = f"can't be written: {why}"
    else:
        return
    raise RefusalError(f"{option} {path}: {problem}", BAD_INPUT)


def _why_not_opened(path: Path) -> str | None:
    """Found out by opening it: permissions don't tell of full disks, names too long, and folders of the system."""
    from orchestrator.config.yaml.files import why_unreadable

    there = why_unreadable(path) != "no such file"
    try:
        with path.open("ab"):
            pass
        if not there:
            path.unlink()
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return None


@dataclass(frozen=True)
class Finished:
    """A campaign that ran to its end, and what was written about it."""

    result: CampaignResult
    published: Published


def run_in_front_of_people(
    plan: CampaignPlan,
    directory: Path,
    *,
    resume: bool,
    stages: Sequence[StageDefinition] | None = None,
    in_process: bool = False,
    brief: bool = False,
    again: str,
    not_resumed: str = "",
    answer: str | None = None,
    checksum: str | None = None,
    live: LiveView | None = None,
) -> Finished:
    """Run a campaign with a live display, a recording, figures and a summary.

    Args:
        directory: of the run.
        stages: in place of the plan's.
        in_process: everything in this process, without Ray (slower; for debugging).
        brief: see `actors.laboratory.open_laboratory`.
        again: the command that resumes, for the message after an interruption; or that begins anew …
        not_resumed: … where nothing resumes: what is not, and what of it is kept.
        answer: what came of a pour that was under way when the run died; else a person at the terminal is asked.
        checksum: of the safety settings that people have accepted for the controller of hardware.
        live: view to open while it runs.

    Raises:
        RefusalError: it failed, was interrupted, or needs a person.
    """
    from actors.laboratory import open_laboratory
    from actors.protocols import LaboratoryError
    from orchestrator.campaign import run_campaign
    from orchestrator.commands.interrupted import (
        file_trouble,
        finished_without_report,
        given_up_pours,
        interruption,
        report_of_what_stands,
    )
    from orchestrator.commands.people import asked_about_unknown_pours, person_at_the_terminal
    from orchestrator.errors import RunError
    from orchestrator.events import Watcher
    from orchestrator.monitor.live import can_record, recorder_of
    from orchestrator.progress import ProgressDisplay
    from orchestrator.publish import not_simulated, publish
    from orchestrator.report.table import print_summary
    from orchestrator.stages import stages_of

    chosen = tuple(stages_of(plan) if stages is None else stages)
    pouring = any(stage.pours for stage in chosen)
    spec = replace(
        plan.laboratory, in_process=in_process or plan.laboratory.in_process, accepted_checksum=checksum or ""
    )
    mention(f"run {directory}  ({spec.mode} bench)" if pouring else f"run {directory}")
    if not resume:
        for line in not_simulated(plan, say):
            mention(line)
    monitor: RerunMonitor | None = None
    result: CampaignResult | None = None
    try:
        display = ProgressDisplay(plan, quiet=is_quiet())
        operator = person_at_the_terminal(spec, display.paused) if pouring else None
        laboratory = open_laboratory(spec, need_bench=pouring, brief=brief, operator=operator)
        if live is not None and can_record(plan):
            mention(f"live view: {live.open()}")
        monitor = recorder_of(plan, directory, say, live)
        with display:
            watchers: list[Watcher] = [display, *([monitor] if monitor is not None else [])]

            async def work(laboratory: Laboratory) -> CampaignResult:
                return await run_campaign(
                    plan,
                    laboratory,
                    directory,
                    resume=resume,
                    watchers=watchers,
                    ask_operator=asked_about_unknown_pours(answer),
                    stages=chosen,
                )

            with stdout_for_results():
                result = asyncio.run(_until_signalled(lambda: work(laboratory), resumable=not not_resumed))
    except (RunError, LaboratoryError) as error:
        problem = getattr(error, "problem", error) if not_resumed else error
        way_on = _way_on(directory, again, not_resumed)
        raise RefusalError(f"{problem}{way_on}", getattr(error, "exit_code", FAILED)) from None
    except OSError as error:
        if error.errno is None:
            raise  # not a file's: a defect, which wants its traceback
        raise RefusalError(f"{file_trouble(error, directory)}{_way_on(directory, again, not_resumed)}") from None
    except (asyncio.CancelledError, KeyboardInterrupt):
        if done := finished_without_report(directory):
            way_on = done
        elif not_resumed:
            unknown = "".join(
                f" while {pour} was under way: what it poured is unknown" for pour in given_up_pours(directory)
            )
            way_on = unknown + _way_on(directory, again, not_resumed)
        else:
            way_on = interruption(directory, plan, again)
        raise RefusalError(f"interrupted{way_on}", INTERRUPTED) from None
    finally:
        if result is None:
            if monitor is not None:
                monitor.close()
            if live is not None:
                live.close()
            if (page := report_of_what_stands(plan, directory)) is not None:
                mention(f"report of what stands  {page}")
    try:
        if monitor is not None:
            monitor.close()
        if live is not None:
            live.close()
        published = publish(plan, result, monitor)
        print_summary(plan, published.summary)
    except KeyboardInterrupt:
        raise RefusalError(f"interrupted{finished_without_report(directory)}", INTERRUPTED) from None
    if published.report is not None:
        mention(f"report  {published.report}")
    return Finished(result, published)


def _way_on(directory: Path, again: str, not_resumed: str) -> str:
    from orchestrator.journal import JOURNAL_NAME

    if not (directory / JOURNAL_NAME).is_file():
        return "\nnothing had begun"
    return f"\n{not_resumed} is in {directory}. {again}" if not_resumed else f"\nwhat is done so far is kept: {again}"


async def _until_signalled(work: Callable[[], Awaitable[CampaignResult]], *, resumable: bool) -> CampaignResult:
    """Run; a first SIGINT, SIGTERM or SIGHUP pauses at the next safe point, a second gives up what is under way."""
    begun = "a pour that has begun"
    task = asyncio.ensure_future(work())
    asked = 0

    def stop() -> None:
        nonlocal asked
        asked += 1
        if asked == 1:
            doing = "pausing" if resumable else "ending"
            say(f"\n{doing}: {begun} is finished and weighed first; once more to give it up")
        else:
            left = (
                "will have to be accounted for on resume" if resumable else "stays unknown: weigh by hand what can be"
            )
            say(f"\nstopping now; {begun} {left}")
        task.cancel()

    loop = asyncio.get_running_loop()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last one: its terminal was closed
    for number in numbers:
        loop.add_signal_handler(number, stop)
    try:
        return await task
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
