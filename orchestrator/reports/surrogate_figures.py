"""Figures of surrogates and posteriors.

- `draw_surrogate` and `draw_trials`: the discrepancy over θ, or the predicted loss over actions.
- `draw_posterior`: the posterior of θ as a corner plot.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orchestrator.learning.calibration.posterior_summary import PosteriorFound
from orchestrator.reports import figure_style as style
from sim_engine.search_space import Axis, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = Mapping[str, float | None]
"""Named SI values of one point."""


@dataclass(frozen=True)
class SurrogatePicture:
    """A surrogate's cost function, prepared for a figure.

    Attributes:
        title: title of the figure.
        cost: label of the cost with its unit, e.g. 'discrepancy [%]'.
        space: search space.
        points: observed points, SI.
        costs: observed costs, in the unit of `cost`.
        best: the chosen point, SI; None if there is none.
        best_name: name of the chosen point: 'θ*', 'best action'.
        mean: (R, R) surrogate mean over the unit square, row i at the second axis's i-th place; None without a map.
        deviation: (R, R) its standard deviation.
        numbers: labels of the points (pours); None: they are dots (simulated θ).
        over: names of the map's two axes; empty if the space has no others.
        held: values of the other axes in the displayed section, SI.
        simulated: points of simulations in addition to the observed pours, SI.
        largest: maximum possible cost; larger values of the surrogate are clipped.
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
    simulated: Sequence[Values] = ()
    largest: float = math.inf

    @property
    def plane(self) -> Space:
        """The two axes of the map, the first horizontal, the second vertical."""
        return Space(tuple(axis for axis in self.space.axes if not self.over or axis.name in self.over))


def draw_surrogate(picture: SurrogatePicture) -> Figure:
    """Draw a surrogate: maps of mean and deviation over two axes; without a map, as `draw_trials`.

    With more than two axes the map is a section of the surrogate; observations from the whole space are projected on
    it.

    Args:
        picture: at least one point or a map.

    Raises:
        ValueError: there is nothing to draw.
    """
    mapped = picture.mean is not None or picture.deviation is not None
    if not picture.points and not mapped:
        raise ValueError(f"'{picture.title}': neither a surrogate nor a single observation to draw")
    two = picture.space.dimension == 2 or (mapped and picture.space.dimension > 2)
    return _maps(picture) if two else _slices(picture)


def draw_trials(picture: SurrogatePicture) -> Figure:
    """Draw the observed costs against each searched axis, in adjacent panels.

    Args:
        picture: at least one point.

    Raises:
        ValueError: there is nothing to draw.
    """
    if not picture.points:
        raise ValueError(f"'{picture.title}': not a single observation to draw")
    return _slices(picture)


def _maps(picture: SurrogatePicture) -> Figure:
    panels: list[tuple[str, NDArray[np.float64] | None]] = [
        ("mean", picture.mean),
        ("standard deviation", picture.deviation),
    ]
    shown: list[tuple[str, NDArray[np.float64] | None]] = [panel for panel in panels if panel[1] is not None] or [
        ("observations", None)
    ]
    alone = len(shown) == 1  # then the legend has no room beside the title
    figure, axes = style.new_figure(1, len(shown), size=(6.4 if alone else 5.6 * len(shown), 4.8), squeeze=False)
    style.entitle(figure, picture.title)
    for place, (name, grid) in enumerate(shown):
        _map_panel(figure, axes[0, place], picture, name, grid)
    marked = {name: h for h, name in zip(*axes[0, 0].get_legend_handles_labels(), strict=True)}
    wide = round(15 * figure.get_figwidth())  # letters of this size
    notes, size = "\n".join(textwrap.fill(note, wide) for note in _notes(picture)), 8.5
    if marked and alone:  # the notes are in the legend: both below the map would overlap
        below = {"title": notes or None, "title_fontsize": size, "alignment": "left"}
        figure.legend(
            marked.values(), marked.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=9, **below
        )
    elif marked:
        figure.legend(marked.values(), marked.keys(), loc="outside upper right", ncols=3, frameon=False, fontsize=9)
    if notes and not (marked and alone):
        figure.supxlabel(notes, fontsize=size, color=style.INK, x=0.02, ha="left")
    return figure


def _notes(picture: SurrogatePicture) -> list[str]:
    """Position of the map's section, and whether the best point is at an end of a range."""
    notes = []
    if picture.held:
        note = f"others at {picture.best_name}: {style.display_values(dict(picture.held))}"
        if picture.points:
            things = "θ" if picture.numbers is None else "pours"
            note += f"; the {things} have any values of them"
        notes.append(note)
    if picture.best is not None and (ends := style.at_ends(dict(picture.best), picture.space.axes)):
        notes.append(f"{picture.best_name} has {' and '.join(ends)}: a wider range may hold a better one")
    return notes


