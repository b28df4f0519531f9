"""Closed surfaces from triangles that scanners and CAD programs leave open, doubled or crossed by inner faces.

- `welded` joins corners that differ by rounding.
- `without_redundant` removes faces that do not separate solid from air: faces within a wall and open sheets in the air.
  The generalised winding number decides. Next to a face of the solid's surface it is 1 on one side and 0 on the other;
  next to a redundant face, the mean of both sides is close to 1 (in the wall) or to 0 (in the air).
- `holes_filled` closes holes with the smallest surface.
- `rebuilt` makes a new surface on a grid where the winding number passes through one half, for triangles that the other
  steps leave open.

Faces are judged together with all faces that they share ordinary edges with, so that one face next to a gap does not
decide by itself.

Sources: Jacobson et al., Robust inside-outside segmentation using generalized winding numbers, SIGGRAPH 2013; Barill et
al., Fast winding numbers for soups and clouds, SIGGRAPH 2018; Barequet & Sharir, Filling gaps in the boundary of a
polyhedron, CAGD 12 (1995); Takayama et al., A simple method for correcting facet orientations, JCGT 3 (2014).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.mesh_surface import components, edge_uses

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

TOLERANCES = (2e-7, 1e-6, 5e-6, 2e-5)
"""Distances at which corners are taken for one, tried in turn [m]; a tenth of the thinnest wall at most."""

BESIDE = 2e-6
"""Distance from a face at which the winding number is taken [m]."""

REDUNDANT = 0.25
"""Faces are redundant if the mean winding number of their sides is at least so far from one half."""

MAIN = 0.4
"""Share of the surface from which a patch is the vessel's own, whatever its winding number: that of an open sheet is
small."""

JUDGED = 200
"""Faces of a patch that are examined; they stand for the rest."""

LONGEST_LOOP = 150
"""Corners of the longest hole that is closed by the smallest surface; longer ones by a fan."""

RAYS = 20_000
"""Number of rays that find the visible sides of patches."""

GRID_NODES = 400_000
"""Nodes of the grid of `rebuilt`."""


def is_closed(faces: Integers) -> bool:
    """Whether every directed edge is used as often as its opposite."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forth = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    back = edges[np.lexsort((edges[:, 0], edges[:, 1]))][:, ::-1]
    return bool(np.array_equal(forth, back))


def welded(vertices: Floats, faces: Integers) -> tuple[Floats, Integers, float]:
    """Join corners that lie closer together than a tolerance, if that closes edges.

    Returns:
        Vertices, faces without degenerate and double ones, and the tolerance [m]; 0 if nothing was joined.
    """
    best, chosen = _open_edges(faces), (vertices, faces, 0.0)
    for tolerance in TOLERANCES:
        if not best:
            break
        joined = _joined_corners(vertices, faces, tolerance)
        if (left := _open_edges(joined)) < best:
            best, chosen = left, (vertices, joined, tolerance)
    return chosen


def _open_edges(faces: Integers) -> int:
    return int(np.count_nonzero(edge_uses(faces)[1] == 1))


def _joined_corners(vertices: Floats, faces: Integers, tolerance: float) -> Integers:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(vertices).query_pairs(tolerance, output_type="ndarray")
    count = len(vertices)
    near = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    number = connected_components(near, directed=False)[1]
    _, first = np.unique(number, return_index=True)
    return distinct(first[number][faces])


def distinct(faces: Integers) -> Integers:
    """Faces with three different corners, each once."""
    nondegenerate = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[nondegenerate]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return faces[np.sort(first)]


def oriented(faces: Integers) -> tuple[Integers, Integers]:
    """Faces with the same side out in every patch, by majority, and the number of each face's patch.

    A patch is a set of faces that are connected by edges of exactly two faces.
    """
    import igl

    turned, patch = igl.bfs_orient(np.ascontiguousarray(faces, dtype=np.int64))
    turned, patch = np.asarray(turned, dtype=np.int64), np.asarray(patch, dtype=np.int64)
    # the search keeps the side of a patch's first face, which may be the one that is wrong
    same = np.array_equal(turned, faces) or np.array([_even(a, b) for a, b in zip(turned, faces, strict=True)])
    agree = np.bincount(patch, weights=np.where(same, 1.0, -1.0) * np.ones(len(faces)))
    flip = agree[patch] < 0.0
    return np.where(flip[:, None], turned[:, ::-1], turned), patch


def outwards(vertices: Floats, faces: Integers) -> Integers:
    """Faces with normals outwards: each connected part encloses a positive volume, if it is closed."""
    faces, _ = oriented(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    component = components(faces)
    volume = np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)))
    return np.where((volume[component] < 0.0)[:, None], faces[:, ::-1], faces)


def _even(a: Integers, b: Integers) -> bool:
    """Whether two triangles with the same corners have the same orientation."""
    k = int(np.flatnonzero(b == a[0])[0])
    return bool(b[(k + 1) % 3] == a[1])


