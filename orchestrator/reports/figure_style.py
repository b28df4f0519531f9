"""Common style of all figures: a palette for colour-blind readers, display units, axis ticks, and saving.

Figures use Matplotlib's Agg canvas without pyplot and without a window system.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150

# Okabe and Ito's palette; each colour has one meaning in all figures.
INK = "#222222"
GREY = "#8c8c8c"
PALE = "#d9d9d9"
MEASURED = "#0072b2"
PREDICTED = "#e69f00"
BEST = "#d55e00"
GOOD = "#009e73"
SPILLED = "#d55e00"
RECEIVED = "#009e73"
FALLING = "#56b4e9"
POURER = "#0072b2"
ESCAPED = "#cc79a7"
POSTERIOR = "#cc79a7"

PARTICLE_STATES: tuple[tuple[str, str], ...] = (
    ("in the pourer", POURER),
    ("falling", FALLING),
    ("received", RECEIVED),
    ("spilled", SPILLED),
    ("escaped through a wall", ESCAPED),
)
"""Meaning and colour of `sim_engine.outcome.ParticleState`, by its value."""

PARAMETER_NAMES = {"particles": "number of particles", "friction": "wall friction"}


def label(name: str) -> str:
    """Axis label of an action dimension or simulation parameter: its name in words and its display unit."""
    unit = display_unit(name)
    words = PARAMETER_NAMES.get(name, name.replace("_", " "))
    return f"{words} [{unit}]" if unit else words


def display_unit(name: str) -> str:
    """Display unit ('' for pure numbers and for names that are neither action nor parameter)."""
    if name in ACTION_DIMENSIONS:
        return ACTION_DIMENSIONS[name].display_unit.replace("^2", "²")
    info = SimulationParameters.info().get(name)
    return "" if info is None or info.unit == "1" else info.shown


def display_factor(name: str) -> float:
    """SI value of one display unit; 1 for names that are neither action nor parameter."""
    if name in ACTION_DIMENSIONS:
        return ACTION_DIMENSIONS[name].factor
    info = SimulationParameters.info().get(name)
    return 1.0 if info is None else info.factor


def display_value(name: str, value: float | None) -> str:
    """A quantity in its display unit, from its SI value: '41.2 deg/s', '1 840', '0.032 N/m'.

    None is shown as the word that switches the dimension off ('until_flow_ends'), or as '—' without such a word.
    """
    if value is None:
        return (ACTION_DIMENSIONS[name].switched_off if name in ACTION_DIMENSIONS else "") or "—"
    if name == "particles":
        return f"{round(value):,}".replace(",", " ")
    return f"{value / display_factor(name):.3g} {display_unit(name)}".rstrip()


def display_interval(name: str, low: float | None, high: float | None) -> str:
    """An interval in the quantity's display unit, from SI values: '0.31 … 0.74 N/m'."""
    unit = display_unit(name)
    return f"{display_value(name, low).removesuffix(unit).rstrip()} … {display_value(name, high)}"


def two_digits(value: float) -> str:
    """Two significant digits: '0.47', '5.2', '1 500'."""
    if value < 100.0:
        return f"{value:.2g}"
    digits = 10 ** (len(str(int(value))) - 2)
    return f"{round(value / digits) * digits:,}".replace(",", " ")


def display_values(values: Mapping[str, float | None]) -> str:
    """Several named quantities in one line, from SI values: 'angular velocity 41.2 deg/s, x offset 104 mm'."""
    return ", ".join(f"{name.replace('_', ' ')} {display_value(name, value)}" for name, value in values.items())


