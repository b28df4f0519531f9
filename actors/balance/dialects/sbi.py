"""Sartorius Balance Interface: `ESC P` is answered by a line of 16 characters, or 22 with an identification before it.

```
+    123.45 g  CR LF          sign, 9 of value, blank, 3 of unit
N     +    123.45 g  CR LF    the same after 6 of identification
```

The unit is blank while the weight is unstable. Only a line with the identification `N` (net), `G#` (gross) or blanks
carries the weight; all others (`IDENTIFICATIONS`) are other quantities: tares, limits, counts, sums, references.

Instead of a value, a line may contain `High`, `Low`, `H`, `L`, `HH`, `LL` (the range of check weighing), `--`,
`Cal.Int.`, `Cal.Ext.`, `C`, or `Err 123`; a 22-character line then begins with `Stat`. Digits outside the verified
(legal-for-trade) range may be in brackets. The decimal point may be a comma, by the balance's menu. A line of another
width has lost characters and is invalid.

Sources: Sartorius Quintix manual p. 87, Entris II interface description p. 3 and 4, LE2202S p. 51, CP operating
instructions p. 55 (1200 baud 7O1 and printing 'at stability' as factory setting of that series; Entris II: 9600 8O1).
Identifications: Combics 1 p. 98, Combics CAW1P p. 106 (with the decimal comma), FB p. 66 (`HH`, `LL`), FC p. 103,
ME215S p. 135.

Limitations: commands are not acknowledged. Set 'print: manual, without stability' and no automatic printing in the
menu: with 'at stability', the query is answered only once the weight is stable; with automatic printing, `ESC P`
toggles it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from actors.balance.dialects.dialect import Dialect, LineSettings, signed_number, text_of
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
from actors.balance.readings import LineError, OtherQuantityError, Reading, ReadingStatus, Reply, WeightMark

SHORT, LONG = 14, 20
"""Widths of the two layouts without CR LF."""

_WORDS = {
    **dict.fromkeys(("High", "H", "HH"), ReadingStatus.OVER),
    **dict.fromkeys(("Low", "L", "LL"), ReadingStatus.UNDER),
    "--": ReadingStatus.BUSY,
    "Cal.Int.": ReadingStatus.BUSY,
    "Cal.Ext.": ReadingStatus.BUSY,
    "C": ReadingStatus.BUSY,
}
_FAULT = re.compile(r"(?:Err|ERR|E) *(?P<number>[0-9]{1,4})|(?P<word>(?:APP|DIS|PRT)\.ER)")
_BRACKETS = re.compile(r"\[([0-9]+)\]")

WEIGHTS = {"": None, "N": WeightMark.NET, "G#": WeightMark.GROSS}
"""Identifications of the weight."""

STATUS = "Stat"
"""Identification of a line with a word instead of a value."""

IDENTIFICATIONS = {
    **dict.fromkeys(("T", "T1"), "the application tare memory 1"),
    "T2": "the application tare memory 2",
    "PT2": "the preset tare",
    "Cont.T": "the contents of the tare memory",
    "N1": "the net weight after an application tare",
    "*G": "the sum of gross weights",
    "*N": "the sum of net weights",
    **dict.fromkeys(("Total", "Tot.cp", "Tot. cp", "S-Comp"), "a total"),
    **dict.fromkeys(("Nom", "Nom.", "Targ."), "the nominal value of the adjustment weight"),
    "Diff": "the difference from the adjustment weight, or between maximum and minimum",
    "Setp": "the target of check weighing",
    "Max": "the upper limit of check weighing",
    "Min": "the lower limit of check weighing",
    **dict.fromkeys(("W.Diff", "Diff.W"), "the difference from the target of check weighing"),
    "Lim": "the deviation from the target of check weighing in per cent",
    "Qnt": "a number of pieces",
    "nRef": "the number of reference pieces",
    "pRef": "the reference percentage",
    "wRef": "the weight of a reference piece",
    "Prc": "a percentage",
    "D": "a loss in per cent",
    "mDef": "the target of animal weighing",
    "Mul": "the factor of animal weighing",
    **dict.fromkeys(("x-Net", "x-Res"), "the result of animal weighing"),
    "Res": "a calculated result",
    "Avg": "an average",
    "Avg.": "an average",
    "s": "a standard deviation",
    "srel": "a coefficient of variation",
    "n": "a counter",
    "NUM": "a typed number",
    "Time": "a time",
    **dict.fromkeys(("ID", "L ID", "S ID", "W ID", "Ser.no"), "an identification"),
}
"""Identifications of other quantities."""

_NUMBERED = {
    re.compile(r"Co?mpx*[0-9]*"): "a component of a formulation",
    re.compile(r"W[0-9x]+%"): "the reference weight of a percentage",
    re.compile(r"(?:Class|Lim)[0-9x]+"): "a class of weights",
}
_REMEDY = "Reduce its print-out to the weight in its menu"


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
        if len(text) not in (SHORT, LONG):
            raise LineError(f"{len(text)} characters; this dialect's lines have {SHORT} or {LONG}")
        name, text = text[:-SHORT].strip(), text[-SHORT:]
        if name not in WEIGHTS and name != STATUS:
            raise _other(name, text)
        word = text.strip()
        if word in _WORDS:
            return Reading(_WORDS[word], detail=word if word.startswith("C") else "")
        if (fault := _FAULT.fullmatch(word)) is not None:
            return Reading(ReadingStatus.ERROR, detail=f"error {fault['number'] or fault['word']}")
        weight = _weight(text)
        if name == STATUS:
            raise OtherQuantityError("a status")
        return replace(weight, mark=WEIGHTS[name])

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
    number = signed_number(_BRACKETS.sub(r"\1", text[:11]), comma=True)  # a bracket replaces the blank before the unit
    name = text[11:].strip()
    if number is None or (name and re.fullmatch(r"[A-Za-z%/]{1,3}", name) is None):
        raise LineError("not a weight")
    return Reading(ReadingStatus.STABLE if name else ReadingStatus.UNSTABLE, number, name)


def _other(name: str, text: str) -> LineError:
    """Return the error for a line with another identification."""
    word = IDENTIFICATIONS.get(name) or next((word for form, word in _NUMBERED.items() if form.fullmatch(name)), "")
    if not word:
        try:
            _weight(text)
        except LineError as error:
            return error
    return OtherQuantityError(f"{word or 'an unknown quantity'} ('{name}')", _REMEDY)


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
        letters = re.findall(rb"\x1b([A-Z]|[a-z][A-Za-z0-9]*_)", bytes(heard))
        tail = bytes(heard).rpartition(b"\x1b")
        begun = tail[1] and re.fullmatch(rb"(?:[a-z][A-Za-z0-9]*)?", tail[2])
        heard[:] = b"\x1b" + tail[2] if begun else b""
        return letters

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
