"""The vessel in a depth image: what a depth camera sees of its outside, from one place, as points.

The table is the plane that most pixels lie in; it says where up is. What stands on it, hangs together in the picture
and does not touch its border is the vessel. Of that the near half is kept: beyond its axis the camera looks at the
inside of the far wall.

Source: Fischler & Bolles, Random sample consensus, Comm. ACM 24 (1981), for the plane.
Limitations: a pinhole camera without distortion; the vessel stands on a flat table, alone in the picture but for what
touches its border. Clear glass and shining metal have no depth that could be seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]

DRAWS = 400
"""Planes that are tried."""

ON_TABLE = 0.004
"""Distance from the plane in which a pixel lies in it [m]: three deviations of a common camera."""

STEEP = 0.9
"""Smallest cosine between the table's normal and the picture's upward direction: the camera looks down by 25° at most,
since from higher up it sees too much of the inside."""

JUMP = 0.012
"""Difference of depth between neighbours that is an edge [m]."""

LEAST_PIXELS = 400


def points_on_table(depth: Floats, focal: float, centre: tuple[float, float] | None = None) -> Floats:
    """The near half of the vessel's outer surface.

    Args:
        depth: along the camera's axis, rows from the top, shape (rows, columns) [m]; 0 where nothing was seen.
        focal: focal length [pixels].
        centre: column and row of the camera's axis; None: the picture's middle.

    Returns:
        Points with z up from the table, shape (n, 3) [m].

    Raises:
        VesselError: no table, or nothing that stands on it.
    """
    from scipy.ndimage import label, maximum_filter, minimum_filter

    rows, columns = depth.shape
    column, row = ((columns - 1) / 2.0, (rows - 1) / 2.0) if centre is None else centre
    seen = np.isfinite(depth) & (depth > 0.0)
    v, u = np.mgrid[:rows, :columns]
    points = np.stack([(u - column) / focal * depth, depth, (row - v) / focal * depth], axis=-1)
    up, level = _table(points[seen])
    above = np.where(seen, points @ up - level, 0.0)
    # Behind an edge are pixels of neither side, which float between; beside a silhouette the last ones are drawn back.
    # Those below the rim are kept: its height is told by them.
    jump = depth - minimum_filter(np.where(seen, depth, np.inf), 3)
    jump = np.maximum(jump, maximum_filter(depth, (1, 3)) - depth)
    body, count = label(seen & (above > ON_TABLE) & (jump < JUMP), structure=np.ones((3, 3)))
    edge = np.unique(np.concatenate([body[0], body[-1], body[:, 0], body[:, -1]]))
    sizes = np.bincount(body.ravel(), minlength=count + 1)
    sizes[edge] = sizes[0] = 0
    if sizes.max() < LEAST_PIXELS:
        raise VesselError(
            f"nothing of at least {LEAST_PIXELS} pixels stands on the table without touching the picture's border; is "
            "the whole vessel in it, and is its focal length right?"
        )
    across = np.cross([0.0, 1.0, 0.0], up)
    across /= np.linalg.norm(across)
    found: Floats = points[body == int(np.argmax(sizes))] @ np.column_stack([across, np.cross(up, across), up])
    found[:, 2] -= level
    low, high = np.quantile(found[:, 0], [0.01, 0.99])
    axis = float(np.quantile(found[:, 1], 0.01)) + 0.5 * float(high - low)
    near: Floats = found[found[:, 1] < axis]
    return near


def _table(points: Floats) -> tuple[Floats, float]:
    """Unit normal and level of the plane that most points lie in, among those that are about level."""
    rng = np.random.default_rng(0)
    few = points[rng.integers(len(points), size=min(len(points), 20_000))] if len(points) else points
    if len(few) < LEAST_PIXELS:
        raise VesselError(f"{len(points)} pixels have a depth; is it the right file?")
    best, up = 0, np.zeros(3)
    for a, b, c in few[rng.integers(len(few), size=(DRAWS, 3))]:
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs(normal[2]) < STEEP * length:
            continue
        normal *= np.sign(normal[2]) / length
        held = int(np.count_nonzero(np.abs((few - a) @ normal) < ON_TABLE))
        if held > best:
            best, up, level = held, normal, float(a @ normal)
    if best < 0.05 * len(few):
        raise VesselError("no table is seen that the vessel stands on; take it from 5° to 25° above the level")
    # the plane of least squares through what lies in it
    held_points = points[np.abs(points @ up - level) < ON_TABLE]
    middle = held_points.mean(axis=0)
    refined = np.linalg.eigh(np.cov((held_points - middle).T))[1][:, 0]
    up = refined * np.sign(refined[2])
    return up, float(middle @ up)
