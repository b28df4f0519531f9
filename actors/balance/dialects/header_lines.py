"""Lines of the form `ST,GS,+  123.4 g`: a header for stability, perhaps one for gross or net, sign, number, unit.

Many makers use such lines. `decode` accepts all of them:

| line                      | sender                                                          |
|---------------------------|-----------------------------------------------------------------|
| `ST,+00123.45  g`         | A&D; also `US`, `QT` (stable count of pieces), `OL`             |
| `ST,GS   1.000KG`         | Kern KFB-TM and KFN-TM, continuous or on request                |
| `ST,G,   1.000kg`         | Kern GAB-N                                                      |
| `ST,NT,+  4.876kg`        | indicators of A&D, T-Scale, Jadever and their copies            |

`ST` is stable and `US` unstable. The second header is `GS` or `G` (gross), `NT` or `N` (net), or the result of a
comparison (`HI`, `OK`, `LO`, `--`). Lines with any other header are other quantities: `TR`, `T`, `TW` (tare), `PT`
(preset tare), `UW` (unit weight), and so on (`OTHERS`). `QT` is a count. `A_AND_D` and `KERN_CONTINUOUS` differ in
their commands.

Sources: A&D's command tables (`Q` and `SI` at once, `S` once stable, `SIR` repeated, `C` cancels, `R` or `Z` re-zero,
`T` tare; with 'error code' on, `AK` and `EC,E01`); A&D EK-L p. 28 (units, `OL` with a unit), GC p. 51 (comparison),
MC-10K p. 36 (tare, date, data number), AD-4406 p. 47 (`TR`), Kern's KFB-TM, KFN-TM and GAB-N operating instructions
(`S`, `W`, `T`, `Z`, `P`; `TW`, `NO`, `TOTAL`), Tiger TI-02-P p. 21 (comma before the unit). Factory settings: A&D 2400
baud 7E1, Kern 9600 baud 8N1. No source was found for the end of Kern's commands; the driver sends CR LF.

Limitations: the lines carry no checksum and, except for A&D's, no fixed width. A line that lost a digit on the way is
another weight; `LineForm` refuses it if a number before it had blanks in front, otherwise only the agreement of several
readings protects from it. No line reports a fault.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from actors.balance.dialects.dialect import Dialect, LineSettings, signed_number, text_of
from actors.balance.dialects.protocol_encoder import (
    Cancel,
    CommandEncoder,
    EncoderDisplay,
    PendingReply,
    ProtocolEncoder,
    Repeat,
    Said,
    line_of,
    silently,
    weight_line,
)
from actors.balance.readings import (
    Acknowledgement,
    LineError,
    OtherQuantityError,
    Reading,
    ReadingReply,
    ReadingStatus,
    Reply,
    WeightMark,
    kilograms,
)

_LINE = re.compile(
    r"(?P<state>ST|US|QT) *, *(?:(?P<load>[A-Z]{1,3}|--)(?![A-Za-z]) *,? *)?"
    r"(?P<number>[+-]? *[0-9]+(?:[.,][0-9]+)?)(?: *, *(?=[A-Za-z%]))? *(?P<unit>[A-Za-z%]{0,4}) *"
)
_OUTSIDE = re.compile(r"OL *,[ A-Za-z%0-9.,+-]*")
_HEADED = re.compile(r"(?P<name>[A-Z]{1,5}) *[,:] *\S.*")
_MARKED = re.compile(rb"..,[GN]")
_FAILED = re.compile(r"EC *, *E(?P<number>[0-9]{1,3})")

ACKNOWLEDGED = b"\x06"
"""A&D's AK."""

_FAILURES = {1: "it does not know the command", 4: "too many characters", 6: "a format error", 7: "a wrong parameter"}
_NOT_NOW = (2, 3, 11)
"""Errors of A&D that may end by themselves: not ready, timed out, not stable."""

COMPARISONS = ("HI", "OK", "LO", "--")
"""Second headers with the result of a comparison."""

