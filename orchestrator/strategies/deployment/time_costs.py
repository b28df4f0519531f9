"""What a pour and a simulation cost in seconds, and so what is worth its time: no clock, only what was told."""

from __future__ import annotations

import statistics
from collections import deque
from typing import Annotated

from sim_engine.settings.model import Section
from sim_engine.settings.quantity import Quantity

LEARNT_FROM = 25
"""Latest simulations whose median is their price: one that was slow by accident changes nothing."""


class PricesSettings(Section):
    """D3 with `per_pour: free`: what things cost, by which simulations are chosen and ended."""

    pour: Annotated[float, Quantity("s", "90 s", 0.0, 86400.0, positive=True)] = 90.0
    """Time that a pour takes, refilling and wiping included."""

    simulation: Annotated[float, Quantity("s", "2 s", 0.0, 3600.0, positive=True)] = 2.0
    """CPU time of a simulation, until their outcomes tell."""

    worth: Annotated[float, Quantity("1", "0.005", 0.0, 1.0)] = 0.005
    """Share of the worst loss: where all simulations that fit beside a pour promise less together, the pool rests."""


class Prices:
    """Values in the loss' unit, over seconds of the wall clock.

    The price of a pour is a setting. That of a simulation is learnt from the CPU seconds in outcomes, which are
    journalled, so that a replay learns the same.
    """

    def __init__(self, settings: PricesSettings, worst: float) -> None:
        self._settings, self._worst = settings, worst
        self._seen: deque[float] = deque(maxlen=LEARNT_FROM)

    def learn(self, seconds: float) -> None:
        """A simulation took so many CPU seconds."""
        if seconds > 0.0:
            self._seen.append(seconds)

    @property
    def pour(self) -> float:
        """Seconds that a pour takes."""
        return self._settings.pour

    def simulation(self, width: int) -> float:
        """Seconds from one simulated outcome to the next with `width` of them at a time."""
        return (statistics.median(self._seen) if self._seen else self._settings.simulation) / max(width, 1)

    def prefers_pour(self, simulation: float, pour: float, width: int) -> bool:
        """Whether a pour is worth more per second than a simulation, given what each is worth."""
        return simulation / self.simulation(width) <= pour / self.pour

    def is_idle(self, simulation: float, width: int) -> bool:
        """Whether as many simulations as fit beside a pour are worth next to nothing together, given what one is."""
        return simulation * self.pour / self.simulation(width) < self._settings.worth * self._worst
