"""Settings of a balance: its placement, its device, its serial line, and the rule for a settled weight.

`BalanceSettings` is the base class, from which `SerialBalanceSettings` and plug-ins' classes derive
(`SimulatedBalanceSettings` is in `simulated_balance`). `BalanceKind` joins settings with driver, emulator and
diagnostics; Decant's own kinds are in `actors.device_kinds`. `Settling` applies a `SettlingRule`: a weight counts if
the balance reports several stable readings in a row and they agree.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from typing import Annotated, Any, ClassVar, Generic, Literal, Protocol, Self, TypeVar

from pydantic import Field

from actors.balance.balance_interface import BalanceDriver
from actors.balance.dialect_registry import dialects, drivers
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.display_quality import dose_tolerance
from actors.balance.scale_model import Duration, Error, PositiveDuration, PositiveMass, ScaleSettings
from actors.balance.serial_port import tcp_address
from actors.balance.weighing_plan import Placement
from actors.dosing_settings import DosingSettings
from actors.interfaces import DeviceCheck, LaboratoryError
from sim_engine.settings.model import (
    NOT_IN_FINGERPRINT,
    SET_BY_PROGRAM,
    Choice,
    FilePath,
    PositiveCount,
    Problems,
    Settings,
    Text,
)
from sim_engine.settings.quantity import Quantity


class SettlingRule(Settings):
    """Criteria for a settled weight.

    One stable reading is not enough: characters get lost on serial lines, some balances report a slowly filling vessel
    as stable, and some are configured to always print a unit.
    """

    readings: Annotated[int, Field(strict=True, ge=2, le=100)] = 4
    """Number of consecutive stable readings."""

    span: Duration = 0.6
    """Time from the first to the last of these readings."""

    steps: Annotated[float, Quantity("1", "1", 0.0, 100.0)] = 1.0
    """Largest difference between these readings, in steps of the display."""

    hold: Annotated[Duration, NOT_IN_FINGERPRINT] = 1.5
    """Time for which readings without flicker must last: some displays hold one for 1.1 s while the load moves."""

    deadline: PositiveDuration = 20.0
    """Maximum time for a weight to settle; then the weighing fails."""

    def scaled(self, time_scale: float) -> Self:
        """The same rule for a laboratory with scaled time.

        Args:
            time_scale: bench seconds per second of the clock.
        """
        return self.with_values(
            span=self.span / time_scale, hold=self.hold / time_scale, deadline=self.deadline / time_scale
        )


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
        masses = [mass for _, mass in self._window]
        changes = sum(before != after for before, after in pairwise(masses))
        # a display that flickers is not held
        span = self._rule.span if changes > 1 else max(self._rule.span, self._rule.hold)
        if len(self._window) < self._rule.readings or time - self._window[0][0] < span:
            return None
        return Settled(sorted(masses)[len(masses) // 2], time, self._spread())

    def _spread(self) -> float:
        masses = [mass for _, mass in self._window]
        return max(masses) - min(masses)


AUTO = "auto"
"""Value of `dialect` that selects automatic detection."""

USUAL_BAUDS = (300, 600, 1200, 2400, 4800, 9600, 14_400, 19_200, 28_800, 38_400, 57_600, 115_200)
"""Usual speeds of balances [bits per second]."""

OBSERVED = 6.0
"""Longest time for which the readings of a balance are observed [s]."""

SLOW_DOSE = 1e-3
"""Usual tolerance of a dose [kg]."""

COARSE = 0.5e-3
"""Displays with larger steps cannot resolve small spills [kg]."""


class BalanceEmulator(Protocol):
    """Emulates a balance on a virtual bench; the driver connects to it as to a real balance."""

    @property
    def balance(self) -> BalanceSettings:
        """The settings, with the emulator's address."""
        ...

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Prepare a new pour: reseed the random numbers and empty the balance."""
        ...

    def put(self, mass: float) -> None:
        """Set the mass on the balance from now on [kg]."""
        ...

    def order(self, kind: str, values: dict[str, Any]) -> dict[str, Any]:
        """Send another command to the emulator, for tests."""
        ...

    def close(self) -> None:
        """End the emulator. May be called again."""
        ...


_TYPED = ("kind", "placement", "load_tolerance", "step", "repeatability")
"""Keys that apply if the operator types all weights."""


class BalanceSettings(Settings):
    """The balance: its placement and its connection, as frozen values that are sent to the bench's machine.

    A package adds a kind with a subclass and its `BalanceKind`.
    """

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "serial"
    plugins: ClassVar[str] = "decant.balances"

    receives_load: ClassVar[bool] = False
    """Whether, on a virtual bench, the driver itself receives the load instead of an emulator. It then has `prepare`
    and `put` as in `actors.balance.simulated_balance.VirtualBalance`."""

    kind: str = ""
    """Kind of the balance; a literal in each subclass, equal to its registered name."""

    placement: Literal["tray", "receiver", "everything", "manual"] = "tray"
    """Load of the balance: 'tray' reads the spill, 'receiver' the received liquid, 'everything' the poured liquid; with 'manual' the operator types all weights."""  # noqa: E501

    pourer: Literal["here", "elsewhere"] = "here"
    """Where the pourer is weighed: on this balance, or on another one whose weight is typed."""

    load_tolerance: PositiveMass = 5e-3
    """Largest difference between a load and the load of the campaign."""

    time_scale: Annotated[float, SET_BY_PROGRAM] = 1.0
    """Bench seconds per second of the clock; 1 for a real device, 0 disables waiting."""

    clock: Annotated[str, SET_BY_PROGRAM] = ""
    """File of the clock that the devices of a virtual bench share (`actors.runtime.bench_clock`); '' on hardware."""

    def check_laboratory(self, problems: Problems, *, mode: str) -> None:
        """Add a problem for each combination of values that is invalid in a laboratory.

        Args:
            problems: of these settings.
            mode: 'virtual' or 'hardware'.
        """

    def check_manual(self, problems: Problems) -> None:
        """Add a problem for each key that has no effect if the operator types all weights."""
        for key, name in self.written_keys().items():
            if name in self.model_fields_set and name not in _TYPED:
                problems.add("is not used with placement 'manual', where the operator types all weights", key)

    @property
    def typed(self) -> bool:
        """Whether the operator types all weights; then there is no device."""
        return self.placement == "manual"

    @property
    def position(self) -> Placement:
        """The load of the balance."""
        return Placement(self.placement)

    @property
    def deviation(self) -> float:
        """Standard deviation of repeated weighings of the same load [kg]; 0 if unknown."""
        return 0.0

    @property
    def longest_call(self) -> float:
        """Upper limit of a call's duration [s of the clock]; deadlines around the driver should be a little longer."""
        return 120.0


