"""Draws docs/images/rack-rows.png: which vessels of a rack a tool reaches from the side, on one height and on stairs.

python docs/make_rack_picture.py [OUTPUT]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

PITCH, WIDTH, HEIGHT = 120.0, 62.0, 83.0
"""Pitch of the rows, and the cup of `mixtures.yaml` [mm]."""

FREE, BLOCKED, TOOL = "#2f855a", "#c53030", "#4a5568"


def rows(axes: Axes, rise: float, reached: int, title: str) -> None:
    """Draw three rows from the side, and the tool at one of them."""
    for row, name in enumerate("ABC"):
        x, z = PITCH * row, rise * row
        axes.add_patch(Rectangle((x - 50.0, -20.0), 100.0, 20.0 + z, color="#e2e8f0"))
        usable = rise > 0.0 or row == 0
        axes.add_patch(
            Rectangle((x - WIDTH / 2, z), WIDTH, HEIGHT, fill=False, lw=2, color=FREE if usable else BLOCKED)
        )
        axes.text(x, z + 0.25 * HEIGHT, name, ha="center", va="center", fontsize=11)
    x, z = PITCH * reached, rise * reached + 0.72 * HEIGHT
    axes.add_patch(Rectangle((-190.0, z - 20.0), x + 190.0 - WIDTH / 2 - 25.0, 40.0, color=TOOL, alpha=0.35))
    axes.add_patch(Rectangle((x - WIDTH / 2 - 25.0, z - 8.0), 25.0 + WIDTH / 2, 16.0, color=TOOL, alpha=0.6))
    axes.text(-185.0, z + 26.0, "wrist and gripper", fontsize=9, color=TOOL)
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlim(-200.0, 310.0)
    axes.set_ylim(-25.0, 350.0)
    axes.set_aspect("equal")
    axes.axis("off")


def main(output: Path) -> None:
    """Draw both racks."""
    figure, (flat, stairs) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    rows(flat, 0.0, 1, "flat: to reach B, the tool would pass through A;\nrow A alone, or one row at a time")
    rows(stairs, 120.0, 1, "row_rise: 120 mm: the tool passes over the\nrows before")
    figure.savefig(output, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images" / "rack-rows.png")
