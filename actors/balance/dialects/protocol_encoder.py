"""The balance's side of a dialect, for emulated balances: received bytes to replies. No clock, no ports.

`ProtocolEncoder` is the interface, `PlainEncoder` its simplest implementation, and `CommandEncoder` a table of commands
that end with a line end. A reply is either bytes or one of
`PendingReply`, `Repeat`, `Follow` and `Cancel`, which the emulator carries out.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Protocol

from actors.balance.readings import Reading, ReadingStatus
from actors.balance.scale_model import EmulatedScale

END = b"\r\n"
"""Ends every line of the dialects in this package."""


@dataclass(frozen=True)
class PendingReply:
    """A reply that is sent once the display is stable.

    Attributes:
        done: executes the command and returns the line.
        expired: line if the display does not become stable in time, or a function that executes the command in any case
            and returns the line; None: wait without limit.
        timeout: longest wait [s of bench time]; None: the balance's limit for every command.
        first: line that confirms the command before it is executed; empty for none.
    """

    done: Callable[[], bytes]
    expired: bytes | Callable[[], bytes] | None = None
    timeout: float | None = None
    first: bytes = b""


@dataclass(frozen=True)
class Repeat:
    """Readings from now on, until the next command.

    Attributes:
        line: returns the line for a reading; None: the dialect's line.
        interval: between two readings [s of bench time].
    """

    line: Callable[[Reading], bytes] | None = None
    interval: float = 0.2


@dataclass(frozen=True)
class Follow:
    """The weight once it is stable, and again after every change once it is stable, until the next command.

    Attributes:
        line: returns the line for a reading.
        step: smallest change that counts, as a function of the last stable value, in the display's unit.
        moving: whether the change itself is reported, too, while the display moves.
    """

    line: Callable[[Reading], bytes]
    step: Callable[[Decimal], Decimal]
    moving: bool = True


@dataclass(frozen=True)
class Cancel:
    """Ends pending replies and repeated output.

    Attributes:
        line: the reply.
    """

    line: bytes


Said = bytes | PendingReply | Repeat | Follow | Cancel


class EncoderDisplay(Protocol):
    """The display that an encoder reads: a scale, or a scale with an injected fault."""

    @property
    def scale(self) -> EmulatedScale:
        """The scale itself."""
        ...

    def reading(self) -> Reading:
        """The display's current reading."""
        ...

    def tare(self) -> ReadingStatus:
        """Execute a tare."""
        ...

    def zero(self) -> ReadingStatus:
        """Execute a zero."""
        ...


class Lines(Protocol):
    """Encodes readings as lines; a dialect does."""

    def encode(self, reading: Reading) -> bytes:
        """Return the line for a reading.

        Raises:
            ValueError: there is no line for it.
        """
        ...


class ProtocolEncoder(Protocol):
    """The balance's side of one dialect."""

    @property
    def dialect(self) -> Lines:
        """The dialect."""
        ...

    def commands(self, heard: bytearray) -> list[bytes]:
        """Remove complete commands from the receive buffer and return them."""
        ...

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """Return the reply to a command; empty for no reply."""
        ...


def weight_line(dialect: Lines, reading: Reading) -> bytes:
    """Return the line for a reading. If the dialect has none, return its fault line, or nothing if it has no fault
    line.
    """
    for state in (reading, Reading(ReadingStatus.ERROR)):
        with contextlib.suppress(ValueError):
            return dialect.encode(state)
    return b""


class PlainEncoder:
    """A balance that answers its query at once, and tares and zeroes without a reply once it is stable.

    Args:
        dialect: encodes its lines.
        query, tare, zero: the accepted commands, byte for byte.
    """

    def __init__(self, dialect: Lines, query: bytes, tare: bytes, zero: bytes | None) -> None:
        self.dialect = dialect
        self._query, self._known = query, [command for command in (query, tare, zero) if command is not None]
        self._tare = tare

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        complete: list[bytes] = []
        while heard:
            command = next((c for c in self._known if heard.startswith(c)), None)
            if command is not None:
                complete.append(command)
                del heard[: len(command)]
            elif any(c.startswith(heard) for c in self._known):
                break  # incomplete command
            else:
                del heard[0]
        return complete

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        if command == self._query:
            return weight_line(self.dialect, display.reading())
        act = display.tare if command == self._tare else display.zero
        return PendingReply(lambda: silently(act))


class CommandEncoder:
    """A balance whose commands are lines.

    Args:
        dialect: encodes its lines.
        answers: command → function of the display that returns the reply.
        unknown: reply to any other command.
    """

    def __init__(
        self, dialect: Lines, answers: Mapping[str, Callable[[EncoderDisplay], Said]], unknown: bytes = b""
    ) -> None:
        self.dialect = dialect
        self._answers, self._unknown = answers, unknown

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        return complete_lines(heard)

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        word = command.decode("ascii", "replace").strip()
        answer = self._answers.get(word)
        return answer(display) if answer is not None else self._unknown if word else b""


def complete_lines(heard: bytearray) -> list[bytes]:
    """Remove complete lines from the receive buffer and return them, without their ends."""
    *lines, unfinished = re.split(rb"\r\n|\n", bytes(heard))
    heard[:] = unfinished
    return lines


def silently(act: Callable[[], ReadingStatus]) -> bytes:
    """Execute a command without a reply."""
    act()
    return b""


def line_of(text: str) -> bytes:
    """Encode a text as a line."""
    return text.encode("ascii", "replace") + END
