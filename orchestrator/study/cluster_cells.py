"""Runs the cells of a study on a Ray cluster: one task per cell.

- `ClusterCells` sends a cell with everything that it needs, since nodes share no files: the study with its meshes, and
  the run folders of the cells that it builds on. It stores the returned run folder, as if the cell had run here.
- `run_on_node` is the task. It runs a cell as `study_runner.work` does.

A cell whose node is lost is run again from its beginning on another node. Its seeds are the same, and so is its result.
"""

from __future__ import annotations

import functools
import io
import shutil
import socket
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from actors.interfaces import LaboratoryError
from actors.runtime.ray_tasks import ClusterTask, ClusterTasks
from actors.simulators.local_worker import thread_pool
from actors.simulators.ray_worker import from_portable, portable
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.run_service import RunResources
from orchestrator.study.study_folder import code_now, run_folder
from orchestrator.study.study_plan import StudyCell, StudyPlan, cells_of
from orchestrator.study.study_runner import run_cell


class ClusterCells:
    """`CellWorkers` on a cluster.

    Args:
        study: the study.
        folder: its folder on this machine, locked by this process.
        tasks: the cluster.
        jobs: number of cells at a time; None: the number of cores of the cluster.
    """

    def __init__(self, study: StudyPlan, folder: Path, tasks: ClusterTasks, jobs: int | None = None) -> None:
        self._folder, self._tasks, self._jobs = folder, tasks, jobs
        self._study = tasks.share(portable(study))
        self._running: dict[str, tuple[StudyCell, ClusterTask]] = {}

    @property
    def slots(self) -> int:
        """See `CellWorkers.slots`."""
        return self._jobs or self._tasks.cpus

    def begin(self, cell: StudyCell) -> None:
        """See `CellWorkers.begin`."""
        folders = {key: packed(run_folder(self._folder, key)) for key in (*cell.needs, cell.id)}
        sent = {key: content for key, content in folders.items() if content is not None}
        self._running[cell.id] = cell, self._tasks.start(run_on_node, self._study, cell.id, code_now(), sent)

    def ended(self) -> Iterator[tuple[StudyCell, str | None]]:
        """See `CellWorkers.ended`."""
        for cell, task in [pair for pair in self._running.values() if pair[1].done]:
            del self._running[cell.id]
            try:
                content, problem = task.result()
            except LaboratoryError as error:
                content, problem = None, str(error)
            if content is not None:
                unpack_whole(content, run_folder(self._folder, cell.id))
            yield cell, problem

    def close(self) -> None:
        """See `CellWorkers.close`; the tasks end when the program leaves the cluster."""


def run_on_node(
    study: bytes, cell_id: str, code: Mapping[str, str], folders: Mapping[str, bytes]
) -> tuple[bytes | None, str | None]:
    """Run a cell on this node.

    Args:
        study: as `portable` made it.
        cell_id: id of the cell.
        code: digests that this node's code must have, since results of other code do not compare.
        folders: run folders by cell: those that it needs, and its own if it was begun.

    Returns:
        Its run folder, or the reason why it has none.
    """
    if (version := code_now()) != dict(code):
        different = ", ".join(name for name in code if version.get(name) != code[name])
        return None, f"{socket.gethostname()} has other code ({different}); install the same version on all machines"
    plan = _study(study)
    cell = next(known for known in cells_of(plan) if known.id == cell_id)
    with tempfile.TemporaryDirectory(prefix="decant-study-") as place:
        folder = Path(place)
        for key, content in folders.items():
            unpack_whole(content, run_folder(folder, key))
        try:
            run_cell(plan, cell, folder, _resources())
        except (RunError, LaboratoryError) as error:
            return None, str(error)
        return packed(run_folder(folder, cell_id)), None


@functools.lru_cache(1)
def _study(content: bytes) -> StudyPlan:
    plan: StudyPlan = from_portable(content)
    return plan


@functools.cache
def _resources() -> RunResources:
    """One simulator in this process, for all cells that Ray runs in it."""
    return RunResources(in_process=True, simulators=thread_pool())


def packed(folder: Path) -> bytes | None:
    """The files of a folder as one archive; None if there is no such folder."""
    if not folder.is_dir():
        return None
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz", compresslevel=3) as archive:
        archive.add(folder, arcname=".")
    return content.getvalue()


def unpack_whole(content: bytes, folder: Path) -> None:
    """Make a folder from an archive, or replace it. A crash leaves no partial folder."""
    draft = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        # `extractall` has a parameter for it only from Python 3.11.4 on.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(draft)
    shutil.rmtree(folder, ignore_errors=True)
    draft.replace(folder)
