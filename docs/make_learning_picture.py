"""Draw docs/images/learning-curves.png from docs/data/learning-curves.json: loss against pours, D1 to D3 and others.

python docs/make_learning_picture.py   # the data: benchmarks/learning_curves.py
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from orchestrator.reports import figure_style as style

DOCS = Path(__file__).resolve().parent
SHOWN = {
    "random": style.PALE,
    "BoTorch qNEI": style.GREY,
    "D1": style.PREDICTED,
    "D2": style.MEASURED,
    "D3": style.GOOD,
}
RESAMPLES = 2000


def main() -> None:
    """Mean loss of each pour over the benches, with 95 % bootstrap intervals."""
    runs = json.loads((DOCS / "data" / "learning-curves.json").read_text(encoding="utf-8"))["runs"]
    figure, axes = style.new_figure(size=(7.0, 3.6))
    rng = np.random.default_rng(0)
    benches = sorted(set.intersection(*(set(runs[name]) for name in SHOWN if name in runs)))
    for name, colour in SHOWN.items():
        if name not in runs:
            continue
        losses = np.array([runs[name][bench] for bench in benches])
        pours = np.arange(1, losses.shape[1] + 1)
        means = losses[rng.integers(0, len(losses), (RESAMPLES, len(losses)))].mean(axis=1)
        low, high = np.percentile(means, (2.5, 97.5), axis=0)
        axes.fill_between(pours, low, high, color=colour, alpha=0.2, linewidth=0.0)
        axes.plot(pours, losses.mean(axis=0), color=colour, label=name)
    axes.set_ylim(0.0, 1.0)
    axes.legend(frameon=False, ncols=len(SHOWN), loc="upper center", bbox_to_anchor=(0.5, -0.18))
    style.dress(axes, title=f"Loss against pours, {len(benches)} benches", x="pour", y="mean loss of the pour")
    style.save(figure, DOCS / "images" / "learning-curves.png")


if __name__ == "__main__":
    main()
