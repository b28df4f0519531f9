"""The interface of a dialect: `Dialect` and its `LineSettings`. Only bytes and values; this module opens no port."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal

from actors.balance.dialects.protocol_encoder import PlainEncoder, ProtocolEncoder
from actors.balance.readings import Reading, Reply

NUMBER = re.compile(r"[+-]?[0-9]{1,10}(?:\.[0-9]{1,9})?")
"""A weight in digits: no exponent, no comma, and a digit on both sides of the point."""

_SIGNED = re.compile(r" *(?P<sign>[+-]?) *(?P<digits>[0-9][0-9.,]*) *")


@dataclass(frozen=True)
class LineSettings:
    """Settings of a serial line.

    Attributes:
        baud: bits per second; 0 for a connection over TCP, which has no settings.
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
        return f"{self.baud} baud {self.format}" if self.baud else "TCP"

    @property
    def character_time(self) -> float:
        """Transmission time of one character [s]."""
        return (1 + self.bits + (self.parity != "N") + self.stop) / self.baud if self.baud else 0.0


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
        acknowledged: whether the balance replies to tare and zero with a line; None: only with a setting of its menu.
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
    acknowledged: bool | None = False
    turn: int = 5
    identity: tuple[str, ...] = ()

    @abstractmethod
    def decode(self, line: bytes) -> Reply:
        """Decode one line.

        Args:
            line: without its CR LF.

        Returns:
            A `Reading` only for the weight itself, or for a status instead of it.

        Raises:
            OtherQuantityError: it carries a tare, a limit, a sum, or another quantity with a mark of its own.
            LineError: it is not a line of this dialect.
        """

    @abstractmethod
    def encode(self, reading: Reading) -> bytes:
        """Return the line that a balance of this dialect sends for a reading, CR LF included.

        Raises:
            ValueError: the dialect has no line for it.
        """

    def likeness(self, answers: Mapping[str, str]) -> int:
        """Score how well a balance that answered the query fits this dialect; among dialects with the same query the
        largest wins.

        Args:
            answers: its replies to the queries of `identity`, '' for none.
        """
        return 0

    def commands_in(self, answers: Mapping[str, str]) -> frozenset[str]:
        """The commands that the balance lists, without line ends; empty if it lists none.

        Args:
            answers: as in `likeness`.
        """
        return frozenset()

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """Protocol encoders for emulated balances: one under the dialect's name, and one per further mode of such
        balances.
        """
        return {self.name: lambda: PlainEncoder(self, self.query, self.tare, self.zero)}


CHANGED = 3
"""Lines of another form in a row after which it counts as the form of this balance, whose range or unit has changed."""

_FIELD = re.compile(rb"(?P<before>[ +-]*)(?P<digits>[0-9]+(?:[.,](?P<decimals>[0-9]+))?)")


class LineForm:
    """Form of the weights of one connection: the column in which the number ends, and its decimals.

    Balances that write numbers to the right of a field end all of them in one column. A line that has lost a byte ends
    elsewhere, or has no decimals. Such a line is refused, unless the form repeats, as after a change of the range.

    Limitations: the form is known from the first number with several blanks before it.
    """

    def __init__(self) -> None:
        self._form: tuple[int, int] | None = None
        self._other: tuple[int, int] | None = None
        self._count = 0

    def keeps(self, line: bytes) -> bool:
        """Whether a line with a weight has the form of the lines before it."""
        match = _FIELD.search(line)
        if match is None:
            return True
        form, padded = (match.end("digits"), len(match["decimals"] or b"")), match["before"].count(b" ") > 1
        if form == self._form:
            self._other = None
            return True
        if self._form is None:
            self._form = form if padded else None
            return True
        self._count = self._count + 1 if form == self._other else 1
        self._other = form
        if self._count < CHANGED:
            return False
        self._form, self._other = form if padded else None, None
        return True


def text_of(line: bytes) -> str | None:
    """Return a line as text; None if it contains anything but printable ASCII."""
    if any(not 0x20 <= byte < 0x7F for byte in line):
        return None
    return line.decode("ascii")


def number_in(text: str) -> Decimal | None:
    """Return the number that makes up the whole text; None for any other text."""
    return Decimal(text) if NUMBER.fullmatch(text) else None


def signed_number(text: str, *, comma: bool = False) -> Decimal | None:
    """Return the number in a field of a line; None for any other text.

    The sign is at the left end of the field or next to the digits, because balances of one protocol differ in it.

    Args:
        text: sign, blanks and digits.
        comma: whether a decimal comma is allowed.
    """
    match = _SIGNED.fullmatch(text)
    if match is None:
        return None
    digits = match["digits"].replace(",", ".") if comma else match["digits"]
    return number_in(match["sign"] + digits)
