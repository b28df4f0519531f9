"""Mixtures of a run: their table, its files, and the picture of the rack.

Rows are the components of the cups: wanted and reached amounts, shares with their uncertainty, dose, time and source.
"""

from __future__ import annotations

import csv
import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.dispense import Dispensed, MixedComponent
from orchestrator.learning.mixtures import dose_strategy
from orchestrator.learning.requests import Failed
from orchestrator.records.codec import Results
from orchestrator.records.run_record import CampaignResult, Row, RunState, read_record
from orchestrator.reports import figure_style as style
from orchestrator.reports.stage_views import all_of
from orchestrator.reports.wording import ResultRow, ResultTable
from orchestrator.runs.stages import DOSES
from sim_engine.resources import installed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILE_NAME = "mixtures"

COLOURS = (style.POURER, style.PREDICTED, style.GOOD, style.POSTERIOR, style.FALLING, style.BEST, style.GREY)
"""Of the liquids, in the order of the campaign's table."""

STATES = {"rejected": "rejected", "refused": "not poured", "unknown": "UNKNOWN", "waiting": "", "filling": "filling"}


def mixtures_of(results: Results) -> Dispensed | None:
    """The stage that poured mixtures; None if there is none."""
    return next((dispensed for dispensed in all_of(results, Dispensed) if dispensed.cups), None)


def with_unfinished(plan: CampaignPlan, result: CampaignResult) -> CampaignResult:
    """The result of a run with the mixtures so far, if it has stopped within them.

    A dose that has begun and has no outcome makes its cup UNKNOWN.

    Raises:
        RunError: the journal can't be read.
    """
    if plan.dispense is None or plan.dispense.mixtures is None or mixtures_of(result.results) is not None:
        return result
    strategy = dose_strategy(plan.dispense, plan.seed)
    for pour in read_record(result.directory).pours:
        if pour.request.dose is not None and (pour.outcome is not None or pour.state in ("under way", "unknown")):
            strategy.take(pour.request, pour.outcome or Failed("pour_unknown", "the run has stopped during the dose"))
    return replace(result, results={**result.results, DOSES: strategy.result()})


def mixture_rows(dispensed: Dispensed, record: RunState) -> list[Row]:
    """One row for each liquid of each cup: masses in g, shares by mass, time in seconds since 1970.

    Args:
        dispensed: with cups.
        record: of the run.
    """
    times = {pour.request.number: pour.time for pour in record.pours if pour.request.dose is not None}
    replaced = {cup.position: cup.replaces for cup in dispensed.cups}
    return [
        {
            **component.model_dump(),
            "time": None if component.dose is None else times.get(component.dose),
            "replaces": replaced[component.cup],
        }
        for component in dispensed.components()
    ]


def write_mixtures(result: CampaignResult) -> None:
    """Write the table of a run, if it has mixtures, into its folder: CSV, JSON, and .xlsx if a package for it is there.

    Times are local, in the form of ISO 8601.

    Raises:
        OSError: a file can't be written.
        RunError: the journal can't be read.
    """
    if (mixtures := mixtures_of(result.results)) is None:
        return
    directory, rows = result.directory, mixture_rows(mixtures, read_record(result.directory))
    table = [
        {
            **row,
            "time": None if row["time"] is None else time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(row["time"])),
        }
        for row in rows
    ]
    path = directory / f"{FILE_NAME}.csv"
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(table[0]))
        writer.writeheader()
        writer.writerows(table)
    path.with_suffix(".json").write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    if installed("openpyxl"):
        from openpyxl import Workbook

        book = Workbook()
        sheet = book.active
        for line in (list(table[0]), *(list(row.values()) for row in table)):
            sheet.append(line)
        book.save(path.with_suffix(".xlsx"))


def mixture_table(dispensed: Dispensed) -> ResultTable:
    """The table for people."""
    rows = []
    for component in dispensed.components():
        error = None if component.received_g is None else component.received_g - component.wanted_g
        masses = (component.wanted_g, component.received_g, error, component.half_interval_g)
        shares = (component.wanted_share, component.share, component.share_half_interval)
        cells = [component.cup, component.liquid, *("—" if grams is None else f"{grams:.2f}" for grams in masses)]
        cells += ["—" if share is None else f"{100.0 * share:.2f}" for share in shares]
        cells += ["—" if component.dose is None else str(component.dose), component.source or "—", component.state]
        rows.append(ResultRow(cells, "" if component.state in ("full", "waiting", "filling") else "bad"))
    header = ["cup", "liquid", "wanted [g]", "received [g]", "difference [g]", "± (90 %) [g]"]
    header += ["wanted share [%]", "share [%]", "± (90 %) [%]", "dose", "source", "cup is"]
    return ResultTable(f"{len(dispensed.cups)} mixtures", header, rows, frozenset(range(2, 10))).filled()


