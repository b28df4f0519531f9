"""Functions as tasks on a Ray cluster, without an event loop: one core each, repeated if their node is lost.

    with ClusterTasks(RaySettings(address="10.0.0.1:6379")) as tasks:
        shared = tasks.share(large_value)
        task = tasks.start(function, shared, 3)
        while not task.done: ...
        print(task.result())

Simulators, which keep state and can be cancelled, are actors instead (`actors.simulators.ray_worker`).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, Self

from actors.interfaces import LaboratoryError, RaySettings
from actors.runtime.ray_cluster import living_nodes
from actors.runtime.ray_runtime import RayStart, start_ray, stop_ray

RETRIES = 5
"""Number of repetitions of a task after its process or its node has died."""

_COUNT_INTERVAL = 5.0
"""Longest age of the number of cores [s]: nodes join and leave."""


class ClusterTask:
    """One task. It waits until a node has a free core; Ray repeats it if its process or its node dies."""

    def __init__(self, reference: Any) -> None:
        self._reference = reference

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        import ray

        return bool(ray.wait([self._reference], timeout=0.0)[0])

    def result(self) -> Any:
        """The value that the function has returned.

        Raises:
            LaboratoryError: the function failed, or its process died each time.
        """
        import ray

        try:
            return ray.get(self._reference)
        except ray.exceptions.RayTaskError as error:
            raise LaboratoryError(f"failed on the cluster: {error.cause!r}") from error
        except ray.exceptions.RayError as error:
            reason = (str(error).strip().splitlines() or [repr(error)])[0]
            raise LaboratoryError(f"its process died {RETRIES + 1} times on the cluster: {reason}") from error


class ClusterTasks:
    """A cluster that this program has joined. To be used with `with`; at the end its tasks are ended.

    Args:
        settings: the cluster; `actors.runtime.ray_cluster.check_cluster` has found it usable.
    """

    def __init__(self, settings: RaySettings) -> None:
        self._start = RayStart(settings.address)
        self._cpus, self._counted = 0, 0.0

    def __enter__(self) -> Self:
        start_ray(self._start)
        return self

    def __exit__(self, *exc: object) -> None:
        stop_ray()

    @property
    def cpus(self) -> int:
        """Cores of all nodes, at least 1."""
        if not self._cpus or time.monotonic() > self._counted + _COUNT_INTERVAL:
            self._cpus = max(sum(node.cpus for node in living_nodes().values()), 1)
            self._counted = time.monotonic()
        return self._cpus

    def share(self, value: Any) -> Any:
        """Return a reference to a value that several tasks use; it is transferred once to each node."""
        import ray

        return ray.put(value)

    def start(self, function: Callable[..., Any], *arguments: Any) -> ClusterTask:
        """Start a function of an importable module.

        Args:
            function: it must give the same result when it is repeated.
            arguments: serializable, or references from `share`.
        """
        return ClusterTask(_remote(function).remote(*arguments))


@functools.cache
def _remote(function: Callable[..., Any]) -> Any:
    """The function for Ray, which keeps every one that is made."""
    import ray

    return ray.remote(num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD")(function)
