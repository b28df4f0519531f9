"""What the weighings of a pour say: its masses, their uncertainties, and whether they can be right. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from actors.balance.errors import BalanceError
from actors.balance.placement import PLANS, Placement, needed
from sim_engine.outcome import PourMeasurement

SURE = 4.0
"""Standard deviations beyond which a mass below nothing is a mistake and no noise."""


class WeighingError(BalanceError):
    """The weighings of a pour are incomplete, or can't all be right."""


@dataclass(frozen=True)
class Weighed:
    """One weighing.

    Attributes:
        mass: net [kg].
        uncertainty: standard deviation [kg].
    """

    mass: float
    uncertainty: float = 0.0


def loaded_mass(placement: Placement, weighed: Mapping[str, Weighed]) -> float:
    """What was filled in [kg], by the weighings before the pour."""
    return sum(c * weighed[key].mass for key, c in PLANS[placement].masses["loaded"].items())


def measurement(
    placement: Placement,
    weighed: Mapping[str, Weighed],
    *,
    nominal: float | None = None,
    tolerance: float = math.inf,
) -> PourMeasurement:
    """The masses of a pour.

    A mass that comes out a little below nothing, within `SURE` standard deviations, is nothing; the notes keep what was
    read.

    Args:
        placement: where the balance stood.
        weighed: all that `needed` names.
        nominal: load that was asked for [kg].
        tolerance: how far the load may lie from it [kg].

    Raises:
        WeighingError: a weighing is missing or no number, a mass is less than nothing beyond noise, more came out
            than was in, or the load is not the one that was asked for. Nothing is assumed in place of what is missing.
    """
    _check_complete(placement, weighed)
    table = PLANS[placement].masses
    mass = {name: sum(c * weighed[key].mass for key, c in row.items()) for name, row in table.items()}
    sigma = {name: _sigma(row, weighed) for name, row in table.items()}
    received = dict(_difference(table))
    mass["received"] = sum(c * weighed[key].mass for key, c in received.items())
    sigma["received"] = _sigma(received, weighed)
    _check_sense(mass, sigma, nominal, tolerance)
    spilled = max(mass["spilled"], 0.0)
    retained = min(max(mass["retained"], 0.0), mass["loaded"])
    return PourMeasurement(
        loaded=mass["loaded"],
        spilled=spilled,
        retained=retained,
        notes={
            "placement": str(placement),
            "received_g": _grams(max(mass["loaded"] - spilled - retained, 0.0)),
            "uncertainty_g": {name: _grams(sigma[name]) for name in ("loaded", "received", "spilled", "retained")},
            "as_weighed_g": {name: _grams(mass[name]) for name in ("loaded", "received", "spilled", "retained")},
            "weighings_g": {key: _grams(weighed[key].mass) for key in needed(placement)},
        },
    )


def weighing_uncertainty(step: float, repeatability: float, *, tared: bool = True) -> float:
    """Standard deviation of one weighing [kg].

    Args:
        step: of the display [kg]; a value within it is as likely as another.
        repeatability: standard deviation of weighing the same thing again [kg].
        tared: net of a tare, which was a weighing too.
    """
    return math.sqrt((step**2 / 12.0 + repeatability**2) * (2.0 if tared else 1.0))


def _difference(table: Mapping[str, Mapping[str, float]]) -> Mapping[str, float]:
    """received = loaded − spilled − retained, by weighings; what cancels is left out."""
    total: dict[str, float] = {}
    for name, sign in (("loaded", 1.0), ("spilled", -1.0), ("retained", -1.0)):
        for key, c in table[name].items():
            total[key] = total.get(key, 0.0) + sign * c
    return {key: c for key, c in total.items() if c != 0.0}


def _sigma(row: Mapping[str, float], weighed: Mapping[str, Weighed]) -> float:
    return math.sqrt(sum((c * weighed[key].uncertainty) ** 2 for key, c in row.items()))


def _check_complete(placement: Placement, weighed: Mapping[str, Weighed]) -> None:
    asked = {step.key: step.put for step in PLANS[placement].steps if step.key}
    missing = [key for key in asked if key not in weighed]
    if missing:
        what = "; ".join(f"{key} ('{asked[key]}')" for key in missing)
        raise WeighingError(
            f"not weighed: {what}. Without it the pour can't be counted; nothing is assumed in its place"
        )
    for key in asked:
        one = weighed[key]
        if not (math.isfinite(one.mass) and math.isfinite(one.uncertainty) and one.uncertainty >= 0.0):
            raise WeighingError(f"{key} is not a weight: {one.mass} kg ± {one.uncertainty} kg")


def _check_sense(mass: dict[str, float], sigma: dict[str, float], nominal: float | None, tolerance: float) -> None:
    """Refuse what can't be; rounding of the sums is not an offence."""
    slack = {name: SURE * sigma[name] + 1e-9 for name in mass}
    shown = {name: f"{_grams(mass[name]):g} ± {_grams(sigma[name]):g} g" for name in mass}
    if mass["loaded"] <= slack["loaded"]:
        raise WeighingError(
            f"loaded {shown['loaded']}: the filled pourer weighed no more than the empty one. Was it filled? "
            "Were the two mixed up?"
        )
    if nominal is not None and abs(mass["loaded"] - nominal) > tolerance:
        raise WeighingError(
            f"loaded {shown['loaded']}, but {_grams(nominal):g} ± {_grams(tolerance):g} g was asked for. Fill anew, or "
            "weigh anew if it was filled right"
        )
    hints = {
        "spilled": "the tray got lighter: was something taken off it, or did the zero drift?",
        "retained": "the pourer got lighter than when it was dry and empty: was another one weighed?",
        "received": "more was spilled and left over than was in the pourer: was it refilled, or a weighing mixed up?",
    }
    for name, hint in hints.items():
        if mass[name] < -slack[name]:
            raise WeighingError(f"{name} {shown[name]} is less than nothing: {hint} All: {_all(shown)}")
        if mass[name] > mass["loaded"] + slack[name] + slack["loaded"]:
            raise WeighingError(
                f"{name} {shown[name]} is more than was loaded, {shown['loaded']}: did something else fall on the "
                f"balance, or was a weighing mixed up? All: {_all(shown)}"
            )


def _all(shown: dict[str, str]) -> str:
    return ", ".join(f"{name} {text}" for name, text in shown.items())


def _grams(mass: float) -> Any:
    """[g], with a microgram's digits: the rest is noise of the computer."""
    return round(1e3 * mass, 6)
