"""Figures of docs/evidence/performance.md, in the style of a campaign's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from orchestrator.reports import figure_style as style

COST, PASSES = "performance-cost.png", "performance-passes.png"
MOMENTS = ("whole pour", "in full flow")
PASS_COLOURS = (
    *(style.MEASURED, style.PREDICTED, style.GOOD, style.BEST, style.FALLING, style.ESCAPED),
    *("#f0e442", "#555555", style.GREY, style.PALE),
)
LEAST_SHARE = 0.03
"""Passes with a smaller share of the pour are combined."""


def cost_figure(
    path: Path,
    ours: Sequence[tuple[int, float]],
    theirs: Sequence[tuple[int, float]],
    targets: Mapping[int, tuple[float, float]],
) -> Path:
    """Draw CPU seconds against the number of particles, both on logarithmic axes.

    Args:
        path: path of the PNG.
        ours, theirs: (particles, CPU seconds).
        targets: required and target CPU seconds by particles.
    """
    figure, axes = style.new_figure(size=(6.4, 4.2))
    for points, colour, name in (
        (theirs, style.GREY, "SPlisHSPlasH, DFSPH"),
        (ours, style.MEASURED, "Decant, whole pour"),
    ):
        if points:
            numbers, seconds = zip(*sorted(points), strict=True)
            axes.plot(numbers, seconds, color=colour, marker="o", ms=4.5, lw=1.5, label=name)
            axes.annotate(f"{seconds[-1]:.3g} s", (numbers[-1], seconds[-1]), (0, 7), textcoords="offset points",
                          ha="center", fontsize=8, color=colour)  # fmt: skip
    for which, (marker, name) in enumerate((("_", "required"), ("x", "aim"))):
        axes.plot(list(targets), [seconds[which] for seconds in targets.values()], marker, color=style.BEST, ms=9,
                  mew=1.6, label=name)  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = sorted({n for n, _ in (*ours, *theirs)} | set(targets))
    axes.set_xticks(ticks, [f"{n:,}" for n in ticks])
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    style.dress(axes, title="The standard pour", x="number of particles", y="CPU seconds, one core", grid="both")
    axes.legend(fontsize=8, framealpha=0.85, edgecolor="none")
    return style.save(figure, path)


def passes_figure(path: Path, profile: Mapping[str, Any]) -> Path:
    """Draw the shares of the solver's passes as stacked bars, for the complete pour and for full flow.

    Args:
        path: path of the PNG.
        profile: result of `profile_passes.py`.
    """
    whole = profile[MOMENTS[0]]["share"]
    drawn = [name for name, share in whole.items() if share >= LEAST_SHARE]
    figure, axes = style.new_figure(size=(8.0, 3.4))
    for row, moment in enumerate(reversed(MOMENTS)):
        share = profile[moment]["share"]
        parts = [(name, share.get(name, 0.0)) for name in drawn]
        parts.append(("the rest", 1.0 - sum(part for _, part in parts)))
        left = 0.0
        for colour, (name, part) in zip(PASS_COLOURS, parts, strict=False):
            axes.barh(row, part, left=left, color=colour, height=0.62, label=name if row == 0 else None)
            if part >= 0.05:
                axes.text(left + part / 2, row, f"{100 * part:.0f}", ha="center", va="center", fontsize=8,
                          color="white" if colour not in ("#f0e442", style.PALE) else style.INK)  # fmt: skip
            left += part
    axes.set_yticks(range(len(MOMENTS)), [f"{m}\n{profile[m]['ms_per_step']:.3g} ms a step" for m in reversed(MOMENTS)])
    axes.set_xlim(0.0, 1.0)
    axes.set_xticks([])
    style.dress(axes, title=f"Share of the CPU time [%], {profile['particles']:,} particles", grid=None)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return style.save(figure, path)
