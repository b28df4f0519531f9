"""Transfer of tasks to other machines: meshes are sent as bytes, since a path is valid on one machine only.

`Packer` makes a task independent of files; `unpack` writes its meshes into the receiver's cache directory. Both
machines then have the same content, so that everything derived from it (distance grids, outcomes) has the same keys.
"""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.interfaces import SimulationError
from sim_engine.resources import cache_directory
from sim_engine.scene import PourTask
from sim_engine.vessel.shapes import MeshShape, VesselSpec

FOLDER = "meshes"
"""Folder in the cache directory for meshes received from other machines."""


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
        self._parcels: dict[MeshShape, SerializedMesh] = {}

    def pack(self, task: PourTask) -> tuple[PourTask, list[SerializedMesh]]:
        """Pack a task.

        Args:
            task: with paths of this machine.

        Returns:
            The task without paths, and its meshes.

        Raises:
            SimulationError: a mesh cannot be read.
        """
        meshes: list[SerializedMesh] = []

        def packed(vessel: VesselSpec) -> VesselSpec:
            if not isinstance(vessel.shape, MeshShape):
                return vessel
            mesh = self._serialized(vessel.shape)
            meshes.append(mesh)
            return _with_path(vessel, vessel.shape, mesh.key)

        return _with_vessels(task, packed(task.scene.pourer), packed(task.scene.receiver)), meshes

    def _serialized(self, shape: MeshShape) -> SerializedMesh:
        if shape not in self._parcels:
            try:
                content = shape.path.read_bytes()
            except OSError as error:
                raise SimulationError(f"{shape.path}: the mesh can't be read: {error.strerror}") from error
            key = Path(hashlib.sha256(content).hexdigest()[:24]) / shape.path.name
            self._parcels[shape] = SerializedMesh(key, np.frombuffer(content, np.uint8))
        return self._parcels[shape]


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
    paths = {mesh.key: _laid_out(mesh) for mesh in meshes}

    def unpacked(vessel: VesselSpec) -> VesselSpec:
        shape = vessel.shape
        return _with_path(vessel, shape, paths[shape.path]) if isinstance(shape, MeshShape) else vessel

    return _with_vessels(task, unpacked(task.scene.pourer), unpacked(task.scene.receiver))


def _laid_out(mesh: SerializedMesh) -> Path:
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
