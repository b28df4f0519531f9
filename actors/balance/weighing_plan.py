"""Placements of the balance, the weighings that each one needs, and the masses that follow from them.

Four masses belong to a pour: loaded = received + spilled + retained. No balance reads all of them at once. Each
placement is a `Plan`: a list of steps, and a table that gives each mass as a sum of weighings. Uncertainties follow
from the same table, and a mass that occurs in two weighings, such as the pourer's own, cancels. `measurement` computes
the masses and their uncertainties and checks them for consistency. All functions here are pure.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from actors.balance.balance_interface import BalanceError
from sim_engine.outcome import PourMeasurement


class Placement(StrEnum):
    """Where the balance stands."""

    TRAY = "tray"
    """Under a tray, with the receiver on a separate stand: it reads the spilled mass."""

    RECEIVER = "receiver"
    """Under the receiver only: it reads the received mass."""

    EVERYTHING = "everything"
    """Under tray and receiver together: it reads the poured mass."""

    TARED = "tared"
    """The weighings of a simulated bench: vessels are tared, so that each weight is that of liquid only."""

    MANUAL = "manual"
    """Anywhere, and not connected: the operator weighs and types."""


When = Literal["once", "before", "pour", "after"]


@dataclass(frozen=True)
class WeighingStep:
    """One step of a plan.

    Attributes:
        do: 'tare' the balance with the listed objects on it, 'weigh' them, or 'pour'.
        put: instruction to the operator about the objects and their places; complete sentences.
        when: 'once' for a vessel (and again when it is replaced), otherwise 'before' or 'after' the pour.
        key: of the weighing; '' for other steps.
        by: source of the number: the connected 'balance', or the 'operator', who types it.
        hands: whether the operator has to act first; otherwise the step runs at once, before anything drifts or dries.
        about: identifier for programs, if the step has no key.
    """

    do: Literal["tare", "weigh", "pour"]
    put: str
    when: When
    key: str = ""
    by: Literal["balance", "operator"] = "balance"
    hands: bool = True
    about: str = ""


@dataclass(frozen=True)
class Plan:
    """A placement: steps, and each mass as Σ coefficient · weighing."""

    steps: tuple[WeighingStep, ...]
    masses: Mapping[str, Mapping[str, float]]


_POUR = WeighingStep("pour", "The arm pours.", "pour")
_DRY = "Put the empty, dry pourer on the balance, alone."
_FULL = "Fill the pourer and put it on the balance."
GRIP = "Give the pourer to the gripper. "
"""The part of an instruction for which a bench with a gripper asks separately, see `actors.bench.held_vessel`."""

_LOADED = {"pourer_full": 1.0, "pourer_empty": -1.0}
_RETAINED = {"pourer_after": 1.0, "pourer_empty": -1.0}


def _tare(about: str, put: str, when: When, *, hands: bool = True) -> WeighingStep:
    return WeighingStep("tare", put, when, hands=hands, about=about)


PLANS: dict[Placement, Plan] = {
    Placement.TRAY: Plan(
        (
            _tare("tray_wiped", "Leave the wiped tray on the balance, with nothing on it.", "before"),
            WeighingStep("weigh", "Put the empty, dry pourer on the tray.", "once", "pourer_empty"),
            WeighingStep("weigh", "Fill the pourer and put it on the tray.", "before", "pourer_full"),
            _tare(
                "set_up",
                GRIP + "Wipe the tray, and put the receiver on its stand; it must not touch the tray.",
                "before",
            ),
            _POUR,
            WeighingStep("weigh", "Touch nothing: what lies on the tray is weighed.", "after", "spilled", hands=False),
            _tare("spill_left", "Leave the spill on the tray.", "after", hands=False),
            WeighingStep("weigh", "Put the pourer on the tray, beside what lies there.", "after", "pourer_after"),
        ),
        {"loaded": _LOADED, "spilled": {"spilled": 1.0}, "retained": _RETAINED},
    ),
    Placement.RECEIVER: Plan(
        (
            _tare("cleared", "Take everything off the balance.", "before"),
            WeighingStep("weigh", _DRY, "once", "pourer_empty"),
            WeighingStep("weigh", _FULL, "before", "pourer_full"),
            _tare("set_up", GRIP + "Put the empty receiver on the balance; nothing else may touch its pan.", "before"),
            _POUR,
            WeighingStep(
                "weigh", "Touch nothing: what is in the receiver is weighed.", "after", "received", hands=False
            ),
            _tare("cleared_after", "Take everything off the balance, and wipe its pan.", "after"),
            WeighingStep("weigh", "Put the pourer on the balance, alone.", "after", "pourer_after"),
        ),
        {
            "loaded": _LOADED,
            # The pourer's own mass cancels.
            "spilled": {"pourer_full": 1.0, "pourer_after": -1.0, "received": -1.0},
            "retained": _RETAINED,
        },
    ),
    Placement.EVERYTHING: Plan(
        (
            _tare("tray_wiped", "Leave the wiped tray on the balance, with nothing on it.", "before"),
            WeighingStep("weigh", "Put the empty, dry pourer on the tray.", "once", "pourer_empty"),
            WeighingStep("weigh", "Fill the pourer and put it on the tray.", "before", "pourer_full"),
            WeighingStep(
                "weigh", GRIP + "Put the empty receiver on the tray, where it will stand.", "before", "receiver_empty"
            ),
            _tare("set_up", "Leave tray and receiver as they are.", "before", hands=False),
            _POUR,
            WeighingStep("weigh", "Touch nothing: what was poured is weighed.", "after", "poured", hands=False),
            WeighingStep(
                "weigh",
                "Lift the receiver off without losing a drop, and leave the spill: less than nothing is shown.",
                "after",
                "receiver_gone",
            ),
        ),
        {
            "loaded": _LOADED,
            "spilled": {"receiver_gone": 1.0, "receiver_empty": 1.0},
            "retained": {"pourer_full": 1.0, "pourer_empty": -1.0, "poured": -1.0},
        },
    ),
    Placement.TARED: Plan(
        (
            _tare("dry_pourer", "Put a dry pourer on the balance, alone; it counts as nothing.", "before"),
            WeighingStep("weigh", "Put the filled pourer on the balance in its place.", "before", "pourer_full"),
            _tare("set_up", GRIP + "Put the wiped tray on the balance, the receiver on its stand.", "before"),
            _POUR,
            WeighingStep("weigh", "Touch nothing: what lies on the tray is weighed.", "after", "spilled", hands=False),
            _tare("dry_pourer_after", "Put a dry pourer on the balance, alone; it counts as nothing.", "after"),
            WeighingStep("weigh", "Put the pourer on the balance in its place.", "after", "pourer_after"),
        ),
        {"loaded": {"pourer_full": 1.0}, "spilled": {"spilled": 1.0}, "retained": {"pourer_after": 1.0}},
    ),
    Placement.MANUAL: Plan(
        (
            WeighingStep("weigh", "Weigh the empty, dry pourer.", "once", "pourer_empty", "operator"),
            WeighingStep("weigh", "Fill the pourer and weigh it.", "before", "pourer_full", "operator"),
            WeighingStep(
                "weigh", GRIP + "Wipe the tray, weigh it, and put it under.", "before", "tray_before", "operator"
            ),
            _POUR,
            WeighingStep("weigh", "Weigh the tray with what was spilled on it.", "after", "tray_after", "operator"),
            WeighingStep("weigh", "Weigh the pourer with what is left in it.", "after", "pourer_after", "operator"),
        ),
        {"loaded": _LOADED, "spilled": {"tray_after": 1.0, "tray_before": -1.0}, "retained": _RETAINED},
    ),
}


def weighings(
    placement: Placement, *, known: Collection[str] = (), pourer_elsewhere: bool = False
) -> tuple[WeighingStep, ...]:
    """Return the steps in order, including the pour.

    Args:
        placement: where the balance stands.
        known: keys of earlier weighings that are still valid; their 'once' steps are left out.
        pourer_elsewhere: whether the pourer is weighed on another balance and typed.
    """
    steps = [step for step in PLANS[placement].steps if not (step.when == "once" and step.key in known)]
    if not pourer_elsewhere or placement is Placement.MANUAL:
        return tuple(steps)
    elsewhere = [_elsewhere(step) if step.key.startswith("pourer") else step for step in steps]
    return tuple(step for i, step in enumerate(elsewhere) if not _idle(elsewhere, i))


def needed(placement: Placement) -> tuple[str, ...]:
    """Return the keys of all weighings that a measurement needs."""
    return tuple(step.key for step in PLANS[placement].steps if step.key)


def _elsewhere(step: WeighingStep) -> WeighingStep:
    texts = {
        "pourer_empty": "Weigh the empty, dry pourer on the other balance.",
        "pourer_full": "Fill the pourer and weigh it on the other balance.",
        "pourer_after": "Weigh the pourer with what is left in it on the other balance.",
    }
    return WeighingStep("weigh", texts[step.key], step.when, step.key, "operator")


def _idle(steps: list[WeighingStep], index: int) -> bool:
    """Whether a tare is useless: another tare precedes the next reading of this balance, or no reading follows."""
    if steps[index].do != "tare":
        return False
    for step in steps[index + 1 :]:
        if step.do == "tare":
            return True
        if step.do == "weigh" and step.by == "balance":
            return False
    return True


SURE = 4.0
"""Number of standard deviations beyond which a negative mass is an error instead of noise."""


@dataclass(frozen=True)
class Weighing:
    """One weighing.

    Attributes:
        mass: net [kg].
        uncertainty: standard deviation [kg].
    """

    mass: float
    uncertainty: float = 0.0


def loaded_mass(placement: Placement, weighed: Mapping[str, Weighing]) -> float:
    """Loaded mass [kg] from the weighings before the pour."""
    return sum(c * weighed[key].mass for key, c in PLANS[placement].masses["loaded"].items())


def measurement(
    placement: Placement,
    weighed: Mapping[str, Weighing],
    *,
    nominal: float | None = None,
    tolerance: float = math.inf,
) -> PourMeasurement:
    """Return the masses of a pour.

    A slightly negative mass, within `SURE` standard deviations, is set to zero; the notes keep the weighed value.

    Args:
        placement: where the balance stood.
        weighed: all weighings that `needed` lists.
        nominal: requested load [kg].
        tolerance: largest deviation of the load from it [kg].

    Raises:
        BalanceError: a weighing is missing or not a number, a mass is negative beyond noise, a mass exceeds the load,
            or the load differs from the requested one. Missing weighings are never replaced by assumptions.
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
        step: of the display [kg]; all values within it are equally likely.
        repeatability: standard deviation of repeated weighings of the same load [kg].
        tared: whether the weight is net of a tare, which was a weighing too.
    """
    return math.sqrt((step**2 / 12.0 + repeatability**2) * (2.0 if tared else 1.0))


def _difference(table: Mapping[str, Mapping[str, float]]) -> Mapping[str, float]:
    """received = loaded − spilled − retained in terms of weighings; terms that cancel are left out."""
    total: dict[str, float] = {}
    for name, sign in (("loaded", 1.0), ("spilled", -1.0), ("retained", -1.0)):
        for key, c in table[name].items():
            total[key] = total.get(key, 0.0) + sign * c
    return {key: c for key, c in total.items() if c != 0.0}


def _sigma(row: Mapping[str, float], weighed: Mapping[str, Weighing]) -> float:
    return math.sqrt(sum((c * weighed[key].uncertainty) ** 2 for key, c in row.items()))


def _check_complete(placement: Placement, weighed: Mapping[str, Weighing]) -> None:
    prompts = {step.key: step.put for step in PLANS[placement].steps if step.key}
    missing = [key for key in prompts if key not in weighed]
    if missing:
        steps = "; ".join(f"{key} ('{prompts[key]}')" for key in missing)
        raise BalanceError(
            f"not weighed: {steps}. Without it the pour can't be counted; nothing is assumed in its place"
        )
    for key in prompts:
        reading = weighed[key]
        if not (math.isfinite(reading.mass) and math.isfinite(reading.uncertainty) and reading.uncertainty >= 0.0):
            raise BalanceError(f"{key} is not a weight: {reading.mass} kg ± {reading.uncertainty} kg")


def _check_sense(mass: dict[str, float], sigma: dict[str, float], nominal: float | None, tolerance: float) -> None:
    """Raise an error for inconsistent masses; rounding errors of the sums are tolerated."""
    slack = {name: SURE * sigma[name] + 1e-9 for name in mass}
    shown = {name: f"{_grams(mass[name]):g} ± {_grams(sigma[name]):g} g" for name in mass}
    if mass["loaded"] <= slack["loaded"]:
        raise BalanceError(
            f"loaded {shown['loaded']}: the filled pourer weighed no more than the empty one. Was it filled? "
            "Were the two mixed up?"
        )
    if nominal is not None and abs(mass["loaded"] - nominal) > tolerance:
        raise BalanceError(
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
            raise BalanceError(f"{name} {shown[name]} is less than nothing: {hint} All: {_all(shown)}")
        if mass[name] > mass["loaded"] + slack[name] + slack["loaded"]:
            raise BalanceError(
                f"{name} {shown[name]} is more than was loaded, {shown['loaded']}: did something else fall on the "
                f"balance, or was a weighing mixed up? All: {_all(shown)}"
            )


def _all(shown: dict[str, str]) -> str:
    return ", ".join(f"{name} {text}" for name, text in shown.items())


def _grams(mass: float) -> Any:
    """Convert to grams, rounded to a microgram; further digits are floating-point noise."""
    return round(1e3 * mass, 6)
