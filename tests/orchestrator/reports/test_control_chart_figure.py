"""`control_chart_figure`: single values beside the means, and panels that say why they are empty; no warnings."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.catalogue.control_charts import COLUMNS, LaboratoryChart, charts_of
from orchestrator.reports.control_chart_figure import draw_charts
from orchestrator.reports.figure_style import save

DAY = 86_400.0
BEGIN = 2.0e9


def charts(days: int, **values: Any) -> list[LaboratoryChart]:
    """Charts of doses on some days: 42 a day, of which one may be far off."""
    rows = []
    for day in range(days):
        for number in range(42):
            about = {
                "laboratory": "north",
                "mode": "hardware",
                "path": f"runs/{day}",
                "time": BEGIN + DAY * day + number,
            }
            row = dict.fromkeys(COLUMNS) | about | {"pourer": values.get("pourer", lambda number: "beaker")(number)}
            row |= {"liquid": "water", "dose_error_g": values.get("error", lambda day, number: 0.1)(day, number)}
            rows.append(row)
    return charts_of(rows)


@pytest.fixture(autouse=True)
def no_warnings() -> Any:
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        yield
    # a file of an earlier test may be collected meanwhile
    assert [warning for warning in seen if not issubclass(warning.category, ResourceWarning)] == []


def test_one_dose_that_is_far_off_is_a_point_of_its_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    (chart,) = charts(8, error=lambda day, number: 17.5 if (day, number) == (6, 20) else rng.normal(0.0, 0.2))
    point = chart.points[6]
    assert max(point.values) == 17.5
    assert abs(point.value) < 1.0
    assert max(point.value_deviations) > 20.0
    figure = draw_charts([chart])
    (axes,) = figure.axes
    offsets = [np.asarray(drawn.get_offsets()) for drawn in axes.collections]
    assert any(17.5 in points[:, 1] for points in offsets if len(points))
    assert axes.get_ylim()[1] > 17.5
    assert save(figure, tmp_path / "charts.png").stat().st_size > 1000


def test_an_empty_panel_says_why_and_has_no_axis_of_1970(tmp_path: Path) -> None:
    (chart,) = charts(3, pourer=lambda number: ("beaker", "jug")[number % 2])
    figure = draw_charts([chart])
    (axes,) = figure.axes
    assert "fewer than 5 days" in axes.texts[-1].get_text()
    assert list(axes.get_xticks()) == []
    assert save(figure, tmp_path / "charts.png").stat().st_size > 1000


def test_values_that_never_differ_are_drawn(tmp_path: Path) -> None:
    assert save(draw_charts(charts(7)), tmp_path / "charts.png").stat().st_size > 1000
