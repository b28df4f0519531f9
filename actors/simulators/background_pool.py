"""A pool of simulators for plain functions: any thread may use it, and its processes stay up between calls.

`background_pool` returns the pool of this program. Its child processes end when the program ends.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait

from actors.simulators.job_runner import Simulator, pour_simulator
from actors.simulators.local_worker import process_pool
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask


class BackgroundPool:
    """Child processes with one simulator each, and a thread that distributes simulations among them.

    Args:
        make: creates a simulator, inside its process.
    """

    def __init__(self, make: Callable[[], Simulator] = pour_simulator) -> None:
        self._loop = asyncio.new_event_loop()
        self._pool = process_pool(0, make)
        self._thread = threading.Thread(target=self._loop.run_forever, name="simulator pool", daemon=True)
        self._thread.start()

    def simulate(
        self,
        tasks: Sequence[PourTask],
        workers: int,
        progress: Callable[[int, int], None] | None = None,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> list[SimulatedPour]:
        """Simulate tasks side by side, and wait for their results. Tasks of several threads take turns.

        Args:
            tasks: what to simulate.
            workers: number of processes to have at least, if there are as many tasks.
            progress: called in this thread with the number of finished simulations and of all.
            meanwhile: called in this thread once the simulations are on their way.

        Returns:
            Results in the order of the tasks.

        Raises:
            LaboratoryError: a task has no result, or no simulator can be started; the other tasks are cancelled.
        """
        user = object()
        self._loop.call_soon_threadsafe(self._grow, min(workers, len(tasks)))
        running = [asyncio.run_coroutine_threadsafe(self._pool.simulate(task, user), self._loop) for task in tasks]
        try:
            meanwhile()
            self._wait(running, progress)
            return [future.result() for future in running]
        finally:
            for future in running:
                future.cancel()

    def close(self) -> None:
        """End the processes and the thread."""
        asyncio.run_coroutine_threadsafe(self._pool.close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _grow(self, size: int) -> None:
        self._pool.open()
        self._pool.grow(size)

    @staticmethod
    def _wait(running: Sequence[Future[SimulatedPour]], progress: Callable[[int, int], None] | None) -> None:
        """Wait for all, or for the first error."""
        if progress is None:
            wait(running, return_when=FIRST_EXCEPTION)
            return
        waiting = set(running)
        while waiting:
            done, waiting = wait(waiting, return_when="FIRST_COMPLETED")
            for future in done:
                future.result()
            progress(len(running) - len(waiting), len(running))


_pool: tuple[int, BackgroundPool] | None = None
_pool_lock = threading.Lock()


def background_pool() -> BackgroundPool:
    """The pool of this process; a forked process gets one of its own."""
    global _pool
    with _pool_lock:
        if _pool is None or _pool[0] != os.getpid():
            _pool = os.getpid(), BackgroundPool()
        return _pool[1]
