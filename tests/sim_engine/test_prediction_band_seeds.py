"""`prediction_band`: what several seeds come to."""

from __future__ import annotations

import statistics
from dataclasses import replace

import pytest

from sim_engine.outcome import PourOutcome
from sim_engine.prediction_band import FRACTIONS, SampleStatistics, spreads

SPILLED = (0.02, 0.05, 0.11)


def outcome(spilled: float, retained: float = 0.2, invalid: str | None = None) -> PourOutcome:
    received = 1.0 - spilled - retained
    return PourOutcome(received, spilled, retained, 0.0, 0.0, 500, 0.005, 0.01, 3.0, 900, 0.9, 1, invalid=invalid)


def test_seeds_have_their_mean_and_the_deviation_of_a_single_one() -> None:
    found = spreads([outcome(s) for s in SPILLED])
    assert found["spilled"].mean == pytest.approx(statistics.mean(SPILLED))
    assert found["spilled"].deviation == pytest.approx(statistics.stdev(SPILLED))
    assert found["spillage"].mean == pytest.approx(statistics.mean(SPILLED) / 0.8)
    assert sum(found[name].mean for name in FRACTIONS) == pytest.approx(1.0)
    assert found["spilled"].percent() == "6.0 ± 4.6 %"


def test_a_single_seed_has_no_spread_rather_than_one_of_zero() -> None:
    found = spreads([outcome(0.031)])["spilled"]
    assert (found.deviation, found.count, found.percent()) == (None, 1, "3.1 %")


def test_invalid_outcomes_and_undefined_spillages_are_left_out() -> None:
    leaked, unpoured = outcome(0.9, 0.0, "it leaked"), outcome(0.01, retained=0.97)
    found = spreads([outcome(0.02), leaked, replace(unpoured, seed=3)])
    assert found["spilled"].count == 2
    assert (found["spillage"].count, found["spillage"].mean) == (1, pytest.approx(0.02 / 0.8))
    assert spreads([leaked]) == {}
    assert SampleStatistics.of([]) is None
