"""The surface of a meshed vessel: its opening, the curves over its lip, and sample points.

Sample points are dense along sharp edges and even by area elsewhere, and the same at every call.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.distance_grid import SignedDistanceGrid
from sim_engine.vessel.mesh_distance import cast_rays

Floats = NDArray[np.float64]

DIRECTIONS = 72
"""Half planes in which meridians are traced."""

WALL_POINTS = 40
"""Points of a meridian on the inner wall."""

RIM_POINTS = 24
"""Points of a meridian over the rim, up to the crest."""

CREST_TILT = math.radians(5.0)
"""Tilt that selects the lip's point of a direction, the rim's highest one after it: the inner edge of a flat rim."""


def _directions(count: int) -> Floats:
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])


def _near(corners: Floats, low: float, high: float) -> Floats:
    """Triangles that reach into a range of heights."""
    inside: Floats = corners[(corners[:, :, 2].max(axis=1) >= low) & (corners[:, :, 2].min(axis=1) <= high)]
    return inside


def measure_opening(grid: SignedDistanceGrid, corners: Floats, rim: float, wall: float) -> tuple[Floats, float]:
    """Centre and radius of the opening.

    Args:
        grid: distance and cavity.
        corners: the solid's triangles, shape (F, 3, 3) [m].
        rim: height of the brim [m].
        wall: thickness [m].

    Returns:
        The centroid of the cavity's section half a wall below the brim, (2,) [m], and the radius of the largest circle
        that fits there, with any centre [m].
    """
    top = int(np.flatnonzero(grid.cavity.any(axis=(0, 1)))[-1])
    i, j = np.nonzero(grid.cavity[:, :, top])
    rough = grid.origin[:2] + grid.spacing * np.array([i.mean(), j.mean()])
    height = rim - min(0.5 * wall, 0.004)
    near = _near(corners, height, height)
    ray = _directions(360)
    length, _ = cast_rays(np.tile([*rough, height], (360, 1)), ray, near)
    edge = rough + (np.where(np.isfinite(length), length, 0.0)[:, None] * ray)[:, :2]
    after = np.roll(edge, -1, axis=0)
    cross = edge[:, 0] * after[:, 1] - after[:, 0] * edge[:, 1]
    if abs(cross.sum()) < 1e-9:
        return rough, 0.0
    centre = ((edge + after) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    best, step = centre, float(np.linalg.norm(edge - centre, axis=1).max()) / 2.0
    offsets = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 2), axis=-1).reshape(-1, 2)
    radius = float(np.linalg.norm(edge - centre, axis=1).min())
    while step > 1e-5:
        tried = best + step * offsets
        fits = np.linalg.norm(edge[None] - tried[:, None], axis=2).min(axis=1)
        if fits.max() > radius:
            radius, best = float(fits.max()), tried[int(np.argmax(fits))]
        step /= 3.0
    return centre, radius


def trace_meridians(grid: SignedDistanceGrid, corners: Floats, floor: float, rim: float, wall: float) -> Floats:
    """Curves up the inner wall and over the rim to its crest, see `Vessel.meridians`.

    Args:
        grid: distance and cavity, the opening's centre on the axis.
        corners: the solid's triangles, shape (F, 3, 3) [m].
        floor: lowest z of the cavity [m].
        rim: height of the brim [m].
        wall: thickness [m].

    Returns:
        Shape (`DIRECTIONS`, points, 3) [m].
    """
    ray = _directions(DIRECTIONS)
    last = rim - min(0.25 * wall, 0.5 * grid.spacing)
    low, high = floor + 0.5 * grid.spacing, min(rim - wall, rim - 2.0 * grid.spacing)
    levels = np.linspace(low, max(high, low), WALL_POINTS)
    radius = _inner_radius(grid, ray, levels)
    walls = radius[:, :, None] * ray[:, None] + np.array([0.0, 0.0, 1.0]) * levels[:, None]
    length, _ = cast_rays(np.tile([0.0, 0.0, last], (DIRECTIONS, 1)), ray, _near(corners, last, last))
    inner = np.where(np.isfinite(length), length, radius[:, -1])
    return np.concatenate([walls, _over_the_rim(ray, inner, last, corners, rim, wall)], axis=1)


def _over_the_rim(ray: Floats, inner: Floats, last: float, corners: Floats, rim: float, wall: float) -> Floats:
    """The inner wall's point at `last` and the points above the rim up to its crest, (directions, points, 3) [m]."""
    reach = np.linspace(1e-6, 2.5 * max(wall, 1e-3), RIM_POINTS)
    r = inner[:, None] + reach
    # Rims may be higher than their lowest point away from a spout, and so may handles; only the rim itself is needed.
    ceiling = rim + 0.25
    start = r[:, :, None] * ray[:, None] + np.array([0.0, 0.0, ceiling])
    fall, _ = cast_rays(
        start.reshape(-1, 3), np.tile([0.0, 0.0, -1.0], (r.size, 1)), _near(corners, last - wall, ceiling)
    )
    z = ceiling - fall.reshape(r.shape)
    z = np.where(np.isfinite(z), z, last)
    crest = np.argmax(z * math.cos(CREST_TILT) - r * math.sin(CREST_TILT), axis=1)
    column = np.minimum(np.arange(RIM_POINTS), crest[:, None])  # beyond the crest, repeat it
    row = np.arange(DIRECTIONS)[:, None]
    over = np.concatenate([r[row, column, None] * ray[:, None], z[row, column, None]], axis=2)[:, :, [0, 1, 3]]
    foot = np.column_stack([inner[:, None] * ray[:, :2], np.full(DIRECTIONS, last)])
    return np.concatenate([foot[:, None], over], axis=1)


