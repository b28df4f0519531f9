"""Runs the unfinished cells of a study in child processes.

`run_cells` starts each cell as soon as the cells that it needs are finished, several at a time. `CellProcess` is one
child process, `CellStatus` the progress. Cells themselves are executed in `cell_process`.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from actors.runtime.child_process import ChildProcess, python_module
from orchestrator.study.study_folder import LOG, is_finished
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
    return python_module("orchestrator.study.cell_process", str(study.source))


class CellProcess:
    """A process that runs cells, one at a time.

    Args:
        command: command of the process; see `orchestrator.study.cell_process` for its input and output.
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


def run_cells(
    study: StudyPlan,
    folder: Path,
    *,
    jobs: int,
    watch: Watch = lambda status: None,
    command: Callable[[StudyPlan], list[str]] = cell_command,
) -> CellStatus:
    """Run all cells that are not finished. A failed cell is recorded, and the others continue.

    On an interrupt (KeyboardInterrupt) the cells' processes are ended first; their journals contain the progress.

    Args:
        folder: folder of the study, locked by this process.
        jobs: number of cells at a time.
    """
    cells = cells_of(study)
    cost = {cell.id: estimated_seconds(study, cell) for cell in cells}
    status = CellStatus(len(cells), {cell.id for cell in cells if is_finished(folder, cell.id)})
    waiting = [cell for cell in cells if cell.id not in status.finished]
    status.cost_left = sum(cost[cell.id] for cell in waiting)
    processes: list[CellProcess] = []
    started = 0
    begun = time.monotonic()
    watch(status)
    try:
        while waiting or status.running:
            _skip(waiting, status)
            ready = [cell for cell in waiting if status.finished.issuperset(cell.needs)]
            idle = [process for process in processes if process.cell is None]
            for cell in ready[: max(jobs, 1) - len(status.running)]:
                if not idle:
                    started += 1
                    processes.append(CellProcess(command(study), folder / LOG.format(started)))
                    idle = processes[-1:]
                waiting.remove(cell)
                idle.pop().begin(cell)
                status.running.add(cell.id)
            for process in list(processes):
                if (end := process.ended()) is not None:
                    _note(*end, folder, cost, status)
                if process.dead:
                    process.close()
                    processes.remove(process)
            status.seconds = time.monotonic() - begun
            watch(status)
            if status.running:
                time.sleep(WAKE)
    finally:
        _end(processes)
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
