"""The benchmark that compares C1 to C4: the same pours judge all of them, and nobody spends more than it may."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from actors.optimizer.suggest import propose
from orchestrator.config.file_loading import load_campaign
from orchestrator.requests import Outcome, Request, Simulate, Simulated, Suggest, Suggested
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategy_harness import outcome_of
from sim_engine.action import Action

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import calibration_strategies

    return calibration_strategies


@pytest.fixture
def plan(bench: ModuleType) -> CampaignPlan:
    found: CampaignPlan = bench.searched(load_campaign(bench.CAMPAIGN), ["wall_distance", "rim_correction"], {})
    return found


class Toy:
    """A simulator that knows the recorded pours, and is right where its liquid keeps 1.2 spacings from walls."""

    def __init__(self, plan: CampaignPlan) -> None:
        assert plan.calibration is not None
        assert plan.calibration.records is not None
        self._pours = plan.calibration.records.pours

    def __call__(self, request: Request) -> Outcome:
        if isinstance(request, Suggest):
            return Suggested(propose(request.query))
        assert isinstance(request, Simulate)
        near = min(self._pours, key=lambda pour: _apart(pour.action, request.action))
        off = 0.5 * (request.parameters.wall_distance - 1.2)
        return Simulated(outcome_of(min(max((near.normalised_spillage or 0.0) - off, 0.0), 1.0)))

    def close(self) -> None:
        pass


def _apart(one: Action, other: Action) -> float:
    return abs(one.angular_velocity - other.angular_velocity) + abs(one.max_angle - other.max_angle)


def test_budgets_are_the_papers_and_none_is_exceeded(bench: ModuleType, plan: CampaignPlan) -> None:
    calibration = plan.calibration
    assert calibration is not None
    c1, c2, c3, c4 = (
        bench.at_price(calibration, bench.Row(name, budget))
        for name, budget in (("C1", 2800), ("C2", 504), ("C3", 1652), ("C4", 108))
    )
    assert c1.settings.grid == {"wall_distance": 10, "rim_correction": 10}
    assert (c2.settings.thetas, c3.settings.thetas, c4.simulations) == (18, 59, 108)
    assert [one.simulations for one in (c1, c2, c3)] == [2800, 504, 1652]
    for name in ("C1", "C2", "C3", "C4"):
        assert bench.at_price(calibration, bench.Row(name, 300)).simulations <= 300
    with pytest.raises(SystemExit, match="too few for 2 parameters and 28 pours"):
        bench.at_price(calibration, bench.Row("C1", 111))


@pytest.mark.parametrize(("name", "budget"), [("C1", 140), ("C2", 140), ("C3", 280), ("C4", 20)])
def test_a_calibrated_simulator_beats_an_uncalibrated_one_on_pours_that_it_never_saw(
    bench: ModuleType, plan: CampaignPlan, name: str, budget: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "Answers", Toy)
    assert plan.calibration is not None
    row = bench.Row(name, budget)
    priced = replace(plan, calibration=bench.at_price(plan.calibration, row))
    found: dict[str, Any] = bench.measure(priced, row, 11)
    without = bench.measure(plan, bench.Row(bench.UNCALIBRATED), 11)
    assert found["simulations"] <= budget
    assert set(found["discrepancy"]) == {"train", "test", "transfer"}
    assert found["discrepancy"]["test"] < 0.6 * without["discrepancy"]["test"]
    assert {split: len(errors) for split, errors in found["errors"].items()} == {"train": 28, "test": 4, "transfer": 16}
    shown = bench.table_row(row, priced.calibration, [found, found])
    assert shown["test_seeds"] == [shown["test"]] * 2
    assert len(shown["unseen_quartiles"]) == 3
    low, high = shown["transfer_interval"]
    assert low <= shown["transfer"] <= high


def test_random_parameters_are_told_by_their_median(
    bench: ModuleType, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "Answers", Toy)
    found = bench.measure(plan, bench.Row(bench.RANDOM, 5), 1)
    assert found["discrepancy"]["test"] > 0.0
    assert found["theta"] is None


def test_what_can_t_be_compared_is_refused(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusal(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["calibration_strategies.py", *arguments])
        with pytest.raises(SystemExit) as refused:
            bench.main()
        return str(refused.value)

    assert "--rows C7=3: should be a strategy and its simulations" in refusal("--rows", "C7=3")
    assert "not searched by recorded.yaml; it searches smagorinsky_constant, friction, wall" in refusal(
        "--search", "cohesion"
    )
    assert "--known rim_correction: searched as well" in refusal("--known", "rim_correction=0")
    quickstart = BENCHMARKS.parent / "configs" / "campaigns" / "quickstart.yaml"
    assert "a campaign with recorded pours is needed" in refusal(str(quickstart))


@pytest.mark.slow
def test_the_table_is_of_what_was_made_and_what_was_kept_is_not_made_again(
    bench: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(bench, "Answers", Toy)
    made: list[dict[str, Any]] = []

    def here(script: str, *arguments: str) -> dict[str, Any]:
        """What a process of its own would print."""
        before, printed = sys.argv, io.StringIO()
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        with contextlib.redirect_stdout(printed):
            bench.main()
        monkeypatch.setattr(sys, "argv", before)
        made.append(json.loads(printed.getvalue()))
        return made[-1]

    def table(*more: str) -> list[dict[str, Any]]:
        arguments = [
            "--rows",
            "C4=20",
            "--random",
            "2",
            "--known",
            "smagorinsky_constant=0",
            "--once",
            "random",
            *more,
            "--json",
        ]
        monkeypatch.setattr(sys, "argv", ["calibration_strategies.py", *arguments])
        bench.main()
        rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out.strip().splitlines()[-1])["rows"]
        return rows

    monkeypatch.setattr(bench, "run_self", here)
    rows = table("--seeds", "11", "12")
    assert [(row["strategy"], row["seeds"]) for row in rows] == [
        ("defaults", 2), ("uncalibrated", 2), ("random", 1), ("C4", 2)
    ]  # fmt: skip
    assert len(made) == 7
    found = [one for one in made if one["simulations"] == 20]
    for split in ("train", "test", "transfer"):
        values = [one["discrepancy"][split] for one in found]
        assert rows[-1][f"{split}_seeds"] == pytest.approx(values, abs=1e-4)
        assert rows[-1][split] == pytest.approx(sum(values) / 2, abs=1e-4)
        low, high = rows[-1][f"{split}_interval"]
        assert low <= rows[-1][split] <= high
    assert [theta["smagorinsky_constant"] for theta in rows[-1]["thetas_found"]] == [0.0, 0.0]
    assert rows[0]["thetas_found"][0]["smagorinsky_constant"] > 0.0

    monkeypatch.setattr(bench, "run_self", lambda *arguments: pytest.fail("made again"))
    assert table("--seeds", "11", "12") == rows
    assert table("--seeds", "11", "12", "13", "--kept") == rows  # of the third seed nothing was made
