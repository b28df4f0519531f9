"""Simulators in plain processes, for interactive commands: they start seconds faster than Ray.

`ProcessSimulatorPool` is the pool. `python -m actors.simulators.process_worker FD` runs one simulator process; it runs
until its owner closes the connection or dies.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from actors.interfaces import LaboratoryError, SimulationError
from actors.runtime.child_process import ConnectedProcess
from actors.simulators.local_worker import ThreadedPool
from actors.simulators.simulation_task import RETRIES, JobCancelledError, JobRunner, Simulator, pour_simulator
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

LOOK = 0.1
"""Time between two checks whether a job is still needed [s]."""

DEADLINE = 10.0
"""Time that a process has to stop a job, and to write its kernels at the end [s]."""


class ProcessSimulatorPool(ThreadedPool):
    """`SimulatorPool` over plain processes of this machine, started at once and at the program's own priority.

    Args:
        size: number of processes.
        make: creates a simulator, inside its process.
    """

    def __init__(self, size: int, *, make: Callable[[], Simulator] = pour_simulator) -> None:
        super().__init__([ProcessRunner(make) for _ in range(size)], separate=True)


class ProcessRunner:
    """A `JobRunner` in a separate process, which is replaced if it dies.

    Attributes:
        pid: of the process.
    """

    def __init__(self, make: Callable[[], Simulator]) -> None:
        self._make = make
        self._start()

    def _start(self) -> None:
        self._child = ConnectedProcess(__name__)
        self.pid = self._child.pid
        with contextlib.suppress(OSError):  # the end of the process is noticed with its first job
            self._child.connection.send(self._make)

    def simulate(self, task: PourTask, cancelled: Callable[[], bool]) -> SimulatedPour:
        """See `JobRunner.simulate`.

        Raises:
            SimulationError: every process that tried the job died.
        """
        last_errors = ""
        for _ in range(RETRIES + 1):
            if cancelled():
                raise JobCancelledError
            try:
                answer = self._request(task, cancelled)
            except (EOFError, OSError):
                self._child.kill()
                messages = f" (it said: {self._child.errors_kept})" if self._child.errors_kept else ""
                last_errors = f"(status {self._child.status} at last){messages}"
                self._child.connection.close()
                self._child.release()
                self._start()
                continue
            if isinstance(answer, SimulatedPour):
                return answer
            raise answer
        raise SimulationError(f"the simulator's process died {RETRIES + 1} times over it {last_errors}")

    def _request(self, task: PourTask, cancelled: Callable[[], bool]) -> Any:
        self._child.connection.send(task)
        while not self._child.connection.poll(LOOK):
            if cancelled():
                self._child.connection.send(None)
                if not self._child.connection.poll(DEADLINE):
                    raise EOFError  # it does not respond, which counts as dead
                break
        return self._child.connection.recv()

    def close(self) -> None:
        """Close the connection; kill a process that does not end then."""
        self._child.connection.close()
        self._child.close(DEADLINE)


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
                answer: Any = runner.simulate(task, connection.poll)
            except (LaboratoryError, JobCancelledError) as error:
                answer = error
            connection.send(answer)
    runner.close()


if __name__ == "__main__":
    import sim_engine.simulator  # noqa: F401 - takes half a second, before the first request arrives

    serve(Connection(int(sys.argv[1])))
