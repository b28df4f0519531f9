"""A balance with a spring: settings, their kind, and a driver that takes its time to come to rest.

It has no line: on a virtual bench the driver is told what stands on it. A driver of a real balance would open its port
in `connect`, and be told nothing.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from decant.plugins import BalanceKind, BalanceSettings, LaboratoryError, Load, Quantity, Weight

STABLE_WEIGHT_TIMEOUT = 20.0
"""How long it may take to come to rest [s of bench time]."""


class SpringSettings(BalanceSettings):
    """A balance with a spring."""

    receives_load: ClassVar[bool] = True

    kind: Literal["spring"] = "spring"
    """A balance with a spring."""

    step: Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01, positive=True)] = 1e-4
    """Step of its display."""

    swing: Annotated[float, Quantity("s", "1 s", 0.0, 60.0)] = 1.0
    """How long it swings after a change."""


class SpringKind(BalanceKind[SpringSettings]):
    """Balances with a spring."""

    settings = SpringSettings

    def driver(self, name: str) -> tuple[type[Any], tuple[Any, ...]]:
        """See `BalanceKind.driver`."""
        return SpringBalance, (self.spec, name)


class SpringBalance:
    """The driver; see `decant.plugins.BalanceDriver`."""

    def __init__(self, spec: SpringSettings, name: str = "spring") -> None:
        self._spec, self._name = spec, name
        self._tare = 0.0
        self._load, self._changed = Load((0.0,), (0.0,)), -math.inf
        self._interrupted = threading.Event()

    def connect(self) -> str:
        """See `BalanceDriver.connect`."""
        return f"{self._name}: a spring, step {1e3 * self._spec.step:g} g"

    def tare(self) -> None:
        """See `BalanceDriver.tare`."""
        self._rest()
        self._tare = self._mass(time.monotonic())

    def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`."""
        self._rest()
        return self.read()

    def read(self) -> Weight:
        """See `BalanceDriver.read`."""
        now = time.monotonic()
        steps = round((self._mass(now) - self._tare) / self._spec.step)
        return Weight(steps * self._spec.step, now >= self._still_at, now, step=self._spec.step)

    def keep_reference(self) -> None:
        """See `BalanceDriver.keep_reference`: it has no connection that could be lost."""

    def interrupt(self) -> None:
        """See `BalanceDriver.interrupt`."""
        self._interrupted.set()

    def resume(self) -> None:
        """See `BalanceDriver.resume`."""
        self._interrupted.clear()

    def close(self) -> None:
        """See `BalanceDriver.close`."""

    def prepare(self, seed: tuple[int, ...]) -> None:
        """A new pour: it is empty."""
        self._load, self._tare = Load((0.0,), (0.0,)), 0.0

    def put(self, load: Load) -> None:
        """Masses that stand on it from now on."""
        self._load, self._changed = load, time.monotonic()

    def _mass(self, now: float) -> float:
        """What stands on it [kg]."""
        since = (now - self._changed) * self._spec.time_scale
        return float(np.interp(since, self._load.times, self._load.masses))

    @property
    def _still_at(self) -> float:
        return self._changed + (self._load.times[-1] + self._spec.swing) / self._spec.time_scale

    def _rest(self) -> None:
        wait = self._still_at - time.monotonic()
        if self._interrupted.wait(min(max(wait, 0.0), STABLE_WEIGHT_TIMEOUT / self._spec.time_scale)):
            raise LaboratoryError(f"balance {self._name}: interrupted")
        if time.monotonic() < self._still_at:
            raise LaboratoryError(
                f"balance {self._name}: not at rest within {STABLE_WEIGHT_TIMEOUT:g} s; is it shaken?"
            )