B = TypeVar("B", bound=BalanceSettings)


class BalanceKind(ABC, Generic[B]):
    """One kind of balance: joins its settings with driver, emulator and diagnostics.

    A subclass is registered in the entry-point group `decant.balances` under the `kind` of its settings.

    Args:
        spec: settings of one balance.
    """

    settings: ClassVar[type[BalanceSettings]]
    """Class of the settings."""

    def __init__(self, spec: B) -> None:
        self.spec = spec

    @abstractmethod
    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (an `actors.balance.balance_interface.BalanceDriver`, importable by name) and
        its arguments.

        Args:
            name: for messages.
        """

    def start_emulator(self) -> BalanceEmulator | None:
        """Start the emulator on a virtual bench; None if the device needs none."""
        return None

    def diagnostics(self, *, tare: bool) -> list[DeviceCheck]:
        """Return the checks of `decant robot check`: identification, a stable reading, its step, and optionally a tare.

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
            if self.spec.position in (Placement.RECEIVER, Placement.EVERYTHING):
                checks.append(_doses(driver, weight.step, self.spec.time_scale))
            if tare:
                driver.tare()
                checks.append(DeviceCheck("balance tare", "ok", "it obeyed, and rests at zero"))
            else:
                text = "not tried; --tare tries it (what is on it counts as nothing then)"
                checks.append(DeviceCheck("balance tare", "ok", text))
        except LaboratoryError as error:
            todo = "docs/reference/messages.md lists causes and remedies"
            checks.append(DeviceCheck("balance", "fail", str(error), todo))
        finally:
            driver.close()
        return checks


def _doses(driver: BalanceDriver, step: float, time_scale: float) -> DeviceCheck:
    """The tolerance of doses with the readings of some seconds."""
    times, end = [driver.read().time], time.monotonic() + OBSERVED / max(time_scale, 1.0)
    while time.monotonic() < end and len(times) < 10:
        time.sleep(0.01)
        if (moment := driver.read().time) > times[-1]:
            times.append(moment)
    if len(times) < 3:
        text = f"{len(times) - 1} new readings in {OBSERVED:g} s; doses need one each second or more"
        return DeviceCheck("balance readings", "warn", text, "set a faster output")
    interval = time_scale * (times[-1] - times[0]) / (len(times) - 1)
    tolerance = dose_tolerance(DosingSettings().smallest_flow, 0.0, (interval,), step, 0.0)
    text = f"one each {interval:.2f} s; doses can be within {1e3 * tolerance:.2g} g in 95 % of the cases"
    slow = tolerance > SLOW_DOSE
    return DeviceCheck("balance readings", "warn" if slow else "ok", text, "set a faster output" if slow else "")


