"""Sartorius Balance Interface: `ESC P` is answered by a line of 16 characters, or 22 with an identification before it.

```
+    123.45 g  CR LF          sign, 9 of value, blank, 3 of unit
N     +    123.45 g  CR LF    the same after 6 of identification
```

The unit is blank while the weight is unstable. Instead of a value, a line may contain `High`, `Low`, `H`, `L`, `--`,
`Cal.Int.`, `Cal.Ext.`, `C`, or `Err 123`; a 22-character line then begins with `Stat`. Digits outside the verified
(legal-for-trade) range may be in brackets. A line of another width has lost characters and is invalid.

Sources: Sartorius Quintix manual p. 87, Entris II interface description p. 3 and 4, LE2202S p. 51, CP operating
instructions p. 55 (1200 baud 7O1 and printing 'at stability' as factory setting of that series; Entris II: 9600 8O1).

Limitations: commands are not acknowledged. Set 'print: manual, without stability' and no automatic printing in the
menu: with 'at stability', the query is answered only once the weight is stable; with automatic printing, `ESC P`
toggles it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects.dialect import Dialect, LineSettings, number_in, text_of
from actors.balance.dialects.protocol_encoder import (
    END,
    EncoderDisplay,
    PendingReply,
    ProtocolEncoder,
    Said,
    line_of,
    silently,
    weight_line,
)
from actors.balance.readings import LineError, Reading, ReadingStatus, Reply

SHORT, LONG = 14, 20
"""Widths of the two layouts without CR LF."""

_WORDS = {
    "High": ReadingStatus.OVER,
    "H": ReadingStatus.OVER,
    "Low": ReadingStatus.UNDER,
    "L": ReadingStatus.UNDER,
    "--": ReadingStatus.BUSY,
    "Cal.Int.": ReadingStatus.BUSY,
    "Cal.Ext.": ReadingStatus.BUSY,
    "C": ReadingStatus.BUSY,
}
_FAULT = re.compile(r"(?:Err|ERR) *(?P<number>[0-9]{1,4})|(?P<word>(?:APP|DIS|PRT)\.ER)")
_BRACKETS = re.compile(r"\[([0-9]+)\]")


@dataclass(frozen=True, kw_only=True)
class Sbi(Dialect):
    """The dialect; it decodes both layouts.

    Attributes:
        identified: whether `encode` sends lines of 22 characters.
    """

    identified: bool = False
    name: str = "sbi"
    title: str = "Sartorius SBI"
    lines: tuple[LineSettings, ...] = (
        LineSettings(9600),
        LineSettings(1200, bits=7, parity="O"),
        LineSettings(9600, parity="O"),
        LineSettings(9600, bits=7, parity="O"),
        LineSettings(19200),
        LineSettings(1200),
    )
    query: bytes = b"\x1bP\r\n"
    tare: bytes = b"\x1bU\r\n"
    zero: bytes | None = b"\x1bV\r\n"
    turn: int = 0

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        text = text_of(line)
        if text is None:
            raise LineError("not printable ASCII")
        if len(text) == LONG:
            text = text[LONG - SHORT :]
        if len(text) != SHORT:
            raise LineError(f"{len(text)} characters; this dialect's lines have {SHORT} or {LONG}")
        word = text.strip()
        if word in _WORDS:
            return Reading(_WORDS[word], detail=word if word.startswith("C") else "")
        if (fault := _FAULT.fullmatch(word)) is not None:
            return Reading(ReadingStatus.ERROR, detail=f"error {fault['number'] or fault['word']}")
        return _weight(text)

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        status = reading.status
        if status in (ReadingStatus.STABLE, ReadingStatus.UNSTABLE) and reading.value is not None:
            sign = "-" if reading.value < 0 else "+"
            unit = reading.unit if status is ReadingStatus.STABLE else ""
            text, label = f"{sign}{abs(reading.value)!s:>9} {unit:<3}", "N"
        elif status in _SAID:
            text, label = _SAID[status].ljust(8).rjust(SHORT), "Stat"
        elif status is ReadingStatus.ERROR:
            text, label = f"   Err {reading.detail.removeprefix('error ') or '54':<7}", "Stat"
        else:
            raise ValueError(f"no line of this dialect says '{status}'")
        return ((f"{label:<6}" if self.identified else "") + text).encode("ascii") + END

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""
        return {
            self.name: SbiEncoder,
            f"{self.name}-identified": lambda: SbiEncoder(identified=True),
            f"{self.name}-at-stability": lambda: SbiEncoder(at_stability=True),
        }


_SAID = {ReadingStatus.OVER: "High", ReadingStatus.UNDER: "Low", ReadingStatus.BUSY: "--"}


def _weight(text: str) -> Reading:
    """Decode the 14 characters of a weight."""
    sign, digits, unit = text[0], _BRACKETS.sub(r"\1", text[1:11]).strip(), text[11:]
    if sign not in "+- " or not unit.isascii():
        raise LineError("not a weight")
    if "[" in text:  # a bracket replaces the blank before the unit
        digits = digits.strip()
    number = number_in(digits)
    name = unit.strip()
    if number is None or (name and re.fullmatch(r"[A-Za-z%/]{1,3}", name) is None):
        raise LineError("not a weight")
    if sign == "-":
        number = -number
    return Reading(ReadingStatus.STABLE if name else ReadingStatus.UNSTABLE, number, name)


class SbiEncoder:
    """Protocol encoder of Sartorius SBI.

    Args:
        identified: send lines of 22 characters.
        at_stability: answer ESC P only once the weight is stable.
    """

    def __init__(self, *, identified: bool = False, at_stability: bool = False) -> None:
        self.dialect = Sbi(identified=identified)
        self._at_stability = at_stability

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        found = re.findall(rb"\x1b([A-Z]|[a-z][A-Za-z0-9]*_)", bytes(heard))
        tail = bytes(heard).rpartition(b"\x1b")
        begun = tail[1] and re.fullmatch(rb"(?:[a-z][A-Za-z0-9]*)?", tail[2])
        heard[:] = b"\x1b" + tail[2] if begun else b""
        return found

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        if command == b"P" and not self._at_stability:
            return weight_line(self.dialect, display.reading())
        match command:
            case b"P":
                return PendingReply(lambda: weight_line(self.dialect, display.reading()))
            case b"T" | b"U":
                return PendingReply(lambda: silently(display.tare))
            case b"V":
                return PendingReply(lambda: silently(display.zero))
            case b"x1_":
                return line_of("VIRTUAL-SBI")
        return b""


SBI = Sbi()
"""Sartorius SBI."""
