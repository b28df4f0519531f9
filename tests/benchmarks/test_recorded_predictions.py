"""`benchmarks/recorded_predictions.py` counts errors and intervals."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


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


def test_rows_have_errors_and_pours_in_their_intervals(benchmark: ModuleType) -> None:
    assert benchmark.seed_rows({12: found(0.11, 0.15), 11: found(0.10, 0.12)}) == [
        ["11", "0.000", "0.020", "2 of 2"],
        ["12", "0.010", "0.050", "1 of 2"],
    ]


def test_mean_row_is_of_all_seeds_and_pours(benchmark: ModuleType) -> None:
    seeds = {12: found(0.11, 0.15), 11: found(0.10, 0.12)}
    assert benchmark.mean_row(seeds) == ["mean", "0.005 (0.000 … 0.010)", "0.035 (0.020 … 0.050)", "3 of 4"]
