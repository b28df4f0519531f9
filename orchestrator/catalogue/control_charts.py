"""Control charts of a laboratory: what every run measures anyway, day by day, against limits from its own history.

- `QUANTITIES` declares what is charted, `CHECKS` what to look at if it leaves its limits.
- `control_chart` has the statistics: arrays in, points and violations out.
- `charts_of` makes the charts of every laboratory from rows of the catalogue.

The charts are written for drifts over weeks. A point is the mean of a day's values, so that a run of sixty pours in one
morning is one observation of what differs between days.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, computed_field

FEWEST, HISTORY = 5, 30
"""Number of days before the first limits, and the largest number of days that limits come from."""

LIMIT, TWICE = 4.0, 3.0
"""Standard deviations: a violation is a point beyond the first, or two of three successive points beyond the second on
the same side. Shewhart's 3 is meant for one chart: nine charts with 60 points each would give 1.5 false alarms."""

SLACK, DECISION = 0.5, 8.0
"""Reference value k and decision interval h of the CUSUM [standard deviations]: a shift of one standard deviation is
reported after about 17 days, a still process gives one false alarm in about 9,600 (Siegmund's formula). With limits
from 5 to 30 days it is one in 60 charts of 60 days."""

CALM = 0.5 * DECISION
"""A violation has ended, and a single bad day is no end of a drift, while the CUSUM is below this."""

LARGEST = 4.0
"""A point counts at most so much in the CUSUM: one bad day is no drift."""

Rule = Literal["limit", "two of three", "cusum"]


class ChartPoint(BaseModel):
    """One point of a chart: the mean of one day, of one vessel or liquid where these differ."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    time: float
    """Time of the day's first value, seconds since 1970."""

    about: str
    """The vessels and the liquid; '' if the quantity does not depend on them."""

    pours: int
    """Number of values."""

    value: float
    """Their mean, in the unit of the chart; the geometric one for scatter and time."""

    values: list[float] = []
    """The single values of the day, in the unit of the chart: one that is far off may vanish in the mean."""

    value_deviations: list[float] = []
    """The same on the scale of `deviations`; empty while there are fewer than five days."""

    deviations: float | None = None
    """Distance from the history's mean in standard deviations; null while there are fewer than five days."""

    low: float | None = None
    """Lower limit (four standard deviations)."""

    high: float | None = None
    """Upper limit."""


