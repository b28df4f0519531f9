"""A simulated balance: noise, resolution, settling, drift, and a display that needs time to become stable.

`SimulatedBalanceSettings` are the settings of `VirtualBalance`, a driver without protocol. The scale of an emulated
serial balance is in `scale_model`.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import Annotated, ClassVar, Literal

import numpy as np

from actors.balance.balance_interface import Weight
from actors.balance.balance_settings import BalanceSettings, check_step
from actors.balance.display_behaviour import IDEAL, DisplayBehaviour, DisplayModel
from actors.balance.scale_model import SETTLED, Duration, Error, Load, PositiveMass
from actors.balance.weighing_plan import Placement
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import Pace
from sim_engine.settings.model import SET_BY_PROGRAM, Problems

INTERVAL = 0.1
"""Bench time between two readings [s]."""

WINDOW = 10
"""Number of readings that must agree for a stable weight."""

STABLE_WEIGHT_TIMEOUT = 20.0
"""Bench time limit for a stable weight [s]."""


DRIFTING = 60.0
"""Longest bench time from a tare to the weighing after it, on a simulated bench [s]."""


class SimulatedBalanceSettings(BalanceSettings):
    """A simulated balance without protocol: its driver receives the load directly."""

    receives_load: ClassVar[bool] = True

    kind: Literal["simulated"] = "simulated"
    """A simulated balance without protocol, on a virtual bench."""

    resolution: PositiveMass = 1e-4
    """Step of the display."""

    noise: Error = 1e-4
    """Standard deviation of a reading."""

    settling_time: Duration = 1.5
    """Time until the display is within 1 % of a change."""

    behaviour: DisplayBehaviour = IDEAL
    """How its display departs from an ideal one: repeated readings, zero tracking, a filter that switches, creep."""

    drift: Annotated[float, SET_BY_PROGRAM] = 0.0
    """Drift of the zero [kg/s]."""

    tared: Annotated[bool, SET_BY_PROGRAM] = False
    """Whether the dry pourer is tared, as on a simulated bench."""

    def check_laboratory(self, problems: Problems, *, mode: str) -> None:
        """See `BalanceSettings.check_laboratory`."""
        if mode == "hardware":
            problems.add("a laboratory of hardware weighs on a balance that is there; give its 'port'")
        check_step(self.resolution, self.load_tolerance, problems, "resolution")
        for key in ("jitter", "lost", "stable_display"):
            if getattr(self.behaviour, key):
                problems.add("has no effect on a simulated balance; write 'kind: serial'", "behaviour", key)

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request: an ideal display, which runs of earlier versions lack."""
        return frozenset({"behaviour"} if self.behaviour == IDEAL else ())

    @property
    def position(self) -> Placement:
        """See `BalanceSettings.position`."""
        return Placement.TARED if self.tared else super().position

    @property
    def longest_call(self) -> float:
        """See `BalanceSettings.longest_call`."""
        return 2.0 * STABLE_WEIGHT_TIMEOUT / self.time_scale if self.time_scale > 0.0 else 0.0

    @property
    def deviation(self) -> float:
        """See `BalanceSettings.deviation`."""
        return math.hypot(self.noise, self.drift * DRIFTING)


class VirtualBalance:
    """Driver of a simulated balance. It blocks; `actors.runtime.remote_object` runs it in a thread or a process.

    The display follows the load as a first-order lag, with a drifting zero, noise on every reading, and rounding.
    Measurements depend on the seed, the loads and the elapsed bench time, but not on the clock or on earlier calls of
    `read`.
    """

    def __init__(self, settings: SimulatedBalanceSettings, name: str = "virtual") -> None:
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
            step = self._settings.resolution
            self._display = DisplayModel(self._settings.behaviour, step, seed)
            self._observed = DisplayModel(self._settings.behaviour, step, (*seed, 1))
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
        return f"{self._name}: a simulated balance, step {1e3 * self._settings.resolution:g} g"

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
            mass = self._observed.show(lambda: self._reading(self._display_rng))
            return Weight(mass, lag <= self._tolerance, self._time)

    @property
    def _tolerance(self) -> float:
        """Largest difference of the readings in a window: noise and rounding must not be taken for motion."""
        s = self._settings
        return 2.0 * s.resolution + 6.0 * s.noise + abs(s.drift) * WINDOW * INTERVAL

    def _stable(self) -> float:
        """Take readings until a window of them agrees; return the last one [kg]."""
        self._pace.restart()
        window: deque[float] = deque(maxlen=WINDOW)
        for count in range(1, round(STABLE_WEIGHT_TIMEOUT / INTERVAL) + 1):
            self._wait(count * INTERVAL)
            self._advance(INTERVAL)
            with self._lock:
                window.append(self._display.show(lambda: self._reading(self._rng)))
            if len(window) == WINDOW and max(window) - min(window) <= self._tolerance:
                return window[-1]
        raise LaboratoryError(
            f"balance {self._name}: no stable weight within {STABLE_WEIGHT_TIMEOUT:g} s "
            f"(last {1e3 * window[-1]:.1f} g, unstable). Is something touching the tray?"
        )

    def _wait(self, moment: float) -> None:
        if not self._pace.wait_until(moment):
            raise LaboratoryError(f"balance {self._name}: interrupted")

    def _load_at(self, moment: float) -> float:
        return float(np.interp(moment - self._loaded_at, self._load.times, self._load.masses))

    def _advance(self, seconds: float) -> None:
        with self._lock:
            self._time += seconds
            lag = self._settings.settling_time / SETTLED
            share = -math.expm1(-seconds / lag) if lag > 0.0 else 1.0
            self._shown += (self._load_at(self._time) - self._shown) * share
            filtered = self._shown + self._settings.drift * self._time
            for display in (self._display, self._observed):
                display.advance(filtered, seconds, self._tare)

    def _reading(self, rng: np.random.Generator) -> float:
        """Return one reading of the display [kg]."""
        s = self._settings
        filtered = self._display.value if s.behaviour.acts else self._shown + s.drift * self._time
        raw = filtered + rng.normal(0.0, s.noise) - self._tare
        return float(round(raw / s.resolution) * s.resolution if s.resolution > 0.0 else raw)


"""Bench time step of a moving display [s]."""