def _map_panel(
    figure: Figure, axes: Axes, picture: SurrogatePicture, name: str, grid: NDArray[np.float64] | None
) -> None:
    x_axis, y_axis = picture.plane.axes
    # Deviations show the accuracy of the mean, not the quality of a point, so they have another colour map.
    colours = "cividis" if name == "standard deviation" else "viridis"
    costs = np.asarray(picture.costs, dtype=float)
    low, high = _limits(np.minimum(costs if grid is None else np.asarray(grid, dtype=float), picture.largest))
    if grid is not None:
        mesh = _coloured(axes, picture, np.asarray(grid, dtype=float), colours, low, high)
        if name == "mean":
            _contours(axes, picture, np.asarray(grid, dtype=float), low, high)
    else:
        mesh = axes.scatter([], [], c=[], cmap=colours, vmin=low, vmax=high)
    if picture.simulated:
        places = (_column(picture.simulated, x_axis), _column(picture.simulated, y_axis))
        axes.scatter(
            *places,
            marker="X",
            s=26,
            linewidths=0.6,
            facecolor="white",  # grey lines are hardly visible in the middle of a colour map
            edgecolor=style.INK,
            clip_on=False,
            zorder=3,
            label="simulation",
        )
    # Observations are filled with their own cost on the same scale: visible points disagree with the surrogate.
    filled: dict[str, Any] = {"c": "white"}
    if name != "standard deviation":
        filled = {"c": np.minimum(costs, picture.largest), "cmap": colours, "vmin": low, "vmax": high}
    _observed(
        axes, picture, filled, np.full(len(costs), name != "standard deviation") & (costs < 0.6 * low + 0.4 * high)
    )
    if picture.best is not None:
        _mark_best(axes, picture, x_axis, y_axis)
    style.dress(
        axes, title=_panel_title(name, picture), x=style.label(x_axis.name), y=style.label(y_axis.name), grid=None
    )
    style.frame(axes, x_axis, "x")
    style.frame(axes, y_axis, "y")
    _bar(figure, axes, mesh, picture.cost if name != "standard deviation" else f"± {picture.cost}")


def _coloured(
    axes: Axes, picture: SurrogatePicture, values: NDArray[np.float64], colours: str, low: float, high: float
) -> Any:
    """Draw the grid in its own colour range: noisy single observations would flatten it."""
    x_axis, y_axis = picture.plane.axes
    places = np.linspace(0.0, 1.0, values.shape[0])
    beyond: Any = "max" if values.max() > high + 1e-9 * (high - low) else "neither"
    return axes.contourf(
        _decode(x_axis, places),
        _decode(y_axis, places),
        np.maximum(values, low),
        levels=np.linspace(low, high, 25),
        cmap=colours,
        extend=beyond,
    )


def _contours(axes: Axes, picture: SurrogatePicture, values: NDArray[np.float64], low: float, high: float) -> None:
    x_axis, y_axis = picture.plane.axes
    places = np.linspace(0.0, 1.0, values.shape[0])
    axes.contour(
        _decode(x_axis, places),
        _decode(y_axis, places),
        values,
        levels=np.linspace(low, high, 9)[1:-1],
        colors="white",
        linewidths=0.5,
        alpha=0.6,
    )


def _observed(axes: Axes, picture: SurrogatePicture, filled: Mapping[str, Any], dark: NDArray[np.bool_]) -> None:
    """Dots, or numbered discs; not clipped at the edge."""
    if not len(picture.points):
        return
    xs, ys = (_column(picture.points, axis) for axis in picture.plane.axes)
    size = 26 if picture.numbers is None else 130
    edge = style.INK if isinstance(filled["c"], str) else "white"
    name = "simulated θ" if picture.numbers is None else "pour"
    axes.scatter(xs, ys, s=size, edgecolors=edge, linewidths=1.0, zorder=5, clip_on=False, label=name, **filled)
    for number, x, y, inked in zip(picture.numbers or (), xs, ys, ~dark, strict=False):
        colour = style.INK if inked else "white"
        axes.text(x, y, str(number), ha="center", va="center", fontsize=6.5, fontweight="bold", color=colour, zorder=6)


def _bar(figure: Figure, axes: Axes, mesh: Any, label: str) -> None:
    from matplotlib.ticker import MaxNLocator

    bar = figure.colorbar(mesh, ax=axes, fraction=0.05, pad=0.03)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(6)
    bar.update_ticks()


def _panel_title(name: str, picture: SurrogatePicture) -> str:
    match name:
        case "mean":
            return f"surrogate mean, {_counted(picture)}"
        case "standard deviation":
            return "its standard deviation"
        case _:
            return _counted(picture)


def _counted(picture: SurrogatePicture) -> str:
    # not "simulations": each θ may have been simulated on many pours
    number = len(picture.points)
    return f"{number} θ" if picture.numbers is None else f"{number} pour{'s' * (number != 1)}"


def _mark_best(axes: Axes, picture: SurrogatePicture, x_axis: Axis, y_axis: Axis) -> None:
    assert picture.best is not None
    x, y = _column([picture.best], x_axis)[0], _column([picture.best], y_axis)[0]
    # Above the map and below the numbers, so that the number of a pour of the best action is readable.
    axes.scatter(
        [x], [y], marker="*", s=560, color=style.BEST, edgecolors="white", linewidths=1.3, zorder=4, clip_on=False,
        label=picture.best_name,
    )  # fmt: skip


