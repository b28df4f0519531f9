"""Reading a vessel's mesh: formats, units, axes, and the reasons to refuse it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.spec import MeshShape

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FORMATS = ("stl", "obj", "ply", "glb")
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SMALLEST, LARGEST = 0.020, 0.500
"""Largest extent of a plausible vessel [m]."""
MOST_FACES = 1_000_000
LARGEST_FILE = 300_000_000
"""As much as so many triangles take where they are written as text [bytes]."""


def check_size(shape: MeshShape) -> None:
    """Refuse a file that is too large to be read, before it is.

    Raises:
        VesselError: it is.
        OSError: there is none.
    """
    size = shape.path.stat().st_size
    if size > LARGEST_FILE:
        raise VesselError(
            f"{shape.path.name}: {size / 1e6:.0f} MB; simplify it to at most {MOST_FACES:,} triangles, some 50 MB"
        )


def read_mesh(shape: MeshShape) -> tuple[Floats, Integers]:
    """Closed, outward-facing triangles of a mesh file in metres, z up.

    Returns:
        Vertices (V, 3) [m] and faces (F, 3).

    Raises:
        VesselError: unreadable, not closed, or of an implausible size.
        OSError: the file can't be read.
    """
    import trimesh

    kind = shape.path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise VesselError(f"{shape.path.name}: '{kind}' is not a mesh format known here; use {', '.join(FORMATS)}")
    content = shape.path.read_bytes()
    try:
        loaded = trimesh.load(io.BytesIO(content), file_type=kind, process=True)
    except Exception as problem:  # trimesh's readers raise whatever the broken byte led to
        raise VesselError(f"{shape.path.name}: not a readable {kind.upper()} file ({problem})") from problem
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh() if len(loaded.geometry) else None
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise VesselError(f"{shape.path.name}: no triangles in it; a vessel needs a closed mesh, not points or lines")
    if len(loaded.faces) > MOST_FACES:
        raise VesselError(f"{shape.path.name}: {len(loaded.faces):,} triangles; simplify it to at most {MOST_FACES:,}")
    if not np.all(np.isfinite(loaded.vertices)):
        raise VesselError(f"{shape.path.name}: some vertices are not finite numbers")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    loaded.update_faces(loaded.nondegenerate_faces())
    _check_closed(loaded, shape.path)
    scale = _scale(float(np.max(loaded.extents)), shape)
    vertices = np.asarray(loaded.vertices, dtype=float) @ to_z(shape.up).T * scale
    return vertices, np.asarray(loaded.faces, dtype=np.int64)


def _check_closed(mesh: object, path: Path) -> None:
    import trimesh

    assert isinstance(mesh, trimesh.Trimesh)
    # A surface is closed when its directed edges cancel; bodies that touch along an edge use it four times.
    _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    if np.any(uses % 2):
        open_edges = int(np.count_nonzero(uses % 2))
        raise VesselError(
            f"{path.name}: not watertight: {open_edges} edge(s) belong to an odd number of faces; "
            "close the holes (a vessel is a solid with walls, not a sheet)"
        )
    if not _edges_cancel(mesh.edges):
        trimesh.repair.fix_winding(mesh)
        if not _edges_cancel(mesh.edges):
            raise VesselError(f"{path.name}: its faces don't agree which side is out, and can't be made to; repair it")
    if mesh.volume < 0.0:
        mesh.invert()
    if not mesh.volume > 0.0:
        raise VesselError(f"{path.name}: encloses no volume")


def _edges_cancel(edges: Integers) -> bool:
    forth, back = np.lexsort((edges[:, 1], edges[:, 0])), np.lexsort((edges[:, 0], edges[:, 1]))
    return bool(np.array_equal(edges[forth], edges[back][:, ::-1]))


def _scale(extent: float, shape: MeshShape) -> float:
    if shape.unit is not None:
        size = extent * UNITS[shape.unit]
        if not SMALLEST / 4.0 <= size <= 2.0 * LARGEST:
            raise VesselError(
                f"{shape.path.name}: its largest extent of {extent:.4g} {shape.unit} is not a vessel's size "
                f"({1e3 * SMALLEST / 4.0:g} … {2e3 * LARGEST:g} mm); is its unit {_likely(extent)}?"
            )
        return UNITS[shape.unit]
    if not SMALLEST <= extent <= LARGEST:
        raise VesselError(
            f"{shape.path.name}: its largest extent would be {extent:.4g} m; a vessel measures "
            f"{1e3 * SMALLEST:g} … {1e3 * LARGEST:g} mm. State its unit: {_likely(extent)}"
        )
    return 1.0


def _likely(extent: float) -> str:
    fitting = [u for u in ("m", "mm", "cm", "in") if SMALLEST <= extent * UNITS[u] <= LARGEST]
    return " or ".join(f"'{u}' ({1e3 * extent * UNITS[u]:.4g} mm)" for u in fitting) or "none of m, cm, mm, in fits"


def to_z(up: str) -> Floats:
    """Rotation that turns an axis of the mesh, such as '-y', to z."""
    target = np.zeros(3)
    target["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    # the new x axis is the mesh's next axis in turn, so that a mesh with z up stays as it is
    x = np.roll(np.abs(target), 1)
    return np.stack([x, np.cross(target, x), target])