class ChartViolation(BaseModel):
    """A period in which a chart was out of control."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    begun: float
    """Estimated begin of the change, seconds since 1970."""

    noticed: float
    """Day on which it was noticed, seconds since 1970."""

    ended: float | None = None
    """When it was in control again; null if it lasts."""

    rule: Rule
    """'limit': a point beyond four standard deviations; 'two of three' beyond three; 'cusum': a small change that
    lasts."""

    deviations: float = 0.0
    """Mean distance since it began, in standard deviations."""


def control_chart(
    times: Sequence[float], values: Sequence[float], about: Sequence[str] | None = None, *, resolution: float = 0.0
) -> tuple[list[ChartPoint], list[ChartViolation]]:
    """The chart of one quantity: Shewhart limits with a run rule, and a two-sided CUSUM.

    Every day is compared with the days of its group before it, at most the first `HISTORY` of them that were in
    control. The distance is converted by Student's distribution, so that it is standard normal for a still process
    however short the history is. Groups of different level (other vessels, other liquids) share one chart.

    Args:
        times: of each value, the oldest first, seconds since 1970 (n,). A day is a local one.
        values: finite numbers (n,).
        about: group of each value (n,); None: one group.
        resolution: smallest standard deviation: differences of this size mean nothing, even in a constant history.

    Returns:
        The points, by day and group, and the violations, the oldest first.

    Source: ISO 7870-2:2023 (individuals, run rules), ISO 7870-4:2021 (CUSUM), ISO 7870-8:2017 (groups in one chart).
    Self-starting: Hawkins, The Statistician 36, 1987; Quesenberry, Journal of Quality Technology 23, 1991. Winsorised
    CUSUM: Hawkins, Communications in Statistics 22, 1993.

    Limitations: days count as independent. A change within the first `FEWEST` days is not seen, and a drift from the
    first day on is seen late, because the limits contain it.
    """
    points: list[ChartPoint] = []
    histories: dict[str, list[tuple[ChartPoint, float]]] = {}
    periods: list[tuple[ChartViolation, int, int | None]] = []
    sums, since = [0.0, 0.0], [0, 0]
    recent: deque[float] = deque(maxlen=3)
    for number, (point, squares) in enumerate(_days(times, values, about or [""] * len(values))):
        points.append(point)
        history = histories.setdefault(point.about, [])
        if len(history) < FEWEST:
            history.append((point, squares))
            continue
        z = _compare(point, history, resolution)
        recent.append(z)
        before = tuple(sums)
        for side, sign in enumerate((1, -1)):
            if sums[side] == 0.0:
                since[side] = number
            counted = min(max(sign * z, -LARGEST), LARGEST)
            sums[side] = min(max(sums[side] + counted - SLACK, 0.0), DECISION)
        side = int(z < 0.0) if abs(z) > TWICE else int(sums[1] > sums[0])
        rule = _rule(z, recent, sums[side])
        last, begun, ended = periods[-1] if periods else (None, 0, 0)
        if rule is None and last is not None and ended is None and max(sums) < CALM:
            last.ended, periods[-1] = point.time, (last, begun, number)
        elif rule is not None and ended is not None:
            begun = max(since[side], ended) if before[side] > CALM else number
            periods.append((ChartViolation(begun=points[begun].time, noticed=point.time, rule=rule), begun, None))
        elif rule is None and ended is not None and len(history) < HISTORY:
            history.append((point, squares))
    for violation, begun, ended in periods:
        distances = [point.deviations for point in points[begun:ended] if point.deviations is not None]
        violation.deviations = float(np.mean(distances))
    return points, [violation for violation, _, _ in periods]


def _compare(point: ChartPoint, history: Sequence[tuple[ChartPoint, float]], resolution: float) -> float:
    """Set the limits of a day and the distances of its values from its history. Returns that of the day."""
    mean, deviation = _expected(history, point.pours, resolution)
    # Beyond 37, Student's distribution is exactly 0 or 1 in floating-point numbers.
    z = _normal((point.value - mean) / max(deviation, 1e-300), len(history) - 1)
    half = _student(LIMIT, len(history) - 1) * deviation
    point.deviations, point.low, point.high = z, mean - half, mean + half
    point.value_deviations = [z + LIMIT * (value - point.value) / max(half, 1e-300) for value in point.values]
    return z


def _expected(history: Sequence[tuple[ChartPoint, float]], pours: int, resolution: float) -> tuple[float, float]:
    """Mean of a history, and the standard deviation of a further day's difference from it, if that day has so many
    pours.

    Days with fewer pours than the history scatter more, by the variance within days. Those with more get no narrower
    limits: the estimate would be too uncertain.
    """
    means, counts, squares = np.array([(point.value, point.pours, squares) for point, squares in history]).T
    variance = means.var(ddof=1)
    within = squares.sum() / max((counts - 1.0).sum(), 1.0)
    expected = variance + within * (1.0 / pours - (1.0 / counts).mean())
    spread = max(expected, variance, resolution**2)
    return float(means.mean()), math.sqrt(spread * (1.0 + 1.0 / len(history)))


def _rule(z: float, recent: Iterable[float], cusum: float) -> Rule | None:
    if abs(z) > LIMIT:
        return "limit"
    if abs(z) > TWICE and sum(math.copysign(other, other * z) > TWICE for other in recent) >= 2:
        return "two of three"
    return "cusum" if cusum >= DECISION else None


def _days(times: Sequence[float], values: Sequence[float], about: Sequence[str]) -> Iterator[tuple[ChartPoint, float]]:
    """One point for each day and group, with the sum of squares of its values about their mean."""
    groups = {name: number for number, name in enumerate(dict.fromkeys(about))}
    days: dict[tuple[int, int], list[int]] = {}
    for place, moment in enumerate(times):
        day = int((moment + time.localtime(moment).tm_gmtoff) // 86_400)
        days.setdefault((day, groups[about[place]]), []).append(place)
    for _, places in sorted(days.items()):
        of_day = [values[place] for place in places]
        mean = math.fsum(of_day) / len(of_day)
        point = ChartPoint(time=times[places[0]], about=about[places[0]], pours=len(of_day), value=mean, values=of_day)
        yield point, math.fsum((value - mean) ** 2 for value in of_day)


def _normal(t: float, freedom: int) -> float:
    """The standard normal value with the same probability as a value of Student's distribution."""
    from scipy.special import ndtri, stdtr

    return math.copysign(float(ndtri(max(stdtr(freedom, -abs(t)), 1e-300))), t)


@cache
def _student(z: float, freedom: int) -> float:
    """The value of Student's distribution with the same probability as a standard normal value."""
    from scipy.special import ndtr, stdtrit

    return -float(stdtrit(freedom, ndtr(-z)))


# ---- the charts of a laboratory


CHECKS = {
    "prediction_error": "was the receiver, the tray or the arm moved, or is it another liquid? Measure the placement; "
    "else calibrate again",
    "dose_error_g": "the display and the cables of the balance, drops at the lip, and the temperature of the liquid",
    "onset_deg": "does the vessel slip in the gripper? Clean its pads, check its force, and teach the grip again; is "
    "it the right vessel?",
    "film_g": "wash and dry the receiver; does it drain as long as before?",
    "missing_g": "is liquid on the table, or does it evaporate? Is it always the same vessel that is weighed?",
    "empty_pourer_g": "weigh a reference weight (`decant balance check`), adjust the balance; is the pourer dry, clean "
    "and the right one?",
    "zero_g": "does something touch the pan? Level the balance, and keep draughts and warmth away",
    "reading_noise_g": "vibrations, draughts and static charge at the balance; its filter setting",
    "seconds": "the speed slider of the arm, stable readings of the balance, and waiting questions",
}
"""What to look at if a quantity leaves its limits, by column of the table of pours."""


