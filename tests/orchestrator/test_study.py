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

from actors.cluster.versions import sources
from orchestrator.config.check import touch
from orchestrator.config.errors import ConfigError
from orchestrator.config.study import load_study
from orchestrator.errors import RunError
from orchestrator.requests import Failed, Poured, Slots
from orchestrator.stages import deployment_stages
from orchestrator.strategies.costs import Costing
from orchestrator.strategies.deployment_d1_risk import RobustPlanning
from orchestrator.strategies.deployment_d2 import RealOnly
from orchestrator.strategies.deployment_d3 import Hybrid
from orchestrator.study.campaigns import campaign_of
from orchestrator.study.cells import cells_of
from orchestrator.study.code import code_now, warning
from orchestrator.study.folder import RESULT, StudyError, as_begun, finished_results, is_finished, opened, run_folder
from orchestrator.study.plan import StudyPlan, study_fingerprint
from orchestrator.study.strategies import FinalPour
from orchestrator.study.worker import run_cell
from sim_engine.liquid import SimulationParameters
from sim_engine.outcome import PourMeasurement
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
    chosen = {key: value for key, value in {**data, **changes}.items() if value is not None}
    return load_study(written(folder, chosen))


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


def test_without_levels_a_study_pours_on_its_laboratory_as_it_is(tmp_path: Path) -> None:
    changes = without(without(read("quick"), "mismatch"), "compared")
    study = load_study(written(tmp_path, changes))
    twin = study.base.laboratory.bench
    assert [level.name for level in study.levels] == [study.compared] == ["twin"]
    assert twin is not None
    assert study.levels[0].bench == replace(twin, time_scale=0.0), "numbers are not waited for"
    wired = {**changes, "laboratory": str(ROOT / "configs/laboratories/virtual.yaml")}
    study = load_study(written(tmp_path / "wired", wired))
    assert study.base.laboratory.arm is not None
    assert study.levels[0].bench == study.base.laboratory.bench, "an arm over wires needs its time"


def risky(folder: Path, **arm: Any) -> Path:
    """The quick study of a campaign that plans under risk."""
    campaign = YAML(typ="safe").load((ROOT / "configs/campaigns/quickstart.yaml").read_text(encoding="utf-8"))
    for section, key in (("calibration", "receiver"), ("deployment", "receiver")):
        campaign[section][key] = str((ROOT / "configs/campaigns" / campaign[section][key]).resolve())
    for key in ("laboratory", "pourer"):
        campaign[key] = str((ROOT / "configs/campaigns" / campaign[key]).resolve())
    kept = {key: campaign["deployment"][key] for key in ("receiver", "motion", "actions")}
    risk = {"measure": "expected", "pose_error": {"x": "3 mm"}, "theta": "posterior"}
    campaign["deployment"] = {**kept, "strategy": "D1", "risk": risk, "window": {"tolerance": "2 %"}}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "campaign.yaml").write_text(json.dumps(campaign), encoding="utf-8")
    data = read("quick")
    data["deployment"]["D1"]["simulations_per_iteration"] = arm.get("simulations_per_iteration", 2)
    return written(folder, {**data, "campaign": str(folder / "campaign.yaml")})


def test_risk_of_the_campaign_is_that_of_d1_and_leaves_the_others_what_they_are(tmp_path: Path) -> None:
    study = load_study(risky(tmp_path))
    plans = {arm.label: arm.plan for arm in study.deployments}
    assert plans["D1-2"].risk is not None
    assert plans["D1-2"].tolerance == pytest.approx(0.02)
    assert {plans[label].risk for label in ("D2", "D3")} == {plans[label].tolerance for label in ("D2", "D3")} == {None}
    theta = study.base.parameters.model_dump()
    rows = [{"cohesion": 0.01 * i} for i in range(3)]
    known = {"calibration": {"theta": theta, "posterior": {"thetas": rows}}}
    made = {}
    for cell in cells_of(study):
        if cell.kind == "deployment" and cell.repetition == 1 and cell.level == "small":
            plan, stages = campaign_of(study, cell, lambda name: known, tmp_path)
            made[cell.arm] = stages[0].build({}, 1)
            assert plan.deployment is not None
            if plan.deployment.risk is not None:
                assert [one.cohesion for one in plan.deployment.risk.thetas] == [0.0, 0.01, 0.02]
    assert {arm: type(one) for arm, one in made.items()} == {"D1-2": RobustPlanning, "D2": RealOnly, "D3": Hybrid}
    for arm in ("D2", "D3"):
        wrong = replace(plans[arm], risk=plans["D1-2"].risk)
        with pytest.raises(RunError, match=f"risk: belongs to D1, not to {arm}"):
            deployment_stages(study.base, wrong)
    with pytest.raises(ConfigError, match="at least 2 are needed"):
        load_study(risky(tmp_path / "few", simulations_per_iteration=1))


# -- files that can't be used ---------------------------------------------------------------------------------------


def without(data: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name != key}


