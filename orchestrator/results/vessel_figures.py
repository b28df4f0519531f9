"""Pictures of a vessel that was measured: its section, what is uncertain about it, and what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.results import figure_style as style
from orchestrator.results.pour_figures import section
from sim_engine.vessel.profile import outer_profile

if TYPE_CHECKING:
    from sim_engine.vessel.vessel import Vessel
    from sim_engine.vessel_acquisition.outline_fit import Evidence, FittedOutline

BAND = 2.0
"""Standard deviations that the band shows to either side."""


def draw_outline(name: str, outline: FittedOutline, evidence: Sequence[Evidence], path: Path) -> Path:
    """The section of a turned vessel with its band, and the radii and levels that were measured."""
    from sim_engine.vessel_acquisition.measurements import FillTable, Radii

    figure, axes = style.new_figure(size=(6.0, 5.0))
    shape = outline.shape()
    inner = np.array(shape.inner)
    outer = outer_profile(inner, shape.wall, shape.floor)
    solid = 1e3 * np.vstack([inner, outer[::-1], [0.0, -shape.floor]])
    for side in (1.0, -1.0):
        axes.fill(side * solid[:, 0], solid[:, 1], color=style.PALE, lw=0, zorder=1)
    z, r, sd = 1e3 * outline.heights, 1e3 * outline.radii, 1e3 * BAND * outline.deviations
    for side in (1.0, -1.0):
        axes.fill_betweenx(z, side * (r - sd), side * (r + sd), color=style.PREDICTED, alpha=0.35, lw=0, zorder=2)
        axes.plot(side * r, z, color=style.INK, lw=1.6, zorder=3)
    axes.plot([-r[0], r[0]], [0.0, 0.0], color=style.INK, lw=1.6, zorder=3)
    axes.fill([], [], color=style.PREDICTED, alpha=0.35, label=f"± {BAND:g} standard deviations of the radius")
    marks = iter(("o", "s", "^"))
    for piece in evidence:
        if isinstance(piece, Radii):
            axes.plot(
                1e3 * piece.observed,
                1e3 * piece.heights,
                next(marks),
                color=style.MEASURED,
                ms=4 if len(piece.observed) < 15 else 2.5,
                label=piece.name,
                zorder=4,
            )
        elif isinstance(piece, FillTable):
            levels = 1e3 * piece.levels
            axes.plot(0.0 * levels, levels, "_", color=style.MEASURED, ms=12, label=f"levels of the {piece.name}")
    title = f"{name}: {1e6 * outline.capacity:.0f} ± {1e6 * outline.capacity_deviation:.1f} mL"
    style.dress(axes, title=title, x="distance from the axis [mm]", y="height above the inner floor [mm]")
    axes.set_aspect("equal")
    axes.margins(0.08)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False, fontsize=8)
    return style.save(figure, path)


def draw_solid(name: str, vessel: Vessel, path: Path) -> Path:
    """The section of a mesh through its middle."""
    figure, axes = style.new_figure(size=(6.0, 5.0))
    for loop in section(vessel.solid_vertices, vessel.solid_faces):
        axes.fill(1e3 * loop[:, 0], 1e3 * (loop[:, 1] - vessel.inner_floor), fc=style.PALE, ec=style.INK, lw=1.6)
    style.dress(
        axes,
        title=f"{name}: {1e6 * vessel.capacity:.0f} mL",
        x="across, through the opening's middle [mm]",
        y="height above the inner floor [mm]",
    )
    axes.set_aspect("equal")
    axes.margins(0.08)
    return style.save(figure, path)
