"""Why a balance gave no weight, in words for the person beside it."""

from __future__ import annotations

from actors.balance.errors import (
    BalanceError,
    BalanceFaultError,
    CommandError,
    NoConnectionError,
    NotStableError,
    OutOfRangeError,
)
from actors.balance.reading import Reading, Status

_OUTSIDE = {
    Status.OVER: "over range: more is on it than it weighs. Take something off, or use a larger balance",
    Status.UNDER: "under range: something that was on it when it was switched on is missing (its pan?), or it hangs",
}

REFUSED = "it refuses the question"
"""Begins the detail of a reading that is not a reading."""

LOST_REFERENCE = (
    "the connection was lost since the last tare. If it stayed switched on, its display still holds the weight (last "
    "seen: {shown}): look whether it does, and confirm. If it was off, its zero is new, and what lay on it is not "
    "known any more"
)
"""A balance that was switched off and on counts what lies on it as nothing: a spill would be read as none."""

WITHOUT_EFFECT = (
    "{name} was sent {times} times without effect: {said}. Is something dripping on it or touching it, is its display "
    "frozen, is its keyboard locked? Try its key; then switch it off and on"
)


def unsettled(seen: Reading, shown: str, within: float, damaged: int) -> tuple[type[BalanceError], str]:
    """What to say when the time for a weight is over.

    Args:
        seen: last reading that was an answer at all.
        shown: last weight on the display, '' for none.
        within: time that was allowed [s].
        damaged: lines that were not understood so far.

    Returns:
        Kind and text of the error.
    """
    cable = f" {damaged} lines were damaged so far: look at cable and plug." if damaged else ""
    match seen.status:
        case Status.OVER | Status.UNDER:
            return OutOfRangeError, _OUTSIDE[seen.status]
        case Status.ERROR:
            detail = f" ({seen.detail})" if seen.detail else ""
            return BalanceFaultError, f"it reports a fault{detail}; look it up in its manual"
        case Status.BUSY if seen.detail.startswith(REFUSED):
            return CommandError, f"{seen.detail}. Does it speak this dialect? Set 'dialect: auto' to find out"
        case Status.SILENT:
            return (
                NoConnectionError,
                f"no answer within {within:g} s. Is it switched on and in weighing mode? If it prints only 'at "
                f"stability', nothing may have come to rest; set it to print without stability.{cable}",
            )
    return (
        NotStableError,
        f"no stable weight within {within:g} s (last {shown or 'nothing'}, {seen.status}). Is something touching the "
        "tray, is it still dripping, is there a draught? Then weigh again; if it never rests, set a slower filter in "
        f"its menu, or allow more 'steps' in the laboratory's file.{cable}",
    )
