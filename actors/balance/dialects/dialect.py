"""What the driver needs to know of a dialect. Bytes and values only; nothing here opens a port."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import Protocol

from actors.balance.reading import Reading, Reply

END = b"\r\n"
"""Ends every line of every dialect here."""

NUMBER = re.compile(r"[+-]?[0-9]{1,10}(?:\.[0-9]{1,9})?")
"""A weight in digits; no exponents, no commas, and a digit on both sides of the point."""


@dataclass(frozen=True)
class LineSettings:
    """How characters travel.

    Attributes:
        baud: bits per second.
        bits: per character, 7 or 8.
        parity: 'N', 'O' or 'E'.
        stop: stop bits.
    """

    baud: int
    bits: int = 8
    parity: str = "N"
    stop: int = 1

    @property
    def format(self) -> str:
        """'8N1'."""
        return f"{self.bits}{self.parity}{self.stop}"

    def __str__(self) -> str:
        return f"{self.baud} baud {self.format}"

    @property
    def character_time(self) -> float:
        """Time that one character takes on the line [s]."""
        return (1 + self.bits + (self.parity != "N") + self.stop) / self.baud


class Dialect(Protocol):
    """One way of talking. Implementations are modules' constants without state."""

    @property
    def name(self) -> str:
        """In files: 'kcp'."""
        ...

    @property
    def title(self) -> str:
        """For people: 'Kern KCP'."""
        ...

    @property
    def lines(self) -> tuple[LineSettings, ...]:
        """Line settings that such balances come with, the likeliest first."""
        ...

    @property
    def gap(self) -> float:
        """Shortest time from one question to the next [s]."""
        ...

    @property
    def query(self) -> bytes:
        """Asks for what the display shows now."""
        ...

    @property
    def tare(self) -> bytes:
        """Counts what is on the balance as nothing."""
        ...

    @property
    def zero(self) -> bytes | None:
        """Sets the empty balance's zero; None where only a key does."""
        ...

    @property
    def cancel(self) -> bytes | None:
        """Ends repeated output and commands that wait; None where there is no such command."""
        ...

    @property
    def acknowledged(self) -> bool:
        """Whether tare and zero are answered by a line."""
        ...

    def decode(self, line: bytes) -> Reply:
        """Understand one line.

        Args:
            line: without its CR LF.

        Raises:
            FrameError: it is none of this dialect's.
        """
        ...

    def encode(self, reading: Reading) -> bytes:
        """The line that a balance of this dialect would send for a reading, CR LF included.

        Raises:
            ValueError: the dialect can't say it.
        """
        ...


def text_of(line: bytes) -> str | None:
    """A line as text; None where it holds anything but printable ASCII."""
    if any(not 0x20 <= byte < 0x7F for byte in line):
        return None
    return line.decode("ascii")


def number_in(text: str) -> Decimal | None:
    """The number that a text consists of; None where it is anything else."""
    return Decimal(text) if NUMBER.fullmatch(text) else None
