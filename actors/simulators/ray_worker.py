"""The Ray actor around a `JobRunner`: one process, one Taichi, one job at a time."""

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
"""How far simulators step back behind the arm's driver, the optimiser and whatever else wants a core [nice]."""

CONTROL = "control"
"""Concurrency group of calls that don't queue behind a job."""


@dataclass(frozen=True)
class Greeting:
    """What a simulator's process says of itself when it is up.

    Attributes:
        pid: process id.
        host: the machine's name and address, for people.
        versions: of what decides its results.
    """

    pid: int
    host: str
    versions: Versions


@dataclass(frozen=True)
class WorkerReply:
    """A result, and how long the process worked for it [s]."""

    result: SimulatedPour
    seconds: float


class SimulatorProcess:
    """What runs inside the actor. Ray's restarts are off: the pool replaces a dead member and retries its job itself,
    since Ray would lose the calls that were queued and give no order to those it repeats."""

    def __init__(self, make: Callable[[], Simulator]) -> None:
        os.nice(NICENESS)
        self._runner = JobRunner(make)
        self._recalled: set[int] = set()

    def greet(self) -> Greeting:
        """Answers as soon as the process is up."""
        import ray

        return Greeting(os.getpid(), f"{socket.gethostname()} ({ray.util.get_node_ip_address()})", versions())

    def simulate(self, number: int, task: PourTask, *parcels: SerializedMesh) -> WorkerReply:
        """See `JobRunner.simulate`.

        Args:
            number: by which the job is recalled; no two have the same.
            task: as `Packer.pack` made it.
            parcels: its meshes.
        """
        begin = time.monotonic()
        try:
            result = self._runner.simulate(unpack(task, parcels), lambda: number in self._recalled)
        finally:
            self._recalled.discard(number)
        return WorkerReply(result, time.monotonic() - begin)

    def recall(self, number: int) -> None:
        """Nobody waits for that job any more: it ends between two steps, or never begins.

        Called beside a running job. Ray's own cancelling answers the caller at once, but lets a job that waited behind
        another one run to its end.
        """
        self._recalled.add(number)

    def close(self) -> None:
        """Write the compiled kernels; a killed process would lose them, and the next one compile again."""
        self._runner.close()


def simulator_actor(make: Callable[[], Simulator], *, cpus: float, placement: Mapping[str, Any]) -> Any:
    """Start an actor; returns its handle at once, before the process is up.

    Args:
        make: makes the simulator, inside the actor.
        cpus: cores that Ray counts for it.
        placement: Ray's options that say where it runs.
    """
    made = actor_class(SimulatorProcess, ((CONTROL, 1),))
    return made.options(num_cpus=cpus, **placement).remote(make)
