"""A model of a scale: the weighing cell, its display and its range, in bench time.

`ScaleSettings` is its data sheet. `EmulatedScale` shows what an emulated serial balance sends; it has no bytes and no
clock. Habits of real displays are in `display_behaviour`, the driver of a simulated balance in `simulated_balance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Annotated

import numpy as np

from actors.balance.display_behaviour import IDEAL, DisplayBehaviour, DisplayModel
from actors.balance.readings import KILOGRAMS, Reading, ReadingStatus
from sim_engine.settings.model import SET_BY_PROGRAM, Settings
from sim_engine.settings.quantity import Quantity

Error = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01)]
"""Error of a weighing. A balance with an error of 10 g cannot measure a spill."""
Drift = Annotated[float, Quantity("kg/s", "0.01 g/s", -0.01, 0.01)]
PositiveMass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.1, positive=True)]
Duration = Annotated[float, Quantity("s", "1.5 s", 0.0, 600.0)]
PositiveDuration = Annotated[float, Quantity("s", "20 s", 0.0, 600.0, positive=True)]


@dataclass(frozen=True)
class Load:
    """The load on the tray from now on.

    Attributes:
        times: since now, increasing [s].
        masses: on the tray at these times [kg]; linear in between, constant after the last.
    """

    times: tuple[float, ...]
    masses: tuple[float, ...]


SETTLED = math.log(100.0)
"""Number of time constants until the display is within 1 % of a change."""

_STEP = 0.01


class ScaleSettings(Settings):
    """Data sheet of a virtual balance."""

    resolution: PositiveMass = 1e-4
    """Step of the display."""

    capacity: Annotated[float, Quantity("kg", "6.2 kg", 0.0, 1000.0, positive=True)] = 6.2
    """Maximum load."""

    noise: Error = 0.0
    """Standard deviation of repeated weighings of the same load."""

    drift: Drift = 0.0
    """Drift of the zero."""

    settling_time: Duration = 1.5
    """Time until the display is within 1 % of a change."""

    behaviour: DisplayBehaviour = IDEAL
    """How its display departs from an ideal one: repeated and late readings, zero tracking, creep."""

    rest_time: Annotated[float, SET_BY_PROGRAM] = 0.3
    """Time without change until the display is stable [s]."""

    unit: Annotated[str, SET_BY_PROGRAM] = "g"
    """Unit of the display."""

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request: an ideal display, which runs of earlier versions lack."""
        return frozenset({"behaviour"} if self.behaviour == IDEAL else ())


ZERO_SHARE = 0.02
"""Largest load for a zero command, as a fraction of the capacity."""


