"""Workers of the simulator pool as Ray actors: one process, one Taichi, one job at a time, on any machine.

- `RayWorker` is this program's side, `SimulatorProcess` runs inside the actor. `ray_pool` makes a pool of them.
- `Packer` and `unpack` transfer meshes as bytes, since a path is valid on one machine only. Both machines then have
  the same content, so that everything derived from it (distance grids, outcomes) has the same keys.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import hashlib
import os
import re
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.interfaces import LaboratoryError, SimulationError
from actors.runtime.child_process import last_lines
from actors.runtime.ray_cluster import Versions, versions
from actors.runtime.ray_runtime import worker_errors
from actors.runtime.remote_object import actor_class, kill_actor, mark_retrieved
from actors.simulators.job_runner import JobCancelledError, JobRunner, Simulator, pour_simulator
from actors.simulators.pool import (
    DEADLINE,
    RETRIES,
    Greeting,
    WorkerLostError,
    WorkerPool,
    WorkerReply,
    WorkerUnusableError,
)
from sim_engine.resources import cache_directory
from sim_engine.scene import PourTask
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec

NICENESS = 15
"""Priority of simulators [nice], below the arm's driver, the optimiser and other programs. Where no real arm moves it
is 0: next to busy programs, simulators at 15 would get next to nothing, and a virtual bench waits for its programs.
"""

CONTROL, LIFE = "control", "life"
"""Concurrency groups of calls that do not queue behind a job: short ones, and one that lasts as long as the process."""

FOLDER = "meshes"
"""Folder in the cache directory for meshes received from other machines."""


class SimulatorProcess:
    """The class that runs inside the actor.

    Ray's restarts are off: the pool replaces a dead worker and retries its job. Ray itself would lose queued calls and
    would not keep the order of those that it repeats."""

    def __init__(self, make: Callable[[], Simulator], niceness: int = NICENESS) -> None:
        os.nice(niceness)
        self._runner = JobRunner(make)
        self._recalled: set[int] = set()

    def greet(self) -> tuple[Greeting, Versions]:
        """Return the greeting, and the versions of everything that affects results, as soon as the process is up."""
        import ray

        return Greeting(os.getpid(), f"{socket.gethostname()} ({ray.util.get_node_ip_address()})"), versions()

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
        """Cancel a job: it ends between two steps, or never begins.

        This call runs concurrently with a job. Ray's own cancelling returns to the caller at once, but a job that
        waited behind another one would still run to its end.
        """
        self._recalled.add(number)

    def live(self) -> None:
        """Never return: the call fails once the process has died."""
        threading.Event().wait()

    def close(self) -> None:
        """Write the compiled kernels. If a process is killed, its kernels are lost and the next one compiles them
        again.
        """
        self._runner.close()


class RayWorker:
    """A `Worker` in a Ray actor.

    Args:
        make: creates the simulator, inside the actor.
        packer: shared by the workers of a pool.
        options: Ray's options that place the actor.
        expected: versions that it must have; None if they cannot differ.
        niceness: of its process.
    """

    def __init__(
        self,
        make: Callable[[], Simulator],
        packer: Packer,
        options: Mapping[str, Any],
        expected: Versions | None,
        niceness: int,
    ) -> None:
        self._packer, self._expected = packer, expected
        remote = actor_class(SimulatorProcess, ((CONTROL, 1), (LIFE, 1)))
        self._actor = remote.options(**options).remote(make, niceness)

    async def start(self) -> Greeting:
        """See `Worker.start`."""
        import ray

        try:
            greeting: Greeting
            greeting, versions = await asyncio.wrap_future(self._actor.greet.remote().future())
        except ray.exceptions.RayActorError as error:
            if "error raised in its creation task" in str(error):
                raise WorkerUnusableError(f"a simulator's process does not start: {_last_line(error)}") from error
            raise _lost(error) from error
        if self._expected is not None and (difference := self._expected.difference(versions)):
            raise WorkerUnusableError(f"the simulator on {greeting.host} is not like this machine's: {difference}")
        died = asyncio.wrap_future(self._actor.live.options(concurrency_group=LIFE).remote().future())
        died.add_done_callback(mark_retrieved)
        return dataclasses.replace(greeting, died=died)

    async def run(self, number: int, task: PourTask) -> WorkerReply:
        """See `Worker.run`."""
        import ray

        packed, meshes = self._packer.shared(task)
        try:
            reply = await asyncio.wrap_future(self._actor.simulate.remote(number, packed, *meshes).future())
        except ray.exceptions.RayActorError as error:
            raise _lost(error) from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, LaboratoryError | JobCancelledError):
                raise error.cause from None
            raise SimulationError(f"the simulator failed: {error.cause!r}") from error
        return WorkerReply(reply.result.copied(), reply.seconds)

    def cancel(self, number: int) -> None:
        """See `Worker.cancel`."""
        with contextlib.suppress(Exception):  # Ray has ended
            self._actor.recall.options(concurrency_group=CONTROL).remote(number)

    async def close(self, timeout: float) -> None:
        """See `Worker.close`."""
        if timeout > 0.0:
            closing = asyncio.wrap_future(self._actor.close.remote().future())
            closing.add_done_callback(mark_retrieved)
            await asyncio.wait({closing}, timeout=timeout)
        kill_actor(self._actor)


def ray_pool(
    size: int,
    make: Callable[[], Simulator] = pour_simulator,
    *,
    cpus: float = 1.0,
    placement: Mapping[str, Any] | None = None,
    expected: Versions | None = None,
    niceness: int = NICENESS,
    retries: int = RETRIES,
    deadline: float = DEADLINE,
    tell: Callable[[str], None] = lambda text: None,
) -> WorkerPool:
    """A pool of Ray actors; needs a running Ray (`actors.runtime.ray_runtime`).

    Args:
        size: number of workers.
        make: creates a worker's simulator, inside its process.
        cpus: cores that Ray counts for a worker.
        placement: Ray's options that place the workers.
        expected: versions that workers must have; None if they cannot differ.
        niceness: of the workers' processes.
        retries, deadline, tell: see `WorkerPool`.
    """
    options = {"num_cpus": cpus, **(placement or {})}
    worker = partial(RayWorker, make, Packer(), options, expected, niceness)
    return WorkerPool(size, worker, ahead=1, retries=retries, deadline=deadline, tell=tell)


def _lost(error: BaseException) -> WorkerLostError:
    pid = re.search(r"\bpid: (\d+)", str(error))
    return WorkerLostError(messages="" if pid is None else last_lines(worker_errors(int(pid[1]))))


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else repr(error)


@dataclass(frozen=True, eq=False)
class SerializedMesh:
    """One mesh file.

    Attributes:
        key: digest of the content, then the file's own name for messages. It is the path below `FOLDER`.
        content: (n,) uint8; an array is passed through shared memory without a copy.
    """

    key: Path
    content: NDArray[np.uint8]


class Packer:
    """Makes tasks independent of this machine's files. Each mesh is read once, at its first use."""

    def __init__(self) -> None:
        self._meshes: dict[MeshShape, SerializedMesh] = {}
        self._references: dict[Path, Any] = {}

    def pack(self, task: PourTask) -> tuple[PourTask, list[SerializedMesh]]:
        """Return the task without paths, and its meshes.

        Raises:
            SimulationError: a mesh cannot be read.
        """
        meshes: list[SerializedMesh] = []

        def packed(vessel: VesselSpec) -> VesselSpec:
            if not isinstance(vessel.shape, MeshShape):
                return vessel
            mesh = self.serialized(vessel.shape)
            meshes.append(mesh)
            return _with_path(vessel, vessel.shape, mesh.key)

        return _with_vessels(task, packed(task.scene.pourer), packed(task.scene.receiver)), meshes

    def shared(self, task: PourTask) -> tuple[PourTask, list[Any]]:
        """Return the task without paths, and Ray's references of its meshes. Raises as `pack` does."""
        packed, meshes = self.pack(task)
        for mesh in meshes:
            if mesh.key not in self._references:
                import ray

                self._references[mesh.key] = ray.put(mesh)
        return packed, [self._references[mesh.key] for mesh in meshes]

    def serialized(self, shape: MeshShape) -> SerializedMesh:
        """The file of a mesh.

        Raises:
            SimulationError: it cannot be read.
        """
        if shape not in self._meshes:
            try:
                content = shape.path.read_bytes()
            except OSError as error:
                raise SimulationError(f"{shape.path}: the mesh can't be read: {error.strerror}") from error
            key = Path(hashlib.sha256(content).hexdigest()[:24]) / shape.path.name
            self._meshes[shape] = SerializedMesh(key, np.frombuffer(content, np.uint8))
        return self._meshes[shape]


