"""Pictures of a surrogate: the discrepancy over θ, the predicted loss over actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orchestrator.report import style
from sim_engine.space import Axis, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = Mapping[str, float | None]
"""Named SI values of one point."""


@dataclass(frozen=True)
class SurrogatePicture:
    """What a surrogate knows about a cost, ready to be drawn.

    Attributes:
        title: of the picture.
        cost: label of the cost with its unit, e.g. 'discrepancy [%]'.
        space: searched box.
        points: where the cost was observed, SI.
        costs: what was observed there, in the unit of `cost`.
        best: the chosen point, SI; None while there is none.
        best_name: what it is called: 'θ*', 'best action'.
        mean: (R, R) surrogate mean over the unit square, row i at the second axis' i-th place; None without a map.
        deviation: (R, R) its standard deviation.
        numbers: what to write on the points (pours); None: they are dots (simulations).
        over: names of the map's two axes; empty: the space has no others.
        held: values of the other axes at which the map cuts the surrogate, SI.
    """

    title: str
    cost: str
    space: Space
    points: Sequence[Values]
    costs: Sequence[float]
    best: Values | None = None
    best_name: str = "θ*"
    mean: NDArray[np.float64] | None = None
    deviation: NDArray[np.float64] | None = None
    numbers: Sequence[int] | None = None
    over: tuple[str, ...] = ()
    held: Values = field(default_factory=dict)

    @property
    def plane(self) -> Space:
        """The two axes of the map, the first across, the second up."""
        return Space(tuple(axis for axis in self.space.axes if not self.over or axis.name in self.over))


def draw_surrogate(path: Path, picture: SurrogatePicture) -> Path:
    """Write a surrogate's picture: maps of mean and deviation over two axes; without a map, as `draw_trials`.

    Of more than two axes the map is a cut through the surrogate; the observations, made anywhere, are projected on it.

    Args:
        path: PNG to write.
        picture: at least one point or a map.

    Returns:
        `path`.

    Raises:
        ValueError: there is nothing to draw.
    """
    if not picture.points and picture.mean is None:
        raise ValueError(f"'{picture.title}': neither a surrogate nor a single observation to draw")
    mapped = picture.space.dimension == 2 or (picture.mean is not None and picture.space.dimension > 2)
    return style.save(_maps(picture) if mapped else _slices(picture), path)


def draw_trials(path: Path, picture: SurrogatePicture) -> Path:
    """Write the observed costs against each searched axis, side by side.

    Args:
        path: PNG to write.
        picture: at least one point.

    Returns:
        `path`.

    Raises:
        ValueError: there is nothing to draw.
    """
    if not picture.points:
        raise ValueError(f"'{picture.title}': not a single observation to draw")
    return style.save(_slices(picture), path)


def _maps(picture: SurrogatePicture) -> Figure:
    panels: list[tuple[str, NDArray[np.float64] | None]] = [
        ("mean", picture.mean),
        ("standard deviation", picture.deviation),
    ]
    shown: list[tuple[str, NDArray[np.float64] | None]] = [panel for panel in panels if panel[1] is not None] or [
        ("observations", None)
    ]
    figure, axes = style.new_figure(1, len(shown), size=(5.4 * len(shown), 4.3), squeeze=False)
    figure.suptitle(picture.title, fontsize=12.5, color=style.INK, x=0.02, ha="left")
    for place, (name, grid) in enumerate(shown):
        _map_panel(figure, axes[0, place], picture, name, grid)
    if picture.held:
        figure.supxlabel(_cut_note(picture), fontsize=8.5, color=style.INK, x=0.02, ha="left")
    return figure


def _cut_note(picture: SurrogatePicture) -> str:
    """Where the map lies in the box, for those who'd take it for the whole."""
    note = f"others at {picture.best_name}: {style.display_values(dict(picture.held))}"
    if picture.points:
        note += f"; the {_things(picture)} were made at any values of them"
    return note


