"""What the pours say about θ: a corner plot of the posterior's draws."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from orchestrator.report import style
from orchestrator.strategies.calibration.posterior import PosteriorFound
from sim_engine.space import Space

BINS = 18


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
    figure, panels = style.new_figure(d, d, size=(1.6 + 2.3 * d, 1.4 + 2.2 * d), squeeze=False)
    title = f"θ that fit the pours: {len(draws)} draws, worth {posterior.effective:.0f}; bars: {posterior.level:.0%}"
    figure.suptitle(title, fontsize=12, color=style.INK, x=0.02, ha="left")
    for row, up in enumerate(axes):
        for column, across in enumerate(axes):
            panel = panels[row, column]
            if column > row:
                panel.set_visible(False)
                continue
            x = np.array([draw[across.name] for draw in draws])
            if across.scale == "log":
                panel.set_xscale("log")
            if row == column:
                edges = _edges(across.lower, across.upper, across.scale)
                panel.hist(x, bins=edges, color=style.PALE)
                panel.axvspan(*posterior.region[across.name], color=style.MEASURED, alpha=0.18, linewidth=0.0)
                panel.set_yticks([])
            else:
                panel.plot(x, [draw[up.name] for draw in draws], ".", color=style.MEASURED, markersize=3, alpha=0.5)
                panel.plot(theta[across.name], theta[up.name], "*", color=style.BEST, markersize=11)
                if up.scale == "log":
                    panel.set_yscale("log")
                panel.set_ylim(up.lower, up.upper)
            if row == column:
                panel.axvline(theta[across.name], color=style.BEST, linewidth=1.6)
            panel.set_xlim(across.lower, across.upper)
            style.dress(
                panel,
                x=style.label(across.name) if row == d - 1 else "",
                y=style.label(up.name) if column == 0 and row > 0 else "",
                grid=None,
            )
    return style.save(figure, path)


def _edges(lower: float, upper: float, scale: str) -> Any:
    return np.geomspace(lower, upper, BINS + 1) if scale == "log" else np.linspace(lower, upper, BINS + 1)
