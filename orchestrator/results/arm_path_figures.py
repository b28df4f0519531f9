"""Figure of an arm's planned path: the pour from the side, and the arm in its cell from above and from the front.

`draw_path` returns the figure; `path_png` writes it.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orchestrator.results import figure_style as style
from orchestrator.results.pour_figures import fill_section, place, section

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from actors.arm.arm_settings import UrArmSpec
    from actors.arm.planned_pour import PourPath
    from actors.arm.planning.kinematics import Transforms
    from actors.arm.planning.trajectory import SampledPath
    from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

_STAND = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_WAYS = (("approach", "way there and back", style.GREY), ("pour", "pour", style.POURER))
_AXES = ("x: where the liquid goes [mm]", "y [mm]", "z: up [mm]")
_LINE = 175
"""Characters per line above the figure."""
_MARGIN = 40.0
"""Margin around the close-up of the pour [mm]."""


def path_png(
    file: Path, path: PourPath, spec: UrArmSpec, pourer: Vessel, receiver: Vessel, *, title: str, note: str = ""
) -> Path:
    """Write the figure of a path.

    Args:
        file: PNG to write.
        path: the planned path.
        spec: settings of the arm and its cell.
        pourer, receiver: geometry.
        title: first line.
        note: text below the title.

    Returns:
        `file`.
    """
    return style.save(draw_path(path, spec, pourer, receiver, title=title, note=note), file)


def draw_path(
    path: PourPath, spec: UrArmSpec, pourer: Vessel, receiver: Vessel, *, title: str, note: str = ""
) -> Figure:
    """The figure of `path_png`."""
    from actors.arm.planning.kinematics import cell_transforms
    from actors.arm.planning.trajectory import SampledPath

    stretches = [SampledPath.of(name, getattr(path, name), spec) for name, _, _ in _WAYS]
    world = cell_transforms(spec).world.inverse
    base, table = 1e3 * world.position, float(1e3 * world.apply(np.array([[0.0, 0.0, spec.cell.table]]))[0, 2])
    # Seen along the direction to the robot, the base would be hidden below the receiver, so the arm is drawn from the
    # side.
    across = 0 if abs(base[0]) > abs(base[1]) else 1
    figure, (near, top, front) = style.new_figure(1, 3, size=(15.0, 6.0), width_ratios=(1.0, 1.0, 1.0))
    lines = [title, *textwrap.wrap(note, _LINE)]
    figure.suptitle("\n".join(lines), fontsize=10.5, color=style.INK, x=0.01, ha="left")
    _near(near, stretches, world, table, pourer, receiver)
    for axes, horizontal, vertical, name in (
        (top, 0, 1, "the cell from above"),
        (front, across, 2, "the cell from the side" if across == 0 else "the cell across the pour"),
    ):
        _cell(axes, stretches[1], spec, world, (horizontal, vertical))
        style.dress(axes, title=name, x=_AXES[horizontal], y=_AXES[vertical], grid="both")
        axes.plot(base[horizontal], base[vertical], "s", color=style.INK, markersize=9, label="robot's base", zorder=5)
    _from_above(top, stretches[1], pourer, receiver)
    _upright(front, stretches[1], pourer, receiver, across)
    front.axhline(table, color=style.INK, linewidth=1.0)
    handles = {n: h for axes in (near, top) for h, n in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    return figure


def _near(
    axes: Axes, stretches: list[SampledPath], world: Transforms, table: float, pourer: Vessel, receiver: Vessel
) -> None:
    """The pour: cross-sections of both vessels, and the paths of tool and pourer near them."""
    shown = [_vessels_from_the_side(axes, stretches[1], pourer, receiver)]
    for stretch, (name, way, colour) in zip(stretches, _WAYS, strict=True):
        tool, underside = 1e3 * world.apply(stretch.tool), 1e3 * stretch.poses[:, :3]
        axes.plot(tool[:, 0], tool[:, 2], color=colour, linewidth=1.4, label=f"tool, {way}")
        axes.plot(
            underside[:, 0], underside[:, 2], ":", color=colour, linewidth=1.4, label=f"pourer's underside, {way}"
        )
        if name == "pour":
            shown += [tool[:, [0, 2]], underside[:, [0, 2]]]
    axes.axhline(table, color=style.INK, linewidth=1.0)
    places = np.concatenate(shown)
    (left, low), (right, high) = places.min(axis=0), places.max(axis=0)
    axes.set_xlim(left - 2 * _MARGIN, right + _MARGIN)
    axes.set_ylim(min(low, table) - 0.5 * _MARGIN, high + _MARGIN)
    axes.set_aspect("equal")
    style.dress(axes, title="the pour from the side", x=_AXES[0], y=_AXES[2], grid="both")


def _cell(axes: Axes, pour: SampledPath, spec: UrArmSpec, world: Transforms, seen: tuple[int, int]) -> None:
    """The box of the arm's limits, and the arm at the start of the pour and at its largest tilt."""
    corners = np.array(list(itertools.product(*zip(spec.limits.box_low, spec.limits.box_high, strict=True))))
    _outline(axes, world.apply(corners)[:, list(seen)], label="box of the laboratory's file")
    largest = int(np.argmax(pour.tilts))
    for index, colour, name in ((0, style.PALE, "arm, upright"), (largest, style.FALLING, "arm, largest tilt")):
        foot = np.zeros((1, 3))
        links = np.concatenate([foot, pour.links[index]])
        points = 1e3 * world.apply(links)[:, list(seen)]
        axes.plot(
            *points.T,
            color=colour,
            linewidth=6.0,
            solid_capstyle="round",
            solid_joinstyle="round",
            label=name,
            zorder=2,
        )
    axes.set_aspect("equal")


