"""The command `decant study run`: a resumable comparison of strategies, with figures and a page."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import add_group
from orchestrator.cli.console import FAILED, INTERRUPTED, RefusalError, print_note
from sim_engine.settings.plugin_registry import FileKind

if TYPE_CHECKING:
    from orchestrator.study.study_plan import StudyCell, StudyPlan
    from orchestrator.study.study_runner import CellStatus, LocalCells
    from sim_engine.settings.model import Settings

SHOWN_FAILURES = 5


StudyPath = Annotated[Path, typer.Argument(help="Study file (YAML).", metavar="STUDY")]


def run_study(
    file: StudyPath,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of cells at a time; default: one per core.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the unfinished cells with an estimate of their cost; start nothing.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Start nothing; write figures, tables and the page from what is finished.")
    ] = False,
) -> None:
    """Compare C1 to C4 and D1 to D3 with repetitions, on virtual benches that differ more or less from the simulator.

    Figures (PNG, SVG, CSV), tables and a page are written to study-NAME/report/ in the study's `directory`. Run the
    same command again to continue a study that was stopped or killed.
    """
    from orchestrator.study.study_folder import check_settings, opened
    from orchestrator.study.study_plan import cells_of
    from orchestrator.study.study_runner import LocalCells

    plan = read_study(file)
    cells = cells_of(plan)
    if dry_run:
        check_settings(plan)
        _print_remaining(plan, cells)
        return
    if report:
        with opened(plan) as folder:
            _report(plan, folder)
        return
    with opened(plan) as folder:
        status = _run(plan, folder, LocalCells(plan, folder, jobs or os.cpu_count() or 1), file)
        _report(plan, folder)
    if status.failed:
        shown = list(status.failed.items())[:SHOWN_FAILURES]
        lines = [f"{len(status.failed)} of {len(cells)} cells failed, {len(status.skipped)} need one of them:"]
        lines += [f"  {name}: {why}" for name, why in shown]
        lines.append(f"finished cells are kept; correct that and continue with: decant study run {file}")
        raise RefusalError("\n".join(lines), FAILED)


def read_study(path: Path) -> StudyPlan:
    """Load a study, build its vessels and check its actions.

    Raises:
        ConfigError, RunTaskError: the files are invalid; lists all problems.
    """
    from dataclasses import replace

    from orchestrator.cli.foreground_run import check_campaign_can_run
    from orchestrator.runs.run_service import RunRequest
    from orchestrator.study.study_file import load_study

    plan = load_study(path)
    deployment = None
    if plan.deployments:  # the cells use draws of θ from the calibration cells
        deployment = replace(plan.deployments[0].plan, thetas=(plan.base.parameters,))
    check_campaign_can_run(RunRequest(replace(plan.base, source=plan.source, deployment=deployment), ()))
    return plan


def _print_remaining(plan: StudyPlan, cells: tuple[StudyCell, ...]) -> None:
    from orchestrator.learning.strategy import plural
    from orchestrator.study.study_folder import is_finished
    from orchestrator.study.study_plan import estimated_seconds

    left = [cell for cell in cells if not is_finished(plan.folder, cell.id)]
    simulations, pours = sum(cell.simulations for cell in left), sum(cell.pours for cell in left)
    hours = sum(estimated_seconds(plan, cell) for cell in left) / 3600
    groups: dict[str, list[StudyCell]] = {}
    for cell in cells:
        groups.setdefault(" ".join(filter(None, (cell.kind, cell.level, cell.strategy))), []).append(cell)
    missing = {cell.id for cell in left}
    for name, members in groups.items():
        todo = [cell for cell in members if cell.id in missing]
        text = f"{len(members) - len(todo)} of {len(members)} finished"
        if todo:
            text += f", left: {plural(sum(c.simulations for c in todo), 'simulation')}, "
            text += plural(sum(c.pours for c in todo), "pour")
        print(f"{name:34} {text}")
    print(
        f"{plural(len(cells), 'cell')}, {len(left)} left: {plural(simulations, 'simulation')} and "
        f"{plural(pours, 'pour')}, some {hours:.2g} CPU hours (good to a factor of two; D3 simulates more while no "
        "simulation is good). Nothing was started."
    )


def _run(plan: StudyPlan, folder: Path, workers: LocalCells, path: Path) -> CellStatus:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    from orchestrator.study.study_folder import code_warning, finished_results
    from orchestrator.study.study_plan import cells_of
    from orchestrator.study.study_runner import run_cells

    cells = cells_of(plan)
    finished = finished_results(folder, cells)
    if len(finished) < len(cells) and (text := code_warning(finished)) is not None:
        print_note(text)
    print_note(f"study {folder}, {workers.slots} at a time")
    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[left]}")]
    try:
        with Progress(*columns, console=Console(stderr=True)) as bar, _ending_like_ctrl_c():
            task = bar.add_task("cells", left="")

            def watch(status: CellStatus) -> None:
                ended = len(status.finished) + len(status.failed) + len(status.skipped)
                text = f"about {_duration(status.seconds_left(workers.slots))} left" if status.running else ""
                bar.update(task, total=status.cells, completed=ended, left=text)

            return run_cells(plan, folder, workers, watch=watch)
    except KeyboardInterrupt:
        raise RefusalError(
            f"interrupted; nothing is lost. Continue with: decant study run {path}", INTERRUPTED
        ) from None


@contextlib.contextmanager
def _ending_like_ctrl_c() -> Iterator[None]:
    """Handle SIGTERM and SIGHUP like Ctrl-C while cells run."""

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{max(minutes, 1)} min"


def _report(plan: StudyPlan, folder: Path) -> None:
    from orchestrator.study.study_page import write_report

    print_note(f"figures, tables and a page: {write_report(plan, folder)}")


def _settings() -> type[Settings]:
    from orchestrator.study.study_file import StudyFile

    return StudyFile


def _check(path: Path) -> tuple[str, list[str]]:
    from orchestrator.study.study_file import load_study
    from orchestrator.study.study_plan import cells_of

    study = load_study(path)
    return f"study, {len(cells_of(study))} cells, seed {study.seed}", []


STUDY_FILE = FileKind(_settings, _check)
"""Study files, for `decant validate` and `decant schema`."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    add = add_group(
        app,
        "study",
        "Compare strategies with repetitions, on virtual benches that differ from the simulator.",
        "decant study run configs/studies/quick.yaml",
        "decant study run configs/studies/quick.yaml --report   # again, from the results that there are",
        quiet=True,
    )
    add(
        run_study,
        "decant study run configs/studies/quick.yaml",
        "decant study run configs/studies/paper.yaml --dry-run   # estimate the cost",
        "decant study run configs/studies/paper.yaml --jobs 2    # continues a stopped study",
        name="run",
    )
