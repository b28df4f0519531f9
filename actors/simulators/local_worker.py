"""Pools of simulators without Ray: the same interface and bit-identical results, run by threads of this process.

`InProcessSimulatorPool` simulates in its thread. `actors.simulators.process_worker` derives a pool whose threads use
one process each.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

from actors.interfaces import SimulationError
from actors.simulators.simulation_task import Account, JobRunner, PoolStatistics, Simulator, pour_simulator
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask


class Runner(Protocol):
    """Runs jobs one after another: a `JobRunner` in this or in another process."""

    def simulate(self, task: PourTask, cancelled: Callable[[], bool]) -> SimulatedPour:
        """See `JobRunner.simulate`."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class ThreadedPool:
    """A `SimulatorPool` of runners; each is used by one thread at a time.

    Limitations: there is no deadline, since a thread cannot be ended from outside.

    Args:
        runners: at least one.
        separate: whether they simulate in separate processes.
    """

    def __init__(self, runners: Sequence[Runner], *, separate: bool) -> None:
        self._runners = tuple(runners)
        self._separate = separate
        self._idle: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number in range(len(runners)):
            self._idle.put(number)
        self._threads = ThreadPoolExecutor(len(runners), thread_name_prefix="simulator")
        self._account = Account(len(runners))
        self._closed = False

    @property
    def size(self) -> int:
        """Number of runners."""
        return len(self._runners)

    @property
    def separate(self) -> bool:
        """Whether the runners simulate in separate processes."""
        return self._separate

    def statistics(self) -> PoolStatistics:
        """Statistics of the pool so far."""
        return self._account.statistics()

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`."""
        if self._closed:
            raise SimulationError("the pool of simulators is closed")
        given_up = threading.Event()
        job = self._threads.submit(self._run, task, given_up)
        try:
            result = await asyncio.wrap_future(job)
        except asyncio.CancelledError:
            given_up.set()
            self._account.cancelled += 1
            raise
        except Exception:
            self._account.jobs += 1
            raise
        self._account.jobs += 1
        return result

    def _run(self, task: PourTask, given_up: threading.Event) -> SimulatedPour:
        number = self._idle.get()
        self._account.begin(number)
        try:
            return self._runners[number].simulate(task, given_up.is_set)
        finally:
            self._account.end(number)
            self._idle.put(number)

    def _end(self) -> None:
        self._runners[self._idle.get()].close()  # take an idle one and do not put it back, so that each is closed once

    async def close(self) -> None:
        """Wait for cancelled jobs to end, then write the compiled kernels."""
        if self._closed:
            return
        self._closed = True
        await asyncio.gather(*(asyncio.wrap_future(self._threads.submit(self._end)) for _ in self._runners))
        self._threads.shutdown(wait=True)


class InProcessSimulatorPool(ThreadedPool):
    """A `SimulatorPool` of one simulator. For tests, and for commands that simulate once.

    Limitations: if the simulator crashes, this process crashes.

    Args:
        make: creates the simulator, in the pool's thread.
    """

    def __init__(self, *, make: Callable[[], Simulator] = pour_simulator) -> None:
        super().__init__([JobRunner(make)], separate=False)