def _outline(axes: Axes, points: FloatArray, *, label: str) -> None:
    """The outline of a box's corners, seen along an axis."""
    from matplotlib.patches import Polygon
    from scipy.spatial import ConvexHull

    corners = 1e3 * points[ConvexHull(points).vertices]
    axes.add_patch(Polygon(corners, fill=False, edgecolor=style.BEST, linewidth=1.2, linestyle="--", label=label))
    axes.update_datalim(corners)


def _vessels_from_the_side(axes: Axes, pour: SampledPath, pourer: Vessel, receiver: Vessel) -> FloatArray:
    """Cross-sections of the receiver, and of the pourer upright, half-way and at its largest tilt; outlines [mm]."""
    outlines = [section(np.asarray(v.solid_vertices, float), np.asarray(v.solid_faces)) for v in (pourer, receiver)]
    stand = [1e3 * place(loop, _STAND) for loop in outlines[1]]
    fill_section(axes, stand, facecolor=style.RECEIVED, linewidth=0.0, label="receiver")
    largest = int(np.argmax(pour.tilts))
    half = int(np.argmax(pour.tilts >= 0.5 * pour.tilts[largest]))
    drawn = list(stand)
    for index, opacity in ((0, 0.35), (half, 0.35), (largest, 1.0)):
        placed = [1e3 * place(loop, pour.poses[index]) for loop in outlines[0]]
        name = f"pourer, up to {math.degrees(float(pour.tilts[largest])):.0f} deg" if index == largest else None
        fill_section(axes, placed, facecolor=style.POURER, alpha=opacity, linewidth=0.0, label=name)
        drawn += placed
    return np.concatenate(drawn)


def _from_above(axes: Axes, pour: SampledPath, pourer: Vessel, receiver: Vessel) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0.0, 0.0), 1e3 * receiver.outer_radius, facecolor=style.RECEIVED, alpha=0.8, zorder=3))
    start = 1e3 * pour.poses[0]
    axes.add_patch(Circle((start[0], start[1]), 1e3 * pourer.outer_radius, facecolor=style.POURER, alpha=0.6, zorder=3))


def _upright(axes: Axes, pour: SampledPath, pourer: Vessel, receiver: Vessel, across: int) -> None:
    """Both vessels as rectangles of their width and height, the pourer before it tilts."""
    from matplotlib.patches import Rectangle

    for vessel, pose, colour in ((receiver, _STAND, style.RECEIVED), (pourer, pour.poses[0], style.POURER)):
        wide, height = 1e3 * vessel.outer_radius, 1e3 * float(np.ptp(np.asarray(vessel.solid_vertices)[:, 2]))
        corner = (1e3 * pose[across] - wide, 1e3 * pose[2])
        axes.add_patch(Rectangle(corner, 2 * wide, height, facecolor=colour, alpha=0.6, zorder=3))