def _map_panel(
    figure: Figure, axes: Axes, picture: SurrogatePicture, name: str, grid: NDArray[np.float64] | None
) -> None:
    x_axis, y_axis = picture.plane.axes
    # Deviations say how sure the mean is, not how good a place is: another colour map, so that nobody mixes them up.
    colours = "cividis" if name == "standard deviation" else "viridis"
    xs, ys = _column(picture.points, x_axis), _column(picture.points, y_axis)
    costs = np.asarray(picture.costs, dtype=float)
    if grid is not None:
        values = np.asarray(grid, dtype=float)
        # The surrogate's own range: single observations, far noisier, would flatten it.
        low, high = _limits(values)
        places = np.linspace(0.0, 1.0, values.shape[0])
        mesh: Any = axes.contourf(
            _decode(x_axis, places),
            _decode(y_axis, places),
            np.clip(values, low, high),
            levels=np.linspace(low, high, 25),
            cmap=colours,
        )
        if name == "mean":
            axes.contour(
                _decode(x_axis, places),
                _decode(y_axis, places),
                values,
                levels=np.linspace(low, high, 9)[1:-1],
                colors="white",
                linewidths=0.5,
                alpha=0.6,
            )
    else:
        low, high = _limits(costs)
        mesh = axes.scatter([], [], c=[], cmap=colours, vmin=low, vmax=high)
    if len(xs):
        # Observations are filled with their own cost on the same scale: where one stands out, the surrogate disagrees.
        filled: dict[str, Any] = (
            {"c": costs, "cmap": colours, "vmin": low, "vmax": high} if name != "standard deviation" else {"c": "white"}
        )
        size = 26 if picture.numbers is None else 130
        axes.scatter(xs, ys, s=size, edgecolors="white", linewidths=1.0, zorder=3, clip_on=False, **filled)
        if picture.numbers is not None:
            for number, x, y, cost in zip(picture.numbers, xs, ys, costs, strict=True):
                dark = name != "standard deviation" and cost < 0.6 * low + 0.4 * high
                axes.annotate(
                    str(number),
                    (x, y),
                    ha="center",
                    va="center",
                    fontsize=6.5,
                    fontweight="bold",
                    color="white" if dark else style.INK,
                    zorder=4,
                )
    if picture.best is not None:
        _mark_best(axes, picture, x_axis, y_axis)
    style.dress(
        axes, title=_panel_title(name, picture), x=style.label(x_axis.name), y=style.label(y_axis.name), grid=None
    )
    _scale(axes, x_axis, "x")
    _scale(axes, y_axis, "y")
    bar = figure.colorbar(mesh, ax=axes, fraction=0.05, pad=0.02)
    bar.set_label(picture.cost if name != "standard deviation" else f"± {picture.cost}", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    from matplotlib.ticker import MaxNLocator

    bar.locator = MaxNLocator(6)
    bar.update_ticks()


def _panel_title(name: str, picture: SurrogatePicture) -> str:
    match name:
        case "mean":
            return f"surrogate mean, {len(picture.points)} {_things(picture)}"
        case "standard deviation":
            return "its standard deviation"
        case _:
            return f"{len(picture.points)} {_things(picture)}"


def _things(picture: SurrogatePicture) -> str:
    return "simulations" if picture.numbers is None else "pours"


def _mark_best(axes: Axes, picture: SurrogatePicture, x_axis: Axis, y_axis: Axis) -> None:
    assert picture.best is not None
    x, y = _column([picture.best], x_axis)[0], _column([picture.best], y_axis)[0]
    axes.scatter([x], [y], marker="*", s=330, color=style.BEST, edgecolors="white", linewidths=1.3, zorder=5)
    # The label goes towards the middle of the picture, where there is room for it.
    u, v = (axis.encode(float(picture.best[axis.name] or 0.0)) for axis in (x_axis, y_axis))
    axes.annotate(
        picture.best_name,
        (x, y),
        xytext=(11 if u < 0.6 else -11, 11 if v < 0.75 else -11),
        textcoords="offset points",
        ha="left" if u < 0.6 else "right",
        va="bottom" if v < 0.75 else "top",
        fontsize=10,
        fontweight="bold",
        color=style.INK,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
        zorder=6,
    )


def _slices(picture: SurrogatePicture) -> Figure:
    """One or more than two axes: the cost against each of them, the other axes wherever they were."""
    count = picture.space.dimension
    figure, axes = style.new_figure(1, count, size=(max(5.4, 3.4 * count), 3.9), squeeze=False, sharey=True)
    figure.suptitle(picture.title, fontsize=12.5, color=style.INK, x=0.02, ha="left")
    for place, axis in enumerate(picture.space.axes):
        panel = axes[0, place]
        panel.scatter(
            _column(picture.points, axis),
            picture.costs,
            s=22,
            color=style.MEASURED,
            alpha=0.75,
            edgecolors="white",
            linewidths=0.5,
        )
        if picture.best is not None:
            x = _column([picture.best], axis)[0]
            panel.axvline(x, color=style.BEST, linewidth=1.6)
            panel.annotate(
                f" {picture.best_name}",
                (x, 1.0),
                xycoords=("data", "axes fraction"),
                va="top",
                color=style.BEST,
                fontweight="bold",
                fontsize=9.5,
            )
        style.dress(panel, x=style.label(axis.name), y=picture.cost if place == 0 else "")
        _scale(panel, axis, "x")
    return figure


def _decode(axis: Axis, places: NDArray[np.float64]) -> NDArray[np.float64]:
    # Not Axis.decode for whole numbers: rounding would fold the grid's lines onto each other.
    smooth = Axis(axis.name, axis.lower, axis.upper, axis.scale)
    return np.array([smooth.decode(u) for u in places]) / style.display_factor(axis.name)


def _column(points: Sequence[Values], axis: Axis) -> NDArray[np.float64]:
    factor = style.display_factor(axis.name)
    return np.array([float(point[axis.name] or 0.0) / factor for point in points], dtype=float)


def _limits(values: NDArray[np.float64]) -> tuple[float, float]:
    """Colour range of the values, never empty."""
    low, high = float(np.min(values)), float(np.max(values))
    return (low, high) if high - low > 1e-12 else (low - 0.5, low + 0.5)


def _scale(axes: Axes, axis: Axis, which: str) -> None:
    factor = style.display_factor(axis.name)
    setter, limits = (axes.set_xscale, axes.set_xlim) if which == "x" else (axes.set_yscale, axes.set_ylim)
    handle = axes.xaxis if which == "x" else axes.yaxis
    if axis.scale == "log":
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        setter("log")
        handle.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        handle.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        handle.set_minor_formatter(NullFormatter())
    limits(axis.lower / factor, axis.upper / factor)