MARKS: dict[str | None, WeightMark | None] = {
    **dict.fromkeys(("GS", "G", "GW"), WeightMark.GROSS),
    **dict.fromkeys(("NT", "N", "NW"), WeightMark.NET),
    None: None,
    **dict.fromkeys(COMPARISONS),
}
"""Second headers of a weight; None for a line without one."""

OTHERS = {
    **dict.fromkeys(("TR", "T", "TW", "TA"), "the tare"),
    "PT": "the preset tare",
    "UW": "the unit weight of a count",
    **dict.fromkeys(("AQ", "TQ"), "a total count"),
    **dict.fromkeys(("AN", "NO"), "the number of weighings"),
    **dict.fromkeys(("TOTAL", "SUM", "TL"), "a total"),
    **dict.fromkeys(("MAX", "MIN", "AVE", "SD", "CV", "R"), "a statistical value"),
    **dict.fromkeys(("ID", "SN", "TN", "FN"), "an identification"),
    "MR": "a memory",
    "DT": "a date",
    "TM": "a time",
}
"""Headers of other quantities."""

WIDTH = 15
"""Narrowest line of A&D's; a narrower one has lost characters."""


def decode(line: bytes) -> Reply:
    """Decode one line.

    Args:
        line: without its CR LF.

    Raises:
        LineError: it is not such a line.
    """
    if line == ACKNOWLEDGED:
        return Acknowledgement("", ReadingReply.DONE)
    text = text_of(line)
    if text is None:
        raise LineError("not printable ASCII")
    text = text.strip()
    if _OUTSIDE.fullmatch(text):
        return Reading(ReadingStatus.UNDER if re.search(r"[, ]-", text) else ReadingStatus.OVER)
    if (failed := _FAILED.fullmatch(text)) is not None:
        number = int(failed["number"])
        answer = ReadingReply.BUSY if number in _NOT_NOW else ReadingReply.REFUSED
        return Acknowledgement("", answer, f"{text} ({_FAILURES.get(number, 'see its manual')})")
    match = _LINE.fullmatch(text)
    value = signed_number(match["number"], comma=True) if match is not None else None
    if match is None or value is None:
        if (headed := _HEADED.fullmatch(text)) is not None and headed["name"] in OTHERS:
            raise OtherQuantityError(f"{OTHERS[headed['name']]} ('{headed['name']}')")
        raise LineError("neither a weight nor an answer to a command")
    if match["load"] not in MARKS:
        raise OtherQuantityError(f"{OTHERS.get(match['load'], 'an unknown quantity')} ('{match['load']}')")
    if match["state"] == "QT" and kilograms(match["unit"]) is not None:
        raise OtherQuantityError("a number of pieces ('QT')", "Switch its counting mode off")
    status = ReadingStatus.UNSTABLE if match["state"] == "US" else ReadingStatus.STABLE
    return Reading(status, value, match["unit"], mark=MARKS[match["load"]])


_HEADERS = {ReadingStatus.STABLE: "ST", ReadingStatus.UNSTABLE: "US"}


