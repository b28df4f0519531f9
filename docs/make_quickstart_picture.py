"""Compose docs/images/quickstart.png from a quickstart run: a pour, the error of calibration, the expected loss.

decant run configs/campaigns/quickstart.yaml
python docs/make_quickstart_picture.py runs/quickstart-…   # its recommended action is simulated with its θ
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import decant
from orchestrator.campaigns.file_loading import load_campaign, load_parameters
from orchestrator.records.run_record import read_result
from orchestrator.reports import figure_style as style
from orchestrator.reports.pour_figures import simulation_figure
from orchestrator.reports.run_figures import figures_of
from orchestrator.reports.stage_views import deployments_of
from orchestrator.runs.run_folder import RESOLVED

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHTS = 1600, (640, 480)
"""Width of the picture and heights of its two rows [pixels]."""

SHARE = 0.4
"""Share of the width that the error of calibration has."""

DPI, TEXT = 100, 13.0
"""Resolution, and the one size of all text [pt]."""


def main(run: Path) -> None:
    """Draw all parts in the same resolution, so that nothing is scaled."""
    plan, results = load_campaign(run / RESOLVED), read_result(run).results
    figures = figures_of(plan, results)
    (deployed,) = deployments_of(results).values()
    assert deployed.recommended is not None
    best = deployed.recommended.action_si
    action = {name: best[name] / style.display_factor(name) for name in ("angular_velocity", "x_offset")}
    action = {name: f"{value} {style.display_unit(name)}" for name, value in action.items()}
    found = decant.simulate(plan, action, theta=load_parameters(run / "theta.json", plan.parameters), seed=0)
    pour = drawn(simulation_figure(found.task, found.pours[0]), WIDTH, HEIGHTS[0])
    left = round(SHARE * WIDTH)
    figures["test discrepancy"].axes[0].set_ylabel("mean error of spillage [%]")  # its own label is too long here
    calibration = drawn(figures["test discrepancy"], left, HEIGHTS[1])
    (expected,) = (figure for name, figure in figures.items() if name.startswith("loss map"))
    canvas = Image.new("RGB", (WIDTH, sum(HEIGHTS)), "white")
    canvas.paste(pour, (0, 0))
    canvas.paste(calibration, (0, HEIGHTS[0]))
    canvas.paste(drawn(expected, WIDTH - left, HEIGHTS[1]), (left, HEIGHTS[0]))
    canvas.save(ROOT / "docs/images/quickstart.png", optimize=True)


def drawn(figure: Figure, width: int, height: int) -> Image.Image:
    """Draw a figure with all text in one size.

    Args:
        width, height: in pixels.
    """
    figure.set_size_inches(width / DPI, height / DPI)
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_fontsize(TEXT)
    for axes in figure.axes:
        axes.tick_params(labelsize=TEXT)
    file = io.BytesIO()
    figure.savefig(file, dpi=DPI, format="png")
    return Image.open(file).convert("RGB").resize((width, height))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]).resolve())