def winding_numbers(vertices: Floats, faces: Integers, points: Floats) -> Floats:
    """Generalised winding numbers of points, shape (n,)."""
    import igl

    used, index = np.unique(faces, return_inverse=True)  # corners without a face would enlarge the search tree
    winding = igl.fast_winding_number(vertices[used], index.reshape(-1, 3).astype(np.int64), points)
    return np.asarray(winding, dtype=float)


@dataclass(frozen=True)
class RemovedFaces:
    """Faces that do not bound the solid.

    Attributes:
        within: number of faces within a wall.
        sheets: faces of each open surface in the air, shapes (F, 3).
    """

    within: int
    sheets: tuple[Integers, ...]


def without_redundant(vertices: Floats, faces: Integers) -> tuple[Integers, RemovedFaces]:
    """Remove faces that do not separate solid from air.

    Args:
        vertices: shape (V, 3) [m], z up.
        faces: of any orientation, shape (F, 3).
    """
    faces, _ = oriented(faces)
    within, sheets = 0, []
    for _ in range(4):  # what remains of patches joins to larger ones, of which some can be judged only then
        faces, patch = oriented(faces)
        drop = np.zeros(len(faces), dtype=bool)
        judged = _judgements(vertices, faces, patch)
        for number, mean in judged.items():
            if abs(mean - 0.5) < REDUNDANT:
                continue
            chosen = patch == number
            drop |= chosen
            if mean > 0.5:
                within += int(chosen.sum())
            else:
                sheets.append(faces[chosen])
        if not drop.any() or drop.all():
            break
        faces = faces[~drop]
    return faces, RemovedFaces(within, tuple(sheets))


