"""Runs the cells of a study: those that are not finished, each as soon as what it needs is, several at a time."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from orchestrator.study.cells import Cell, cells_of, estimated_seconds
from orchestrator.study.folder import LOG, is_finished, run_folder
from orchestrator.study.plan import StudyPlan

WAKE = 0.1
"""Seconds between two looks at the workers."""

GRACE = 10.0
"""Seconds that workers have to end after they were told to."""


@dataclass
class Status:
    """Where a study stands.

    Attributes:
        finished, failed, running: ids; `skipped`: cells that need a failed one.
        cost_left, cost_done: estimated CPU seconds of what is left, and of what this process has finished.
        seconds: since this process began.
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
        """Rough: by the estimate until something is finished, then by how fast that went [s]."""
        if self.cost_done <= 0.0:
            return self.cost_left / max(jobs, 1)
        return self.cost_left * self.seconds / self.cost_done


Watch = Callable[[Status], None]


def worker_command(study: StudyPlan, cell: Cell) -> list[str]:
    """What runs a cell in a process of its own."""
    return [sys.executable, "-m", "orchestrator.study.worker", str(study.source), cell.id]


def run_cells(
    study: StudyPlan,
    folder: Path,
    *,
    jobs: int,
    watch: Watch = lambda status: None,
    command: Callable[[StudyPlan, Cell], list[str]] = worker_command,
) -> Status:
    """Run all cells that are not finished. What fails is noted, and the others go on.

    Interrupted (KeyboardInterrupt), the workers are ended first: their journals say how far they came.

    Args:
        folder: of the study, held by this process.
        jobs: workers at a time.
    """
    cells = cells_of(study)
    cost = {cell.id: estimated_seconds(study, cell) for cell in cells}
    status = Status(len(cells), {cell.id for cell in cells if is_finished(folder, cell.id)})
    waiting = [cell for cell in cells if cell.id not in status.finished]
    status.cost_left = sum(cost[cell.id] for cell in waiting)
    workers: dict[str, subprocess.Popen[bytes]] = {}
    begun = time.monotonic()
    watch(status)
    try:
        while waiting or workers:
            _skip(waiting, status)
            ready = [cell for cell in waiting if status.finished.issuperset(cell.needs)]
            for cell in ready[: max(jobs, 1) - len(workers)]:
                waiting.remove(cell)
                workers[cell.id] = _start(command(study, cell), run_folder(folder, cell.id))
                status.running.add(cell.id)
            for name in [name for name, worker in workers.items() if worker.poll() is not None]:
                _close(workers.pop(name))
                status.running.discard(name)
                status.cost_left -= cost[name]
                if is_finished(folder, name):
                    status.finished.add(name)
                    status.cost_done += cost[name]
                else:
                    status.failed[name] = last_words(run_folder(folder, name) / LOG)
            status.seconds = time.monotonic() - begun
            watch(status)
            if workers:
                time.sleep(WAKE)
    finally:
        _end(workers.values())
    return status


def last_words(log: Path) -> str:
    """The last line that a worker wrote."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        return "its process ended without a word"
    return lines[-1] if lines else "its process ended without a word"


def _skip(waiting: list[Cell], status: Status) -> None:
    """Cells that need one that failed: they can't be run now."""
    for cell in list(waiting):
        if any(need in status.failed or need in status.skipped for need in cell.needs):
            waiting.remove(cell)
            status.skipped.add(cell.id)


def _start(command: Sequence[str], directory: Path) -> subprocess.Popen[bytes]:
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / LOG).open("wb") as log:
        # A session of its own: Ctrl-C reaches this process alone, which then ends its workers.
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


def _close(worker: subprocess.Popen[bytes]) -> None:
    if worker.stdin is not None:
        worker.stdin.close()


def _end(workers: Iterable[subprocess.Popen[bytes]]) -> None:
    mine = list(workers)
    for worker in mine:
        worker.terminate()
    deadline = time.monotonic() + GRACE
    for worker in mine:
        try:
            worker.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            worker.kill()
            worker.wait()
        _close(worker)
