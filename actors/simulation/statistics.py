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
        busy_s: wall seconds that members had a job, summed over them.
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
    _opened: float = field(default_factory=time.monotonic)
    _since: dict[int, float] = field(default_factory=dict)

    def begin(self, member: int) -> None:
        """A member was given a job."""
        self._since[member] = time.monotonic()

    def end(self, member: int) -> None:
        """It is idle again, or gone."""
        self._busy += time.monotonic() - self._since.pop(member, time.monotonic())

    def statistics(self) -> PoolStatistics:
        """As of now, jobs under way included."""
        now = time.monotonic()
        busy = self._busy + sum(now - since for since in self._since.values())
        available = max((now - self._opened) * self.size, 1e-9)
        return PoolStatistics(self.jobs, self.cancelled, self.deaths, busy, busy / available)
