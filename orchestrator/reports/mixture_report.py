"""Mixtures of a run: their table, its files, and the picture of the rack.

Rows are the components of the cups: wanted and reached amounts, shares with their uncertainty, dose, time, source and
batch of the liquid.
"""

from __future__ import annotations

import csv
import json
import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.dispense import CupState, Dispensed, MixedComponent
from orchestrator.learning.mixtures import Mix
from orchestrator.learning.requests import Failed
from orchestrator.records.codec import Results
from orchestrator.records.run_record import CampaignResult, RecordedQuestion, Row, RunPour, RunState, read_record
from orchestrator.reports import figure_style as style
from orchestrator.reports.stage_views import all_of
from orchestrator.reports.wording import ResultRow, ResultTable
from orchestrator.runs.stages import DOSES
from sim_engine.resources import installed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILE_NAME = "mixtures"

COLOURS = (style.POURER, style.PREDICTED, style.GOOD, style.POSTERIOR, style.FALLING, style.BEST, style.GREY)
"""Of the liquids, in the order of the campaign's table."""

STATES: dict[CupState, str] = {
    "waiting": "empty",
    "filling": "being filled",
    "full": "done",
    "missed": "missed",
    "rejected": "rejected",
    "refused": "not poured",
    "unknown": "UNKNOWN",
}

PROBLEMS = ("missed", "missed, corrected", "rejected", "not poured", "UNKNOWN")


def mixtures_of(results: Results) -> Dispensed | None:
    """The stage that poured mixtures; None if there is none."""
    return next((dispensed for dispensed in all_of(results, Dispensed) if dispensed.cups), None)


def mixed_liquids(plan: CampaignPlan) -> tuple[str, ...]:
    """Names of the liquids of mixtures, in the order of the campaign."""
    if plan.dispense is None:
        return ()
    poured = {dose.liquid for dose in plan.dispense.doses}
    liquids = dict.fromkeys(scene.liquid.name for scene in plan.dispense.scenes)
    return tuple(liquid for liquid in liquids if liquid in poured)


def mixtures_so_far(plan: CampaignPlan, record: RunState, *, live: bool = False) -> Dispensed | None:
    """The mixtures of a run that has not closed their stage; None if its campaign has none.

    Args:
        plan: of the run.
        record: of the run.
        live: whether it is in progress; otherwise a dose that has begun and has no outcome makes its cup UNKNOWN.
    """
    if plan.dispense is None or plan.dispense.mixtures is None:
        return None
    strategy = Mix(plan.dispense, plan.seed)
    unknown = Failed("pour_unknown", "the run has stopped during the dose")
    entries: list[RunPour | RecordedQuestion] = [*record.pours, *record.questions]
    for pour in sorted(entries, key=lambda entry: entry.id):
        if isinstance(pour, RecordedQuestion):
            if pour.answer is not None and pour.proposes:
                strategy.propose(pour.answer)
        elif pour.request.dose is not None and (pour.outcome is not None or pour.state in ("under way", "unknown")):
            under_way = live and pour.state == "under way"
            strategy.take(pour.request, None if under_way else pour.outcome or unknown)
    return strategy.result()


def with_unfinished(plan: CampaignPlan, result: CampaignResult) -> CampaignResult:
    """The result of a run with the mixtures so far, if it has stopped within them.

    Raises:
        RunError: the journal can't be read.
    """
    if plan.dispense is None or plan.dispense.mixtures is None or mixtures_of(result.results) is not None:
        return result
    mixtures = mixtures_so_far(plan, read_record(result.directory))
    return result if mixtures is None else replace(result, results={**result.results, DOSES: mixtures})


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
        source = component.source + (f", batch {component.batch}" if component.batch else "")
        cells += ["—" if component.dose is None else str(component.dose), component.outcome_text or "—"]
        cells += [source or "—", component.state]
        right = component.state in ("full", "waiting", "filling") and component.outcome in (None, "reached")
        rows.append(ResultRow(cells, "" if right else "bad"))
    header = ["cup", "liquid", "wanted [g]", "received [g]", "difference [g]", "± (90 %) [g]"]
    header += ["wanted share [%]", "share [%]", "± (90 %) [%]", "dose", "dose is", "source", "cup is"]
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


