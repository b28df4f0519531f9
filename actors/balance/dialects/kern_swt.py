"""Older Kern balances: single letters `s`, `w`, `t` without CR LF, answered by lines of fixed width.

| line                    | Kern PCB-BA-e-1315, KDE-T-BA_IA-e-1210 | PCB-BA-e-0712, FKB_A-BA-e-1513, 440-BA-e-1744 |
|-------------------------|----------------------------------------|-----------------------------------------------|
| stable                  | 18 bytes: M, sign, 10 of value, blank, 3 of unit | 18                                  |
| unstable                | 18 bytes, the unit blank               | 15, the unit left out                         |
| fault                   | 18 bytes: 11 blanks, `Error`           | 14: 7 blanks, `Error`                         |

The widths include CR LF. The drawings of the second column can also be read as one byte more (19 and 16), so these
widths are accepted too. A line of any other width has lost characters, and a lost digit would give a wrong weight; such
a line is invalid. The sign is in its column or next to the digits (`     -29.186 g  ` was captured from a balance). A
stable line has a unit and an unstable one has none; the unit is the only difference. `=Overload=` may appear instead of
a value. Counts and percentages have the same lines with the units `Pcs` and `%`, which are no mass. Such balances must
be set to remote control ('rE Cr').

Limitations: there is no command for zero, and a tare is not acknowledged.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects.dialect import Dialect, LineSettings, signed_number, text_of
from actors.balance.dialects.protocol_encoder import (
    END,
    EncoderDisplay,
    PendingReply,
    ProtocolEncoder,
    Said,
    silently,
    weight_line,
)
from actors.balance.readings import LineError, Reading, ReadingStatus, Reply

STABLE_WIDTHS = (16, 17)
"""Widths of a stable line without CR LF."""

UNSTABLE_WIDTHS = (13, 14, 16, 17)
"""Widths of an unstable line without CR LF."""

FAULT_WIDTHS = (12, 16)
"""Widths of a fault line without CR LF."""

_LINE = re.compile(r"[ M]?(?P<value> *-? *[0-9.]+) (?P<unit>[A-Za-z%]{0,4}) *")


@dataclass(frozen=True, kw_only=True)
class KernSwt(Dialect):
    """The dialect; it decodes both layouts.

    Attributes:
        short: whether `encode` uses the shorter layout.
    """

    short: bool = False
    name: str = "kern-swt"
    title: str = "older Kern (s/w/t)"
    lines: tuple[LineSettings, ...] = tuple(LineSettings(baud) for baud in (9600, 4800, 2400, 1200, 19200))
    query: bytes = b"w"
    tare: bytes = b"t"
    turn: int = 1

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        text = text_of(line)
        if text is None:
            raise LineError("not printable ASCII")
        if text.strip() == "Error" and len(text) in FAULT_WIDTHS:
            return Reading(ReadingStatus.ERROR)
        if text.strip() == "=Overload=":
            return Reading(ReadingStatus.OVER)
        match = _LINE.fullmatch(text)
        value = signed_number(match["value"]) if match is not None else None
        if match is None or value is None:
            raise LineError("not a weight")
        widths = STABLE_WIDTHS if match["unit"] else UNSTABLE_WIDTHS
        if len(text) not in widths:
            raise LineError(f"{len(text)} characters; a weight has {' or '.join(map(str, widths))}")
        return Reading(ReadingStatus.STABLE if match["unit"] else ReadingStatus.UNSTABLE, value, match["unit"])

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        if reading.status in (ReadingStatus.STABLE, ReadingStatus.UNSTABLE) and reading.value is not None:
            sign = "-" if reading.value < 0 else " "
            head = f" {sign}{abs(reading.value)!s:>10} "
            stable = reading.status is ReadingStatus.STABLE
            text = head + (f"{reading.unit:<3}" if stable else "" if self.short else "   ")
        elif reading.status is ReadingStatus.OVER:
            text = "=Overload=".rjust(16)
        elif reading.status is ReadingStatus.ERROR:
            text = "Error".rjust(12 if self.short else 16)
        else:
            raise ValueError(f"no line of this dialect says '{reading.status}'")
        return text.encode("ascii") + END

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""
        return {self.name: KernSwtEncoder, f"{self.name}-short": lambda: KernSwtEncoder(short=True)}


class KernSwtEncoder:
    """Protocol encoder of older Kern balances.

    Args:
        short: send lines of 15 and 14 bytes instead of 18.
    """

    def __init__(self, *, short: bool = False) -> None:
        self.dialect = KernSwt(short=short)

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        letters = [bytes([byte]) for byte in heard if byte in b"swt"]
        heard.clear()
        return letters

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        if command == b"w":
            return weight_line(self.dialect, display.reading())
        if command == b"s":
            return PendingReply(lambda: weight_line(self.dialect, display.reading()))
        return PendingReply(lambda: silently(display.tare)) if command == b"t" else b""


KERN_SWT = KernSwt()
"""Older Kern balances."""
