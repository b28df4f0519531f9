"""Comparison of weighed pours with the simulator's predictions: scores per split, a CSV table, and a figure."""

from __future__ import annotations

import csv
import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.campaigns.pour_table import column_name
from orchestrator.reports import figure_style as style
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.prediction_band import PredictionInterval, SampleStatistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ScoredRow:
    """A weighed pour and its prediction.

    Attributes:
        line: line in the table of pours.
        split: 'train', 'test' or 'transfer'.
        action: the action of the pour.
        measured: r = spilled / poured as weighed; None if too little was poured.
        predicted: r over the simulations; None if none of them could be used, or poured enough.
        band: prediction interval of a single pour.
        lost: simulations that could not be used.
    """

    line: int
    split: str
    action: Action
    measured: float | None
    predicted: SampleStatistics | None
    band: PredictionInterval | None
    lost: int = 0

    @property
    def difference(self) -> float | None:
        """Measured minus predicted."""
        if self.measured is None or self.predicted is None:
            return None
        return self.measured - self.predicted.mean

    @property
    def held(self) -> bool | None:
        """Whether the interval contains the pour; None if one of them is unknown."""
        return None if self.measured is None or self.band is None else self.band.holds(self.measured)


@dataclass(frozen=True)
class Score:
    """Quality of the predictions of some pours.

    Attributes:
        pours: pours that have both r and a prediction.
        error: mean |Δ|; None without pours.
        correlation: Spearman's, of measured and predicted r; None for fewer than three pours, or if all values are
            equal.
        held: pours inside their interval.
    """

    pours: int
    error: float | None
    correlation: float | None
    held: int

    def text(self) -> str:
        """'mean |Δ| 1.6 %, Spearman 0.97, 15 of 16 pours inside their 90 % interval'."""
        if self.error is None:
            return "no pour with a spillage to compare"
        ranks = "" if self.correlation is None else f", Spearman {self.correlation:.2f}"
        pours = "pour" if self.pours == 1 else "pours"
        return f"mean |Δ| {100 * self.error:.2f} %{ranks}, {self.held} of {self.pours} {pours} inside the 90 % interval"


def score(rows: Iterable[ScoredRow]) -> Score:
    """Mean |Δ|, rank correlation, and the number of pours inside their intervals."""
    known = [row for row in rows if row.difference is not None]
    differences = [abs(row.difference or 0.0) for row in known]
    measured = [row.measured or 0.0 for row in known]
    predicted = [row.predicted.mean for row in known if row.predicted is not None]
    return Score(
        pours=len(known),
        error=math.fsum(differences) / len(known) if known else None,
        correlation=rank_correlation(measured, predicted),
        held=sum(row.held is True for row in known),
    )


def scores(rows: Sequence[ScoredRow]) -> dict[str, Score]:
    """Scores by split, and for 'all' if there is more than one split."""
    splits = list(dict.fromkeys(row.split for row in rows))
    by_split = {split: score(row for row in rows if row.split == split) for split in splits}
    return {**by_split, "all": score(rows)} if len(splits) > 1 else by_split


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Spearman's ρ; None for fewer than three pairs, or if one side has only equal values."""
    if len(first) < 3 or len(set(first)) < 2 or len(set(second)) < 2:
        return None
    from scipy.stats import spearmanr

    return float(spearmanr(first, second).statistic)


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
    infos = [ACTION_DIMENSIONS[name] for name in dimensions]
    head = ["line", "split", *(column_name(dimension) for dimension in infos)]
    head += ["measured", "predicted", "deviation", "low_90", "high_90", "inside"]
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(head)
        for row in rows:
            values = [getattr(row.action, dimension.name) for dimension in infos]
            shown = [
                "" if value is None else f"{value / dimension.factor:.6g}"
                for value, dimension in zip(values, infos, strict=True)
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


def draw_scored(rows: Sequence[ScoredRow], *, title: str, note: str) -> Figure:
    """Measured against predicted spillage, each with its prediction interval; pours outside their interval are ringed.

    Args:
        rows: in any order; rows without r or prediction are left out.
        title: first line.
        note: description of the predictor.
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
        x="predicted spilled / poured [%], with its 90 % interval",
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
    return figure
