"""Vessels from mesh files: solid, cavity, brim, opening and lip, kept in the cache by content."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine import cache
from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.flood import Flood, brim_height, flood, floor_height
from sim_engine.vessel.mesh_distance import GridLayout, cast_rays, crossings, layout_around, signed_distance
from sim_engine.vessel.mesh_file import check_size, read_mesh
from sim_engine.vessel.rim import measure_opening, trace_meridians
from sim_engine.vessel.sdf import SignedDistanceGrid, choose_spacing
from sim_engine.vessel.spec import MeshShape, VesselSpec
from sim_engine.vessel.surface import normals_and_areas
from sim_engine.vessel.vessel import QUADRATURE_POINTS, Vessel, lattice

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FORMAT_VERSION = 2
"""Raised whenever the same mesh would give other arrays."""

SMALLEST_SHARE = 0.03
"""Smallest cavity as a share of the bounding box: less is a dent."""

SCALARS = ("spacing", "inner_floor", "rim_height", "opening_radius", "outer_radius", "capacity", "wall_thickness")


def build_mesh_vessel(spec: VesselSpec, *, use_cache: bool = True) -> Vessel:
    """See `sim_engine.vessel.build.build_vessel`."""
    assert isinstance(spec.shape, MeshShape)
    check_size(spec.shape)
    key = f"vessel-{FORMAT_VERSION}-{spec.content_hash()}"
    if use_cache:
        stored = cache.load_arrays(key)
        if stored is not None:
            try:
                return _unpack(spec, stored)
            except (KeyError, ValueError, IndexError, TypeError):
                cache.discard(key)  # written by something else, or damaged: compute it again
    vessel = _measure(spec, spec.shape)
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
        **scalars,
    )


def _measure(spec: VesselSpec, shape: MeshShape) -> Vessel:
    vertices, faces = read_mesh(shape)
    vertices -= [*(vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2.0, vertices[:, 2].min()]
    wall = wall_thickness(vertices, faces)
    layout = layout_around(vertices, choose_spacing(np.ptp(vertices, axis=0), wall))
    hits, inside = crossings(vertices, faces, layout)
    _check_one_body(vertices, faces, inside, layout, shape)
    found = flood(~inside)
    _check_cavity(found, shape, layout.spacing, vertices, layout.origin[2])
    rim = brim_height(found, ~inside, layout, hits)
    floor = floor_height(found, layout, hits)
    values = signed_distance(vertices, faces, layout, inside)
    grid = SignedDistanceGrid(layout.origin, layout.spacing, values, found.pool.astype(np.uint8))
    centre, radius = measure_opening(grid, vertices[faces], rim, wall)
    if radius < 0.002:
        raise VesselError(f"{shape.path.name}: its opening of {2e3 * radius:.2g} mm is too narrow to pour from")
    shift = np.array([*centre, 0.0])
    vertices = vertices - shift
    grid = SignedDistanceGrid(layout.origin - shift, layout.spacing, values, grid.cavity)
    meridians = trace_meridians(grid, vertices[faces], floor, rim, wall)
    crest = float(meridians[:, -1, 2].min())
    if 0.0 < crest - rim < 0.5 * layout.spacing:
        rim = crest  # columns straddle a rounded crest; the meridians run over it
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
    )


def wall_thickness(vertices: Floats, faces: Integers) -> float:
    """Smallest thickness of the solid's walls [m].

    Rays go inwards from points spread over the surface; those that leave through a face roughly parallel to where they
    entered have crossed a wall. The second percentile of their lengths leaves out the odd sliver.

    Args:
        vertices: shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).
    """
    normal, area = normals_and_areas(vertices, faces)
    count = int(np.clip(4_000_000 // len(faces), 100, 1_000))
    chosen = np.searchsorted(np.cumsum(area), (np.arange(count) + 0.5) / count * area.sum())
    chosen = np.minimum(chosen, len(faces) - 1)
    corners = vertices[faces]
    weights = np.random.default_rng(0).dirichlet((2.0, 2.0, 2.0), size=count)
    start = np.einsum("nk,nkd->nd", weights, corners[chosen])
    length, other = cast_rays(start, -normal[chosen], corners)
    parallel = np.isfinite(length) & (np.einsum("ij,ij->i", normal[chosen], normal[other]) < -0.7) & (length > 1e-6)
    if not parallel.any():
        return float(np.ptp(vertices, axis=0).min())
    return float(np.percentile(length[parallel], 2.0))


def _check_one_body(
    vertices: Floats, faces: Integers, inside: NDArray[np.bool_], layout: GridLayout, shape: MeshShape
) -> None:
    """Refuse several things in one file. Bodies that overlap or touch, such as a handle of its own, are one."""
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
    for part in ndimage.find_objects(labels):
        size = " × ".join(f"{1e3 * layout.spacing * max(s.stop - s.start - 2, 1):.0f}" for s in part)
        shown.append(f"{size} mm")
    raise VesselError(
        f"{shape.path.name}: {count} bodies that don't touch ({', '.join(shown[:4])}{', …' if count > 4 else ''}); a "
        "vessel is one: save it alone"
    )


def _check_cavity(found: Flood, shape: MeshShape, spacing: float, vertices: Floats, bottom: float) -> None:
    """Refuse what holds no liquid, with the most likely reason."""
    box = float(np.prod(np.ptp(vertices, axis=0)))
    least = SMALLEST_SHARE * box
    cell = spacing**3
    pool = float(np.count_nonzero(found.pool)) * cell
    if pool >= least:
        return
    name = shape.path.name
    if found.enclosed * cell >= least:
        raise VesselError(
            f"{name}: no opening: a cavity of {1e6 * found.enclosed * cell:.3g} mL is closed on all sides; "
            "cut the lid away"
        )
    if found.drained * cell >= least:
        at = max(bottom + spacing * (found.drain - 1), 0.0)  # the hole begins between two slices
        raise VesselError(
            f"{name}: holds nothing: what is poured in runs out {1e3 * at:.0f} mm above the underside; "
            f"close the hole in its floor or wall, or state which axis is up (now '{shape.up}')"
        )
    raise VesselError(
        f"{name}: no cavity: the mesh is one closed skin, solid within, as from a scanner that can't see inside; "
        f"model the inner wall too, or describe the vessel by a profile (up is '{shape.up}')"
    )