WRONG: dict[str, tuple[Any, str]] = {
    "no mismatch left": (lambda d: {**without(d, "compared"), "mismatch": []}, "mismatch: is empty"),
    "hardware": (
        lambda d: {**d, "laboratory": str(ROOT / "configs/laboratories/ur10-kern.yaml")},
        "laboratory 'ur10-kern' is hardware. An arm moves only for one run, after '--arm'",
    ),
    "nothing to confirm": (lambda d: without({**d, "confirm": 1}, "deployment"), "confirm: there is no deployment"),
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
    study = replace(small(tmp_path, calibration=arms, deployment=deployment, mismatch=levels), confirm=0)
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


# -- final actions, and which code made a cell -----------------------------------------------------------------------


def test_what_is_recommended_may_be_poured_again_later_and_changes_no_other_cell(tmp_path: Path) -> None:
    quick = without(read("quick"), "confirm")
    plain, twice = (
        load_study(written(tmp_path / name, quick | more)) for name, more in (("a", {}), ("b", {"confirm": 2}))
    )
    assert study_fingerprint(plain) == study_fingerprint(twice)
    cells = cells_of(twice)
    final = [cell for cell in cells if cell.kind == "final"]
    assert tuple(cell for cell in cells if cell.kind != "final") == cells_of(plain)
    assert len(final) == 2 * sum(cell.kind == "deployment" for cell in cells)
    assert {cell.id for cell in cells_of(replace(twice, confirm=1))} < {cell.id for cell in cells}
    shared: dict[tuple[str, str, int, int], set[int]] = {}
    for cell in final:
        assert cell.needs[0] == f"deployment.{cell.level}.{cell.arm}.{cell.receiver}.{cell.repetition:02d}"
        assert cell.pours == 1
        shared.setdefault((cell.level, cell.receiver, cell.repetition, cell.again), set()).add(cell.seed)
    assert all(len(seeds) == 1 for seeds in shared.values()), "strategies of a repetition have the same chance"
    assert len(set.union(*shared.values())) == len(shared) == 2 * 1 * 2 * 2


def test_a_final_pour_is_the_recommended_action_with_fresh_chance_and_its_code_is_noted(tmp_path: Path) -> None:
    deployment = {"D2": {**read("quick")["deployment"]["D2"], "repetitions": 1}}
    changes = {"deployment": deployment, "mismatch": read("quick")["mismatch"][:1], "confirm": 2}
    study = small(tmp_path, **changes, calibration=None)
    cells = cells_of(study)
    assert [cell.kind for cell in cells] == ["deployment", "final", "final"]
    learnt, *again = (run_cell(study, cell, study.folder, ToyLaboratory) for cell in cells)  # type: ignore[arg-type]
    values = learnt["results"]["deployment:narrow"]["action_si"]
    finals = [one["results"]["final"] for one in again]
    action = study.deployments[0].plan.scenes[0].action(values)
    hidden = study.levels[0].bench.liquid
    least = toy_study.spilled(action, hidden, 0) - 0.01
    for one in finals:
        assert one["action_si"] == action.values()
        assert one["made"]
        assert least <= one["loss"] == one["spillage"] <= least + 0.02
    measured = [pour["loss"] for pour in learnt["results"]["deployment:narrow"]["pours"]]
    assert len({*measured, *(one["loss"] for one in finals)}) == len(measured) + 2, "a seed was used again"
    assert [one["pours"] for one in again] == [1, 1]
    assert learnt["code"] == code_now()


def test_an_action_that_can_not_be_poured_and_none_at_all_have_the_worst_loss(tmp_path: Path) -> None:
    plan = small(tmp_path).deployment("D2").plan
    scene = plan.scenes[0]
    costing = Costing.of(replace(plan, loss=replace(plan.loss, retained_weight=3.0)), scene, SimulationParameters())
    none = FinalPour(costing, None, 1)
    assert none.finished
    assert (none.ask(Slots(1, 1)), none.result()["loss"], none.result()["made"]) == ([], 3.0, False)
    action = scene.action(plan.actions.decode([0.5] * plan.actions.dimension))
    for outcome in (
        Failed("invalid_action", "cups touch"),
        Failed("pour_failed", "cups touch"),
        Poured(PourMeasurement(scene.liquid.mass, float("nan"), 0.0)),
    ):
        one = FinalPour(costing, action, 1)
        (request,) = one.ask(Slots(1, 1))
        assert not one.finished
        assert one.ask(Slots(1, 1)) == []
        one.tell(request, outcome)
        assert one.finished
        assert (one.result()["loss"], one.result()["spillage"], one.result()["made"]) == (3.0, 1.0, False)


def test_other_code_than_that_of_finished_cells_is_named_once_and_is_no_error(tmp_path: Path) -> None:
    same = {"code": code_now()}
    older = {"code": {**code_now(), "strategies": "0123456789ab"}}
    assert warning({}) is None
    assert warning({"a": same, "b": same}) is None
    text = warning({"a": same, "b": older, "c": {}, "d": {}}) or ""
    assert "1 finished by other code (strategies: changed since)" in text
    assert "2 finished before versions were noted" in text
    assert "\n" not in text
    (tmp_path / "a.py").write_text("x = 1", encoding="utf-8")
    before = sources(tmp_path)
    (tmp_path / "a.py").write_text("x = 2", encoding="utf-8")
    assert sources(tmp_path) != before


def test_two_commands_can_not_run_one_study(tmp_path: Path) -> None:
    study = small(tmp_path)
    with opened(study), pytest.raises(StudyError, match="another process is running this study"), opened(study):
        pass