def balance_kind(spec: BalanceSettings) -> BalanceKind[Any]:
    """The kind of a balance, for its settings."""
    kind: BalanceKind[Any] = drivers()[spec.kind](spec)
    return kind


def dialect_names() -> list[str]:
    """Allowed values of `dialect`: all installed dialects, and automatic detection."""
    return [AUTO, *dialects()]


class SerialBalanceSettings(BalanceSettings):
    """A balance on a serial line."""

    kind: Literal["serial"] = "serial"
    """A balance on a serial line."""

    port: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Serial port, or host:port of a serial server or a balance in the network. Names under /dev/serial/by-id/ do not change when the balance is reconnected."""  # noqa: E501

    virtual: ScaleSettings | None = None
    """A virtual balance instead of a port."""

    dialect: Annotated[str, Choice(dialect_names)] = AUTO
    """Protocol of the balance; 'auto' detects it."""

    baud: Annotated[PositiveCount | None, NOT_IN_FINGERPRINT] = None
    """Bits per second; detected unless given."""

    format: Annotated[Text | None, NOT_IN_FINGERPRINT] = None
    """Bits, parity and stop bits, e.g. 8N1 (write '7E1' in quotes; it is a number in YAML); detected unless given."""

    handshake: Annotated[Literal["none", "software", "hardware"], NOT_IN_FINGERPRINT] = "none"
    """Flow control by the balance: characters (Xon/Xoff), wires (CTS), or none."""

    dtr: Annotated[bool, NOT_IN_FINGERPRINT] = True
    """Whether the wire DTR is on; some balances stay silent without it."""

    rts: Annotated[bool, NOT_IN_FINGERPRINT] = True
    """Whether the wire RTS is on; some balances stay silent without it. With handshake 'hardware' it follows the handshake."""  # noqa: E501

    weight: Annotated[Literal["net", "gross"], NOT_IN_FINGERPRINT] = "net"
    """Weight that counts if the balance marks its lines as net or gross. With 'gross' no tare is sent: the driver subtracts the weight at the tare. Lines without a mark always count, and gross lines count as net until there is a tare."""  # noqa: E501

    step: PositiveMass | None = None
    """Step of the display, if it is not one unit of the last digit."""

    repeatability: Error = 0.0
    """Standard deviation of repeated weighings of the same load, from the data sheet."""

    settling: SettlingRule = SettlingRule()
    """Criteria for a settled weight."""

    interval: Annotated[float, Quantity("s", "0.15 s", 0.02, 5.0)] = 0.15
    """Time between two requests for a reading."""

    answer_time: PositiveDuration = 1.0
    """Maximum time to wait for a reply."""

    reconnect_time: Annotated[float, Quantity("s", "1.5 s", 0.0, 600.0), NOT_IN_FINGERPRINT] = 20.0
    """Maximum time to wait for a port that has disappeared."""

    raw_lines: Annotated[FilePath | None, NOT_IN_FINGERPRINT] = None
    """Folder for recordings of the balance's raw lines: a file for each connection, as `decant balance record` writes it."""  # noqa: E501

    def check_laboratory(self, problems: Problems, *, mode: str) -> None:
        """See `BalanceSettings.check_laboratory`."""
        if not self.typed:
            self._check_port(problems, mode)
            self._check_line(problems)
        if self.settling.deadline <= self.settling.span:
            problems.add("nothing can settle: 'deadline' should be longer than 'span'", "settling")
        elif self.settling.deadline <= self.settling.hold:
            problems.add("nothing can settle: 'deadline' should be longer than 'hold'", "settling")

    def _check_port(self, problems: Problems, mode: str) -> None:
        if self.port and self.virtual is not None:
            problems.add("a balance has a 'port' or is 'virtual', not both", "virtual")
        elif mode == "hardware" and self.virtual is not None:
            problems.add("a laboratory of hardware weighs on a balance that is there; give its 'port'", "virtual")
        elif mode != "hardware" and self.port:
            problems.add("a virtual laboratory has no port; write 'virtual: {}', or 'mode: hardware'", "port")
        elif not self.port and self.virtual is None:
            example = "port: /dev/serial/by-id/usb-…" if mode == "hardware" else "virtual: {resolution: 0.1 g}"
            text = f"placement '{self.placement}' reads the balance; add '{example}', or type: 'manual'"
            problems.add(text, of="port")

    def _check_line(self, problems: Problems) -> None:
        if tcp_address(self.port) is not None:
            for key in ("baud", "format", "handshake", "dtr", "rts"):
                if key in self.model_fields_set:
                    problems.add("has no effect over TCP; set it in the serial server", key)
        if self.baud is not None and self.baud not in USUAL_BAUDS:
            usual = ", ".join(str(baud) for baud in USUAL_BAUDS)
            problems.add(f"no balance talks at {self.baud} baud; should be one of {usual}", "baud")
        if self.step is not None:
            check_step(self.step, self.load_tolerance, problems, "step")
        if self.virtual is not None:
            check_step(self.virtual.resolution, self.load_tolerance, problems, "virtual", "resolution")
        if self.format is not None:
            try:
                parse_format(self.format)
            except ValueError as error:
                problems.add(str(error), "format")

    @property
    def deviation(self) -> float:
        """See `BalanceSettings.deviation`."""
        return self.repeatability

    @property
    def longest_call(self) -> float:
        """See `BalanceSettings.longest_call`."""
        return 4.0 * self.settling.deadline / self.time_scale + 4.0 * self.reconnect_time + 60.0

    @property
    def allowed(self) -> tuple[Dialect, ...]:
        """Dialects that the balance may use."""
        return tuple(dialects().values()) if self.dialect == AUTO else (dialects()[self.dialect],)

    def candidates(self) -> tuple[LineSettings, ...]:
        """Line settings to try, the most likely first."""
        if tcp_address(self.port) is not None:
            return (LineSettings(0),)
        usual = _interleaved([dialect.lines for dialect in self.allowed])
        if self.baud is None and self.format is None:
            return usual
        forms = [parse_format(self.format)] if self.format is not None else [(s.bits, s.parity, s.stop) for s in usual]
        bauds = [self.baud] if self.baud is not None else [s.baud for s in usual]
        if self.format is None:  # a known speed: the usual formats at any speed
            return tuple(dict.fromkeys(LineSettings(bauds[0], *form) for form in forms))
        return tuple(dict.fromkeys(LineSettings(baud, *forms[0]) for baud in bauds))


