"""Vessels from mesh files.

`load_triangles` reads a file of any format, `read_mesh` checks units, axes and closedness. `build_mesh_vessel` computes
solid, cavity, brim, opening and lip, and keeps them in the cache by content.
"""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_engine import resources as cache
from sim_engine.vessel.cavity import CavityFill, brim_height, flood, floor_height
from sim_engine.vessel.distance_grid import SignedDistanceGrid, choose_spacing
from sim_engine.vessel.exact_cavity import ExactCavity, exact_cavity, fillers
from sim_engine.vessel.mesh_distance import GridLayout, cast_rays, crossings, layout_around, signed_distance
from sim_engine.vessel.mesh_surface import measure_opening, normals_and_areas, trace_meridians
from sim_engine.vessel.shapes import LengthUnit, VesselError, VesselSpec
from sim_engine.vessel.vessel import QUADRATURE_POINTS, Vessel, lattice

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FORMATS = ("stl", "obj", "ply", "glb")
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
SMALLEST, LARGEST = 0.020, 0.500
"""Largest extent of a plausible vessel [m]."""
MOST_FACES = 1_000_000
LARGEST_FILE = 300_000_000
"""Largest size of a file [bytes]; the same number of triangles as text needs as much."""


class MeshFile(Protocol):
    """What is read of a mesh's settings, `sim_engine.vessel.mesh_shape.MeshShape`."""

    @property
    def path(self) -> Path:
        """The file."""
        ...

    @property
    def unit(self) -> LengthUnit | None:
        """Unit of its coordinates; None: concluded from the size."""
        ...

    @property
    def up(self) -> str:
        """Axis that points out of the opening."""
        ...


def check_size(path: Path) -> None:
    """Refuse a file that is too large, before it is read.

    Raises:
        VesselError: it is too large.
        OSError: it does not exist.
    """
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise VesselError(
            f"{path.name}: {size / 1e6:.0f} MB; simplify it to at most {MOST_FACES:,} triangles, some 50 MB"
        )


_OTHER_FORMATS = (
    (re.compile(rb"ISO-10303"), "a STEP file, a CAD model without triangles: export it as STL"),
    (re.compile(rb"(?i)<!doctype html|<html"), "a web page: download the mesh itself, on GitHub with 'Raw'"),
    (re.compile(rb"glTF"), "a GLB file: name it .glb"),
    (re.compile(rb"ply\r?\n"), "a PLY file: name it .ply"),
    (re.compile(rb"PK\x03\x04(?=.{0,200}3D/3dmodel)", re.DOTALL), "a 3MF file: name it .3mf"),
    (re.compile(rb"PK\x03\x04"), "an archive (ZIP): unpack it"),
)
"""Begin of files that are sent under the name of another format, and what to do."""

_FORMAT_BEGINS = {"glb": b"glTF", "ply": b"ply", "3mf": b"PK"}


def _check_format(name: str, kind: str, content: bytes) -> None:
    begin = content[:1000].lstrip(b"\xef\xbb\xbf \t\r\n")
    if begin.startswith(_FORMAT_BEGINS.get(kind, b"\0")):
        return
    for pattern, remedy in _OTHER_FORMATS:
        if pattern.match(begin):
            raise VesselError(f"{name}: is {remedy}")


def _check_finite(name: str, content: bytes) -> None:
    """Refuse an OBJ file with a vertex that is no number, of which trimesh reads no triangles."""
    if (vertex := re.search(rb"(?im)^[ \t]*v[ \t][^\r\n]*(?:nan|inf)[^\r\n]*", content)) is not None:
        line = content.count(b"\n", 0, vertex.start()) + 1
        raise VesselError(
            f"{name}:{line}: a vertex is not a finite number "
            f"({vertex[0].decode('ascii', 'replace').strip()[:60]}); export the mesh again, or remove this vertex and "
            "its faces"
        )


