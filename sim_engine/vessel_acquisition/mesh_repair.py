"""Repairs a mesh from a scanner or a CAD program, so that it is the closed solid that a vessel has to be.

It determines the unit, drops small loose parts, closes holes, joins parts that cross each other, and thickens a sheet
without thickness and walls that are too thin for the grid, both outwards. Triangles that do not close are repaired in
`surface_repair`. Several vessels in one file are refused. A closed mesh of one part with thick walls stays as it is.

Steps that may change the cavity compare its volume before and after (`exact_cavity`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_engine.resources import MissingExtraError, installed
from sim_engine.settings.plugin_registry import DISTRIBUTION
from sim_engine.vessel.exact_cavity import exact_cavity, fillers
from sim_engine.vessel.mesh import (
    UNITS,
    load_triangles,
    scale_of,
    to_z,
    typical_wall,
    wall_thickness,
)
from sim_engine.vessel.mesh_shape import Axis, MeshShape
from sim_engine.vessel.mesh_surface import components, normals_and_areas
from sim_engine.vessel.shapes import LengthUnit, VesselError
from sim_engine.vessel_acquisition.surface_repair import (
    boundary_loops,
    distinct,
    holes_filled,
    is_closed,
    oriented,
    outwards,
    rebuilt,
    welded,
    without_redundant,
)
from sim_engine.vessel_acquisition.wall_thickening import fits_grid, thickened

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SMALLEST, LARGEST = 0.030, 0.400
"""Smallest and largest plausible extent of vessels on a bench [m]."""

LEAST, MOST = 20e-6, 20e-3
"""Smallest and largest plausible capacity of vessels whose unit is not given [m³]."""

CRUMB = 0.02
"""Share of the surface below which a loose part is dropped."""

HOLE = 0.6
"""For a sheet: share of the longest boundary below which a boundary is a hole to be closed."""

LARGE_HOLE = 0.01
"""Share of the surface from which a closed hole, or an open surface that is dropped, is a warning."""

ARC, ARC_HEIGHT = 30.0, 0.15
"""Angle around the axis from which a hole is a missing part of the wall [deg], and its least height as a share of the
vessel's. Smaller holes are closed; a boundary that encloses the axis is an opening. A flat patch across 30° lies 3 % of
the radius inside. A gap in the rim lowers the lip however narrow it is; a slanted rim falls over a wider angle than a
gap."""

TOUCHING = 0.5e-3
"""Largest distance of the edge of a liquid's surface from the vessel [m]; walls are thicker."""

RIM, COMPACT = 0.98, 0.45
"""Share of the vessel's height from which a hole goes through the rim; share of its box that another one takes."""

BESIDE = 1e-4
"""Largest height above the underside of a bowl of an open surface that is its stem or foot [m]."""

CHANGED = 0.01
"""Relative change of the cavity from which a repair is a warning."""

FLATNESS = 0.02
"""Largest deviation of a simplified surface [mm]."""


@dataclass(frozen=True)
class RepairedMesh:
    """A closed solid.

    Attributes:
        vertices: (V, 3) [m].
        faces: normals outwards, (F, 3).
        unit: of the file's numbers.
        notes: descriptions of the repairs.
        warnings: what the user has to look at.
    """

    vertices: Floats
    faces: Integers
    unit: LengthUnit
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class MissingArc:
    """A part of the wall that is missing.

    Attributes:
        begin, end: around the axis, from x [deg].
        bottom, top: above the underside [m].
    """

    begin: float
    end: float
    bottom: float
    top: float

    def __str__(self) -> str:
        span = self.end - self.begin
        ends = f"{span:.0f}° around the axis ({self.begin:.0f}° to {self.end % 360.0:.0f}° from x)"
        where = "all around the axis" if span >= 360.0 else ends
        return f"{where}, {1e3 * self.bottom:.0f} to {1e3 * self.top:.0f} mm above the underside"


class MissingWallError(VesselError):
    """A hole takes out so much of a wall that its closing would be a guess.

    Attributes:
        corners: of the surface that is there, shape (N, 3) [m], z up.
        holes: boundaries of the holes, each (M, 3) [m].
    """

    def __init__(self, message: str, corners: Floats, holes: list[Floats]) -> None:
        super().__init__(message)
        self.corners, self.holes = corners, holes


