"""`study_runner`: whatever of a study is killed, it goes on and comes to the same; finished cells are kept."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from actors.simulators.local_worker import thread_pool
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.requests import Failed, Poured, Slots
from orchestrator.records.run_record import read_record
from orchestrator.runs.run_service import RunResources
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import (
    RESULT,
    CellResult,
    StudyError,
    code_now,
    code_warning,
    finished_results,
    is_finished,
    opened,
    run_folder,
)
from orchestrator.study.study_plan import StudyPlan, cells_of, study_fingerprint
from orchestrator.study.study_runner import run_cell
from orchestrator.study.study_strategies import FinalPour
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement
from sim_engine.solver_fingerprint import folder_digest
from tests.support import toy_study
from tests.support.fake_simulator import make_fake
from tests.support.study_files import ROOT, read, small, without, written
from tests.support.toy_campaign import logical_record
from tests.support.toy_study import PAUSE, TOYS, run_toy_study
from tests.support.waiting import PATIENCE


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


@pytest.mark.realtime
@pytest.mark.slow
def test_killed_in_the_middle_it_goes_on_and_comes_to_what_an_undisturbed_one_comes_to(tmp_path: Path) -> None:
    strategies = read("quick")["calibration"]
    changes = {
        "calibration": {"C1": strategies["C1"], "C4": {**strategies["C4"], "repetitions": 1}},
        "deployment": {"D3": {**read("quick")["deployment"]["D3"], "pours": 2, "repetitions": 1}},
        "mismatch": read("quick")["mismatch"][:1],
    }
    undisturbed, disturbed = small(tmp_path / "one", **changes), small(tmp_path / "two", **changes)
    cells = cells_of(undisturbed)
    for cell in cells:
        run_cell(undisturbed, cell, undisturbed.folder, TOYS)
    process = toy_process(disturbed, 0.05)
    deadline = time.monotonic() + PATIENCE
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
    assert all(one.results["calibration"].simulations == 4 * 4 for one in scored)
    # θ* and the uncalibrated θ, on six pours each
    assert all(one.simulations == 2 * 6 for one in scored), "the grid was simulated again"
    planned = {cell.id: cell.simulations for cell in cells if cell.kind == "calibration"}
    assert {name: results[name].simulations for name in planned} == planned, "the estimate counts other simulations"
    assert scored[0].results["calibration"].trials != scored[1].results["calibration"].trials
    splits = [[p.split for p in results[f"pours.small.0{n}"].results["pours"].pours] for n in (1, 2)]
    actions = [[p.action for p in results[f"pours.small.0{n}"].results["pours"].pours] for n in (1, 2)]
    assert actions[0] == actions[1]
    assert splits[0] != splits[1]
    theta = results["calibration.small.C4.01"].results["calibration"].found.theta.model_dump()
    resolved = run_folder(disturbed.folder, "deployment.small.D3.deployment-narrow.01") / "resolved.json"
    assert load_campaign(resolved).parameters.model_dump() == theta


@pytest.mark.realtime
@pytest.mark.slow
def test_a_cell_that_fails_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    strategies, levels = (
        {"C4": {"repetitions": 1, "simulations": 4, "initial_samples": 4}},
        read("quick")["mismatch"][:1],
    )
    deployment = {"D3": {**read("quick")["deployment"]["D3"], "pours": 1, "repetitions": 1}}
    study = replace(small(tmp_path, calibration=strategies, deployment=deployment, mismatch=levels), confirm=0)
    blocked = run_folder(study.folder, "calibration.small.C4.01")
    blocked.mkdir(parents=True)
    (blocked / "journal.sqlite").write_bytes(b"no journal at all, but as long as one" * 40)
    status = run_toy_study(study)
    assert set(status.failed) == {"calibration.small.C4.01"}
    assert "not a journal" in status.failed["calibration.small.C4.01"]
    assert status.skipped == {"deployment.small.D3.deployment-narrow.01"}, "it needs the θ* that there is none of"
    assert len(status.finished) == len(cells_of(study)) - 2


def test_d3_of_a_study_is_told_what_the_calibration_of_its_repetition_has_shown_as_in_a_campaign(
    tmp_path: Path,
) -> None:
    calibration = {"C4": {"repetitions": 1, "simulations": 8, "initial_samples": 4}}
    deployment = {"D3": {**read("quick")["deployment"]["D3"], "pours": 1, "repetitions": 1}}
    levels = read("quick")["mismatch"][:1]
    study = small(tmp_path, calibration=calibration, deployment=deployment, mismatch=levels, confirm=None)
    for cell in cells_of(study):
        run_cell(study, cell, study.folder, TOYS)
    logged = read_record(run_folder(study.folder, "deployment.small.D3.deployment-narrow.01")).decisions
    told = [decision.text for decision in logged if "calibration pours into" in decision.text]
    assert any("the first predictions are based on this" in text for text in told), told


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
        assert cell.needs[0] == f"deployment.{cell.level}.{cell.strategy}.{cell.receiver}.{cell.repetition:02d}"
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
    learnt, *again = (run_cell(study, cell, study.folder, TOYS) for cell in cells)
    values = learnt.results["deployment:narrow"].recommended.action_si
    finals = [one.results["final"] for one in again]
    action = study.deployments[0].plan.scenes[0].action(values)
    hidden = study.levels[0].bench.theta
    least = toy_study.spilled(action, hidden, 0) - 0.01
    for one in finals:
        assert one.action_si == action.values()
        assert one.made
        assert least <= one.loss == one.spillage <= least + 0.02
    measured = [pour.loss for pour in learnt.results["deployment:narrow"].pours]
    assert len({*measured, *(one.loss for one in finals)}) == len(measured) + 2, "a seed was used again"
    assert [one.pours for one in again] == [1, 1]
    assert learnt.code == code_now()


def test_the_cells_of_a_worker_share_a_simulator_and_none_of_them_closes_it(tmp_path: Path) -> None:
    deployment = {"D2": {**read("quick")["deployment"]["D2"], "repetitions": 1}}
    changes = {"deployment": deployment, "mismatch": read("quick")["mismatch"][:1], "confirm": 1}
    study = small(tmp_path, **changes, calibration=None)
    log = tmp_path / "simulator.log"
    simulators = thread_pool(make=make_fake(log=log))
    resources = RunResources(in_process=True, simulators=simulators)
    pours = [run_cell(study, cell, study.folder, resources).pours for cell in cells_of(study)]
    assert len(pours) > 1
    assert all(pours)
    happened = [line.split()[0] for line in log.read_text(encoding="utf-8").splitlines()]
    assert happened == ["made", *["begin", "end"] * sum(pours)]
    asyncio.run(simulators.close())
    assert log.read_text(encoding="utf-8").splitlines()[-1].startswith("closed")


def test_an_action_that_can_not_be_poured_and_none_at_all_have_the_worst_loss(tmp_path: Path) -> None:
    plan = small(tmp_path).deployment("D2").plan
    scene = plan.scenes[0]
    costing = Costing.of(replace(plan, loss=plan.loss.with_values(retained_weight=3.0)), scene, SimulationParameters())
    none = FinalPour(costing, None, 1)
    assert none.finished
    assert (none.ask(Slots(1, 1)), none.result().loss, none.result().made) == ([], 3.0, False)
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
        assert (one.result().loss, one.result().spillage, one.result().made) == (3.0, None, False)


def test_other_code_than_that_of_finished_cells_is_named_once_and_is_no_error(tmp_path: Path) -> None:
    same = CellResult(results={}, simulations=0, pours=0, cpu_s=0.0, seconds=0.0, expected=(), code=code_now())
    older = same.model_copy(update={"code": {**code_now(), "strategies": "0123456789ab"}})
    assert code_warning({}) is None
    assert code_warning({"a": same, "b": same}) is None
    text = code_warning({"a": same, "b": older, "c": same}) or ""
    assert "1 finished by other code (strategies: changed since)" in text
    assert "\n" not in text
    assert folder_digest(tmp_path / "nothing") not in code_now().values(), "a folder of the code has moved"
    (tmp_path / "a.py").write_text("x = 1", encoding="utf-8")
    before = folder_digest(tmp_path)
    (tmp_path / "a.py").write_text("x = 2", encoding="utf-8")
    assert folder_digest(tmp_path) != before


def test_two_commands_can_not_run_one_study(tmp_path: Path) -> None:
    study = small(tmp_path)
    with opened(study), pytest.raises(StudyError, match="another process is running this study"), opened(study):
        pass


def test_a_dry_run_tells_by_arm_what_is_left_and_begins_nothing(tmp_path: Path) -> None:
    study = small(tmp_path, mismatch=read("quick")["mismatch"][:1])
    assert study.source is not None
    first = CliRunner().invoke(app, ["study", "run", str(study.source), "--dry-run"])
    assert first.exit_code == 0, first.output
    assert not study.folder.exists()
    cells = cells_of(study)
    pours = [cell for cell in cells if cell.kind == "pours"]
    rows = dict(re.findall(r"(?m)^(\S.*?\S)  +(.+)$", first.stdout))
    each = study.pour_count
    assert rows["pours small"] == f"0 of {len(pours)} finished, left: 0 simulations, {each * len(pours)} pours"
    assert f"{len(cells)} cells, {len(cells)} left" in first.stdout
    run_cell(study, pours[0], study.folder, TOYS)
    then = CliRunner().invoke(app, ["study", "run", str(study.source), "--dry-run"]).stdout
    assert f"pours small {' ' * 22} 1 of {len(pours)} finished" in then
    assert f"{len(cells)} cells, {len(cells) - 1} left" in then
