"""Thin walls made thick enough for the simulator's grid, outwards: the cavity keeps its shape.

The outer surface is displaced along its normals; the inner surface stays. A face belongs to the inner surface if it is
the nearest one to points of the cavity (`sim_engine.vessel.exact_cavity`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.distance_grid import MARGIN, MAXIMUM_NODES, THINNEST_WALL, choose_spacing
from sim_engine.vessel.exact_cavity import ExactCavity
from sim_engine.vessel.mesh_surface import normals_and_areas
from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

NORMAL = 0.05
"""Distance that counts as much as normals that differ by a radian, in the comparison of faces with points [m]."""

RESERVE = 1.1
"""Thickness given, in multiples of the least one."""

NEAR = 2.0
"""Distance of the nodes that assign faces to a side [spacings]."""

ASSIGNING = 30_000
"""Largest number of these nodes."""

LEVEL = 0.7
"""Smallest vertical component of a normal of the rim's upper side."""


def least_wall(extent: Floats) -> float:
    """Thickness of walls that the grid of a vessel of some size resolves [m]; see `choose_spacing`.

    Args:
        extent: the solid's size along x, y, z, shape (3,) [m].
    """
    box = np.asarray(extent, dtype=float) + 2.0 * MARGIN
    spacing = 1e-4
    while np.prod(np.ceil(box / spacing) + 2.0) > MAXIMUM_NODES:
        spacing *= 1.02
    return spacing / THINNEST_WALL


def fits_grid(extent: Floats, wall: float) -> bool:
    """Whether the grid of a vessel of some size resolves walls of a thickness [m]; see `choose_spacing`."""
    try:
        choose_spacing(extent, wall)
    except VesselError:
        return False
    return True


def thickened(vertices: Floats, faces: Integers, wall: float, cavity: ExactCavity) -> tuple[Floats, float]:
    """Displace the outer surface.

    Args:
        vertices: of a closed solid, z up, shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).
        wall: its thickness [m].
        cavity: of the solid.

    Returns:
        Vertices (V, 3) [m] and the new thickness [m].
    """
    extent = np.ptp(vertices, axis=0)
    goal = RESERVE * least_wall(extent)
    goal = RESERVE * least_wall(extent + 2.0 * max(goal - wall, 0.0))
    by = max(goal - wall, 0.0)
    normal, area = normals_and_areas(vertices, faces)
    inner = _inner_faces(vertices, faces, normal, cavity)
    centre = vertices[faces].mean(axis=1)
    rim = (normal[:, 2] > LEVEL) & (centre[:, 2] > cavity.brim - 2.0 * wall)
    outer = ~inner & ~rim
    fixed = np.zeros(len(vertices), dtype=bool)
    fixed[faces[inner]] = True
    mean, total = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(mean, faces[outer, corner], area[outer, None] * normal[outer])
        np.add.at(total, faces[outer, corner], area[outer])
    # the mean of unit normals is shorter than 1 at edges, where the displacement has to be longer
    length = np.linalg.norm(mean, axis=1) / np.maximum(total, 1e-30)
    moves = (total > 0.0) & ~fixed & (length > 0.1)
    step = np.zeros_like(vertices)
    step[moves] = by * mean[moves] / total[moves, None] / np.maximum(length[moves, None], 0.5) ** 2
    moved = vertices + step
    moved[:, 2] = np.minimum(moved[:, 2], np.maximum(vertices[:, 2], cavity.brim))
    return moved, goal


def _inner_faces(vertices: Floats, faces: Integers, normal: Floats, cavity: ExactCavity) -> Flags:
    """Faces of the cavity's surface, shape (F,)."""
    import igl
    from scipy.ndimage import binary_dilation
    from scipy.spatial import cKDTree

    layout = cavity.layout
    cube = np.ones((3, 3, 3), dtype=bool)
    beside = [binary_dilation(each, cube) & binary_dilation(~each, cube) for each in (cavity.pool, cavity.solid)]
    chosen = np.argwhere(~cavity.solid & (beside[0] | beside[1]))
    if len(chosen) > ASSIGNING:
        chosen = np.random.default_rng(0).choice(chosen, ASSIGNING, replace=False)
    nodes = layout.origin + layout.spacing * chosen
    wet = cavity.pool[tuple(chosen.T)]
    square, index, foot = igl.point_mesh_squared_distance(nodes, vertices, faces)
    near = np.asarray(square) < (NEAR * layout.spacing) ** 2
    features = np.hstack([np.asarray(foot)[near], NORMAL * normal[np.asarray(index)[near]]])
    sought = np.hstack([vertices[faces].mean(axis=1), NORMAL * normal])
    _, nearest = cKDTree(features).query(sought)
    return np.asarray(wet[near][nearest], dtype=bool)