def unpack(task: PourTask, meshes: Sequence[SerializedMesh]) -> PourTask:
    """Return a packed task with its meshes as files of this machine.

    Args:
        task: as `Packer.pack` made it.
        meshes: its meshes.

    Raises:
        OSError: the cache directory cannot be written.
    """
    if not meshes:
        return task
    paths = {mesh.key: _write(mesh) for mesh in meshes}

    def unpacked(vessel: VesselSpec) -> VesselSpec:
        shape = vessel.shape
        return _with_path(vessel, shape, paths[shape.path]) if isinstance(shape, MeshShape) else vessel

    return _with_vessels(task, unpacked(task.scene.pourer), unpacked(task.scene.receiver))


def _write(mesh: SerializedMesh) -> Path:
    """Write the mesh to a file. Other processes of this machine may write the same one."""
    path = cache_directory() / FOLDER / mesh.key
    if not path.exists() or path.stat().st_size != mesh.content.size:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
            file.write(mesh.content.tobytes())
        Path(file.name).replace(path)
    return path


def _with_path(vessel: VesselSpec, shape: MeshShape, path: Path) -> VesselSpec:
    return vessel.model_copy(update={"shape": shape.model_copy(update={"path": path})})


def _with_vessels(task: PourTask, pourer: VesselSpec, receiver: VesselSpec) -> PourTask:
    if pourer is task.scene.pourer and receiver is task.scene.receiver:
        return task
    return dataclasses.replace(task, scene=dataclasses.replace(task.scene, pourer=pourer, receiver=receiver))
