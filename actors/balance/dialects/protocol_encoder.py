"""The balance's side of a dialect: from bytes that it hears to what it says. No clock, no ports."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import Protocol

from actors.balance.readings import Reading, ReadingStatus
from actors.balance.simulated_balance import EmulatedScale

END = b"\r\n"
"""Ends every line of every dialect here."""


@dataclass(frozen=True)
class PendingReply:
    """Said once the display stands.

    Attributes:
        done: carries the command out and gives the line.
        expired: line if it does not come to rest in time, or what carries the command out all the same and gives it;
            None: waits for ever.
        patience: how long it waits [s of bench time]; None: as long as the balance waits for every command.
    """

    done: Callable[[], bytes]
    expired: bytes | Callable[[], bytes] | None = None
    patience: float | None = None


@dataclass(frozen=True)
class Repeat:
    """Readings from now on, until the next command.

    Attributes:
        line: gives the line for a reading; None: the dialect's.
    """

    line: Callable[[Reading], bytes] | None = None


@dataclass(frozen=True)
class Follow:
    """The weight once it stands, and again whenever it has changed and stands again, until the next command.

    Attributes:
        line: gives the line for a reading.
        step: change that counts, as a function of the last stable value, in the display's unit.
        moving: the change itself is reported, too, while the display moves.
    """

    line: Callable[[Reading], bytes]
    step: Callable[[Decimal], Decimal]
    moving: bool = True


@dataclass(frozen=True)
class Cancel:
    """Ends what waits and what is repeated.

    Attributes:
        line: the answer.
    """

    line: bytes


Said = bytes | PendingReply | Repeat | Follow | Cancel


class EncoderDisplay(Protocol):
    """What a voice speaks of: a scale, or one with a fault."""

    @property
    def scale(self) -> EmulatedScale:
        """The scale itself."""
        ...

    def reading(self) -> Reading:
        """What the display shows."""
        ...

    def tare(self) -> ReadingStatus:
        """Carry out a tare."""
        ...

    def zero(self) -> ReadingStatus:
        """Carry out a zero."""
        ...


class Lines(Protocol):
    """Puts readings into lines: a dialect."""

    def encode(self, reading: Reading) -> bytes:
        """The line for a reading.

        Raises:
            ValueError: there is none for it.
        """
        ...


class ProtocolEncoder(Protocol):
    """One dialect, spoken by a balance."""

    @property
    def dialect(self) -> Lines:
        """The dialect."""
        ...

    def commands(self, heard: bytearray) -> list[bytes]:
        """Take whole commands out of what was received."""
        ...

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """What it says to a command; empty for nothing."""
        ...


def weight_line(dialect: Lines, reading: Reading) -> bytes:
    """The line for a reading; a dialect that can't say it reports a fault instead, or has no words for that either."""
    for said in (reading, Reading(ReadingStatus.ERROR)):
        with contextlib.suppress(ValueError):
            return dialect.encode(said)
    return b""


class PlainEncoder:
    """A balance that answers its question at once, and tares and zeroes in silence once it rests.

    Args:
        dialect: whose lines it sends.
        query, tare, zero: what it understands, each byte for byte.
    """

    def __init__(self, dialect: Lines, query: bytes, tare: bytes, zero: bytes | None) -> None:
        self.dialect = dialect
        self._query, self._known = query, [command for command in (query, tare, zero) if command is not None]
        self._tare = tare

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        found: list[bytes] = []
        while heard:
            command = next((c for c in self._known if heard.startswith(c)), None)
            if command is not None:
                found.append(command)
                del heard[: len(command)]
            elif any(c.startswith(heard) for c in self._known):
                break  # the rest is still to come
            else:
                del heard[0]
        return found

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        if command == self._query:
            return weight_line(self.dialect, display.reading())
        act = display.tare if command == self._tare else display.zero
        return PendingReply(lambda: silently(act))


def silently(act: Callable[[], ReadingStatus]) -> bytes:
    """Do it and say nothing."""
    act()
    return b""


def line_of(text: str) -> bytes:
    """A text as a line."""
    return text.encode("ascii", "replace") + END
