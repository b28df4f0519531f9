"""Settings of a balance: its serial line, where it stands. Plain values.

When a weight counts: the balance vouches for several readings in a row, and they agree.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field, replace
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, Literal, Protocol

from actors.balance.balance_interface import BalanceDriver
from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.simulated_balance import PATIENCE, BalanceSettings, ScaleSettings, VirtualBalance
from actors.balance.weighing_plan import Placement
from actors.interfaces import DeviceCheck, LaboratoryError
from sim_engine.settings.model import FREE


@dataclass(frozen=True)
class SettlingRule:
    """What must be seen before a weight counts.

    One stable reading isn't enough: characters get lost on serial lines, some balances call a slowly filling vessel
    stable, and some are set up to print a unit always.

    Attributes:
        readings: stable ones in a row, nothing else in between; 2 or more.
        span: from the first of them to the last [s].
        steps: how far they may lie apart, in steps of the display.
        deadline: after which a weight that has not settled is given up [s].
    """

    readings: int = 4
    span: float = 0.6
    steps: float = 1.0
    deadline: float = 20.0

    def scaled(self, time_scale: float) -> SettlingRule:
        """The same in a laboratory whose time runs faster.

        Args:
            time_scale: bench seconds per second of the clock.
        """
        return replace(self, span=self.span / time_scale, deadline=self.deadline / time_scale)


@dataclass(frozen=True)
class Settled:
    """A weight that counts.

    Attributes:
        mass: median of the readings [kg].
        time: of the last of them [s].
        spread: largest minus smallest [kg].
    """

    mass: float
    time: float
    spread: float


class Settling:
    """Watches readings until a weight counts."""

    def __init__(self, rule: SettlingRule) -> None:
        self._rule = rule
        self._window: deque[tuple[float, float]] = deque()

    def feed(self, mass: float | None, time: float, step: float) -> Settled | None:
        """Take note of a reading.

        Args:
            mass: a stable one [kg], or None for one that is anything else.
            time: when it came [s].
            step: of the display [kg].

        Returns:
            The weight, once it counts.
        """
        if mass is None:
            self._window.clear()
            return None
        self._window.append((time, mass))
        allowed = self._rule.steps * step * (1.0 + 1e-9)
        while abs(self._spread()) > allowed:
            self._window.popleft()
        first = self._window[0][0]
        if len(self._window) < self._rule.readings or time - first < self._rule.span:
            return None
        masses = sorted(mass for _, mass in self._window)
        return Settled(masses[len(masses) // 2], time, self._spread())

    def _spread(self) -> float:
        masses = [mass for _, mass in self._window]
        return max(masses) - min(masses)


AUTO = "auto"
"""Dialect that is found out."""

SERIAL_EMULATOR = "actors.emulators.serial_balance.balance_process:SerialStandIn"
"""Emulates a balance on a serial line of a virtual bench; a name, because drivers do not import emulators."""

DRIFTING = 60.0
"""From a tare to the weighing after it, at most, on a bench of numbers [s of bench time]."""

Handshake = Literal["none", "software", "hardware"]


COARSE = 0.5e-3
"""A display with larger steps tells little of small spills [kg]."""


class BalanceEmulator(Protocol):
    """What a driver finds at its far end on a virtual bench, in place of a balance."""

    @property
    def device(self) -> BalanceDevice:
        """The settings, with its address filled in."""
        ...

    def prepare(self, seed: tuple[int, ...]) -> None:
        """A new pour: its chance begins anew, and it is empty."""
        ...

    def put(self, mass: float) -> None:
        """What stands on it from now on [kg]."""
        ...

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """Have something else done to it, for tests."""
        ...

    def close(self) -> None:
        """End it. May be called again."""
        ...


class BalanceDevice(ABC):
    """Settings of what weighs: frozen values that travel to where the bench is, and know which driver they are for.

    Attributes:
        kind: as registered at the door `decant.balances`, and as written in files.
        told: on a virtual bench nothing is at its far end: the driver itself is given what stands on it, and has
            `prepare` and `put` as `actors.balance.simulated_balance.VirtualBalance` has them.
        time_scale: bench seconds per second of the clock; 1 for anything real, 0 waits for nothing.
        repeatability: standard deviation of weighing the same thing again [kg].
    """

    kind: ClassVar[str]
    told: ClassVar[bool] = False
    time_scale: float = 1.0
    repeatability: float = 0.0

    @abstractmethod
    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (an `actors.balance.balance_interface.BalanceDriver`), importable by name, and its
        arguments.

        Args:
            name: for messages.
        """

    @property
    def longest_call(self) -> float:
        """No call lasts longer than this [s of the clock]; what holds the driver should wait a little longer."""
        return 120.0

    def stand_in(self) -> BalanceEmulator | None:
        """Start what stands in for it on a virtual bench; None where nothing does."""
        return None

    def paced(self, time_scale: float) -> BalanceDevice:
        """The same balance in a virtual bench's time."""
        return replace(self, time_scale=time_scale)  # type: ignore[type-var]

    def look(self, *, tare: bool) -> list[DeviceCheck]:
        """What `decant doctor` tells of it: who is there, a stable reading, its step; and whether it obeys a tare.

        Args:
            tare: also tare it.
        """
        cls, arguments = self.driver("balance")
        driver: BalanceDriver = cls(*arguments)
        checks: list[DeviceCheck] = []
        try:
            checks.append(DeviceCheck("balance", "ok", driver.connect()))
            weight = driver.weigh()
            checks.append(DeviceCheck("balance reading", "ok", f"{1e3 * weight.mass:g} g, stable"))
            coarse = weight.step > COARSE
            advice = "spills of less than a few steps can't be told apart; a finer balance would help" if coarse else ""
            checks.append(DeviceCheck("balance step", "warn" if coarse else "ok", f"{1e3 * weight.step:g} g", advice))
            if tare:
                driver.tare()
                checks.append(DeviceCheck("balance tare", "ok", "it obeyed, and rests at zero"))
            else:
                said = "not tried; --tare tries it (what is on it counts as nothing then)"
                checks.append(DeviceCheck("balance tare", "ok", said))
        except LaboratoryError as error:
            todo = "docs/balances.md has a table of what it says and what to do"
            checks.append(DeviceCheck("balance", "fail", str(error), todo))
        finally:
            driver.close()
        return checks