def _judgements(vertices: Floats, faces: Integers, patch: Integers) -> dict[int, float]:
    """Mean winding number of both sides for each patch that is open and not the vessel's main one."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    judgements: dict[int, float] = {}
    chosen, points = [], []
    rng = np.random.default_rng(0)
    for number in np.unique(patch):
        members = np.flatnonzero(patch == number)
        main = double[members].sum() > MAIN * double.sum()
        if main or not _open_edges(faces[members]):
            continue
        if len(members) > JUDGED:
            members = rng.choice(members, JUDGED, replace=False, p=double[members] / double[members].sum())
        normal = cross[members] / np.maximum(double[members], 1e-30)[:, None]
        centre = corners[members].mean(axis=1)
        chosen.append((int(number), members))
        points.append(np.concatenate([centre + BESIDE * normal, centre - BESIDE * normal]))
    if not chosen:
        return judgements
    values = winding_numbers(vertices, faces, np.concatenate(points))
    start = 0
    for number, members in chosen:
        sides = values[start : start + 2 * len(members)].reshape(2, -1).mean(axis=0)
        start += 2 * len(members)
        order = np.argsort(sides)
        weight = np.cumsum(double[members][order])
        judgements[number] = float(sides[order][np.searchsorted(weight, 0.5 * weight[-1])])
    return judgements


def boundary_loops(faces: Integers) -> list[Integers]:
    """Closed boundaries, each as corners in the order in which faces that close it would use them.

    Boundaries that touch themselves at a corner are split there.
    """
    _, uses, index = edge_uses(faces)
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    onward: dict[int, list[int]] = defaultdict(list)
    for a, b in sides[uses[index] == 1].tolist():
        onward[b].append(a)
    loops = []
    while onward:
        path = [next(iter(onward))]
        place = {path[0]: 0}
        while (following := onward.get(path[-1])) is not None:
            corner = following.pop()
            if not following:
                del onward[path[-1]]
            if corner in place:
                cut = place[corner]
                loop = path[cut:]
                for dropped in loop[1:]:
                    del place[dropped]
                path = path[: cut + 1]
                if len(loop) >= 3:
                    loops.append(np.array(loop, dtype=np.int64))
            else:
                place[corner] = len(path)
                path.append(corner)
    return loops


def holes_filled(vertices: Floats, faces: Integers, loops: list[Integers]) -> tuple[Floats, Integers, Floats]:
    """Close boundaries.

    Returns:
        Vertices, faces, and the area that closes each boundary [m²].
    """
    added, areas, more = [], [], [vertices]
    count = len(vertices)
    for loop in loops:
        if len(loop) <= LONGEST_LOOP:
            patch = _smallest_surface(vertices[loop], loop)
            corners = vertices[patch]
        else:
            centre = vertices[loop].mean(axis=0)
            patch = np.column_stack([loop, np.roll(loop, -1), np.full(len(loop), count)])
            corners = np.stack(
                [vertices[loop], np.roll(vertices[loop], -1, axis=0), np.tile(centre, (len(loop), 1))], 1
            )
            more.append(centre[None])
            count += 1
        added.append(patch)
        areas.append(_area(corners[:, 0], corners[:, 1], corners[:, 2]).sum())
    return np.vstack(more), np.vstack([faces, *added]), np.array(areas)


def _area(a: Floats, b: Floats, c: Floats) -> Floats:
    result: Floats = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    return result


def _smallest_surface(points: Floats, loop: Integers) -> Integers:
    """Triangles of least area that span a loop, by dynamic programming."""
    n = len(loop)
    cost = np.zeros((n, n))
    middle = np.zeros((n, n), dtype=np.int64)
    for gap in range(2, n):
        for i in range(n - gap):
            k = i + gap
            between = np.arange(i + 1, k)
            total = cost[i, between] + cost[between, k] + _area(points[i], points[between], points[k])
            best = int(np.argmin(total))
            cost[i, k], middle[i, k] = total[best], between[best]
    triangles, waiting = [], [(0, n - 1)]
    while waiting:
        i, k = waiting.pop()
        if k - i >= 2:
            m = int(middle[i, k])
            triangles.append((loop[i], loop[m], loop[k]))
            waiting += [(i, m), (m, k)]
    return np.array(triangles, dtype=np.int64)


def rebuilt(vertices: Floats, faces: Integers) -> tuple[Floats, Integers, float]:
    """A closed surface around the points whose winding number is above one half.

    Args:
        vertices: shape (V, 3) [m].
        faces: of any orientation, shape (F, 3).

    Returns:
        Vertices (V, 3) [m], faces (F, 3) with normals outwards, none if nothing is inside, and the grid's spacing [m].
    """
    import igl
    from skimage.measure import marching_cubes

    low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    spacing = float(np.cbrt(np.prod(high - low + 1e-3) / GRID_NODES))
    counts = np.ceil((high - low) / spacing).astype(int) + 7
    origin = low - 3.0 * spacing
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    turned = _most_decided(vertices, faces, nodes)
    inside = _inside(vertices, turned, nodes, counts, spacing)
    if not inside.any():
        return vertices, np.zeros((0, 3), dtype=np.int64), spacing
    corners, triangles, _, _ = marching_cubes(inside.astype(np.float32), 0.5, spacing=(spacing,) * 3)
    remaining_faces = np.asarray(triangles, dtype=np.int64)
    points = np.asarray(corners, dtype=float) + origin
    # half a spacing off at most, except next to gaps
    square, _, foot = igl.point_mesh_squared_distance(points, vertices, turned)
    near = np.asarray(square) < spacing**2
    points[near] = np.asarray(foot)[near]
    a, b, c = (points[remaining_faces[:, i]] for i in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
        remaining_faces = remaining_faces[:, ::-1]
    return points, remaining_faces, spacing


def _inside(vertices: Floats, faces: Integers, nodes: Floats, counts: Integers, spacing: float) -> Flags:
    """Whether the winding number of nodes is above one half, shape `counts`.

    It is computed near the surface only, and at one node of each region without surface.
    """
    from scipy.ndimage import binary_dilation, label

    low = nodes[0]
    surface = np.zeros(counts, dtype=bool)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.ceil(longest / (0.5 * spacing)).astype(np.int64)
    for count in np.unique(steps):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        weights = np.stack([i, j, count - i - j], axis=-1)[(i + j) <= count] / count
        points = np.einsum("wc,fcd->fwd", weights, corners[steps == count]).reshape(-1, 3)
        surface[tuple(np.rint((points - low) / spacing).astype(np.int64).T)] = True
    near = binary_dilation(surface, np.ones((3, 3, 3), dtype=bool))
    regions, _ = label(~near)
    flat = regions.ravel()
    _, first = np.unique(flat, return_index=True)
    chosen = np.concatenate([np.flatnonzero(near.ravel()), first[1:] if near.any() else first])
    enclosed = winding_numbers(vertices, faces, nodes[chosen]) > 0.5
    inside = np.zeros(len(nodes), dtype=bool)
    beside = int(np.count_nonzero(near))
    inside[chosen[:beside]] = enclosed[:beside]
    whole = np.concatenate([[False], enclosed[beside:]])
    inside |= whole[flat]
    return inside.reshape(counts)


def _most_decided(vertices: Floats, faces: Integers, nodes: Floats) -> Integers:
    """The orientation of the patches, as in the file or by visibility, with winding numbers closest to 0 and 1."""
    import igl.embree

    few = nodes[np.random.default_rng(0).choice(len(nodes), min(2_000, len(nodes)), replace=False)]
    as_given, _ = oriented(faces)
    flipped, _ = igl.embree.reorient_facets_raycast(vertices, as_given, RAYS)
    seen = np.where(np.asarray(flipped, dtype=bool)[:, None], as_given[:, ::-1], as_given)

    def undecided(turned: Integers) -> float:
        w = winding_numbers(vertices, turned, few)
        return float(np.minimum(np.abs(w), np.abs(w - 1.0)).mean())

    return min((as_given, np.ascontiguousarray(seen)), key=undecided)
