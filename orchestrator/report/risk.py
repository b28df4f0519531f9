"""What errors of execution do to a planned action, in words: its risk, and how far one may miss it."""

from __future__ import annotations

from orchestrator.report import style
from orchestrator.report.units import LossUnit
from orchestrator.strategies.deployment.learnt import RiskFound
from orchestrator.strategies.deployment.window import WindowFound


def risk_line(risk: RiskFound, unit: LossUnit) -> str:
    """'under pose error and θ: CVaR 90 % 4.10 %, expected 2.30 %, pours differ by ± 1.40 %'."""
    thetas = f" and {risk.thetas} θ of the posterior" if risk.thetas else ""
    worst = f"CVaR {100 * risk.level:g} % {unit.text(max(risk.value, 0.0))}, " if risk.measure == "cvar" else ""
    return (
        f"best action under errors of execution{thetas}: {worst}expected {unit.text(max(risk.expected, 0.0))}, "
        f"pours differ by ± {unit.text(risk.spread)}"
    )


def window_line(window: WindowFound, unit: LossUnit) -> str:
    """'safe window: x offset 118 … 131 mm, angular velocity 34 … 71 deg/s at ≤ 2.00 %, checked by 12 simulations'."""
    checked = f"checked by {window.simulations} simulations"
    tolerance = unit.text(window.tolerance)
    if not window.axes:
        return f"safe window: none; the action itself comes to more than {tolerance}, {checked}"
    parts = []
    for name, ends in window.axes.items():
        low, high = (end / style.display_factor(name) for end in (ends.low, ends.high))
        more = {(): "", ("low",): " or less", ("high",): " or more"}.get(ends.cut_off, " or farther")
        parts.append(f"{name.replace('_', ' ')} {low:.4g} … {high:.4g} {style.display_unit(name)}{more}")
    return f"safe window: {', '.join(parts)} at ≤ {tolerance}, one missed at a time, {checked}"
