"""Compose docs/images/quickstart.png from a quickstart run: its best pour, spillage against pours, the learnt loss.

decant run configs/campaigns/quickstart.yaml
python docs/make_quickstart_picture.py runs/quickstart-…
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
WIDTH = 1600


def main(run: Path) -> None:
    """Simulate the run's best action with its θ*, and put the figures below."""
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    (receiver,) = summary["receivers"].values()
    action = receiver["best_action"]
    with tempfile.TemporaryDirectory() as folder:
        pour = Path(folder) / "pour.png"
        subprocess.run(
            [
                str(Path(sys.executable).parent / "decant"),
                "simulate",
                str(ROOT / "configs/campaigns/quickstart.yaml"),
                f"--set=angular_velocity={action['angular_velocity_deg_s']}",
                f"--set=x_offset={action['x_offset_mm']}",
                f"--parameters={run / 'theta.json'}",
                f"--png={pour}",
            ],
            check=True,
        )
        rows = [[pour], [run / "figures" / "spillage.png", run / "figures" / "loss-map-narrow.png"]]
        strips = [_strip([Image.open(path).convert("RGB") for path in row]) for row in rows]
    canvas = Image.new("RGB", (WIDTH, sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height
    canvas.save(ROOT / "docs/images/quickstart.png", optimize=True)


def _strip(pictures: list[Image.Image]) -> Image.Image:
    """Pictures side by side at one height, `WIDTH` wide."""
    height = round(WIDTH / sum(p.width / p.height for p in pictures))
    strip = Image.new("RGB", (WIDTH, height), "white")
    left = 0
    for picture in pictures:
        scaled = picture.resize((round(picture.width * height / picture.height), height), Image.Resampling.LANCZOS)
        strip.paste(scaled, (left, 0))
        left += scaled.width
    return strip


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
