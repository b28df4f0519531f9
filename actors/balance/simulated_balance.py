"""Simulated balances: noise, resolution, settling, drift, and a display that needs time to become stable.

`VirtualBalance` is the driver of a simulated bench. `EmulatedScale` models the weighing cell and display of an emulated
serial balance, including its range; it has no bytes and no clock.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from actors.balance.balance_interface import Weight
from actors.balance.readings import KILOGRAMS, Reading, ReadingStatus
from actors.bench.bench_clock import Pace
from actors.interfaces import LaboratoryError

INTERVAL = 0.1
"""Bench time between two readings [s]."""

WINDOW = 10
"""Number of readings that must agree for a stable weight."""

PATIENCE = 20.0
"""Bench time limit for a stable weight [s]."""

_SETTLED = math.log(100.0)
"""Number of time constants until the display is within 1 % of a change."""


@dataclass(frozen=True)
class BalanceSettings:
    """Data sheet of a simulated balance.

    Attributes:
        resolution: smallest step of the display [kg]; 0: no rounding.
        noise: standard deviation of one reading [kg].
        drift: of the zero point [kg/s].
        settling_time: until the display shows a new load to within 1 % of it [s].
        time_scale: bench seconds per wall second; 0 disables waiting.
    """

    resolution: float
    noise: float
    drift: float
    settling_time: float
    time_scale: float


@dataclass(frozen=True)
class Load:
    """The load on the tray from now on.

    Attributes:
        times: since now, increasing [s].
        masses: on the tray at these times [kg]; linear in between, constant after the last.
    """

    times: tuple[float, ...]
    masses: tuple[float, ...]


class VirtualBalance:
    """Driver of a simulated balance. It blocks; `actors.runtime.remote_object` runs it in a thread or a process.

    The display follows the load as a first-order lag, with a drifting zero, noise on every reading, and rounding.
    Measurements depend on the seed, the loads and the elapsed bench time, but not on the clock or on earlier calls of
    `read`.
    """

    def __init__(self, settings: BalanceSettings, name: str = "virtual") -> None:
        self._settings = settings
        self._name = name
        self._pace = Pace(settings.time_scale)
        self._lock = threading.Lock()
        self.prepare((0,))

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty the tray, set bench time to 0, and reseed the noise."""
        with self._lock:
            self._rng = np.random.default_rng(seed)
            self._display_rng = np.random.default_rng((*seed, 1))
            self._time = self._shown = self._tare = 0.0
            self._load = Load((0.0,), (0.0,))
            self._loaded_at = 0.0
        self._pace.resume()

    def put(self, load: Load) -> None:
        """Change the load on the tray, now and in the future."""
        with self._lock:
            self._load, self._loaded_at = load, self._time

    def pass_time(self, seconds: float) -> None:
        """Let bench time pass [s].

        Raises:
            LaboratoryError: interrupted.
        """
        self._pace.restart()
        steps = math.ceil(seconds / INTERVAL - 1e-9)
        for step in range(1, steps + 1):
            self._wait(step * seconds / steps)
            self._advance(seconds / steps)

    def interrupt(self) -> None:
        """End the current wait, until the next `prepare` or `resume`."""
        self._pace.interrupt()

    def resume(self) -> None:
        """Allow waits again after `interrupt`."""
        self._pace.resume()

    def close(self) -> None:
        """Do nothing: there is no resource to release."""

    def connect(self) -> str:
        """See `BalanceDriver.connect`."""
        return f"{self._name}: a balance of numbers, step {1e3 * self._settings.resolution:g} g"

    def keep_reference(self) -> None:
        """Do nothing: the connection cannot be lost."""

    def tare(self) -> None:
        """See `BalanceDriver.tare`."""
        mass = self._stable()
        with self._lock:
            self._tare += mass

    def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`."""
        mass = self._stable()
        return Weight(mass, True, self._time, step=self._settings.resolution)

    def read(self) -> Weight:
        """See `BalanceDriver.read`. It has a separate noise stream, so that it does not affect measurements."""
        with self._lock:
            lag = abs(self._load_at(self._time) - self._shown)
            return Weight(self._reading(self._display_rng), lag <= self._tolerance, self._time)

    @property
    def _tolerance(self) -> float:
        """Largest difference of the readings in a window: noise and rounding must not be taken for motion."""
        s = self._settings
        return 2.0 * s.resolution + 6.0 * s.noise + abs(s.drift) * WINDOW * INTERVAL

    def _stable(self) -> float:
        """Take readings until a window of them agrees; return the last one [kg]."""
        self._pace.restart()
        window: deque[float] = deque(maxlen=WINDOW)
        for count in range(1, round(PATIENCE / INTERVAL) + 1):
            self._wait(count * INTERVAL)
            self._advance(INTERVAL)
            with self._lock:
                window.append(self._reading(self._rng))
            if len(window) == WINDOW and max(window) - min(window) <= self._tolerance:
                return window[-1]
        raise LaboratoryError(
            f"balance {self._name}: no stable weight within {PATIENCE:g} s (last {1e3 * window[-1]:.1f} g, unstable). "
            "Is something touching the tray?"
        )

    def _wait(self, moment: float) -> None:
        if not self._pace.wait_until(moment):
            raise LaboratoryError(f"balance {self._name}: interrupted")

    def _load_at(self, moment: float) -> float:
        return float(np.interp(moment - self._loaded_at, self._load.times, self._load.masses))

    def _advance(self, seconds: float) -> None:
        with self._lock:
            self._time += seconds
            lag = self._settings.settling_time / _SETTLED
            share = -math.expm1(-seconds / lag) if lag > 0.0 else 1.0
            self._shown += (self._load_at(self._time) - self._shown) * share

    def _reading(self, rng: np.random.Generator) -> float:
        """Return one reading of the display [kg]."""
        s = self._settings
        raw = self._shown + s.drift * self._time + rng.normal(0.0, s.noise) - self._tare
        return float(round(raw / s.resolution) * s.resolution if s.resolution > 0.0 else raw)


_STEP = 0.01
"""Bench time step of a moving display [s]."""


ZERO_SHARE = 0.02
"""Largest load for a zero command, as a fraction of the capacity."""


@dataclass(frozen=True)
class ScaleSettings:
    """Data sheet of an emulated scale.

    Attributes:
        resolution: step of the display [kg].
        capacity: maximum load [kg].
        noise: standard deviation of repeated weighings of the same load [kg]. It is drawn once per load, because a real
            display stands still while nothing moves. A weight therefore depends on seed and loads only, not on the
            number or times of the queries.
        drift: of the zero point [kg/s].
        settling_time: until the display shows a change to within 1 % of it [s].
        rest_time: time without change until the display is stable [s].
        unit: of the display.
    """

    resolution: float = 1e-4
    capacity: float = 6.2
    noise: float = 0.0
    drift: float = 0.0
    settling_time: float = 1.5
    rest_time: float = 0.3
    unit: str = "g"


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

    def put(self, load: Load) -> None:
        """Change the load, now and in the future."""
        self._load, self._loaded_at = load, self.time
        self._offset = float(self._rng.normal(0.0, self.settings.noise))
        self._resting = 0.0

    def advance(self, seconds: float) -> None:
        """Let bench time pass [s]."""
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
        """Whether the display is stable."""
        return self._resting >= self.settings.rest_time

    @property
    def gross(self) -> float:
        """Load as measured by the cell [kg]; 0 after switching on."""
        return self._lagging + self._offset + self.settings.drift * self.time - self._zero

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
        """Return the display's reading."""
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
