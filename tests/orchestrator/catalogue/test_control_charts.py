"""`control_charts`: limits from a laboratory's own history, and what leaves them."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.catalogue.control_charts import (
    CHECKS,
    COLUMNS,
    FEWEST,
    LIMIT,
    QUANTITIES,
    ChartPoint,
    ChartViolation,
    LaboratoryChart,
    charts_of,
    control_chart,
)
from orchestrator.catalogue.run_reading import POURS, RunRows
from tests.support.hypothesis_examples import examples

Floats = NDArray[np.float64]
SEEDS = st.integers(0, 2**32 - 1)


def drawn(seed: int, days: int = 60) -> tuple[NDArray[np.int64], Floats]:
    """Days and values of a still process with scatter between and within days, one to five values a day."""
    rng = np.random.default_rng(seed)
    day = np.repeat(np.arange(days), rng.integers(1, 6, days))
    return day, rng.normal(0.0, 0.7, days)[day] + rng.normal(0.0, 1.0, len(day))


DAY = 86_400.0


def chart(days: Any, values: Any, groups: Any = None, **options: Any) -> tuple[list[ChartPoint], list[ChartViolation]]:
    """The chart of values at noon of numbered days."""
    numbers = [0] * len(values) if groups is None else groups
    times = [DAY * float(day) + 43_200.0 + float(number) for day, number in zip(days, numbers, strict=True)]
    return control_chart(times, [float(value) for value in values], [str(number) for number in numbers], **options)


def day(moment: float | None) -> int:
    assert moment is not None
    return int(moment // DAY)


def side(violation: ChartViolation) -> float:
    return math.copysign(1, violation.deviations)


def violations(values: Any, **options: Any) -> list[ChartViolation]:
    """Violations of a chart with one value a day."""
    return chart(range(len(values)), values, **options)[1]


def still(days: int, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(0.0, 1.0, days)


@settings(max_examples=examples(40))
@given(SEEDS, st.floats(1e-6, 1e6), st.floats(-1e3, 1e3), st.sampled_from([-1, 1]))
def test_a_chart_does_not_depend_on_unit_zero_and_direction(seed: int, unit: float, zero: float, sign: int) -> None:
    days, values = drawn(seed, 25)
    points, found = chart(days, values)
    changed, found_then = chart(days, sign * unit * (values + zero))
    expected = [None if p.deviations is None else sign * p.deviations for p in points]
    assert [p.deviations for p in changed] == [None if z is None else pytest.approx(z, abs=1e-3) for z in expected]
    assert [(v.noticed, v.rule, sign * side(v)) for v in found_then] == [(v.noticed, v.rule, side(v)) for v in found]


@settings(max_examples=examples(40))
@given(SEEDS)
def test_the_order_of_values_within_a_day_does_not_matter(seed: int) -> None:
    days, values = drawn(seed, 20)
    order = np.random.default_rng(seed).permutation(len(days))
    points, _ = chart(days, values)
    shuffled, _ = chart(days[order], values[order])
    assert [p.deviations for p in shuffled] == [
        None if p.deviations is None else pytest.approx(p.deviations, abs=1e-6) for p in points
    ]


@settings(max_examples=examples(60))
@given(SEEDS)
def test_a_point_is_beyond_its_limits_exactly_if_it_deviates_by_more_than_the_limit(seed: int) -> None:
    days, values = drawn(seed, 40)
    values[days > 20] += np.random.default_rng(seed).uniform(-8.0, 8.0)
    for point in chart(days, values)[0]:
        if point.low is not None and point.high is not None and point.deviations is not None:
            assert (not point.low <= point.value <= point.high) == (abs(point.deviations) > LIMIT)


def test_a_still_process_gives_hardly_any_false_alarm() -> None:
    """Nine charts of 60 days: at most one alarm in three laboratories."""
    alarms = sum(len(chart(*drawn(50_000 + seed))[1]) for seed in range(300))
    assert 9 * alarms / 300 < 0.33


@pytest.mark.parametrize("slope", [-0.3, 0.15, 1.0])
def test_a_drift_is_noticed_once_in_its_direction_within_five_days_of_two_deviations(slope: float) -> None:
    late = 0
    for seed in range(20):
        days, values = drawn(51_000 + seed)
        found = chart(days, values + slope * np.maximum(days - 20, 0))[1]
        (drift,) = [v for v in found if day(v.noticed) >= 20][-1:]
        assert (side(drift), drift.ended) == (math.copysign(1, slope), None)
        late += day(drift.noticed) > 20 + 2.0 * math.hypot(0.7, 1.0) / abs(slope) + 5
    assert late <= 1


def test_one_bad_day_is_one_violation_and_changes_no_later_limit() -> None:
    values = still(40)
    bad = values.copy()
    bad[15] += 50.0
    (violation,) = violations(bad)
    assert (day(violation.begun), day(violation.noticed), violation.rule, side(violation)) == (15, 15, "limit", 1)
    assert day(violation.ended) < 30
    then, otherwise = chart(range(40), bad)[0][39], chart(range(39), np.delete(values, 15))[0][38]
    assert (then.low, then.high) == pytest.approx((otherwise.low, otherwise.high), rel=0.35)


def test_a_change_that_lasts_is_one_violation_and_a_second_one_after_a_repair_is_another() -> None:
    values = still(160)
    values[40:80] += 3.0
    (first,) = violations(values[:80])
    assert first.ended is None
    values[130:] -= 3.0
    first, second = violations(values)
    assert (side(first), side(second)) == (1, -1)
    assert 40 <= day(first.noticed) < 46
    assert 80 < day(first.ended) < 110
    assert 130 <= day(second.noticed) < 136


def test_two_of_three_days_count_on_the_same_side_only() -> None:
    values = still(40)
    for pattern, expected in (([3.6, 0.0, 3.6], 1), ([3.6, 0.0, -3.6], 0)):
        changed = values.copy()
        changed[30:33] = values[:30].mean() + np.array(pattern) * values[:30].std(ddof=1) * 1.02
        assert len(violations(changed)) == expected


def test_a_constant_history_has_finite_limits() -> None:
    """As a warm-up of equal values has given limits that are not numbers elsewhere."""
    constant = np.full(20, 0.25)
    assert violations(constant) == []
    assert violations([*constant, 0.26], resolution=0.01) == []
    points, found = chart(range(21), [*constant, 0.75], resolution=0.01)
    assert found[0].rule == "limit"
    assert all(math.isfinite(value) for point in points for value in (point.low or 0.0, point.high or 0.0, point.value))
    points, found = chart(range(21), [*constant, 0.75])
    assert len(found) == 1
    assert all(math.isfinite(point.deviations) for point in points if point.deviations is not None)


def test_few_days_have_no_limits_and_nothing_has_no_points() -> None:
    points, found = chart(range(FEWEST), [0.0, 1e9, -1e9, 3.0, 4.0])
    assert {point.low for point in points} == {None}
    assert found == []
    assert chart([], []) == ([], [])
    assert charts_of([]) == []


def test_vessels_of_different_weight_share_a_chart() -> None:
    values = np.concatenate([150.0 + 0.02 * still(30), 80.0 + 0.02 * still(30, 2)])
    days, groups = np.tile(np.arange(30), 2), np.repeat([0, 1], 30)
    assert chart(days, values, groups)[1] == []
    values[groups == 1] -= 0.2 * (days[groups == 1] >= 20)  # only one of them is off
    points, (violation,) = chart(days, values, groups)
    (noticed,) = (point for point in points if point.time == violation.noticed)
    assert (noticed.about, side(violation)) == ("1", -1)


def row(day: int, **values: Any) -> dict[str, Any]:
    about = {"laboratory": "north", "mode": "hardware", "path": f"runs/{day}", "time": 86_400.0 * day + 43_200.0}
    return {**dict.fromkeys(COLUMNS), "pourer": "beaker", "receiver": "cup", "liquid": "water", **about, **values}


def test_a_violation_says_what_since_when_and_what_to_check() -> None:
    scatter = 0.02 * still(30)
    rows = [row(day, film_g=0.3 + scatter[day] + 0.05 * max(day - 20, 0), zero_g=scatter[day]) for day in range(30)]
    film, zero = charts_of(rows)
    assert (film.quantity, zero.quantity, zero.text) == ("film_g", "zero_g", "")
    assert "film in the receiver" in film.text
    assert "above its history since 1970-01-" in film.text
    assert "dry the receiver" in film.text
    assert LaboratoryChart.model_validate_json(film.model_dump_json()) == film


def test_an_empty_pourer_counts_once_in_a_run_and_values_that_are_no_numbers_do_not() -> None:
    rows = [row(1, empty_pourer_g=152.0, zero_g=math.nan), row(1, empty_pourer_g=152.0, reading_noise_g=0.0)]
    (pourer,) = charts_of([*rows, row(2, empty_pourer_g=152.1)])
    assert [(point.pours, point.value) for point in pourer.points] == [(1, 152.0), (1, 152.1)]


def test_every_quantity_is_a_column_with_a_unit_and_a_check() -> None:
    columns = {column.name for column in POURS}
    assert {q.column for q in QUANTITIES} <= columns
    assert all(CHECKS[q.column] and q.unit and q.label for q in QUANTITIES)


def test_charts_of_ten_thousand_pours_take_less_than_a_second(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    days = np.sort(rng.integers(0, 250, 10_000))
    pours = [
        {
            **row(int(day)),
            "path": str(tmp_path),
            "outcome": "weighed",
            "seconds": 90.0,
            **{name: float(rng.normal()) for name in ("prediction_error", "film_g", "zero_g", "missing_g")},
        }
        for day in days
    ]
    with Catalogue(tmp_path / "state") as catalogue:
        run = {"path": str(tmp_path), "laboratory": "north", "mode": "hardware"}
        catalogue._enter(str(tmp_path), "x", RunRows(run, pours))
        begun = time.process_time()
        charts = catalogue.charts({})
        assert time.process_time() - begun < 1.0
    assert sum(point.pours for point in charts[0].points) == 10_000
