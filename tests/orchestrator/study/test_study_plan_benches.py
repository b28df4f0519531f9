"""`study_plan`: the study of hidden benches: compared on all of them, scored in other vessels, beside random θ and
chosen pours.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import Scores
from orchestrator.learning.calibration.pour_design import DesignResult
from orchestrator.records.codec import result_of
from orchestrator.runs.stages import CALIBRATION, EVALUATION, POURS
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import finished_results
from orchestrator.study.study_page import write_report
from orchestrator.study.study_plan import StudyPlan, cells_of
from orchestrator.study.study_statistics import RANDOM, gather
from sim_engine.scene import PourTask
from sim_engine.simulator import InvalidSceneError, PourSimulator
from tests.support.study_files import STUDIES, read, written
from tests.support.toy_study import run_toy_study

LEVELS = ("bench1", "bench2")


def cut(folder: Path, **changes: Any) -> StudyPlan:
    """Two of the benches, one repetition, little of everything."""
    data = read("benches")
    data["mismatch"] = [level for level in data["mismatch"] if level["name"] in LEVELS]
    data["random_baseline"] = 2
    data["calibration"] = {
        "C4": {"repetitions": 1, "simulations": 12},
        "C4_active": {"repetitions": 1, "simulations": 12, "pours": 4, "design_simulations": 16},
    }
    data["deployment"] = {"D2": {"repetitions": 1, "pours": 2, "initial_samples": 2}}
    return load_study(written(folder, {**data, **changes, "confirm": 0}))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyPlan, Any]:
    study = cut(tmp_path_factory.mktemp("benches"))
    status = run_toy_study(study)
    assert not status.failed
    return study, finished_results(study.folder, cells_of(study))


def test_every_bench_has_every_arm_as_often_as_promised() -> None:
    study = load_study(STUDIES / "benches.yaml")
    assert len(study.levels) >= 8
    count = Counter((cell.kind, cell.strategy, cell.level) for cell in cells_of(study))
    for level in study.levels:
        assert count["calibration", "C4", level.name] == count["calibration", "C4-active", level.name] == 3
        assert count["uncalibrated", "", level.name] == 3
        assert count["deployment", "D3", level.name] == 2 * 3


def test_no_bench_lets_the_cups_touch_where_calibration_and_deployment_pour() -> None:
    study, simulator = load_study(STUDIES / "benches.yaml"), PourSimulator()
    calibration, deployment = study.base.calibration, study.deployments[0].plan
    assert calibration is not None
    spaces = [(scene, calibration.actions) for scene in calibration.poured]
    spaces += [(scene, deployment.actions) for scene in deployment.scenes]
    for scene, actions in spaces:
        low = {axis.name: axis.lower for axis in actions.axes}
        for level in study.levels:
            task = PourTask(scene, scene.action(low), level.bench.theta, 1, pose_error=level.bench.pose_error.error)
            try:
                simulator.prepare(task)
            except InvalidSceneError as error:
                pytest.fail(f"{level.name}, {scene.receiver.name}: {error}")


@pytest.mark.slow
def test_calibrations_are_scored_in_vessels_that_they_did_not_learn_in(played: tuple[StudyPlan, Any]) -> None:
    _, results = played
    for strategy in ("C4", "C4-active"):
        scores = result_of(results[f"calibration.bench1.{strategy}.01"].results, EVALUATION, Scores)
        tested = {pair.scene for pair in scores.pairs if pair.split == "test"}
        assert tested == {"calibration-narrow", "calibration-cone"}, strategy
        assert not tested & {pair.scene for pair in scores.pairs if pair.split == "train"}


@pytest.mark.slow
def test_the_active_arm_learns_on_its_own_few_pours_and_is_scored_on_the_same_ones(
    played: tuple[StudyPlan, Any],
) -> None:
    _, results = played
    own = result_of(results["pours.bench1.C4-active.01"].results, POURS, DesignResult)
    assert len(own.measured) == 4
    assert own.simulated
    even, active = (
        result_of(results[f"calibration.bench1.{strategy}.01"].results, EVALUATION, Scores)
        for strategy in ("C4", "C4-active")
    )
    weighed = [
        [pair.measured for pair in one.pairs if pair.split == "test" and pair.theta == "theta"]
        for one in (even, active)
    ]
    assert weighed[0] == weighed[1]
    calibrated = result_of(results["calibration.bench1.C4-active.01"].results, CALIBRATION, Calibrated)
    assert calibrated.training_pours == 4


@pytest.mark.slow
def test_the_report_compares_them_on_all_benches(played: tuple[StudyPlan, Any]) -> None:
    study, results = played
    found = gather(study, results)
    assert list(found.calibrated) == ["uncalibrated", RANDOM, "C4", "C4-active"]
    for one in found.calibrated.values():
        assert len({*one.numbers}) == len(LEVELS)
    write_report(study, study.folder)
    page = (study.folder / "report" / "index.html").read_text()
    assert "C4-active − C4" in page
    assert f"C4 − {RANDOM}" in page


def test_a_study_knows_its_levels(tmp_path: Path) -> None:
    assert cut(tmp_path).compares("bench2")
    with pytest.raises(ConfigError, match="no such level; there are bench1, bench2, and all"):
        cut(tmp_path, compared="bench3")
