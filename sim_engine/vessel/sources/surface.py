"""A mesh of a vessel that is not round, from points: the radius by direction and height, with the wall beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.sources.points import FOOT, Scan

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

DIRECTIONS, ROWS = 48, 30
"""Directions and heights at which the radius is told."""


def mesh_of(scan: Scan, wall: float, floor: float) -> tuple[Floats, Integers]:
    """A closed mesh of a vessel that is not round.

    Args:
        wall, floor: thickness [m].

    Returns:
        Vertices (V, 3) [m] and faces (F, 3), normals outwards.

    Raises:
        VesselError: more than a quarter of its surface was not seen.
    """
    from scipy import ndimage
    from scipy.interpolate import griddata

    radius = np.hypot(scan.points[:, 0], scan.points[:, 1])
    middle = np.array([(la.inner or 0.0) / 2.0 + (la.outer or 0.0) / 2.0 for la in scan.layers])
    z_of = np.array([layer.z for layer in scan.layers])
    points = scan.points
    if scan.seen == "both":
        ours = radius < np.interp(points[:, 2], z_of, middle)
        points, radius = points[ours], radius[ours]
    margin = FOOT * scan.height
    body = (points[:, 2] >= margin) & (points[:, 2] <= scan.height)
    points, radius = points[body], radius[body]
    turn = (np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)) % 1.0
    column = np.floor(turn * DIRECTIONS).astype(int) % DIRECTIONS
    row = np.minimum(((points[:, 2] - margin) / (scan.height - margin) * ROWS).astype(int), ROWS - 1)
    grid = np.full((ROWS, DIRECTIONS), np.nan)
    for i in range(ROWS):
        for j in range(DIRECTIONS):
            cell = radius[(row == i) & (column == j)]
            if len(cell) >= 3:
                grid[i, j] = np.median(cell)
    known = np.isfinite(grid)
    if known.mean() < 0.75:
        raise VesselError(
            f"only {known.mean():.0%} of the surface was seen, and the vessel is not round: scan it from all sides"
        )
    at = np.argwhere(known)
    tiled = np.vstack([at + np.array([0, shift * DIRECTIONS]) for shift in (-1, 0, 1)])
    whole = griddata(tiled, np.tile(grid[known], 3), tuple(np.indices(grid.shape)), method="linear")
    nearest = griddata(tiled, np.tile(grid[known], 3), tuple(np.indices(grid.shape)), method="nearest")
    surface = ndimage.gaussian_filter(
        np.where(np.isfinite(whole), whole, nearest), (0.7, 0.7), mode=("nearest", "wrap")
    )
    inner = surface - (wall if scan.seen == "outer" else 0.0)
    levels = np.linspace(0.0, scan.height - (0.0 if scan.seen == "inner" else floor), ROWS)
    return _between(inner, inner + wall, levels, floor)


def _between(inner: Floats, outer: Floats, levels: Floats, floor: float) -> tuple[Floats, Integers]:
    """The solid between two surfaces over directions and heights, with a flat floor."""
    rows, columns = inner.shape
    angle = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns

    def ring(radius: Floats, z: float) -> Floats:
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(columns, z)])

    rings = [ring(inner[k], float(levels[k])) for k in range(rows)]
    rings += [ring(outer[k], float(levels[k])) for k in reversed(range(rows))]
    rings.append(ring(outer[0], -floor))
    vertices = np.vstack([*rings, [[0.0, 0.0, 0.0], [0.0, 0.0, -floor]]])
    top, bottom = len(vertices) - 2, len(vertices) - 1
    here = np.arange(columns)
    there = np.roll(here, -1)
    faces = [np.column_stack([np.full(columns, top), here, there])]
    for k in range(len(rings) - 1):
        a, b = k * columns, (k + 1) * columns
        faces.append(np.column_stack([a + here, b + here, b + there]))
        faces.append(np.column_stack([a + here, b + there, a + there]))
    last = (len(rings) - 1) * columns
    faces.append(np.column_stack([np.full(columns, bottom), last + there, last + here]))
    return vertices, np.vstack(faces).astype(np.int64)
