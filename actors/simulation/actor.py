"""The Ray actor around a `SimulationWorker`: one process, one Taichi, one job at a time."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from actors.protocols import SimulationResult
from actors.simulation.worker import SimulationWorker, Simulator
from sim_engine.task import PourTask


class SimulatorProcess:
    """What runs inside the actor. Ray's restarts are off: the pool replaces a dead member and retries its job itself,
    since Ray would lose the calls that were queued and give no order to those it repeats."""

    def __init__(self, make: Callable[[], Simulator]) -> None:
        self._worker = SimulationWorker(make)

    def simulate(self, task: PourTask) -> SimulationResult:
        """See `SimulationWorker.simulate`; asks Ray whether the caller has cancelled."""
        import ray

        return self._worker.simulate(task, ray.get_runtime_context().is_canceled)

    def pid(self) -> int:
        """Process id."""
        return os.getpid()

    def close(self) -> None:
        """Write the compiled kernels; a killed process would lose them, and the next one compile again."""
        self._worker.close()


def simulator_actor(make: Callable[[], Simulator], *, cpus: float) -> Any:
    """Start an actor; returns its handle at once, before the process is up.

    Args:
        make: makes the simulator, inside the actor.
        cpus: cores that Ray counts for it.
    """
    import ray

    cls = ray.remote(num_cpus=cpus, max_restarts=0, max_task_retries=0)(SimulatorProcess)
    return cls.remote(make)
