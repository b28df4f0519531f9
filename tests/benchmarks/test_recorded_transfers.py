"""Surrogates predict recorded transfers of viscous liquids, which no simulator made, with 90 % intervals."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def transfers(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import recorded_transfers

    return recorded_transfers


@pytest.mark.slow
def test_nine_recorded_transfers_in_ten_lie_in_the_intervals_of_a_surrogate(transfers: ModuleType) -> None:
    found = transfers.figures(transfers.campaigns(transfers.ANSWERS), "linear")
    shown, before = found["averaged"], found["plug-in"]
    assert shown["settings"] == 125
    assert 0.85 <= shown["inside"] <= 0.95
    assert shown["first"] >= 0.8, "the corners, which are extrapolated from the others"
    assert shown["score"] <= before["score"]
    assert before["first"] < 0.8, "one set of hyperparameters is not enough"


def test_the_recorded_transfers_are_complete_and_have_their_licence(transfers: ModuleType) -> None:
    known = transfers.campaigns()
    assert [len(known), sum(len(one.errors) for one in known)] == [20, 205]
    assert known[0].errors[0] == pytest.approx((25.011 + 37.843 + 41.926) / 3)
    assert "Permission is hereby granted" in transfers.DATA.with_name("LICENSE").read_text()
    assert "github.com/Quijanove/LiqTransferOptimizer" in transfers.DATA.with_name("README").read_text()
