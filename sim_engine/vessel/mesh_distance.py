"""Signed distance of a closed triangle mesh on a grid: exact near the surface, propagated outwards elsewhere.

1. Sign: winding number along the grid's vertical columns, so overlapping closed bodies (a handle pushed into a wall)
  count as one solid.
2. Within 2 spacings of a triangle: exact distance to the nearest triangle.
3. Farther: distance to one of the surface points next to the grid's nodes, so it is never too small. Up to 8 spacings
  every second node has the nearest of these points. The nodes between take the best of their neighbours' points, too
  large by up to a quarter spacing where the nearest point jumps. Beyond 8 spacings a feature transform selects the
  point (up to a spacing too large).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.distance_grid import MARGIN
from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

BAND = 2.0
"""Half width of the exact band [spacings]."""

MIDDLE = 8.0
"""Largest distance at which the nearest surface point is searched [spacings]; farther, near an axis, this takes
minutes.
"""

SEEDS = 0.9
"""Nodes within this distance of the surface propagate it [spacings]; √3/2 omits no part of the surface."""

CHUNK = 1_000_000
"""Pairs of a triangle and a node handled at once."""


@dataclass(frozen=True)
class Crossings:
    """Crossings of the grid's vertical columns with the surface: column indices i, j and heights z [m], each (C,)."""

    i: Integers
    j: Integers
    z: Floats


@dataclass(frozen=True)
class GridLayout:
    """Nodes of a grid: origin (3,) [m], spacing [m], nodes along each axis."""

    origin: Floats
    spacing: float
    shape: tuple[int, int, int]


def layout_around(vertices: Floats, spacing: float) -> GridLayout:
    """A grid that leaves `MARGIN` around a mesh on every side."""
    cells = np.ceil((np.ptp(vertices, axis=0) + 2.0 * MARGIN) / spacing).astype(int)
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return GridLayout(
        centre - cells * spacing / 2.0, spacing, (int(cells[0]) + 1, int(cells[1]) + 1, int(cells[2]) + 1)
    )


