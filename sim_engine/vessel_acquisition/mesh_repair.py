"""Repairs a mesh from a scanner or a CAD program, so that it is the closed solid that a vessel has to be.

It determines the unit, drops small loose parts, closes holes, thickens a sheet without thickness outwards, and joins
parts that cross each other. Several vessels in one file are refused.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.mesh import FORMATS, MOST_FACES, UNITS, check_size
from sim_engine.vessel.shapes import LengthUnit, MeshShape, VesselError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SMALLEST, LARGEST = 0.030, 0.400
"""Smallest and largest plausible extent of vessels on a bench [m]."""

CRUMB = 0.02
"""Share of the surface below which a loose part is dropped."""

HOLE = 0.6
"""For a sheet: share of the longest boundary below which a boundary is a hole to be closed."""


@dataclass(frozen=True)
class RepairedMesh:
    """A closed solid.

    Attributes:
        vertices: (V, 3) [m].
        faces: normals outwards, (F, 3).
        unit: of the file's numbers.
        notes: descriptions of the repairs.
    """

    vertices: Floats
    faces: Integers
    unit: LengthUnit
    notes: tuple[str, ...]


def mended(path: Path, *, unit: LengthUnit | None, wall: float | None) -> RepairedMesh:
    """Read a mesh and repair it.

    Args:
        path: STL, OBJ, PLY or GLB.
        unit: of its numbers; None: determined by its size.
        wall: thickness given to a sheet [m].

    Raises:
        VesselError: it cannot be made a solid; the text gives a remedy.
        OSError: the file cannot be read.
    """
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise VesselError(f"{path.name}: '{kind}' is not a mesh format known here; use {', '.join(FORMATS)}")
    check_size(MeshShape(path=path))
    try:
        mesh = trimesh.load(io.BytesIO(path.read_bytes()), file_type=kind, force="mesh", process=True)
    except Exception as problem:  # trimesh's readers raise various errors for damaged files
        raise VesselError(f"{path.name}: not a readable {kind.upper()} file ({problem})") from problem
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise VesselError(f"{path.name}: no triangles in it; if it has points only, use --points")
    if len(mesh.faces) > MOST_FACES:
        raise VesselError(f"{path.name}: {len(mesh.faces):,} triangles; simplify it to at most {MOST_FACES:,}")
    notes: list[str] = []
    found = unit or likely_unit(float(np.max(mesh.extents)), path)
    if unit is None:
        notes.append(
            f"its numbers are taken for {found}: it is {1e3 * UNITS[found] * np.max(mesh.extents):.0f} mm large"
        )
    mesh.apply_scale(UNITS[found])
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh = _one_body(mesh, path, notes)
    if not mesh.is_watertight:
        mesh = _closed(mesh, path, wall, notes)
    trimesh.repair.fix_normals(mesh)
    if mesh.volume < 0.0:
        mesh.invert()
    vertices, faces = _joined(
        np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64), path, notes
    )
    return RepairedMesh(vertices, faces, found, tuple(notes))


def likely_unit(extent: float, path: Path) -> LengthUnit:
    """The unit in which a vessel's size is plausible.

    Args:
        extent: largest extent of it, in that unit.
        path: of its file, for messages.

    Raises:
        VesselError: no unit is plausible, or several are.
    """
    fitting: list[LengthUnit] = [u for u in ("mm", "cm", "m", "in") if SMALLEST <= extent * UNITS[u] <= LARGEST]
    if len(fitting) == 1:
        return fitting[0]
    shown = " or ".join(f"--unit {u} ({1e3 * extent * UNITS[u]:.0f} mm)" for u in fitting)
    if shown:
        raise VesselError(f"{path.name}: its largest extent of {extent:.4g} fits several units; say which: {shown}")
    raise VesselError(f"{path.name}: its largest extent of {extent:.4g} is a vessel's in no unit; say one with --unit")


def _one_body(mesh: Any, path: Path, notes: list[str]) -> Any:
    parts = mesh.split(only_watertight=False)
    if len(parts) <= 1:
        return mesh
    large = [part for part in parts if part.area >= CRUMB * mesh.area]
    crumbs = len(parts) - len(large)
    apart = [part for part in large[1:] if not _boxes_meet(part.bounds, large[0].bounds)]
    if apart:
        sizes = ", ".join(" × ".join(f"{1e3 * x:.0f}" for x in part.extents) + " mm" for part in large[:4])
        raise VesselError(f"{path.name}: {len(large)} bodies ({sizes}); a vessel is one: save it alone")
    if crumbs:
        notes.append(f"{crumbs} loose crumb(s) dropped")
    import trimesh

    return trimesh.util.concatenate(large) if crumbs else mesh


def _boxes_meet(a: Floats, b: Floats) -> bool:
    return bool(np.all(a[0] <= b[1] + 1e-4) and np.all(b[0] <= a[1] + 1e-4))


def _closed(mesh: Any, path: Path, wall: float | None, notes: list[str]) -> Any:
    """Fill holes; if one boundary is as long as an opening, the mesh is a sheet, and is thickened."""
    import trimesh

    before = len(mesh.faces)
    if trimesh.repair.fill_holes(mesh):
        notes.append(f"holes closed with {len(mesh.faces) - before} triangle(s)")
        return mesh
    loops = _boundaries(mesh)
    if not loops:
        raise VesselError(f"{path.name}: some edges belong to more than two faces; repair it with a mesh program")
    lengths = np.array([_length(mesh.vertices, loop) for loop in loops])
    # an opening is at least as long as a circle with a third of the mesh's width as its diameter
    opening = lengths.max() > np.pi * np.sort(mesh.extents)[1] / 3.0 and not _is_solid_with_hole(mesh, loops)
    small = [loop for loop, length in zip(loops, lengths, strict=True) if not opening or length < HOLE * lengths.max()]
    mesh = _filled(mesh, small)
    if small:
        longest = 1e3 * max(_length(mesh.vertices, loop) for loop in small)
        notes.append(f"{len(small)} hole(s) closed, the longest {longest:.0f} mm around")
    if not opening:
        return mesh
    if wall is None:
        raise VesselError(
            f"{path.name}: a sheet without thickness (its opening is one edge of {1e3 * lengths.max():.0f} mm); say "
            "how thick its wall is, for example --wall 3mm, and it is thickened outwards"
        )
    notes.append(f"the sheet was thickened outwards by {1e3 * wall:g} mm")
    return _thickened(mesh, wall)


def _is_solid_with_hole(mesh: Any, loops: Sequence[Integers]) -> bool:
    """Whether a large hole is a missing piece of a solid: its faces point both towards and away from the axis."""
    centre = mesh.bounds.mean(axis=0)
    across = mesh.triangles_center[:, :] - centre
    axis = int(np.argmax(np.abs([np.ptp(mesh.vertices[np.concatenate(list(loops))], axis=0)]).min(axis=0) < 0))
    radial = np.delete(across, axis if len(loops) > 1 else 2, axis=1)
    facing = np.einsum("ij,ij->i", radial, np.delete(mesh.face_normals, axis if len(loops) > 1 else 2, axis=1))
    outwards = float(mesh.area_faces[facing > 0.0].sum() / mesh.area)
    return 0.25 < outwards < 0.75


def _boundaries(mesh: Any) -> list[Integers]:
    """Closed boundaries as loops of vertices."""
    edges = mesh.edges_sorted
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    single = {tuple(edge) for edge in unique[uses == 1].tolist()}
    onward: dict[int, int] = {}
    for a, b in mesh.edges.tolist():
        if (min(a, b), max(a, b)) in single:
            onward[b] = a  # opposite to the faces' own order, so that the filling faces the same side
    loops = []
    while onward:
        first, then = onward.popitem()
        loop = [first]
        while then != first:
            loop.append(then)
            if then not in onward:
                break
            then = onward.pop(then)
        else:
            loops.append(np.array(loop))
    return [loop for loop in loops if len(loop) >= 3]


def _length(vertices: Floats, loop: Integers) -> float:
    corners = vertices[loop]
    return float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).sum())


def _filled(mesh: Any, loops: Sequence[Integers]) -> Any:
    """Close each loop by a fan about its middle."""
    import trimesh

    if not loops:
        return mesh
    vertices, faces = [np.asarray(mesh.vertices)], [np.asarray(mesh.faces)]
    count = len(mesh.vertices)
    for loop in loops:
        vertices.append(mesh.vertices[loop].mean(axis=0)[None])
        faces.append(np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), count)]))
        count += 1
    return trimesh.Trimesh(np.vstack(vertices), np.vstack(faces), process=False)


def _thickened(mesh: Any, wall: float) -> Any:
    """A sheet and its offset, joined at the rim. The sheet's own side is unchanged."""
    import trimesh

    trimesh.repair.fix_winding(mesh)
    centre = mesh.vertices.mean(axis=0)
    outwards = float(np.einsum("ij,ij->i", mesh.triangles_center - centre, mesh.face_normals) @ mesh.area_faces)
    if outwards < 0.0:
        mesh.invert()
    inner = np.asarray(mesh.vertices)
    outer = inner + wall * np.asarray(mesh.vertex_normals)
    count = len(inner)
    faces = [np.asarray(mesh.faces)[:, ::-1], np.asarray(mesh.faces) + count]
    for loop in _boundaries(mesh):
        after = np.roll(loop, -1)
        faces += [np.column_stack([after, loop, loop + count]), np.column_stack([after, loop + count, after + count])]
    return trimesh.Trimesh(np.vstack([inner, outer]), np.vstack(faces), process=False)


def _joined(vertices: Floats, faces: Integers, path: Path, notes: list[str]) -> tuple[Floats, Integers]:
    """One manifold solid of parts that may cross each other.

    Raises:
        VesselError: it is still not a solid.
    """
    import manifold3d

    welded = manifold3d.Mesh(
        vert_properties=np.asarray(vertices * 1e3, dtype=np.float32), tri_verts=np.asarray(faces, dtype=np.uint32)
    )
    welded.merge()
    solid = manifold3d.Manifold(welded)
    if solid.status() != manifold3d.Error.NoError:
        reason = str(solid.status()).rpartition(".")[2]
        raise VesselError(
            f"{path.name}: is still not a closed solid after mending ({reason}); repair it with a mesh program"
        )
    parts = solid.decompose()
    if len(parts) > 1:
        solid = manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)
        notes.append(f"{len(parts)} parts that touch were joined")
    result = solid.to_mesh()
    return np.asarray(result.vert_properties[:, :3], dtype=float) / 1e3, np.asarray(result.tri_verts, dtype=np.int64)
