"""What a study leaves on the disk: one run folder for each cell, and what came of it in one file."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import SerializeAsAny, field_validator

from orchestrator.codec import digest, first_difference, from_json, to_json
from orchestrator.errors import RunError
from orchestrator.journal_file import locked_alone
from orchestrator.results import decode_result
from orchestrator.strategies.learnt import Learnt, Part
from orchestrator.study.cells import Cell
from orchestrator.study.plan import StudyPlan, study_fingerprint

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


class CellResult(Part):
    """What came of a finished cell."""

    results: dict[str, SerializeAsAny[Learnt]]
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
        return {name: one if isinstance(one, Learnt) else decode_result(one) for name, one in value.items()}


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


def finished_results(folder: Path, cells: tuple[Cell, ...]) -> dict[str, CellResult]:
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
    before, now = json.loads(path.read_text(encoding="utf-8")), study_fingerprint(study)
    if digest(before) != digest(now):
        raise StudyError(
            f"{study.folder}: this study was begun with other settings: {first_difference(before, now)}. Set that "
            "back, give the study another name, or delete the folder"
        )
