"""`study_plan`: a study's cells are a pure function of its file, and what is wrong with the file is said with its
place.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from orchestrator.campaigns.campaign_checks import touch
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.study.study_campaigns import campaign_of
from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import cells_of, estimated_seconds
from sim_engine.vessel.vessel import build_vessel
from tests.support.study_files import ROOT, STUDIES, read, small, without, written


def test_the_paper_study_has_the_repetitions_that_it_promises() -> None:
    cells = cells_of(load_study(STUDIES / "paper.yaml"))
    count = Counter((cell.kind, cell.strategy, cell.level) for cell in cells)
    assert [count["calibration", strategy, "searched"] for strategy in ("C1", "C2", "C3", "C4")] == [6, 3, 3, 6]
    for level in ("searched", "moderate", "large"):
        assert count["pours", "", level] == 6
        for strategy in ("D1-uncalibrated", "D1-15", "D2", "D3"):
            assert count["deployment", strategy, level] == 3 * 6
    spent = {
        strategy: sum(c.simulations - 2 * 40 for c in cells if c.strategy == strategy) for strategy in ("C2", "C3")
    }
    assert spent == {"C2": 3 * 504, "C3": 3 * 1652}
    assert [c.simulations for c in cells if c.kind == "grid"] == [100 * 40]


def test_one_bench_of_the_paper_study_differs_from_the_simulator_in_what_is_searched_alone() -> None:
    study = load_study(STUDIES / "paper.yaml")
    bench, plan = study.level(study.compared).bench, study.calibration("C4").plan
    default = study.base.parameters
    assert bench is not None
    differs = {name for name, value in bench.theta if value != getattr(default, name)}
    assert differs == {axis.name for axis in plan.parameters.axes} == {"particles", "friction"}
    assert bench.pose_error == type(bench.pose_error)(), "the receiver stands where the arm assumes it"
    places = {
        axis.name: abs(axis.encode(getattr(bench.theta, axis.name)) - axis.encode(getattr(default, axis.name)))
        for axis in plan.parameters.axes
    }
    assert places == pytest.approx({"particles": 1 / 3, "friction": 1 / 3}, abs=0.01)


def test_the_uncalibrated_baseline_plans_with_the_defaults_and_needs_no_calibration(tmp_path: Path) -> None:
    strategy = {"repetitions": 2, "simulations_per_iteration": 1}
    strategies = {"D1": {**strategy, "iterations": [2]}, "D1_uncalibrated": {**strategy, "iterations": [2]}}
    study = load_study(written(tmp_path, {**read("quick"), "deployment": strategies}))
    cells = {cell.strategy: cell for cell in cells_of(study) if cell.kind == "deployment" and cell.repetition == 1}
    assert cells["D1-2"].needs == ("calibration.large.C4.01",)
    assert cells["D1-uncalibrated"].needs == ()
    assert cells["D1-2"].seed == cells["D1-uncalibrated"].seed, "they differ in θ alone"
    request = campaign_of(study, cells["D1-uncalibrated"], lambda _: pytest.fail("it loads no results"), tmp_path)
    assert request.campaign.parameters == study.base.parameters
    without_c4 = {key: value for key, value in read("quick").items() if key != "calibration"}
    alone = load_study(written(tmp_path / "alone", {**without_c4, "deployment": {"D1_uncalibrated": strategy}}))
    assert {cell.kind for cell in cells_of(alone)} == {"deployment", "final"}
    with pytest.raises(ConfigError, match=r"D1_uncalibrated.iterations: 2 numbers, but the baseline is one plan"):
        load_study(
            written(
                tmp_path / "two",
                {**read("quick"), "deployment": {"D1_uncalibrated": {**strategy, "iterations": [2, 3]}}},
            )
        )


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
    seeds: dict[tuple[str, str, str, int, int], set[int]] = {}
    for cell in cells_of(load_study(STUDIES / "paper.yaml")):
        kind = "calibration" if cell.kind == "uncalibrated" else cell.kind
        seeds.setdefault((kind, cell.level, cell.receiver, cell.repetition, cell.again), set()).add(cell.seed)
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
    assert study.levels[0].bench == twin.with_values(time_scale=0.0), "numbers are not waited for"
    wired = {**changes, "laboratory": str(ROOT / "configs/laboratories/virtual.yaml")}
    study = load_study(written(tmp_path / "wired", wired))
    assert study.base.laboratory.arm is not None
    assert study.levels[0].bench == study.base.laboratory.bench, "an arm over wires needs its time"


WRONG: dict[str, tuple[Any, str]] = {
    "no mismatch left": (lambda d: {**without(d, "compared"), "mismatch": []}, "mismatch: is empty"),
    "hardware": (
        lambda d: {**d, "laboratory": str(ROOT / "configs/laboratories/ur10-kern.yaml")},
        "laboratory 'ur10-kern' is hardware. An arm moves only for one run, after '--enable-motion'",
    ),
    "nothing to confirm": (lambda d: without({**d, "confirm": 1}, "deployment"), "confirm: there is no deployment"),
    "unknown level": (lambda d: {**d, "compared": "huge"}, "compared: no such level; there are small, large"),
    "level twice": (lambda d: {**d, "mismatch": [d["mismatch"][0]] * 2}, "mismatch[1]: a level 'small'"),
    "not searched": (lambda d: {**d, "search": ["xsph_rate"]}, "search[0]: 'xsph_rate' is not searched"),
    "nothing left to search": (
        lambda d: {
            **without(d, "search"),
            "parameters": {
                "particles": 500,
                "cohesion": "0 N/m",
                "friction": 0.1,
                "wall_distance": 0.5,
                "receiver_x": "0 mm",
            },
        },
        "parameters: fixes all that the campaign searches",
    ),
    "no bench": (
        lambda d: {**d, "laboratory": str(ROOT / "configs/laboratories/planning.yaml")},
        "laboratory 'planning' has no virtual bench",
    ),
    "no such campaign": (lambda d: {**d, "campaign": "nothing.yaml"}, "campaign: no such file"),
    "another's key": (
        lambda d: {
            **d,
            "calibration": {**d["calibration"], "C1": {"repetitions": 1, "points_per_axis": 2, "samples": 3}},
        },
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
    "empty calibration and deployment": (
        lambda d: {**d, "calibration": {}, "deployment": {}},
        "calibration: there is nothing to compare; name a strategy, for example 'C4: {repetitions: 10, ",
    ),
    "empty deployment alone": (
        lambda d: {**without(d, "calibration"), "deployment": {}},
        "deployment: there is nothing to compare; name a strategy, for example 'D2: {repetitions: 10, pours: 15}'",
    ),
    "empty list of iterations": (
        lambda d: {**d, "deployment": {"D1": {"repetitions": 1, "iterations": []}}},
        "deployment.D1.iterations: is empty; name at least one",
    ),
    "too many final pours": (
        lambda d: {**d, "confirm": 1_000_000_000},
        "confirm: 1000000000 is too large; at most 2,000",
    ),
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


MEASURED = {
    "calibration.moderate.C4.01": 80.4,
    "deployment.moderate.D1-15.deployment-cone.01": 37.0,
    "deployment.moderate.D3.deployment-narrow.01": 75.1,
    "uncalibrated.moderate.01": 6.9,
}
"""CPU seconds of cells of the shipped study of figure 6, one at a time on a core that other programs used too."""


def test_the_estimate_of_cpu_time_is_good_to_a_factor_of_two() -> None:
    study = load_study(ROOT / "configs" / "studies" / "figure-6.yaml")
    estimated = {cell.id: estimated_seconds(study, cell) for cell in cells_of(study)}
    for name, seconds in MEASURED.items():
        assert 0.5 < estimated[name] / seconds < 2.0, name
    assert 15 * 60 < sum(estimated.values()) < 2 * 15 * 60, "it fits 15 minutes of two cores"
