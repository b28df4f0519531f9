"""Draws the gallery: docs/images/gallery-vessels.png and one docs/images/gallery-pour-….png for each pour below.

Run from the project's root: python docs/make_gallery.py (some ten CPU seconds)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import decant
from orchestrator.campaigns.file_loading import load_vessel
from orchestrator.reports import figure_style as style
from orchestrator.reports.pour_figures import fill_section, section, simulation_figure
from sim_engine.vessel.vessel import build_vessel

ROOT = Path(__file__).resolve().parent.parent
IMAGES, VESSELS = ROOT / "docs" / "images", ROOT / "configs" / "vessels"

POURS: dict[str, tuple[str, dict[str, str | float]]] = {
    "short": ("narrow", {"angular_velocity": "62 deg/s", "x_offset": "128 mm"}),
}
"""Name of the picture → receiver, action."""

SEED = 0
PICTURE_DPI = 110


def main() -> None:
    """Write all pictures."""
    style.DPI = PICTURE_DPI
    draw_vessels(IMAGES / "gallery-vessels.png")
    campaign = decant.load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    for name, (receiver, action) in POURS.items():
        found = decant.simulate(campaign, action, receiver=VESSELS / f"{receiver}.yaml", seed=SEED)
        style.save(simulation_figure(found.task, found.pours[0]), IMAGES / f"gallery-pour-{name}.png")
        outcome = found.pours[0].outcome
        print(f"{name}: {100 * outcome.spilled:.1f} % spilled, {100 * outcome.retained:.1f} % retained")


def draw_vessels(path: Path) -> None:
    """All shipped vessels cut open, to one scale, with what they hold to the brim."""
    specs = [load_vessel(file) for file in sorted(VESSELS.glob("*.yaml"))]
    figure, axes = style.new_figure(1, 1, size=(11.0, 3.4))
    left = 0.0
    for spec in specs:
        vessel = build_vessel(spec)
        cut = section(np.asarray(vessel.solid_vertices, float), np.asarray(vessel.solid_faces))
        loops = [1e3 * loop for loop in cut]
        low, high = min(loop[:, 0].min() for loop in loops), max(loop[:, 0].max() for loop in loops)
        shift = left - low
        fill_section(axes, [loop + np.array([shift, 0.0]) for loop in loops], facecolor=style.POURER, linewidth=0.0)
        middle = shift + (low + high) / 2
        brim = 1e6 * vessel.capacity
        axes.text(middle, -14.0, f"{spec.name}\n{brim:.0f} mL", ha="center", va="top", fontsize=10, color=style.INK)
        left = shift + high + 28.0
    axes.set_xlim(-10.0, left - 18.0)
    axes.set_ylim(-42.0, 155.0)
    axes.set_aspect("equal")
    style.dress(axes, y="height [mm]", grid="y")
    axes.set_xticks([])
    axes.set_yticks(range(0, 151, 25))
    axes.spines["left"].set_bounds(0.0, 150.0)
    axes.spines["bottom"].set_visible(False)
    style.save(figure, path)


if __name__ == "__main__":
    main()
