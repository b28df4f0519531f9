"""Runs the cells of a study in child processes: `python -m orchestrator.study.study_runner STUDY.yaml` is one.

- `run_cells` starts each cell as soon as the cells that it needs are finished, several at a time. `CellStatus` is the
  progress. `LocalCells` runs the cells in child processes (`CellProcess`).
- `work` is the loop of a child process. Each line of its stdin names a cell, each line of its stdout is the JSON list
  [cell, error or null]. The process and its simulator are kept, since starting Python, Taichi and its kernels takes
  longer than a small cell.
- A child process ends with its stdin, also during a cell. The cell's journal has its progress, and the next process
  continues it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import ChildProcess, python_module
from actors.simulators.local_worker import thread_pool
from orchestrator.learning.run_errors import RunError
from orchestrator.records.run_record import read_record
from orchestrator.runs.run_service import RunResources, RunService
from orchestrator.runs.stages import CALIBRATION
from orchestrator.study.study_campaigns import campaign_of
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import (
    LOG,
    CellResult,
    code_now,
    is_finished,
    read_result,
    run_folder,
    write_result,
)
from orchestrator.study.study_plan import StudyCell, StudyPlan, cells_of, estimated_seconds

WAKE = 0.1
"""Interval at which the cells' processes are polled [s]."""

GRACE = 10.0
"""Time that a cell's process has to end after a request to end [s]."""


@dataclass
class CellStatus:
    """Progress of a study.

    Attributes:
        finished, failed, running: ids of cells. `skipped`: cells that need a failed one.
        cost_left, cost_done: estimated CPU seconds of the remaining cells, and of those that this process has finished.
        seconds: time since this process began.
    """

    cells: int
    finished: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: set[str] = field(default_factory=set)
    running: set[str] = field(default_factory=set)
    cost_left: float = 0.0
    cost_done: float = 0.0
    seconds: float = 0.0

    def seconds_left(self, jobs: int) -> float:
        """Rough remaining time [s]: by the estimate until a cell is finished, then by the measured speed."""
        if self.cost_done <= 0.0:
            return self.cost_left / max(jobs, 1)
        return self.cost_left * self.seconds / self.cost_done


Watch = Callable[[CellStatus], None]


def cell_command(study: StudyPlan) -> list[str]:
    """Command that runs cells in a separate process."""
    return python_module("orchestrator.study.study_runner", str(study.source))


class CellProcess:
    """A process that runs cells, one at a time.

    Args:
        command: command of the process; see `work` for its input and output.
        log: file for its other output.

    Attributes:
        cell: the running cell.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self._log = log
        with log.open("wb") as errors:
            self.child = ChildProcess(command, errors=errors)
        self.cell: StudyCell | None = None

    def begin(self, cell: StudyCell) -> None:
        """Start a cell in the process."""
        self.cell = cell
        with contextlib.suppress(BrokenPipeError):  # the process has died; `ended` reports it
            self.child.write(f"{cell.id}\n".encode())

    def ended(self) -> tuple[StudyCell, str | None] | None:
        """The cell that has just ended, if any, and its error."""
        if self.cell is None:
            return None
        dead = self.dead  # before the last read of its output
        line = None
        with contextlib.suppress(TimeoutError, EOFError):
            line = self.child.read_line(0.0)
        if line is None and not dead:
            return None
        cell, self.cell = self.cell, None
        return cell, last_words(self._log) if line is None else json.loads(line)[1]

    @property
    def dead(self) -> bool:
        """Whether the process has ended."""
        return not self.child.alive

    def close(self) -> None:
        """Close the pipes of the process."""
        self.child.release()


class LocalCells:
    """Runs cells in child processes, several at a time. When they are ended, the cells' journals contain their
    progress.

    Args:
        study: the study.
        folder: folder of the study.
        jobs: number of processes.
        command: command of a process.
    """

    def __init__(
        self,
        study: StudyPlan,
        folder: Path,
        jobs: int,
        command: Callable[[StudyPlan], list[str]] = cell_command,
    ) -> None:
        self._study, self._folder, self._command = study, folder, command
        self.slots = max(jobs, 1)
        self._processes: list[CellProcess] = []
        self._started = 0

    def begin(self, cell: StudyCell) -> None:
        """Start a cell. Does not wait."""
        idle = next((process for process in self._processes if process.cell is None), None)
        if idle is None:
            self._started += 1
            idle = CellProcess(self._command(self._study), self._folder / LOG.format(self._started))
            self._processes.append(idle)
        idle.begin(cell)

    def ended(self) -> Iterator[tuple[StudyCell, str | None]]:
        """The cells that have ended since the last call, with their errors. Does not wait."""
        for process in list(self._processes):
            if (end := process.ended()) is not None:
                yield end
            if process.dead:
                process.close()
                self._processes.remove(process)

    def close(self) -> None:
        """End the cells that run."""
        _end(self._processes)


def run_cells(study: StudyPlan, folder: Path, workers: LocalCells, *, watch: Watch = lambda status: None) -> CellStatus:
    """Run all cells that are not finished. A failed cell is recorded, and the others continue.

    On an interrupt (KeyboardInterrupt) the workers are closed first.

    Args:
        folder: folder of the study, locked by this process.
        workers: run the cells; they are closed at the end.
    """
    cells = cells_of(study)
    cost = {cell.id: estimated_seconds(study, cell) for cell in cells}
    status = CellStatus(len(cells), {cell.id for cell in cells if is_finished(folder, cell.id)})
    waiting = [cell for cell in cells if cell.id not in status.finished]
    status.cost_left = sum(cost[cell.id] for cell in waiting)
    begun = time.monotonic()
    watch(status)
    try:
        while waiting or status.running:
            _skip(waiting, status)
            ready = [cell for cell in waiting if status.finished.issuperset(cell.needs)]
            for cell in ready[: max(workers.slots - len(status.running), 0)]:
                waiting.remove(cell)
                workers.begin(cell)
                status.running.add(cell.id)
            for cell, problem in workers.ended():
                _note(cell, problem, folder, cost, status)
            status.seconds = time.monotonic() - begun
            watch(status)
            if status.running:
                time.sleep(WAKE)
    finally:
        workers.close()
    return status


def _note(cell: StudyCell, problem: str | None, folder: Path, cost: dict[str, float], status: CellStatus) -> None:
    status.running.discard(cell.id)
    status.cost_left -= cost[cell.id]
    if is_finished(folder, cell.id):
        status.finished.add(cell.id)
        status.cost_done += cost[cell.id]
    else:
        status.failed[cell.id] = problem or "it ended without a result"


def last_words(log: Path) -> str:
    """Last line of a cell's log."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        return "its process ended without a word"
    return lines[-1] if lines else "its process ended without a word"


