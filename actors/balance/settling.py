"""When a weight counts: the balance vouches for several readings in a row, and they agree."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class SettlingRule:
    """What must be seen before a weight counts.

    One stable reading isn't enough: characters get lost on serial lines, some balances call a slowly filling vessel
    stable, and some are set up to print a unit always.

    Attributes:
        readings: stable ones in a row, nothing else in between; 2 or more.
        span: from the first of them to the last [s].
        steps: how far they may lie apart, in steps of the display.
        deadline: after which a weight that has not settled is given up [s].
    """

    readings: int = 4
    span: float = 0.6
    steps: float = 1.0
    deadline: float = 20.0

    def scaled(self, time_scale: float) -> SettlingRule:
        """The same in a laboratory whose time runs faster.

        Args:
            time_scale: bench seconds per second of the clock.
        """
        return replace(self, span=self.span / time_scale, deadline=self.deadline / time_scale)


@dataclass(frozen=True)
class Settled:
    """A weight that counts.

    Attributes:
        mass: median of the readings [kg].
        time: of the last of them [s].
        spread: largest minus smallest [kg].
    """

    mass: float
    time: float
    spread: float


class Settling:
    """Watches readings until a weight counts."""

    def __init__(self, rule: SettlingRule) -> None:
        self._rule = rule
        self._window: deque[tuple[float, float]] = deque()

    def feed(self, mass: float | None, time: float, step: float) -> Settled | None:
        """Take note of a reading.

        Args:
            mass: a stable one [kg], or None for one that is anything else.
            time: when it came [s].
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
        first = self._window[0][0]
        if len(self._window) < self._rule.readings or time - first < self._rule.span:
            return None
        masses = sorted(mass for _, mass in self._window)
        return Settled(masses[len(masses) // 2], time, self._spread())

    def _spread(self) -> float:
        masses = [mass for _, mass in self._window]
        return max(masses) - min(masses)