@dataclass(frozen=True, kw_only=True)
class AAndD(Dialect):
    """Balances of A&D; see the module docstring."""

    name: str = "a-and-d"
    title: str = "A&D"
    lines: tuple[LineSettings, ...] = (
        LineSettings(2400, bits=7, parity="E"),
        LineSettings(9600),
        LineSettings(9600, bits=7, parity="E"),
        LineSettings(19200),
        LineSettings(4800, bits=7, parity="E"),
    )
    query: bytes = b"SI\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    cancel: bytes | None = b"C\r\n"
    acknowledged: bool | None = None
    turn: int = 2

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`; lines with a second header belong to `KernContinuous`."""
        reply = decode(line)
        width = WIDTH + 3 * (text_of(line[3:5]) in COMPARISONS)
        if isinstance(reply, Reading) and (len(line) < width or _MARKED.match(line)):
            raise LineError(f"{len(line)} characters, or gross and net; a weight has at least {width} and neither")
        return reply

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        if reading.status in _HEADERS and reading.value is not None:
            sign = "-" if reading.value < 0 else "+"
            return line_of(f"{_HEADERS[reading.status]},{sign}{abs(reading.value)!s:0>8}{reading.unit:>3}")
        if reading.status in (ReadingStatus.OVER, ReadingStatus.UNDER):
            return line_of(f"OL,{'+' if reading.status is ReadingStatus.OVER else '-'}9999999E+19")
        raise ValueError(f"no line of this dialect says '{reading.status}'")

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`; the second has 'error code' switched on."""
        return {self.name: lambda: _a_and_d(self), f"{self.name}-error-code": lambda: _a_and_d(self, codes=True)}


@dataclass(frozen=True, kw_only=True)
class KernContinuous(Dialect):
    """Kern's continuous output and its copies; see the module docstring.

    Attributes:
        layout: of `encode`: 'kern', 'gab' or 'indicator', as in the module's table.
        net: whether `encode` sends a net weight.
    """

    layout: str = "kern"
    net: bool = False
    name: str = "kern-continuous"
    title: str = "Kern continuous (ST,GS)"
    query: bytes = b"W\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    acknowledged: bool | None = None
    turn: int = 3

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        return decode(line)

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        load = "NT" if self.net else "GS"
        if reading.status in _HEADERS and reading.value is not None:
            head, number = _HEADERS[reading.status], reading.value
            sign, digits = "-" if number < 0 else "+", abs(number)
            match self.layout:
                case "gab":
                    return line_of(f"{head},{load[0]},{sign.replace('+', ' ')}{digits!s:>7} {reading.unit}")
                case "indicator":
                    return line_of(f"{head},{load},{sign}{digits!s:>7}{reading.unit}")
            return line_of(f"{head},{load}{number!s:>8}{'KG' if reading.unit == 'kg' else reading.unit}")
        if reading.status in (ReadingStatus.OVER, ReadingStatus.UNDER):
            return line_of(f"OL,{load},{'+' if reading.status is ReadingStatus.OVER else '-'}999999")
        raise ValueError(f"no line of this dialect says '{reading.status}'")

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`; one per layout."""
        return {
            self.name: lambda: _kern(self),
            f"{self.name}-gab": lambda: _kern(replace(self, layout="gab")),
            f"{self.name}-indicator": lambda: _kern(replace(self, layout="indicator")),
        }


def _a_and_d(dialect: AAndD, *, codes: bool = False) -> ProtocolEncoder:
    done = ACKNOWLEDGED + b"\r\n" if codes else b""

    def at_once(display: EncoderDisplay) -> bytes:
        return weight_line(dialect, display.reading())

    def once_stable(display: EncoderDisplay) -> PendingReply:
        return PendingReply(lambda: weight_line(dialect, display.reading()))

    def rezero(display: EncoderDisplay) -> PendingReply:
        def act() -> bytes:
            if display.zero() is not ReadingStatus.STABLE:  # beyond its zero range, this key tares
                display.tare()
            return done

        return PendingReply(act, first=done)

    def tare(display: EncoderDisplay) -> PendingReply:
        return PendingReply(lambda: silently(display.tare) + done, first=done)

    answers: dict[str, Callable[[EncoderDisplay], Said]] = {
        **dict.fromkeys(("Q", "SI"), at_once),
        "S": once_stable,
        "SIR": lambda display: Repeat(interval=0.1),
        "C": lambda display: Cancel(b""),
        **dict.fromkeys(("R", "Z"), rezero),
        "T": tare,
    }
    return CommandEncoder(dialect, answers, line_of("EC,E01") if codes else b"")


def _kern(dialect: KernContinuous) -> ProtocolEncoder:
    def line(display: EncoderDisplay) -> bytes:
        return weight_line(replace(dialect, net=bool(display.scale.tared)), display.reading())

    answers: dict[str, Callable[[EncoderDisplay], Said]] = {
        "W": line,
        "S": lambda display: PendingReply(lambda: line(display)),
        "T": lambda display: PendingReply(lambda: silently(display.tare)),
        "Z": lambda display: PendingReply(lambda: silently(display.zero)),
    }
    return CommandEncoder(dialect, answers)


A_AND_D = AAndD()
"""A&D."""

KERN_CONTINUOUS = KernContinuous()
"""Kern's continuous output, and its copies."""
