"""What the benchmark of calibration counts: pours that judge a θ* were never seen by it, and budgets are the same."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from orchestrator.config.file_loading import load_campaign
from orchestrator.strategies.campaign_plan import CalibrationPlan
from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def power(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import calibration_power

    return calibration_power


@pytest.fixture
def calibration(power: ModuleType) -> CalibrationPlan:
    plan = load_campaign(power.CAMPAIGN).calibration
    assert plan is not None
    return plan


@pytest.fixture
def options() -> argparse.Namespace:
    return argparse.Namespace(folds=8, fold_simulations=9, simulations=10, particles=700, known=[], as_it_is=False)


def test_every_pour_judges_once_and_slow_and_fast_ones_in_each_fold(
    power: ModuleType, calibration: CalibrationPlan
) -> None:
    assert calibration.records is not None
    pours = calibration.records.pours
    folds = power.dealt(pours, 8)
    assert sorted(i for fold in folds for i in fold) == list(range(32))
    speeds = [sorted(pours[i].action.angular_velocity / DEG for i in fold) for fold in folds]
    assert all(slow < 47 and fast > 94 for slow, *_, fast in speeds)
    assert sorted(len(fold) for fold in power.dealt(pours, 5)) == [6, 6, 6, 7, 7]


def test_what_judges_a_fold_was_not_calibrated_on(
    power: ModuleType, calibration: CalibrationPlan, options: argparse.Namespace
) -> None:
    assert calibration.records is not None
    judged = []
    for k in range(options.folds):
        job = power.job(calibration, options, f"fold {k} 11")
        pours = job.calibration.records.pours
        test = [pour.action for pour in pours if pour.split == "test"]
        assert not {pour.action for pour in pours if pour.split == "train"} & set(test)
        assert len(pours) == 32
        assert (job.splits, job.calibration.simulations, job.calibration.transfer) == (("test",), 9, None)
        assert job.calibration.parameters == calibration.parameters
        judged += test
    assert set(judged) == {pour.action for pour in calibration.records.pours}


def without_nuisances(fixed: Mapping[str, float]) -> dict[str, float]:
    """What a calibration takes as known, but for the bench's own errors and what thin liquids do not feel."""
    info = SimulationParameters.info()
    known = {name for name in fixed if info[name].nuisance} | {"viscosity_factor"}
    return {name: value for name, value in fixed.items() if name not in known}


def test_each_set_searches_one_step_more_at_the_same_budget(
    power: ModuleType, calibration: CalibrationPlan, options: argparse.Namespace
) -> None:
    jobs = [power.job(calibration, options, f"set {k} 11").calibration for k in range(len(power.growing_sets()))]
    nothing, first, second, *_, last = jobs
    assert nothing.simulations == 0
    assert nothing.fixed_parameters == calibration.fixed_parameters
    assert {job.simulations for job in jobs[1:]} == {10}
    assert first.parameters.names == ("xsph_rate",)
    assert second.parameters.names == ("xsph_rate", "cohesion")
    fixed = {name: value for name, value in calibration.fixed_parameters.items() if name != "xsph_rate"}
    assert first.fixed_parameters == fixed
    assert set(last.parameters.names) == {*calibration.parameters.names, "xsph_rate", "cohesion"}
    assert without_nuisances(last.fixed_parameters) == {"particles": 1000}
    ours = {axis.name: axis for axis in calibration.parameters.axes}
    assert all(ours.get(axis.name, axis) == axis for axis in last.parameters.axes)


def test_particles_are_the_options_where_the_campaign_does_not_fix_them(
    power: ModuleType, calibration: CalibrationPlan, options: argparse.Namespace
) -> None:
    unfixed = replace(calibration, fixed_parameters={"friction": 0.05})
    for k in range(len(power.growing_sets())):
        assert power.job(unfixed, options, f"set {k} 11").calibration.fixed_parameters["particles"] == 700


def found(train: float, test: float, errors: list[float]) -> dict[str, Any]:
    discrepancy = {"train": train, "test": test, "transfer": None}
    return {"discrepancy": discrepancy, "errors": errors, "theta": {"xsph_rate": 1.23456}, "cpu_s": 1.5}


