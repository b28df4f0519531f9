"""Mettler-Toledo's Standard Interface Command Set, levels 0 and 1.

The reply to a command that is sent before the last reply may be confused with it, so the driver keeps at most one
command pending. Sources: Mettler-Toledo AL/AB operating instructions (commands, `S` replies); AT operating instructions
(upper case, CR LF). 9600 baud 8N1 is the factory setting of many; some are delivered with Xon/Xoff (setting
`handshake`).

An emulated balance answers all commands of levels 0 and 1 as listed in the reference manual for weigh modules
(11781363), and `M21` of level 2, which selects the unit. In the mode `mt-sics-weigh-module` it claims level 1 and lacks
six commands of it, as a WXS205SDU does. Two replies are assumed, not verified on a balance: `M21`
without parameters lists host and display unit in two lines, and `ZC` answers like `ZI`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal

from actors.balance.dialects import status_lines
from actors.balance.dialects.protocol_encoder import (
    Cancel,
    EncoderDisplay,
    Lines,
    PendingReply,
    ProtocolEncoder,
    Repeat,
    Said,
    line_of,
    weight_line,
)
from actors.balance.readings import KILOGRAMS, Reading, ReadingStatus


@dataclass(frozen=True, kw_only=True)
class MtSics(status_lines.StatusLines):
    """The MT-SICS dialect; see the module docstring."""

    name: str = "mt-sics"
    title: str = "Mettler-Toledo MT-SICS"
    gap: float = 0.05

    def likeness(self, answers: Mapping[str, str]) -> int:
        """See `Dialect.likeness`."""
        return 2 if self.commands_in(answers) else 0

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""
        identity = ('"01" "2.30" "2.22"', "VIRTUAL")
        return {
            self.name: lambda: MtSicsVoice(self, *identity),
            f"{self.name}-weigh-module": lambda: MtSicsVoice(self, *identity, lacks=_LACKING),
        }


HOST, DISPLAY = 0, 1
"""Kinds of unit that M21 sets: the unit of weights on the line, and the unit in the replies to SIRU and SRU."""

UNITS = {"0": "g", "1": "kg", "3": "mg", "5": "ct"}
"""Numbers of the units. Pounds and ounces are refused because their conversion is not a power of ten."""

_LACKING = frozenset(("C", "D", "DW", "SC", "TC", "ZC"))
"""Commands of level 1 that a weigh module WXS205SDU lacks, although its I1 claims this level."""

LONGEST_WAIT = 65_535
"""Longest wait that SC, TC and ZC accept [ms]."""


class MtSicsVoice(status_lines.StatusLineEncoder):
    """The commands that MT-SICS has in addition to KCP: units, commands with a time limit, repeated output in the
    display's unit.
    """

    LEVELS: Mapping[str, int] = {
        **status_lines.StatusLineEncoder.LEVELS,
        **dict.fromkeys(("C", "SC", "SIRU", "SNR", "SRU", "TC", "ZC"), 1),
        "M21": 2,
    }

    def __init__(self, dialect: Lines, levels: str, model: str, lacks: frozenset[str] = frozenset()) -> None:
        super().__init__(dialect, levels, model)
        self.known = {name: level for name, level in self.LEVELS.items() if name not in lacks}
        self._model = model
        self._units: dict[int, str] = {}

    def answer_bare(self, word: str, display: EncoderDisplay) -> Said:
        """See `StatusLineEncoder.answer_bare`."""
        match word:
            case "C":
                return Cancel(line_of("C B") + line_of("C A"))
            case "I2":
                return line_of(f'I2 A "{self._model} {display.scale.capacity} {display.scale.settings.unit}"')
            case "SIRU":
                return Repeat(lambda reading: weight_line(self.dialect, self._in_unit(reading, DISPLAY)))
            case "SNR":
                return self.follow(display, moving=False)
            case "SRU":
                shown = self.follow(display)
                return replace(shown, line=lambda r: weight_line(self.dialect, self._in_unit(r, DISPLAY)))
            case "M21":
                host, shown_ = (self._number(kind, display) for kind in (HOST, DISPLAY))
                return line_of(f"M21 B {HOST} {host}") + line_of(f"M21 A {DISPLAY} {shown_}")
        return super().answer_bare(word, display)

    def answer_with(self, word: str, parameters: str, display: EncoderDisplay) -> Said:
        """See `StatusLineEncoder.answer_with`."""
        match word:
            case "SC" | "TC" | "ZC":
                return self._limited(word, parameters, display)
            case "SNR":
                mass = self.mass_in(parameters)
                return self.follow(display, mass, moving=False) if mass else line_of("SNR L")
            case "M21":
                kind, _, unit = parameters.partition(" ")
                if kind not in (str(HOST), str(DISPLAY)) or unit not in UNITS:
                    return line_of("M21 L")
                self._units[int(kind)] = UNITS[unit]
                return line_of("M21 A")
        return super().answer_with(word, parameters, display)

    def line(self, reading: Reading) -> bytes:
        """See `StatusLineEncoder.line`."""
        return weight_line(self.dialect, self._in_unit(reading, HOST))

    def tared(self, display: EncoderDisplay) -> str:
        """See `StatusLineEncoder.tared`."""
        tare = self._in_unit(Reading(ReadingStatus.STABLE, display.scale.tared, display.scale.settings.unit), HOST)
        return f"{tare.value!s:>10} {tare.unit}"

    def _limited(self, word: str, parameters: str, display: EncoderDisplay) -> Said:
        """Wait up to a time limit for a stable weight, then execute the command in any case."""
        if not parameters.isdecimal() or int(parameters) > LONGEST_WAIT:
            return line_of(f"{word} L")

        def act() -> bytes:
            return self.weight(display) if word == "SC" else self.act(word, display)

        return PendingReply(act, act, int(parameters) / 1000.0)

    def _number(self, kind: int, display: EncoderDisplay) -> str:
        unit = self._units.get(kind, display.scale.settings.unit)
        return next((number for number, name in UNITS.items() if name == unit), "0")

    def _in_unit(self, reading: Reading, kind: int) -> Reading:
        """Convert a reading to the host's or the display's unit; a reading without a mass is returned unchanged."""
        unit = self._units.get(kind, reading.unit)
        if reading.value is None or unit == reading.unit or reading.unit not in KILOGRAMS:
            return reading
        factor = Decimal(repr(KILOGRAMS[reading.unit])) / Decimal(repr(KILOGRAMS[unit]))
        last = Decimal((0, (1,), reading.value.as_tuple().exponent))  # type: ignore[arg-type]
        digit = (last * factor).normalize()
        value = (reading.value * factor).quantize(min(digit, Decimal(1)))
        return replace(reading, value=value, unit=unit)


MT_SICS = MtSics()
"""Mettler-Toledo MT-SICS."""