@dataclass(frozen=True)
class RackLine:
    """A line through points (x, y), of a width [inch]; `liquid` is what a line of the legend stands for."""

    points: tuple[tuple[float, float], ...]
    colour: str
    width: float
    liquid: str = ""


@dataclass(frozen=True)
class RackText:
    """A text that is centred vertically at a point [inch]; `side` is the end of it that is there."""

    at: tuple[float, float]
    text: str
    colour: str = style.INK
    bold: bool = False
    size: float = 0.12
    side: Literal["left", "center", "right"] = "center"


@dataclass(frozen=True)
class RackDrawing:
    """The rack from above, which report, operator's page and live view show: x to the right, y down [inch].

    Attributes:
        labels: the texts of the cups in fewer pieces, for the live view, whose texts have one size and are below their
            points.
    """

    width: float
    height: float
    lines: tuple[RackLine, ...]
    texts: tuple[RackText, ...]
    labels: tuple[RackText, ...]

    def svg(self) -> str:
        """The drawing as an SVG file."""
        size = {"width": f"{100 * self.width:.0f}", "height": f"{100 * self.height:.0f}"}
        box = {**size, "viewBox": f"0 0 {size['width']} {size['height']}", "font-family": "sans-serif"}
        root = Element("svg", {"xmlns": "http://www.w3.org/2000/svg", **box})
        SubElement(root, "rect", {"width": "100%", "height": "100%", "fill": "white"})
        for line in self.lines:
            points = " ".join(f"{100 * x:.1f},{100 * y:.1f}" for x, y in line.points)
            look = {"fill": "none", "stroke": line.colour, "stroke-width": f"{100 * line.width:.1f}"}
            SubElement(root, "polyline", {"points": points, **look})
        anchors = {"left": "start", "center": "middle", "right": "end"}
        for text in self.texts:
            place = {"x": f"{100 * text.at[0]:.1f}", "y": f"{100 * (text.at[1] + 0.35 * text.size):.1f}"}
            look = {"font-size": f"{100 * text.size:.1f}", "text-anchor": anchors[text.side], "fill": text.colour}
            look["font-weight"] = "bold" if text.bold else "normal"
            SubElement(root, "text", {**place, **look}).text = text.text
        return tostring(root, encoding="unicode")

    def figure(self) -> Figure:
        """The drawing as a figure."""
        figure, axes = style.new_figure(size=(self.width, self.height), layout=None)
        axes.set_position((0.0, 0.0, 1.0, 1.0))  # so that a unit of the axes is an inch
        axes.set_xlim(0.0, self.width)
        axes.set_ylim(self.height, 0.0)
        axes.set_axis_off()
        for line in self.lines:
            axes.plot(*zip(*line.points, strict=True), color=line.colour, lw=72 * line.width, solid_capstyle="butt")
        for text in self.texts:
            look = {"color": text.colour, "fontsize": 72 * text.size, "fontweight": "bold" if text.bold else "normal"}
            axes.text(*text.at, text.text, ha=text.side, va="center_baseline", **look)
        return figure


def draw_rack(dispensed: Dispensed, liquids: Sequence[str]) -> RackDrawing:
    """Each cup with its liquids, its state, and the amounts with their differences from the table.

    The difference of a dose that missed what was wanted of it is bold; after such a dose, this may be a corrected
    amount instead of the table's.

    Args:
        dispensed: with cups.
        liquids: names, in the order of their colours.
    """
    colours = {liquid: COLOURS[i % len(COLOURS)] for i, liquid in enumerate(liquids)}
    places = _grid([cup.position for cup in dispensed.cups])
    requested = {dose.number: dose.wanted_g for dose in dispensed.doses}
    columns, rows = (1 + max(place[k] for place in places.values()) for k in (0, 1))
    full = sum(cup.state == "full" for cup in dispensed.cups)
    title = f"{full} of {len(dispensed.cups)} cups are full: amounts, and differences from the table [g]"
    width, bottom = max(1.6 * columns + 0.1, 0.2 + 0.077 * len(title)), 0.5 + 2.0 * rows
    lines, texts, labels = list[RackLine](), [RackText((0.1, 0.25), title, size=0.15, side="left")], list[RackText]()
    for cup in dispensed.cups:
        column, row = places[cup.position]
        own = [component for component in dispensed.components() if component.cup == cup.position]
        centre = (0.85 + 1.6 * column, 1.55 + 2.0 * row)
        labels += _draw_cup(lines, texts, centre, own, requested, colours)
    x, y = 0.15, bottom + 0.25
    for liquid, colour in colours.items():
        if x > 0.2 and x + 0.5 + 0.09 * len(liquid) > width:
            x, y = 0.15, y + 0.25
        lines.append(RackLine(((x, y), (x + 0.3, y)), colour, 0.12, liquid))
        texts.append(RackText((x + 0.38, y), liquid, size=0.125, side="left"))
        x += 0.65 + 0.09 * len(liquid)
    return RackDrawing(width, y + 0.2, tuple(lines), tuple(texts), tuple(labels))


