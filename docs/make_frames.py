"""Draws docs/images/frames.png: frames, signs and names of a pour, from the definitions that the code uses.

Run from the project's root: python docs/make_frames.py
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from orchestrator.reports import figure_style as style
from orchestrator.reports.pour_figures import fill_section, place, section
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

MM = 1e-3
TILT = 55 * DEG
WHITE: dict[str, Any] = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.9}


def main(path: Path) -> None:
    """Write the picture."""
    scene = Scene(
        "frames",
        cylinder("beaker", inner_radius=36 * MM, inner_height=95 * MM),
        cylinder("tumbler", inner_radius=42 * MM, inner_height=80 * MM),
        Liquid(mass=0.2),
    )
    action = Action(angular_velocity=40 * DEG, x_offset=110 * MM, height=45 * MM, max_angle=TILT, hold_time=1.0)
    pourer, receiver = build_vessel(scene.pourer), build_vessel(scene.receiver)
    motion = plan_motion(scene, action, pourer, receiver)
    upright, tilted = motion.sample(np.array([0.0, motion.phases[0].end]))
    outline = section(pourer.solid_vertices, pourer.solid_faces)
    stand = section(receiver.solid_vertices, receiver.solid_faces)
    lip = np.array(motion.pivot_world)[[0, 2]]

    figure, (left, right) = style.new_figure(1, 2, size=(12.4, 5.4))
    for axes, title in (
        (left, "Where the pourer starts: x_offset and height"),
        (right, "How it moves: a positive tilt turns it about +y, through the lip"),
    ):
        axes.set_title(title, fontsize=12, loc="left", color=style.INK)
        axes.set_aspect("equal")
        axes.axis("off")
        axes.set_xlim(-0.205, 0.115)
        axes.set_ylim(-0.03, 0.285)
        axes.axhline(0.0, color=style.GREY, linewidth=1.4, zorder=0)
        fill_section(axes, stand, facecolor="#555555", edgecolor="#555555")

    # Left: the start.
    fill_section(left, [place(loop, upright) for loop in outline], facecolor="#555555", edgecolor="#555555")
    top = 0.258
    for x in (upright[0], 0.0):
        left.plot([x, x], [-0.012, top + 0.008], color=style.GREY, linewidth=0.9, linestyle=(0, (8, 3, 2, 3)))
    _dimension(left, (upright[0], top), (0.0, top), "x_offset", above=True)
    left.plot([lip[0], 0.07], [lip[1], lip[1]], color=style.GREY, linewidth=0.8, linestyle=":")
    left.plot([0.05, 0.07], [receiver.rim_height] * 2, color=style.GREY, linewidth=0.8, linestyle=":")
    _dimension(left, (0.062, receiver.rim_height), (0.062, lip[1]), "height", above=False)
    _frame(left, (0.0, 0.0), 0.0, "world frame", (0.0, 0.0), below=True)
    _frame(left, (upright[0], upright[2]), 0.0, "vessel frame", (0.0, 0.0), below=True)
    _lip(left, lip, "lip = pivot", (-4, 9), "right")
    left.text(-0.2, 0.004, "table, z = 0", fontsize=9, color=style.GREY, va="bottom")
    left.text(0.0, 0.064, "receiver", fontsize=10, color=style.INK, ha="center", bbox=WHITE)
    left.text(upright[0], upright[2] + 0.066, "pourer", fontsize=10, color=style.INK, ha="center", bbox=WHITE)

    # Right: the tilt.
    ghost = [place(loop, upright) for loop in outline]
    fill_section(right, ghost, facecolor="none", edgecolor=style.GREY, linewidth=1.0, linestyle="--")
    fill_section(right, [place(loop, tilted) for loop in outline], facecolor="#555555", edgecolor="#555555")
    _frame(right, (tilted[0], tilted[2]), TILT, "", (0.0, 0.0), below=True)
    _lip(right, lip, "lip: does not move", (8, -14), "left")
    radius = 0.08
    axis_end = lip + 0.105 * np.array([math.sin(TILT), math.cos(TILT)])
    right.plot([lip[0]] * 2, [lip[1], lip[1] + 0.105], color=style.GREY, linewidth=0.9, linestyle=(0, (8, 3, 2, 3)))
    right.plot(
        [lip[0], axis_end[0]], [lip[1], axis_end[1]], color=style.GREY, linewidth=0.9, linestyle=(0, (8, 3, 2, 3))
    )
    angles = np.linspace(0.0, TILT - 0.05, 40)
    right.plot(lip[0] + radius * np.sin(angles), lip[1] + radius * np.cos(angles), color=style.BEST, linewidth=2.2)
    _arrow(
        right,
        lip + radius * np.array([math.sin(TILT - 0.12), math.cos(TILT - 0.12)]),
        lip + radius * np.array([math.sin(TILT), math.cos(TILT)]),
        style.BEST,
    )
    middle = lip + 1.12 * radius * np.array([math.sin(TILT / 2), math.cos(TILT / 2)])
    right.text(*middle, "tilt > 0", fontsize=11, color=style.BEST, fontweight="bold", ha="left")
    _frame(right, (0.0, 0.0), 0.0, "", (0.0, 0.0), below=True)
    right.text(-0.2, 0.004, "table, z = 0", fontsize=9, color=style.GREY, va="bottom")
    _into_paper(right, (-0.18, 0.255))
    style.save(figure, path)


def _arrow(axes: Any, start: Any, end: Any, colour: str) -> None:
    axes.annotate(
        "",
        xy=tuple(end),
        xytext=tuple(start),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.0, "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0},
        zorder=6,
    )


def _frame(
    axes: Any, origin: tuple[float, float], tilt: float, name: str, shift: tuple[float, float], *, below: bool
) -> None:
    """x (red-orange) and z (blue) of a frame that is turned by `tilt` about y."""
    length = 0.042
    o = np.array(origin)
    for direction, colour, text in (
        (np.array([math.cos(tilt), -math.sin(tilt)]), style.BEST, "x"),
        (np.array([math.sin(tilt), math.cos(tilt)]), style.MEASURED, "z"),
    ):
        _arrow(axes, o, o + length * direction, colour)
        axes.text(
            *(o + 1.17 * length * direction),
            text,
            color=colour,
            fontsize=11,
            fontweight="bold",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle,pad=0.08", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
            zorder=7,
        )
    axes.plot(*o, "o", color=style.INK, markersize=5, zorder=7)
    if name:
        axes.text(
            o[0] + shift[0],
            o[1] - 0.012,
            name,
            fontsize=10,
            color=style.INK,
            ha="center",
            va="top" if below else "bottom",
            fontweight="bold",
            bbox=WHITE,
        )


def _lip(axes: Any, lip: Any, text: str, shift: tuple[float, float], align: str) -> None:
    axes.plot(
        *lip, "o", markersize=9, markerfacecolor="white", markeredgecolor=style.GOOD, markeredgewidth=2.4, zorder=8
    )
    axes.annotate(
        text,
        tuple(lip),
        xytext=shift,
        textcoords="offset points",
        ha=align,
        fontsize=10.5,
        color=style.GOOD,
        fontweight="bold",
        zorder=8,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )


def _dimension(axes: Any, start: tuple[float, float], end: tuple[float, float], text: str, *, above: bool) -> None:
    axes.annotate(
        "",
        xy=end,
        xytext=start,
        arrowprops={
            "arrowstyle": "<|-|>",
            "color": style.INK,
            "lw": 1.2,
            "mutation_scale": 11,
            "shrinkA": 0,
            "shrinkB": 0,
        },
    )
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    if above:
        axes.text(x, y + 0.004, text, ha="center", va="bottom", fontsize=11, color=style.INK, family="monospace")
    else:
        axes.text(x + 0.005, y, text, ha="left", va="center", fontsize=11, color=style.INK, family="monospace")


def _into_paper(axes: Any, at: tuple[float, float]) -> None:
    """y points into the paper: seen from −y, x to the right and z up."""
    axes.plot(*at, "o", markersize=13, markerfacecolor="white", markeredgecolor=style.GOOD, markeredgewidth=1.8)
    axes.plot(*at, "x", markersize=7, color=style.GOOD, markeredgewidth=1.8)
    axes.text(at[0] + 0.009, at[1], "y, into the paper", va="center", fontsize=10, color=style.GOOD)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images" / "frames.png")
