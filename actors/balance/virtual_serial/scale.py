"""What a virtual balance weighs and shows: settling, drift, noise, steps, range. No bytes, no clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from actors.balance.reading import Reading, Status
from actors.balance.units import KILOGRAMS
from actors.balance.virtual_balance import Load

_STEP = 0.01
"""Bench time in which a moving display is computed anew [s]."""

_SETTLED = math.log(100.0)
"""Time constants until the display is within a hundredth of a change."""

ZERO_SHARE = 0.02
"""How much of the capacity may be on it when it is zeroed."""


@dataclass(frozen=True)
class ScaleSettings:
    """What a data sheet says.

    Attributes:
        resolution: step of the display [kg].
        capacity: heaviest load [kg].
        noise: standard deviation of weighing the same thing again [kg]. Drawn once for each load that is put on, as
            the display of a real one stands still while nothing moves: a weight then depends on seed and loads alone,
            however often and whenever it was asked for.
        drift: of the zero point [kg/s].
        settling_time: until a change is shown to within a hundredth of it [s].
        rest_time: how long the display must stand before it is called stable [s].
        unit: that it shows.
    """

    resolution: float = 1e-4
    capacity: float = 6.2
    noise: float = 0.0
    drift: float = 0.0
    settling_time: float = 1.5
    rest_time: float = 0.3
    unit: str = "g"


class Scale:
    """The weighing cell and its display, in bench time."""

    def __init__(self, settings: ScaleSettings, seed: tuple[int, ...] = (0,)) -> None:
        self.settings = settings
        factor = Decimal(repr(KILOGRAMS[settings.unit]))
        step = (Decimal(repr(settings.resolution)) / factor).normalize()
        self._decimal_step = step if step.as_tuple().exponent <= 0 else step.quantize(Decimal(1))  # type: ignore[operator]
        self.prepare(seed)

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty, bench time 0, no tare, chance begun anew."""
        self._rng = np.random.default_rng(seed)
        self.time = 0.0
        self._tare = self._zero = self._offset = 0.0
        self._load, self._loaded_at = Load((0.0,), (0.0,)), 0.0
        self._lagging = 0.0
        self._resting = math.inf

    def put(self, load: Load) -> None:
        """Change what is, or will be, on it."""
        self._load, self._loaded_at = load, self.time
        self._offset = float(self._rng.normal(0.0, self.settings.noise))
        self._resting = 0.0

    def advance(self, seconds: float) -> None:
        """Bench time passes [s]."""
        end = self.time + seconds
        lag = self.settings.settling_time / _SETTLED
        while self.time < end:
            before = self._true(self.time)
            if self._lagging == before and self.time >= self._loaded_at + self._load.times[-1]:
                self._resting += end - self.time
                self.time = end
                return
            step = min(_STEP, end - self.time)
            self.time = min(self.time + step, end)
            target = self._true(self.time)
            self._lagging += (target - self._lagging) * (-math.expm1(-step / lag) if lag > 0.0 else 1.0)
            if before == target and abs(target - self._lagging) < self.settings.resolution / 8.0:
                self._lagging = target
                self._resting += step
            else:
                self._resting = 0.0

    @property
    def stable(self) -> bool:
        """Whether the display stands."""
        return self._resting >= self.settings.rest_time

    @property
    def gross(self) -> float:
        """On the cell, as it measures it [kg]; 0 after switching on."""
        return self._lagging + self._offset + self.settings.drift * self.time - self._zero

    @property
    def truth(self) -> float:
        """What is on it now [kg]."""
        return self._true(self.time)

    def tare(self) -> Status:
        """Count what is on it as nothing; the status says whether it could."""
        if self.range is not Status.STABLE:
            return self.range
        self._tare = self.gross
        return Status.STABLE

    def clear_tare(self) -> None:
        """Forget the tare."""
        self._tare = 0.0

    @property
    def tared(self) -> Decimal:
        """The tare as it would be shown, in the unit."""
        return self._rounded(self._tare)

    def preset_tare(self, mass: float) -> bool:
        """Take a known mass for the tare [kg]. Returns whether it is within the range."""
        if not 0.0 <= mass <= self.settings.capacity:
            return False
        self._tare = mass
        return True

    @property
    def capacity(self) -> Decimal:
        """The heaviest load as it would be shown, in the unit."""
        return self._rounded(self.settings.capacity)

    @property
    def step(self) -> Decimal:
        """Step of the display, in the unit."""
        return self._decimal_step

    def zero(self) -> Status:
        """Set the zero; refused where more than a little is on it."""
        if abs(self.gross) > ZERO_SHARE * self.settings.capacity:
            return Status.OVER if self.gross > 0.0 else Status.UNDER
        self._zero += self.gross
        self._tare = 0.0
        return Status.STABLE

    def power_cycle(self) -> None:
        """Switched off and on: what is on it is the new zero, and the tare is gone."""
        self._zero += self.gross
        self._tare = 0.0

    @property
    def range(self) -> Status:
        """Stable where the load is within range, else over or under."""
        if self.gross > self.settings.capacity + 9.0 * self.settings.resolution:
            return Status.OVER
        return Status.UNDER if self.gross < -0.2 * self.settings.capacity else Status.STABLE

    def reading(self) -> Reading:
        """What the display shows."""
        if self.range is not Status.STABLE:
            return Reading(self.range)
        status = Status.STABLE if self.stable else Status.UNSTABLE
        return Reading(status, self._rounded(self.gross - self._tare), self.settings.unit)

    def _rounded(self, mass: float) -> Decimal:
        """As digits of the display."""
        steps = round(mass / self.settings.resolution)
        return steps * self._decimal_step if steps else abs(0 * self._decimal_step)

    def _true(self, moment: float) -> float:
        return float(np.interp(moment - self._loaded_at, self._load.times, self._load.masses))
