"""Workers of the simulator pool on this machine, without Ray: a thread, and a child process.

- `thread_pool` simulates in this process. For tests, and for commands that simulate once.
- `process_pool` simulates in child processes. They start seconds faster than Ray, for interactive commands.

Outcomes are bit-identical to those of `actors.simulators.ray_worker`.

`python -m actors.simulators.local_worker FD` is the child process. It ends when its owner closes the connection or
dies.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import ConnectedProcess, last_lines
from actors.simulators.job_runner import JobCancelledError, JobRunner, Simulator, pour_simulator
from actors.simulators.pool import Greeting, WorkerLostError, WorkerPool, WorkerReply
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

LOOK_INTERVAL = 0.1
"""Time between two checks whether a job was cancelled [s]."""

ENDING = 1.0
"""Time for a process that has closed its connection to end with a status of its own [s]."""


class ThreadWorker:
    """A `Worker` in a thread of this process. If the simulator crashes, this process crashes.

    Args:
        make: creates the simulator, in the thread.
    """

    def __init__(self, make: Callable[[], Simulator] = pour_simulator) -> None:
        self._runner = JobRunner(make)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="simulator")
        self._cancelled: set[int] = set()

    async def start(self) -> Greeting:
        """See `Worker.start`."""
        return Greeting(os.getpid())

    async def run(self, number: int, task: PourTask) -> WorkerReply:
        """See `Worker.run`."""
        return await asyncio.wrap_future(self._thread.submit(self._simulate, number, task))

    def _simulate(self, number: int, task: PourTask) -> WorkerReply:
        begin = time.monotonic()
        try:
            result = self._runner.simulate(task, lambda: number in self._cancelled)
        finally:
            self._cancelled.discard(number)
        return WorkerReply(result, time.monotonic() - begin)

    def cancel(self, number: int) -> None:
        """See `Worker.cancel`."""
        self._cancelled.add(number)

    async def close(self, timeout: float) -> None:
        """See `Worker.close`; waits for cancelled jobs, since a thread cannot be ended from outside."""
        await asyncio.wrap_future(self._thread.submit(self._runner.close))
        self._thread.shutdown(wait=True)


class ProcessWorker:
    """A `Worker` in a child process, at this program's own priority. A thread waits for its replies.

    Args:
        make: creates the simulator, inside the process.
    """

    def __init__(self, make: Callable[[], Simulator] = pour_simulator) -> None:
        self._make = make
        self._child: ConnectedProcess | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="simulator")
        self._cancelled: set[int] = set()

    async def start(self) -> Greeting:
        """See `Worker.start`."""
        self._child = ConnectedProcess(__name__)
        with contextlib.suppress(OSError):  # the end of the process is noticed with its first job
            self._child.connection.send(self._make)
        return Greeting(self._child.pid)

    async def run(self, number: int, task: PourTask) -> WorkerReply:
        """See `Worker.run`."""
        assert self._child is not None
        return await asyncio.wrap_future(self._thread.submit(self._request, self._child, number, task))

    def _request(self, child: ConnectedProcess, number: int, task: PourTask) -> WorkerReply:
        begin = time.monotonic()
        try:
            child.connection.send(task)
            while not child.connection.poll(LOOK_INTERVAL):
                if number in self._cancelled:
                    child.connection.send(None)  # any message cancels the job
                    break
            reply = child.connection.recv()
        except (EOFError, OSError):
            if not child.wait(ENDING):
                child.kill()
            raise WorkerLostError(f"status {child.status}", last_lines(child.errors_kept)) from None
        finally:
            self._cancelled.discard(number)
        if isinstance(reply, SimulatedPour):
            return WorkerReply(reply, time.monotonic() - begin)
        raise reply

    def cancel(self, number: int) -> None:
        """See `Worker.cancel`."""
        self._cancelled.add(number)

    async def close(self, timeout: float) -> None:
        """See `Worker.close`."""
        if self._child is None:
            return
        if timeout == 0.0:
            await asyncio.to_thread(self._child.kill)  # also ends the wait for a reply
        ended = self._thread.submit(self._end, self._child, timeout)
        done, _ = await asyncio.wait({asyncio.wrap_future(ended)}, timeout=timeout or None)
        if not done:
            await asyncio.to_thread(self._child.kill)
        self._thread.shutdown(wait=False)

    def _end(self, child: ConnectedProcess, timeout: float) -> None:
        child.connection.close()
        child.close(timeout)


def thread_pool(make: Callable[[], Simulator] = pour_simulator) -> WorkerPool:
    """A pool of one simulator in a thread of this process, since a process has one Taichi.

    Args:
        make: creates the simulator.
    """
    return WorkerPool(1, partial(ThreadWorker, make), separate=False)


def process_pool(size: int, make: Callable[[], Simulator] = pour_simulator) -> WorkerPool:
    """A pool of child processes.

    Args:
        size: number of processes.
        make: creates a simulator, inside its process.
    """
    return WorkerPool(size, partial(ProcessWorker, make))


def serve(connection: Connection) -> None:
    """Simulate until the owner closes the connection. A message during a job, or the end of the connection, cancels the
    job.
    """
    runner = JobRunner(connection.recv())
    with contextlib.suppress(EOFError, OSError):
        while True:
            task = connection.recv()
            if task is None:  # it arrived after the job's end
                continue
            try:
                reply: Any = runner.simulate(task, connection.poll)
            except (LaboratoryError, JobCancelledError) as error:
                reply = error
            connection.send(reply)
    runner.close()


if __name__ == "__main__":
    import sim_engine.simulator  # noqa: F401 - takes half a second, before the first request arrives

    serve(Connection(int(sys.argv[1])))
