"""What a study leaves on the disk: one run folder for each cell, and what came of it in one file.

Which code made a cell: digests of what decides its numbers.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import SerializeAsAny, field_validator

from actors.runtime.cluster_nodes import sources, versions
from orchestrator.journal.codec import digest, first_difference, from_json, to_json
from orchestrator.journal.journal_file import locked_alone
from orchestrator.journal.stage_results import decode_result
from orchestrator.journal.upgrade import upgraded_fingerprint
from orchestrator.run_errors import RunError
from orchestrator.strategies.stage_result import ResultPart, StageResult
from orchestrator.study.study_plan import StudyCell, StudyPlan, study_fingerprint

CELLS, RESULT, LOG, SETTINGS = "cells", "result.json", "process-{}.log", "study.json"
SOURCE = "study-file.txt"


class StudyError(RunError):
    """The study can't begin or go on; the text says why."""


def run_folder(folder: Path, cell: str) -> Path:
    """Folder of a cell's run."""
    return folder / CELLS / cell


def is_finished(folder: Path, cell: str) -> bool:
    """Whether the cell's results are there."""
    return (run_folder(folder, cell) / RESULT).is_file()


class CellResult(ResultPart):
    """What came of a finished cell."""

    results: dict[str, SerializeAsAny[StageResult]]
    """What each stage learnt, in order."""

    simulations: int
    """Finished ones, failed ones included."""

    pours: int
    """Finished ones, failed ones included."""

    cpu_s: float
    """CPU seconds of all simulations and suggestions."""

    seconds: float
    """Wall time."""

    expected: tuple[tuple[int, float], ...]
    """C4: simulations asked for until a θ was chosen, and the mean |Δ| expected of it."""

    code: dict[str, str]
    """Digests of what decides its numbers."""

    @field_validator("results", mode="before")
    @classmethod
    def _by_kind(cls, value: Any) -> Any:
        return {name: one if isinstance(one, StageResult) else decode_result(one) for name, one in value.items()}


def read_result(folder: Path, cell: str) -> CellResult:
    """What came of a finished cell.

    Raises:
        StudyError: it isn't finished, or its file is damaged.
    """
    path = run_folder(folder, cell) / RESULT
    try:
        return CellResult.model_validate(from_json(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, RunError) as error:
        raise StudyError(f"{path}: can't be read ({error}); delete it, and the study makes it again") from None


def write_result(folder: Path, cell: str, result: CellResult) -> None:
    """Keep what came of a cell: all of it or nothing, whenever the process dies."""
    path = run_folder(folder, cell) / RESULT
    write_whole(path, json.dumps(to_json(result.model_dump()), ensure_ascii=False))


def write_whole(path: Path, text: str) -> None:
    """Write a file that is never seen half written."""
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def finished_results(folder: Path, cells: tuple[StudyCell, ...]) -> dict[str, CellResult]:
    """What came of all cells that are finished."""
    return {cell.id: read_result(folder, cell.id) for cell in cells if is_finished(folder, cell.id)}


@contextlib.contextmanager
def opened(study: StudyPlan) -> Iterator[Path]:
    """The study's folder, for one process at a time.

    Raises:
        StudyError: another process runs the study, or it was begun with other settings.
    """
    folder = study.folder
    try:
        (folder / CELLS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(f"{folder}: can't be written: {error.strerror}") from None
    with (folder / "study.lock").open("a") as lock:
        try:
            alone = locked_alone(lock)
        except OSError as error:
            raise StudyError(f"{error.filename}: {error.strerror}") from None
        if not alone:
            raise StudyError(f"{folder}: another process is running this study; wait for it, or stop it")
        check_settings(study)
        text = json.dumps(study_fingerprint(study), indent=1, ensure_ascii=False)
        write_whole(folder / SETTINGS, text + "\n")
        write_whole(folder / SOURCE, f"{study.source}\n")
        yield folder


def file_of(folder: Path) -> Path:
    """The study's file, as it was called when the study ran last.

    Raises:
        StudyError: nobody knows it, or it is not there any more.
    """
    try:
        path = Path((folder / SOURCE).read_text(encoding="utf-8").strip())
    except OSError:
        raise StudyError(f"{folder}: nothing says here which file the study is of; name the file (YAML)") from None
    if not path.is_file():
        raise StudyError(f"{folder}: its file was {path}, which is not there any more; name the file (YAML)")
    return path


def check_settings(study: StudyPlan) -> None:
    """Whether what is in the study's folder was made with the same settings; repetitions may be added.

    Raises:
        StudyError: it was not.
    """
    path = study.folder / SETTINGS
    if not path.is_file():
        return
    before, now = upgraded_fingerprint(json.loads(path.read_text(encoding="utf-8"))), study_fingerprint(study)
    if digest(before) != digest(now):
        raise StudyError(
            f"{study.folder}: this study was begun with other settings: {first_difference(before, now)}. Set that "
            "back, give the study another name, or delete the folder"
        )


_ROOT = Path(__file__).parents[2]


@functools.cache
def code_now() -> dict[str, str]:
    """Version of Decant, and digests of the optimiser, the strategies and the solver, as they are on the disk.

    Cached: a process that was started with some code keeps it, whatever is written to the disk since.
    """
    here = versions()
    return {
        "decant": here.decant,
        "optimiser": sources(_ROOT / "actors" / "optimizer" / "core"),
        "strategies": sources(_ROOT / "orchestrator" / "strategies"),
        "solver": here.simulator,
    }


def made_by(results: Mapping[str, CellResult]) -> Counter[tuple[tuple[str, str], ...]]:
    """How many cells each code has made."""
    return Counter(tuple(result.code.items()) for result in results.values())


def warning(results: Mapping[str, CellResult]) -> str | None:
    """What to say where a study goes on with other code than its finished cells were made with; None: nothing.

    Args:
        results: of the finished cells.
    """
    now, other, parts = code_now(), 0, dict[str, None]()
    for code, count in made_by(results).items():
        if (was := dict(code)) != now:
            other += count
            parts |= dict.fromkeys(name for name in now if was.get(name) != now[name])
    if not other:
        return None
    return (
        f"warning: of this study's cells {other} finished by other code ({', '.join(parts)}: changed since); those "
        "that follow may not compare with them. To have all of one code, give the study another name"
    )


def told(results: Mapping[str, CellResult]) -> str:
    """For the page: how many codes the cells have, and which."""
    count = made_by(results)
    if not count:
        return "Code: no cell is finished."
    listed = [(cells, ", ".join(f"{name} {value}" for name, value in code)) for code, cells in count.most_common()]
    texts = [f"{cells} of {parts}" for cells, parts in listed]
    return f"Code: {len(count)} different for {count.total()} cells: {'; '.join(texts)}."
