"""Whether the first pours bear out what was simulated: the figure behind a trust alarm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from orchestrator.report import style
from orchestrator.report.units import LossUnit
from orchestrator.strategies.deployment.pours import Foretold
from orchestrator.strategies.deployment.trust import Compared, Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLLOWED = {
    "D2": "its simulations were forgotten",
    "widen": "its simulations were believed less",
    "go on": "its simulations were used on, as somebody decided",
}
"""What followed on an alarm, in words."""


def trust_line(trust: Compared | Foretold) -> str | None:
    """What people should know of a comparison: what was wrong by how much, and what followed; None where nothing was.

    Args:
        trust: of a deployment's result.
    """
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
    figure, (left, right) = style.new_figure(1, 2, size=(8.2, 3.9))
    if trust.alarm:
        verdict = "the simulator is wrong here"
    else:
        verdict = "better than simulated" if trust.better else "the simulator is borne out"
    figure.suptitle(
        f"First pours against simulation: {receiver}: {verdict}", fontsize=12.5, color=style.INK, x=0.02, ha="left"
    )
    numbers = np.array([pour.number for pour in pours])
    _losses(left, numbers, pours, unit)
    style.dress(left, title="weighed and simulated", x="pour", y=unit.label)
    limit, z = trust.limit, trust.z_scores
    right.bar(numbers, z, 0.5, color=[style.BEST if value > limit else style.GOOD for value in z])
    right.axhline(limit, color=style.INK, linewidth=1.0, linestyle="--", label=f"limit {limit:g}")
    mean = f"mean, better counts as 0: {trust.mean_z:.1f}"
    right.axhline(trust.mean_z, color=style.MEASURED, linewidth=1.6, label=mean)
    right.axhline(0.0, color=style.INK, linewidth=0.8)
    _legend_above(right)
    right.set_xticks(numbers)
    style.dress(right, title="distance", x="pour", y="worse by, standard deviations")
    return style.save(figure, path)


def _losses(axes: Axes, numbers: Any, pours: Sequence[Comparison], unit: LossUnit) -> None:
    simulated = unit.factor * np.array([pour.simulated for pour in pours])
    deviation = unit.factor * np.array([pour.deviation for pour in pours])
    weighed = unit.factor * np.array([pour.weighed for pour in pours])
    down = np.minimum(2 * deviation, simulated)  # nothing is spilled less than not at all
    axes.errorbar(
        numbers, simulated, yerr=np.vstack([down, 2 * deviation]), fmt="_", markersize=9, elinewidth=6.0,
        ecolor=style.PALE, color=style.PREDICTED, label="simulated ± 2 σ", zorder=2,
    )  # fmt: skip
    axes.plot(numbers, weighed, "o", color=style.MEASURED, markersize=6.5, label="weighed", zorder=3)
    axes.set_ylim(bottom=0.0)
    axes.set_xticks(numbers)
    _legend_above(axes)


def _legend_above(axes: Axes) -> None:
    """A legend with room of its own above what is drawn."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))
    axes.legend(fontsize=8.5, frameon=False, loc="upper right")
