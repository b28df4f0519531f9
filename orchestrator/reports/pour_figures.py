"""Figures of pours, simulated and planned, and of vessels, as cross-sections in the plane y = 0.

- `draw_pour` and `simulation_figure`: snapshots of a pour from the side, and the shares of the liquid over time.
- `film_strip`: the snapshots alone.
- `section` and `place`: outlines of a mesh in its plane y = 0, and their transformation by a pose.
- `draw_solid`: a mesh of a vessel.
- `draw_path`: an arm's planned path: the pour from the side, and the arm in its cell.
"""

from __future__ import annotations

import math
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orchestrator.reports import figure_style as style
from sim_engine.outcome import ParticleState

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from actors.arm.arm_interface import ArmFigure
    from actors.arm.planned_pour import PourPath
    from sim_engine.outcome import SimulatedPour
    from sim_engine.scene import PourTask, Scene
    from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]


def section(vertices: Floats, faces: NDArray[np.integer[Any]]) -> list[Floats]:
    """Closed outlines of a watertight mesh in the plane y = 0.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3), consistently oriented.

    Returns:
        One (n, 2) array of (x, z) [m] for each loop, oriented as the faces are, so that holes have the opposite
        orientation.

    Raises:
        ValueError: the mesh is open at the cut.
    """
    above = vertices[:, 1] >= 0.0
    count = above[faces].sum(axis=1)
    # an edge at which two bodies touch is passed once for each of them
    follows: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for face in faces[(count > 0) & (count < 3)]:
        enter = leave = None
        for i in range(3):
            a, b = int(face[i]), int(face[(i + 1) % 3])
            if above[a] != above[b]:
                edge = (min(a, b), max(a, b))
                if above[b]:
                    enter = edge
                else:
                    leave = edge
        assert enter is not None
        assert leave is not None
        follows[enter].append(leave)
    loops = []
    while follows:
        start, after = follows.popitem()
        edge = after.pop()
        if after:
            follows[start] = after
        loop = [start]
        while edge != start:
            loop.append(edge)
            if edge not in follows:
                raise ValueError("the mesh is open: its section by the plane y = 0 has a loose end")
            after = follows.pop(edge)
            following = after.pop()
            if after:
                follows[edge] = after
            edge = following
        ends = np.array(loop)
        a, b = vertices[ends[:, 0]], vertices[ends[:, 1]]
        t = (a[:, 1] / (a[:, 1] - b[:, 1]))[:, None]
        loops.append((a + t * (b - a))[:, [0, 2]])
    return loops


def place(points: Floats, pose: Floats) -> Floats:
    """Points of a body's plane y = 0 in the world's x–z plane.

    Args:
        points: (n, 2) as (x, z) in the body's frame [m].
        pose: x y z qw qx qy qz of the body; its rotation must be about y.

    Returns:
        (n, 2) as (x, z) [m].
    """
    tilt = 2.0 * np.arctan2(pose[5], pose[3])
    c, s = np.cos(tilt), np.sin(tilt)
    # A positive rotation about +y tips z towards +x.
    x = c * points[:, 0] + s * points[:, 1] + pose[0]
    z = -s * points[:, 0] + c * points[:, 1] + pose[2]
    return np.column_stack([x, z])


