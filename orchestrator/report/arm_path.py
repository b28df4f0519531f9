"""The planned path of an arm as a picture: from the side and from above, with the box it has to stay in."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orchestrator.report import style
from orchestrator.report.section import fill_section, place, section

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from actors.arm.joint_path import PourPath
    from actors.arm.path.stretch import Stretch
    from actors.arm.spec import UrArmSpec
    from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

_STAND = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
_WAYS = (("approach", "way there and back", style.GREY), ("pour", "pour", style.POURER))


def path_png(
    file: Path, path: PourPath, spec: UrArmSpec, pourer: Vessel, receiver: Vessel, *, title: str, note: str = ""
) -> Path:
    """Draw a path.

    Args:
        file: PNG to write.
        path: as planned.
        spec: of the arm and its cell.
        pourer, receiver: geometry.
        title: first line.
        note: second line.

    Returns:
        `file`.
    """
    from actors.arm.path.frames import cell_frames
    from actors.arm.path.stretch import Stretch

    stretches = [Stretch.of(name, getattr(path, name), spec) for name, _, _ in _WAYS]
    world = cell_frames(spec).world.inverse
    box = world.apply(np.array(list(itertools.product(*zip(spec.limits.box_low, spec.limits.box_high, strict=True)))))
    base, table = world.apply(np.zeros((1, 3)))[0], world.apply(np.array([[0.0, 0.0, spec.cell.table]]))[0, 2]
    figure, (side, top) = style.new_figure(1, 2, size=(12.5, 6.2))
    figure.suptitle(f"{title}\n{note}".strip(), fontsize=10.5, color=style.INK, x=0.01, ha="left")
    for axes, across, name in ((side, 2, "z: up"), (top, 1, "y")):
        _outline(axes, box[:, [0, across]], label="box of the laboratory's file")
        for stretch, (_, way, colour) in zip(stretches, _WAYS, strict=True):
            tool = world.apply(stretch.tool)
            axes.plot(1e3 * tool[:, 0], 1e3 * tool[:, across], color=colour, linewidth=1.2, label=f"tool, {way}")
            place_ = stretch.poses
            axes.plot(
                *(1e3 * place_[:, 0], 1e3 * place_[:, across]),
                color=colour,
                linewidth=1.2,
                linestyle=":",
                label=f"pourer's underside, {way}",
            )
        axes.plot(
            1e3 * base[0], 1e3 * base[across], marker="s", color=style.INK, linestyle="none", label="robot's base"
        )
        axes.set_aspect("equal")
        style.dress(axes, x="x: where the liquid goes [mm]", y=f"{name} [mm]", grid="both")
    side.axhline(1e3 * table, color=style.INK, linewidth=1.0)
    side.set_title("from the side", fontsize=11, loc="left", color=style.INK)
    top.set_title("from above", fontsize=11, loc="left", color=style.INK)
    _vessels_from_the_side(side, stretches[1], pourer, receiver)
    _vessels_from_above(top, stretches[1], pourer, receiver)
    handles, labels = side.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8.5, frameon=False)
    return style.save(figure, file)


def _outline(axes: Axes, points: FloatArray, *, label: str) -> None:
    """The outline of a box's corners, seen along an axis."""
    from matplotlib.patches import Polygon
    from scipy.spatial import ConvexHull

    corners = 1e3 * points[ConvexHull(points).vertices]
    axes.add_patch(Polygon(corners, fill=False, edgecolor=style.BEST, linewidth=1.2, linestyle="--", label=label))


def _vessels_from_the_side(axes: Axes, pour: Stretch, pourer: Vessel, receiver: Vessel) -> None:
    """Cut open: the receiver, and the pourer upright, half-way and at its largest tilt."""
    outlines = [section(np.asarray(v.solid_vertices, float), np.asarray(v.solid_faces)) for v in (pourer, receiver)]
    fill_section(axes, [1e3 * place(loop, _STAND) for loop in outlines[1]], facecolor=style.RECEIVED, linewidth=0.0)
    largest = int(np.argmax(pour.tilts))
    half = int(np.argmax(pour.tilts >= 0.5 * pour.tilts[largest]))
    for index, opacity in ((0, 0.35), (half, 0.35), (largest, 1.0)):
        placed = [1e3 * place(loop, pour.poses[index]) for loop in outlines[0]]
        fill_section(axes, placed, facecolor=style.POURER, alpha=opacity, linewidth=0.0)
    tilt = math.degrees(float(pour.tilts[largest]))
    at = 1e3 * pour.poses[largest]
    axes.annotate(
        f"{tilt:.0f} deg", (at[0], at[2]), fontsize=9, color=style.INK, xytext=(6, 6), textcoords="offset points"
    )


def _vessels_from_above(axes: Axes, pour: Stretch, pourer: Vessel, receiver: Vessel) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0.0, 0.0), 1e3 * receiver.outer_radius, facecolor=style.RECEIVED, alpha=0.5))
    start = 1e3 * pour.poses[0]
    axes.add_patch(Circle((start[0], start[1]), 1e3 * pourer.outer_radius, facecolor=style.POURER, alpha=0.35))
