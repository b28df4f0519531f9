"""The pool's twin without Ray: the same protocol and the same results, bit for bit, on one thread of this process."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from actors.protocols import SimulationError
from actors.simulation.job_runner import JobRunner, Simulator, pour_simulator
from actors.simulation.statistics import Account, PoolStatistics
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask


class InProcessSimulatorPool:
    """`SimulatorPool` of one simulator. For tests, and for commands that simulate once.

    Limitations: a crash of the simulator is a crash of this process; there is no deadline, since a thread can't be
    ended from outside.

    Args:
        make: makes the simulator, in the pool's thread.
    """

    def __init__(self, *, make: Callable[[], Simulator] = pour_simulator) -> None:
        self._runner = JobRunner(make)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="simulator")
        self._account = Account(1)
        self._closed = False

    @property
    def size(self) -> int:
        """One."""
        return 1

    @property
    def separate(self) -> bool:
        """They share this process with the bench."""
        return False

    def statistics(self) -> PoolStatistics:
        """What the pool has done so far."""
        return self._account.statistics()

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`."""
        if self._closed:
            raise SimulationError("the pool of simulators is closed")
        given_up = threading.Event()
        job = self._thread.submit(self._run, task, given_up)
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
        self._account.begin(0)
        try:
            return self._runner.simulate(task, given_up.is_set)
        finally:
            self._account.end(0)

    async def close(self) -> None:
        """Let a cancelled job end and write the compiled kernels."""
        if self._closed:
            return
        self._closed = True
        await asyncio.wrap_future(self._thread.submit(self._runner.close))
        self._thread.shutdown(wait=True)