def load_triangles(path: Path) -> Any:
    """All triangles of a file as one `trimesh.Trimesh`, in the unit and the axes of the file.

    Raises:
        VesselError: the format is unknown, or the file is no mesh, damaged, or too large.
        OSError: it cannot be read.
    """
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise VesselError(f"{path.name}: '{kind}' is not a mesh format known here; use {', '.join(FORMATS)}")
    check_size(path)
    content = path.read_bytes()
    if content.startswith(b"version https://git-lfs"):
        raise VesselError(
            f"{path.name}: is a pointer of Git LFS, a text of {len(content)} bytes that stands for the mesh; fetch the "
            "mesh itself with 'git lfs pull'"
        )
    _check_format(path.name, kind, content)
    if kind == "obj":
        _check_finite(path.name, content)
        content = _with_absolute_indices(content)
    elif kind == "stl" and b"\0" in content[80:84]:  # binary; text has no byte 0
        end = 84 + 50 * int.from_bytes(content[80:84], "little")
        if len(content) < end:
            raise VesselError(
                f"{path.name}: is cut off: it has {len(content):,} bytes, and its {(end - 84) // 50:,} triangles need "
                f"{end:,}; copy or export it again"
            )
        content = content[:end]  # some programs append bytes, for which trimesh takes the file for text
    try:
        # without materials: textures are often missing, and the reader would print the traceback of its search
        mesh = trimesh.load(io.BytesIO(content), file_type=kind, force="mesh", process=True, skip_materials=True)
    except Exception as problem:  # trimesh's readers raise various errors for damaged files
        raise VesselError(f"{path.name}: not a readable {kind.upper()} file ({problem})") from problem
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise VesselError(
            f"{path.name}: no triangles in it; a vessel needs a closed mesh, not points or lines; make one of "
            "the points, for example with MeshLab"
        )
    if len(mesh.faces) > MOST_FACES:
        raise VesselError(f"{path.name}: {len(mesh.faces):,} triangles; simplify it to at most {MOST_FACES:,}")
    return mesh


def _with_absolute_indices(content: bytes) -> bytes:
    """An OBJ file whose faces count from its first vertex, not back from the face's own line.

    trimesh counts back from the last vertex of the file (mikedh/trimesh#2364).
    """
    if not re.search(rb"(?m)^\s*f\s.*-\d", content):
        return content
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    lines = content.splitlines()
    for number, line in enumerate(lines):
        key, *words = line.split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            corners = [
                b"/".join(
                    b"%d" % (count + 1 + int(index)) if index.startswith(b"-") else index
                    for index, count in zip(word.split(b"/"), counts.values(), strict=False)
                )
                for word in words
            ]
            lines[number] = b"f " + b" ".join(corners)
    return b"\n".join(lines)


def read_mesh(shape: MeshFile) -> tuple[Floats, Integers]:
    """Closed, outward-facing triangles of a mesh file in metres, z up.

    Returns:
        Vertices (V, 3) [m] and faces (F, 3).

    Raises:
        VesselError: unreadable, not closed, or of an implausible size.
        OSError: the file cannot be read.
    """
    loaded = load_triangles(shape.path)
    if not np.all(np.isfinite(loaded.vertices)):
        raise VesselError(f"{shape.path.name}: some vertices are not finite numbers")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    loaded.update_faces(loaded.nondegenerate_faces())
    _check_closed(loaded, shape.path)
    scale = scale_of(float(np.max(loaded.extents)), shape)
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
            "close the holes (a vessel is a solid with walls, not a sheet), or let 'decant vessel' repair it: "
            f"decant vessel mesh {path.name} NEW.yaml"
        )
    if not _edges_cancel(mesh.edges):
        trimesh.repair.fix_winding(mesh)
        if not _edges_cancel(mesh.edges):
            raise VesselError(
                f"{path.name}: its faces don't agree which side is out, and can't be made to; repair it: "
                f"decant vessel mesh {path.name} NEW.yaml"
            )
    if mesh.volume < 0.0:
        mesh.invert()
    if not mesh.volume > 0.0:
        raise VesselError(f"{path.name}: encloses no volume")


