"""`decant`: `import decant`: light, typed, and the page about it true."""

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
from orchestrator.learning.requests import Simulate
from tests.support.hypothesis_examples import THOROUGH

ROOT = Path(__file__).parents[2]
PAGE, NOTEBOOK = ROOT / "docs" / "tutorials" / "notebook.md", ROOT / "docs" / "library.ipynb"
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


@pytest.mark.slow
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
    for name in ("pour.png", "losses.png"):
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
    with pytest.raises(ValueError, match="enabled from the command line alone"):
        decant.run(campaign)


def test_a_starting_set_is_copied_whole_and_never_over_something(tmp_path: Path) -> None:
    campaigns = decant.starting_set(tmp_path / "lab")
    assert {path.stem for path in campaigns} >= {"quickstart", "recorded", "paper"}
    for path in campaigns:
        decant.load_campaign(path)
    with pytest.raises(FileExistsError, match="not an empty folder"):
        decant.starting_set(tmp_path / "lab")


@pytest.mark.parametrize("directory", ["lab", "."])
def test_runs_of_a_starting_set_are_in_the_working_directory(
    directory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for path in [*decant.starting_set(directory), *Path(directory).glob("studies/*.yaml")]:
        text = path.read_text()
        named = text.split("directory: ")[1].split()[0].rstrip("}")
        assert (path.parent / named).resolve() == tmp_path / "runs"


def test_a_built_campaign_names_the_place_of_what_is_wrong_in_it() -> None:
    content = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")).resolved
    with pytest.raises(decant.ConfigError, match="simulatons"):
        decant.build_campaign({**content, "calibration": {**content["calibration"], "simulatons": 3}})


USER = """
from pathlib import Path

import decant


def action(path: str, table: list[dict[str, float | str]]) -> dict[str, float | None]:
    campaign = decant.load_campaign(path)
    campaign = decant.load_campaign(Path(path), laboratory="twin.yaml", seed=3)
    seen: list[decant.Event] = []
    try:
        calibrated = decant.calibrate(campaign, table, watch=[seen.append])
        planned = decant.plan(campaign, decant.load_vessel("mug.yaml"), theta=calibrated, seeds=2)
    except (decant.ConfigError, decant.AssignmentError, decant.RunError) as error:
        raise SystemExit(1) from error
    except decant.DecantError:
        raise
    theta: decant.SimulationParameters | None = calibrated.theta
    print(theta, decant.shipped("campaigns/quickstart.yaml"), decant.events.StageOpened)
    return planned.recommended["mug"].action


decant.open_runs("misspelt")  # type: ignore[attr-defined]
"""


@pytest.mark.slow
def test_a_program_of_a_user_passes_a_strict_type_check_and_misspelt_names_do_not(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(USER, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=", "--cache-dir", str(tmp_path / "cache")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([*command, str(program)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_public_error_is_a_decant_error_and_what_it_was_before() -> None:
    from orchestrator.records.codec import CodecError
    from orchestrator.records.journal_file import JournalError
    from orchestrator.runs.run_service import RunTaskError
    from sim_engine.errors import InvalidSceneError
    from sim_engine.settings.plugin_registry import PluginError
    from sim_engine.vessel.shapes import VesselError

    before: dict[type[Exception], type[Exception]] = {
        decant.AssignmentError: ValueError,
        decant.ConfigError: Exception,
        decant.InvalidArgumentError: ValueError,
        decant.LaboratoryError: Exception,
        decant.MissingExtraError: ImportError,
        decant.RunError: Exception,
        CodecError: ValueError,
        PluginError: LookupError,
        InvalidSceneError: ValueError,
        RunTaskError: ValueError,
        JournalError: decant.RunError,
        VesselError: ValueError,
    }
    assert all(issubclass(error, decant.DecantError) and issubclass(error, old) for error, old in before.items())
    named = [getattr(decant, name) for name in decant.__all__ if name.endswith("Error")]
    assert len(named) == 7
    assert all(issubclass(error, decant.DecantError) for error in named)


def small(folder: Path, **changes: Any) -> decant.CampaignPlan:
    """The quickstart with runs in a folder of the test; its sections with other values."""
    content = dict(decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")).resolved)
    content["outputs"] = {"directory": str(folder / "runs"), "recording": False, "figures": False}
    for name, section in changes.items():
        content[name] = section
    content = {name: section for name, section in content.items() if section is not None}
    return decant.build_campaign(content, folder)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda plan: decant.plan(plan, seeds=0), "seeds=0: should be 1 or more"),
        (lambda plan: decant.plan(plan, iterations=0), "iterations=0: should be 1 or more"),
        (lambda plan: decant.simulate(plan, seeds=0), "seeds=0: should be 1 or more"),
        (lambda plan: decant.simulate(plan, {"angular_velocity": "3 kg"}), "angular_velocity"),
        (lambda plan: decant.calibrate(plan, "pours.csv"), "should be a pandas.DataFrame or a list of dicts, not str"),
        (lambda plan: decant.calibrate(plan, [1, 2]), "every row should be a dict"),
        (lambda plan: decant.find_runs(since="yesterday"), "'yesterday' is not a date"),
    ],
)
def test_an_argument_that_can_not_be_used_is_one_clear_error_and_leaves_no_run(
    tmp_path: Path, call: Any, said: str
) -> None:
    with pytest.raises(decant.DecantError, match=re.escape(said)) as refused:
        call(small(tmp_path))
    assert isinstance(refused.value, ValueError)
    assert not (tmp_path / "runs").exists()


def test_a_refused_table_leaves_no_run_and_names_the_place_of_its_error(tmp_path: Path) -> None:
    row = {"angular_velocity_deg_s": 60, "x_offset_mm": 110, "poured_g": 198, "retained_g": 2, "split": "train"}
    rows = [{**row, "spilled_g": 1.2}, {**row, "spilled_g": "much"}]
    with pytest.raises(decant.ConfigError, match=r"pours\.csv:3:\d+") as refused:
        decant.calibrate(small(tmp_path), rows)
    assert "much" in str(refused.value)
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def fake_simulators(monkeypatch: pytest.MonkeyPatch) -> None:
    """Campaigns of the library with simulators that make numbers up."""
    from functools import partial

    from actors.laboratory import open_laboratory
    from tests.support.fake_simulator import make_fake

    monkeypatch.setattr("actors.laboratory.open_laboratory", partial(open_laboratory, make=make_fake()))


def test_a_campaign_is_planned_with_the_draws_of_a_calibration(tmp_path: Path, fake_simulators: None) -> None:
    import json

    rows = [{"theta": {"friction": friction}, "weight": 1.0} for friction in (0.1, 0.3)]
    theta = tmp_path / "theta.json"
    theta.write_text(json.dumps({"theta": {"friction": 0.2}, "posterior": rows}), encoding="utf-8")
    seen: set[float] = set()

    def watch(event: decant.Event) -> None:
        request = getattr(event, "request", None)
        if isinstance(request, Simulate):
            seen.add(request.parameters.friction)

    planned = decant.plan(small(tmp_path), theta=theta, iterations=2, seeds=2, watch=[watch])
    assert planned.recommended
    assert {0.1, 0.3} <= seen <= {0.1, 0.2, 0.3}


@pytest.mark.slow
def test_a_run_of_the_library_is_recorded_and_warns_as_one_of_the_command_line(
    tmp_path: Path, fake_simulators: None
) -> None:
    pytest.importorskip("rerun")
    content = dict(small(tmp_path).resolved)
    content["outputs"] = {**content["outputs"], "recording": True}
    actions = {**content["deployment"]["actions"], "x_offset": ["150 mm", "300 mm"]}
    content["deployment"] = {**content["deployment"], "actions": actions}
    campaign = decant.build_campaign(content, tmp_path)
    with pytest.warns(UserWarning, match="x_offset"):
        planned = decant.plan(campaign, iterations=2, seeds=2)
    recording = planned.directory / "campaign.rrd"
    assert planned.published is not None
    assert planned.published.recording == recording
    assert recording.stat().st_size > 1000
