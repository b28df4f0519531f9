"""A tap with a valve, and a strip that conducts when it is wet: devices of a bench besides arm and balance.

`Valve` and `Wires` are the devices; in this example they are objects, and real ones are at the end of a cable. A tap
may fill the source vessel again (`source: {refill: {kind: tap}}`). The balance under a source vessel is a balance as
any other, see `balance.py`.
"""

from __future__ import annotations

import threading
import time
from typing import Annotated, Any, Literal

from decant.plugins import (
    SET_BY_PROGRAM,
    LaboratoryError,
    PumpSettings,
    PumpStoppedError,
    SpillEvent,
    SpillSensorSettings,
    Text,
)


class TapSettings(PumpSettings):
    """A tap with a valve."""

    kind: Literal["tap"] = "tap"
    """A tap with a valve, which is opened for a time."""

    metering: Annotated[Literal["time"], SET_BY_PROGRAM] = "time"
    """The driver has `run`."""

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `PumpSettings.driver`."""
        return Tap, (self,)


class Valve:
    """The tap itself: 4 mL/s flow while it is open.

    Attributes:
        plugged: its cable is connected.
    """

    def __init__(self) -> None:
        self.plugged = True
        self._opened: float | None = None
        self._flowed = 0.0

    def turn(self, *, opened: bool) -> None:
        """Open or close it.

        Raises:
            ConnectionError: the cable is not connected.
        """
        if not self.plugged:
            raise ConnectionError("the tap does not answer")
        self._flowed, self._opened = self.flowed, time.monotonic() if opened else None

    @property
    def flowed(self) -> float:
        """Volume that has left it [m³]."""
        return self._flowed + (0.0 if self._opened is None else 4e-6 * (time.monotonic() - self._opened))


class Tap:
    """The driver; see `decant.plugins.Pump`.

    Args:
        settings: nominal flow.
        valve: the tap itself; its own by default.
    """

    def __init__(self, settings: TapSettings, valve: Valve | None = None) -> None:
        self._settings = settings
        self._valve = valve or Valve()
        self._stopped = threading.Event()

    def connect(self) -> str:
        """See `Pump.connect`; the valve is closed."""
        self._turn(opened=False)
        return "a tap"

    def dispense(self, volume: float) -> None:
        """Not used: `metering` is 'time'."""
        raise LaboratoryError("a tap measures no volume")

    def run(self, seconds: float) -> None:
        """See `Pump.run`."""
        self._stopped.clear()
        self._turn(opened=True)
        stopped = self._stopped.wait(seconds / self._settings.time_scale)
        self._turn(opened=False)
        if stopped:
            raise PumpStoppedError("the tap was closed before the time was over")

    def stop(self) -> None:
        """See `Pump.stop`."""
        self._stopped.set()

    def close(self) -> None:
        """See `Pump.close`."""
        self.stop()

    def _turn(self, *, opened: bool) -> None:
        try:
            self._valve.turn(opened=opened)
        except ConnectionError as error:
            raise LaboratoryError(f"{error}; look at its cable, and close it by hand") from error


class StripSettings(SpillSensorSettings):
    """A conductivity strip."""

    kind: Literal["strip"] = "strip"
    """A strip that conducts when it is wet."""

    place: Text = "strip"
    """Name of its place on the table."""

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `SpillSensorSettings.driver`."""
        return Strip, (self,)


class Wires:
    """The strip itself.

    Attributes:
        wet: there is liquid on it.
        plugged: its cable is connected.
    """

    def __init__(self) -> None:
        self.wet, self.plugged = False, True

    def conducts(self) -> bool:
        """Whether it conducts.

        Raises:
            ConnectionError: the cable is not connected.
        """
        if not self.plugged:
            raise ConnectionError("the strip does not answer")
        return self.wet


class Strip:
    """The driver; see `decant.plugins.SpillSensor`.

    Args:
        settings: its place.
        wires: the strip itself; its own by default.
    """

    def __init__(self, settings: StripSettings, wires: Wires | None = None) -> None:
        self._settings = settings
        self._wires = wires or Wires()
        self._wet = False

    def connect(self) -> str:
        """See `SpillSensor.connect`."""
        self._read()
        return f"a strip: {self._settings.place}"

    def events(self) -> list[SpillEvent]:
        """See `SpillSensor.events`."""
        before, self._wet = self._wet, self._read()
        return [] if self._wet == before else [SpillEvent(time.time(), self._wet, self._settings.place)]

    def close(self) -> None:
        """See `SpillSensor.close`."""

    def _read(self) -> bool:
        try:
            return self._wires.conducts()
        except ConnectionError as error:
            raise LaboratoryError(f"{error}; look at its cable") from error
