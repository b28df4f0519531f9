"""Figures of a study's calibrations, and what all figures of a study share.

- `draw_calibrations`: 3b test discrepancy, 3c discrepancy against simulations, 4 discrepancy over θ.
- `Drawn` is a figure with its caption and numbers; `series_style` is the style of a strategy; `level_panels` and
  `legend` make panels and a legend.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import UNCALIBRATED
from orchestrator.reports import figure_style as style
from orchestrator.study.study_plan import StudyPlan
from orchestrator.study.study_statistics import (
    RANDOM,
    SHARE,
    Estimate,
    Gathered,
    StrategyScores,
    estimate,
    mean,
    running_least,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS = {
    "uncalibrated": style.GREY,
    "C1": style.MEASURED,
    "C2": style.PREDICTED,
    "C3": style.GOOD,
    "C4": style.BEST,
    "C4-paper": style.ESCAPED,
    "D1": style.PREDICTED,
    "D1-uncalibrated": style.GREY,
    "D2": style.MEASURED,
    "D2-paper": style.FALLING,
    "D3": style.BEST,
    "D3-paper": style.GOOD,
}
OTHERS = (style.ESCAPED, style.FALLING, style.INK)
"""Colours of strategies from packages."""

PAPER = "-paper"
"""Suffix of the label of a strategy in the paper's form: dashed line, open markers."""

LINES = (":", "--", "-", "-.")
MARKERS = ("v", "^", "<", ">")
"""Line styles and markers of several D1, by number of iterations."""

MARKER = {"D1": "v", "D1-uncalibrated": "X", "D2": "s", "D3": "o"}
"""Marker of each strategy; calibrations have a diamond."""

MOST_ABREAST = 8
"""Maximum number of entries per row of a legend."""

MOST_ABREAST_OF_PANELS = 4
"""Number of panels per row if there are more levels than this."""

PALEST, DARKEST = 0.45, -0.35
"""Shades of several D1, from the fewest iterations to the most: fraction of white, or of ink if negative."""


@dataclass(frozen=True)
class SeriesStyle:
    """Style of one strategy. The styles of a figure are distinct; related strategies differ in more than colour.

    Attributes:
        colour: colour of lines and markers.
        line: line style.
        marker: marker of means.
        filled: whether the marker is filled.
    """

    colour: str
    line: str
    marker: str
    filled: bool = True

    @property
    def face(self) -> str:
        """Fill colour of the marker."""
        return self.colour if self.filled else "white"


@dataclass
class Drawn:
    """One figure.

    Attributes:
        name: stem of the file names.
        number: number of its counterpart in the paper; '' without one.
        title, caption: displayed texts.
        header, rows: the plotted numbers, as CSV.
    """

    name: str
    number: str
    title: str
    caption: str
    figure: Figure
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    def save(self, folder: Path) -> None:
        """Write PNG, SVG and CSV files."""
        style.save(self.figure, folder / f"{self.name}.png", (".svg",))
        write_csv(folder / f"{self.name}.csv", self.header, self.rows)


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write a CSV file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def colour(label: str) -> str:
    """Colour of a strategy; all D1 share one, and strategies of packages have one by their name."""
    return COLOURS.get(label) or COLOURS.get(strategy_of(label)) or OTHERS[sum(label.encode()) % len(OTHERS)]


def is_ours(label: str) -> bool:
    """Whether a label is that of a built-in strategy or of the uncalibrated simulator."""
    return label in COLOURS or strategy_of(label) in COLOURS


def strategy_of(label: str) -> str:
    """Strategy of a label: 'D1' of 'D1-15', 'D3' of 'D3-paper'."""
    return label.split("-", maxsplit=1)[0]


def series_style(strategy: str, strategies: Sequence[str]) -> SeriesStyle:
    """Style of a strategy in a figure with other strategies.

    Args:
        strategy: label of the strategy.
        strategies: labels of all strategies of the figure, including this one.
    """
    marker = MARKER.get(strategy) or MARKER.get(strategy_of(strategy), "D")
    if strategy.endswith(PAPER):
        return SeriesStyle(colour(strategy), "--", marker, filled=False)
    kin = sorted(
        (other for other in strategies if d1_iterations(other) is not None), key=lambda other: d1_iterations(other) or 0
    )
    if strategy not in kin or len(kin) == 1:
        return SeriesStyle(colour(strategy), "-", marker)
    place = kin.index(strategy)
    share = PALEST + (DARKEST - PALEST) * place / (len(kin) - 1)
    return SeriesStyle(_shade(colour(strategy), share), LINES[place % len(LINES)], MARKERS[place % len(MARKERS)])


