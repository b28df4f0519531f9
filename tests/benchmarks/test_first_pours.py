"""`benchmarks/first_pours.py` compares pours with their predictions."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from actors.laboratory_settings import BenchSettings


@pytest.fixture
def first_pours(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import first_pours

    return first_pours


def test_first_pours_are_compared_with_their_predictions(first_pours: ModuleType) -> None:
    pours = [{"loss": loss, "predicted": 0.02, "band": [0.005, 0.03]} for loss in (0.01, 0.04)]
    shown = first_pours.first_pours([{"program": "first", "bench": "14 mm", "pours": [pour]} for pour in pours])
    # expected 2 %; interval 0.5 … 3 %, which the second one misses by 1 %: a penalty of 2 / 0.1 of that in one of two
    numbers = ["first", "2", "2.0", "2.5", "1.5", "2.5", "50 %", "0.125"]
    assert shown["rows"] == [["with evidence", bench, *numbers] for bench in ("14 mm", "all")]
    assert len(shown["head"]) == len(numbers) + 2


@pytest.mark.parametrize(
    ("program", "x", "y"),
    [
        ("first", -0.002, 0.001),
        ("wrong wall", -0.002, 0.001),
        ("moved", 0.018, 0.001),
        ("moved, before", 0.018, 0.001),
        ("arm moved", -0.016, 0.015),
        ("arm moved, before", -0.016, 0.015),
    ],
)
def test_only_what_was_moved_since_the_calibration_stands_elsewhere(
    first_pours: ModuleType, program: str, x: float, y: float, tmp_path: Path
) -> None:
    content = first_pours.content_of(62000, "twin", program, 5, tmp_path)
    truth = BenchSettings.model_validate(content["laboratory"]["bench"]).pose_error
    assert (truth.x, truth.y) == pytest.approx((x, y))
