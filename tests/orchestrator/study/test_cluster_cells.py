"""`cluster_cells`: a study whose cells run elsewhere: its results are those of a study on this machine, also if
cells are repeated.

The cluster is a stand-in that runs tasks in this process; real ones are in `tests/end_to_end/test_cluster_services.py`.
"""

from __future__ import annotations

import socket
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from actors.interfaces import LaboratoryError
from actors.simulators.ray_worker import from_portable, portable
from orchestrator.cli.app import app
from orchestrator.study import cluster_cells
from orchestrator.study.cluster_cells import ClusterCells, packed, unpack_whole
from orchestrator.study.study_folder import finished_results, opened
from orchestrator.study.study_plan import StudyPlan, cells_of
from orchestrator.study.study_runner import CellStatus, run_cell, run_cells
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec
from tests.support.study_files import read, small
from tests.support.toy_study import TOYS

MUG = Path(__file__).parents[3] / "configs" / "vessels" / "meshes" / "mug.stl"


class Done:
    """A task that has ended."""

    done = True

    def __init__(self, answer: Any) -> None:
        self._answer = answer

    def result(self) -> Any:
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer


class Cluster:
    """Two cores. A task runs as often as a node is lost with it, and once more, as Ray repeats it."""

    cpus = 2

    def __init__(self, lost: int = 0, error: Exception | None = None) -> None:
        self._lost, self._error = lost, error

    def share(self, value: Any) -> Any:
        return value

    def start(self, function: Callable[..., Any], *arguments: Any) -> Done:
        if self._error is not None:
            return Done(self._error)
        for _ in range(self._lost):
            function(*arguments)
        return Done(function(*arguments))


def two_cells(folder: Path) -> StudyPlan:
    """A study of a deployment and a pour of its recommended action."""
    deployment = {"D2": {**read("quick")["deployment"]["D2"], "repetitions": 1}}
    return small(folder, deployment=deployment, mismatch=read("quick")["mismatch"][:1], confirm=1, calibration=None)


def run_on(cluster: Cluster, study: StudyPlan, monkeypatch: pytest.MonkeyPatch) -> CellStatus:
    monkeypatch.setattr(cluster_cells, "_resources", lambda: TOYS)
    with opened(study) as folder:
        return run_cells(study, folder, ClusterCells(study, folder, cluster))  # type: ignore[arg-type]


def kept(study: StudyPlan) -> dict[str, Any]:
    return {key: one.results for key, one in finished_results(study.folder, cells_of(study)).items()}


@pytest.mark.parametrize("lost", [0, 2])
def test_cells_give_the_results_of_this_machine_also_if_their_node_is_lost(
    lost: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = two_cells(tmp_path / "here"), two_cells(tmp_path / "there")
    for cell in cells_of(here):
        run_cell(here, cell, here.folder, TOYS)
    status = run_on(Cluster(lost), there, monkeypatch)
    assert (len(status.finished), status.failed) == (2, {})
    assert kept(there) == kept(here)
    names = [path.name for path in (there.folder / "cells").iterdir()]
    assert sorted(names) == sorted(cell.id for cell in cells_of(there))
    assert (there.folder / "cells" / names[0] / "journal.sqlite").is_file(), "as if it had run here"


def test_finished_cells_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = two_cells(tmp_path)
    run_on(Cluster(), study, monkeypatch)
    status = run_on(Cluster(error=AssertionError("a task was started")), study, monkeypatch)
    assert len(status.finished) == 2


def test_a_cell_whose_process_dies_each_time_fails_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = two_cells(tmp_path)
    status = run_on(Cluster(error=LaboratoryError("its process died 6 times")), study, monkeypatch)
    (first, second) = cells_of(study)
    assert status.failed == {first.id: "its process died 6 times"}
    assert status.skipped == {second.id}


def test_a_node_with_other_code_runs_no_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = two_cells(tmp_path)
    code = {**cluster_cells.code_now(), "strategies": "0123456789ab"}
    answer = cluster_cells.run_on_node(portable(study), cells_of(study)[0].id, code, {})
    assert answer[0] is None
    assert "has other code (strategies); install the same version" in (answer[1] or "")


def test_a_mesh_travels_with_its_content_and_a_folder_replaces_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "cache"))
    path = tmp_path / "mine.stl"
    path.write_bytes(MUG.read_bytes())
    # Debian 12's Python 3.11.2 has no argument `filter`.
    unpack = tarfile.TarFile.extractall
    monkeypatch.setattr(tarfile.TarFile, "extractall", lambda archive, path: unpack(archive, path))  # noqa: PLW0108
    sent = portable([VesselSpec(name="mug", shape=MeshShape(path=path, unit="mm"))])
    path.unlink()
    (vessel,) = from_portable(sent)
    assert vessel.shape.unit == "mm"
    assert vessel.shape.path.read_bytes() == MUG.read_bytes()
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "new").write_text("x")
    content = packed(tmp_path / "a")
    assert content is not None
    assert packed(tmp_path / "nowhere") is None
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "old").write_text("y")
    unpack_whole(content, tmp_path / "b")
    assert [one.name for one in (tmp_path / "b").iterdir()] == ["new"]


def test_an_address_that_is_none_or_where_nothing_answers_is_refused_before_anything_starts(tmp_path: Path) -> None:
    study = small(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.2", 0))
        address = f"127.0.0.2:{free.getsockname()[1]}"
    for given, said in (
        ("10.0.0.1", "--ray: '10.0.0.1' should be host:port of the cluster's head"),
        (address, f"--ray: Ray cluster at {address}: nothing answers there (Connection refused)"),
    ):
        done = CliRunner().invoke(app, ["study", "run", str(study.source), "--ray", given])
        assert done.exit_code == 2
        assert said in done.output
    assert not study.folder.exists()