def _inner_radius(grid: SignedDistanceGrid, ray: Floats, levels: Floats) -> Floats:
    """Distance from the axis to the cavity's far wall, shape (directions, levels) [m]; 0 if there is none."""
    step = 0.5 * grid.spacing
    r = np.arange(0.0, float(np.abs([grid.origin[:2], grid.upper[:2]]).max()), step)
    points = np.empty((len(ray), len(levels), len(r), 3))
    points[...] = r[:, None] * ray[:, None, None]
    points[..., 2] = levels[:, None]
    away = grid.sample(points.reshape(-1, 3)).reshape(points.shape[:3])
    index = np.rint((points - grid.origin) / grid.spacing).astype(np.int64)
    index = np.clip(index, 0, np.array(grid.shape) - 1)
    wet = (grid.cavity[index[..., 0], index[..., 1], index[..., 2]] > 0) & (away > 0.0)
    last = len(r) - 1 - np.argmax(wet[..., ::-1], axis=2)
    last = np.minimum(last, len(r) - 2)
    here = np.take_along_axis(away, last[..., None], axis=2)[..., 0]
    there = np.take_along_axis(away, last[..., None] + 1, axis=2)[..., 0]
    fraction = np.where(there < here, np.clip(here / np.maximum(here - there, 1e-12), 0.0, 1.0), 0.0)
    result: Floats = np.where(wet.any(axis=2), r[last] + fraction * step, 0.0)
    return result


Integers = NDArray[np.int64]

SHARP = np.cos(np.deg2rad(30.0))
"""Edges whose faces' normals differ by more than 30° count as sharp."""

EDGE_SHARE = 1.0 / 3.0
"""Share of the points that sharp edges get."""


def normals_and_areas(vertices: Floats, faces: Integers) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) and areas (F,) [m²] of triangles; degenerate ones get the normal 0."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-30)[:, None], length / 2.0


def edge_uses(faces: Integers) -> tuple[Integers, Integers, Integers]:
    """Undirected edges (E, 2), faces at each (E,), and the edge of each side of each face (3 F,)."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, index, uses = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, uses, index.reshape(-1)


def components(faces: Integers) -> Integers:
    """Number of the connected part that each face belongs to, by common edges, shape (F,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, _, index = edge_uses(faces)
    count = len(faces)
    owner = np.repeat(np.arange(count), 3)
    size = count + len(edges)
    joined = coo_array((np.ones(len(owner), dtype=bool), (owner, count + index)), shape=(size, size))
    number = connected_components(joined, directed=False)[1][:count]
    _, component = np.unique(number, return_inverse=True)
    return np.asarray(component, dtype=np.int64).reshape(-1)


def sharp_edges(vertices: Floats, faces: Integers) -> Integers:
    """Vertex pairs of the edges where the surface turns by more than 30°, shape (E, 2)."""
    normal, _ = normals_and_areas(vertices, faces)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    pair = np.flatnonzero(np.all(edges[1:] == edges[:-1], axis=1))
    turn = np.einsum("ij,ij->i", normal[owner[pair]], normal[owner[pair + 1]])
    sharp: Integers = edges[pair[turn < SHARP]]
    return sharp


def sample_surface(vertices: Floats, faces: Integers, count: int) -> Floats:
    """Points on the surface; see `Vessel.surface_points`.

    Args:
        vertices: shape (V, 3) [m].
        faces: shape (F, 3).
        count: number of points, at least 10.

    Returns:
        Shape (count, 3) [m].

    Raises:
        ValueError: count below 10.
    """
    if count < 10:
        raise ValueError(f"surface points: at least 10, got {count}")
    edges = sharp_edges(vertices, faces)
    on_edges = round(count * EDGE_SHARE) if len(edges) else 0
    parts = []
    if on_edges:
        start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
        along = _even(np.linalg.norm(end - start, axis=1), on_edges)
        parts.append(start[along[0]] + along[1][:, None] * (end - start)[along[0]])
    _, area = normals_and_areas(vertices, faces)
    chosen, place = _even(area, count - on_edges)
    # `place` is evenly distributed in its triangle; a second, golden-ratio sequence spreads it in 2-D.
    second = np.arange(len(chosen)) * 0.618033988749895 % 1.0
    root = np.sqrt(place)
    u, v = 1.0 - root, second * root
    a, b, c = (vertices[faces[chosen, i]] for i in range(3))
    parts.append(a + u[:, None] * (b - a) + v[:, None] * (c - a))
    return np.vstack(parts)


def _even(weights: Floats, count: int) -> tuple[Integers, Floats]:
    """Evenly spaced draws from consecutive intervals: interval (count,) and position in it in [0, 1] (count,)."""
    total = np.cumsum(weights)
    target = (np.arange(count) + 0.5) / count * total[-1]
    chosen = np.minimum(np.searchsorted(total, target), len(weights) - 1)
    start = total[chosen] - weights[chosen]
    return chosen, np.clip((target - start) / np.maximum(weights[chosen], 1e-30), 0.0, 1.0)