def _pairs(low: Integers, high: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Every integer point of many boxes, in chunks: the box's index (N,) and the point (N, axes).

    Args:
        low: first point of each box, shape (F, axes).
        high: last one (empty boxes are allowed), shape (F, axes).
    """
    size = np.maximum(high - low + 1, 0)
    count = np.prod(size, axis=1)
    ends = np.cumsum(count)
    start = 0
    while start < len(count):
        stop = max(int(np.searchsorted(ends, (ends[start - 1] if start else 0) + CHUNK, side="right")), start + 1)
        box = np.repeat(np.arange(start, stop), count[start:stop])
        before = ends[start:stop] - count[start:stop]
        rest = np.arange(len(box)) + (ends[start] - count[start]) - np.repeat(before, count[start:stop])
        point = np.empty((len(box), size.shape[1]), dtype=np.int64)
        for axis in range(size.shape[1] - 1, -1, -1):
            rest, digit = np.divmod(rest, size[box, axis])
            point[:, axis] = low[box, axis] + digit
        if len(box):
            yield box, point
        start = stop


def crossings(vertices: Floats, faces: Integers, layout: GridLayout) -> tuple[Crossings, NDArray[np.bool_]]:
    """Crossings of columns with the surface, and the nodes inside the solid.

    Args:
        vertices: shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).
        layout: of the grid.

    Returns:
        The crossings and a mask of the grid's shape.

    Raises:
        VesselError: some column enters the solid without leaving it: the surface is not closed.
    """
    for attempt in range(4):
        # Columns are slightly displaced from the nodes, so that none runs exactly along an edge of an aligned mesh.
        jitter = layout.spacing * 1e-5 * np.array([np.sqrt(2.0) + attempt, np.sqrt(3.0) + 0.7 * attempt])
        heights, sign = _cross_columns(vertices, faces, layout, layout.origin[:2] + jitter)
        nx, ny, nz = layout.shape
        winding = np.zeros((nx, ny, nz + 1), dtype=np.int16)
        first_above = np.clip(np.ceil((heights.z - layout.origin[2]) / layout.spacing).astype(np.int64), 0, nz)
        np.add.at(winding, (heights.i, heights.j, first_above), sign)
        np.cumsum(winding, axis=2, out=winding)
        if not winding[:, :, -1].any():
            return heights, winding[:, :, :-1] > 0
    raise VesselError("the mesh's surface is not closed: a vertical line enters its solid and does not leave it")


def _cross_columns(
    vertices: Floats, faces: Integers, layout: GridLayout, origin: Floats
) -> tuple[Crossings, NDArray[np.int16]]:
    corners = vertices[faces]
    flat = corners[:, :, :2]
    low = np.ceil((flat.min(axis=1) - origin) / layout.spacing).astype(np.int64)
    high = np.floor((flat.max(axis=1) - origin) / layout.spacing).astype(np.int64)
    a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    high[twice == 0.0] = low[twice == 0.0] - 1  # parallel to the column
    parts = []
    for face, column in _pairs(low, high):
        p = origin + layout.spacing * column
        weights = []
        for k in range(3):
            # Both triangles of an edge must compute the same value for it: always from its lower vertex index.
            first, second = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            swap = first > second
            q, r = vertices[np.minimum(first, second), :2], vertices[np.maximum(first, second), :2]
            side = (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])
            weights.append(np.where(swap, -side, side))
        w = np.column_stack(weights)
        hit = np.all(w > 0.0, axis=1) | np.all(w < 0.0, axis=1)
        w, crossed, at = w[hit], face[hit], column[hit]
        z = np.einsum("nk,nk->n", w, corners[crossed, :, 2]) / w.sum(axis=1)
        parts.append((at[:, 0], at[:, 1], z, np.where(twice[crossed] < 0.0, 1, -1)))
    i, j, z, sign = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Crossings(i, j, z), sign.astype(np.int16)


def closest_points(points: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    """The nearest point of a triangle to a point, pairwise.

    Args:
        points: shape (N, 3) [m].
        a, b, c: corners of each point's triangle, each (N, 3) [m].

    Returns:
        Shape (N, 3) [m].
    """
    best = np.empty_like(points)
    best_distance = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        length2 = np.maximum(np.einsum("ij,ij->i", edge, edge), 1e-30)
        t = np.clip(np.einsum("ij,ij->i", points - start, edge) / length2, 0.0, 1.0)
        candidate = start + t[:, None] * edge
        distance = np.einsum("ij,ij->i", points - candidate, points - candidate)
        closer = distance < best_distance
        best[closer], best_distance[closer] = candidate[closer], distance[closer]
    # where the foot of the perpendicular falls inside the triangle it is nearer than any edge
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = (np.einsum("ij,ij->i", p, q) for p, q in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    determinant = uu * vv - uv * uv
    safe = np.where(determinant > 0.0, determinant, 1.0)
    s, t = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    inside = (determinant > 0.0) & (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
    best[inside] = (a + s[:, None] * u + t[:, None] * v)[inside]
    return best


def signed_distance(
    vertices: Floats, faces: Integers, layout: GridLayout, inside: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Signed distance at the grid's nodes.

    Args:
        vertices: shape (V, 3) [m].
        faces: shape (F, 3).
        layout: of the grid.
        inside: nodes in the solid, from `crossings`.

    Returns:
        Shape of the grid [m], negative inside.
    """
    from scipy import ndimage, spatial

    square, closest = _band(vertices, faces, layout)
    shape = layout.shape
    # Faces inside the solid where bodies overlap are not a surface: keep faces that have the other side within two
    # nodes.
    cube = np.ones((3, 3, 3), dtype=bool)
    near = ndimage.binary_dilation(inside, cube, iterations=2) & ndimage.binary_dilation(~inside, cube, iterations=2)
    exact = np.isfinite(square).reshape(shape) & near
    seeds = (square.reshape(shape) <= (SEEDS * layout.spacing) ** 2) & near
    index = ndimage.distance_transform_edt(~seeds, return_distances=False, return_indices=True)
    flat = np.ravel_multi_index(tuple(index), shape)
    nearest = flat.reshape(shape).astype(np.int32)
    # The nearest seed need not have the nearest point, since it may only protrude towards the node: a tree finds it.
    carriers = np.flatnonzero(seeds)
    coarse = (slice(None, None, 2),) * 3
    rough = _square_distance(nearest[coarse], closest, layout, coarse)
    far = np.argwhere(~exact[coarse] & (rough < (MIDDLE * layout.spacing) ** 2)) * 2
    _, carrier = spatial.cKDTree(closest[carriers]).query(layout.origin + layout.spacing * far)
    nearest[tuple(far.T)] = carriers[carrier]
    values = np.sqrt(_relax(nearest, closest, layout))
    values[exact] = np.sqrt(square.reshape(shape)[exact])
    values[inside] *= -1.0
    return values


