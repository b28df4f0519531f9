"""What the pours say about θ: in words, and as a corner plot of the posterior's draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orchestrator.results import figure_style as style
from orchestrator.strategies.calibration.posterior_summary import PosteriorFound, PosteriorSummary
from sim_engine.search_space import Axis, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 18


def posterior_lines(posterior: PosteriorSummary, space: Space) -> list[str]:
    """What the pours determine of θ and what they don't, one sentence a line.

    Args:
        posterior: of a calibration's result.
        space: searched θ.
    """
    known, unknown = [], []
    for axis in space.axes:
        words, searched = axis.name.replace("_", " "), _interval(axis.name, axis.lower, axis.upper)
        if axis.name in posterior.open:
            unknown.append(f"{words} ({searched})")
        else:
            known.append(f"{words} {_interval(axis.name, *posterior.region[axis.name])} (searched {searched})")
    lines = []
    if known:
        lines.append(f"{100 * posterior.level:.0f} % of the θ that fit the pours have {', '.join(known)}")
    if unknown:
        lines.append(
            f"the pours don't determine {', '.join(unknown)}: nearly all of what was searched fits them as well as θ*"
        )
    return [*lines, *posterior.directions]


def _interval(name: str, low: float, high: float) -> str:
    """'0.31 … 0.74 N/m'."""
    first = style.display_value(name, low).removesuffix(style.display_unit(name)).rstrip()
    return f"{first} … {style.display_value(name, high)}"


def draw_posterior(path: Path, posterior: PosteriorFound, space: Space, theta: Mapping[str, float]) -> Path:
    """One histogram per searched parameter with its region, one cloud per pair, θ* marked; logarithmic axes as such.

    Args:
        path: PNG to write.
        posterior: of a calibration's result.
        space: searched θ, the plot's range.
        theta: θ*.

    Returns:
        `path`.

    Raises:
        ValueError: there are no draws.
    """
    draws = posterior.thetas
    if not draws:
        raise ValueError("posterior figure: no draws of θ")
    axes, d = space.axes, space.dimension
    figure, panels = style.new_figure(d, d, size=(max(1.8 + 2.3 * d, 6.0), 1.9 + 2.2 * d), squeeze=False, sharex="col")
    figure.suptitle(f"θ that fit the pours\n{len(draws)} draws", fontsize=12.5, color=style.INK, x=0.02, ha="left")
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
    return style.save(figure, path)


def _histogram(panel: Axes, axis: Axis, posterior: PosteriorFound, theta: Mapping[str, float]) -> None:
    steps = np.geomspace if axis.scale == "log" else np.linspace
    values = [draw[axis.name] for draw in posterior.thetas]
    panel.hist(values, bins=steps(axis.lower, axis.upper, BINS + 1).tolist(), color=style.GREY)
    name = f"{100 * posterior.level:.0f} % of the draws"
    panel.axvspan(*posterior.region[axis.name], color=style.MEASURED, alpha=0.18, linewidth=0.0, label=name)
    panel.axvline(theta[axis.name], color=style.BEST, linewidth=1.8, label="θ*")


def _cloud(
    panel: Axes, across: Axis, up: Axis, draws: Sequence[Mapping[str, float]], theta: Mapping[str, float]
) -> None:
    places = [[draw[axis.name] for draw in draws] for axis in (across, up)]
    panel.plot(*places, ".", color=style.MEASURED, markersize=4, alpha=0.45, label="a draw")
    panel.plot(
        theta[across.name], theta[up.name], "*", color=style.BEST, markersize=13, markeredgecolor="white", zorder=4
    )
