"""Draws docs/images/recorded-predictions.png: predicted against recorded spillage with 90 % intervals.

Run from the project's root: python docs/make_prediction_picture.py
Its data are those of benchmarks/recorded_predictions.py --write, docs/data/recorded-predictions.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from orchestrator.reports import figure_style as style

DOCS = Path(__file__).parent
DATA, PICTURE = DOCS / "data" / "recorded-predictions.json", DOCS / "images" / "recorded-predictions.png"
TITLES = {"test": "same receiver", "transfer": "another receiver"}


def main() -> None:
    """Draw the picture from the data file."""
    found = json.loads(DATA.read_text(encoding="utf-8"))
    seeds: dict[str, list[dict[str, Any]]] = found["seeds"]
    figure, axes = style.new_figure(1, 2, size=(9.0, 4.6))
    for one, (split, title) in zip(axes, TITLES.items(), strict=True):
        pours = [pour for rows in seeds.values() for pour in rows if pour["split"] == split]
        top = 105 * max(max(pour["high"], pour["recorded"]) for pour in pours)
        one.plot([0, top], [0, top], color=style.INK, linewidth=0.8)
        for pour in pours:
            x, y = 100 * pour["recorded"], 100 * pour["predicted"]
            held = pour["low"] <= pour["recorded"] <= pour["high"]
            color = style.POURER if held else style.SPILLED
            one.plot([x, x], [100 * pour["low"], 100 * pour["high"]], color=color, linewidth=1.0, alpha=0.5)
            one.plot(x, y, "o", color=color, markersize=3.5, clip_on=False)
        held = sum(pour["low"] <= pour["recorded"] <= pour["high"] for pour in pours)
        style.dress(
            one,
            title=f"{title}: {held} of {len(pours)} pours in 90 % intervals",
            x="recorded: spilled / poured [%]",
            y="predicted [%]",
        )
        one.set_xlim(0, top)
        one.set_ylim(0, top)
    style.save(figure, PICTURE)


if __name__ == "__main__":
    main()
