"""A simulator that several threads of one process may use.

A process has one engine. `SharedSimulator` lets one pour use it at a time; the others wait. The engine ends when the
last simulator that has used it is closed. Outcomes are those of `PourSimulator`, bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from sim_engine.errors import SimulationCancelled
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator

CANCEL_INTERVAL = 0.1
"""Time between two checks whether a waiting pour was cancelled [s]."""

_engine_lock = threading.Lock()
_users: set[SharedSimulator] = set()


class SharedSimulator(PourSimulator):
    """A `PourSimulator` whose pours wait until no other thread simulates in this process."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """See `PourSimulator.simulate`; `cancelled` is also polled while the pour waits."""
        while not _engine_lock.acquire(timeout=CANCEL_INTERVAL):
            if cancelled is not None and cancelled():
                raise SimulationCancelled
        try:
            _users.add(self)
            return super().simulate(task, cancelled=cancelled)
        finally:
            _engine_lock.release()

    def close(self) -> None:
        """Close it after the running pour. The last one ends Taichi; compiled kernels are kept for the next process."""
        with _engine_lock:
            _users.discard(self)
            if not _users:
                super().close()
