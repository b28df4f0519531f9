"""Cells in a process of their own, one after the other: `python -m orchestrator.study.cell_process STUDY.yaml`.

Each line of its stdin names a cell, each line of its stdout is the JSON list [cell, what went wrong or null]. Starting
Python, Taichi and its kernels takes longer than a small cell, so process and simulator are kept. It ends when its
stdin does, amid a cell too: the cell's journal says how far it came, and the next process goes on from there.
"""

from __future__ import annotations

import asyncio
import json
import os
import queue
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from actors.interfaces import LaboratoryError
from actors.simulators.local_worker import thread_pool
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.run_errors import RunError
from orchestrator.run_service import RunRequest, RunResources, RunService
from orchestrator.runs.stages import CALIBRATION
from orchestrator.study.study_campaigns import campaign_of
from orchestrator.study.study_folder import CellResult, code_now, read_result, run_folder, write_result
from orchestrator.study.study_plan import StudyCell, StudyPlan, cells_of


def run_cell(study: StudyPlan, cell: StudyCell, folder: Path, resources: RunResources) -> CellResult:
    """Run a cell, or go on with it, and keep what came of it.

    Args:
        study: that it belongs to.
        cell: to run.
        folder: of the study.
        resources: to run it with; all cells of a process share them.

    Raises:
        RunError: it can't begin or go on.
        LaboratoryError: its laboratory can't be opened.
    """
    directory = run_folder(folder, cell.id)
    plan, stages = campaign_of(study, cell, lambda other: read_result(folder, other).results, directory)
    directory.mkdir(parents=True, exist_ok=True)
    handle = RunService().start(RunRequest(plan, stages, directory, "if begun"), resources)
    result = asyncio.run(handle.wait())
    kept = CellResult(
        results=dict(result.results),
        simulations=result.simulations,
        pours=result.pours,
        cpu_s=result.cpu_s,
        seconds=result.seconds,
        expected=tuple(_expected(directory)) if cell.arm.startswith("C4") else (),
        code=code_now(),
    )
    write_result(folder, cell.id, kept)
    return kept


def _expected(directory: Path) -> list[tuple[int, float]]:
    """What C4's surrogate expected of each θ when it was chosen: simulations asked for until then, and mean |Δ|."""
    asked, found = 0, list[tuple[int, float]]()
    with JournalReader(directory / JOURNAL_NAME) as journal:
        for entry in journal.entries(stage=CALIBRATION, kinds=[Kind.REQUESTED, Kind.DECISION]):
            if entry.kind == Kind.REQUESTED:
                asked += entry.body["request"]["type"] == "Simulate"
            elif "mean" in (entry.body.get("values") or {}):
                found.append((asked, entry.body["values"]["mean"]))
    return found


def named_cells() -> Iterator[str]:
    """The lines of stdin as they come, until it ends; amid a cell this process ends with it."""
    names: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    idle, over = threading.Event(), threading.Event()

    def listen() -> None:
        with os.fdopen(0, "r", encoding="utf-8", closefd=False) as lines:
            for line in lines:
                names.put(line.strip())
        over.set()
        if not idle.is_set():
            os._exit(1)
        names.put(None)

    threading.Thread(target=listen, daemon=True).start()
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
        path: of the study.
        resources: to run them with; by default one simulator in this process.
    """
    from orchestrator.study.study_file import load_study

    # Libraries print to stdout, which is for answers alone: from here on they print to the log.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    code_now()  # of the sources that this process has read, before anybody changes them
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