def check_step(step: float, tolerance: float, problems: Problems, *at: str) -> None:
    """Add a problem if a display is too coarse to check a load.

    Args:
        step: of the display [kg].
        tolerance: of the load [kg].
        problems: of the balance's settings.
        at: keys of the step.
    """
    if step > tolerance:
        problems.add(
            f"a display in steps of {1e3 * step:g} g can't tell whether a load lies within load_tolerance, "
            f"{1e3 * tolerance:g} g; weigh on a finer balance, or raise load_tolerance",
            *at,
        )


def parse_format(text: str) -> tuple[int, str, int]:
    """Parse a character format: '7O1' → (7, 'O', 1).

    Raises:
        ValueError: not bits 7 or 8, parity N, O or E, stop bits 1 or 2.
    """
    if len(text) != 3 or text[0] not in "78" or text[1].upper() not in "NOE" or text[2] not in "12":
        raise ValueError(f"'{text}' should be bits, parity and stop bits, as '8N1' or '7O1'")
    return int(text[0]), text[1].upper(), int(text[2])


def _interleaved(tables: list[tuple[LineSettings, ...]]) -> tuple[LineSettings, ...]:
    """Merge the tables: the first entries of all, the most common first, then the second entries, and so on."""
    ranks = [[line for line in rank if line is not None] for rank in zip_longest(*tables)]
    return tuple(dict.fromkeys(line for rank in ranks for line, _ in Counter(rank).most_common()))


def balance_diagnostics(balance: BalanceSettings | None, *, tare: bool) -> list[DeviceCheck]:
    """Identification, a stable reading and its step, and optionally a tare.

    Args:
        balance: as in the laboratory's file, its address filled in.
        tare: also tare it.
    """
    if balance is None:
        return [DeviceCheck("balance", "fail", "the file has none", "add a 'balance' section, or 'placement: manual'")]
    if balance.typed:
        return [DeviceCheck("balance", "ok", "all weights are typed by the operator")]
    return balance_kind(balance).diagnostics(tare=tare)
