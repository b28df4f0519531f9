"""Runs of the commands: reads a campaign, runs a task in the foreground, and ends the command with its verdict.

- `read_campaign` and `read_draws` read the files of a command; `check_campaign_can_run` refuses a run before it starts.
- `run_at_terminal` runs a task. After an interruption or a failure it prints the next command.
- `resources_with_operator` selects the answerer of questions: the operator at the terminal, or none.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import signal
import sys
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from actors.arm.arm_interface import PathReport
from actors.interfaces import LaboratoryError
from orchestrator.campaigns.file_loading import load_campaign, load_posterior, predicts_with_posterior
from orchestrator.catalogue.catalogue import posterior_source
from orchestrator.cli.console import (
    FAILED,
    INTERRUPTED,
    NOT_COMPLETE,
    RefusalError,
    Refused,
    WaitingIndicator,
    is_quiet,
    print_message,
    print_note,
    print_warning,
    stdout_for_results,
)
from orchestrator.cli.motion_control import consent_to_motion
from orchestrator.cli.terminal_operator import TerminalOperator, somebody_at_the_terminal
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.live_view.live_server import LiveView
from orchestrator.live_view.rerun_subscriber import RerunMonitor, can_record, recorder_of
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_file import MB, TO_BEGIN, JournalError, free_space
from orchestrator.records.run_record import CampaignResult, read_record, read_result
from orchestrator.records.states import State
from orchestrator.runs.resume import AskOperator, Facts, shown_fact
from orchestrator.runs.run_folder import RESOLVED, create_run, find_run
from orchestrator.runs.run_service import RunHandle, RunRequest, RunResources, RunService

if TYPE_CHECKING:
    from orchestrator.records.verdict import Verdict
    from orchestrator.reports.publishing import Published
    from sim_engine.liquids import SimulationParameters


def read_campaign(
    path: Path,
    laboratory: Path | None = None,
    seed: int | None = None,
    resumed: Callable[[CampaignPlan], Path] | None = None,
) -> CampaignPlan:
    """A campaign's plan, on another laboratory or with another seed if one is given.

    Args:
        path: of its file.
        laboratory: of another laboratory.
        seed: another one.
        resumed: finds the run that is resumed; its prior from earlier campaigns is kept.

    Raises:
        ConfigError: with all problems of its files.
    """
    plan = load_campaign(path, laboratory, seed, posteriors=posterior_source)
    if resumed is None or plan.memory is None:
        return plan
    memory = load_campaign(resumed(plan) / RESOLVED).memory
    return load_campaign(path, laboratory, seed, memory=memory)


def read_draws(
    parameters: Path | None, thetas: int | None, seeds: int, base: SimulationParameters
) -> tuple[SimulationParameters, ...]:
    """Draws of the posterior of θ that predictions use in turn, as requested on the command line; empty: θ alone.

    Args:
        parameters: theta.json of a calibration, or the user's own file; None: the campaign's θ.
        thetas: number of draws; None: as many as `seeds` if the file has a posterior and recommends the calibrated θ;
            0: θ alone.
        seeds: simulations of a pour.
        base: values of θ that the file does not contain.

    Raises:
        ConfigError, RefusalError: the file is invalid, or it lacks the requested posterior.
    """
    if parameters is None:
        if thetas:
            raise RefusalError(f"--thetas {thetas}: goes with --parameters, the theta.json of a calibration")
        return ()
    if thetas is None:
        thetas = seeds if predicts_with_posterior(parameters) else 0
    return load_posterior(parameters, thetas, base) if thetas else ()


def check_campaign_can_run(request: RunRequest) -> None:
    """Vessels, loads and motions of a campaign, before anything starts; its warnings are shown.

    Raises:
        RunTaskError: with every problem.
    """
    memory = request.campaign.memory
    for line in () if memory is None else memory.lines:
        print_note(line)
    with WaitingIndicator() as doing:
        report = RunService().check(request, doing=doing)
    for text in report.warnings:
        print_warning(text)
    report.require()


def check_laboratory_answers(request: RunRequest, resources: RunResources) -> None:
    """The requirements of the laboratory, on this machine and on others, before anything starts.

    Raises:
        RefusalError: something is missing (exit code 2).
    """
    laboratory = resources.settings(request.campaign)
    if laboratory.ray is not None and not laboratory.in_process:
        print_note(f"looking at the Ray cluster at {laboratory.ray.address} …")
    with Refused(LaboratoryError):
        RunService().check_laboratory(request, resources)


def resources_with_operator(
    request: RunRequest,
    *,
    in_process: bool,
    motion: tuple[str, PathReport | None] = ("", None),
    answer: str | None = None,
) -> RunResources:
    """Resources of a run that may pour: the operator's consent to its motion, and who answers questions.

    Args:
        request: of the run.
        in_process: see `RunResources`.
        motion: what the operator consents to, if hardware moves; see `consent_to_motion`.
        answer: outcome of a pour that was under way when the run died; None: a person at the terminal is asked.

    Raises:
        RefusalError: motion is not enabled, or the bench asks a person and there is no terminal (exit code 2).
    """
    checksum = consent_to_motion(request, *motion)
    laboratory, operator = request.campaign.laboratory, None
    if request.pours and laboratory.needs_person:
        if not somebody_at_the_terminal():
            raise RefusalError(
                f"laboratory {laboratory.name} asks a person (operator: answers: person), and there is no terminal to "
                "ask at; run this in a terminal, with nothing piped into it"
            )
        operator = TerminalOperator(laboratory.operator)
    ask = asked_about_unknown_pours(answer)
    return RunResources(in_process=in_process, approved_checksum=checksum, operator=operator, ask_operator=ask)


def resumed_run(plan: CampaignPlan, run_id: str | None) -> Path:
    """The folder of the run to go on with.

    Raises:
        RefusalError: there is none (exit code 2).
    """
    with Refused(RunError, OSError):
        return find_run(plan, run_id)


def new_run(plan: CampaignPlan) -> Path:
    """The folder of a new run.

    Raises:
        RefusalError: it can't be made (exit code 2).
    """
    try:
        return create_run(plan)
    except RunError as error:
        raise RefusalError(str(error)) from None
    except OSError as error:
        raise RefusalError(f"{plan.outputs.folder}: can't be written: {error.strerror}") from None


def run_at_terminal(
    request: RunRequest,
    resources: RunResources,
    *,
    again: Callable[[Path], str],
    not_resumed: str = "",
    live: LiveView | None = None,
) -> tuple[CampaignResult, Published]:
    """Run a task that was checked, with a live display, a recording, figures and a summary.

    Args:
        request: without a folder for a new run.
        resources: to run it with; display and recorder are added here.
        again: makes the command that resumes the run, or starts another one, from the folder of this one.
        not_resumed: for a run that can't be resumed: its name, and the part of it that is kept.
        live: view to open while it runs.

    Returns:
        The result of the run, and the files written about it.

    Raises:
        RefusalError: something is missing (exit code 2), it failed, was interrupted, or needs a person.
    """
    from orchestrator.reports.console_progress import ProgressDisplay
    from orchestrator.reports.console_view import print_summary
    from orchestrator.reports.publishing import publish_run
    from orchestrator.reports.validity_warnings import not_simulated

    check_laboratory_answers(request, resources)
    plan, directory = request.campaign, request.folder or new_run(request.campaign)
    print_note(f"run {directory}  ({plan.laboratory.mode} bench)" if request.pours else f"run {directory}")
    if not request.resume:
        for line in not_simulated(plan, print_message):
            print_note(line)

    def recorder(plan: CampaignPlan, run: Path) -> RerunMonitor | None:
        if live is not None and can_record(plan):
            print_note(f"live view: {live.open()}")
        return recorder_of(plan, run, print_message, "" if live is None else live.stream)

    handle: RunHandle | None = None
    result: CampaignResult | None = None
    try:
        display = ProgressDisplay(plan, quiet=is_quiet())
        if isinstance(resources.operator, TerminalOperator):
            resources.operator.paused = display.paused
        handle = RunService().start(
            replace(request, folder=directory), replace(resources, subscribers=[display], recorder=recorder)
        )
        with display, stdout_for_results():
            result = asyncio.run(_until_signalled(handle.wait, resumable=not not_resumed))
    except (RunError, LaboratoryError) as error:
        problem = getattr(error, "problem", error) if not_resumed else error
        way_on = _way_on(directory, again(directory), not_resumed)
        raise RefusalError(f"{problem}{way_on}", error.exit_code) from None
    except OSError as error:
        if error.errno is None:
            raise  # not a file's: a defect, which wants its traceback
        way_on = _way_on(directory, again(directory), not_resumed)
        raise RefusalError(f"{file_trouble(error, directory)}{way_on}", FAILED) from None
    except (asyncio.CancelledError, KeyboardInterrupt):
        way_on = _after_interruption(directory, plan, again(directory), not_resumed)
        raise RefusalError(f"interrupted{way_on}", INTERRUPTED) from None
    finally:
        if result is None:
            _close(handle, live)
            if handle is not None and (page := report_of_what_stands(handle)) is not None:
                print_note(f"report of what stands  {page}")
    try:
        _close(handle, live)
        published = publish_run(handle)
        print_summary(published.summary)
    except KeyboardInterrupt:
        raise RefusalError(f"interrupted{finished_without_report(directory)}", INTERRUPTED) from None
    if published.report is not None:
        print_note(f"report  {published.report}")
    return result, published


def conclude(verdict: Verdict) -> None:
    """Print what a run reached as the last line of a command. Exits with code 4 unless that is all that was wanted."""
    if verdict.word == "complete":
        print_note(verdict.text)
        return
    for goal in verdict.unmet:
        print_message(goal.line)
    print_message(verdict.text)
    raise SystemExit(NOT_COMPLETE)


def _close(handle: RunHandle | None, live: LiveView | None) -> None:
    if handle is not None:
        handle.close()
    if live is not None:
        live.close()


def _way_on(directory: Path, again: str, not_resumed: str) -> str:
    if not (directory / JOURNAL_NAME).is_file():
        return "\nnothing had begun"
    return f"\n{not_resumed} is in {directory}. {again}" if not_resumed else f"\nwhat is done so far is kept: {again}"


def _after_interruption(directory: Path, plan: CampaignPlan, again: str, not_resumed: str) -> str:
    """Follows 'interrupted': what is kept of a run, and how to go on."""
    if done := finished_without_report(directory):
        return done
    if not not_resumed:
        return interruption(directory, plan, again)
    unknown = [f" while {pour} was under way: what it poured is unknown" for pour in given_up_pours(directory)]
    return "".join(unknown) + _way_on(directory, again, not_resumed)


async def _until_signalled(work: Callable[[], Awaitable[CampaignResult]], *, resumable: bool) -> CampaignResult:
    """Run; a first SIGINT, SIGTERM or SIGHUP pauses at the next safe point, a second gives up what is under way."""
    begun = "a pour that has begun"
    task = asyncio.ensure_future(work())
    signals = 0

    def stop() -> None:
        nonlocal signals
        signals += 1
        if signals == 1:
            doing = "pausing" if resumable else "ending"
            print_message(f"\n{doing}: {begun} is finished and weighed first; once more to give it up")
        else:
            left = (
                "will have to be accounted for on resume" if resumable else "stays unknown: weigh by hand what can be"
            )
            print_message(f"\nstopping now; {begun} {left}")
        task.cancel()

    loop = asyncio.get_running_loop()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last one: its terminal was closed
    for number in numbers:
        loop.add_signal_handler(number, stop)
    try:
        result = await task
        if signals:
            print_message("the campaign had ended before: its results are written")
        return result
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)


def interruption(directory: Path, plan: CampaignPlan, again: str) -> str:
    """Follows 'interrupted': that nothing is lost, or what may be.

    Args:
        directory: of the run, which can be resumed.
        plan: of its campaign.
        again: the command that resumes.
    """
    pours = given_up_pours(directory)
    if not pours:
        return f"; nothing is lost. Continue with: {again}"
    lost = " and ".join(pours)
    if plan.laboratory.mode != "virtual":
        rescue = (
            "What it poured is lost unless you weigh it now: wait until the arm stands still, move nothing else, and "
            "weigh the spilled liquid and the liquid in the pourer. Resuming asks for its outcome: "
            "'weighed SPILLED RETAINED' (in grams) or 'lost'"
        )
    elif plan.on_unknown == "repeat":
        rescue = "Resuming pours it again with the same chance, as 'on_unknown: repeat' says"
    else:
        rescue = "Resuming asks for its outcome: on a virtual bench 'repeat' pours it again with the same chance"
    return (
        f" while {lost} was under way: it was abandoned, and its outcome is unknown. {rescue}. Everything "
        f"before it is kept. Continue with: {again}"
    )


def finished_without_report(directory: Path) -> str:
    """Follows 'interrupted' if all stages of a run are done and its results may not be published; empty otherwise."""
    with contextlib.suppress(JournalError):
        if read_record(directory).state is State.FINISHED:
            return (
                " after the last stage, while the results were written; the run is finished, and nothing is lost. "
                f"Write its summary, figures and report with: decant report {directory}"
            )
    return ""


def given_up_pours(directory: Path) -> list[str]:
    """Pours of a run that had begun and have no outcome: 'pour 3 of stage deployment:narrow'."""
    with contextlib.suppress(JournalError):
        return [f"pour {pour.request.number} of stage {pour.stage}" for pour in read_record(directory).unknown_pours]
    return []


def report_of_what_stands(handle: RunHandle) -> Path | None:
    """Write the report of a run that was interrupted or broke off; None if it was refused, or can't be reported on.

    Whatever goes wrong with it, a further Ctrl-C too, is no reason to say less about the run itself.
    """
    from orchestrator.reports.publishing import report_on

    with contextlib.suppress(Exception, KeyboardInterrupt):
        if handle.begun:
            plan = handle.campaign
            return report_on(plan, read_result(handle.folder), draw=plan.outputs.figures)[0]
    return None


def file_trouble(error: OSError, directory: Path) -> str:
    """What went wrong with a file of a run: which one, and how much room there should be where the disk is full."""
    where = error.filename or directory
    text = f"{where}: {error.strerror}"
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return text
    return (
        f"{text}; {free_space(directory) / MB:.1f} MB are free there. A run needs {TO_BEGIN / MB:.0f} MB to begin, and "
        "more for long ones with recordings"
    )


def asked_about_unknown_pours(answer: str | None) -> AskOperator | None:
    """Who is asked about a pour whose outcome is unknown: the command line, the terminal, or nobody."""
    if answer is not None:
        return lambda question, options, facts: answer
    return _ask_on_terminal if sys.stdin.isatty() else None


async def _ask_on_terminal(question: str, options: Sequence[str], facts: Facts) -> str:
    lines = [f"  {shown_fact(name):20s} {value}" for name, value in facts.items()]
    print_message("\n".join(["", question, *lines, f"  answer with one of: {' | '.join(options)}"]))
    return (await asyncio.to_thread(input, "> ")).strip()
