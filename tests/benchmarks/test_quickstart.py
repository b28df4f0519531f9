"""`benchmarks/quickstart.py` simulates nothing twice, and counts what it says it counts."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from orchestrator.runs.strategy_harness import SCENE
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PourTask
from tests.support.fake_simulator import make_fake


@pytest.fixture
def quickstart(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import quickstart

    return quickstart


def run_of(*losses: float, recommended: int, ended: str | None = None) -> dict[str, Any]:
    pours = [{"at": [i, i], "loss": loss, "predicted": 0.02, "band": [0.005, 0.03]} for i, loss in enumerate(losses)]
    return {"seed": 7, "pours": pours, "recommended": [recommended, recommended], "ended": ended}


def test_a_pour_that_was_simulated_once_is_answered_from_its_file(quickstart: ModuleType, tmp_path: Path) -> None:
    action = SCENE.action({"angular_velocity": 1.0, "x_offset": 0.1})
    tasks = [PourTask(SCENE, action, SimulationParameters(), seed) for seed in (1, 2, 1)]

    async def answers() -> tuple[list[Any], int]:
        pool = quickstart.KeptPours(tmp_path / "pours.jsonl", make=make_fake())
        found = [(await pool.simulate(task)).outcome for task in tasks]
        await pool.close()
        return found, pool.simulated

    first, made = asyncio.run(answers())
    again, made_again = asyncio.run(answers())
    assert (made, made_again) == (2, 0)
    assert first == again
    assert first[0] == first[2] != first[1]


def test_only_pours_after_the_first_good_one_count_as_bad(quickstart: ModuleType) -> None:
    found = quickstart.figures(run_of(0.4, 0.005, 0.2, 0.02, recommended=1))
    assert (found["good"], found["bad"], found["after"], found["final"]) == (2, 1, 0.2, 0.005)
    never = quickstart.figures(run_of(0.4, 0.2, recommended=1))
    assert (never["good"], never["bad"]) == (3, 0)
    assert math.isnan(never["after"])


def test_the_summary_says_what_was_asked(quickstart: ModuleType) -> None:
    good = run_of(0.02, 0.005, recommended=1, ended="good enough: the best action is expected to lose 0.8 %")
    text = quickstart.summary([good, run_of(0.03, 0.02, 0.02, recommended=1)])
    assert "no pour above 10 % after the first below 1 % in 2 of them; 2.5 pours in the median" in text
    assert "below 1 % in 1 of them, in the median at pour 2" in text
    assert "5 of 5 pours (100 %) lie in their 90 % bands" in text
    assert "3 of 4 pours (75 %)" in quickstart.summary([run_of(0.02, 0.04, 0.03, 0.005, recommended=0)])


def test_coverage_counts_pours_with_and_without_scaled_intervals(quickstart: ModuleType) -> None:
    runs = [run_of(0.02, 0.01, 0.04, recommended=0), run_of(0.5, 0.02, recommended=0)]
    for run in runs:
        for pour in run["pours"]:
            pour["unscaled"] = [0.0, 1.0]
    rows = quickstart.coverage_table(runs)["rows"]
    # the score of an interval is its width, and 20 times the distance of a loss outside
    assert rows == [
        ["first pours", "2", "50 %", "4.7250", "100 %", "1.0000"],
        ["all others", "3", "67 %", "0.0917", "100 %", "1.0000"],
        ["all", "5", "60 %", "1.9450", "100 %", "1.0000"],
    ]


def test_the_arm_of_all_pours_does_not_stop(quickstart: ModuleType, tmp_path: Path) -> None:
    from decant.running import build_campaign

    content = quickstart.on_numbers(3, quickstart.ROOT / "configs" / "laboratories" / "twin.yaml", str(tmp_path))
    quickstart.ARMS["all pours"](content)
    deployment = build_campaign(content, tmp_path).deployment
    assert deployment is not None
    assert (deployment.settings.pours, deployment.settings.stop, deployment.settings.good_enough) == (15, None, None)


def test_a_seed_counts_as_halved_by_its_error_on_the_test_pours(quickstart: ModuleType) -> None:
    theta = {"friction": 0.3, "receiver_x": 0.0132}
    runs = [
        {"seed": 201, "test": {"theta": 0.04, "uncalibrated": 0.12}, "theta": theta},
        {"seed": 202, "test": {"theta": 0.07, "uncalibrated": 0.12}, "theta": theta},
    ]
    rows = quickstart.calibration_table(runs)["rows"]
    assert rows == [
        ["201", "12.0", "4.0", "yes", "0.30", "13.2 mm"],
        ["202", "12.0", "7.0", "no", "0.30", "13.2 mm"],
    ]


def test_the_benchmark_s_bench_has_the_ground_truth_of_the_campaign_s_own_laboratory(
    quickstart: ModuleType, tmp_path: Path
) -> None:
    from decant.running import build_campaign, load_campaign

    twin = quickstart.ROOT / "configs" / "laboratories" / "twin.yaml"
    campaign = build_campaign(quickstart.on_numbers(3, twin, str(tmp_path)), tmp_path)
    bench, shipped = campaign.laboratory.bench, load_campaign(quickstart.CAMPAIGN).laboratory.bench
    assert bench is not None
    assert shipped is not None
    assert (campaign.laboratory.name, campaign.seed) == ("twin", 3)
    assert (bench.theta, bench.pose_error, bench.pose_noise) == (shipped.theta, shipped.pose_error, shipped.pose_noise)
