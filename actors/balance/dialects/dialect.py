"""What the driver needs to know of a dialect. Bytes and values only; nothing here opens a port."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal

from actors.balance.dialects.protocol_encoder import PlainEncoder, ProtocolEncoder
from actors.balance.readings import Reading, Reply

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


@dataclass(frozen=True, kw_only=True)
class Dialect(ABC):
    """One way of talking: a class without state in a file of its own, whose one instance is registered at the door
    `decant.balances` under its `name`.

    Attributes:
        name: in files: 'kcp'.
        title: for people: 'Kern KCP'.
        lines: line settings that such balances come with, the likeliest first.
        gap: shortest time from one question to the next [s].
        query: asks for what the display shows now.
        tare: counts what is on the balance as nothing.
        zero: sets the empty balance's zero; None where only a key does.
        cancel: ends repeated output and commands that wait; None where there is no such command.
        acknowledged: whether tare and zero are answered by a line.
        turn: when this is asked, as long as it isn't known who is there: a question that means nothing to other
            balances comes first, one that they may take for a command last.
        identity: questions that make it say who it is, without ends of lines.
    """

    name: str
    title: str
    query: bytes
    tare: bytes
    lines: tuple[LineSettings, ...] = tuple(LineSettings(baud) for baud in (9600, 19200, 4800, 2400, 1200))
    gap: float = 0.1
    zero: bytes | None = None
    cancel: bytes | None = None
    acknowledged: bool = False
    turn: int = 5
    identity: tuple[str, ...] = ()

    @abstractmethod
    def decode(self, line: bytes) -> Reply:
        """Understand one line.

        Args:
            line: without its CR LF.

        Raises:
            LineError: it is none of this dialect's.
        """

    @abstractmethod
    def encode(self, reading: Reading) -> bytes:
        """The line that a balance of this dialect would send for a reading, CR LF included.

        Raises:
            ValueError: the dialect can't say it.
        """

    def likeness(self, said: Mapping[str, str]) -> int:
        """How much a balance that knew the query is one of this dialect; of those that ask alike the largest wins.

        Args:
            said: what it answered to the questions of `identity`, '' for nothing.
        """
        return 0

    def voices(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """Its side at the far end of the line, for virtual balances: by the dialect's name, and by others for what else
        such balances may be set to."""
        return {self.name: lambda: PlainEncoder(self, self.query, self.tare, self.zero)}


def text_of(line: bytes) -> str | None:
    """A line as text; None where it holds anything but printable ASCII."""
    if any(not 0x20 <= byte < 0x7F for byte in line):
        return None
    return line.decode("ascii")


def number_in(text: str) -> Decimal | None:
    """The number that a text consists of; None where it is anything else."""
    return Decimal(text) if NUMBER.fullmatch(text) else None
