"""What a pool has done so far."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass(frozen=True)
class PoolStatistics:
    """A pool's account.

    Attributes:
        jobs: answered, refusals included.
        cancelled: given up because nobody waited any more.
        deaths: members lost and replaced.
        busy_s: wall seconds that members worked, summed over them; by their own clocks where they have told.
        busy_fraction: of the members' time since the pool was opened.
    """

    jobs: int
    cancelled: int
    deaths: int
    busy_s: float
    busy_fraction: float


@dataclass
class Account:
    """Keeps a pool's statistics."""

    size: int
    jobs: int = 0
    cancelled: int = 0
    deaths: int = 0
    _busy: float = 0.0
    _available: float = 0.0
    _resized: float = field(default_factory=time.monotonic)
    _since: dict[int, float] = field(default_factory=dict)

    def begin(self, member: int) -> None:
        """A member was given a job."""
        self._since[member] = time.monotonic()

    def end(self, member: int, worked: float | None = None) -> None:
        """It is idle again, or gone.

        Args:
            member: its number.
            worked: by its own clock [s]; else the time since `begin`.
        """
        elapsed = time.monotonic() - self._since.pop(member, time.monotonic())
        self._busy += elapsed if worked is None else worked

    def resize(self, size: int) -> None:
        """From now on there are so many members."""
        now = time.monotonic()
        self._available += (now - self._resized) * self.size
        self.size, self._resized = size, now

    def statistics(self) -> PoolStatistics:
        """As of now, jobs under way included."""
        now = time.monotonic()
        busy = self._busy + sum(now - since for since in self._since.values())
        available = max(self._available + (now - self._resized) * self.size, 1e-9)
        return PoolStatistics(self.jobs, self.cancelled, self.deaths, busy, busy / available)
