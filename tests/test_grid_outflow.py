"""`benchmarks/grid_outflow.py`: the mesh that it writes for OpenFOAM, and what it says without OpenFOAM."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def grid(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import grid_outflow

    return grid_outflow


def test_cells_are_closed_and_the_liquid_has_its_volume(grid: ModuleType) -> None:
    mesh = grid.make_mesh(10)
    faces = grid.faces(mesh)
    node = np.unravel_index(faces.corners, tuple(len(line) for line in mesh.nodes), order="F")
    corners = np.stack([line[i] for line, i in zip(mesh.nodes, node, strict=True)], axis=-1)
    areas = 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])  # out of the owner
    total = np.zeros((np.count_nonzero(mesh.used), 3))
    np.add.at(total, faces.owner, areas)
    np.subtract.at(total, faces.neighbour, areas[: len(faces.neighbour)])
    assert np.abs(total).max() < 1e-9 * np.abs(areas).max()
    across, along = mesh.size
    assert 2.0 * grid.fill_level(mesh).sum() * across**2 * along == pytest.approx(200e-6, rel=1e-6)
    assert mesh.volume_ratio == pytest.approx(1.0, abs=0.01)


def test_without_openfoam_one_line_says_what_is_needed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "grid_outflow.py", "--viscosity", "1"],
        env=os.environ | {"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "install OpenFOAM" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
