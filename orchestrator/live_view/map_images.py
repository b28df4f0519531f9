"""Pictures for which Rerun has no plot type: surrogates over two axes, and the posterior of θ.

The functions return matplotlib figures; `png` encodes them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Point, PourQuery, SimulationQuery, Suggestion, SurrogateQuery
from actors.optimizer.suggest import slices
from orchestrator.results import figure_style as style
from orchestrator.results.loss_units import LossUnit
from orchestrator.strategies.calibration.calibration_base import CalibratedTheta

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

_DPI = 80


def simulated_points(query: SurrogateQuery) -> tuple[Point, ...]:
    """Simulated observations of a query; empty if its type has none."""
    return query.simulated.points if isinstance(query, PourQuery | SimulationQuery) else ()


def png(figure: Figure) -> bytes:
    """Encode a figure as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    figure.set_dpi(_DPI)
    # `savefig` would draw it twice, the first time for layouts that PNG does not need.
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]
    return buffer.getvalue()


def surrogate_picture(query: SurrogateQuery, suggestion: Suggestion, unit: LossUnit, title: str) -> Figure:
    """Draw mean, deviation and lower bound of a surrogate over two axes, with observations and the next points.

    Args:
        query: suggestion query.
        suggestion: result with a surrogate.
        unit: unit of the cost.
        title: title of the picture.
    """
    assert suggestion.surrogate is not None
    surrogate, space = suggestion.surrogate, query.space
    plane = surrogate.plane(space)
    columns = [space.names.index(name) for name in plane.names]
    mean, deviation = (unit.factor * np.asarray(grid, float) for grid in (surrogate.mean, surrogate.deviation))
    bound = mean - query.kappa * deviation
    figure, axes = style.new_figure(1, 3, size=(15.0, 5.2), layout=None)
    figure.subplots_adjust(left=0.065, right=0.955, bottom=0.13, top=0.85, wspace=0.18)
    held = style.display_values(dict(surrogate.held(space)))
    figure.suptitle(f"{title}{f'   (held: {held})' if held else ''}", fontsize=17, color=style.INK, x=0.01, ha="left")
    panels = (
        (f"expected {unit.label}", np.maximum(mean, 0.0), "viridis_r"),
        (f"± σ [{unit.unit}]", deviation, "cividis"),
        (f"lower bound, mean − {query.kappa:g} σ [{unit.unit}]", bound, "viridis_r"),
    )
    simulated = simulated_points(query)
    across, up = plane.axes
    scales = [style.display_factor(axis.name) for axis in (across, up)]
    places = np.linspace(0.0, 1.0, len(mean))
    grid = [[axis.decode(u) / scale for u in places] for axis, scale in zip((across, up), scales, strict=True)]
    for panel, (name, values, colours) in zip(axes, panels, strict=True):
        picture = panel.pcolormesh(*grid, values, shading="nearest", cmap=colours, zorder=0, rasterized=True)
        bar = figure.colorbar(picture, ax=panel, pad=0.03, fraction=0.06)
        bar.ax.tick_params(labelsize=13)
        for points, look in (
            (simulated, {"marker": "o", "s": 14, "facecolor": "none", "edgecolor": style.INK}),
            (query.data.points, {"marker": "o", "s": 55, "facecolor": "white", "edgecolor": style.INK}),
            (suggestion.points, {"marker": "*", "s": 330, "facecolor": style.BEST, "edgecolor": "white"}),
        ):
            if points:
                xs, ys = _values(points, columns, plane.axes, scales)
                panel.scatter(xs, ys, linewidth=1.2, zorder=4, **look)
        panel.set_title(name, fontsize=14, loc="left", color=style.INK)
        panel.set_xlabel(style.label(across.name), fontsize=14)
        style.frame(panel, across, "x")
        style.frame(panel, up, "y")
        panel.tick_params(labelsize=13, labelleft=panel is axes[0])
    axes[0].set_ylabel(style.label(up.name), fontsize=14)
    axes[1].set_xlabel(f"{style.label(across.name)}      {_key(query, suggestion)}", fontsize=14)
    return figure


