"""Common elements of a study's figures: colours and line styles of the strategies, panels, legends, files.

`Drawn` is one figure with its caption and numbers; `SeriesStyle` is the style of one arm. The content of the figures is
in `calibration_figures` and `deployment_figures`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.results import figure_style as style

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

MARKER = {"D1": "v", "D2": "s", "D3": "o"}
"""Marker of each strategy; calibrations have a diamond."""

MOST_ABREAST = 8
"""Maximum number of entries per row of a legend."""

MOST_ABREAST_OF_PANELS = 4
"""Number of panels per row if there are more levels than this."""

PALEST, DARKEST = 0.45, -0.35
"""Shades of several D1, from the fewest iterations to the most: fraction of white, or of ink if negative."""


@dataclass(frozen=True)
class SeriesStyle:
    """Style of one arm. The styles of a figure are distinct; related arms differ in more than colour.

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


def colour(arm: str) -> str:
    """Colour of a strategy; all D1 share one, and strategies of packages have one by their name."""
    return COLOURS.get(arm) or COLOURS.get(strategy_of(arm)) or OTHERS[sum(arm.encode()) % len(OTHERS)]


def is_ours(arm: str) -> bool:
    """Whether an arm is a built-in strategy or the uncalibrated simulator."""
    return arm in COLOURS or strategy_of(arm) in COLOURS


def strategy_of(arm: str) -> str:
    """Strategy of an arm's label: 'D1' of 'D1-15', 'D3' of 'D3-paper'."""
    return arm.split("-", maxsplit=1)[0]


def look(arm: str, arms: Sequence[str]) -> SeriesStyle:
    """Style of an arm in a figure with other arms.

    Args:
        arm: label of the arm.
        arms: labels of all arms of the figure, including this one.
    """
    marker = MARKER.get(strategy_of(arm), "D")
    if arm.endswith(PAPER):
        return SeriesStyle(colour(arm), "--", marker, filled=False)
    kin = sorted((other for other in arms if _iterations(other) is not None), key=lambda other: _iterations(other) or 0)
    if arm not in kin or len(kin) == 1:
        return SeriesStyle(colour(arm), "-", marker)
    place = kin.index(arm)
    share = PALEST + (DARKEST - PALEST) * place / (len(kin) - 1)
    return SeriesStyle(_shade(colour(arm), share), LINES[place % len(LINES)], MARKERS[place % len(MARKERS)])


def _iterations(arm: str) -> int | None:
    strategy, _, number = arm.partition("-")
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


def legend(figure: Figure, arms: Sequence[str]) -> None:
    """Add one legend for all panels below them, in the order of the arms; an arm may be missing in some panels."""
    handles = {name: h for axes in figure.axes for h, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    names = [*(arm for arm in arms if arm in handles), *(name for name in handles if name not in arms)]
    columns = -(-len(names) // -(-len(names) // MOST_ABREAST))
    figure.legend([handles[n] for n in names], names, loc="outside lower center", ncols=columns, frameon=False)
