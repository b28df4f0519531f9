"""Settings of a balance: its serial line, where it stands. Plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.doors import dialects
from actors.balance.placement import Placement
from actors.balance.settling import SettlingRule
from actors.balance.virtual_serial.scale import ScaleSettings
from sim_engine.marks import FREE

AUTO = "auto"
"""Dialect that is found out."""

Handshake = Literal["none", "software", "hardware"]


@dataclass(frozen=True)
class SerialBalanceSpec:
    """A balance on a serial line.

    Attributes:
        port: device; under `/dev/serial/by-id/` it keeps its name when it is plugged in again.
        dialect: one of `doors.dialects`, or 'auto'.
        baud: bits per second; None: found out.
        format: bits, parity and stop bits, as '8N1'; None: found out.
        handshake: whether the balance may stop the line: by characters (Xon/Xoff), by wires (CTS), or not.
        settling: when a weight counts.
        step: of the display [kg], where it is not one of the last digit sent.
        repeatability: standard deviation of weighing the same thing again [kg], from the data sheet.
        interval: from one question to the next [s].
        answer_time: longest wait for an answer [s of the clock].
        reconnect_time: how long a vanished port is waited for [s].
        time_scale: bench seconds per second of the clock; 1 for everything real.
    """

    port: Annotated[str, FREE]
    dialect: str = AUTO
    baud: Annotated[int | None, FREE] = None
    format: Annotated[str | None, FREE] = None
    handshake: Annotated[Handshake, FREE] = "none"
    settling: SettlingRule = field(default_factory=SettlingRule)
    step: float | None = None
    repeatability: float = 0.0
    interval: float = 0.15
    answer_time: float = 1.0
    reconnect_time: Annotated[float, FREE] = 20.0
    time_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.dialect != AUTO and self.dialect not in dialects():
            raise ValueError(f"dialect '{self.dialect}' is not known; there are {', '.join(dialects())} and {AUTO}")
        if self.time_scale <= 0.0:
            raise ValueError(f"time_scale must be above 0, got {self.time_scale}")
        if self.format is not None:
            parse_format(self.format)

    @property
    def longest_call(self) -> float:
        """No call lasts longer than this [s of the clock]; what holds the driver should wait a little longer."""
        return 4.0 * self.settling.deadline / self.time_scale + 4.0 * self.reconnect_time + 60.0

    @property
    def allowed(self) -> tuple[Dialect, ...]:
        """Dialects that it may speak."""
        return tuple(dialects().values()) if self.dialect == AUTO else (dialects()[self.dialect],)

    def candidates(self) -> tuple[LineSettings, ...]:
        """Line settings to try, the likeliest first."""
        usual = _interleaved([dialect.lines for dialect in self.allowed])
        if self.baud is None and self.format is None:
            return usual
        forms = [parse_format(self.format)] if self.format is not None else [(s.bits, s.parity, s.stop) for s in usual]
        bauds = [self.baud] if self.baud is not None else [s.baud for s in usual]
        if self.format is None:  # a known speed: the formats that are usual at any
            return tuple(dict.fromkeys(LineSettings(bauds[0], *form) for form in forms))
        return tuple(dict.fromkeys(LineSettings(baud, *forms[0]) for baud in bauds))


@dataclass(frozen=True)
class BalanceSpec:
    """A laboratory's balance.

    Attributes:
        placement: where it stands.
        serial: its line; None where the operator types what it shows.
        virtual: what its data sheet would say, where there is none: it is started, and `serial.port` set to its port.
        pourer_elsewhere: the pourer is weighed on another balance, and typed.
        load_tolerance: how far a load may lie from the one asked for [kg].
    """

    placement: Placement
    serial: SerialBalanceSpec | None
    virtual: ScaleSettings | None = None
    pourer_elsewhere: bool = False
    load_tolerance: float = 5e-3


def parse_format(text: str) -> tuple[int, str, int]:
    """'7O1' → (7, 'O', 1).

    Raises:
        ValueError: anything else than bits 7 or 8, parity N, O or E, stop bits 1 or 2.
    """
    if len(text) != 3 or text[0] not in "78" or text[1].upper() not in "NOE" or text[2] not in "12":
        raise ValueError(f"'{text}' should be bits, parity and stop bits, as '8N1' or '7O1'")
    return int(text[0]), text[1].upper(), int(text[2])


def _interleaved(tables: list[tuple[LineSettings, ...]]) -> tuple[LineSettings, ...]:
    """First choices of all before second choices of any."""
    longest = max(len(table) for table in tables)
    return tuple(dict.fromkeys(table[i] for i in range(longest) for table in tables if i < len(table)))