@dataclass
class _Log:
    """File and axis for messages, and the messages."""

    path: Path
    turn: Floats
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def capacity(self, vertices: Floats, faces: Integers) -> float | None:
        """Volume of the cavity [m³]; None if the surface is not closed."""
        try:
            return exact_cavity(vertices @ self.turn.T, faces).volume
        except VesselError:
            return None

    def compare(self, quantity: str, before: float | None, after: float | None) -> None:
        """Add a note of a repair, or a warning with both capacities if it changed the cavity."""
        if before is None or after is None or abs(after - before) <= CHANGED * max(before, after):
            self.notes.append(quantity)
        else:
            self.warnings.append(f"{quantity}: that changed the cavity from {1e6 * before:.0f} to {1e6 * after:.0f} mL")


def mended(
    path: Path, *, unit: LengthUnit | None, wall: float | None, up: Axis = "z", drop_bodies: bool = False
) -> RepairedMesh:
    """Read a mesh and repair it.

    Args:
        path: STL, OBJ, PLY or GLB.
        unit: of its numbers; None: determined by its size.
        wall: thickness given to a sheet [m].
        up: axis of the mesh that points out of the opening.
        drop_bodies: leave out separate bodies that fill a part of the cavity.

    Raises:
        VesselError: it cannot be made a solid; the text gives a remedy.
        MissingExtraError: it needs a package that is not installed.
        OSError: the file cannot be read.
    """
    import trimesh

    log = _Log(path, to_z(up))
    mesh = _read(path)
    extent = float(np.max(mesh.extents))
    if unit is not None:
        scale_of(extent, MeshShape(path=path, unit=unit))
    length_unit = unit or likely_unit(extent, path)
    if unit is None:
        log.notes.append(
            f"its numbers are taken for {length_unit}: it is {1e3 * UNITS[length_unit] * extent:.0f} mm large"
        )
    mesh.apply_scale(UNITS[length_unit])
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    if not len(mesh.faces):
        raise VesselError(f"{path.name}: all of its triangles are without area")
    if not mesh.is_watertight:
        _require_igl()
        mesh = _closed(mesh, wall, log)
    else:
        mesh = _one_body(mesh, path, log.notes)
        trimesh.repair.fix_normals(mesh)
        if mesh.volume < 0.0:
            mesh.invert()
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    faces = _without_fillers(vertices, faces, drop_bodies, log)
    joined = _joined(vertices, faces, log)
    if joined is None:
        _require_igl()
        joined = _remade(vertices, faces, log)
    vertices, faces = joined
    if (held := log.capacity(vertices, faces)) and not LEAST <= held <= MOST:
        sizes = ", ".join(
            f"--unit {u} ({1e3 * extent * UNITS[u]:.4g} mm, {1e6 * held * (UNITS[u] / UNITS[length_unit]) ** 3:.3g} mL)"
            for u in UNITS
        )
        if unit is None:
            raise VesselError(f"{path.name}: its unit is not clear from its size and its capacity; say which: {sizes}")
        log.warnings.append(
            f"in {unit} it holds {1e6 * held:.3g} mL, which no vessel on a bench does; is the unit right? {sizes}"
        )
    return RepairedMesh(_thick_enough(vertices, faces, log), faces, length_unit, tuple(log.notes), tuple(log.warnings))


def _require_igl() -> None:
    if not installed("igl"):
        raise MissingExtraError(
            "mending this mesh needs the package 'libigl', which is not installed: "
            f"pip install '{DISTRIBUTION}[vessels]'"
        )


def _read(path: Path) -> Any:
    mesh = load_triangles(path)
    if not np.all(np.isfinite(mesh.vertices)):
        mesh.update_faces(np.isfinite(mesh.vertices).all(axis=1)[mesh.faces].all(axis=1))
        mesh.remove_unreferenced_vertices()
        if not len(mesh.faces):
            raise VesselError(f"{path.name}: its vertices are not finite numbers")
    return mesh


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
    large = [body for body in parts if body.area >= CRUMB * mesh.area]
    crumbs = len(parts) - len(large)
    apart = [body for body in large[1:] if not _boxes_meet(body.bounds, large[0].bounds)]
    if apart:
        sizes = ", ".join(" × ".join(f"{1e3 * x:.0f}" for x in body.extents) + " mm" for body in large[:4])
        raise VesselError(f"{path.name}: {len(large)} bodies ({sizes}); a vessel is one: save it alone")
    if crumbs:
        notes.append(f"{crumbs} loose crumb(s) dropped")
    import trimesh

    return trimesh.util.concatenate(large) if crumbs else mesh


