"""Radwag: `SI` is answered by a line of 20 characters, and commands by two lines.

| columns | content                                                                             |
|---------|-------------------------------------------------------------------------------------|
| 1–3     | the command: `SI`, `S`, `SU` or `SUI`                                               |
| 5       | blank: stable, `?`: unstable, `^`: over range, `v`: under range                     |
| 7       | blank or `-`; the `-` may also be next to the digits                                |
| 8–16    | number, right-aligned                                                               |
| 18–20   | unit, left-aligned                                                                  |

Columns 4, 6 and 17 are blank. A line of another width has lost characters and is invalid. Lines that begin with another
command are other quantities (`OTHERS`): `OT` is the tare, `ODH` and `OUH` are limits. `T` and `Z` are answered by `T A`
(understood) and then `T D` (done), `T ^`, `T v`, or `T E` (not at rest in time); `T I` means not now, and `ES` an
unknown command. Source: communication protocol in Radwag's PS, PS R2, AS R2, WTC and PUE C41H manuals. Factory setting
of most: 9600 baud 8N1.

Limitations: no line reports a fault.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal

from actors.balance.dialects.dialect import Dialect, signed_number, text_of
from actors.balance.dialects.protocol_encoder import (
    Cancel,
    CommandEncoder,
    EncoderDisplay,
    PendingReply,
    ProtocolEncoder,
    Repeat,
    Said,
    line_of,
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
)

WIDTH = 20
_LINE = re.compile(
    r"(?:SI |S  |SU |SUI) (?P<state>[ ?^v]) (?P<sign>[ -])(?P<value>[ 0-9.-]{8}[0-9]) (?P<unit>[A-Za-z%]{0,3}) *"
)
_OTHER = re.compile(r"(?P<command>[A-Z]{2,3}) +\S")
OTHERS = {
    **dict.fromkeys(("OT", "UT"), "the tare"),
    **dict.fromkeys(("ODH", "DH"), "the lower limit of check weighing"),
    **dict.fromkeys(("OUH", "UH"), "the upper limit of check weighing"),
    "SIA": "a line for several platforms",
    "SM": "the mass of a piece",
    "TV": "a target",
    "RM": "a reference",
    "BN": "the type",
    "FS": "the capacity",
    "RV": "the version of the program",
}
"""First words of lines with other quantities."""

_STATES = {
    " ": ReadingStatus.STABLE,
    "?": ReadingStatus.UNSTABLE,
    "^": ReadingStatus.OVER,
    "v": ReadingStatus.UNDER,
}
_MARKS = {status: mark for mark, status in _STATES.items()}
_ANSWERS = {
    "A": ReadingReply.BEGUN,
    "D": ReadingReply.DONE,
    "OK": ReadingReply.DONE,
    "I": ReadingReply.BUSY,
    "E": ReadingReply.BUSY,
    "^": ReadingReply.OVER,
    "v": ReadingReply.UNDER,
}
_READINGS = {
    "I": ReadingStatus.BUSY,
    "E": ReadingStatus.BUSY,
    "^": ReadingStatus.OVER,
    "v": ReadingStatus.UNDER,
}
_ANSWER = re.compile(r"(?P<command>T|Z|S|SI|SU|SUI|C0|C1|NB) (?P<answer>A|D|OK|I|E|\^|v)(?: +(?P<text>\S.*))?")


@dataclass(frozen=True, kw_only=True)
class Radwag(Dialect):
    """The dialect; see the module docstring."""

    name: str = "radwag"
    title: str = "Radwag"
    query: bytes = b"SI\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    cancel: bytes | None = b"C0\r\n"
    acknowledged: bool | None = True
    turn: int = 2
    identity: tuple[str, ...] = ("NB",)

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        text = text_of(line)
        if text is None:
            raise LineError("not printable ASCII")
        if text.strip() == "ES":
            return Acknowledgement("", ReadingReply.REFUSED, "it does not know the command (ES)")
        if (answer := _ANSWER.fullmatch(text.strip())) is not None:
            if answer["command"].startswith("S") and (status := _READINGS.get(answer["answer"])) is not None:
                return Reading(status)
            return Acknowledgement(answer["command"], _ANSWERS[answer["answer"]], answer["text"] or "")
        if (other := _OTHER.match(text)) is not None and other["command"] in OTHERS:
            raise OtherQuantityError(f"{OTHERS[other['command']]} ('{other['command']}')")
        match = _LINE.fullmatch(text) if len(text) == WIDTH else None
        if match is None:
            raise LineError("neither a weight nor an answer to a command")
        status = _STATES[match["state"]]
        if status in (ReadingStatus.OVER, ReadingStatus.UNDER):
            return Reading(status)
        value = signed_number(match["sign"] + match["value"])
        if value is None:
            raise LineError("not a weight")
        return Reading(status, value, match["unit"])

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        if reading.status not in _MARKS:
            raise ValueError(f"no line of this dialect says '{reading.status}'")
        value = Decimal(0) if reading.value is None else reading.value
        sign = "-" if value < 0 else " "
        return line_of(f"SI  {_MARKS[reading.status]} {sign}{abs(value)!s:>9} {reading.unit:<3}")

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""
        marks = {ReadingStatus.STABLE: "D", ReadingStatus.OVER: "^", ReadingStatus.UNDER: "v"}

        def at_once(display: EncoderDisplay) -> bytes:
            return weight_line(self, display.reading())

        def once_stable(display: EncoderDisplay) -> PendingReply:
            return PendingReply(lambda: b"S " + at_once(display)[2:], line_of("S E"), first=line_of("S A"))

        def tare(display: EncoderDisplay) -> PendingReply:
            return PendingReply(lambda: line_of(f"T {marks[display.tare()]}"), line_of("T E"), first=line_of("T A"))

        def zero(display: EncoderDisplay) -> PendingReply:
            return PendingReply(lambda: line_of(f"Z {marks[display.zero()]}"), line_of("Z E"), first=line_of("Z A"))

        answers: dict[str, Callable[[EncoderDisplay], Said]] = {
            **dict.fromkeys(("SI", "SUI"), at_once),
            **dict.fromkeys(("S", "SU"), once_stable),
            **dict.fromkeys(("C1", "CU1"), lambda display: Repeat(interval=0.1)),
            **dict.fromkeys(("C0", "CU0"), lambda display: Cancel(line_of("C0 A"))),
            "T": tare,
            "Z": zero,
            "NB": lambda display: line_of('NB A "123456"'),
        }
        return {self.name: lambda: CommandEncoder(self, answers, line_of("ES"))}


RADWAG = Radwag()
"""Radwag."""