@dataclass(frozen=True)
class NumbersBalanceSpec(BalanceDevice):
    """A balance of numbers.

    Attributes:
        sheet: what its data sheet says; its pace is the bench's.
    """

    sheet: BalanceSettings

    kind: ClassVar[str] = "numbers"
    told: ClassVar[bool] = True

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceDevice.driver`."""
        return VirtualBalance, (self.sheet, name)

    def paced(self, time_scale: float) -> NumbersBalanceSpec:
        """See `BalanceDevice.paced`."""
        return NumbersBalanceSpec(replace(self.sheet, time_scale=time_scale))

    @property
    def longest_call(self) -> float:
        """See `BalanceDevice.longest_call`."""
        return 2.0 * PATIENCE / self.sheet.time_scale if self.sheet.time_scale > 0.0 else 0.0

    @property
    def time_scale(self) -> float:  # type: ignore[override]
        """See `BalanceDevice`."""
        return self.sheet.time_scale

    @property
    def repeatability(self) -> float:  # type: ignore[override]
        """See `BalanceDevice`."""
        return math.hypot(self.sheet.noise, self.sheet.drift * DRIFTING)


@dataclass(frozen=True)
class SerialBalanceSpec(BalanceDevice):
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
        virtual: what the data sheet of the balance at the other end would say, where there is none: it is started on a
            virtual bench, and `port` filled in.
    """

    kind: ClassVar[str] = "serial"

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
    virtual: ScaleSettings | None = None

    def __post_init__(self) -> None:
        if self.dialect != AUTO and self.dialect not in dialects():
            raise ValueError(f"dialect '{self.dialect}' is not known; there are {', '.join(dialects())} and {AUTO}")
        if self.time_scale <= 0.0:
            raise ValueError(f"time_scale must be above 0, got {self.time_scale}")
        if self.format is not None:
            parse_format(self.format)

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceDevice.driver`."""
        return resolve_name("actors.balance.serial_balance:SerialBalance"), (self, name)

    def stand_in(self) -> BalanceEmulator | None:
        """See `BalanceDevice.stand_in`."""
        if self.virtual is None:
            return None
        emulator: BalanceEmulator = resolve_name(SERIAL_EMULATOR)(self, self.virtual)
        return emulator

    def look(self, *, tare: bool) -> list[DeviceCheck]:
        """See `BalanceDevice.look`: the port first."""
        from actors.balance.serial_port import look_at_port

        port = look_at_port(self.port)
        return [port] if port.state == "fail" else [port, *super().look(tare=tare)]

    @property
    def longest_call(self) -> float:
        """See `BalanceDevice.longest_call`."""
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
        device: what weighs; None where the operator types what it shows.
        pourer_elsewhere: the pourer is weighed on another balance, and typed.
        load_tolerance: how far a load may lie from the one asked for [kg].
    """

    placement: Placement
    device: BalanceDevice | None
    pourer_elsewhere: bool = False
    load_tolerance: float = 5e-3

    @property
    def repeatability(self) -> float:
        """Standard deviation of weighing the same thing again [kg]."""
        return 0.0 if self.device is None else self.device.repeatability


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


def look_at_balance(spec: BalanceSpec | None, *, tare: bool) -> list[DeviceCheck]:
    """Who is there, a stable reading, its step; and whether it obeys a tare.

    Args:
        spec: as in the laboratory's file, its address filled in.
        tare: also tare it.
    """
    if spec is None:
        return [DeviceCheck("balance", "fail", "the file has none", "add a 'balance' section, or 'placement: manual'")]
    if spec.device is None:
        return [DeviceCheck("balance", "ok", "all weights are typed by the operator")]
    return spec.device.look(tare=tare)