def _boxes_meet(a: Floats, b: Floats) -> bool:
    return bool(np.all(a[0] <= b[1] + 1e-4) and np.all(b[0] <= a[1] + 1e-4))


def _closed(mesh: Any, wall: float | None, log: _Log) -> Any:
    """A closed surface from triangles that are open, doubled, or crossed by others."""
    vertices, faces, tolerance = welded(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))
    if tolerance:
        log.notes.append(f"corners less than {1e6 * tolerance:g} µm apart were joined")
    faces = _without_crumbs(vertices, distinct(faces), log)
    upright = vertices @ log.turn.T
    bottom = float(upright[faces.ravel(), 2].min())
    faces, removed = without_redundant(upright, faces)
    if removed.within:
        log.notes.append(f"{removed.within} inner face(s), which bound no solid, were removed")
    floor = float(upright[faces.ravel(), 2].min())
    beneath = [bool(upright[sheet, 2].max() <= floor + BESIDE) for sheet in removed.sheets]
    sheets = [sheet for sheet, below in zip(removed.sheets, beneath, strict=True) if not below]
    base = [sheet for sheet, below in zip(removed.sheets, beneath, strict=True) if below]
    least = LARGE_HOLE * float(normals_and_areas(vertices, faces)[1].sum())
    areas = [float(normals_and_areas(vertices, sheet)[1].sum()) for sheet in sheets]
    for sheet, area in zip(sheets, areas, strict=True):
        if area >= least and (ring := _missing_ring(upright, faces, sheet, bottom)):
            whole = np.vstack([faces, *removed.sheets])
            raise _missing_wall(log, [ring], upright, whole, boundary_loops(whole))
    if small := [area for area in areas if area < least]:
        area = 1e4 * sum(small)
        log.notes.append(f"{len(small)} small open surface(s), which bound no solid, of {area:.2g} cm² were dropped")
    for sheet, area in zip(sheets, areas, strict=True):
        low, high = (1e3 * (limit(upright[sheet, 2]) - bottom) for limit in (np.min, np.max))
        if area >= least:
            log.warnings.append(
                f"an open surface of {1e4 * area:.3g} cm², {low:.3g} to {high:.3g} mm above the underside, was "
                "dropped: it bounds no solid (the surface of a liquid?)"
            )
    closed, faces = _without_holes(vertices, faces, wall, log)
    faces = outwards(closed, faces)
    if base:
        foot = np.concatenate(base)
        vertices, foot, _ = holes_filled(vertices, foot, boundary_loops(foot))
        faces = np.vstack([faces, outwards(vertices, foot) + len(closed)])
        closed = np.vstack([closed, vertices])
        log.notes.append(
            f"its stem or foot, {1e3 * (floor - bottom):.0f} mm high and open, was closed and counts as solid"
        )
    return _mesh(closed, faces)


def _mesh(vertices: Floats, faces: Integers) -> Any:
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def _without_crumbs(vertices: Floats, faces: Integers, log: _Log) -> Integers:
    component = components(faces)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.bincount(component, area) / area.sum()
    large = np.flatnonzero(share >= min(CRUMB, share.max()))
    bounds = [(corners[component == k].min(axis=(0, 1)), corners[component == k].max(axis=(0, 1))) for k in large]
    main = int(np.argmax(share[large]))
    apart = [
        k for k, each in zip(large, bounds, strict=True) if not _boxes_meet(np.array(each), np.array(bounds[main]))
    ]
    if apart:
        upright = vertices @ log.turn.T
        parts = [(faces[component == large[main]], faces[component == k]) for k in apart]
        rings = [_missing_ring(upright, *pair, float(upright[faces, 2].min())) for pair in parts]
        if all(rings):
            raise _missing_wall(log, [ring for ring in rings if ring], upright, faces, boundary_loops(faces))
        sizes = ", ".join(" × ".join(f"{1e3 * x:.0f}" for x in high - low) + " mm" for low, high in bounds[:4])
        raise VesselError(f"{log.path.name}: {len(large)} bodies ({sizes}); a vessel is one: save it alone")
    if len(large) < len(share):
        log.notes.append(f"{len(share) - len(large)} loose crumb(s) dropped")
    return faces[np.isin(component, large)]