def _square_distance(
    index: NDArray[np.int32], closest: NDArray[np.float32], layout: GridLayout, block: tuple[slice, ...]
) -> NDArray[np.float32]:
    """Squared distance of some nodes to the surface points of the nodes in `index` [m²]."""
    point = closest[index]
    for axis, count in enumerate(layout.shape):
        coordinate = (layout.origin[axis] + layout.spacing * np.arange(count))[block[axis]].astype(np.float32)
        point[..., axis] -= coordinate.reshape([-1 if k == axis else 1 for k in range(3)])
    result: NDArray[np.float32] = np.einsum("xyzk,xyzk->xyz", point, point)
    return result


def _relax(index: NDArray[np.int32], closest: NDArray[np.float32], layout: GridLayout) -> NDArray[np.float32]:
    """Squared distance to the surface point of the node in `index` [m²], after trying the neighbours' points."""
    best = _square_distance(index, closest, layout, (slice(None),) * 3)
    for axis in range(3):
        for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            target = tuple(here if k == axis else slice(None) for k in range(3))
            source = tuple(there if k == axis else slice(None) for k in range(3))
            candidate = index[source]
            tried = _square_distance(candidate, closest, layout, target)
            better = tried < best[target]
            best[target] = np.where(better, tried, best[target])
            index[target] = np.where(better, candidate, index[target])
    return best


def _band(vertices: Floats, faces: Integers, layout: GridLayout) -> tuple[Floats, NDArray[np.float32]]:
    """Squared distance (nodes,) [m²], infinite beyond the band, and the nearest surface point (nodes, 3) [m]."""
    reach = BAND * layout.spacing
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    limit = np.array(layout.shape) - 1
    low = np.clip(np.ceil((corners.min(axis=1) - reach - layout.origin) / layout.spacing), 0, limit).astype(np.int64)
    high = np.clip(np.floor((corners.max(axis=1) + reach - layout.origin) / layout.spacing), 0, limit).astype(np.int64)
    square = np.full(int(np.prod(layout.shape)), np.inf)
    closest = np.zeros((len(square), 3), dtype=np.float32)
    for box, node in _pairs(low, high):
        points = layout.origin + layout.spacing * node
        close = np.abs(np.einsum("ij,ij->i", points - corners[box, 0], normal[box])) <= reach
        points, face = points[close], box[close]
        foot = closest_points(points, corners[face, 0], corners[face, 1], corners[face, 2])
        distance = np.einsum("ij,ij->i", points - foot, points - foot)
        within = distance <= reach**2
        distance, foot = distance[within], foot[within]
        flat = np.ravel_multi_index(tuple(node[close][within].T), layout.shape)
        np.minimum.at(square, flat, distance)
        best = distance <= square[flat]
        closest[flat[best]] = foot[best]
    return square, closest


def cast_rays(origins: Floats, directions: Floats, corners: Floats) -> tuple[Floats, Integers]:
    """First hit of each ray.

    Args:
        origins: shape (N, 3) [m].
        directions: unit vectors, shape (N, 3).
        corners: triangles, shape (F, 3, 3) [m].

    Returns:
        Distance along the ray (N,) [m], infinite for a miss, and the triangle that is hit (N,).

    Source: Möller and Trumbore, Journal of Graphics Tools 2 (1997).
    """
    distance = np.full(len(origins), np.inf)
    face = np.zeros(len(origins), dtype=np.int64)
    if not len(corners):
        return distance, face
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    batch = max(1, CHUNK // (2 * len(corners)))
    for start in range(0, len(origins), batch):
        o, d = origins[start : start + batch, None], directions[start : start + batch, None]
        p = np.cross(d, v[None])
        determinant = np.einsum("fk,nfk->nf", u, p)
        inverse = 1.0 / np.where(np.abs(determinant) < 1e-18, np.inf, determinant)
        s = o - a
        first = np.einsum("nfk,nfk->nf", s, p) * inverse
        q = np.cross(s, u[None])
        second = np.einsum("nfk,nfk->nf", np.broadcast_to(d, q.shape), q) * inverse
        t = np.einsum("fk,nfk->nf", v, q) * inverse
        hit = (first >= 0.0) & (second >= 0.0) & (first + second <= 1.0) & (t > 1e-7) & (inverse != 0.0)
        t = np.where(hit, t, np.inf)
        best = np.argmin(t, axis=1)
        distance[start : start + batch] = t[np.arange(len(best)), best]
        face[start : start + batch] = best
    return distance, face
