"""Compose docs/images/quickstart.png from quickstart runs with several seeds: a pour, all pours, the learnt loss.

for seed in 1 2 3: decant run configs/campaigns/quickstart.yaml --laboratory configs/laboratories/twin.yaml --seed …
python docs/make_quickstart_picture.py runs/quickstart-…   # one folder a seed; the first one's best pour is simulated
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from actors.runtime.child_process import child_environment
from orchestrator.journal.run_record import read_result
from orchestrator.results import figure_style as style
from orchestrator.results.stage_views import deployments_of
from orchestrator.strategies.deployment.deployment_result import Deployed

ROOT = Path(__file__).resolve().parent.parent
CAMPAIGN = ROOT / "configs" / "campaigns" / "quickstart.yaml"
WIDTH = 1600
LEAST = 0.05
"""What less than that is drawn at [%]: a gram or two hundred more or less decide whether it is nothing."""


def main(runs: list[Path]) -> None:
    """Simulate the first run's best action with its θ*, and put the figures below."""
    learnt = [learnt_in(run) for run in runs]
    with tempfile.TemporaryDirectory() as folder:
        pour, pours = Path(folder) / "pour.png", Path(folder) / "pours.png"
        draw_pours(pours, learnt)
        simulate(pour, runs[0], learnt[0])
        rows = [[pour], [pours, runs[0] / "figures" / "loss-map-narrow.png"]]
        strips = [_strip([Image.open(path).convert("RGB") for path in row]) for row in rows]
    canvas = Image.new("RGB", (WIDTH, sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        canvas.paste(strip, (0, top))
        top += strip.height
    canvas.save(ROOT / "docs/images/quickstart.png", optimize=True)


def learnt_in(run: Path) -> Deployed:
    """What a run's deployment learnt."""
    (deployed,) = deployments_of(read_result(run).results).values()
    return deployed


def simulate(path: Path, run: Path, learnt: Deployed) -> None:
    """The best action, as the run's θ* sees it."""
    assert learnt.recommended is not None
    best = learnt.recommended.action_si
    values = [f"--set={name}={best[name] / style.display_factor(name)}" for name in ("angular_velocity", "x_offset")]
    decant = str(Path(sys.executable).parent / "decant")
    theta = f"--parameters={run / 'theta.json'}"
    subprocess.run(
        [decant, "simulate", str(CAMPAIGN), *values, theta, f"--png={path}"], check=True, env=child_environment()
    )


def draw_pours(path: Path, runs: list[Deployed]) -> None:
    """Loss of every pour of every run, and the least so far: thin lines, and their median."""
    figure, axes = style.new_figure(size=(6.4, 4.6))
    losses = [[100 * pour.loss for pour in run.weighed if pour.loss is not None] for run in runs]
    for one in losses:
        numbers = range(1, len(one) + 1)
        axes.plot(numbers, np.maximum(one, LEAST), "o", color=style.MEASURED, alpha=0.75, clip_on=False, label="a pour")
        least = np.maximum(np.minimum.accumulate(one), LEAST)
        axes.step(numbers, least, where="post", color=style.BEST, linewidth=1.4, alpha=0.75, label="best so far")
    axes.set_yscale("log")
    ticks = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100]
    top = 1.2 * max(max(one) for one in losses)
    axes.set_ylim(LEAST, top)
    shown = [tick for tick in ticks if tick <= top]
    axes.set_yticks(shown, ["≤ 0.05", *(f"{tick:g}" for tick in shown[1:])])
    axes.minorticks_off()
    axes.set_xticks(range(1, 1 + max(map(len, losses))))
    title = f"Pours into a narrow cup until one is good enough, {len(runs)} seeds"
    style.dress(axes, title=title, x="pour", y="(spilled + retained) / loaded [%]", grid="both")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    style.save(figure, path)


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
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main([Path(argument).resolve() for argument in sys.argv[1:]])