def _without_holes(vertices: Floats, faces: Integers, wall: float | None, log: _Log) -> tuple[Floats, Integers]:
    """Close holes; if one boundary is the opening of a sheet, thicken the sheet."""
    loops = boundary_loops(faces)
    if not loops:
        return vertices, faces
    lengths = np.array([_length(vertices, loop) for loop in loops])
    # an opening is at least as long as a circle with a third of the mesh's width as its diameter
    width = np.sort(np.ptp(vertices[faces.ravel()], axis=0))[1]
    upright = vertices @ log.turn.T
    opening = bool(lengths.max() > np.pi * width / 3.0 and _is_sheet(upright, faces))
    if opening:
        small = [loop for loop, length in zip(loops, lengths, strict=True) if length < HOLE * lengths.max()]
    else:
        # an inner and an outer surface without a rim between them: closed each by itself, they would hold nothing
        around = [bool(np.ptp(upright[loop, :2], axis=0).min() > 0.5 * width) for loop in loops]
        small = [loop for loop, each in zip(loops, around, strict=True) if sum(around) < 2 or not each]
    arcs = [arc for loop in small if (arc := _missing_arc(upright, loop)) is not None]
    if opening and (gap := _gap_in_rim(upright, edge := loops[int(lengths.argmax())])) is not None:
        arcs, small = [*arcs, gap], [*small, edge]
    if arcs:
        raise _missing_wall(log, arcs, upright, faces, small)
    if small:
        vertices, faces, areas = holes_filled(vertices, faces, small)
        longest = 1e3 * max(_length(vertices, loop) for loop in small)
        text = f"{len(small)} hole(s) closed, the longest {longest:.0f} mm around"
        corners = vertices[faces]
        whole = (
            0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        )
        if areas.max() > LARGE_HOLE * whole:
            log.warnings.append(f"{text}; the largest has {1e4 * areas.max():.3g} cm²: check the shape there")
        else:
            log.notes.append(text)
    if not opening:
        return vertices, faces
    if wall is None:
        raise VesselError(
            f"{log.path.name}: a sheet without thickness (its opening is one edge of {1e3 * lengths.max():.0f} mm); "
            "say how thick its wall is, for example --wall 3mm, and it is thickened outwards. If it is the outside of "
            "a vessel, its inside is missing: export both"
        )
    log.notes.append(f"the sheet was thickened outwards by {1e3 * wall:g} mm")
    thick = _thickened(_mesh(vertices, faces), wall)
    return np.asarray(thick.vertices, dtype=float), np.asarray(thick.faces, dtype=np.int64)


def _missing_wall(
    log: _Log, arcs: list[MissingArc], upright: Floats, faces: Integers, loops: list[Integers]
) -> MissingWallError:
    return MissingWallError(
        f"{log.path.name}: a part of its wall is missing: {' and '.join(map(str, arcs))}. What closes such a "
        "hole is a guess: scan the vessel again from that side, close the hole in a mesh program, or describe the "
        "vessel by --height and --diameters (vessel profile)",
        upright[np.unique(faces)],
        [upright[loop] for loop in loops],
    )


def _missing_ring(upright: Floats, faces: Integers, sheet: Integers, underside: float) -> MissingArc | None:
    """The part of an inner or outer wall that is missing all around, between an open surface and the vessel.

    None if the open surface touches the vessel, as that of a liquid does, or if the vessel has no edge around the axis.
    """
    import igl

    middle = 0.5 * (upright[faces.ravel(), :2].min(axis=0) + upright[faces.ravel(), :2].max(axis=0))
    ends = [loop for loop in boundary_loops(faces) if _encloses(upright[loop], middle)]
    edges = [loop for loop in boundary_loops(sheet) if _encloses(upright[loop], middle)]
    if not ends or not edges:
        return None
    squared = igl.point_mesh_squared_distance(upright[np.concatenate(edges)], upright, faces)[0]
    if np.median(squared) < TOUCHING**2:
        return None
    heights = [float(np.median(upright[loop, 2])) - underside for loop in (*ends, *edges)]
    return MissingArc(0.0, 360.0, min(heights), max(heights))


def _encloses(corners: Floats, middle: Floats) -> bool:
    """Whether a closed line runs around the axis."""
    angles = np.arctan2(corners[:, 1] - middle[1], corners[:, 0] - middle[0])
    turns = (np.roll(angles, -1) - angles + np.pi) % (2.0 * np.pi) - np.pi
    return bool(abs(turns.sum()) > np.pi)


