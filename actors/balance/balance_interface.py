"""The interface of balances: readings, the driver protocol and the errors. It contains no driver.

`Weight` is one reading and `BalanceDriver` the protocol that every driver implements. Every `BalanceError` has a text
for the operator at the balance; `unsettled` builds the text for a weight that never settled. `BalanceDisplay` keeps the
last reading of a display: its weight, its step, and its unit for lines without one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from actors.balance.readings import IN_TURN, OTHER_UNITS, Reading, ReadingStatus, in_turn, kilograms
from actors.interfaces import LaboratoryError


@dataclass(frozen=True)
class Weight:
    """A reading.

    Attributes:
        mass: net of the tare [kg]; nan if the display shows none (`read` only).
        stable: whether the balance reports it as stable; only stable weights count as measurements.
        time: of the reading [s]: bench time for a simulated balance in this process, `DeviceClock` for a serial
            balance.
        status: 'stable', 'unstable', 'over range', 'under range', 'busy', 'error', 'silent', 'not understood' or
            'lost'.
        step: of the display [kg]; 0 if unknown.
        shown: as the balance sent it, e.g. '12.34 g'.
    """

    mass: float
    stable: bool
    time: float
    status: str = ""
    step: float = 0.0
    shown: str = ""


class BalanceDriver(Protocol):
    """The driver of one balance. It is plain and blocking, and runs in a process or thread of its own.

    `actors.contract_tests.balance_contract` has the tests that every driver has to pass.
    """

    def connect(self) -> str:
        """Identify the balance.

        Returns:
            Description of the balance, for the operator.

        Raises:
            LaboratoryError: no balance with a supported dialect replies.
        """
        ...

    def tare(self) -> None:
        """Wait for a stable weight and tare the balance.

        Raises:
            LaboratoryError: not stable in time, or connection lost.
        """
        ...

    def weigh(self) -> Weight:
        """Wait for a stable weight. After a lost connection it fails until `keep_reference` or another tare.

        Raises:
            ReferenceLostError: the balance may have been switched off since the last tare, and may have a new zero.
            LaboratoryError: no stable weight in time, or connection lost; the text is for the operator at the balance.
        """
        ...

    def read(self) -> Weight:
        """Return the display's weight, stable or not; never fails, and does not wait for a running call."""
        ...

    def keep_reference(self) -> None:
        """Confirm after a lost connection that the operator has checked the tare."""
        ...

    def interrupt(self) -> None:
        """End the current wait with a LaboratoryError, and later waits at once, until `resume`."""
        ...

    def resume(self) -> None:
        """Allow waits again."""
        ...

    def close(self) -> None:
        """Release the balance; never fails, and may be called again."""
        ...


class BalanceError(LaboratoryError):
    """A balance cannot carry out a request."""


class NoConnectionError(BalanceError):
    """The port cannot be opened or has vanished, or no device replies on it."""


class LineSettingsError(NoConnectionError):
    """The port cannot be set to this speed or format."""


class NotStableError(BalanceError):
    """The weight did not settle in time."""


class OutOfRangeError(BalanceError):
    """The load is above or below the balance's range."""


class CommandError(BalanceError):
    """Tare or zero was refused, or had no effect."""


class UnitError(BalanceError):
    """The balance shows a unit that is not a mass."""


class ReferenceLostError(BalanceError):
    """The connection was lost since the last tare: the balance may have been switched off and have a new zero."""


_OUTSIDE = {
    ReadingStatus.OVER: "over range: more is on it than it weighs. Take something off, or use a larger balance",
    ReadingStatus.UNDER: (
        "under range: something that was on it when it was switched on is missing (its pan?), or it hangs"
    ),
}

REFUSED = "it refuses the question"
"""Prefix of the detail of a reading that reports a refused query."""

LOST_REFERENCE = (
    "the connection was lost since the last tare. If it stayed switched on, its display still holds the weight (last "
    "seen: {shown}): look whether it does, and confirm. If it was off, its zero is new, and what lay on it is not "
    "known any more"
)
"""After a power cycle, a balance takes its current load as zero; a spill would then be read as zero."""

