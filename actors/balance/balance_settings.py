"""Settings of a balance: its device, its serial line, its placement, and the rule for a settled weight.

`BalanceSpec` is a laboratory's balance. Its `BalanceDevice` is a `SerialBalanceSpec`, a `NumbersBalanceSpec` or a
plug-in's class, and names the driver. `Settling` applies a `SettlingRule`: a weight counts if the balance reports
several stable readings in a row and they agree. The drivers themselves are in other modules.
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
from sim_engine.settings.model import NOT_IN_FINGERPRINT


@dataclass(frozen=True)
class SettlingRule:
    """Conditions for a weight to count.

    One stable reading is not enough: characters get lost on serial lines, some balances report a slowly filling vessel
    as stable, and some are configured to always print a unit.

    Attributes:
        readings: number of consecutive stable readings; 2 or more.
        span: time from the first of them to the last [s].
        steps: largest difference between them, in steps of the display.
        deadline: time limit for settling [s].
    """

    readings: int = 4
    span: float = 0.6
    steps: float = 1.0
    deadline: float = 20.0

    def scaled(self, time_scale: float) -> SettlingRule:
        """The same rule for a laboratory with scaled time.

        Args:
            time_scale: bench seconds per second of the clock.
        """
        return replace(self, span=self.span / time_scale, deadline=self.deadline / time_scale)


@dataclass(frozen=True)
class Settled:
    """A weight that counts.

    Attributes:
        mass: median of the readings [kg].
        time: of the last reading [s].
        spread: largest minus smallest reading [kg].
    """

    mass: float
    time: float
    spread: float


class Settling:
    """Collects readings until a weight counts."""

    def __init__(self, rule: SettlingRule) -> None:
        self._rule = rule
        self._window: deque[tuple[float, float]] = deque()

    def feed(self, mass: float | None, time: float, step: float) -> Settled | None:
        """Add a reading.

        Args:
            mass: of a stable reading [kg]; None for any other reading.
            time: of the reading [s].
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
"""Value of `dialect` that selects automatic detection."""

SERIAL_EMULATOR = "actors.emulators.serial_balance.balance_process:SerialBalanceEmulator"
"""Emulates a balance on a serial line of a virtual bench; a name, because drivers do not import emulators."""

DRIFTING = 60.0
"""Longest bench time from a tare to the weighing after it, on a simulated bench [s]."""

Handshake = Literal["none", "software", "hardware"]


COARSE = 0.5e-3
"""Displays with larger steps cannot resolve small spills [kg]."""