@dataclass(frozen=True)
class ChartedQuantity:
    """A quantity with a chart.

    Attributes:
        column: of the table of pours.
        label, unit: for people.
        resolution: smallest standard deviation that means anything, in the unit (or of the logarithm).
        groups: columns whose values have levels of their own.
        logarithmic: whether ratios count, not differences.
        once: whether it is measured once in a run, and repeated in the rows of its pours.
    """

    column: str
    label: str
    unit: str
    resolution: float
    groups: tuple[str, ...] = ()
    logarithmic: bool = False
    once: bool = False


_VESSELS = ("pourer", "receiver", "liquid")

QUANTITIES = (
    ChartedQuantity("prediction_error", "prediction error", "SD", 0.1, _VESSELS),
    ChartedQuantity("dose_error_g", "dose error", "g", 0.02, ("pourer", "liquid")),
    ChartedQuantity("onset_deg", "tilt at which doses begin to flow", "deg", 0.1, ("pourer", "liquid")),
    ChartedQuantity("film_g", "film in the receiver", "g", 0.01, ("receiver", "liquid")),
    ChartedQuantity("missing_g", "masses that do not close", "g", 0.02),
    ChartedQuantity("empty_pourer_g", "weight of the empty pourer", "g", 0.01, ("pourer",), once=True),
    ChartedQuantity("zero_g", "zero of the balance", "g", 0.005),
    ChartedQuantity("reading_noise_g", "scatter of readings at rest", "g", 0.1, logarithmic=True),
    ChartedQuantity("seconds", "time of a pour", "s", 0.05, ("purpose", *_VESSELS), logarithmic=True),
)
"""What is charted, in the order in which it is shown."""

COLUMNS = tuple(dict.fromkeys(name for q in QUANTITIES for name in (q.column, *q.groups)))
"""Columns of the table of pours that charts need, besides the time and the run."""

NEW_LIMITS = "new limits"
"""Beginning of a note on a run, after which the charts of its laboratory begin again."""


class LaboratoryChart(BaseModel):
    """The control chart of one quantity of one laboratory."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    laboratory: str
    """Name of the laboratory."""

    mode: str
    """'virtual', or 'hardware' for a real bench."""

    quantity: str
    """Column of the table of pours."""

    label: str
    """The quantity in words."""

    unit: str
    """Unit of the values."""

    check: str
    """What to look at if it leaves its limits."""

    points: list[ChartPoint]
    """The days, the oldest first."""

    violations: list[ChartViolation]
    """The oldest first."""

    @property
    def lasting(self) -> ChartViolation | None:
        """The violation that lasts; None if the chart is in control."""
        return self.violations[-1] if self.violations and self.violations[-1].ended is None else None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def text(self) -> str:
        """'film in the receiver: 6.1 standard deviations above its history since 2030-03-14; check: …', or ''."""
        violation = self.lasting
        if violation is None:
            return ""
        side = "above" if violation.deviations > 0.0 else "below"
        since = time.strftime("%Y-%m-%d", time.localtime(violation.begun))
        off = f"{abs(violation.deviations):.1f} standard deviations {side} its history since {since}"
        return f"{self.label}: {off}; check: {self.check}"


def charts_of(rows: Sequence[Mapping[str, Any]]) -> list[LaboratoryChart]:
    """The charts of all laboratories, by laboratory and quantity; quantities without values have none.

    Args:
        rows: weighed pours, the oldest first, with 'laboratory', 'mode', 'path', 'time' and `COLUMNS`.
    """
    laboratories: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        laboratories.setdefault((str(row["laboratory"] or ""), str(row["mode"])), []).append(row)
    charts = [
        _chart(name, mode, quantity, laboratories[name, mode])
        for name, mode in sorted(laboratories)
        for quantity in QUANTITIES
    ]
    return [chart for chart in charts if chart.points]


def _chart(laboratory: str, mode: str, quantity: ChartedQuantity, rows: Sequence[Mapping[str, Any]]) -> LaboratoryChart:
    times, values, groups = [], [], []
    runs: set[tuple[str, str]] = set()
    for row in rows:
        value = row[quantity.column]
        if value is None or not math.isfinite(value) or (quantity.logarithmic and value <= 0.0):
            continue
        about = ", ".join(filter(None, (str(row[name] or "") for name in quantity.groups)))
        if quantity.once and (row["path"], about) in runs:
            continue
        runs.add((row["path"], about))
        times.append(float(row["time"]))
        values.append(math.log(value) if quantity.logarithmic else value)
        groups.append(about)
    points, violations = control_chart(times, values, groups, resolution=quantity.resolution)
    for point in points if quantity.logarithmic else ():
        point.value = math.exp(point.value)
        point.values = [math.exp(value) for value in point.values]
        if point.low is not None and point.high is not None:
            point.low, point.high = math.exp(point.low), math.exp(point.high)
    return LaboratoryChart(
        laboratory=laboratory,
        mode=mode,
        quantity=quantity.column,
        label=quantity.label,
        unit=quantity.unit,
        check=CHECKS[quantity.column],
        points=points,
        violations=violations,
    )