class EmulatedScale:
    """The weighing cell and its display, in bench time."""

    def __init__(self, settings: ScaleSettings, seed: tuple[int, ...] = (0,)) -> None:
        self.settings = settings
        factor = Decimal(repr(KILOGRAMS[settings.unit]))
        step = (Decimal(repr(settings.resolution)) / factor).normalize()
        self._decimal_step = step if step.as_tuple().exponent <= 0 else step.quantize(Decimal(1))  # type: ignore[operator]
        self.prepare(seed)

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty the scale, set bench time to 0, clear the tare, and reseed the noise."""
        self._rng = np.random.default_rng(seed)
        self.time = 0.0
        self._tare = self._zero = self._offset = 0.0
        self._load, self._loaded_at = Load((0.0,), (0.0,)), 0.0
        self._lagging = 0.0
        self._resting = math.inf
        self._display = DisplayModel(self.settings.behaviour, self.settings.resolution, seed)
        self._seen, self._still_since = Decimal(0), -math.inf

    def put(self, load: Load) -> None:
        """Change the load, now and in the future."""
        self._load, self._loaded_at = load, self.time
        self._offset = float(self._rng.normal(0.0, self.settings.noise))
        self._resting = 0.0
        self._still_since = self.time

    def change(self, mass: float) -> None:
        """Change the mass on the tray [kg] while liquid flows: the same load goes on, with the same error."""
        if mass != self.truth:
            self._load, self._loaded_at = Load((0.0,), (mass,)), self.time
            self._resting = 0.0

    def advance(self, seconds: float) -> None:
        """Let bench time pass [s]."""
        end = self.time + seconds
        lag = self.settings.settling_time / SETTLED
        while self.time < end:
            before = self._true(self.time)
            ended = self.time >= self._loaded_at + self._load.times[-1]
            if self._lagging == before and ended and self._display.settled:
                remaining, self.time = end - self.time, end
                self._resting += remaining
                self._display.advance(self._filtered, remaining, self._zero + self._tare)
                return
            step = min(_STEP, end - self.time)
            self.time = min(self.time + step, end)
            target = self._true(self.time)
            self._lagging += (target - self._lagging) * (-math.expm1(-step / lag) if lag > 0.0 else 1.0)
            arrived = before == target and abs(target - self._lagging) < self.settings.resolution / 8.0
            if arrived:
                self._lagging = target
            self._display.advance(self._filtered, step, self._zero + self._tare)
            self._resting = self._resting + step if arrived and self._display.settled else 0.0

    @property
    def stable(self) -> bool:
        """Whether the balance reports its display as stable."""
        still = self.time - self._still_since if self.settings.behaviour.stable_display else self._resting
        return still >= self.settings.rest_time

    @property
    def gross(self) -> float:
        """Load as measured by the cell [kg]; 0 after switching on."""
        return (self._display.value if self.settings.behaviour.acts else self._filtered) - self._zero

    @property
    def display(self) -> DisplayModel:
        """The model that delays and loses readings."""
        return self._display

    @property
    def _filtered(self) -> float:
        return self._lagging + self._offset + self.settings.drift * self.time

    @property
    def truth(self) -> float:
        """The true load now [kg]."""
        return self._true(self.time)

    def tare(self) -> ReadingStatus:
        """Tare the scale; the status reports whether the load is within range."""
        if self.range is not ReadingStatus.STABLE:
            return self.range
        self._tare = self.gross
        return ReadingStatus.STABLE

    def clear_tare(self) -> None:
        """Clear the tare."""
        self._tare = 0.0

    @property
    def tared(self) -> Decimal:
        """The tare as displayed, in the unit."""
        return self._rounded(self._tare)

    def preset_tare(self, mass: float) -> bool:
        """Set the tare to a known mass [kg]. Returns whether it is within the range."""
        if not 0.0 <= mass <= self.settings.capacity:
            return False
        self._tare = mass
        return True

    @property
    def capacity(self) -> Decimal:
        """The maximum load as displayed, in the unit."""
        return self._rounded(self.settings.capacity)

    @property
    def step(self) -> Decimal:
        """Step of the display, in the unit."""
        return self._decimal_step

    def zero(self) -> ReadingStatus:
        """Set the zero; refused if the load exceeds `ZERO_SHARE` of the capacity."""
        if abs(self.gross) > ZERO_SHARE * self.settings.capacity:
            return ReadingStatus.OVER if self.gross > 0.0 else ReadingStatus.UNDER
        self._zero += self.gross
        self._tare = 0.0
        return ReadingStatus.STABLE

    def power_cycle(self) -> None:
        """Switch the scale off and on: the current load becomes the zero, and the tare is cleared."""
        self._zero += self.gross
        self._tare = 0.0

    @property
    def range(self) -> ReadingStatus:
        """STABLE if the load is within range, otherwise OVER or UNDER."""
        if self.gross > self.settings.capacity + 9.0 * self.settings.resolution:
            return ReadingStatus.OVER
        return ReadingStatus.UNDER if self.gross < -0.2 * self.settings.capacity else ReadingStatus.STABLE

    def reading(self) -> Reading:
        """Return the display's next reading."""
        reading = self._display.show(self._new_reading)
        if not self.settings.behaviour.stable_display or reading.value is None:
            return reading
        if abs(reading.value - self._seen) > self._decimal_step:
            self._seen, self._still_since = reading.value, self.time
        return replace(reading, status=ReadingStatus.STABLE if self.stable else ReadingStatus.UNSTABLE)

    def _new_reading(self) -> Reading:
        if self.range is not ReadingStatus.STABLE:
            return Reading(self.range)
        status = ReadingStatus.STABLE if self.stable else ReadingStatus.UNSTABLE
        return Reading(status, self._rounded(self.gross - self._tare), self.settings.unit)

    def _rounded(self, mass: float) -> Decimal:
        """Round a mass to digits of the display."""
        steps = round(mass / self.settings.resolution)
        return steps * self._decimal_step if steps else abs(0 * self._decimal_step)

    def _true(self, moment: float) -> float:
        return float(np.interp(moment - self._loaded_at, self._load.times, self._load.masses))
