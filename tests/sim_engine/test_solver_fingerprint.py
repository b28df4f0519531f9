"""`solver_fingerprint`: results belong together as long as what simulates a pour does the same."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sim_engine.solver_fingerprint import ROOT, solver_fingerprint


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "sim_engine", tmp_path / "sim_engine", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


def change(root: Path, file: str, old: str, new: str) -> None:
    path = root / "sim_engine" / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("fluid/step.py", "CFL = 1.5", "CFL = 1.4"),
        pytest.param("fluid/neighbours.py", "+ (EIGHT - 1)", "+ EIGHT", marks=pytest.mark.slow),
        pytest.param("simulator.py", "LEAD = 0.3", "LEAD = 0.2", marks=pytest.mark.slow),
        pytest.param("vessel/wall_correction.py", "EDITION = 1", "EDITION = 2", marks=pytest.mark.slow),
    ],
)
def test_another_solver_has_another_fingerprint(copy: Path, file: str, old: str, new: str) -> None:
    assert solver_fingerprint(copy) == solver_fingerprint()
    change(copy, file, old, new)
    assert solver_fingerprint(copy) != solver_fingerprint()


def test_words_and_what_is_told_beside_a_pour_leave_it_alone(copy: Path) -> None:
    change(copy, "fluid/step.py", '"""', '"""Words. ')
    change(copy, "fluid/engine.py", '"""', '"""Words. ')
    change(copy, "prediction_band.py", '"""', '"""Words. ')
    (copy / "sim_engine" / "model_validity.py").write_text("SOMETHING = 1\n", encoding="utf-8")
    assert solver_fingerprint(copy) == solver_fingerprint()