def slices_picture(query: SurrogateQuery, suggestion: Suggestion, unit: LossUnit, title: str) -> Figure:
    """Draw a surrogate over each pair of axes: mean below the diagonal, deviation above it, with data and next points.

    Args:
        query: suggestion query with more than two axes.
        suggestion: result with a surrogate.
        unit: unit of the cost.
        title: title of the picture.
    """
    maps = slices(query, suggestion)
    names = [name for name in query.space.names if any(name in one.axes for one in maps)]
    if not names:
        return words(f"{title}: too little for slices")
    axis_of = dict(zip(query.space.names, query.space.axes, strict=True))
    column_of = {name: query.space.names.index(name) for name in names}
    figure, axes = style.new_figure(len(names), len(names), size=(15.0, 9.0), squeeze=False)
    figure.suptitle(title, fontsize=17, color=style.INK, x=0.01, ha="left")
    means = [unit.factor * np.maximum(np.asarray(one.mean, float), 0.0) for one in maps]
    deviations = [unit.factor * np.asarray(one.deviation, float) for one in maps]
    seen = (
        (simulated_points(query), {"marker": "o", "s": 10, "facecolor": "none", "edgecolor": style.INK}),
        (query.data.points, {"marker": "o", "s": 30, "facecolor": "white", "edgecolor": style.INK}),
        (suggestion.points, {"marker": "*", "s": 200, "facecolor": style.BEST, "edgecolor": "white"}),
    )
    drawn: dict[str, Any] = {}
    for one, mean, deviation in zip(maps, means, deviations, strict=True):
        low, high = (names.index(name) for name in one.axes)
        # Below the diagonal, the first axis is horizontal; above it, the panel is transposed.
        for kind, (row, column), values, every, colours in (
            ("mean", (high, low), mean, means, "viridis_r"),
            ("sd", (low, high), deviation.T, deviations, "cividis"),
        ):
            panel, across, up = axes[row, column], axis_of[names[column]], axis_of[names[row]]
            places = np.linspace(0.0, 1.0, len(values))
            scales = [style.display_factor(axis.name) for axis in (across, up)]
            grid = [[axis.decode(u) / scale for u in places] for axis, scale in zip((across, up), scales, strict=True)]
            span = {"vmin": min(float(v.min()) for v in every), "vmax": max(float(v.max()) for v in every)}
            drawn[kind] = panel.pcolormesh(*grid, values, shading="nearest", cmap=colours, rasterized=True, **span)
            for points, look in seen:
                if points:
                    places_of = [column_of[across.name], column_of[up.name]]
                    panel.scatter(*_values(points, places_of, (across, up), scales), zorder=4, **look)
            style.frame(panel, across, "x")
            style.frame(panel, up, "y")
            panel.tick_params(labelsize=12, labelbottom=row == len(names) - 1, labelleft=column == 0)
    for place, name in enumerate(names):
        axes[place, place].axis("off")
        axes[place, place].text(0.5, 0.5, style.label(name).replace(" [", "\n["), ha="center", va="center", fontsize=15)
        if place:
            axes[place, 0].set_ylabel(style.label(name), fontsize=13)
        if place < len(names) - 1:
            axes[-1, place].set_xlabel(style.label(name), fontsize=13)
    for kind, text in (("mean", f"below: expected {unit.label}"), ("sd", f"above: ± σ [{unit.unit}]")):
        bar = figure.colorbar(drawn[kind], ax=axes, pad=0.01, aspect=40)
        bar.set_label(text, fontsize=13)
        bar.ax.tick_params(labelsize=12)
    held = style.display_values(dict(query.space.decode(maps[0].at)))
    figure.supxlabel(f"each cut goes through {held}      {_key(query, suggestion)}", fontsize=13, color=style.INK)
    return figure


def _key(query: SurrogateQuery, suggestion: Suggestion) -> str:
    marks = ["○ poured   ∘ simulated" if simulated_points(query) else "○ observed"]
    return "   ".join([*marks, "★ next"] if suggestion.points else marks)


def words(text: str) -> Figure:
    """Draw a line of text as placeholder."""
    figure, axes = style.new_figure(size=(15.0, 5.2))
    axes.axis("off")
    axes.text(0.5, 0.5, text, ha="center", va="center", fontsize=26, color=style.GREY)
    return figure


def theta_picture(found: CalibratedTheta) -> Figure:
    """Draw θ* and its posterior: one panel for each searched parameter."""
    names = found.searched
    figure, axes = style.new_figure(1, len(names), size=(5.0 * max(len(names), 2), 4.2), squeeze=False)
    expected = f"expected |measured − simulated| {100 * max(found.predicted_discrepancy, 0.0):.1f} %"
    figure.suptitle(f"θ*: {expected}", fontsize=17, color=style.INK, x=0.01, ha="left")
    draws = () if found.posterior is None else found.posterior.thetas
    chosen = found.theta.model_dump()
    for panel, name in zip(axes[0], names, strict=True):
        if draws:
            panel.hist([theta[name] for theta in draws], bins=24, color=style.FALLING, density=True)
        panel.axvline(chosen[name], color=style.BEST, linewidth=3.0)
        title = f"{style.display_value(name, chosen[name])}"
        panel.set_title(title, fontsize=15, loc="left", color=style.BEST)
        panel.set_xlabel(style.label(name), fontsize=14)
        panel.set_yticks([])
        panel.tick_params(labelsize=13)
    axes[0, 0].set_ylabel("how well it fits", fontsize=14)
    return figure


def _values(
    points: Sequence[Sequence[float]], columns: list[int], axes: Any, scales: list[float]
) -> tuple[list[float], list[float]]:
    across, up = (
        [axis.decode(point[column]) / scale for point in points]
        for axis, column, scale in zip(axes, columns, scales, strict=True)
    )
    return across, up
