"""Draws docs/images/system.png: the parts of Decant, how they are connected, and which of them are processes.

python docs/make_system_diagram.py
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

IMAGE = Path(__file__).parent / "images" / "system.png"
INK, SOFT = "#1b1f24", "#57606a"
BLUE, GREEN, ORANGE, GREY = "#d6e8f5", "#d5eee3", "#fbe3cf", "#eef0f2"

BOXES: dict[str, tuple[float, float, float, float, str, str, str]] = {
    # name: left, bottom, width, height, colour, title, text
    "people": (0.0, 5.6, 3.4, 1.5, GREY, "You", "command line, notebook,\noperator's page"),
    "daemon": (4.8, 5.6, 3.4, 1.5, BLUE, "Daemon", "queue, questions,\nHTTP API"),
    "scheduler": (9.6, 5.6, 3.4, 1.5, BLUE, "Scheduler", "strategies decide,\nthe journal records"),
    "viewer": (14.4, 5.6, 3.4, 1.5, GREY, "Rerun viewer", "live view in a browser,\nrecordings"),
    "optimizer": (0.0, 2.9, 3.4, 1.5, GREEN, "Optimiser actor", "Gaussian processes"),
    "pool": (4.8, 2.9, 3.4, 1.5, GREEN, "Simulator pool", "Taichi particle solver,\none process per core"),
    "arm": (9.6, 2.9, 3.4, 1.5, GREEN, "Arm actor", "plans and checks paths,\nconsent, stops"),
    "balance": (14.4, 2.9, 3.4, 1.5, GREEN, "Balance actor", "settled weights"),
    "controller": (9.6, 0.2, 3.4, 1.5, ORANGE, "UR controller", "real or emulated: RTDE,\ndashboard, URScript"),
    "scale": (14.4, 0.2, 3.4, 1.5, ORANGE, "Laboratory balance", "real or emulated:\nKCP, MT-SICS, SBI"),
}

LEGEND = ((BLUE, "the orchestrator"), (GREEN, "actors (Ray), own processes"), (ORANGE, "devices"))

ARROWS = (
    ("people", "daemon", "campaign"),
    ("daemon", "scheduler", "start, stop"),
    ("scheduler", "viewer", "events"),
    ("scheduler", "arm", "pours"),
    ("scheduler", "pool", "simulations"),
    ("scheduler", "balance", "weighings"),
    ("scheduler", "optimizer", "suggestions"),
    ("arm", "controller", "TCP"),
    ("balance", "scale", "serial line"),
)


def main() -> None:
    """Draw the diagram."""
    figure, axes = plt.subplots(figsize=(12, 4.9), dpi=160)
    axes.set_xlim(-0.1, 17.9)
    axes.set_ylim(0.0, 7.3)
    axes.axis("off")
    for box in BOXES.values():
        draw_box(axes, *box)
    for begin, end, text in ARROWS:
        connect(axes, begin, end, text)
    for place, (colour, text) in enumerate(LEGEND):
        axes.add_patch(
            FancyBboxPatch((0.0, 1.35 - 0.5 * place), 0.45, 0.3, boxstyle="round,pad=0", fc=colour, ec=SOFT, lw=0.9)
        )
        axes.text(0.65, 1.5 - 0.5 * place, text, ha="left", va="center", fontsize=9, color=INK)
    figure.savefig(IMAGE, bbox_inches="tight", facecolor="white")
    print(IMAGE)


def draw_box(
    axes: Axes, left: float, bottom: float, width: float, height: float, colour: str, title: str, text: str
) -> None:
    """One part: its name and what it does."""
    axes.add_patch(
        FancyBboxPatch(
            (left, bottom), width, height, boxstyle="round,pad=0,rounding_size=0.15", fc=colour, ec=SOFT, lw=0.9
        )
    )
    axes.text(
        left + width / 2, bottom + height - 0.32, title, ha="center", va="center", fontsize=11, color=INK, weight="bold"
    )
    axes.text(left + width / 2, bottom + (height - 0.5) / 2, text, ha="center", va="center", fontsize=9, color=INK)


def connect(axes: Axes, begin: str, end: str, text: str) -> None:
    """An arrow between two parts, with what it carries."""
    (l0, b0, w0, h0), (l1, b1, w1, h1) = BOXES[begin][:4], BOXES[end][:4]
    if abs(b0 - b1) < 0.1:
        start, stop = (l0 + w0, b0 + h0 / 2), (l1, b1 + h1 / 2)
    else:
        start, stop = (l0 + w0 / 2, b0), (l1 + w1 / 2, b1 + h1)
    axes.add_patch(
        FancyArrowPatch(start, stop, arrowstyle="-|>", mutation_scale=11, color=SOFT, lw=1.1, shrinkA=2, shrinkB=2)
    )
    if text:
        x, y = (start[0] + stop[0]) / 2, (start[1] + stop[1]) / 2 + (0.25 if abs(b0 - b1) < 0.1 else 0.0)
        axes.text(
            x,
            y,
            text,
            fontsize=8.5,
            color=SOFT,
            ha="center",
            va="center",
            bbox={"fc": "white", "ec": "none", "pad": 1.0},
        )


if __name__ == "__main__":
    main()