class BalanceEmulator(Protocol):
    """Emulates a balance on a virtual bench; the driver connects to it as to a real balance."""

    @property
    def device(self) -> BalanceDevice:
        """The settings, with the emulator's address."""
        ...

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Prepare a new pour: reseed the random numbers and empty the balance."""
        ...

    def put(self, mass: float) -> None:
        """Set the mass on the balance from now on [kg]."""
        ...

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """Send another command to the emulator, for tests."""
        ...

    def close(self) -> None:
        """End the emulator. May be called again."""
        ...


class BalanceDevice(ABC):
    """Settings of a weighing device: frozen values that can be sent to the bench's machine and name their driver.

    Attributes:
        kind: as registered in the plug-in registry `decant.balances`, and as written in files.
        told: whether, on a virtual bench, the driver itself receives the load instead of an emulator. It then has
            `prepare` and `put` as in `actors.balance.simulated_balance.VirtualBalance`.
        time_scale: bench seconds per second of the clock; 1 for a real device, 0 disables waiting.
        repeatability: standard deviation of repeated weighings of the same load [kg].
    """

    kind: ClassVar[str]
    told: ClassVar[bool] = False
    time_scale: float = 1.0
    repeatability: float = 0.0

    @abstractmethod
    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """Return the class of the driver (an `actors.balance.balance_interface.BalanceDriver`, importable by name) and
        its arguments.

        Args:
            name: for messages.
        """

    @property
    def longest_call(self) -> float:
        """Upper limit of a call's duration [s of the clock]; deadlines around the driver should be a little longer."""
        return 120.0

    def start_emulator(self) -> BalanceEmulator | None:
        """Start the emulator on a virtual bench; None if the device needs none."""
        return None

    def paced(self, time_scale: float) -> BalanceDevice:
        """The same balance with a virtual bench's time scale."""
        return replace(self, time_scale=time_scale)  # type: ignore[type-var]

    def look(self, *, tare: bool) -> list[DeviceCheck]:
        """Return the checks of `decant doctor`: identification, a stable reading, its step, and optionally a tare.

        Args:
            tare: also tare the balance.
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
    """A simulated balance.

    Attributes:
        sheet: data sheet of the balance; its time scale is the bench's.
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
        dialect: one of `actors.balance.dialect_registry.dialects`, or 'auto'.
        baud: bits per second; None: detected.
        format: bits, parity and stop bits, as '8N1'; None: detected.
        handshake: how the balance may pause the line: by characters (Xon/Xoff), by wires (CTS), or not at all.
        settling: conditions for a weight to count.
        step: of the display [kg], if it differs from one unit of the last digit sent.
        repeatability: standard deviation of repeated weighings of the same load [kg], from the data sheet.
        interval: between two queries [s].
        answer_time: longest wait for a reply [s of the clock].
        reconnect_time: longest wait for a vanished port [s].
        time_scale: bench seconds per second of the clock; 1 for real devices.
        virtual: data sheet of the emulated balance, if there is no real one; it is started on a virtual bench, and
            `port` is filled in.
    """

    kind: ClassVar[str] = "serial"

    port: Annotated[str, NOT_IN_FINGERPRINT]
    dialect: str = AUTO
    baud: Annotated[int | None, NOT_IN_FINGERPRINT] = None
    format: Annotated[str | None, NOT_IN_FINGERPRINT] = None
    handshake: Annotated[Handshake, NOT_IN_FINGERPRINT] = "none"
    settling: SettlingRule = field(default_factory=SettlingRule)
    step: float | None = None
    repeatability: float = 0.0
    interval: float = 0.15
    answer_time: float = 1.0
    reconnect_time: Annotated[float, NOT_IN_FINGERPRINT] = 20.0
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

    def start_emulator(self) -> BalanceEmulator | None:
        """See `BalanceDevice.start_emulator`."""
        if self.virtual is None:
            return None
        emulator: BalanceEmulator = resolve_name(SERIAL_EMULATOR)(self, self.virtual)
        return emulator

    def look(self, *, tare: bool) -> list[DeviceCheck]:
        """See `BalanceDevice.look`; checks the port first."""
        from actors.balance.serial_port import look_at_port

        port = look_at_port(self.port)
        return [port] if port.state == "fail" else [port, *super().look(tare=tare)]

    @property
    def longest_call(self) -> float:
        """See `BalanceDevice.longest_call`."""
        return 4.0 * self.settling.deadline / self.time_scale + 4.0 * self.reconnect_time + 60.0

    @property
    def allowed(self) -> tuple[Dialect, ...]:
        """Dialects that the balance may use."""
        return tuple(dialects().values()) if self.dialect == AUTO else (dialects()[self.dialect],)

    def candidates(self) -> tuple[LineSettings, ...]:
        """Line settings to try, the most likely first."""
        usual = _interleaved([dialect.lines for dialect in self.allowed])
        if self.baud is None and self.format is None:
            return usual
        forms = [parse_format(self.format)] if self.format is not None else [(s.bits, s.parity, s.stop) for s in usual]
        bauds = [self.baud] if self.baud is not None else [s.baud for s in usual]
        if self.format is None:  # a known speed: the usual formats at any speed
            return tuple(dict.fromkeys(LineSettings(bauds[0], *form) for form in forms))
        return tuple(dict.fromkeys(LineSettings(baud, *forms[0]) for baud in bauds))


@dataclass(frozen=True)
class BalanceSpec:
    """A laboratory's balance.

    Attributes:
        placement: where it stands.
        device: the weighing device; None if the operator types the weights.
        pourer_elsewhere: whether the pourer is weighed on another balance, and typed.
        load_tolerance: largest deviation from the requested load [kg].
    """

    placement: Placement
    device: BalanceDevice | None
    pourer_elsewhere: bool = False
    load_tolerance: float = 5e-3

    @property
    def repeatability(self) -> float:
        """Standard deviation of repeated weighings of the same load [kg]."""
        return 0.0 if self.device is None else self.device.repeatability


def parse_format(text: str) -> tuple[int, str, int]:
    """Parse a character format: '7O1' → (7, 'O', 1).

    Raises:
        ValueError: not bits 7 or 8, parity N, O or E, stop bits 1 or 2.
    """
    if len(text) != 3 or text[0] not in "78" or text[1].upper() not in "NOE" or text[2] not in "12":
        raise ValueError(f"'{text}' should be bits, parity and stop bits, as '8N1' or '7O1'")
    return int(text[0]), text[1].upper(), int(text[2])


def _interleaved(tables: list[tuple[LineSettings, ...]]) -> tuple[LineSettings, ...]:
    """Merge the tables: the first entries of all, then the second entries, and so on."""
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
