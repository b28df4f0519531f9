"""The interface of a dialect, `Dialect` with its `LineSettings`, and the plug-in registry of balances.

A dialect handles bytes and values only; this module opens no port. `BALANCES` registers dialects of serial lines and
settings of drivers, built-in and installed.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from actors.balance.dialects.protocol_encoder import PlainEncoder, ProtocolEncoder
from actors.balance.readings import Reading, Reply
from sim_engine.settings.plugin_registry import PluginRegistry

NUMBER = re.compile(r"[+-]?[0-9]{1,10}(?:\.[0-9]{1,9})?")
"""A weight in digits: no exponent, no comma, and a digit on both sides of the point."""


@dataclass(frozen=True)
class LineSettings:
    """Settings of a serial line.

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
        """Character format, e.g. '8N1'."""
        return f"{self.bits}{self.parity}{self.stop}"

    def __str__(self) -> str:
        return f"{self.baud} baud {self.format}"

    @property
    def character_time(self) -> float:
        """Transmission time of one character [s]."""
        return (1 + self.bits + (self.parity != "N") + self.stop) / self.baud


@dataclass(frozen=True, kw_only=True)
class Dialect(ABC):
    """A dialect: a class without state in a file of its own. Its one instance is registered in the plug-in registry
    `decant.balances` under its `name`.

    Attributes:
        name: in files: 'kcp'.
        title: for messages: 'Kern KCP'.
        lines: usual line settings of such balances, the most likely first.
        gap: shortest time between two queries [s].
        query: requests the display's current weight.
        tare: tares the balance.
        zero: sets the empty balance's zero; None if only a key does.
        cancel: ends repeated output and waiting commands; None if there is no such command.
        acknowledged: whether the balance replies to tare and zero with a line.
        turn: order of the query during detection. A query without meaning to other balances comes first, one that they
            may take for a command comes last.
        identity: queries that return the balance's identification, without line ends.
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
        """Decode one line.

        Args:
            line: without its CR LF.

        Raises:
            LineError: it is not a line of this dialect.
        """

    @abstractmethod
    def encode(self, reading: Reading) -> bytes:
        """Return the line that a balance of this dialect sends for a reading, CR LF included.

        Raises:
            ValueError: the dialect has no line for it.
        """

    def likeness(self, said: Mapping[str, str]) -> int:
        """Score how well a balance that answered the query fits this dialect; among dialects with the same query the
        largest wins.

        Args:
            said: its replies to the queries of `identity`, '' for none.
        """
        return 0

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """Protocol encoders for emulated balances: one under the dialect's name, and one per further mode of such
        balances.
        """
        return {self.name: lambda: PlainEncoder(self, self.query, self.tare, self.zero)}


def text_of(line: bytes) -> str | None:
    """Return a line as text; None if it contains anything but printable ASCII."""
    if any(not 0x20 <= byte < 0x7F for byte in line):
        return None
    return line.decode("ascii")


def number_in(text: str) -> Decimal | None:
    """Return the number that makes up the whole text; None for any other text."""
    return Decimal(text) if NUMBER.fullmatch(text) else None


def _balance(loaded: Any, name: str) -> Dialect | type[Any]:
    found: Dialect | type[Any]
    if isinstance(loaded, Dialect):
        found, called = loaded, loaded.name
    elif isinstance(loaded, type) and callable(getattr(loaded, "driver", None)) and hasattr(loaded, "model_fields"):
        found, called = loaded, loaded.model_fields["kind"].default
    else:
        raise TypeError("should be an instance of a Dialect, or a class of settings with a method 'driver'")
    if called != name:
        raise ValueError(f"it calls itself '{called}', which should be the name that it is registered under")
    return found


BALANCES: PluginRegistry[Dialect | type[Any]] = PluginRegistry("decant.balances", "balance", _balance)
"""All installed balances: instances of dialects, and subclasses of `BalanceSettings`."""


def dialects() -> dict[str, Dialect]:
    """Dialects by the names that files use."""
    return {name: found for name, found in BALANCES.all.items() if isinstance(found, Dialect)}


def kinds() -> dict[str, type[Any]]:
    """Settings of drivers by the names that files use."""
    return {name: found for name, found in BALANCES.all.items() if isinstance(found, type)}


def encoders() -> dict[str, Callable[[], ProtocolEncoder]]:
    """Protocol encoders for emulated balances, by name: one per dialect, and one per further mode of such balances."""
    return {name: encoder for dialect in dialects().values() for name, encoder in dialect.encoders().items()}
