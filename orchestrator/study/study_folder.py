"""The folder of a study: one run folder and one result file per cell, the settings and the code version.

- `CellResult` is the content of a result file; `read_result` and `write_result` access it.
- `opened` locks the folder for one process and checks its settings.
- `code_now` and `code_warning` compare the code that made the finished cells with the current one.

Cells are run in `study_runner`.
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

from actors.runtime.ray_cluster import versions
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import ResultPart, StageResult
from orchestrator.records.codec import decode_result, digest, first_difference, from_json, to_json
from orchestrator.records.journal_file import locked_alone
from orchestrator.study.study_plan import StudyCell, StudyPlan, study_fingerprint
from sim_engine.solver_fingerprint import folder_digest

CELLS, RESULT, LOG, SETTINGS = "cells", "result.json", "process-{}.log", "study.json"
SOURCE = "study-file.txt"


class StudyError(RunError):
    """The study can't begin or continue; the text gives the reason."""

    exit_code = 2


def run_folder(folder: Path, cell: str) -> Path:
    """Folder of a cell's run."""
    return folder / CELLS / cell


def is_finished(folder: Path, cell: str) -> bool:
    """Whether the cell has a result file."""
    return (run_folder(folder, cell) / RESULT).is_file()


class CellResult(ResultPart):
    """Result of a finished cell."""

    results: dict[str, SerializeAsAny[StageResult]]
    """Result of each stage, in order."""

    simulations: int
    """Number of completed simulations, including failed ones."""

    pours: int
    """Number of completed pours, including failed ones."""

    cpu_s: float
    """CPU seconds of all simulations and suggestions."""

    seconds: float
    """Wall time [s]."""

    expected: tuple[tuple[int, float], ...]
    """C4 only: number of simulations requested until a θ was chosen, and its expected mean |Δ|."""

    code: dict[str, str]
    """Digests of the code that determines the numbers."""

    @field_validator("results", mode="before")
    @classmethod
    def _by_kind(cls, value: Any) -> Any:
        return {name: raw if isinstance(raw, StageResult) else decode_result(raw) for name, raw in value.items()}


def read_result(folder: Path, cell: str) -> CellResult:
    """Read the result of a finished cell.

    Raises:
        StudyError: the cell isn't finished, or its file is damaged.
    """
    path = run_folder(folder, cell) / RESULT
    try:
        return CellResult.model_validate(from_json(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, RunError) as error:
        raise StudyError(f"{path}: can't be read ({error}); delete it, and the study makes it again") from None


def write_result(folder: Path, cell: str, result: CellResult) -> None:
    """Write the result of a cell atomically: a crash leaves either the whole file or none."""
    path = run_folder(folder, cell) / RESULT
    write_whole(path, json.dumps(to_json(result.model_dump()), ensure_ascii=False))


def write_whole(path: Path, text: str) -> None:
    """Write a file atomically."""
    temporary = path.with_suffix(f".{os.getpid()}.part")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def finished_results(folder: Path, cells: tuple[StudyCell, ...]) -> dict[str, CellResult]:
    """Results of all finished cells."""
    return {cell.id: read_result(folder, cell.id) for cell in cells if is_finished(folder, cell.id)}


@contextlib.contextmanager
def opened(study: StudyPlan) -> Iterator[Path]:
    """Open the study's folder for one process at a time.

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


def check_settings(study: StudyPlan) -> None:
    """Check that the contents of the study's folder were made with the same settings; repetitions may be added.

    Raises:
        StudyError: the settings differ.
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


_ROOT = Path(__file__).parents[2]


@functools.cache
def code_now() -> dict[str, str]:
    """Version of Decant, and digests of the optimiser, the strategies and the solver on the disk.

    The result is cached, because a running process keeps its code when files on the disk change.
    """
    current = versions()
    return {
        "decant": current.decant,
        "optimiser": folder_digest(_ROOT / "actors" / "optimizer"),
        "strategies": folder_digest(_ROOT / "orchestrator" / "learning"),
        "solver": current.simulator,
    }


def made_by(results: Mapping[str, CellResult]) -> Counter[tuple[tuple[str, str], ...]]:
    """Number of cells by the code that made them."""
    return Counter(tuple(result.code.items()) for result in results.values())


def code_warning(results: Mapping[str, CellResult]) -> str | None:
    """Warning for a study that continues with other code than that of its finished cells; None if the code is equal.

    Args:
        results: results of the finished cells.
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


def code_summary(results: Mapping[str, CellResult]) -> str:
    """Text for the page: the number of different codes of the cells, and their digests."""
    count = made_by(results)
    if not count:
        return "Code: no cell is finished."
    listed = [(cells, ", ".join(f"{name} {value}" for name, value in code)) for code, cells in count.most_common()]
    texts = [f"{cells} of {parts}" for cells, parts in listed]
    return f"Code: {len(count)} different for {count.total()} cells: {'; '.join(texts)}."