WITHOUT_EFFECT = (
    "{name} was sent {times} times without effect: {said}. Is something dripping on it or touching it, is its display "
    "frozen, is its keyboard locked? Try its key; then switch it off and on"
)


def unsettled(
    seen: Reading, shown: str, within: float, damaged: int, masses: Sequence[float] = ()
) -> tuple[type[BalanceError], str]:
    """Return the error for a weight that did not settle before the deadline.

    Args:
        seen: the last reading other than silence.
        shown: last weight on the display, '' for none.
        within: the time limit [s].
        damaged: number of invalid lines so far.
        masses: the last weights, stable or not [kg].

    Returns:
        Class and text of the error.
    """
    cable = f" {damaged} lines were damaged so far: look at cable and plug." if damaged else ""
    match seen.status:
        case ReadingStatus.OVER | ReadingStatus.UNDER:
            return OutOfRangeError, _OUTSIDE[seen.status]
        case ReadingStatus.ERROR:
            detail = f" ({seen.detail})" if seen.detail else ""
            return BalanceError, f"it reports a fault{detail}; look it up in its manual"
        case ReadingStatus.BUSY if seen.detail.startswith(REFUSED):
            return CommandError, f"{seen.detail}. Does it speak this dialect? Set 'dialect: auto' to find out"
        case ReadingStatus.UNREADABLE:
            text = f"it answers, but no weight came within {within:g} s. Its last line was {seen.detail}"
            return NoConnectionError, text
        case ReadingStatus.SILENT:
            return (
                NoConnectionError,
                f"no answer within {within:g} s. Is it switched on and in weighing mode? If it prints only 'at "
                f"stability', nothing may have come to rest; set it to print without stability.{cable}",
            )
    if in_turn(masses):
        return NotStableError, f"no stable weight within {within:g} s: {IN_TURN}"
    flag = str(seen.status)
    if seen.status is ReadingStatus.STABLE:
        flag = "marked as stable, but not the same for long enough"
    return (
        NotStableError,
        f"no stable weight within {within:g} s (last {shown or 'nothing'}, {flag}). Is something touching the "
        "tray, is it still dripping, is there a draught? Then weigh again; if it never rests, set a slower filter in "
        f"its menu, or allow more 'steps' in the laboratory's file.{cable}",
    )


_WITHOUT_LINE = (ReadingStatus.SILENT, ReadingStatus.UNREADABLE)


class BalanceDisplay:
    """Keeps the last reading of a display.

    Args:
        step: of the display [kg], if it differs from one unit of the last digit sent.
    """

    def __init__(self, step: float | None = None) -> None:
        self._given = step
        self._unit = ""
        self.step = step or 0.0
        """Step of the display [kg]; 0 while unknown."""
        self.last = Weight(math.nan, False, 0.0, str(ReadingStatus.LOST))
        """Last reading."""

    def note(self, reading: Reading, moment: float) -> None:
        """Record a reading.

        Args:
            reading: as the balance sent it.
            moment: time of the reading [s].
        """
        if kilograms(reading.unit) is not None or reading.unit.lower() in OTHER_UNITS:
            self._unit = reading.unit
        step = reading.step(self._unit)
        if self._given is None and step is not None:
            self.step = step
        mass = reading.mass(self._unit)
        shown = "" if reading.value is None else f"{reading.value} {reading.unit or self._unit}".strip()
        self.last = Weight(
            math.nan if mass is None else mass,
            reading.status is ReadingStatus.STABLE and mass is not None,
            moment,
            str(reading.status),
            self.step,
            shown or (self.last.shown if reading.status in _WITHOUT_LINE else str(reading)),
        )

    def lose(self, moment: float) -> None:
        """Record the loss of the connection at a time [s]; the last shown text is kept for messages."""
        self.last = Weight(math.nan, False, moment, str(ReadingStatus.LOST), self.step, self.last.shown)

    def in_grams(self, mass: float) -> str:
        """Format a mass with the display's digits.

        Args:
            mass: [kg].
        """
        digits = max(0, -math.floor(math.log10(1e3 * self.step) + 1e-9)) if self.step > 0.0 else 3
        return f"{1e3 * mass:.{digits}f} g"
