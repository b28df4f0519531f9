"""Devices of a bench besides arm and balance: refill pumps, spill sensors, and a balance under the source vessel.

- `Pump` is a driver that fills the source vessel again: a pump, or a tap with a valve. `PumpSettings` are its settings,
  `PUMPS` the installed kinds.
- `SpillSensor` is a driver that reports a wet table as `SpillEvent`s; `SpillSensorSettings`, `SPILL_SENSORS`.
- `SourceSettings` is a laboratory's section `source`: the refill pump, and a balance under the source vessel.

Each has a simulated kind here. The steps of a bench with these devices are in `actors.bench.liquid_supply`. Drivers are
plain, blocking classes and run in a process of their own.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol, cast

import numpy as np

from actors.balance.balance_settings import BalanceSettings
from actors.balance.dialect_registry import kinds
from actors.grippers.gripper_interface import Gripper, GripperSettings
from actors.interfaces import DeviceCheck, LaboratoryError
from actors.runtime.bench_clock import Pace
from sim_engine.settings.model import SET_BY_PROGRAM, OneOf, Problems, Settings, Text
from sim_engine.settings.plugin_registry import PluginRegistry, settings_kind
from sim_engine.settings.quantity import Quantity

Flow = Annotated[float, Quantity("m^3/s", "5 mL/s", 0.0, 1e-3, positive=True)]
Volume = Annotated[float, Quantity("m^3", "0.2 mL", 0.0, 1e-2, positive=True)]
Fraction = Annotated[float, Quantity("1", "0.03", 0.0, 1.0)]


class PumpStoppedError(LaboratoryError):
    """A pump was stopped before it had moved all that was requested."""


class Pump(Protocol):
    """Driver of a pump or of a tap. A kind implements `dispense` or `run`, as its `PumpSettings.metering` states."""

    def connect(self) -> str:
        """Connect and identify the device; nothing flows. Returns its description. May be called again.

        Raises:
            LaboratoryError: it cannot be reached.
        """
        ...

    def dispense(self, volume: float) -> None:
        """Move a volume [m³]; return when the flow has ended.

        Raises:
            PumpStoppedError: `stop` was called meanwhile.
            LaboratoryError: it failed; an unknown part has flowed.
        """
        ...

    def run(self, seconds: float) -> None:
        """Let liquid flow for a time [s]; return when the flow has ended. Raises as `dispense`."""
        ...

    def stop(self) -> None:
        """End the flow at once; callable from another thread. Later requests are carried out again."""
        ...

    def close(self) -> None:
        """Stop and release the device; never fails; may be called again."""
        ...


class PumpSettings(Settings):
    """Base class of a pump's settings. `kind` of a subclass is its name in the entry-point group `decant.pumps`."""

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "simulated"
    plugins: ClassVar[str] = "decant.pumps"

    simulates: ClassVar[bool] = False
    """Whether the driver only simulates, for virtual laboratories. It then has `prepare` and `moved` as
    `SimulatedPump`."""

    kind: str = ""
    """Kind of the pump."""

    metering: Annotated[Literal["volume", "time"], SET_BY_PROGRAM] = "volume"
    """Whether the driver has `dispense` ('volume') or `run` ('time')."""

    flow: Flow = 4e-6
    """Nominal flow."""

    smallest: Volume = 0.2e-6
    """Smallest dependable volume."""

    time_scale: Annotated[float, SET_BY_PROGRAM] = 1.0
    """Bench seconds per second of the clock; 0 to skip all waits."""

    @abstractmethod
    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (a `Pump`), importable by name, and its arguments."""

    def check_laboratory(self, problems: Problems, *, mode: str) -> None:
        """Add a problem for each value that does not fit the laboratory.

        Args:
            problems: of these settings.
            mode: 'virtual' or 'hardware'.
        """

    def request(self, volume: float) -> tuple[str, float]:
        """The driver's method and its argument that move a volume [m³]."""
        return ("dispense", volume) if self.metering == "volume" else ("run", volume / self.flow)


@dataclass(frozen=True)
class SpillEvent:
    """A change that a spill sensor has seen.

    Attributes:
        time: seconds since 1970.
        wet: whether the place is wet from now on.
        place: name of the place, for the operator.
    """

    time: float
    wet: bool
    place: str


class SpillSensor(Protocol):
    """Driver of a sensor that watches for spills: a camera above the table, or a conductivity strip."""

    def connect(self) -> str:
        """Connect and identify the sensor; returns its description. May be called again.

        Raises:
            LaboratoryError: it cannot be reached.
        """
        ...

    def events(self) -> list[SpillEvent]:
        """The changes since the last call, in order; the first call reports the places that are wet. Never waits.

        Raises:
            LaboratoryError: the sensor does not answer.
        """
        ...

    def close(self) -> None:
        """Release the sensor; never fails; may be called again."""
        ...