def mixture_lines(directory: Path) -> list[str]:
    """Each cup of a published run in one line: reached and wanted amounts.

    Args:
        directory: folder of the run.

    Raises:
        OSError: it has no mixtures.
        ValueError, LookupError: its file is damaged.
    """
    lines: dict[str, list[str]] = {}
    for row in json.loads((directory / f"{FILE_NAME}.json").read_text(encoding="utf-8")):
        received = "—" if row["received_g"] is None else f"{row['received_g']:.1f}"
        replaced = f", instead of {row['replaces']}" if row["replaces"] else ""
        text = f"{row['liquid']} {received} of {row['wanted_g']:g} g"
        lines.setdefault(f"{row['cup']}  {row['state']}{replaced}: ", []).append(text)
    return [start + ", ".join(texts) for start, texts in lines.items()]


# ---- the rack from above


def draw_rack(dispensed: Dispensed, limits: Mapping[str, float]) -> Figure:
    """The rack from above: each cup with its liquids, and the difference of every amount from the table.

    Args:
        dispensed: with cups.
        limits: tolerances by liquid [g]; larger differences are bold.
    """
    from matplotlib.patches import Patch

    liquids = list(limits)
    places = _grid([cup.position for cup in dispensed.cups])
    columns, rows = (1 + max(place[k] for place in places.values()) for k in (0, 1))
    size = (max(1.5 * columns + 0.8, 4.6), 1.75 * rows + 1.5)
    figure, axes = style.new_figure(1, 1, size=size)
    full = sum(cup.state == "full" for cup in dispensed.cups)
    style.entitle(figure, f"{full} of {len(dispensed.cups)} cups are full: difference from the wanted amounts [g]")
    colours = {liquid: COLOURS[i % len(COLOURS)] for i, liquid in enumerate(liquids)}
    components = dispensed.components()
    for cup in dispensed.cups:
        column, row = places[cup.position]
        own = [component for component in components if component.cup == cup.position]
        _draw_cup(axes, (1.5 * column, -1.75 * row), cup.position.partition("/")[2], own, colours, limits)
    axes.set_xlim(-0.85, 1.5 * (columns - 1) + 0.85)
    axes.set_ylim(-1.75 * (rows - 1) - 0.95, 0.95)
    axes.set_aspect("equal")
    axes.set_axis_off()
    handles = [Patch(color=colours[liquid], label=liquid) for liquid in liquids]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def _grid(positions: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Column and row of each position, from 0; positions without the usual names are in rows of six."""
    usual = {name: re.fullmatch(r".*?([A-Z])([0-9]+)", name) for name in positions}
    if any(match is None for match in usual.values()):
        return {name: (i % 6, i // 6) for i, name in enumerate(positions)}
    places = {name: (int(match[2]), ord(match[1])) for name, match in usual.items() if match is not None}
    left, top = (min(place[k] for place in places.values()) for k in (0, 1))
    return {name: (column - left, row - top) for name, (column, row) in places.items()}


def _draw_cup(
    axes: Axes,
    centre: tuple[float, float],
    name: str,
    components: Sequence[MixedComponent],
    colours: Mapping[str, str],
    limits: Mapping[str, float],
) -> None:
    """One cup: a ring of its liquids by mass, its name, and the differences within."""
    from matplotlib.patches import Circle, Wedge

    x, y = centre
    axes.add_patch(Circle(centre, 0.68, facecolor="white", edgecolor=style.GREY, linewidth=1.0))
    total = sum(component.wanted_g for component in components)
    start = 90.0
    for component in components:
        angle = 360.0 * component.wanted_g / total
        poured = component.received_g is not None
        axes.add_patch(
            Wedge(
                centre, 0.66, start - angle, start, width=0.13,
                facecolor=colours[component.liquid] if poured else "white", edgecolor="white", linewidth=1.2,
            )
        )  # fmt: skip
        start -= angle
    state = components[0].state
    axes.text(x, y + 0.8, name, ha="center", va="center", fontsize=9.5, color=style.INK)
    if note := STATES.get(state, ""):
        axes.text(x, y - 0.8, note, ha="center", va="center", fontsize=8, color=style.BEST)
    for i, component in enumerate(components):
        if component.received_g is None:
            text, beyond = "—", False
        else:
            error = component.received_g - component.wanted_g
            text, beyond = f"{round(error, 2) + 0.0:+.2f}", abs(error) > limits[component.liquid]
        axes.text(
            x, y + 0.2 * (0.5 * (len(components) - 1) - i), text, ha="center", va="center", fontsize=8.5,
            color=colours[component.liquid], fontweight="bold" if beyond else "normal",
        )  # fmt: skip
