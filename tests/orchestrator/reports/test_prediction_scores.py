"""`prediction_scores`: how predictions of weighed pours are scored, tabled and drawn."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from orchestrator.reports.figure_style import save
from orchestrator.reports.prediction_scores import ScoredRow, draw_scored, rank_correlation, score, scores, write_scored
from sim_engine.action import DEG, Action
from sim_engine.prediction_band import SampleStatistics, band
from tests.support.example_results import is_picture

ACTION = Action(angular_velocity=40 * DEG, x_offset=0.09, height=0.06)


def row(line: int, measured: float | None, predicted: list[float], split: str = "test") -> ScoredRow:
    found = band(predicted, 1_000) if predicted else None
    return ScoredRow(line, split, ACTION, measured, SampleStatistics.of(predicted), found, lost=0)


ROWS = [
    row(2, 0.10, [0.11, 0.13]),
    row(3, 0.60, [0.20, 0.22]),
    row(4, 0.30, [0.30, 0.31], "train"),
    row(5, None, [0.3]),
    row(6, 0.2, []),
]


def test_the_score_is_of_pours_that_have_a_spillage_and_a_prediction() -> None:
    found = score(ROWS)
    assert found.error == pytest.approx((0.02 + 0.39 + 0.005) / 3)
    assert (found.held, found.pours) == (2, 3)
    assert set(scores(ROWS)) == {"test", "train", "all"}
    assert scores(ROWS)["train"].held == 1
    assert score([]).error is None


def test_ranks_are_spearmans_with_ties() -> None:
    assert rank_correlation([1, 2, 3, 4], [10, 20, 30, 40]) == pytest.approx(1.0)
    assert rank_correlation([1, 2, 3, 4], [4, 3, 2, 1]) == pytest.approx(-1.0)
    assert rank_correlation([1, 2, 2, 4], [1, 3, 2, 5]) == pytest.approx(0.94868, abs=1e-5)
    assert rank_correlation([1, 1, 1], [1, 2, 3]) is None
    assert rank_correlation([1, 2], [1, 2]) is None


def test_the_table_says_what_was_foretold_of_each_line(tmp_path: Path) -> None:
    path = write_scored(tmp_path / "scored.csv", ROWS, ["angular_velocity", "x_offset"])
    with path.open(encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert [line["line"] for line in found] == ["2", "3", "4", "5", "6"]
    assert (found[0]["angular_velocity_deg_s"], found[0]["x_offset_mm"]) == ("40", "90")
    assert (found[0]["measured"], found[0]["predicted"]) == ("0.10000", "0.12000")
    assert [line["inside"] for line in found] == ["yes", "no", "yes", "", ""]
    assert found[4]["low_90"] == ""


def test_measured_is_drawn_over_predicted(tmp_path: Path) -> None:
    assert is_picture(
        save(draw_scored(ROWS, title="beaker into cup", note="intervals from seeds"), tmp_path / "scored.png")
    )