class SpillSensorSettings(Settings):
    """Base class of a spill sensor's settings. `kind` of a subclass is its name in `decant.spill_sensors`."""

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "simulated"
    plugins: ClassVar[str] = "decant.spill_sensors"

    simulates: ClassVar[bool] = False
    """Whether the driver only simulates, for virtual laboratories. It then has `spill` and `wipe` as
    `SimulatedSpillSensor`."""

    kind: str = ""
    """Kind of the sensor."""

    @abstractmethod
    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (a `SpillSensor`), importable by name, and its arguments."""

    def check_laboratory(self, problems: Problems, *, mode: str) -> None:
        """See `PumpSettings.check_laboratory`."""


PUMPS: PluginRegistry[type[PumpSettings]] = PluginRegistry("decant.pumps", "pump", settings_kind(PumpSettings))
"""Settings classes of all installed kinds of pumps."""

SPILL_SENSORS: PluginRegistry[type[SpillSensorSettings]] = PluginRegistry(
    "decant.spill_sensors", "spill sensor", settings_kind(SpillSensorSettings)
)
"""Settings classes of all installed kinds of spill sensors."""


class SourceSettings(Settings):
    """Devices at the source vessel."""

    balance: Annotated[BalanceSettings, OneOf(kinds)] | None = None
    """Balance under the place with `use: source`; the refill pump then fills by weight."""

    refill: Annotated[PumpSettings, OneOf(lambda: PUMPS.all)] | None = None
    """Pump or tap that fills the source vessel again; the operator fills it unless given."""

    refill_error: Fraction = 0.03
    """Standard deviation of a refilled amount, relative to it."""


def check_devices(
    problems: Problems,
    mode: str,
    source: SourceSettings | None,
    sensor: SpillSensorSettings | None,
    *,
    at_source: bool,
) -> None:
    """Add a problem for each device of a laboratory that does not fit its mode.

    Args:
        problems: of the laboratory, whose keys `source` and `spill_sensor` are.
        mode: 'virtual' or 'hardware'.
        source, sensor: the sections; None if they are missing.
        at_source: whether the laboratory has a place under the outlet of the refill pump.
    """
    devices: list[tuple[tuple[str, ...], PumpSettings | SpillSensorSettings | None]] = [
        (("source", "refill"), None if source is None else source.refill),
        (("spill_sensor",), sensor),
    ]
    for keys, device in devices:
        if device is None:
            continue
        if device.simulates and mode == "hardware":
            problems.add(f"'{device.kind}' only simulates; a laboratory of hardware names its own kind", *keys)
        elif not device.simulates and mode == "virtual":
            problems.add(f"'{device.kind}' is a real device; write 'mode: hardware', or 'kind: simulated'", *keys)
        device.check_laboratory(problems.within(*keys), mode=mode)
    if source is None or source.balance is None:
        return
    inner = problems.within("source", "balance")
    if not at_source or source.refill is None:
        text = "stands under the place where a pump fills the pourer; add 'refill' and a place with 'use: source'"
        problems.add(text, "source", "balance")
    elif source.balance.typed:
        inner.add("a balance under the source vessel is read without the operator", "placement")
    elif mode == "virtual" and not source.balance.receives_load:
        problems.add("is not emulated at the source; write 'kind: simulated'", "source", "balance")
    else:
        source.balance.check_laboratory(inner, mode=mode)


def device_checks(
    source: SourceSettings | None = None,
    sensor: SpillSensorSettings | None = None,
    gripper: GripperSettings | None = None,
) -> list[DeviceCheck]:
    """Connect each device of a laboratory in turn, and release it; nothing flows, no finger moves.

    Args:
        source, sensor, gripper: the sections; None if they are missing.
    """
    devices: list[tuple[str, PumpSettings | SpillSensorSettings | GripperSettings | None]] = [
        ("refill", None if source is None else source.refill),
        ("spill sensor", sensor),
        ("gripper", gripper),
    ]
    return [_device_check(name, device) for name, device in devices if device is not None]


def _device_check(name: str, settings: PumpSettings | SpillSensorSettings | GripperSettings) -> DeviceCheck:
    cls, arguments = settings.driver()
    driver: Pump | SpillSensor | Gripper = cls(*arguments)
    try:
        model = driver.connect()
        if isinstance(settings, GripperSettings):
            problem = cast("Gripper", driver).state().problem
            if problem:
                return DeviceCheck(name, "warn", model, "a pour asks for what it needs; see docs/reference/grippers.md")
        if isinstance(settings, SpillSensorSettings):
            wet = [event.place for event in cast("SpillSensor", driver).events() if event.wet]
            if wet:
                return DeviceCheck(name, "warn", f"{model}; wet: {', '.join(wet)}", "wipe it before the first pour")
        return DeviceCheck(name, "ok", model)
    except LaboratoryError as error:
        return DeviceCheck(name, "fail", str(error), "check power, cable and address")
    finally:
        driver.close()


class SimulatedPumpSettings(PumpSettings):
    """A simulated pump, in a virtual laboratory."""

    simulates: ClassVar[bool] = True

    kind: Literal["simulated"] = "simulated"
    """A simulated pump."""

    metering: Literal["volume", "time"] = "volume"
    """Whether it doses by volume or by time."""

    factor: Annotated[float, Quantity("1", "0.96", 0.1, 10.0)] = 0.96
    """True flow, relative to the nominal one."""

    scatter: Fraction = 0.005
    """Standard deviation of a volume, relative to it."""

    time_scale: Annotated[float, Quantity("1", "10", 0.0, 1e6)] = 1.0
    """Bench seconds per second of the clock; 0 means no waiting."""

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `PumpSettings.driver`."""
        return SimulatedPump, (self,)


