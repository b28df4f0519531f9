"""The safe window as a picture: the loss over actions with the window in it, and the loss along each dimension."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.report import style
from orchestrator.report.maps import SurrogatePicture
from orchestrator.report.units import LossUnit, at_least_nothing
from orchestrator.strategies.deployment.learnt import Deployed, RiskFound
from orchestrator.strategies.deployment.window import WindowFound

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_window(
    path: Path, result: Deployed, picture: SurrogatePicture | None, *, unit: LossUnit, receiver: str
) -> Path:
    """A loss map with action and window, where there is one, and a panel for each dimension: what the surrogate
    expects along it, what the checks came to, the tolerance.

    Args:
        path: PNG to write.
        result: of a deployment, with its window and what it recommends.
        picture: its loss map.
        unit: of the loss.
        receiver: for the title.

    Returns:
        `path`.

    Raises:
        ValueError: no window was looked for, or nothing is recommended.
    """
    if result.window is None or result.recommended is None:
        raise ValueError("safe window: none was looked for")
    window, action = result.window, result.recommended.action_si
    names, mapped = list(window.outline), picture is not None and picture.mean is not None
    count = len(names) + mapped
    figure, axes = style.new_figure(1, count, size=(4.3 * count, 4.1), squeeze=False)
    measure = _measure(result.risk)
    figure.suptitle(f"Safe window: {receiver}, {measure}", fontsize=12.5, color=style.INK, x=0.02, ha="left")
    if picture is not None and mapped:
        _map_panel(axes[0, 0], picture, window, unit)
    for panel, name in zip(axes[0, count - len(names) :], names, strict=True):
        _profile(panel, name, window, action[name], unit)
        style.dress(panel, x=style.label(name), y=unit.label)
    handles, labels = axes[0, -1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8.5, frameon=False)
    return style.save(figure, path)


def _measure(risk: RiskFound | None) -> str:
    if risk is None:
        return "executed exactly but for one dimension"
    if risk.measure == "cvar":
        return f"CVaR {100 * risk.level:g} % under errors of execution"
    return "expected under errors of execution"


def _map_panel(axes: Axes, picture: SurrogatePicture, window: WindowFound, unit: LossUnit) -> None:
    across, up = picture.plane.axes
    assert picture.mean is not None
    mean, places = np.asarray(picture.mean), np.linspace(0.0, 1.0, len(picture.mean))
    xs, ys = (np.array([axis.decode(u) for u in places]) / style.display_factor(axis.name) for axis in (across, up))
    mesh = axes.contourf(xs, ys, mean, levels=20, cmap="viridis")
    axes.figure.colorbar(mesh, ax=axes, fraction=0.05, pad=0.02).ax.tick_params(labelsize=8)
    axes.contour(xs, ys, mean, levels=[unit.factor * window.tolerance], colors="white", linewidths=1.3)
    if picture.best is not None:
        x, y = (float(picture.best[a.name] or 0.0) / style.display_factor(a.name) for a in (across, up))
        for name, ends in window.axes.items():
            low, high = (end / style.display_factor(name) for end in (ends.low, ends.high))
            if name == across.name:
                axes.plot([low, high], [y, y], color=style.BEST, linewidth=3.0, solid_capstyle="butt", clip_on=False)
            elif name == up.name:
                axes.plot([x, x], [low, high], color=style.BEST, linewidth=3.0, solid_capstyle="butt", clip_on=False)
        axes.scatter(
            [x], [y], marker="*", s=230, color=style.BEST, edgecolors="white", linewidths=1.2, zorder=5, clip_on=False
        )
    style.dress(axes, title=f"{unit.label}, contour at the tolerance", x=style.label(across.name), grid=None)
    axes.set_ylabel(style.label(up.name), fontsize=9.5, color=style.INK)


def _profile(axes: Axes, name: str, window: WindowFound, best: float, unit: LossUnit) -> None:
    factor, tolerance = style.display_factor(name), unit.factor * window.tolerance
    along = window.outline[name]
    expected = [unit.factor * at_least_nothing(loss) for loss in along.expected]
    axes.plot(np.array(along.values) / factor, expected, color=style.PREDICTED, label="surrogate", zorder=2)
    axes.axhline(tolerance, color=style.GREY, linewidth=1.0, linestyle="--", label="tolerance")
    axes.axvline(best / factor, color=style.BEST, linewidth=1.4, label="action")
    if name in window.axes:
        ends = window.axes[name]
        axes.axvspan(ends.low / factor, ends.high / factor, color=style.GOOD, alpha=0.16, label="safe window")
    top = 4.0 * tolerance
    for inside, colour, marker in ((True, style.GOOD, "o"), (False, style.SPILLED, "X")):
        checks = [c for c in window.checks if c.inside is inside and c.axis in (None, name)]
        losses = [top if c.loss is None else unit.factor * c.loss for c in checks]
        top = max([top, *losses]) if losses else top
        said = "simulated, inside" if inside else "simulated, outside"
        places = [c.action_si[name] / factor for c in checks]
        axes.plot(places, losses, marker, color=colour, markeredgecolor="white", markersize=8, label=said, zorder=4)
    axes.set_ylim(0.0, 1.08 * min(top, max([*expected, 4.0 * tolerance])))
