"""Ohaus: `IP` is answered by a number in ten columns, a unit, and `?` while it moves.

```
    192.21 g                 10 characters, right-aligned; blank; unit of up to 5
      0.01 g     ?           blank and `?` if unstable; perhaps a word such as NET after it
```

A number that ends in another column has lost characters; such a line is invalid. Older models have 11 or 12 columns,
which are accepted too. Units are left-aligned in five characters or sent without padding.

Commands: `IP` at once, `P` (`SP` once stable), `CP` repeated, `0P` ends it, `T` tare, `Z` zero. An unknown command, or
40 s without a stable weight, is answered by `ES`. `OK!` confirms a command of some models. Sources: Ohaus Explorer
operating instructions (output format, `ES`), RS232 interface manual (older columns, `IP`). Factory settings: 9600 baud
8N1; older models 2400 baud 7N2.

Limitations: no source states the line of an overload; it is taken to be the display's `Err 8.3` (under range 8.4).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects.dialect import Dialect, LineSettings, number_in, text_of
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
from actors.balance.readings import Acknowledgement, LineError, Reading, ReadingReply, ReadingStatus, Reply

COLUMNS = (10, 11, 12)
"""Columns in which a number may end."""

_LINE = re.compile(
    r"(?P<field> *(?P<value>-? *[0-9.]+)) (?P<unit>[A-Za-z%]{0,5}) *(?P<moving>\??)(?: +[A-Z/]{1,10})? *"
)
_ERROR = re.compile(r"Err(?:or)? *(?P<number>[0-9]{1,2}(?:\.[0-9]{1,2})?)")
_OUTSIDE = {"8.3": ReadingStatus.OVER, "8.4": ReadingStatus.UNDER}
_ANSWERS = {
    "OK!": Acknowledgement("", ReadingReply.DONE),
    "ES": Acknowledgement("", ReadingReply.REFUSED, "it does not know the command, or was not at rest for 40 s (ES)"),
}


@dataclass(frozen=True, kw_only=True)
class Ohaus(Dialect):
    """The dialect; see the module docstring."""

    name: str = "ohaus"
    title: str = "Ohaus"
    lines: tuple[LineSettings, ...] = (
        LineSettings(9600),
        LineSettings(2400, bits=7, stop=2),
        LineSettings(19200),
        LineSettings(4800),
        LineSettings(2400),
    )
    query: bytes = b"IP\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    cancel: bytes | None = b"0P\r\n"
    acknowledged: bool | None = None
    turn: int = 4

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        text = text_of(line)
        if text is None:
            raise LineError("not printable ASCII")
        word = text.strip()
        if word in _ANSWERS:
            return _ANSWERS[word]
        if (error := _ERROR.fullmatch(word)) is not None:
            number = error["number"]
            return Reading(_OUTSIDE.get(number, ReadingStatus.ERROR), detail=f"error {number}")
        match = _LINE.fullmatch(text)
        value = number_in(match["value"].replace(" ", "")) if match is not None else None
        if match is None or value is None:
            raise LineError("not a weight")
        if len(match["field"]) not in COLUMNS:
            raise LineError(f"the number ends in column {len(match['field'])}; it has lost characters")
        status = ReadingStatus.UNSTABLE if match["moving"] else ReadingStatus.STABLE
        return Reading(status, value, match["unit"])

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        match reading.status:
            case ReadingStatus.STABLE | ReadingStatus.UNSTABLE if reading.value is not None:
                moving = "?" if reading.status is ReadingStatus.UNSTABLE else " "
                return line_of(f"{reading.value!s:>10} {reading.unit:<5} {moving}")
            case ReadingStatus.OVER | ReadingStatus.UNDER:
                return line_of(f"Err {'8.3' if reading.status is ReadingStatus.OVER else '8.4'}")
            case ReadingStatus.ERROR:
                return line_of(f"Err {reading.detail.removeprefix('error ') or '9.5'}")
        raise ValueError(f"no line of this dialect says '{reading.status}'")

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""

        def at_once(display: EncoderDisplay) -> bytes:
            return weight_line(self, display.reading())

        def once_stable(display: EncoderDisplay) -> PendingReply:
            return PendingReply(lambda: weight_line(self, display.reading()), line_of("ES"), 40.0)

        answers: dict[str, Callable[[EncoderDisplay], Said]] = {
            "IP": at_once,
            **dict.fromkeys(("P", "SP"), once_stable),
            "CP": lambda display: Repeat(),
            "0P": lambda display: Cancel(b""),
            "T": lambda display: PendingReply(lambda: silently(display.tare)),
            "Z": lambda display: PendingReply(lambda: silently(display.zero)),
        }
        return {self.name: lambda: CommandEncoder(self, answers, line_of("ES"))}


OHAUS = Ohaus()
"""Ohaus."""