class SimulatedPump:
    """Driver of a simulated pump, see `Pump`.

    Args:
        settings: flow and errors.
    """

    def __init__(self, settings: SimulatedPumpSettings) -> None:
        self._settings = settings
        self._pace = Pace(settings.time_scale)
        self._moved = self._told = 0.0
        self._rate = self._seconds = 0.0
        self.prepare((0,))

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Seed the scatter of the next dose."""
        self._rng = np.random.default_rng(seed)

    def moved(self) -> float:
        """The true volume that has left the pump since the last call [m³]."""
        total = self._moved + self._flowing
        moved, self._told = total - self._told, total
        return moved

    @property
    def _flowing(self) -> float:
        """Volume of the present request so far [m³]."""
        return self._rate * min(self._pace.now, self._seconds) if self._rate > 0.0 else 0.0

    def connect(self) -> str:
        """See `Pump.connect`."""
        return f"a simulated pump, {1e6 * self._settings.flow:g} mL/s"

    def dispense(self, volume: float) -> None:
        """See `Pump.dispense`."""
        self.run(volume / self._settings.flow)

    def run(self, seconds: float) -> None:
        """See `Pump.run`."""
        settings = self._settings
        factor = settings.factor * (1.0 + settings.scatter * float(self._rng.standard_normal()))
        self._pace.restart()
        self._pace.resume()
        self._seconds, self._rate = seconds, factor * settings.flow
        done = self._pace.wait_until(seconds)
        flowed = self._rate * seconds if done else self._flowing
        self._rate = 0.0
        self._moved += flowed
        if not done:
            raise PumpStoppedError("the pump was stopped")

    def stop(self) -> None:
        """See `Pump.stop`."""
        self._pace.interrupt()

    def close(self) -> None:
        """See `Pump.close`."""
        self.stop()


class SimulatedSpillSensorSettings(SpillSensorSettings):
    """A simulated spill sensor, in a virtual laboratory."""

    simulates: ClassVar[bool] = True

    kind: Literal["simulated"] = "simulated"
    """A simulated spill sensor."""

    smallest: Annotated[float, Quantity("kg", "0.5 g", 0.0, 1.0)] = 0.5e-3
    """Smallest mass on the table that it sees."""

    place: Text = "table"
    """Name of the place that it watches."""

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `SpillSensorSettings.driver`."""
        return SimulatedSpillSensor, (self,)


class SimulatedSpillSensor:
    """Driver of a simulated spill sensor, see `SpillSensor`.

    Args:
        settings: place and smallest mass.
    """

    def __init__(self, settings: SimulatedSpillSensorSettings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._mass = 0.0
        self._wet = False
        self._events: list[SpillEvent] = []

    def spill(self, mass: float) -> None:
        """More liquid lies on the table [kg]."""
        with self._lock:
            self._mass += mass
            self._see()

    def wipe(self) -> None:
        """The operator has wiped the table."""
        with self._lock:
            self._mass = 0.0
            self._see()

    def _see(self) -> None:
        wet = self._mass > self._settings.smallest
        if wet != self._wet:
            self._wet = wet
            self._events.append(SpillEvent(time.time(), wet, self._settings.place))

    def connect(self) -> str:
        """See `SpillSensor.connect`."""
        return f"a simulated spill sensor: {self._settings.place}"

    def events(self) -> list[SpillEvent]:
        """See `SpillSensor.events`."""
        with self._lock:
            events, self._events = self._events, []
        return events

    def close(self) -> None:
        """See `SpillSensor.close`."""
