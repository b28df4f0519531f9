"""Figure of docs/evidence/performance.md, in the style of a campaign's report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from orchestrator.reports import figure_style as style

COST = "performance-cost.png"


def cost_figure(path: Path, ours: Sequence[tuple[int, float]], theirs: Sequence[tuple[int, float]]) -> Path:
    """Draw CPU seconds against the number of particles, both on logarithmic axes.

    Args:
        path: path of the PNG.
        ours, theirs: (particles, CPU seconds).
    """
    figure, axes = style.new_figure(size=(6.4, 4.2))
    for points, colour, name in (
        (theirs, style.GREY, "SPlisHSPlasH, DFSPH"),
        (ours, style.MEASURED, "Decant, without the use of symmetry"),
    ):
        if points:
            numbers, seconds = zip(*sorted(points), strict=True)
            axes.plot(numbers, seconds, color=colour, marker="o", ms=4.5, lw=1.5, label=name)
            axes.annotate(f"{seconds[-1]:.3g} s", (numbers[-1], seconds[-1]), (0, 7), textcoords="offset points",
                          ha="center", fontsize=8, color=colour)  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = sorted({n for n, _ in (*ours, *theirs)})
    axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    style.dress(
        axes, title="CPU time of a pour of 200 mL", x="number of particles", y="CPU seconds, one core", grid="both"
    )
    axes.legend(fontsize=8, framealpha=0.85, edgecolor="none")
    return style.save(figure, path)
