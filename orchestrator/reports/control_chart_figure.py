"""The picture of a laboratory's control charts: one panel for each quantity."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

from orchestrator.catalogue.control_charts import FEWEST, LIMIT, LaboratoryChart
from orchestrator.reports import figure_style as style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS, PANEL = 2, (5.4, 2.3)
"""Number of panels side by side, and the size of each [inch]."""

MARGIN = timedelta(days=2)


def draw_charts(charts: Sequence[LaboratoryChart]) -> Figure:
    """Daily means with their limits, and the single values of each day. Points of a violation are red, from its begin.

    A panel without points says why. Quantities whose levels depend on vessel or liquid are shown as deviations if
    there are several of them.

    Args:
        charts: of one laboratory, at least one.
    """
    rows = -(-len(charts) // COLUMNS)
    columns = min(COLUMNS, len(charts))
    size = (PANEL[0] * columns, PANEL[1] * rows + 0.5)
    figure, panels = style.new_figure(rows, columns, size=size, squeeze=False)
    style.entitle(figure, f"{charts[0].laboratory or 'no laboratory'}: daily means and their limits")
    for axes, chart in zip(panels.flat, charts, strict=False):
        _panel(axes, chart)
    for axes in panels.flat[len(charts) :]:
        axes.set_axis_off()
    return figure


def _panel(axes: Axes, chart: LaboratoryChart) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    several = len({point.about for point in chart.points}) > 1
    points = [point for point in chart.points if not several or point.deviations is not None]
    if not points:
        style.dress(axes, title=chart.label, y="")
        text = f"no limits yet: fewer than {FEWEST} days\nof each vessel and liquid"
        axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, color=style.GREY)
        axes.set_xticks([])
        axes.set_yticks([])
        return
    times = [datetime.fromtimestamp(point.time) for point in points]
    values = [(point.deviations or 0.0) if several else point.value for point in points]
    singles = [
        (when, value)
        for when, point in zip(times, points, strict=True)
        if point.pours > 1
        for value in (point.value_deviations if several else point.values)
    ]
    if singles:
        days, heights = zip(*singles, strict=True)
        axes.scatter(days, heights, s=5, c=style.GREY, linewidths=0.0, zorder=2)
    limits = [
        (when, -LIMIT, LIMIT) if several else (when, point.low, point.high)
        for when, point in zip(times, points, strict=True)
        if point.low is not None and point.high is not None
    ]
    if limits:
        since, low, high = zip(*limits, strict=True)
        axes.fill_between(since, low, high, color=style.PALE, alpha=0.6, step="mid", zorder=1)
        every = [*values, *(value for _, value in singles)]
        bottom, top = min(low[-1], *every), max(high[-1], *every)  # the first limits are wide
        if top > bottom:
            axes.set_ylim(bottom - 0.1 * (top - bottom), top + 0.1 * (top - bottom))
    out = [
        any(v.begun <= point.time and (v.ended is None or point.time < v.ended) for v in chart.violations)
        for point in points
    ]
    colours = [style.BEST if is_out else style.MEASURED for is_out in out]
    axes.scatter(times, values, s=12, c=colours, linewidths=1.0, zorder=3)  # type: ignore[arg-type]
    unit = "standard deviations" if several or chart.unit == "SD" else chart.unit
    lasting = chart.lasting
    title = (
        chart.label if lasting is None else f"{chart.label}: off since {datetime.fromtimestamp(lasting.begun):%d %b}"
    )
    style.dress(axes, title=title, y=f"[{unit}]")
    if lasting is not None:
        axes.set_title(title, fontsize=11, loc="left", color=style.BEST, pad=8)
    axes.set_xlim(times[0] - MARGIN, times[-1] + MARGIN)  # type: ignore[arg-type]
    locator = AutoDateLocator(maxticks=6)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
