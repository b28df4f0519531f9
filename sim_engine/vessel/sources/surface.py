"""A mesh of a vessel that is not round, from points: the radius by direction and height, with the wall beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.sources.points import FOOT, Scan, surfaces

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_DIRECTIONS, LEAST_DIRECTIONS = 48, 16
"""Directions in which the radius is given; there are two thirds as many heights."""

IN_A_CELL = 20
"""Points that should fall to each direction and height."""


def mesh_of(scan: Scan, wall: float | None, floor: float | None) -> tuple[Floats, Integers]:
    """A closed mesh of a vessel that is not round.

    Args:
        wall: thickness [m]; None: as far apart as the two surfaces were seen.
        floor: thickness [m]; None: as the wall.

    Returns:
        Vertices (V, 3) [m] and faces (F, 3), normals outwards; the inner floor at z = 0.

    Raises:
        VesselError: more than a quarter of its surface was not seen, or nothing says how thick the wall is.
    """
    margin = FOOT * scan.height
    points = scan.points[(scan.points[:, 2] >= margin) & (scan.points[:, 2] <= scan.height)]
    radius = np.hypot(points[:, 0], points[:, 1])
    wanted = int(np.sqrt(1.5 * len(points) / IN_A_CELL))
    directions = int(np.clip(wanted, LEAST_DIRECTIONS, MOST_DIRECTIONS))
    rows = 2 * directions // 3
    turn = (np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)) % 1.0
    column = np.floor(turn * directions).astype(int) % directions
    row = np.minimum(((points[:, 2] - margin) / (scan.height - margin) * rows).astype(int), rows - 1)
    order = np.argsort(row * directions + column, kind="stable")
    cells = np.split(
        radius[order], np.searchsorted((row * directions + column)[order], np.arange(1, rows * directions))
    )
    parts = [surfaces(cell) if len(cell) >= 3 else [] for cell in cells]
    seen = [len(part) for part in parts if part]
    if len(seen) < 0.75 * len(cells):
        raise VesselError(
            f"only {len(seen) / len(cells):.0%} of the surface was seen, and the vessel is not round: scan it from all "
            "sides"
        )
    both = float(np.mean([count == 2 for count in seen])) > 0.5
    if both and wall is None:
        wall = float(np.median([np.median(part[1]) - np.median(part[0]) for part in parts if len(part) == 2]))
    if wall is None:
        raise VesselError(
            "the points are of one surface: how thick is the wall? Say it with --wall, such as --wall 3mm"
        )
    grid = np.array([np.median(part[0]) if len(part) == 1 + both else np.nan for part in parts])
    inner = _whole(grid.reshape(rows, directions)) - (0.0 if both or scan.seen == "inner" else wall)
    below = wall if floor is None else floor
    levels = np.linspace(0.0, scan.height - (0.0 if scan.seen == "inner" else below), rows)
    return _between(inner, inner + wall, levels, below)


def _whole(grid: Floats) -> Floats:
    """A surface over heights and directions without its gaps (NaN), a little smoothed."""
    from scipy import ndimage
    from scipy.interpolate import griddata

    known = np.isfinite(grid)
    at = np.argwhere(known)
    tiled = np.vstack([at + np.array([0, shift * grid.shape[1]]) for shift in (-1, 0, 1)])
    values, everywhere = np.tile(grid[known], 3), np.argwhere(np.ones_like(known))
    linear = griddata(tiled, values, everywhere, method="linear").reshape(grid.shape)
    nearest = griddata(tiled, values, everywhere, method="nearest").reshape(grid.shape)
    closed = np.where(np.isfinite(linear), linear, nearest)
    smooth: Floats = ndimage.gaussian_filter(closed, (0.7, 0.7), mode=("nearest", "wrap"))
    return smooth


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
