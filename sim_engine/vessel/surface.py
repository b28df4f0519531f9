"""Points on a triangle mesh: dense along its sharp edges, even by area elsewhere. The same points at every call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
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
        count: how many, at least 10.

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
    # `place` runs evenly through the triangle that it fell into; a second, golden-ratio sequence spreads it in 2-D.
    second = np.arange(len(chosen)) * 0.618033988749895 % 1.0
    root = np.sqrt(place)
    u, v = 1.0 - root, second * root
    a, b, c = (vertices[faces[chosen, i]] for i in range(3))
    parts.append(a + u[:, None] * (b - a) + v[:, None] * (c - a))
    return np.vstack(parts)


def _even(weights: Floats, count: int) -> tuple[Integers, Floats]:
    """Evenly spaced draws from consecutive intervals: which one (count,), and the place in it in [0, 1] (count,)."""
    total = np.cumsum(weights)
    target = (np.arange(count) + 0.5) / count * total[-1]
    chosen = np.minimum(np.searchsorted(total, target), len(weights) - 1)
    start = total[chosen] - weights[chosen]
    return chosen, np.clip((target - start) / np.maximum(weights[chosen], 1e-30), 0.0, 1.0)
