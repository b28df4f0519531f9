"""Lines of the form `command status value unit`, which KCP and MT-SICS share.

`StatusLines` is the base class of both dialects and `StatusLineEncoder` that of their encoders.

Sources: Mettler-Toledo AL/AB and AT operating instructions (`S S`, `S I`, `S +`, `S -`, commands I0 … TAC); Kern
CKE-BA-e-2132 and KIB-TM-ZB-e-1913 for the same of KCP; `S D`, `T S`, `Z A`, `TAC A` from existing drivers for such
balances. No source states whether every KCP balance answers `T` with a weight (`T S`) or with `T A`; both are accepted.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal

from actors.balance.dialects.dialect import Dialect, number_in, signed_number, text_of
from actors.balance.dialects.protocol_encoder import (
    END,
    Cancel,
    EncoderDisplay,
    Follow,
    Lines,
    PendingReply,
    Repeat,
    Said,
    complete_lines,
    line_of,
    weight_line,
)
from actors.balance.readings import (
    KILOGRAMS,
    Acknowledgement,
    LineError,
    OtherQuantityError,
    Reading,
    ReadingReply,
    ReadingStatus,
    Reply,
    kilograms,
)

WEIGHTS = {"S": ReadingStatus.STABLE, "D": ReadingStatus.UNSTABLE}
STATES = {"I": ReadingStatus.BUSY, "+": ReadingStatus.OVER, "-": ReadingStatus.UNDER, "L": ReadingStatus.ERROR}
_LETTERS = {
    ReadingStatus.STABLE: "S",
    ReadingStatus.UNSTABLE: "D",
    ReadingStatus.BUSY: "I",
    ReadingStatus.OVER: "+",
    ReadingStatus.UNDER: "-",
}
ANSWERS = {
    "A": ReadingReply.DONE,
    "S": ReadingReply.DONE,
    "D": ReadingReply.DONE,
    "I": ReadingReply.BUSY,
    "+": ReadingReply.OVER,
    "-": ReadingReply.UNDER,
    "L": ReadingReply.REFUSED,
}
REFUSALS = {
    "ES": "syntax error: it does not know the command",
    "ET": "transmission error: it received damaged characters",
    "EL": "logical error: it can't carry the command out",
}

OTHERS = {
    "A01": "the reference of percent weighing",
    "A10": "the target of a check",
    "C4": "the date of the adjustment",
    "DAT": "the date",
    "M19": "the adjustment weight",
    "PW": "the weight of a piece",
    "REF": "the number of reference pieces",
    "SM1": "the result of dynamic weighing",
    "SM2": "the result of dynamic weighing",
    "SM3": "the result of dynamic weighing",
    **dict.fromkeys(("SX", "SXI", "SXIR"), "a record of several weights"),
    "TIM": "the time",
}
"""Replies with a quantity of their own. The replies to T, TI and TA, which state the tare, are acknowledgements."""

_REPLIED = ("A", "B", "S", "D")

UNIT = re.compile(r"[A-Za-z%µ]{1,5}")
COMMAND = re.compile(r"(?:T|TI|TA|TAC|Z|ZI|I[0-9]{1,2}|@|MM|U)")


def decode(line: bytes) -> Reply:
    """Decode one line.

    Args:
        line: without its CR LF.

    Raises:
        LineError: it is not such a line.
    """
    text = text_of(line)
    if text is None:
        raise LineError("not printable ASCII")
    words = text.split()
    if not words:
        raise LineError("empty")
    if words[0] in REFUSALS and len(words) == 1:
        return Acknowledgement("", ReadingReply.REFUSED, REFUSALS[words[0]])
    if words[0] == "S":
        return _weight(words)
    if len(words) > 1 and words[0] in OTHERS and words[1] in _REPLIED:
        raise OtherQuantityError(f"{OTHERS[words[0]]} ('{words[0]}')")
    if not COMMAND.fullmatch(words[0]) or len(words) < 2 or (words[1] not in ANSWERS and words[1] != "B"):
        raise LineError("neither a weight nor an answer to a command")
    if words[1] in WEIGHTS and len(words) > 2 and (len(words) != 4 or number_in(words[2]) is None):
        raise LineError("the weight is damaged")
    return Acknowledgement(words[0], ANSWERS.get(words[1], ReadingReply.BUSY), " ".join(words[2:]))


def _weight(words: list[str]) -> Reading:
    match words:
        case ["S", state] if state in STATES:
            return Reading(STATES[state], detail="it can't carry out the question" if state == "L" else "")
        case ["S", "S" | "D", "Error", number]:
            return Reading(ReadingStatus.ERROR, detail=f"error {number}")
        case ["S", state, *signs, value, unit] if state in WEIGHTS:
            weight = signed_number("".join((*signs, value))) if len(signs) < 2 else None
            if weight is not None and UNIT.fullmatch(unit):
                return Reading(WEIGHTS[state], weight, unit)
            if unit == "lb:oz":
                raise LineError("pounds and ounces in two numbers; switch its unit to g")
    raise LineError("not a weight")


def encode(reading: Reading) -> bytes:
    """Return the line for a reading; the value is right-aligned in ten characters.

    Raises:
        ValueError: these dialects have no such line.
    """
    if reading.status in _LETTERS:
        letter = _LETTERS[reading.status]
        weight = f" {reading.value!s:>10} {reading.unit}" if letter in WEIGHTS else ""
        return f"S {letter}{weight}".encode("ascii") + END
    if reading.status is ReadingStatus.ERROR:
        return f"S S Error {reading.detail.removeprefix('error ') or '1b'}".encode("ascii") + END
    raise ValueError(f"no line says '{reading.status}'")


IDENTITY = ("I0", "I2")
"""Queries for the list of commands and for the model. I1, the command levels, is not a reliable source: a weigh module
(WXS205SDU) claims level 1, but lacks six of its commands."""

_SIGNS = {ReadingStatus.OVER: "+", ReadingStatus.UNDER: "-"}


@dataclass(frozen=True, kw_only=True)
class StatusLines(Dialect):
    """The common base of the dialects with such lines."""

    query: bytes = b"SI\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    cancel: bytes | None = b"@\r\n"
    acknowledged: bool | None = True
    turn: int = 2
    identity: tuple[str, ...] = IDENTITY

    def decode(self, line: bytes) -> Reply:
        """See `Dialect.decode`."""
        return decode(line)

    def encode(self, reading: Reading) -> bytes:
        """See `Dialect.encode`."""
        return encode(reading)

    def commands_in(self, answers: Mapping[str, str]) -> frozenset[str]:
        """See `Dialect.commands_in`."""
        return frozenset(re.findall(r'[0-9]+ "([^"]+)"', answers.get("I0", "")))


class StatusLineEncoder:
    """The commands that KCP and MT-SICS share: MT-SICS's levels 0 and 1, as implemented by most balances.

    Args:
        dialect: KCP or MT-SICS.
        levels: reply to I1.
        model: reply to I2.
    """

    LEVELS: Mapping[str, int] = {
        **dict.fromkeys(("@", "I0", "I1", "I2", "I3", "I4", "I5", "S", "SI", "SIR", "Z", "ZI"), 0),
        **dict.fromkeys(("D", "DW", "K", "SR", "T", "TA", "TAC", "TI"), 1),
    }
    """Commands as I0 lists them, each with its level."""

    def __init__(self, dialect: Lines, levels: str, model: str) -> None:
        self.dialect = dialect
        self.known = self.LEVELS
        """Known commands, each with its level."""
        self._identity = {
            "I1": levels,
            "I2": f'"{model}"',
            "I3": '"1.00 1.2.3.4"',
            "I4": '"0123456789"',
            "I5": '"12345678A"',
        }

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `ProtocolEncoder.commands`."""
        return complete_lines(heard)

    def answer(self, command: bytes, display: EncoderDisplay) -> Said:
        """See `ProtocolEncoder.answer`."""
        word, _, parameters = command.decode("ascii", "replace").partition(" ")
        if not word and not parameters:
            return b""
        if word not in self.known:
            return line_of("ES")
        if parameters:
            return self.answer_with(word, parameters.strip(), display)
        return self.answer_bare(word, display)

    def answer_bare(self, word: str, display: EncoderDisplay) -> Said:
        """Return the reply to a known command without parameters."""
        match word:
            case "I0":
                return self._list()
            case "SI":
                return self.weight(display)
            case "S":
                return PendingReply(lambda: self.weight(display), line_of("S I"))
            case "SIR":
                return Repeat(self.line)
            case "SR":
                return self.follow(display)
            case "T" | "Z":
                return PendingReply(lambda: self.act(word, display), line_of(f"{word} I"))
            case "TI" | "ZI":
                return self.act(word, display)
            case "TA":
                return line_of(f"TA A {self.tared(display)}")
            case "TAC":
                display.scale.clear_tare()
                return line_of("TAC A")
            case "DW":
                return line_of("DW A")
            case "@":
                return Cancel(line_of(f"I4 A {self._identity['I4']}"))
        return line_of(f"{word} A {self._identity[word]}" if word in self._identity else f"{word} L")

    def answer_with(self, word: str, parameters: str, display: EncoderDisplay) -> Said:
        """Return the reply to a known command with parameters; 'L' if they are invalid."""
        match word:
            case "D" if re.fullmatch(r'"[^"]*"', parameters):
                return line_of("D A")
            case "K" if parameters in ("1", "2", "3", "4"):
                return line_of("K A")
            case "TA" if (mass := self.mass_in(parameters)) is not None and display.scale.preset_tare(mass):
                return line_of(f"TA A {self.tared(display)}")
            case "SR" if (mass := self.mass_in(parameters)) is not None and mass > 0.0:
                return self.follow(display, mass)
            case "D" | "K" | "TA" | "SR":
                return line_of(f"{word} L")
        return line_of("ES")

    def line(self, reading: Reading) -> bytes:
        """Return the line for a reading."""
        return weight_line(self.dialect, reading)

    def weight(self, display: EncoderDisplay) -> bytes:
        """Return the line for the display's current reading."""
        return self.line(display.reading())

    def tared(self, display: EncoderDisplay) -> str:
        """The tare with its unit, formatted for a line."""
        return f"{display.scale.tared!s:>10} {display.scale.settings.unit}"

    def mass_in(self, parameters: str) -> float | None:
        """Parse the mass in 'value unit' [kg]; None if it is invalid."""
        value, _, unit = parameters.partition(" ")
        number, factor = number_in(value), kilograms(unit.strip())
        return None if number is None or factor is None else float(number) * factor

    def follow(self, display: EncoderDisplay, mass: float | None = None, *, moving: bool = True) -> Follow:
        """Report changes of at least `mass` [kg]; by default, an eighth of the weight and at least 30 display steps."""
        scale = display.scale
        if mass is None:
            return Follow(self.line, lambda stood: max(abs(stood) / 8, 30 * scale.step), moving)
        step = Decimal(repr(mass)) / Decimal(repr(KILOGRAMS[scale.settings.unit]))
        return Follow(self.line, lambda stood: step, moving)

    def act(self, word: str, display: EncoderDisplay) -> bytes:
        """Tare (T …) or zero (Z …) now, and return the reply."""
        status = display.tare() if word.startswith("T") else display.zero()
        if status in _SIGNS:
            return line_of(f"{word} {_SIGNS[status]}")
        letter = "S" if display.scale.stable else "D"
        if word.startswith("Z"):
            return line_of("Z A" if word == "Z" else f"{word} {letter}")
        return line_of(f"{word} {letter} {self.tared(display)}")

    def _list(self) -> bytes:
        listed = sorted(self.known.items(), key=lambda entry: entry[1])
        states = ["B"] * (len(listed) - 1) + ["A"]
        return b"".join(
            line_of(f'I0 {state} {level} "{name}"') for state, (name, level) in zip(states, listed, strict=True)
        )


def is_kern(answers: Mapping[str, str]) -> bool:
    """Whether the balance identifies itself as one of Kern's."""
    return any("KERN" in text.upper() for text in answers.values())