def _missing_arc(upright: Floats, loop: Integers) -> MissingArc | None:
    """The part of the wall that a hole takes out; None for a small hole, one in the floor, or one all around."""
    low, high = upright.min(axis=0), upright.max(axis=0)
    corners, middle = upright[loop], 0.5 * (low + high)[:2]
    if _encloses(corners, middle):
        return None
    corners = corners[np.linalg.norm(corners[:, :2] - middle, axis=1) > 0.25 * float(np.min((high - low)[:2]))]
    if len(corners) < 3:
        return None
    angles, begin, span = _around(corners[:, :2] - middle)
    bottom, top = float(corners[:, 2].min() - low[2]), float(corners[:, 2].max() - low[2])
    height = float(high[2] - low[2])
    if top - bottom < ARC_HEIGHT * height:
        return None
    # a hole through the rim has an inner and an outer edge; another one fills its box, and a chain of gaps does not
    around = (angles - begin) % 360.0
    enclosed = 0.5 * abs(float(np.sum(around * np.roll(corners[:, 2], -1) - np.roll(around, -1) * corners[:, 2])))
    if span < ARC if enclosed >= COMPACT * span * (top - bottom) else top < RIM * height:
        return None
    return MissingArc(begin, begin + span, bottom, top)


def _gap_in_rim(upright: Floats, edge: Integers) -> MissingArc | None:
    """The part of a sheet's wall that is missing below the edge of its opening; None if the rim is level or slanted."""
    low, high = upright.min(axis=0), upright.max(axis=0)
    angles, _, _ = _around(upright[edge, :2] - 0.5 * (low + high)[:2])
    heights = upright[edge, 2] - low[2]
    top, bottom = float(np.quantile(heights, 0.9)), float(heights.min())
    turned = np.abs((np.roll(angles, -1) - angles + 180.0) % 360.0 - 180.0)
    middle = (0.5 * (heights + np.roll(heights, -1)) - bottom) / max(top - bottom, 1e-9)
    if top - bottom < ARC_HEIGHT * (high[2] - low[2]) or turned[(middle > 0.1) & (middle < 0.9)].sum() > ARC:
        return None
    _, begin, span = _around(upright[edge[heights < 0.5 * (top + bottom)], :2] - 0.5 * (low + high)[:2])
    return MissingArc(begin, begin + span, bottom, top)


def _around(corners: Floats) -> tuple[Floats, float, float]:
    """Angles of corners around the axis, (N,); the angle from which they take up the least, and how much [deg]."""
    angles = np.degrees(np.arctan2(corners[:, 1], corners[:, 0])) % 360.0
    ordered = np.sort(angles)
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    widest = int(np.argmax(gaps))
    return angles, float(ordered[(widest + 1) % len(ordered)]), 360.0 - float(gaps[widest])


def _is_sheet(vertices: Floats, faces: Integers) -> bool:
    """Whether the walls face the axis on one side only: a solid has as much surface towards it as away from it."""
    corners = vertices[oriented(faces)[0]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, :2]
    middle = (vertices[faces.ravel(), :2].min(axis=0) + vertices[faces.ravel(), :2].max(axis=0)) / 2.0
    radial = corners.mean(axis=1)[:, :2] - middle
    facing = np.einsum("ij,ij->i", radial, normal) / np.maximum(np.linalg.norm(radial, axis=1), 1e-12)
    away = float(np.maximum(facing, 0.0).sum() / max(np.abs(facing).sum(), 1e-30))
    return not 0.25 < away < 0.75


def _length(vertices: Floats, loop: Integers) -> float:
    corners = vertices[loop]
    return float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).sum())


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
    for loop in boundary_loops(np.asarray(mesh.faces, dtype=np.int64)):
        after = np.roll(loop, -1)
        faces += [np.column_stack([after, loop, loop + count]), np.column_stack([after, loop + count, after + count])]
    return trimesh.Trimesh(np.vstack([inner, outer]), np.vstack(faces), process=False)