def _edges_cancel(edges: Integers) -> bool:
    forth, back = np.lexsort((edges[:, 1], edges[:, 0])), np.lexsort((edges[:, 0], edges[:, 1]))
    return bool(np.array_equal(edges[forth], edges[back][:, ::-1]))


def rim_tilt(vessel: Vessel) -> float:
    """Angle of the rim from level [rad]: of the plane that the lip's points are closest to, spouts aside."""
    crest = vessel.meridians[:, -1]
    plane: NDArray[Any] = np.zeros(3)
    away: Floats = np.ones(len(crest))
    design = np.column_stack([crest[:, :2], np.ones(len(crest))])
    for _ in range(30):  # least absolute deviations, so that a spout or a notch does not turn the plane
        weight = 1.0 / np.sqrt(np.maximum(away, 1e-5))
        plane = np.linalg.lstsq(design * weight[:, None], crest[:, 2] * weight, rcond=None)[0]
        away = np.abs(design @ plane - crest[:, 2])
    return float(np.arctan(np.hypot(plane[0], plane[1])))


def scale_of(extent: float, shape: MeshFile) -> float:
    """Metres in the unit of a file's numbers.

    Args:
        extent: largest extent of the vessel, in this unit.
        shape: states the unit, or none for metres.

    Raises:
        VesselError: in this unit it is not a vessel's size; the text states a likely one.
    """
    if shape.unit is not None:
        size = extent * UNITS[shape.unit]
        if not SMALLEST / 4.0 <= size <= 2.0 * LARGEST:
            raise VesselError(
                f"{shape.path.name}: its largest extent of {extent:.4g} {shape.unit} is not a vessel's size "
                f"({1e3 * SMALLEST / 4.0:g} … {2e3 * LARGEST:g} mm); state its unit: {_likely(extent)}"
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
    return (
        " or ".join(f"'{u}' ({1e3 * extent * UNITS[u]:.4g} mm)" for u in fitting)
        or "none of m, cm, mm and in fits; save it in another scale"
    )


def to_z(up: str) -> Floats:
    """Rotation that turns an axis of the mesh, such as '-y', to z."""
    target = np.zeros(3)
    target["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    # the new x axis is the mesh's next axis in cyclic order, so that a mesh with z up is unchanged
    x = np.roll(np.abs(target), 1)
    return np.stack([x, np.cross(target, x), target])


FORMAT_VERSION = 3
"""Incremented whenever the same mesh would give other arrays."""

SMALLEST_SHARE = 0.03
"""Smallest cavity as a share of the bounding box: less is a dent."""

NEIGHBOURS = 15
"""Rays whose median is a thickness in `typical_wall`."""

SAME_CAVITY = 0.03
"""Largest relative difference of a cavity by its nodes from that of the mesh; a leak costs more."""

SCALARS = ("spacing", "inner_floor", "rim_height", "opening_radius", "outer_radius", "capacity", "wall_thickness")


def build_mesh_vessel(spec: VesselSpec, shape: MeshFile, *, use_cache: bool = True) -> Vessel:
    """See `sim_engine.vessel.vessel.build_vessel`.

    Args:
        spec: the vessel.
        shape: its shape.
        use_cache: whether the result is taken from the cache, or stored there.
    """
    check_size(shape.path)
    key = f"vessel-{FORMAT_VERSION}-{spec.content_hash()}"
    if use_cache:
        stored = cache.load_arrays(key)
        if stored is not None:
            try:
                return _unpack(spec, stored)
            except (KeyError, ValueError, IndexError, TypeError):
                cache.discard(key)  # written by another program, or damaged: compute it again
    vessel = _measure(spec, shape)
    if use_cache:
        cache.store_arrays(key, _pack(vessel))
    return vessel


def _pack(vessel: Vessel) -> dict[str, NDArray[np.generic]]:
    return {
        "scalars": np.array([vessel.grid.spacing] + [getattr(vessel, name) for name in SCALARS[1:]]),
        "origin": vessel.grid.origin,
        "values": vessel.grid.values,
        "cavity": np.packbits(vessel.grid.cavity),
        "vertices": vessel.solid_vertices,
        "faces": vessel.solid_faces,
        "meridians": vessel.meridians,
        "warnings": np.frombuffer("\n".join(vessel.warnings).encode(), dtype=np.uint8),
    }


def _unpack(spec: VesselSpec, stored: dict[str, NDArray[np.generic]]) -> Vessel:
    scalars = dict(zip(SCALARS, stored["scalars"].astype(float).tolist(), strict=True))
    values = stored["values"].astype(np.float32)
    if values.ndim != 3 or not np.all(np.isfinite(values)) or stored["origin"].shape != (3,):
        raise ValueError("no distance grid")
    cavity = np.unpackbits(stored["cavity"].astype(np.uint8), count=values.size).reshape(values.shape)
    grid = SignedDistanceGrid(stored["origin"].astype(float), scalars.pop("spacing"), values, cavity)
    return Vessel(
        spec=spec,
        solid_vertices=stored["vertices"].astype(float),
        solid_faces=stored["faces"].astype(np.int64),
        grid=grid,
        meridians=stored["meridians"].astype(float),
        warnings=tuple(stored["warnings"].astype(np.uint8).tobytes().decode().splitlines()),
        **scalars,
    )


def _measure(spec: VesselSpec, shape: MeshFile) -> Vessel:
    vertices, faces = read_mesh(shape)
    vertices -= [*(vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2.0, vertices[:, 2].min()]
    wall, spacing, refusal = _spacing(vertices, faces)
    layout = layout_around(vertices, spacing)
    hits, inside = crossings(vertices, faces, layout)
    _check_one_body(vertices, faces, inside, layout, shape)
    warnings = _doubts(vertices, faces, inside, layout, shape)
    fill = flood(~inside)
    if refusal is not None:
        _check_walls(fill, layout, exact_cavity(vertices, faces), refusal)
    _check_cavity(fill, ~inside, shape, layout.spacing, vertices, layout.origin[2])
    rim = brim_height(fill, ~inside, layout, hits)
    floor = floor_height(fill, layout, hits)
    values = signed_distance(vertices, faces, layout, inside)
    grid = SignedDistanceGrid(layout.origin, layout.spacing, values, fill.pool.astype(np.uint8))
    centre, radius = measure_opening(grid, vertices[faces], rim, wall)
    if radius < 0.002:
        raise VesselError(f"{shape.path.name}: its opening of {2e3 * radius:.2g} mm is too narrow to pour from")
    shift = np.array([*centre, 0.0])
    vertices = vertices - shift
    grid = SignedDistanceGrid(layout.origin - shift, layout.spacing, values, grid.cavity)
    meridians = trace_meridians(grid, vertices[faces], floor, rim, wall)
    crest = float(meridians[:, -1, 2].min())
    if 0.0 < crest - rim < 0.5 * layout.spacing:
        rim = crest  # columns pass on both sides of a rounded crest; the meridians run over it
    points, cell = lattice(spec, grid, floor, rim, QUADRATURE_POINTS)
    return Vessel(
        spec=spec,
        solid_vertices=vertices,
        solid_faces=faces,
        grid=grid,
        inner_floor=floor,
        rim_height=rim,
        opening_radius=radius,
        outer_radius=float(np.hypot(vertices[:, 0], vertices[:, 1]).max()),
        capacity=len(points) * cell,
        wall_thickness=wall,
        meridians=meridians,
        warnings=warnings,
    )


def _spacing(vertices: Floats, faces: Integers) -> tuple[float, float, VesselError | None]:
    """Thickness of the walls [m] and spacing of the grid [m].

    If the grid cannot resolve the smallest thickness, as on a noisy scan, the typical one counts, and the refusal that
    holds if the grid has another cavity than the mesh is returned too.
    """
    extent = np.ptp(vertices, axis=0)
    wall = wall_thickness(vertices, faces)
    try:
        return wall, choose_spacing(extent, wall), None
    except VesselError as error:
        refusal = VesselError(
            f"{error}, or let 'decant vessel' thicken them outwards: decant vessel mesh FILE NEW.yaml"
        )
    wall = typical_wall(vertices, faces)
    try:
        return wall, choose_spacing(extent, wall), refusal
    except VesselError:
        raise refusal from None


def _check_walls(fill: CavityFill, layout: GridLayout, cavity: ExactCavity, refusal: VesselError) -> None:
    """Refuse walls with gaps on the grid: the cavity drains there, or is lower than the mesh's."""
    held = float(np.count_nonzero(fill.pool)) * layout.spacing**3
    if abs(held - cavity.volume) > SAME_CAVITY * cavity.volume:
        raise refusal


def wall_thickness(vertices: Floats, faces: Integers) -> float:
    """Smallest thickness of the solid's walls [m].

    Rays go inwards from points spread over the surface. Rays that leave through a face roughly parallel to their entry
    face have crossed a wall. The second percentile of their lengths ignores single slivers, but not noise.

    Args:
        vertices: shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).
    """
    _, length = _wall_samples(vertices, faces)
    return float(np.percentile(length, 2.0)) if len(length) else float(np.ptp(vertices, axis=0).min())


def typical_wall(vertices: Floats, faces: Integers) -> float:
    """Thickness of the thinnest part of the walls, without the noise of a scanner [m].

    Each thickness is the median of its neighbours', so that single spikes do not count. The fifth percentile is a part
    of the vessel that is thinner than the rest, such as the upper half of a wall.

    Args:
        vertices: shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).
    """
    from scipy.spatial import cKDTree

    middle, length = _wall_samples(vertices, faces)
    if not len(length):
        return float(np.ptp(vertices, axis=0).min())
    _, near = cKDTree(middle).query(middle, k=min(NEIGHBOURS, len(length)))
    return float(np.percentile(np.median(length[near.reshape(len(length), -1)], axis=1), 5.0))


def _wall_samples(vertices: Floats, faces: Integers) -> tuple[Floats, Floats]:
    """Middles (n, 3) [m] and lengths (n,) [m] of rays across walls."""
    normal, area = normals_and_areas(vertices, faces)
    count = int(np.clip(4_000_000 // len(faces), 100, 1_000))
    chosen = np.searchsorted(np.cumsum(area), (np.arange(count) + 0.5) / count * area.sum())
    chosen = np.minimum(chosen, len(faces) - 1)
    corners = vertices[faces]
    weights = np.random.default_rng(0).dirichlet((2.0, 2.0, 2.0), size=count)
    start = np.einsum("nk,nkd->nd", weights, corners[chosen])
    length, other = cast_rays(start, -normal[chosen], corners)
    parallel = np.isfinite(length) & (np.einsum("ij,ij->i", normal[chosen], normal[other]) < -0.7) & (length > 1e-6)
    across = length[parallel]
    return start[parallel] - 0.5 * across[:, None] * normal[chosen][parallel], across


def _check_one_body(
    vertices: Floats, faces: Integers, inside: NDArray[np.bool_], layout: GridLayout, shape: MeshFile
) -> None:
    """Refuse several objects in one file. Bodies that overlap or touch, such as a separate handle, count as one."""
    from scipy import ndimage
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    joined = coo_array((np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2)
    if connected_components(joined, directed=False)[0] == 1:
        return
    everywhere = np.ones((3, 3, 3), dtype=bool)
    labels, count = ndimage.label(ndimage.binary_dilation(inside, everywhere), everywhere)
    if count < 2:
        return
    shown = []
    for body in ndimage.find_objects(labels):
        size = " × ".join(f"{1e3 * layout.spacing * max(s.stop - s.start - 2, 1):.0f}" for s in body)
        shown.append(f"{size} mm")
    raise VesselError(
        f"{shape.path.name}: {count} bodies that don't touch ({', '.join(shown[:4])}{', …' if count > 4 else ''}); a "
        "vessel is one: save it alone"
    )


def _doubts(
    vertices: Floats, faces: Integers, inside: NDArray[np.bool_], layout: GridLayout, shape: MeshFile
) -> tuple[str, ...]:
    """Warnings about bodies in the cavity, and about faces that two bodies share.

    Raises:
        VesselError: it has a sheet without thickness, which would be a wall that holds nothing apart.
    """
    name = shape.path.name
    repair = f"decant vessel mesh {name} NEW.yaml"
    doubts = [
        f"a separate body of {body.size} fills a part of the cavity and counts as solid: {body.capacities}. If it is "
        f"the liquid, leave it out: {repair} --drop-bodies"
        for body in fillers(vertices, faces)
    ]
    _, first, uses = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    shared = faces[first[uses > 1]]
    if len(shared):
        node = np.floor((vertices[shared].mean(axis=1) - layout.origin) / layout.spacing).astype(np.int64)
        around = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        i, j, k = np.moveaxis(node[:, None] + around, 2, 0)
        if np.mean(inside[i, j, k].any(axis=1)) < 0.5:
            raise VesselError(
                f"{name}: {len(shared)} faces are there twice and bound no solid: a sheet without thickness, such as "
                f"the surface of a liquid; leave it out, or let 'decant vessel' repair it: {repair}"
            )
        doubts.append(
            f"{len(shared)} faces are shared by two bodies, which both count as solid; if one of them is the liquid, "
            "save the vessel alone"
        )
    return tuple(doubts)


def _other_up(free: NDArray[np.bool_], shape: MeshFile, least: int) -> tuple[str, int]:
    """The axis of the file with which up the mesh holds most, and number of cells that it holds; '' for none.

    Args:
        free: cells of the grid that are not solid, the axis that counts as up last.
        least: number of cells that count as a cavity.
    """
    held: dict[str, int] = {}
    for name in ("x", "y", "z", "-x", "-y", "-z"):
        direction = to_z(shape.up) @ to_z(name)[2]  # of the file's axis in the grid
        axis = int(np.argmax(np.abs(direction)))
        turned = np.moveaxis(free, axis, 2)
        held[name] = int(np.count_nonzero(flood(turned if direction[axis] > 0.0 else turned[:, :, ::-1]).pool))
    best = max(held, key=lambda name: held[name])
    return (best, held[best]) if held[best] >= least else ("", 0)


def _check_cavity(
    fill: CavityFill, free: NDArray[np.bool_], shape: MeshFile, spacing: float, vertices: Floats, bottom: float
) -> None:
    """Refuse a shape that holds no liquid, with the most likely reason."""
    box = float(np.prod(np.ptp(vertices, axis=0)))
    least = SMALLEST_SHARE * box
    cell = spacing**3
    pool = float(np.count_nonzero(fill.pool)) * cell
    if pool >= least:
        return
    name = shape.path.name
    if fill.enclosed * cell >= least:
        raise VesselError(
            f"{name}: no opening: a cavity of {1e6 * fill.enclosed * cell:.3g} mL is closed on all sides; "
            "cut the lid away"
        )
    up, cells = _other_up(free, shape, math.ceil(least / cell))
    if up:
        raise VesselError(
            f"{name}: holds nothing if '{shape.up}' is up; if '{up}' is, it holds {1e6 * cells * cell:.3g} mL. State "
            f"'up: {up}', or with 'decant vessel mesh' --up {up}"
        )
    if fill.drained * cell >= least:
        at = max(bottom + spacing * (fill.drain - 1), 0.0)  # the hole begins between two slices
        raise VesselError(
            f"{name}: holds nothing: what is poured in runs out {1e3 * at:.0f} mm above the underside; "
            f"close the hole in its floor or wall, or state which axis is up (now '{shape.up}')"
        )
    raise VesselError(
        f"{name}: no cavity: the mesh is one closed skin, solid within, as from a scanner that can't see inside; "
        f"model the inner wall too, or describe the vessel by a profile (up is '{shape.up}')"
    )
