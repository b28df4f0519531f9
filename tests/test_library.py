"""`import decant`: light, typed, and the page about it true."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import decant
from tests.depth import THOROUGH

ROOT = Path(__file__).parents[1]
PAGE, NOTEBOOK = ROOT / "docs" / "library.md", ROOT / "docs" / "library.ipynb"
MOST_LINES = 10
HEAVY = ("taichi", "ray", "rerun", "matplotlib")


def python(code: str, folder: Path, *, patience: float = 280.0) -> subprocess.CompletedProcess[str]:
    """A program of its own: Taichi lives once in a process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=patience)


def examples() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_importing_it_imports_nothing_heavy_and_every_name_is_there(tmp_path: Path) -> None:
    heavy = f"print([m for m in {HEAVY} if m in sys.modules])"
    done = python(f"import sys, decant; {heavy}; [getattr(decant, n) for n in decant.__all__]; {heavy}", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == ["[]", "[]"]


def test_a_name_that_it_has_not_is_said_with_those_that_it_has() -> None:
    with pytest.raises(AttributeError, match="open_run"):
        _ = decant.open_runs  # type: ignore[attr-defined]


def test_examples_are_short() -> None:
    assert len(examples()) >= 7
    assert all(len(example.strip().splitlines()) <= MOST_LINES for example in examples())


def test_every_example_of_the_page_runs_as_it_stands(tmp_path: Path) -> None:
    """All in `make slow`; else without a calibration of its own, as a campaign has one."""
    shown = examples() if THOROUGH else [each for each in examples() if "decant.calibrate(" not in each]
    done = python("\n".join(shown), tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "quickstart ['narrow']" in done.stdout
    assert "angular_velocity_deg_s" in done.stdout
    runs = sorted(path.name for path in (tmp_path / "lab" / "runs").iterdir() if (path / "summary.json").is_file())
    assert len(runs) == (3 if THOROUGH else 2), "a calibration, a plan and a campaign"
    assert {path.stem for path in tmp_path.glob("lab/runs/*/tables/*.parquet")} == {
        "pours",
        "simulations",
        "decisions",
        "curves",
        "outflows",
    }
    for name in ("pour.png", "spillage.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_the_notebook_is_the_page_executed_with_its_pictures() -> None:
    book, made = committed(), make_notebook().notebook()
    assert [cell.source for cell in book.cells] == [cell.source for cell in made.cells], "run docs/make_notebook.py"
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert "/" + "work/" not in NOTEBOOK.read_text(encoding="utf-8"), "a path of the machine that made it"


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    book = make_notebook().executed(tmp_path)
    pictures = [o for cell in book.cells for o in cell.get("outputs", ()) if "image/png" in o.get("data", {})]
    assert len(pictures) == 2


def committed() -> Any:
    import nbformat

    return nbformat.read(NOTEBOOK, as_version=4)


def make_notebook() -> Any:
    spec = importlib.util.spec_from_file_location("make_notebook", ROOT / "docs" / "make_notebook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_hardware_is_not_armed_from_a_program(tmp_path: Path) -> None:
    campaign = decant.load_campaign(decant.shipped("campaigns/first-pour.yaml"))
    with pytest.raises(ValueError, match="armed from the command line alone"):
        decant.run(campaign)


def test_a_starting_set_is_copied_whole_and_never_over_something(tmp_path: Path) -> None:
    campaigns = decant.starting_set(tmp_path / "lab")
    assert {path.stem for path in campaigns} >= {"quickstart", "recorded", "paper"}
    for path in campaigns:
        decant.load_campaign(path)
    with pytest.raises(FileExistsError, match="not an empty folder"):
        decant.starting_set(tmp_path / "lab")


def test_a_built_campaign_names_the_place_of_what_is_wrong_in_it() -> None:
    content = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")).resolved
    with pytest.raises(decant.ConfigError, match="simulatons"):
        decant.build_campaign({**content, "calibration": {**content["calibration"], "simulatons": 3}})