def d1_iterations(label: str) -> int | None:
    """Iterations of a label with D1: 15 of 'D1-15'; None for all others."""
    strategy, _, number = label.partition("-")
    return int(number) if strategy == "D1" and number.isdigit() else None


def _shade(colour: str, share: float) -> str:
    """Mix a colour with white, or with ink if the fraction is negative."""
    from matplotlib.colors import to_hex, to_rgb

    (r, g, b), other = to_rgb(colour), to_rgb("white" if share > 0 else style.INK)
    keep, add = 1 - abs(share), abs(share)
    return to_hex((keep * r + add * other[0], keep * g + add * other[1], keep * b + add * other[2]))


def log_axis(axis: Axis, *, decades: bool = False) -> None:
    """Set a logarithmic axis with readable ticks: 0.5, 1, 2, 5, 10; or `decades` alone."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes = axis.axes
    (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1.0,) if decades else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def level_words(*levels: str) -> str:
    """'small, large mismatch' for levels 'small' and 'large'; numbered benches keep their names: 'bench3'."""
    return ", ".join(levels) + ("" if levels[-1][-1:].isdigit() else " mismatch")


def level_panels(
    levels: Sequence[str], across: int = 1, *, width: float = 3.6, height: float = 4.2
) -> tuple[Figure, list[list[Axes]]]:
    """Make a figure and its panels: `across` panels for each level, in as many rows as needed.

    Args:
        across: panels per level.
        width, height: size of a panel including its share of the margins [inch].
    """
    few = len(levels) <= MOST_ABREAST_OF_PANELS
    abreast = (len(levels) if across == 1 else 1) if few else max(MOST_ABREAST_OF_PANELS // across, 1)
    lines = -(-len(levels) // abreast)
    size = (1.2 + width * abreast * across, height * lines + 0.7)
    figure, grid = style.new_figure(lines, abreast * across, size=size, squeeze=False, sharey=True)
    panels = [axes for row in grid for axes in row]
    for axes in panels[len(levels) * across :]:
        axes.set_axis_off()
    return figure, [panels[across * i : across * (i + 1)] for i in range(len(levels))]


def is_first(axes: Axes) -> bool:
    """Whether a panel is in the left column, where the vertical axis has a label."""
    place = axes.get_subplotspec()
    return place is None or place.is_first_col()


def legend(figure: Figure, strategies: Sequence[str]) -> None:
    """Add one legend for all panels below them, in the order of the strategies; some panels may lack one."""
    handles = {name: h for axes in figure.axes for h, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    names = [
        *(name for name in strategies if name in handles),
        *(name for name in handles if name not in strategies),
    ]
    columns = -(-len(names) // -(-len(names) // MOST_ABREAST))
    figure.legend([handles[n] for n in names], names, loc="outside lower center", ncols=columns, frameon=False)


def draw_calibrations(study: StudyPlan, pooled: Gathered) -> list[Drawn]:
    """Draw all figures for which there is data."""
    tested = {name: scores for name, scores in pooled.calibrated.items() if any(scores.test)}
    strategies = {name: scores for name, scores in tested.items() if name not in (UNCALIBRATED, RANDOM)}
    figures = [_boxes(tested)] if tested else []
    if strategies:
        figures.append(_against_simulations(strategies, tested.get(UNCALIBRATED)))
        figures.append(_over_theta(study, strategies))
    return figures


def error(estimate: Estimate) -> list[list[float]]:
    """Distances down and up for `errorbar`; zero without an interval."""
    return [[np.nan_to_num(estimate.mean - estimate.low)], [np.nan_to_num(estimate.high - estimate.mean)]]


def _boxes(tested: Mapping[str, StrategyScores]) -> Drawn:
    figure, axes = style.new_figure(size=(1.6 + 1.25 * len(tested), 4.2))
    rows: list[list[object]] = []
    for place, (name, scores) in enumerate(tested.items(), start=1):
        pooled = [100 * value for test in scores.test for value in test]
        axes.boxplot([pooled], positions=[place], widths=0.55, showfliers=False, medianprops={"color": style.INK})
        axes.plot(np.linspace(place - 0.12, place + 0.12, len(pooled)), pooled, ".", color=style.PALE, zorder=1)
        average = estimate([mean(test) for test in scores.test], SHARE).scaled(100)
        axes.errorbar([place], [average.mean], yerr=error(average), fmt="D", color=colour(name), capsize=4, zorder=4)
        quartiles = [float(q) for q in np.percentile(pooled, [25, 50, 75])]
        rows.append([name, average.count, len(pooled), average.mean, average.low, average.high, *quartiles])
    axes.set_xticks(range(1, len(tested) + 1), list(tested))
    axes.set_ylim(bottom=0.0)
    style.dress(axes, title="Test discrepancy", y="|measured − simulated| spillage [%]")
    return Drawn(
        "figure-3b",
        "3b",
        "Test discrepancy",
        "Every test pour of every repetition: quartiles, median, whiskers to 1.5 quartile ranges (grey: the pours). "
        "Diamonds: mean over repetitions with its 95 % t interval.",
        figure,
        ("strategy", "repetitions", "pours", "mean_percent", "low", "high", "quartile_1", "median", "quartile_3"),
        rows,
    )


def _against_simulations(strategies: Mapping[str, StrategyScores], uncalibrated: StrategyScores | None) -> Drawn:
    figure, axes = style.new_figure(size=(6.4, 4.2))
    rows: list[list[object]] = []
    for name, scores in strategies.items():
        curves = [_curve(name, *pair) for pair in zip(scores.results, scores.expected, strict=True)]
        curves = [curve for curve in curves if curve]
        if not curves:
            continue
        length = min(len(curve) for curve in curves)
        points = [
            (curves[0][i][0], estimate([curve[i][1] for curve in curves], SHARE).scaled(100)) for i in range(length)
        ]
        rows += [[name, spent, e.count, e.mean, e.low, e.high] for spent, e in points]
        spent, means = [p[0] for p in points], [p[1].mean for p in points]
        if len(points) == 1:
            axes.errorbar(
                spent,
                means,
                yerr=error(points[0][1]),
                fmt="s",
                color=colour(name),
                capsize=4,
                label=name,
                clip_on=False,
            )
        else:
            axes.plot(spent, means, series_style(name, list(strategies)).line, color=colour(name), label=name)
            axes.errorbar(
                spent[-1:], means[-1:], yerr=error(points[-1][1]), fmt="o", color=colour(name), capsize=4, clip_on=False
            )
    if uncalibrated is not None and any(uncalibrated.train):
        e = estimate([mean(train) for train in uncalibrated.train if train], SHARE).scaled(100)
        rows.append([UNCALIBRATED, 0, e.count, e.mean, e.low, e.high])
        axes.axhline(e.mean, color=colour(UNCALIBRATED), linestyle="--", label=UNCALIBRATED, zorder=1)
    log_axis(axes.xaxis)
    axes.set_ylim(bottom=0.0)
    legend(figure, list(strategies))
    style.dress(axes, title="Discrepancy against simulations", x="simulations", y="best discrepancy [%]", grid="both")
    return Drawn(
        "figure-3c",
        "3c",
        "Best discrepancy against simulations",
        "On training pours. C3: least mean discrepancy of the θ tried so far; C4: least that its surrogate had "
        "expected of a θ it chose, and at last of θ*; C1 and C2 choose all θ beforehand, and are one point. Bars, of "
        "a curve at its end: 95 % t intervals over repetitions. Dashed: the uncalibrated simulator.",
        figure,
        ("strategy", "simulations", "repetitions", "best_percent", "low", "high"),
        rows,
    )


def _curve(name: str, result: Calibrated, expected: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """(simulations, best discrepancy so far)."""
    if strategy_of(name) == "C3":
        each = result.training_pours
        values = [float("nan") if t.discrepancy is None else t.discrepancy for t in result.trials]
        return [(each * (i + 1), value) for i, value in enumerate(running_least(values))]
    if strategy_of(name) == "C4":
        best = running_least([max(value, 0.0) for _, value in expected])
        return [(spent, value) for (spent, _), value in zip(expected, best, strict=True)]
    return [] if result.found is None else [(result.simulations, result.found.predicted_discrepancy)]


def _displayed(places: Iterable[tuple[float, float]], factors: Sequence[float]) -> list[list[float]]:
    """The two coordinates of places in SI, in display units."""
    return [[place[k] / factors[k] for place in places] for k in (0, 1)]


def _over_theta(study: StudyPlan, strategies: Mapping[str, StrategyScores]) -> Drawn:
    figure, grid = style.new_figure(1, len(strategies), size=(1.0 + 3.4 * len(strategies), 3.9), squeeze=False)
    rows: list[list[object]] = []
    names: list[str] = []
    box = {axis.name: axis for axis in study.calibrations[0].plan.parameters.axes}
    shown = None
    top = 100 * max((_largest(scores) for scores in strategies.values()), default=1.0)
    for axes, (name, scores) in zip(grid[0], strategies.items(), strict=True):
        thetas = [result.found for result in scores.results if result.found is not None]
        maps = [theta.map for theta in thetas if theta.map is not None]
        names = list(maps[0].over) if maps else [*thetas[0].searched, *thetas[0].searched][:2]
        factors = [style.display_factor(axis) for axis in names]
        settings = {"cmap": "viridis", "vmin": 0.0, "vmax": top}
        if strategy_of(name) in ("C1", "C2"):
            tried: dict[tuple[float, float], list[float]] = {}
            for result in scores.results:
                for trial in result.trials:
                    if trial.discrepancy is not None:
                        place = (trial.theta[names[0]], trial.theta[names[1]])
                        tried.setdefault(place, []).append(100 * trial.discrepancy)
            places = list(tried)
            values = [mean(tried[place]) for place in places]
            shown = axes.scatter(*_displayed(places, factors), c=values, marker="s", s=46, clip_on=False, **settings)
            rows += [[name, "trial", names[0], x, names[1], y, v] for (x, y), v in zip(places, values, strict=True)]
        elif maps:
            alike = [m for m in maps if list(m.over) == names]
            surface = 100 * np.mean([np.maximum(m.mean, 0.0) for m in alike], axis=0)
            xs, ys = list(alike[0].axes[names[0]]), list(alike[0].axes[names[1]])
            grid_lines = [[v / factor for v in vs] for vs, factor in zip((xs, ys), factors, strict=True)]
            shown = axes.pcolormesh(*grid_lines, surface, shading="gouraud", **settings)
            rows += [
                [name, "surrogate", names[0], x, names[1], y, float(surface[j, i])]
                for j, y in enumerate(ys)
                for i, x in enumerate(xs)
            ]
        stars = [(getattr(theta.theta, names[0]), getattr(theta.theta, names[1])) for theta in thetas]
        axes.plot(
            *_displayed(stars, factors), "X", color=style.BEST, markeredgecolor="white", markersize=9,
            label="θ* of a repetition", clip_on=False, zorder=4,
        )  # fmt: skip
        rows += [[name, "theta*", names[0], x, names[1], y, ""] for x, y in stars]
        first = axes is grid[0][0]
        style.dress(axes, title=name, x=style.label(names[0]), y=style.label(names[1]) if first else "", grid=None)
        style.frame(axes, box[names[0]], "x")
        style.frame(axes, box[names[1]], "y")
    if shown is not None:
        figure.colorbar(shown, ax=list(grid[0]), label="discrepancy [%]", extend="max", pad=0.02)
    legend(figure, [])
    return Drawn(
        "figure-4",
        "4",
        "Discrepancy over θ",
        "C1 and C2: mean over the training pours of each θ that was tried, over the repetitions. C3 and C4: posterior "
        "mean of the surrogate, averaged over the repetitions. Crosses: θ* of each repetition. "
        "Colours end at the ninth decile of what was found.",
        figure,
        ("strategy", "what", "x_name", "x", "y_name", "y", "discrepancy_percent"),
        rows,
    )


def _largest(scores: StrategyScores) -> float:
    values = [t.discrepancy for r in scores.results for t in r.trials if t.discrepancy is not None]
    return float(np.percentile(values, 90)) if values else 0.0