def _grid(positions: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Column and row of each position, from 0; positions without the usual names are in rows of six."""
    usual = {name: re.fullmatch(r".*?([A-Z])([0-9]+)", name) for name in positions}
    if any(match is None for match in usual.values()):
        return {name: (i % 6, i // 6) for i, name in enumerate(positions)}
    places = {name: (int(match[2]), ord(match[1])) for name, match in usual.items() if match is not None}
    left, top = (min(place[k] for place in places.values()) for k in (0, 1))
    return {name: (column - left, row - top) for name, (column, row) in places.items()}


def _draw_cup(
    lines: list[RackLine],
    texts: list[RackText],
    centre: tuple[float, float],
    components: Sequence[MixedComponent],
    requested: Mapping[int, float],
    colours: Mapping[str, str],
) -> list[RackText]:
    """One cup: a ring of its liquids by mass, its name and state, and its amounts within. Returns its labels."""
    (x, y), amounts = centre, list[str]()
    name, start, total = components[0].cup.partition("/")[2], 0.0, sum(part.wanted_g for part in components)
    step, corrected = min(0.2, 0.9 / len(components)), False
    for i, component in enumerate(components):
        end = start + component.wanted_g / total
        colour = style.PALE if component.received_g is None else colours[component.liquid]
        lines.append(RackLine(_arc(centre, 0.65, start + 0.004, end - 0.004), colour, 0.11))
        level, start = y + step * (i - 0.5 * (len(components) - 1)), end
        lines.append(RackLine(((x - 0.49, level), (x - 0.41, level)), colours[component.liquid], 0.08))
        if component.received_g is None or component.dose is None:
            amounts.append("—" if component.dose is None else "?")
            texts.append(RackText((x - 0.02, level), amounts[-1], side="right"))
            continue
        wanted = requested[component.dose]
        error = component.received_g - component.wanted_g
        corrected = corrected or wanted != component.wanted_g
        amount, difference = f"{component.received_g:.1f}", f"{round(error, 2) + 0.0:+.2f}"
        amounts.append(f"{amount} {difference}")
        texts.append(RackText((x - 0.02, level), amount, side="right"))
        texts.append(RackText((x + 0.47, level), difference, bold=component.outcome == "missed", side="right"))
    state = components[0].state
    word = "missed, corrected" if corrected and state == "missed" else STATES[state]
    colour = style.BEST if word in PROBLEMS else style.INK
    edge = style.GREY if state == "waiting" else colour
    lines.append(RackLine(_arc(centre, 0.74, 0.0, 1.0), edge, 0.01 if word in ("empty", "done") else 0.03))
    texts.append(RackText((x, y - 0.87), name, size=0.135))
    texts.append(RackText((x, y + 0.87), word, colour, bold=word not in ("empty", "done")))
    rows = [RackText((x, y + 0.27 * (i - 0.5 * len(amounts))), text) for i, text in enumerate(amounts)]
    return [*rows, RackText((x, y + 0.72), f"{name} {word.partition(',')[0]}", colour)]


def _arc(centre: tuple[float, float], radius: float, start: float, end: float) -> tuple[tuple[float, float], ...]:
    """Points of an arc, clockwise from the top, between two fractions of the circle."""
    angles = np.linspace(2.0 * math.pi * start, 2.0 * math.pi * end, 2 + max(round(40 * (end - start)), 0))
    return tuple((centre[0] + radius * math.sin(angle), centre[1] - radius * math.cos(angle)) for angle in angles)