def _skip(waiting: list[StudyCell], status: CellStatus) -> None:
    """Skip the cells that need a failed or skipped one."""
    for cell in list(waiting):
        if any(need in status.failed or need in status.skipped for need in cell.needs):
            waiting.remove(cell)
            status.skipped.add(cell.id)


def _end(processes: Iterable[CellProcess]) -> None:
    mine = list(processes)
    for process in mine:
        if process.cell is None:
            process.child.close_input()  # it ends by itself, and its compiled kernels reach their cache
        else:
            process.child.terminate()
    deadline = time.monotonic() + GRACE
    for process in mine:
        if not process.child.wait(max(deadline - time.monotonic(), 0.1)):
            process.child.kill()
        process.close()


def run_cell(study: StudyPlan, cell: StudyCell, folder: Path, resources: RunResources) -> CellResult:
    """Run a cell, or continue it, and write its result.

    Args:
        folder: folder of the study.
        resources: shared by all cells of a process.

    Raises:
        RunError: it can't begin or go on.
        LaboratoryError: its laboratory can't be opened.
    """
    directory = run_folder(folder, cell.id)
    request = campaign_of(study, cell, lambda other: read_result(folder, other).results, directory)
    directory.mkdir(parents=True, exist_ok=True)
    handle = RunService().start(request, resources)
    result = asyncio.run(handle.wait())
    cell_result = CellResult(
        results=dict(result.results),
        simulations=result.simulations,
        pours=result.pours,
        cpu_s=result.cpu_s,
        seconds=result.seconds,
        expected=tuple(_expected(directory)) if cell.strategy.startswith("C4") else (),
        code=code_now(),
    )
    write_result(folder, cell.id, cell_result)
    return cell_result


def _expected(directory: Path) -> list[tuple[int, float]]:
    """For each θ that C4 chose: simulations requested until then, and the mean |Δ| that its surrogate expected."""
    decisions = [d for d in read_record(directory).decisions if d.stage == CALIBRATION and "mean" in d.values]
    return [(d.simulations_asked, d.values["mean"]) for d in decisions]


def named_cells() -> Iterator[str]:
    """The lines of stdin, until it ends; during a cell, this process ends with it."""
    names: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    idle, over = threading.Event(), threading.Event()

    def read() -> None:
        with os.fdopen(0, "r", encoding="utf-8", closefd=False) as lines:
            for line in lines:
                names.put(line.strip())
        over.set()
        if not idle.is_set():
            os._exit(1)
        names.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        idle.set()
        name = names.get()
        idle.clear()
        if name is None or over.is_set():
            return
        yield name


def work(path: Path, resources: RunResources | None = None) -> None:
    """Run the cells that stdin names until it ends.

    Args:
        path: path of the study's file.
        resources: by default, one simulator in this process.
    """
    # Libraries print to stdout, which is only for answers: from here on they print to the log.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    code_now()  # of the sources that this process has read, before they change
    study = load_study(path)
    cells = {cell.id: cell for cell in cells_of(study)}
    simulators = thread_pool()
    resources = resources or RunResources(in_process=True, simulators=simulators)
    for name in named_cells():
        problem = None
        try:
            run_cell(study, cells[name], study.folder, resources)
        except (RunError, LaboratoryError) as error:
            problem = str(error)
        print(json.dumps([name, problem]), file=answers, flush=True)
    asyncio.run(simulators.close())  # compiled kernels reach their cache


if __name__ == "__main__":
    work(Path(sys.argv[1]))