def _without_fillers(vertices: Floats, faces: Integers, drop: bool, log: _Log) -> Integers:
    """Find separate bodies that fill a part of the cavity, and leave them out if that is wanted."""
    remaining = np.ones(len(faces), dtype=bool)
    for body in fillers(vertices @ log.turn.T, faces, together=drop):
        if drop:
            log.notes.append(f"a separate body of {body.size} in the cavity was left out: {body.capacities}")
            remaining &= ~body.faces
        else:
            log.warnings.append(
                f"a separate body of {body.size} fills a part of the cavity and counts as solid: {body.capacities}. "
                "If it is the liquid or a spoon, leave it out with --drop-bodies"
            )
    return faces[remaining]


def _solid(vertices: Floats, faces: Integers) -> Any:
    import manifold3d

    welded_mesh = manifold3d.Mesh(
        vert_properties=np.asarray(vertices * 1e3, dtype=np.float32), tri_verts=np.asarray(faces, dtype=np.uint32)
    )
    welded_mesh.merge()
    return manifold3d.Manifold(welded_mesh)


def _arrays(solid: Any) -> tuple[Floats, Integers]:
    result = solid.to_mesh()
    return np.asarray(result.vert_properties[:, :3], dtype=float) / 1e3, np.asarray(result.tri_verts, dtype=np.int64)


def _joined(vertices: Floats, faces: Integers, log: _Log) -> tuple[Floats, Integers] | None:
    """One manifold solid of parts that may cross each other; None if the surface is not closed."""
    import manifold3d

    solid = _solid(vertices, faces)
    if solid.status() != manifold3d.Error.NoError:
        return None
    parts = solid.decompose()
    if len(parts) == 1:
        return _arrays(solid)
    joined = _arrays(manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add))
    log.compare(f"{len(parts)} parts were joined", log.capacity(vertices, faces), log.capacity(*joined))
    return joined


def _remade(vertices: Floats, faces: Integers, log: _Log) -> tuple[Floats, Integers]:
    """A new surface for triangles that do not close.

    Raises:
        VesselError: it cannot be made.
    """
    import manifold3d

    points, triangles, spacing = rebuilt(vertices, faces)
    solid = _solid(points, triangles) if len(triangles) else None
    if solid is None or solid.status() != manifold3d.Error.NoError or solid.is_empty():
        raise VesselError(
            f"{log.path.name}: its triangles enclose no solid; is it a sheet without thickness? Save the vessel as one "
            "closed body, with its wall"
        )
    remade = _arrays(solid.simplify(FLATNESS))
    before = log.capacity(vertices, faces) if is_closed(faces) else None
    repair = f"its triangles do not close: a new surface was made on a grid of {1e3 * spacing:.2g} mm"
    after = log.capacity(*remade)
    if before is None and after:
        log.warnings.append(f"{repair}; it holds {1e6 * after:.0f} mL: compare that with the vessel (--brimful)")
    else:
        log.compare(repair, before, after)
    return remade


def _thick_enough(vertices: Floats, faces: Integers, log: _Log) -> Floats:
    """The vertices, displaced outwards if the walls are too thin for the simulator's grid.

    Raises:
        VesselError: that would change the cavity.
    """
    upright = vertices @ log.turn.T
    extent = np.ptp(upright, axis=0)
    if fits_grid(extent, wall_thickness(upright, faces)):
        return vertices
    wall = typical_wall(upright, faces)
    if fits_grid(extent, wall):
        log.notes.append(f"its surface is noisy; the thinnest part of its walls has about {1e3 * wall:.2g} mm")
        return vertices
    cavity = exact_cavity(upright, faces)
    if not cavity.volume:
        return vertices  # what builds the vessel gives the reason
    _require_igl()
    moved, thick = thickened(upright, faces, wall, cavity)
    after = exact_cavity(moved, faces).volume
    if abs(after - cavity.volume) > CHANGED * cavity.volume:
        raise VesselError(
            f"{log.path.name}: walls of {1e3 * wall:.2g} mm are too thin for the simulator's grid, and thickening them "
            f"outwards to {1e3 * thick:.2g} mm would change the cavity from {1e6 * cavity.volume:.0f} to "
            f"{1e6 * after:.0f} mL; give it thicker walls, or describe its inner shape by --height and --diameters"
        )
    log.notes.append(
        f"walls of {1e3 * wall:.2g} mm are too thin for the simulator's grid; they were thickened outwards to "
        f"{1e3 * thick:.2g} mm, and the cavity keeps its {1e6 * after:.0f} mL"
    )
    result: Floats = moved @ log.turn
    return result