def fill_section(axes: Axes, loops: list[Floats], **look: Any) -> None:
    """Draw outlines as one filled shape with holes."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    axes.add_patch(PathPatch(Outline.make_compound_path(*(Outline(loop, closed=False) for loop in loops)), **look))


IN_POURER, _FALLING, _RECEIVED, SPILLED, _ESCAPED = (int(state) for state in ParticleState)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def simulation_figure(task: PourTask, result: SimulatedPour) -> Figure:
    """Figure of one simulated pour.

    Args:
        task: the simulated task, with `frame_rate` > 0.
        result: its result.

    Raises:
        ValueError: the result has no frames.
    """
    from sim_engine.vessel.vessel import build_vessel

    scene = task.scene
    names = ("angular_velocity", "max_angle", "x_offset", "height")
    action = style.display_values({name: getattr(task.action, name) for name in names})
    outcome = result.outcome
    title = (
        f"{scene.pourer.name} into {scene.receiver.name}: {100 * outcome.received:.1f} % received, "
        f"{100 * outcome.spilled:.1f} % spilled, {100 * outcome.retained:.1f} % retained"
    )
    if outcome.invalid is not None:
        title += f"   [not valid: {outcome.invalid}]"
    note = f"{action}; {style.display_value('particles', outcome.particles)} particles, seed {outcome.seed}"
    return draw_pour(
        result,
        build_vessel(scene.pourer),
        build_vessel(scene.receiver),
        title=title,
        note=note,
    )


def draw_pour(
    result: SimulatedPour,
    pourer: Vessel,
    receiver: Vessel,
    *,
    title: str,
    note: str = "",
    snapshots: int = 4,
) -> Figure:
    """Snapshots of a pour from the side (vessels cut at y = 0), above the shares of the liquid over time.

    Args:
        result: a simulated pour with frames.
        pourer: its surface.
        receiver: its surface.
        title: first line.
        note: second line.
        snapshots: number of snapshots.

    Raises:
        ValueError: the result has no frames.
    """
    shown = _Snapshots(result, pourer, receiver, snapshots)
    figure, grid = style.new_figure(
        2,
        snapshots,
        size=(3.1 * snapshots, 3.0 * shown.aspect + 2.6),
        height_ratios=[3.0 * shown.aspect, 1.5],
        squeeze=False,
    )
    figure.suptitle(title, fontsize=12.5, color=style.INK, x=0.01, ha="left")
    shown.draw(grid[0])
    for axes in grid[1, 1:]:
        axes.remove()
    timeline = grid[1, 0]
    timeline.set_subplotspec(timeline.get_gridspec()[1, :])
    _timeline(timeline, shown.times, shown.shares, shown.times[shown.chosen])
    if note:
        figure.supxlabel(note, fontsize=8.5, color=style.GREY, x=0.01, ha="left")
    return figure


STRIP = 6
"""Number of snapshots of a film strip."""


def film_strip(scene: Scene, result: SimulatedPour, *, title: str) -> Figure:
    """Snapshots of a simulated pour from the side, in one row.

    Args:
        scene: its vessels.
        result: its result, with frames.
        title: above them.

    Raises:
        ValueError: the result has no frames.
    """
    from sim_engine.vessel.vessel import build_vessel

    shown = _Snapshots(result, build_vessel(scene.pourer), build_vessel(scene.receiver), STRIP)
    figure, grid = style.new_figure(1, STRIP, size=(2.0 * STRIP, 2.0 * shown.aspect + 0.6), squeeze=False)
    figure.suptitle(title, fontsize=12.5, color=style.INK, x=0.01, ha="left")
    shown.draw(grid[0])
    return figure


class _Snapshots:
    """Moments of a simulated pour, and the part of the plane y = 0 that shows both vessels in all of them."""

    def __init__(self, result: SimulatedPour, pourer: Vessel, receiver: Vessel, count: int) -> None:
        frames = result.frames
        if frames is None or len(frames.times) == 0:
            raise ValueError("this simulation kept no frames to draw; simulate it with a record rate above 0")
        self._frames, self._spacing = frames, result.outcome.spacing
        self.times = np.asarray(frames.times, dtype=float)
        self.shares = _shares(frames.states)
        self.chosen = _moments(self.times, self.shares, count)
        self._outlines = [
            section(np.asarray(v.solid_vertices, float), np.asarray(v.solid_faces)) for v in (pourer, receiver)
        ]
        self._stand = UPRIGHT + np.array([*frames.receiver_at, 0, 0, 0, 0])
        self._window = _window(self._outlines, np.asarray(frames.pourer_poses, float)[self.chosen], self._stand)
        left, right, low, high = self._window
        self.aspect = min(max((high - low) / (right - left), 0.7), 1.9)

    def draw(self, row: Sequence[Axes]) -> None:
        for axes, index in zip(row, self.chosen, strict=True):
            _snapshot(
                axes,
                np.asarray(self._frames.positions[index], float),
                np.asarray(self._frames.states[index]),
                [
                    [place(loop, np.asarray(self._frames.pourer_poses[index], float)) for loop in self._outlines[0]],
                    [place(loop, self._stand) for loop in self._outlines[1]],
                ],
                self._window,
                self._spacing,
            )
            axes.set_title(f"{self.times[index]:.2f} s", fontsize=10.5, loc="left", color=style.INK)
        _scale_bar(row[0], self._window)


def _shares(states: Any) -> Floats:
    """(F, 5) fraction of the particles in every state."""
    return np.array([np.bincount(np.asarray(s, dtype=int), minlength=5)[:5] / len(s) for s in states])


def _moments(times: Floats, shares: Floats, count: int) -> NDArray[np.intp]:
    """Frames for the snapshots.

    They are the frames at which shares 1/8 … 7/8 of the leaving liquid have left, and the end. If no liquid leaves,
    they are spread evenly.
    """
    left = 1.0 - shares[:, IN_POURER]
    if left[-1] < 0.01:
        return np.linspace(0, len(times) - 1, count).round().astype(int)
    wanted = np.linspace(0.0, 1.0, 2 * count - 1)[1::2][: count - 1] * left.max()
    picked = [int(np.argmax(left >= level)) for level in wanted]
    return np.array([*picked, len(times) - 1])


def _window(outlines: list[list[Floats]], poses: Floats, stand: Floats) -> tuple[float, float, float, float]:
    """Range of x and z that shows both vessels in all snapshots and some table on both sides."""
    corners = [place(loop, pose) for pose in poses for loop in outlines[0]]
    corners += [place(loop, stand) for loop in outlines[1]]
    everything = np.concatenate(corners)
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.12 * float(max(high - low))
    return low[0] - margin, high[0] + 2 * margin, min(low[1], 0.0) - 0.4 * margin, high[1] + 0.5 * margin


def _snapshot(
    axes: Axes,
    positions: Floats,
    states: NDArray[Any],
    vessels: list[list[Floats]],
    window: tuple[float, float, float, float],
    spacing: float,
) -> None:
    from matplotlib.collections import EllipseCollection

    axes.set_xlim(window[0], window[1])
    axes.set_ylim(window[2], window[3])
    axes.set_aspect("equal")
    axes.axis("off")
    axes.axhline(0.0, color=style.GREY, linewidth=1.0, zorder=0)
    # Distant particles are drawn first, so that near particles cover them, as seen from −y.
    order = np.argsort(-positions[:, 1])
    palette = np.array([colour for _, colour in style.PARTICLE_STATES])
    axes.add_collection(
        EllipseCollection(
            widths=[spacing],
            heights=[spacing],
            angles=[0.0],
            units="xy",
            offsets=positions[order][:, [0, 2]],
            offset_transform=axes.transData,
            facecolors=palette[np.minimum(states[order], 4)].tolist(),
            edgecolors=(1.0, 1.0, 1.0, 0.35),
            linewidths=0.2,
            zorder=1,
            rasterized=True,  # as lines, thousands of particles make a page slow
        )
    )
    for loops in vessels:
        fill_section(axes, loops, facecolor=style.INK, edgecolor=style.INK, linewidth=0.4, zorder=2)


def _scale_bar(axes: Axes, window: tuple[float, float, float, float]) -> None:
    length = 0.05
    right = window[1] - 0.04 * (window[1] - window[0])
    top = window[3] - 0.05 * (window[3] - window[2])
    axes.plot([right - length, right], [top, top], color=style.INK, linewidth=2.0, solid_capstyle="butt")
    axes.text(right - length / 2, top, "50 mm", ha="center", va="bottom", fontsize=8, color=style.INK)


def _timeline(axes: Axes, times: Floats, shares: Floats, marks: Floats) -> None:
    shown = [i for i in (2, SPILLED, 1, IN_POURER, 4) if i != 4 or shares[:, 4].max() > 0]
    axes.stackplot(
        times,
        *(100 * shares[:, i] for i in shown),
        colors=[style.PARTICLE_STATES[i][1] for i in shown],
        labels=[style.PARTICLE_STATES[i][0] for i in shown],
        linewidth=0,
        alpha=0.9,
    )
    for mark in marks:
        axes.axvline(mark, color="white", linewidth=1.6)
        axes.axvline(mark, color=style.INK, linewidth=0.7, linestyle=(0, (4, 2)))
    style.dress(axes, x="time [s]", y="liquid [%]", grid=None)
    axes.set_xlim(times[0], max(times[-1], times[0] + 1e-6))
    axes.set_ylim(0, 100)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8.5, frameon=False, reverse=True)


def draw_solid(name: str, vessel: Vessel) -> Figure:
    """The cross-section of a mesh through its middle."""
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
    return figure


# ---- planned paths

_WAYS = (("approach", "way there and back", style.GREY), ("pour", "pour", style.POURER))
_AXES = ("x: where the liquid goes [mm]", "y [mm]", "z: up [mm]")
_LINE = 175
"""Characters per line above the figure."""
_MARGIN = 40.0
"""Margin around the close-up of the pour [mm]."""


def draw_path(
    path: PourPath,
    arm: ArmFigure,
    box: Floats | None,
    pourer: Vessel,
    receiver: Vessel,
    *,
    title: str,
    note: str = "",
) -> Figure:
    """Figure of an arm's path.

    Args:
        path: the planned path.
        arm: its figure.
        box: corners (8, 3) of the box of its limits in the world [m]; None without one.
        pourer, receiver: geometry.
        title: first line.
        note: text below the title.
    """
    ways = [getattr(path, name).joints for name, _, _ in _WAYS]
    base, table = 1e3 * arm.ends(path.pour.joints[0])[0, 0], 1e3 * arm.table
    poses = arm.pourer(path.pour.joints)
    largest = int(np.argmax(path.tilts))
    half = int(np.argmax(path.tilts >= 0.5 * path.tilts[largest]))
    # Seen along the direction to the robot, the base would be hidden below the receiver, so the arm is drawn from the
    # side.
    across = 0 if abs(base[0]) > abs(base[1]) else 1
    figure, (near, top, front) = style.new_figure(1, 3, size=(15.0, 6.0), width_ratios=(1.0, 1.0, 1.0))
    lines = [title, *textwrap.wrap(note, _LINE)]
    figure.suptitle("\n".join(lines), fontsize=10.5, color=style.INK, x=0.01, ha="left")
    angle = f"up to {math.degrees(float(path.tilts[largest])):.0f} deg"
    cups = _vessels_from_the_side(near, poses[[0, half, largest]], angle, pourer, receiver)
    _near(near, ways, arm, table, cups)
    for axes, horizontal, vertical, name in (
        (top, 0, 1, "the cell from above"),
        (front, across, 2, "the cell from the side" if across == 0 else "the cell across the pour"),
    ):
        seen = [horizontal, vertical]
        if box is not None:
            _outline(axes, box[:, seen], label="box of the laboratory's file")
        _arm(axes, arm.ends(path.pour.joints[[0, largest]]), seen)
        style.dress(axes, title=name, x=_AXES[horizontal], y=_AXES[vertical], grid="both")
        axes.plot(base[horizontal], base[vertical], "s", color=style.INK, markersize=9, label="robot's base", zorder=5)
    _from_above(top, poses[0], pourer, receiver)
    _upright(front, poses[0], pourer, receiver, across)
    front.axhline(table, color=style.INK, linewidth=1.0)
    handles = {n: h for axes in (near, top) for h, n in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    return figure


def _near(axes: Axes, ways: list[Floats], arm: ArmFigure, table: float, cups: Floats) -> None:
    """The pour: cross-sections of both vessels (`cups`), and the paths of tool and pourer near them."""
    shown = [cups]
    for joints, (name, way, colour) in zip(ways, _WAYS, strict=True):
        tool, underside = 1e3 * arm.tool(joints)[:, :3], 1e3 * arm.pourer(joints)[:, :3]
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


def _arm(axes: Axes, ends: Floats, seen: list[int]) -> None:
    """The arm at the start of the pour and at its largest tilt, from its bars' ends (2, bars, 2, 3) [m]."""
    for bars, colour, name in zip(
        ends, (style.PALE, style.FALLING), ("arm, upright", "arm, largest tilt"), strict=True
    ):
        links = np.concatenate([bars[:, 0], bars[-1:, 1]])
        axes.plot(
            *(1e3 * links[:, seen]).T,
            color=colour,
            linewidth=6.0,
            solid_capstyle="round",
            solid_joinstyle="round",
            label=name,
            zorder=2,
        )
    axes.set_aspect("equal")