def test_rows_are_means_over_seeds_and_folds_weigh_pours_alike(power: ModuleType) -> None:
    two = [found(0.01, 0.02, [0.1]), found(0.03, 0.06, [0.2, 0.3, 0.4])]
    two[1]["posterior"] = {"train": None, "test": 0.041}  # the first one had none, or was kept before there were any
    row = power.set_row("xsph_rate", two)
    assert (row["train_posterior_seeds"], row["test_posterior_seeds"]) == ([], [0.041])
    assert (row["train"], row["test"], row["transfer"], row["test_seeds"]) == (0.02, 0.04, None, [0.02, 0.06])
    assert (row["searched"], row["cpu_s"], row["thetas"][0]) == ("xsph_rate", 3.0, {"xsph_rate": 1.235})
    folds = power.fold_summary(two)
    assert (folds["discrepancy"], folds["pours"], folds["largest"]) == (0.25, 4, 0.4)
    assert folds["standard_error"] == pytest.approx(0.0645, abs=1e-4)  # s/√n of 0.1, 0.2, 0.3, 0.4


@pytest.mark.slow
def test_mean_of_the_others_is_what_the_records_say_it_is(power: ModuleType, calibration: CalibrationPlan) -> None:
    assert calibration.records is not None
    spillage = [pour.normalised_spillage or 0.0 for pour in calibration.records.pours]
    others = [abs(r - (sum(spillage) - r) / 31) for r in spillage]
    told = power.without_simulator(calibration, [[i] for i in range(32)])
    assert told["mean"] == pytest.approx(sum(others) / 32, abs=1e-4)
    assert told["regression"] < told["mean"]


def test_what_was_made_is_kept_and_what_broke_off_is_not(
    power: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(len(made))
        if len(made) == 1:
            raise SystemExit("killed")
        return {"number": len(made)}

    with pytest.raises(SystemExit):
        power.Kept(fresh=False).get(["a"], make)
    assert power.Kept(fresh=False).get(["a"], make) == {"number": 2}
    assert power.Kept(fresh=False).get(["a"], make) == {"number": 2}
    assert power.Kept(fresh=False).get(["b"], make) == {"number": 3}
    assert power.Kept(fresh=True).get(["a"], make) == {"number": 4}


def test_what_can_t_be_measured_is_refused(power: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusal(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["calibration_power.py", *arguments])
        with pytest.raises(SystemExit) as refused:
            power.main()
        return str(refused.value)

    assert refusal("--folds=33") == "--folds 33: 2 to 32 are possible with 32 recorded pours"
    quickstart = power.ROOT / "configs" / "campaigns" / "quickstart.yaml"
    assert "a campaign with recorded pours is needed" in refusal(str(quickstart))
    assert refusal("nowhere.yaml") == "nowhere.yaml: no such file"


def test_the_campaign_as_it_is_searches_what_it_searches_with_the_seed_that_is_asked_for(
    power: ModuleType, calibration: CalibrationPlan, options: argparse.Namespace
) -> None:
    options.as_it_is, options.searched = True, calibration.parameters.names
    assert len(power.wanted_sets(options)) == 1
    one = power.job(calibration, options, "set 0 12")
    assert one.calibration.parameters == calibration.parameters
    assert one.calibration.fixed_parameters == calibration.fixed_parameters
    assert one.seed == 12


def test_a_last_row_takes_some_parameters_as_known(
    power: ModuleType, calibration: CalibrationPlan, options: argparse.Namespace
) -> None:
    options.known = ["wall_distance=1.5", "rim_correction=0"]
    last = power.job(calibration, options, f"set {len(power.growing_sets())} 11").calibration
    assert set(last.parameters.names) == {"cohesion", "xsph_rate", "friction", "smagorinsky_constant"}
    assert without_nuisances(last.fixed_parameters) == {"particles": 1000, "wall_distance": 1.5, "rim_correction": 0.0}
    options.known = ["wall_distanse=1.5"]
    with pytest.raises(SystemExit, match="wall_distanse"):
        power.wanted_sets(options)