def _slices(picture: SurrogatePicture) -> Figure:
    """One axis or more than two: the cost against each of them, over all values of the other axes."""
    count = picture.space.dimension
    figure, axes = style.new_figure(1, count, size=(max(5.4, 3.4 * count), 4.1), squeeze=False, sharey=True)
    style.entitle(figure, picture.title)
    for place, axis in enumerate(picture.space.axes):
        panel = axes[0, place]
        panel.scatter(
            _column(picture.points, axis),
            picture.costs,
            s=26,
            color=style.MEASURED,
            alpha=0.75,
            edgecolors="white",
            linewidths=0.5,
            clip_on=False,
            zorder=3,
            label="pour" if picture.numbers is not None else "simulated θ, the other parameters at any values",
        )
        if picture.best is not None:
            x = _column([picture.best], axis)[0]
            panel.axvline(x, color=style.BEST, linewidth=1.8, label=picture.best_name)
        style.dress(panel, x=style.label(axis.name), y=picture.cost if place == 0 else "")
        style.frame(panel, axis, "x")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _decode(axis: Axis, places: NDArray[np.float64]) -> NDArray[np.float64]:
    # Not Axis.decode for whole numbers: rounding would make grid lines coincide.
    smooth = Axis(axis.name, axis.lower, axis.upper, axis.scale)
    return np.array([smooth.decode(u) for u in places]) / style.display_factor(axis.name)


def _column(points: Sequence[Values], axis: Axis) -> NDArray[np.float64]:
    factor = style.display_factor(axis.name)
    return np.array([float(point[axis.name] or 0.0) / factor for point in points], dtype=float)


def _limits(values: NDArray[np.float64]) -> tuple[float, float]:
    """Colour range of the values, never empty."""
    low, high = float(np.min(values)), float(np.max(values))
    return (low, high) if high - low > 1e-12 else (low - 0.5, low + 0.5)


BINS = 18


def draw_posterior(posterior: PosteriorFound, space: Space, theta: Mapping[str, float]) -> Figure:
    """One histogram per searched parameter with its region, one cloud per pair, θ* marked; logarithmic axes are kept.

    Args:
        posterior: posterior of a calibration's result.
        space: searched θ, the plot's range.
        theta: θ*.

    Raises:
        ValueError: there are no draws.
    """
    draws = posterior.thetas
    if not draws:
        raise ValueError("posterior figure: no draws of θ")
    axes, d = space.axes, space.dimension
    figure, panels = style.new_figure(d, d, size=(max(1.8 + 2.3 * d, 6.0), 1.9 + 2.2 * d), squeeze=False, sharex="col")
    style.entitle(figure, f"θ that fit the pours\n{len(draws)} draws")
    for row, up in enumerate(axes):
        for column, across in enumerate(axes):
            panel = panels[row, column]
            if column > row:
                panel.set_visible(False)
                continue
            bottom = style.label(across.name) if row == d - 1 else ""
            if row == column:
                _histogram(panel, across, posterior, theta)
                style.dress(panel, x=bottom, y="draws", grid=None)
            else:
                _cloud(panel, across, up, draws, theta)
                style.dress(panel, x=bottom, y=style.label(up.name) if column == 0 else "", grid=None)
                style.frame(panel, up, "y")
            style.frame(panel, across, "x")
            if row < d - 1:
                panel.tick_params(labelbottom=False)
            if 0 < column < row:
                panel.tick_params(labelleft=False)
    handles: dict[str, Any] = {}
    for panel in panels.flat:
        handles |= {name: handle for handle, name in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def _histogram(panel: Axes, axis: Axis, posterior: PosteriorFound, theta: Mapping[str, float]) -> None:
    factor = style.display_factor(axis.name)
    steps = np.geomspace if axis.scale == "log" else np.linspace
    bins = steps(axis.lower / factor, axis.upper / factor, BINS + 1).tolist()
    panel.hist([draw[axis.name] / factor for draw in posterior.thetas], bins=bins, color=style.GREY)
    low, high = (bound / factor for bound in posterior.region[axis.name])
    name = f"{100 * posterior.level:.0f} % of the draws"
    panel.axvspan(low, high, color=style.MEASURED, alpha=0.18, linewidth=0.0, label=name)
    panel.axvline(theta[axis.name] / factor, color=style.BEST, linewidth=1.8, label="θ*")


def _cloud(
    panel: Axes, across: Axis, up: Axis, draws: Sequence[Mapping[str, float]], theta: Mapping[str, float]
) -> None:
    def shown(values: Mapping[str, float]) -> tuple[float, float]:
        return values[across.name] / style.display_factor(across.name), values[up.name] / style.display_factor(up.name)

    places = zip(*map(shown, draws), strict=True)
    panel.plot(*places, ".", color=style.MEASURED, markersize=4, alpha=0.45, label="a draw")
    panel.plot(*shown(theta), "*", color=style.BEST, markersize=13, markeredgecolor="white", zorder=4)
