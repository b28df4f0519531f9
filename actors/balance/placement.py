"""Where the balance stands, and what therefore has to be weighed. Pure; what the weighings say is in `masses`.

Four masses belong to a pour: loaded = received + spilled + retained. No balance reads all of them at once. Each
placement is a list of steps and a table that says each mass as a sum of weighings: uncertainties follow from the same
table, and what is in two weighings (the pourer's own mass) cancels where it does.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Placement(StrEnum):
    """Where the balance stands."""

    TRAY = "tray"
    """Under a tray, with the receiver on a stand of its own: it reads what was spilled."""

    RECEIVER = "receiver"
    """Under the receiver alone: it reads what was received."""

    EVERYTHING = "everything"
    """Under tray and receiver together: it reads what was poured."""

    TARED = "tared"
    """The weighings of the bench of numbers: vessels are tared away, so that each is liquid alone."""

    MANUAL = "manual"
    """Anywhere, and not connected: the operator weighs and types."""


When = Literal["once", "before", "pour", "after"]


@dataclass(frozen=True)
class Step:
    """Something to do, in order.

    Attributes:
        do: 'tare' the balance with what is listed on it, 'weigh' what is listed, or 'pour'.
        put: what has to stand where, for the person who puts it there; whole sentences.
        when: 'once' for a vessel (and again when it is replaced), else 'before' or 'after' the pour.
        key: of the weighing; '' for other steps.
        by: who gives the number: the 'balance' that stands here, or the 'operator', who types it.
        hands: whether somebody has to do something first; else it is done at once, before anything drifts or dries.
        about: what it is about, for programs, where it has no key.
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

    steps: tuple[Step, ...]
    masses: Mapping[str, Mapping[str, float]]


_POUR = Step("pour", "The arm pours.", "pour")
_DRY = "Put the empty, dry pourer on the balance, alone."
_FULL = "Fill the pourer and put it on the balance."
_GRIP = "Give the pourer to the gripper. "
_LOADED = {"pourer_full": 1.0, "pourer_empty": -1.0}
_RETAINED = {"pourer_after": 1.0, "pourer_empty": -1.0}


def _tare(about: str, put: str, when: When, *, hands: bool = True) -> Step:
    return Step("tare", put, when, hands=hands, about=about)


PLANS: dict[Placement, Plan] = {
    Placement.TRAY: Plan(
        (
            _tare("tray_wiped", "Leave the wiped tray on the balance, with nothing on it.", "before"),
            Step("weigh", "Put the empty, dry pourer on the tray.", "once", "pourer_empty"),
            Step("weigh", "Fill the pourer and put it on the tray.", "before", "pourer_full"),
            _tare(
                "set_up",
                _GRIP + "Wipe the tray, and put the receiver on its stand; it must not touch the tray.",
                "before",
            ),
            _POUR,
            Step("weigh", "Touch nothing: what lies on the tray is weighed.", "after", "spilled", hands=False),
            _tare("spill_left", "Leave the spill on the tray.", "after", hands=False),
            Step("weigh", "Put the pourer on the tray, beside what lies there.", "after", "pourer_after"),
        ),
        {"loaded": _LOADED, "spilled": {"spilled": 1.0}, "retained": _RETAINED},
    ),
    Placement.RECEIVER: Plan(
        (
            _tare("cleared", "Take everything off the balance.", "before"),
            Step("weigh", _DRY, "once", "pourer_empty"),
            Step("weigh", _FULL, "before", "pourer_full"),
            _tare("set_up", _GRIP + "Put the empty receiver on the balance; nothing else may touch its pan.", "before"),
            _POUR,
            Step("weigh", "Touch nothing: what is in the receiver is weighed.", "after", "received", hands=False),
            _tare("cleared_after", "Take everything off the balance, and wipe its pan.", "after"),
            Step("weigh", "Put the pourer on the balance, alone.", "after", "pourer_after"),
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
            Step("weigh", "Put the empty, dry pourer on the tray.", "once", "pourer_empty"),
            Step("weigh", "Fill the pourer and put it on the tray.", "before", "pourer_full"),
            Step(
                "weigh", _GRIP + "Put the empty receiver on the tray, where it will stand.", "before", "receiver_empty"
            ),
            _tare("set_up", "Leave tray and receiver as they are.", "before", hands=False),
            _POUR,
            Step("weigh", "Touch nothing: what was poured is weighed.", "after", "poured", hands=False),
            Step(
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
            Step("weigh", "Put the filled pourer on the balance in its place.", "before", "pourer_full"),
            _tare("set_up", _GRIP + "Put the wiped tray on the balance, the receiver on its stand.", "before"),
            _POUR,
            Step("weigh", "Touch nothing: what lies on the tray is weighed.", "after", "spilled", hands=False),
            _tare("dry_pourer_after", "Put a dry pourer on the balance, alone; it counts as nothing.", "after"),
            Step("weigh", "Put the pourer on the balance in its place.", "after", "pourer_after"),
        ),
        {"loaded": {"pourer_full": 1.0}, "spilled": {"spilled": 1.0}, "retained": {"pourer_after": 1.0}},
    ),
    Placement.MANUAL: Plan(
        (
            Step("weigh", "Weigh the empty, dry pourer.", "once", "pourer_empty", "operator"),
            Step("weigh", "Fill the pourer and weigh it.", "before", "pourer_full", "operator"),
            Step("weigh", _GRIP + "Wipe the tray, weigh it, and put it under.", "before", "tray_before", "operator"),
            _POUR,
            Step("weigh", "Weigh the tray with what was spilled on it.", "after", "tray_after", "operator"),
            Step("weigh", "Weigh the pourer with what is left in it.", "after", "pourer_after", "operator"),
        ),
        {"loaded": _LOADED, "spilled": {"tray_after": 1.0, "tray_before": -1.0}, "retained": _RETAINED},
    ),
}


def weighings(placement: Placement, *, known: Collection[str] = (), pourer_elsewhere: bool = False) -> tuple[Step, ...]:
    """What has to be done, in order, the pour among it.

    Args:
        placement: where the balance stands.
        known: keys of weighings of before that still hold; their 'once' steps are left out.
        pourer_elsewhere: the pourer is weighed on another balance and typed.
    """
    steps = [step for step in PLANS[placement].steps if not (step.when == "once" and step.key in known)]
    if not pourer_elsewhere or placement is Placement.MANUAL:
        return tuple(steps)
    elsewhere = [_elsewhere(step) if step.key.startswith("pourer") else step for step in steps]
    return tuple(step for i, step in enumerate(elsewhere) if not _idle(elsewhere, i))


def needed(placement: Placement) -> tuple[str, ...]:
    """Keys of all weighings that a measurement is made of."""
    return tuple(step.key for step in PLANS[placement].steps if step.key)


def _elsewhere(step: Step) -> Step:
    texts = {
        "pourer_empty": "Weigh the empty, dry pourer on the other balance.",
        "pourer_full": "Fill the pourer and weigh it on the other balance.",
        "pourer_after": "Weigh the pourer with what is left in it on the other balance.",
    }
    return Step("weigh", texts[step.key], step.when, step.key, "operator")


def _idle(steps: list[Step], index: int) -> bool:
    """Whether a tare serves no weighing: another tare comes before this balance is read, or none is read after it."""
    if steps[index].do != "tare":
        return False
    for step in steps[index + 1 :]:
        if step.do == "tare":
            return True
        if step.do == "weigh" and step.by == "balance":
            return False
    return True
