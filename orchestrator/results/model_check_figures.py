"""Whether the first pours bear out what was simulated: the figure behind a trust alarm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orchestrator.results import figure_style as style
from orchestrator.results.loss_units import LossUnit
from orchestrator.strategies.deployment.model_check import Compared, PourComparison
from orchestrator.strategies.deployment.model_monitoring import Believed
from orchestrator.strategies.deployment.real_pours import Foretold

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLLOWED = {
    "D2": "its simulations were forgotten",
    "widen": "its simulations were believed less",
    "go on": "its simulations were used on, as somebody decided",
}
"""What followed on an alarm, in words."""


def trust_line(trust: Compared | Foretold | Believed) -> str | None:
    """What people should know of a comparison: what was wrong by how much, and what followed; None where nothing was.

    Args:
        trust: of a deployment's result.
    """
    if isinstance(trust, Believed):
        return trust.text or None
    if not trust.alarm:
        return None
    if isinstance(trust, Foretold):  # a run that only tells
        return "the first pours were far from what was predicted; the simulator may not fit this vessel"
    text = "the first pours were worse than simulated; the simulator may not fit this vessel"
    what = "nobody has said yet how to go on"
    if trust.followed is not None:
        what = f"after pour {trust.pours[-1].number} {FOLLOWED[trust.followed]}"
    return f"{text} (by {trust.mean_z:.1f} deviations in the mean, limit {trust.limit:g}); {what}"


def draw_trust(path: Path, trust: Compared, *, unit: LossUnit, receiver: str) -> Path:
    """First pours beside what the simulations alone say of their actions, and the distance in standard deviations.

    Args:
        path: PNG to write.
        trust: of a deployment's result, with at least one compared pour.
        unit: of the loss.
        receiver: name for people.

    Returns:
        `path`.

    Raises:
        ValueError: nothing was compared.
    """
    pours = trust.pours
    if not pours:
        raise ValueError("trust figure: no pour was compared with the simulations")
    figure, (left, right) = style.new_figure(1, 2, size=(8.6, 4.2))
    title = f"First pours into {receiver}: {trust_title(trust)}"
    figure.suptitle(title, fontsize=12, color=style.INK, x=0.02, ha="left", wrap=True)
    numbers = np.array([pour.number for pour in pours])
    _losses(left, numbers, pours, unit)
    style.dress(left, title="weighed and simulated", x="pour", y=unit.label)
    limit, z = trust.limit, trust.z_scores
    # The mean is a bar of its own and no second line, which would often lie on the limit's.
    last = float(numbers[-1]) + 1.5
    right.bar(numbers, z, 0.5, color=[style.BEST if value > limit else style.GOOD for value in z])
    right.bar(
        [last],
        [trust.mean_z],
        0.5,
        color="white",
        edgecolor=style.BEST if trust.alarm else style.GOOD,
        hatch="//",
    )
    right.axhline(limit, color=style.INK, linewidth=1.0, linestyle="--", label=f"limit of the mean, {limit:g}")
    right.axhline(0.0, color=style.INK, linewidth=0.8)
    style.dress(right, title="how much worse than simulated", x="pour", y="standard deviations")
    right.set_xticks([*numbers, last], [*map(str, numbers), "mean, better\ncounts as 0"])
    for panel in (left, right):
        _legend_above(panel)
    return style.save(figure, path)


def trust_title(trust: Compared) -> str:
    """What the comparison shows, pour by pour: 'pours 2 and 3 as simulated, pour 1 worse by 7.6 σ: alarm'."""
    limit, groups = trust.limit, dict[str, list[tuple[int, float]]]()
    for pour, z in zip(trust.pours, trust.z_scores, strict=True):
        verdict = "worse" if z > limit else "better" if z < -limit else "as simulated"
        groups.setdefault(verdict, []).append((pour.number, abs(z)))
    parts = []
    for verdict in ("as simulated", "better", "worse"):
        if verdict in groups:
            some = groups[verdict]
            name = f"pour{'s' * (len(some) > 1)} {_listed([number for number, _ in some])} {verdict}"
            parts.append(name if verdict == "as simulated" else f"{name} by {_span([z for _, z in some])} σ")
    return ", ".join(parts) + (": alarm" if trust.alarm else "")


def _listed(numbers: list[int]) -> str:
    words = list(map(str, numbers))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _span(values: list[float]) -> str:
    low, high = f"{min(values):.1f}", f"{max(values):.1f}"
    return low if low == high else f"{low} to {high}"


def _losses(axes: Axes, numbers: Any, pours: Sequence[PourComparison], unit: LossUnit) -> None:
    simulated = unit.factor * np.array([pour.simulated for pour in pours])
    deviation = unit.factor * np.array([pour.deviation for pour in pours])
    weighed = unit.factor * np.array([pour.weighed for pour in pours])
    down = np.minimum(2 * deviation, simulated)  # nothing is spilled less than not at all
    axes.errorbar(
        numbers, simulated, yerr=np.vstack([down, 2 * deviation]), fmt="_", markersize=9, elinewidth=6.0,
        ecolor=style.PALE, color=style.PREDICTED, label="simulated ± 2 σ", zorder=2,
    )  # fmt: skip
    axes.plot(numbers, weighed, "o", color=style.MEASURED, markersize=6.5, label="weighed", zorder=3, clip_on=False)
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(numbers[0] - 0.6, numbers[-1] + 0.6)
    axes.set_xticks(numbers)


def _legend_above(axes: Axes) -> None:
    """A legend in a row of its own between title and panel."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles, labels, fontsize=8.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2,
        ncols=2, borderpad=0.0,
    )  # fmt: skip
    axes.set_title(axes.get_title(loc="left"), fontsize=11, loc="left", color=style.INK, pad=24)
