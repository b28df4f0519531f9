"""What a balance can be asked. Values and a protocol; no driver.

What can go wrong with a balance, for the person who stands beside it.

Why a balance gave no weight, in words for the person beside it.

What was last seen on a balance's display: its weight, its unit where lines leave it out, its step.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Protocol

from actors.balance.readings import Reading, ReadingStatus, kilograms
from actors.interfaces import LaboratoryError


@dataclass(frozen=True)
class Weight:
    """A reading.

    Attributes:
        mass: net of the tare [kg]; nan where the display shows none (`read` only).
        stable: the balance vouches for it; only stable weights count as measurements.
        time: of the reading [s]: bench time of a virtual balance in this process, `time.monotonic` of one on a serial
            line.
        status: 'stable', 'unstable', 'over range', 'under range', 'busy', 'error', 'silent' or 'lost'.
        step: of the display [kg]; 0 where it is not known.
        shown: as the balance sent it, e.g. '12.34 g'.
    """

    mass: float
    stable: bool
    time: float
    status: str = ""
    step: float = 0.0
    shown: str = ""


class BalanceDriver(Protocol):
    """What talks to one balance: plain and blocking; it is put into a process (or thread) of its own.

    `actors.contract_tests.balance_contract` has the tests that every driver has to pass.
    """

    def connect(self) -> str:
        """Find out what is there.

        Returns:
            What was found, for people.

        Raises:
            LaboratoryError: nobody understandable is there.
        """
        ...

    def tare(self) -> None:
        """Wait until the balance is at rest and count what is on it as zero.

        Raises:
            LaboratoryError: not at rest in time, or lost.
        """
        ...

    def weigh(self) -> Weight:
        """Wait for a stable weight. After a lost connection it refuses until `keep_reference` or another tare.

        Raises:
            ReferenceLostError: the balance may have been off since the last tare, and begun at a new zero.
            LaboratoryError: no stable weight in time, or lost; the text is for the person beside it.
        """
        ...

    def read(self) -> Weight:
        """What the display shows now, stable or not; never fails, and doesn't wait for a call that is under way."""
        ...

    def keep_reference(self) -> None:
        """After a lost connection: a person has seen that the tare still holds."""
        ...

    def interrupt(self) -> None:
        """End the wait that is under way with a LaboratoryError, and later ones at once, until `resume`."""
        ...

    def resume(self) -> None:
        """Let waits last again."""
        ...

    def close(self) -> None:
        """Let go of it; never fails, and may be called again."""
        ...


class BalanceError(LaboratoryError):
    """A balance can't do what was asked."""


class NoConnectionError(BalanceError):
    """The port can't be opened, has vanished, or nobody answers on it."""


class LineSettingsError(NoConnectionError):
    """The port can't be set to this speed or format."""


class UnknownDialectError(NoConnectionError):
    """Something may be there, but it speaks none of the dialects."""


class NotStableError(BalanceError):
    """The weight did not settle in time."""


class OutOfRangeError(BalanceError):
    """More on the balance than it weighs, or less."""


class CommandError(BalanceError):
    """Tare or zero was refused, or did not take effect."""


class UnitError(BalanceError):
    """The balance shows something that is not a mass."""


class ReferenceLostError(BalanceError):
    """The connection was lost since the last tare: the balance may have been off and begun at a new zero."""


class BalanceFaultError(BalanceError):
    """The balance reports a fault of its own."""


_OUTSIDE = {
    ReadingStatus.OVER: "over range: more is on it than it weighs. Take something off, or use a larger balance",
    ReadingStatus.UNDER: (
        "under range: something that was on it when it was switched on is missing (its pan?), or it hangs"
    ),
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
        case ReadingStatus.OVER | ReadingStatus.UNDER:
            return OutOfRangeError, _OUTSIDE[seen.status]
        case ReadingStatus.ERROR:
            detail = f" ({seen.detail})" if seen.detail else ""
            return BalanceFaultError, f"it reports a fault{detail}; look it up in its manual"
        case ReadingStatus.BUSY if seen.detail.startswith(REFUSED):
            return CommandError, f"{seen.detail}. Does it speak this dialect? Set 'dialect: auto' to find out"
        case ReadingStatus.SILENT:
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


class BalanceDisplay:
    """Remembers readings.

    Args:
        step: of the display [kg], where it is not one of the last digit sent.
    """

    def __init__(self, step: float | None = None) -> None:
        self._given = step
        self._unit = ""
        self.step = step or 0.0
        """Step of the display [kg]; 0 while it is not known."""
        self.last = Weight(math.nan, False, 0.0, str(ReadingStatus.LOST))
        """Last reading."""

    def note(self, reading: Reading, moment: float) -> None:
        """Take note of a reading.

        Args:
            reading: as the balance sent it.
            moment: when it came [s].
        """
        if kilograms(reading.unit) is not None:
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
            shown or (self.last.shown if reading.status is ReadingStatus.SILENT else str(reading)),
        )

    def lose(self) -> None:
        """The connection is gone; what was last shown is kept for messages."""
        self.last = Weight(math.nan, False, time.monotonic(), str(ReadingStatus.LOST), self.step, self.last.shown)

    def in_grams(self, mass: float) -> str:
        """A mass with the display's digits.

        Args:
            mass: [kg].
        """
        digits = max(0, -math.floor(math.log10(1e3 * self.step) + 1e-9)) if self.step > 0.0 else 3
        return f"{1e3 * mass:.{digits}f} g"
