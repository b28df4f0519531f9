"""Comparison of weighed pours with their predictions, as a CSV table and as a figure."""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Sequence
from pathlib import Path

from orchestrator.config.weighed_pours import column_name
from orchestrator.results import figure_style as style
from orchestrator.results.prediction_scores import ScoredRow, score
from sim_engine.action import ACTION_DIMENSIONS

NOTE_WIDTH = 44
"""Characters per line in the figure's lower right corner, which contains pours only if predictions are bad."""

COLOURS = {"train": style.PALE, "test": style.MEASURED, "transfer": style.BEST}
SAID = {"train": "pours that θ was fitted to", "test": "unseen pours", "transfer": "another receiver"}


def write_scored(path: Path, rows: Sequence[ScoredRow], dimensions: Sequence[str]) -> Path:
    """Write one line per pour: its line in the evaluated table, its action, measured and predicted r, and the interval.

    Args:
        path: CSV to write.
        rows: in the order of the table.
        dimensions: action dimensions that get a column.

    Raises:
        OSError: it can't be written.
    """
    given = [ACTION_DIMENSIONS[name] for name in dimensions]
    head = ["line", "split", *(column_name(dimension) for dimension in given)]
    head += ["measured", "predicted", "deviation", "low_90", "high_90", "inside"]
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        for row in rows:
            values = [getattr(row.action, dimension.name) for dimension in given]
            shown = [
                "" if value is None else f"{value / dimension.factor:.6g}"
                for value, dimension in zip(values, given, strict=True)
            ]
            predicted = row.predicted
            numbers = [
                row.measured,
                None if predicted is None else predicted.mean,
                None if predicted is None else predicted.deviation,
                None if row.band is None else row.band.low,
                None if row.band is None else row.band.high,
            ]
            cells = ["" if value is None else f"{value:.5f}" for value in numbers]
            held = {None: "", True: "yes", False: "no"}[row.held]
            table.writerow([row.line, row.split, *shown, *cells, held])
    return path


def draw_scored(path: Path, rows: Sequence[ScoredRow], *, title: str, note: str) -> Path:
    """Measured against predicted spillage, each with its prediction interval; pours outside their interval are ringed.

    Args:
        path: PNG to write.
        rows: in any order; rows without r or prediction are left out.
        title: first line.
        note: description of the predictor.

    Raises:
        OSError: it can't be written.
    """
    figure, axes = style.new_figure(size=(6.6, 6.4))
    top = 0.0
    for split in dict.fromkeys(row.split for row in rows):
        known = [row for row in rows if row.split == split and row.difference is not None]
        first = True
        for row in known:
            if row.measured is None or row.predicted is None or row.band is None:
                continue
            x, y = 100 * row.predicted.mean, 100 * row.measured
            axes.plot(
                (100 * row.band.low, 100 * row.band.high),
                (y, y),
                color=style.GREY if split == "train" else COLOURS[split],
                alpha=0.45,
                linewidth=3.0,
                solid_capstyle="butt",
                zorder=2,
            )
            axes.plot(
                [x],
                [y],
                "o",
                color=COLOURS[split],
                markersize=6.5,
                markeredgecolor=style.GREY if split == "train" else "white",
                label=f"{SAID[split]}: {score(known).text()}" if first else None,
                clip_on=False,
                zorder=4,
            )
            first = False
            if row.held is False:
                axes.plot([x], [y], "o", markersize=12, markerfacecolor="none", markeredgecolor=style.INK, zorder=5)
            top = max(top, x, y, 100 * row.band.high)
    top = min(1.04 * top, 100.0) or 1.0
    axes.plot((0.0, top), (0.0, top), color=style.GREY, linewidth=1.0, zorder=1)
    axes.annotate(
        "as predicted",
        (0.985 * top, 0.985 * top),
        ha="right",
        va="bottom",
        rotation=45,
        rotation_mode="anchor",
        fontsize=8.5,
        color=style.GREY,
    )
    axes.set_xlim(0.0, top)
    axes.set_ylim(0.0, top)
    axes.set_aspect("equal")
    style.dress(
        axes,
        title=title,
        x="predicted spilled / poured [%], with the band that holds nine pours in ten",
        y="measured spilled / poured [%]",
        grid="both",
    )
    figure.legend(loc="outside lower center", fontsize=8.5, frameon=False)
    axes.text(
        0.98,
        0.02,
        textwrap.fill(note, NOTE_WIDTH),
        transform=axes.transAxes,
        ha="right",
        va="bottom",
        fontsize=8.0,
        color=style.GREY,
    )
    return style.save(figure, path)
