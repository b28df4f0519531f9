"""`benchmarks/recorded_predictions.py` changes pours as little as it says, and counts what it says it counts."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from orchestrator.config.file_loading import load_campaign

ROOT = Path(__file__).parents[1]


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import recorded_predictions

    return recorded_predictions


def found(*predicted: float, friction: float = 0.1) -> dict[str, Any]:
    pours = [
        {"split": split, "recorded": 0.10, "predicted": value, "low": value - 0.03, "high": value + 0.03}
        for split, value in zip(("test", "transfer"), predicted, strict=True)
    ]
    return {"theta": {"friction": friction}, "pours": pours}


def test_masses_change_by_one_part_in_ten_million(benchmark: ModuleType) -> None:
    plan = load_campaign(benchmark.CAMPAIGN)
    changed = benchmark.perturbed(plan, 1)
    for before, after in zip(plan.calibration.records.pours, changed.calibration.records.pours, strict=True):
        assert abs(after.poured / before.poured - 1.0) == pytest.approx(1e-7, rel=1e-6)
        assert after.action == before.action
    assert benchmark.perturbed(plan, 1) == changed != benchmark.perturbed(plan, 2)
    assert benchmark.perturbed(plan, 0) is plan


def test_rows_have_errors_and_pours_in_their_intervals(benchmark: ModuleType) -> None:
    assert benchmark.seed_rows({12: found(0.11, 0.15), 11: found(0.10, 0.12)}) == [
        ["11", "0.000", "0.020", "2 of 2"],
        ["12", "0.010", "0.050", "1 of 2"],
    ]
    rows = dict(benchmark.rounding_rows([found(0.10, 0.12), found(0.11, 0.16, friction=0.2)]))
    assert rows["θ\\*, `friction`"] == "0.1 … 0.2"
    assert rows["largest difference of two predictions of a pour"] == "0.040"
    assert rows["predictions inside the 90 % intervals of the others"] == "2 of 4"