def safe_name(name: str) -> str:
    """A name that is valid as part of a file name or an entity path."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name) or "_"


Layout = Literal["constrained"] | None


def new_figure(
    rows: int = 1, columns: int = 1, *, size: tuple[float, float], layout: Layout = "constrained", **kwargs: Any
) -> tuple[Figure, Any]:
    """A figure without a window system.

    Args:
        size: width and height [inch].
        layout: layout engine; None: the caller places labels, because the engine takes longer than the drawing.

    Returns:
        The figure and the result of `Figure.subplots` (axes, or an array of them).
    """
    # Figure is used without pyplot: no global state, no backend to choose, no figures kept in a daemon.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=DPI, layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, **kwargs)


def entitle(figure: Figure, title: str) -> None:
    """Set the title of a whole figure."""
    figure.suptitle(title, fontsize=12.5, color=INK, x=0.02, ha="left")


def dress(axes: Axes, *, title: str = "", x: str = "", y: str = "", grid: str | None = "y") -> None:
    """Set title, labels and a thin grid; remove the box."""
    axes.set_title(title, fontsize=11, loc="left", color=INK, pad=8)
    axes.set_xlabel(x, fontsize=9.5, color=INK)
    axes.set_ylabel(y, fontsize=9.5, color=INK)
    axes.tick_params(labelsize=8.5, colors=INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.set_axisbelow(True)
    if grid == "both":
        axes.grid(True, color=PALE, linewidth=0.6)
    elif grid in ("x", "y"):
        axes.grid(True, axis="x" if grid == "x" else "y", color=PALE, linewidth=0.6)


MARGIN = 0.045
"""Margin of a searched axis beyond its bounds, as a share of its length, which shows points on a bound."""

FEWEST_TICKS = 3

_LOG_STEPS = (
    (1.0,),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0),
)


def frame(axes: Axes, axis: Axis, which: Literal["x", "y"]) -> None:
    """Set scale, limits and ticks of a searched axis; its line ends at the bounds. Call it after `dress`.

    Args:
        axis: the searched axis, bounds in SI.
        which: axis of the figure.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

    factor = display_factor(axis.name)
    low, high = axis.lower / factor, axis.upper / factor
    handle, side = (axes.xaxis, "bottom") if which == "x" else (axes.yaxis, "left")
    limits = axes.set_xlim if which == "x" else axes.set_ylim
    if axis.scale == "log":
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        places, room = log_ticks(low, high), (high / low) ** MARGIN
        limits(low / room, high * room)
        handle.set_minor_locator(NullLocator())
    else:
        slack = 1e-9 * (high - low)
        places = [
            t
            for t in MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
            if low - slack <= t <= high + slack
        ]
        limits(low - MARGIN * (high - low), high + MARGIN * (high - low))
    handle.set_major_locator(FixedLocator(places))
    handle.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.spines[side].set_bounds(low, high)


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers between two positive ones, at least `FEWEST_TICKS` if possible: 500, 700, 1000, 1500."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    places: list[float] = []
    for steps in _LOG_STEPS:
        candidates = sorted(step * 10.0**decade for decade in decades for step in steps)
        places = [place for place in candidates if low * (1 - 1e-9) <= place <= high * (1 + 1e-9)]
        if len(places) >= FEWEST_TICKS:
            break
    return places


def number(value: float) -> str:
    """A number for an axis: '0.05', '1 500'."""
    return f"{value:.6g}" if abs(value) < 1000 else f"{value:,.0f}".replace(",", " ")


def at_ends(values: Mapping[str, float | None], axes: tuple[Axis, ...]) -> list[str]:
    """Searched values that lie at an end of their range: 'angular velocity at its upper end (150 deg/s)'.

    Args:
        values: values of a point [SI].
        axes: searched axes.
    """
    notes = []
    for axis in axes:
        value = values.get(axis.name)
        if value is None:
            continue
        unit = axis.encode(value)
        if min(unit, 1.0 - unit) < 1e-3:
            end = "upper" if unit > 0.5 else "lower"
            notes.append(f"{axis.name.replace('_', ' ')} at its {end} end ({display_value(axis.name, value)})")
    return notes


def save(figure: Figure, path: Path, formats: Sequence[str] = ()) -> Path:
    """Write a PNG; the folder is made if needed.

    Args:
        path: PNG to write.
        formats: suffixes of additional files next to it ('.svg' or '.pdf'), for print.

    Raises:
        OSError: a file can't be written.
    """
    from matplotlib import rc_context

    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context({"svg.hashsalt": path.stem}):  # the same figure gives the same file
        for suffix in (path.suffix, *formats):
            undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(suffix)
            figure.savefig(path.with_suffix(suffix), dpi=DPI, facecolor="white", metadata=undated)
            figure.set_layout_engine("none")  # keep the layout of the first format
    return path
