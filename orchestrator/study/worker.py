"""One cell in a process of its own: `python -m orchestrator.study.worker STUDY.yaml CELL`.

It ends when its parent does: its stdin is a pipe that nobody writes to. Whenever it ends, the cell's journal says how
far it came, and the next worker goes on from there.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from actors.protocols import Laboratory, LaboratoryError
from actors.spec import LaboratorySpec
from orchestrator.campaign import run_campaign
from orchestrator.errors import RunError
from orchestrator.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.stages import CALIBRATION
from orchestrator.study.campaigns import campaign_of
from orchestrator.study.cells import Cell, cells_of
from orchestrator.study.folder import as_begun, read_result, run_folder, write_result
from orchestrator.study.plan import StudyPlan


def laboratory_in_process(spec: LaboratorySpec, need_bench: bool) -> Laboratory:
    """Everything in threads of this process: cells run side by side, each on a core."""
    from actors.laboratory import open_laboratory

    return open_laboratory(replace(spec, in_process=True), need_bench=need_bench)


def run_cell(
    study: StudyPlan,
    cell: Cell,
    folder: Path,
    make: Callable[[LaboratorySpec, bool], Laboratory] = laboratory_in_process,
) -> dict[str, Any]:
    """Run a cell, or go on with it, and keep what came of it.

    Raises:
        RunError: it can't begin or go on.
        LaboratoryError: its laboratory can't be opened.
    """
    directory = run_folder(folder, cell.id)
    plan, stages = campaign_of(study, cell, lambda other: read_result(folder, other)["results"], directory)
    directory.mkdir(parents=True, exist_ok=True)
    laboratory = make(plan.laboratory, any(stage.pours for stage in stages))
    begun = (directory / JOURNAL_NAME).is_file()
    result = asyncio.run(run_campaign(plan, laboratory, directory, resume=begun, stages=stages))
    data = {
        "results": result.results,
        "simulations": result.simulations,
        "pours": result.pours,
        "cpu_s": result.cpu_s,
        "seconds": result.seconds,
        "expected": _expected(directory) if cell.arm == "C4" else [],
    }
    write_result(folder, cell.id, data)
    return data


def _expected(directory: Path) -> list[list[float]]:
    """What C4's surrogate expected of each θ when it was chosen: [simulations asked for until then, mean |Δ|]."""
    asked, found = 0, []
    with JournalReader(directory / JOURNAL_NAME) as journal:
        for entry in journal.entries(stage=CALIBRATION, kinds=[Kind.REQUESTED, Kind.DECISION]):
            if entry.kind == Kind.REQUESTED:
                asked += entry.body["request"]["type"] == "Simulate"
            elif "mean" in (entry.body.get("values") or {}):
                found.append([asked, entry.body["values"]["mean"]])
    return found


def end_with_parent() -> None:
    """End this process as soon as nobody holds the other end of its stdin."""

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def work(arguments: list[str], make: Callable[[LaboratorySpec, bool], Laboratory] = laboratory_in_process) -> int:
    """Run the cell that the arguments name; the exit code."""
    from orchestrator.config.study import load_study

    end_with_parent()
    study = as_begun(load_study(Path(arguments[0])))
    cell = {cell.id: cell for cell in cells_of(study)}[arguments[1]]
    try:
        run_cell(study, cell, study.folder, make)
    except (RunError, LaboratoryError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(work(sys.argv[1:]))
