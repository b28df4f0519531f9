"""The balance's side of each dialect: from bytes that it hears to what it says. No clock, no ports."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from actors.balance.dialects import KCP, MT_SICS, Dialect
from actors.balance.dialects.dialect import END
from actors.balance.dialects.kern_swt import KernSwt
from actors.balance.dialects.sbi import Sbi
from actors.balance.reading import Reading, Status
from actors.balance.virtual_serial.scale import Scale

SIGNS = {Status.OVER: "+", Status.UNDER: "-"}


@dataclass(frozen=True)
class Waiting:
    """Said once the display stands.

    Attributes:
        done: carries the command out and gives the line.
        expired: line if it does not come to rest in time; None: waits for ever.
    """

    done: Callable[[], bytes]
    expired: bytes | None = None


@dataclass(frozen=True)
class Repeat:
    """Readings from now on, until the next command."""


Said = bytes | Waiting | Repeat


class Display(Protocol):
    """What a voice speaks of: a scale, or one with a fault."""

    @property
    def scale(self) -> Scale:
        """The scale itself."""
        ...

    def reading(self) -> Reading:
        """What the display shows."""
        ...

    def tare(self) -> Status:
        """Carry out a tare."""
        ...

    def zero(self) -> Status:
        """Carry out a zero."""
        ...


class Voice(Protocol):
    """One dialect, spoken by a balance."""

    @property
    def dialect(self) -> Dialect:
        """The dialect."""
        ...

    def commands(self, heard: bytearray) -> list[bytes]:
        """Take whole commands out of what was heard."""
        ...

    def answer(self, command: bytes, display: Display) -> Said:
        """What it says to a command; empty for nothing."""
        ...


def weight_line(dialect: Dialect, reading: Reading) -> bytes:
    """The line for a reading; a dialect that can't say it reports a fault instead."""
    try:
        return dialect.encode(reading)
    except ValueError:
        return dialect.encode(Reading(Status.ERROR))


class StatusLineVoice:
    """KCP and MT-SICS.

    Args:
        dialect: one of the two.
        levels: answer to I1.
        model: answer to I2.
    """

    def __init__(self, dialect: Dialect, levels: str, model: str) -> None:
        self.dialect = dialect
        self._identity = {"I1": levels, "I2": f'"{model}"', "I3": '"1.00"', "I4": '"0123456789"'}

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `Voice.commands`."""
        *whole, rest = re.split(rb"\r\n|\n", bytes(heard))
        heard[:] = rest
        return whole

    def answer(self, command: bytes, display: Display) -> Said:
        """See `Voice.answer`."""
        word = command.decode("ascii", "replace")
        match word:
            case "":
                return b""
            case "SI":
                return weight_line(self.dialect, display.reading())
            case "S":
                return Waiting(lambda: weight_line(self.dialect, display.reading()), _line("S I"))
            case "SIR":
                return Repeat()
            case "T" | "Z":
                return Waiting(lambda: self._act(word, display), _line(f"{word} I"))
            case "TI" | "ZI":
                return self._act(word, display)
            case "TA":
                return _line(f"TA A {display.scale.tared!s:>10} {display.scale.settings.unit}")
            case "TAC":
                display.scale.clear_tare()
                return _line("TAC A")
            case "@":
                return _line(f"I4 A {self._identity['I4']}")
        return _line(f"{word} A {self._identity[word]}") if word in self._identity else _line("ES")

    def _act(self, word: str, display: Display) -> bytes:
        status = display.tare() if word.startswith("T") else display.zero()
        if status in SIGNS:
            return _line(f"{word} {SIGNS[status]}")
        letter = "S" if display.scale.stable else "D"
        if word.startswith("Z"):
            return _line("Z A" if word == "Z" else f"ZI {letter}")
        return _line(f"{word} {letter} {display.scale.tared!s:>10} {display.scale.settings.unit}")


class KernSwtVoice:
    """Older Kern balances.

    Args:
        short: lines of 15 and 14 bytes where the other layout has 18.
    """

    def __init__(self, *, short: bool = False) -> None:
        self.dialect = KernSwt(short=short)

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `Voice.commands`."""
        letters = [bytes([byte]) for byte in heard if byte in b"swt"]
        heard.clear()
        return letters

    def answer(self, command: bytes, display: Display) -> Said:
        """See `Voice.answer`."""
        if command == b"w":
            return weight_line(self.dialect, display.reading())
        if command == b"s":
            return Waiting(lambda: weight_line(self.dialect, display.reading()))
        return Waiting(lambda: _silently(display.tare)) if command == b"t" else b""


class SbiVoice:
    """Sartorius SBI.

    Args:
        identified: lines of 22 characters.
        at_stability: answers ESC P only once it is at rest.
    """

    def __init__(self, *, identified: bool = False, at_stability: bool = False) -> None:
        self.dialect = Sbi(identified=identified)
        self._at_stability = at_stability

    def commands(self, heard: bytearray) -> list[bytes]:
        """See `Voice.commands`."""
        found = re.findall(rb"\x1b([A-Z]|[a-z][A-Za-z0-9]*_)", bytes(heard))
        tail = bytes(heard).rpartition(b"\x1b")
        begun = tail[1] and re.fullmatch(rb"(?:[a-z][A-Za-z0-9]*)?", tail[2])
        heard[:] = b"\x1b" + tail[2] if begun else b""
        return found

    def answer(self, command: bytes, display: Display) -> Said:
        """See `Voice.answer`."""
        if command == b"P" and not self._at_stability:
            return weight_line(self.dialect, display.reading())
        match command:
            case b"P":
                return Waiting(lambda: weight_line(self.dialect, display.reading()))
            case b"T" | b"U":
                return Waiting(lambda: _silently(display.tare))
            case b"V":
                return Waiting(lambda: _silently(display.zero))
            case b"x1_":
                return _line("VIRTUAL-SBI")
        return b""


def _silently(act: Callable[[], Status]) -> bytes:
    act()
    return b""


def _line(text: str) -> bytes:
    return text.encode("ascii", "replace") + END


VOICES: dict[str, Callable[[], Voice]] = {
    "kcp": lambda: StatusLineVoice(KCP, '"01" "1.1.2" "1.1.2"', "KERN VIRTUAL 6200-2"),
    "kern-swt": KernSwtVoice,
    "kern-swt-short": lambda: KernSwtVoice(short=True),
    "mt-sics": lambda: StatusLineVoice(MT_SICS, '"01" "2.30" "2.22"', "VIRTUAL 6200.00 g"),
    "sbi": SbiVoice,
    "sbi-identified": lambda: SbiVoice(identified=True),
    "sbi-at-stability": lambda: SbiVoice(at_stability=True),
}
"""What a virtual balance may be started as: the dialects, and what else balances of these families are set to."""