def _outline(axes: Axes, points: Floats, *, label: str) -> None:
    """The outline of a box's corners, seen along an axis."""
    from matplotlib.patches import Polygon
    from scipy.spatial import ConvexHull

    corners = 1e3 * points[ConvexHull(points).vertices]
    axes.add_patch(Polygon(corners, fill=False, edgecolor=style.BEST, linewidth=1.2, linestyle="--", label=label))
    axes.update_datalim(corners)


def _vessels_from_the_side(axes: Axes, poses: Floats, angle: str, pourer: Vessel, receiver: Vessel) -> Floats:
    """Cross-sections of the receiver, and of the pourer at poses (3, 7), the last of them named; outlines [mm]."""
    outlines = [section(np.asarray(v.solid_vertices, float), np.asarray(v.solid_faces)) for v in (pourer, receiver)]
    stand = [1e3 * place(loop, UPRIGHT) for loop in outlines[1]]
    fill_section(axes, stand, facecolor=style.RECEIVED, linewidth=0.0, label="receiver")
    cups = list(stand)
    for pose, opacity, name in zip(poses, (0.35, 0.35, 1.0), (None, None, f"pourer, {angle}"), strict=True):
        placed = [1e3 * place(loop, pose) for loop in outlines[0]]
        fill_section(axes, placed, facecolor=style.POURER, alpha=opacity, linewidth=0.0, label=name)
        cups += placed
    return np.concatenate(cups)


def _from_above(axes: Axes, pose: Floats, pourer: Vessel, receiver: Vessel) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0.0, 0.0), 1e3 * receiver.outer_radius, facecolor=style.RECEIVED, alpha=0.8, zorder=3))
    start = 1e3 * pose
    axes.add_patch(Circle((start[0], start[1]), 1e3 * pourer.outer_radius, facecolor=style.POURER, alpha=0.6, zorder=3))


def _upright(axes: Axes, start: Floats, pourer: Vessel, receiver: Vessel, across: int) -> None:
    """Both vessels as rectangles of their width and height, the pourer before it tilts."""
    from matplotlib.patches import Rectangle

    for vessel, pose, colour in ((receiver, UPRIGHT, style.RECEIVED), (pourer, start, style.POURER)):
        wide, height = 1e3 * vessel.outer_radius, 1e3 * float(np.ptp(np.asarray(vessel.solid_vertices)[:, 2]))
        corner = (1e3 * pose[across] - wide, 1e3 * pose[2])
        axes.add_patch(Rectangle(corner, 2 * wide, height, facecolor=colour, alpha=0.6, zorder=3))
