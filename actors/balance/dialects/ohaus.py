"""Ohaus: `IP` is answered by a number, a unit, `?` while it moves, and perhaps a legend.

| number ends in column | then                                                        | models                       |
|-----------------------|-------------------------------------------------------------|------------------------------|
| 10                    | blank, unit, blank, `?` if unstable, blank, legend          | Explorer, Navigator, Ranger  |
| 11 or 12              | the same; older models                                      | Scout Pro                    |
| 11                    | unit right-aligned in 5, blank perhaps, `?`, blank, legend  | Scout, Defender 5000         |
| 9                     | unit left-aligned in 5 and `?`: 16 characters in all        | Adventurer                   |
| 8                     | unit left-aligned in 5, `?`, legend                         | Defender 3000                |

A number that ends in another column, or in a line of another layout, has lost characters; such a line is invalid. In
the first two layouts units are left-aligned in five characters or sent without padding.

The legend says what the number is: `G` or `B/G` gross, `N` or `NET` net, `T` the tare, `PT` the preset tare, `TOTAL` a
sum. Only gross, net and no legend are weights. `Under`, `Accept` and `Over` are results of check weighing.

Commands: `IP` at once, `P` (`SP` once stable), `CP` repeated, `0P` ends it, `T` tare, `Z` zero. An unknown command, or
40 s without a stable weight, is answered by `ES`. `OK!` confirms a command of some models. Sources: Ohaus Explorer
operating instructions (output format, `ES`), RS232 interface manual (older columns, `IP`), Defender 3000 p. 35,
Defender 5000 p. 51 (legends), Scout interface manual p. 5 (format 3), Ranger RC p. 36. Captures in public drivers:
`       0.01     g     ` (Scout), `    53.98 g     ` (Adventurer), `   0.355 kg   ?G` and `-  1.640 kg    N` (Defender
3000). Factory settings: 9600 baud 8N1; older models 2400 baud 7N2.

Limitations: no source states the line of an overload; it is taken to be the display's `Err 8.3` (under range 8.4).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
)

COLUMNS = (10, 11, 12)
"""Columns in which a number may end that is followed by one blank and its unit."""

_LINE = re.compile(
    r"(?P<number> *[+-]? *[0-9.]+)(?P<gap> +)(?P<unit>[A-Za-z%]{0,5}) *(?P<moving>\??) *(?P<legend>\S.*?)? *"
)
_MARKS = {"": None, "G": WeightMark.GROSS, "B/G": WeightMark.GROSS, "N": WeightMark.NET, "NET": WeightMark.NET}
_LEGENDS = {
    "T": "the tare",
    "PT": "the preset tare",
    "TOTAL": "a sum",
    "WET WT": "a weighing for a density",
    "AIR WT": "a weighing for a density",
}
_CHECK = ("UNDER", "ACCEPT", "OVER")
_TIME = re.compile(r"[0-9]{2}:[0-9]{2}:[0-9]{2}")
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
        value = signed_number(match["number"]) if match is not None else None
        if match is None or value is None:
            raise LineError("not a weight")
        if not _is_whole(match, len(text)):
            raise LineError(f"the number ends in column {len(match['number'])}; it has lost characters")
        legend = " ".join(word for word in (match["legend"] or "").split() if word.upper() not in _CHECK)
        if _TIME.fullmatch(legend):
            raise OtherQuantityError("a line of interval printing", "Switch interval printing off")
        if legend not in _MARKS:
            meaning = _LEGENDS.get(legend, "an unknown quantity")
            raise OtherQuantityError(f"{meaning} ('{legend}')", "Reduce its print-out to the weight in its menu")
        status = ReadingStatus.UNSTABLE if match["moving"] else ReadingStatus.STABLE
        return Reading(status, value, match["unit"], mark=_MARKS[legend])

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


def _is_whole(match: re.Match[str], width: int) -> bool:
    """Whether the columns of number, unit and legend are those of one of the layouts."""
    column, gap, unit_end = len(match["number"]), len(match["gap"]), match.end("unit")
    if column in COLUMNS and (gap == 1 or not match["unit"]):
        return True
    if column == 11 and unit_end == 17:
        return True
    if column == 9 and gap == 1:
        return width == 16 and not match["legend"]
    return column == 8 and gap == 1 and unit_end <= 14 and match.start("legend") == 15


OHAUS = Ohaus()
"""Ohaus."""
