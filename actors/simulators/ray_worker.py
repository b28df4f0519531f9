"""The Ray actor around a `JobRunner`: one process, one Taichi, one job at a time.

`SimulatorProcess` runs inside the actor; `simulator_actor` starts it. Restarts and retries belong to
`actors.simulators.pool`.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from actors.runtime.cluster_nodes import Versions, versions
from actors.runtime.remote_object import actor_class
from actors.simulators.simulation_task import JobRunner, Simulator
from actors.simulators.task_transfer import SerializedMesh, unpack
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

NICENESS = 15
"""Priority of simulators, below the arm's driver, the optimiser and other programs [nice]."""

CONTROL = "control"
"""Concurrency group of calls that do not queue behind a job."""


@dataclass(frozen=True)
class Greeting:
    """A simulator process's description of itself when it is up.

    Attributes:
        pid: process id.
        host: the machine's name and address, for messages.
        versions: of everything that affects its results.
    """

    pid: int
    host: str
    versions: Versions


@dataclass(frozen=True)
class WorkerReply:
    """A result, and the time that the process worked for it [s]."""

    result: SimulatedPour
    seconds: float


class SimulatorProcess:
    """The class that runs inside the actor.

    Ray's restarts are off: the pool replaces a dead worker and retries its job. Ray itself would lose queued calls and
    would not keep the order of those that it repeats."""

    def __init__(self, make: Callable[[], Simulator]) -> None:
        os.nice(NICENESS)
        self._runner = JobRunner(make)
        self._recalled: set[int] = set()

    def greet(self) -> Greeting:
        """Return the greeting as soon as the process is up."""
        import ray

        return Greeting(os.getpid(), f"{socket.gethostname()} ({ray.util.get_node_ip_address()})", versions())

    def simulate(self, number: int, task: PourTask, *meshes: SerializedMesh) -> WorkerReply:
        """See `JobRunner.simulate`.

        Args:
            number: unique number by which the job can be recalled.
            task: as `Packer.pack` made it.
            meshes: its meshes.
        """
        begin = time.monotonic()
        try:
            result = self._runner.simulate(unpack(task, meshes), lambda: number in self._recalled)
        finally:
            self._recalled.discard(number)
        return WorkerReply(result, time.monotonic() - begin)

    def recall(self, number: int) -> None:
        """Cancel a job that is not needed any more: it ends between two steps, or never begins.

        This call runs concurrently with a job. Ray's own cancelling returns to the caller at once, but a job that
        waited behind another one would still run to its end.
        """
        self._recalled.add(number)

    def close(self) -> None:
        """Write the compiled kernels. If a process is killed, its kernels are lost and the next one compiles them
        again.
        """
        self._runner.close()


def simulator_actor(make: Callable[[], Simulator], *, cpus: float, placement: Mapping[str, Any]) -> Any:
    """Start an actor. Returns its handle at once, before the process is up.

    Args:
        make: creates the simulator, inside the actor.
        cpus: cores that Ray counts for it.
        placement: Ray's options that place it.
    """
    made = actor_class(SimulatorProcess, ((CONTROL, 1),))
    return made.options(num_cpus=cpus, **placement).remote(make)
