"""A study: its cells are a pure function of its file, and whatever is killed, it goes on and comes to the same."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from orchestrator.config.check import touch
from orchestrator.config.errors import ConfigError
from orchestrator.config.study import load_study
from orchestrator.study.cells import cells_of
from orchestrator.study.folder import RESULT, StudyError, as_begun, finished_results, is_finished, opened, run_folder
from orchestrator.study.plan import StudyPlan
from orchestrator.study.worker import run_cell
from sim_engine.vessel.build import build_vessel
from tests.orchestrator import toy_study
from tests.orchestrator.toy import logical_record
from tests.orchestrator.toy_study import PAUSE, ToyLaboratory, run_toy_study

ROOT = Path(__file__).parents[2]
STUDIES = ROOT / "configs" / "studies"


def read(name: str) -> dict[str, Any]:
    data: dict[str, Any] = YAML(typ="safe").load((STUDIES / f"{name}.yaml").read_text(encoding="utf-8"))
    for key in ("campaign", "laboratory"):
        data[key] = str((STUDIES / data[key]).resolve())
    return data


def written(folder: Path, data: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.yaml"
    path.write_text(json.dumps({**data, "directory": str(folder / "runs")}), encoding="utf-8")
    return path


def small(folder: Path, **changes: Any) -> StudyPlan:
    """The quick study with less of everything."""
    data = read("quick")
    data["deployment"]["D2"]["pours"] = data["deployment"]["D3"]["pours"] = 2
    return load_study(written(folder, {**data, **changes}))


# -- cells ----------------------------------------------------------------------------------------------------------


def test_the_paper_study_has_the_repetitions_that_it_promises() -> None:
    cells = cells_of(load_study(STUDIES / "paper.yaml"))
    count = Counter((cell.kind, cell.arm, cell.level) for cell in cells)
    assert [count["calibration", arm, "moderate"] for arm in ("C1", "C2", "C3", "C4")] == [10, 5, 5, 10]
    for level in ("small", "moderate", "large"):
        assert count["pours", "", level] == 10
        for arm in ("D1-15", "D2", "D3"):
            assert count["deployment", arm, level] == 3 * 10
    spent = {arm: sum(c.simulations - 32 for c in cells if c.arm == arm) for arm in ("C2", "C3")}
    assert spent == {"C2": 5 * 504, "C3": 5 * 1652}
    assert [c.simulations for c in cells if c.kind == "grid"] == [100 * 32]


def test_a_study_may_have_other_values_and_ranges_of_parameters_than_its_campaign(tmp_path: Path) -> None:
    changes = {"particles": {"range": [300, 350], "scale": "log"}, "cohesion": "0.02 N/m"}
    study = small(tmp_path, parameters=changes, search=["particles"])
    plan = study.calibration("C4").plan
    axis = plan.parameters.axes[0]
    assert (axis.name, axis.lower, axis.upper, axis.scale) == ("particles", 300.0, 350.0, "log")
    assert plan.fixed_parameters["cohesion"] == 0.02
    assert study.base.parameters.particles == 350, "the default, as near as the range allows"
    assert study.base.parameters.cohesion == 0.02


@pytest.mark.parametrize("name", ["paper", "quick"])
def test_cells_are_the_same_whenever_the_file_is_read_and_come_after_what_they_need(name: str) -> None:
    cells = cells_of(load_study(STUDIES / f"{name}.yaml"))
    assert cells == cells_of(load_study(STUDIES / f"{name}.yaml"))
    assert len({cell.id for cell in cells}) == len(cells)
    known: set[str] = set()
    for cell in cells:
        assert known.issuperset(cell.needs), cell.id
        known.add(cell.id)


def test_repetitions_levels_and_receivers_have_seeds_of_their_own_and_arms_share_them() -> None:
    seeds: dict[tuple[str, str, str, int], set[int]] = {}
    for cell in cells_of(load_study(STUDIES / "paper.yaml")):
        kind = "calibration" if cell.kind == "uncalibrated" else cell.kind
        seeds.setdefault((kind, cell.level, cell.receiver, cell.repetition), set()).add(cell.seed)
    assert all(len(found) == 1 for found in seeds.values())
    assert len(set.union(*seeds.values())) == len(seeds)


def test_another_seed_gives_other_seeds_to_all_cells(tmp_path: Path) -> None:
    one, other = cells_of(small(tmp_path / "a", seed=1)), cells_of(small(tmp_path / "b", seed=2))
    assert [cell.id for cell in one] == [cell.id for cell in other]
    assert not {cell.seed for cell in one} & {cell.seed for cell in other}


@pytest.mark.parametrize("name", ["paper", "quick"])
def test_no_mismatch_lets_the_cups_touch_in_calibration(name: str) -> None:
    study = load_study(STUDIES / f"{name}.yaml")
    assert study.base.calibration is not None
    scene, actions = study.base.calibration.scene, study.base.calibration.actions
    pourer, receiver = build_vessel(scene.pourer), build_vessel(scene.receiver)
    action = scene.action(actions.decode([1.0] * actions.dimension))
    for level in study.levels:
        error, noise = level.bench.pose_error, level.bench.pose_noise
        nearest = action.with_values(x_offset=action.x_offset + error.x - 3 * noise.x)
        assert touch(scene, nearest, pourer, receiver) is None, level.name


# -- files that can't be used ---------------------------------------------------------------------------------------


def without(data: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name != key}


WRONG: dict[str, tuple[Any, str]] = {
    "no mismatch": (lambda d: without(d, "mismatch"), "key 'mismatch' is missing"),
    "unknown level": (lambda d: {**d, "compared": "huge"}, "compared: no such level; there are small, large"),
    "level twice": (lambda d: {**d, "mismatch": [d["mismatch"][0]] * 2}, "mismatch[1]: a level 'small'"),
    "not searched": (lambda d: {**d, "search": ["friction"]}, "search[0]: 'friction' is not searched"),
    "nothing left to search": (
        lambda d: {
            **without(d, "search"),
            "parameters": {"particles": 500, "cohesion": "0 N/m", "viscosity": "1 1/s"},
        },
        "parameters: fixes all that the campaign searches",
    ),
    "no bench": (
        lambda d: {**d, "laboratory": str(ROOT / "configs/laboratories/planning.yaml")},
        "laboratory 'planning' has no virtual bench",
    ),
    "no such campaign": (lambda d: {**d, "campaign": "nothing.yaml"}, "campaign: no such file"),
    "another's key": (
        lambda d: {**d, "calibration": {**d["calibration"], "C1": {"repetitions": 1, "per_axis": 2, "samples": 3}}},
        "calibration.C1.samples: belongs to C2, not to C1",
    ),
    "no budget": (
        lambda d: {**d, "calibration": {**d["calibration"], "C3": {"repetitions": 1}}},
        "calibration.C3: key 'iterations' is missing",
    ),
    "no θ for D3": (
        lambda d: {**d, "calibration": without(d["calibration"], "C4")},
        "D3 simulates with the θ* that C4 finds",
    ),
    "all for testing": (lambda d: {**d, "holdout": 5}, "holdout: 5 of 6 pours for testing"),
    "nothing to compare": (lambda d: without(without(d, "calibration"), "deployment"), "there is nothing to compare"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_a_study_is_said_with_its_place(case: str, tmp_path: Path) -> None:
    change, message = WRONG[case]
    path = written(tmp_path, change(read("quick")))
    with pytest.raises(ConfigError) as refused:
        load_study(path)
    assert message in str(refused.value)
    if case != "no such campaign":
        assert f"{path}:1:" in str(refused.value)


def test_a_campaign_is_no_study() -> None:
    with pytest.raises(ConfigError, match="describes a campaign, but a study is needed here"):
        load_study(ROOT / "configs" / "campaigns" / "quickstart.yaml")


# -- running --------------------------------------------------------------------------------------------------------


def comparable(study: StudyPlan) -> dict[str, Any]:
    cells = cells_of(study)
    return {cell.id: logical_record(run_folder(study.folder, cell.id)) for cell in cells}


def toy_process(study: StudyPlan, pause: float) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), PAUSE: str(pause)}
    command = [sys.executable, str(Path(toy_study.__file__)), str(study.source)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    return [int(child) for child in children.split()]


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(autouse=True)
def _imports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def test_killed_in_the_middle_it_goes_on_and_comes_to_what_an_undisturbed_one_comes_to(tmp_path: Path) -> None:
    arms = read("quick")["calibration"]
    changes = {
        "calibration": {"C1": arms["C1"], "C4": {**arms["C4"], "repetitions": 1}},
        "deployment": {"D3": {**read("quick")["deployment"]["D3"], "pours": 2, "repetitions": 1}},
        "mismatch": read("quick")["mismatch"][:1],
    }
    undisturbed, disturbed = small(tmp_path / "one", **changes), small(tmp_path / "two", **changes)
    cells = cells_of(undisturbed)
    for cell in cells:
        run_cell(undisturbed, cell, undisturbed.folder, ToyLaboratory)  # type: ignore[arg-type]
    process = toy_process(disturbed, 0.05)
    deadline = time.monotonic() + 120
    while sum(is_finished(disturbed.folder, cell.id) for cell in cells) < 2:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.05)
    workers = workers_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    while any(map(is_alive, workers)):
        assert time.monotonic() < deadline, "a worker outlives the command"
        time.sleep(0.05)
    finished = {
        c.id: (run_folder(disturbed.folder, c.id) / RESULT) for c in cells if is_finished(disturbed.folder, c.id)
    }
    before = {name: path.stat().st_mtime_ns for name, path in finished.items()}
    assert 2 <= len(before) < len(cells)
    assert not run_toy_study(disturbed).failed
    assert comparable(disturbed) == comparable(undisturbed)
    assert {name: finished[name].stat().st_mtime_ns for name in before} == before, "a finished cell was run again"
    # C1 is scored from the grid, with the pours of its own repetition
    results = finished_results(disturbed.folder, cells)
    scored = [results[f"calibration.small.C1.0{n}"] for n in (1, 2)]
    assert all(one["results"]["calibration"]["simulations"] == 4 * 4 for one in scored)
    assert all(one["simulations"] == 6 for one in scored), "the grid was simulated again"
    assert scored[0]["results"]["calibration"]["trials"] != scored[1]["results"]["calibration"]["trials"]
    splits = [[p["split"] for p in results[f"pours.small.0{n}"]["results"]["pours"]["pours"]] for n in (1, 2)]
    actions = [[p["action"] for p in results[f"pours.small.0{n}"]["results"]["pours"]["pours"]] for n in (1, 2)]
    assert actions[0] == actions[1]
    assert splits[0] != splits[1]
    theta = results["calibration.small.C4.01"]["results"]["calibration"]["theta"]
    resolved = run_folder(disturbed.folder, "deployment.small.D3.deployment-narrow.01") / "resolved.json"
    assert json.loads(resolved.read_text(encoding="utf-8"))["parameters"] == theta


def test_a_cell_that_fails_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    arms, levels = {"C4": {"repetitions": 1, "simulations": 4, "initial": 4}}, read("quick")["mismatch"][:1]
    deployment = {"D3": {**read("quick")["deployment"]["D3"], "pours": 1, "repetitions": 1}}
    study = small(tmp_path, calibration=arms, deployment=deployment, mismatch=levels)
    blocked = run_folder(study.folder, "calibration.small.C4.01")
    blocked.mkdir(parents=True)
    (blocked / "journal.sqlite").write_bytes(b"no journal at all, but as long as one" * 40)
    status = run_toy_study(study)
    assert set(status.failed) == {"calibration.small.C4.01"}
    assert "not a journal" in status.failed["calibration.small.C4.01"]
    assert status.skipped == {"deployment.small.D3.deployment-narrow.01"}, "it needs the θ* that there is none of"
    assert len(status.finished) == len(cells_of(study)) - 2


def test_a_study_from_before_goes_on_with_what_its_deployments_began_with(tmp_path: Path) -> None:
    today = small(tmp_path)
    assert {(arm.plan.noise, arm.plan.refusals) for arm in today.deployments} == {("constant", "avoid")}
    arms = tuple(replace(arm, plan=replace(arm.plan, refusals="penalise")) for arm in today.deployments)
    with opened(replace(today, deployments=arms)) as folder:
        begun = json.loads((folder / "study.json").read_text(encoding="utf-8"))["deployments"]
    assert not any({"noise", "refusals"} & set(arm) for arm in begun.values())  # as it was before there were any
    with pytest.raises(StudyError, match="begun with other settings"), opened(today):
        pass
    assert as_begun(today).deployments == arms
    with opened(as_begun(today)):
        pass


def test_settings_may_not_change_under_a_study_but_repetitions_may_be_added(tmp_path: Path) -> None:
    study = small(tmp_path)
    with opened(study):
        pass
    more = read("quick")["calibration"]
    more["C2"]["repetitions"] = 3
    with opened(small(tmp_path, calibration=more)):
        pass
    more["C2"]["samples"] = 4
    with pytest.raises(StudyError, match="begun with other settings"), opened(small(tmp_path, calibration=more)):
        pass


def test_two_commands_can_not_run_one_study(tmp_path: Path) -> None:
    study = small(tmp_path)
    with opened(study), pytest.raises(StudyError, match="another process is running this study"), opened(study):
        pass
