"""What the benchmark of bands counts: unseen pours only, each by what its own fold's calibration left over."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def bands(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import bands

    return bands


def test_each_cause_of_a_band_holds_as_many_pours_or_more(bands: ModuleType) -> None:
    pours = [
        {"split": "test", "measured": 0.20, "simulated": [0.19, 0.20, 0.21]},  # seeds alone
        {"split": "test", "measured": 0.12, "simulated": [0.19, 0.20, 0.21]},  # with the resolution
        {"split": "test", "measured": 0.05, "simulated": [0.19, 0.20, 0.21]},  # with what was left over
        {"split": "transfer", "measured": 0.9, "simulated": [0.1, 0.1, 0.11]},  # by none
        {"split": "transfer", "measured": 0.9, "simulated": []},  # has no prediction
    ]
    test, transfer = bands.summary([{"left_over": 0.6, "particles": 1_000, "pours": pours}])
    assert [test[name]["held"] for name in bands.ROWS] == [1, 2, 3]
    assert (test["count"], transfer["count"]) == (3, 1)
    assert [transfer[name]["share"] for name in bands.ROWS] == [0.0, 0.0, 0.0]
    assert test["mean_error"] == pytest.approx((0.0 + 0.08 + 0.15) / 3, abs=1e-4)
    assert test[bands.ROWS[2]]["mean_width"] > test[bands.ROWS[1]]["mean_width"] > test[bands.ROWS[0]]["mean_width"]
