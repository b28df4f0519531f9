"""A balance that answers `?` by `12.3 g`, with an exclamation mark while it moves."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal

from decant.plugins import Dialect, LineError, Reading, ReadingStatus, Reply

_LINE = re.compile(rb"(?P<value>-?[0-9]+\.[0-9]+) (?P<unit>k?g)(?P<moving>!?)")


@dataclass(frozen=True, kw_only=True)
class Plain(Dialect):
    """See the module's text."""

    name: str = "plain"
    title: str = "Example's plain balance"
    query: bytes = b"?\r\n"
    tare: bytes = b"0\r\n"

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        match = _LINE.fullmatch(line)
        if match is None:
            raise LineError("not a weight")
        status = ReadingStatus.UNSTABLE if match["moving"] else ReadingStatus.STABLE
        return Reading(status, Decimal(match["value"].decode()), match["unit"].decode())

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        if reading.value is None:
            raise ValueError("it has no words for what is not a weight")
        moving = "!" if reading.status is ReadingStatus.UNSTABLE else ""
        return f"{reading.value} {reading.unit}{moving}\r\n".encode()


PLAIN = Plain()
