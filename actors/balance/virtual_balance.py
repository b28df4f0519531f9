"""A balance without a balance: noise, resolution, settling, drift, and a display that needs time to become stable."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from actors.balance.protocol import Weight
from actors.pacing import Pace
from actors.protocols import LaboratoryError

INTERVAL = 0.1
"""Bench time between two readings [s]."""

WINDOW = 10
"""Readings that must agree for a stable weight."""

PATIENCE = 20.0
"""Bench time after which a balance that is not at rest is given up [s]."""

_SETTLED = math.log(100.0)
"""Time constants until the display is within a hundredth of a step."""


@dataclass(frozen=True)
class BalanceSettings:
    """What a data sheet says.

    Attributes:
        resolution: smallest step of the display [kg]; 0: no rounding.
        noise: standard deviation of one reading [kg].
        drift: of the zero point [kg/s].
        settling_time: until a new load is shown to within a hundredth of it [s].
        time_scale: bench seconds per wall second; 0 waits for nothing.
    """

    resolution: float
    noise: float
    drift: float
    settling_time: float
    time_scale: float


@dataclass(frozen=True)
class Load:
    """What comes onto the tray from now on.

    Attributes:
        times: since now, increasing [s].
        masses: on the tray at these times [kg]; linear in between, constant after the last.
    """

    times: tuple[float, ...]
    masses: tuple[float, ...]


class VirtualBalance:
    """Plain and blocking; `actors.device` puts it into a thread or a process.

    The display follows the load as a first-order lag, with a drifting zero, noise on every reading, and rounding.
    Measurements depend on the seed, the loads and the bench time that passed, never on the clock or on who looked at
    the display meanwhile.
    """

    def __init__(self, settings: BalanceSettings, name: str = "virtual") -> None:
        self._settings = settings
        self._name = name
        self._pace = Pace(settings.time_scale)
        self._lock = threading.Lock()
        self.prepare((0,))

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty tray, bench time 0, noise of a new pour."""
        with self._lock:
            self._rng = np.random.default_rng(seed)
            self._display_rng = np.random.default_rng((*seed, 1))
            self._time = self._shown = self._tare = 0.0
            self._load = Load((0.0,), (0.0,))
            self._loaded_at = 0.0
        self._pace.resume()

    def put(self, load: Load) -> None:
        """Change what is (or will be) on the tray."""
        with self._lock:
            self._load, self._loaded_at = load, self._time

    def pass_time(self, seconds: float) -> None:
        """Stand there for some bench time [s].

        Raises:
            LaboratoryError: interrupted.
        """
        self._pace.restart()
        steps = math.ceil(seconds / INTERVAL - 1e-9)
        for step in range(1, steps + 1):
            self._wait(step * seconds / steps)
            self._advance(seconds / steps)

    def interrupt(self) -> None:
        """End the wait that is under way, until the next `prepare` or `resume`."""
        self._pace.interrupt()

    def resume(self) -> None:
        """Let waits last again after `interrupt`."""
        self._pace.resume()

    def close(self) -> None:
        """Nothing has to be let go of."""

    def connect(self) -> str:
        """See `BalanceDriver.connect`."""
        return f"{self._name}: a balance of numbers, step {1e3 * self._settings.resolution:g} g"

    def keep_reference(self) -> None:
        """Its connection can't be lost."""

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
        """See `BalanceDriver.read`. Its noise is a stream of its own, so that watching changes no measurement."""
        with self._lock:
            lag = abs(self._load_at(self._time) - self._shown)
            return Weight(self._reading(self._display_rng), lag <= self._tolerance, self._time)

    @property
    def _tolerance(self) -> float:
        """How far the readings of a window may lie apart: their noise and rounding must not look like motion."""
        s = self._settings
        return 2.0 * s.resolution + 6.0 * s.noise + abs(s.drift) * WINDOW * INTERVAL

    def _stable(self) -> float:
        """Take readings until a window of them agrees; the last one counts [kg]."""
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
        """One reading of the display [kg]."""
        s = self._settings
        raw = self._shown + s.drift * self._time + rng.normal(0.0, s.noise) - self._tare
        return float(round(raw / s.resolution) * s.resolution if s.resolution > 0.0 else raw)
