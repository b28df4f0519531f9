"""The cavity of a closed mesh whose walls may be thinner than the spacing of any grid.

The distance grid of the simulator needs walls of about one spacing. Here the surface itself separates nodes: two
neighbouring nodes are connected unless the segment between them crosses a triangle. So a coarse lattice finds the
cavity of a bowl of foil, and its volume is that of the triangles, not that of the nodes.

It serves to compare a mesh before and after a repair; the capacity of a `Vessel` comes from its distance grid.

Limitations: as those of `sim_engine.vessel.cavity`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.cavity import CavityFill, flood
from sim_engine.vessel.mesh_distance import Crossings, GridLayout, crossings, layout_around
from sim_engine.vessel.mesh_surface import components
from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

NODES = 400_000
"""Approximate number of nodes of the lattice."""

FINEST = 0.0008
"""Smallest spacing of the lattice [m]."""

MOST_BODIES = 30
"""Number of separate bodies that are examined."""

FILLED, IMMERSED = 0.01, 0.2
"""A body fills the cavity if this share of the cavity, or of the body, is in it: a spoon is small, and most of a handle
is outside, though its ends may reach through the wall."""

BISECTIONS = 8
"""Halvings of the interval of a spacing that contains the brim."""


@dataclass(frozen=True)
class ExactCavity:
    """The largest pool that rain leaves in a solid, by its triangles.

    Attributes:
        volume: to the brim [m³]; 0 without a pool.
        brim: height at which it overflows [m].
        layout: of the lattice.
        pool: nodes of the cavity, shape of the lattice.
        solid: nodes in solid.
    """

    volume: float
    brim: float
    layout: GridLayout
    pool: Flags
    solid: Flags


def exact_cavity(vertices: Floats, faces: Integers) -> ExactCavity:
    """Find the cavity of a closed mesh, z up.

    Args:
        vertices: shape (V, 3) [m].
        faces: normals outwards, shape (F, 3).

    Raises:
        VesselError: the surface is not closed.
    """
    size = np.ptp(vertices, axis=0)
    layout = layout_around(vertices, max(FINEST, float(np.cbrt(np.prod(size + 0.024) / NODES))))
    hits, solid = crossings(vertices, faces, layout)
    heights = layout.origin[2] + layout.spacing * np.arange(layout.shape[2])
    corners = vertices[faces]
    low, high = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    free = np.empty((2 * layout.shape[0] - 1, 2 * layout.shape[1] - 1, layout.shape[2]), dtype=bool)
    for k, z in enumerate(heights):
        free[:, :, k] = _plane(corners[(low < z) & (high > z)], z, layout, ~solid[:, :, k])
    lowest, highest = _between(hits, layout)
    sealed = np.ones_like(free)
    sealed[::2, ::2] = np.isfinite(lowest)
    fill = flood(free, sealed)
    pool = fill.pool[::2, ::2]
    if not pool.any():
        return ExactCavity(0.0, float(heights[0]), layout, pool, solid)
    brim = _brim(fill, corners, layout, solid)
    return ExactCavity(_volume(pool, lowest, highest, layout, brim), brim, layout, pool, solid)


@dataclass(frozen=True)
class Filler:
    """A separate body that fills a part of the cavity, such as the liquid or a stirrer.

    Attributes:
        faces: its faces, a mask (F,).
        size: "72 × 72 × 57 mm".
        capacities: a clause with the capacities with it and without it.
    """

    faces: Flags
    size: str
    capacities: str


def fillers(vertices: Floats, faces: Integers, *, together: bool = False) -> Iterator[Filler]:
    """Find separate bodies without which a closed mesh would hold more.

    A body whose box contains all others is the vessel itself: what is left without it may be a chamber in its wall.
    Costs nothing for a mesh of one body.

    Args:
        vertices: shape (V, 3) [m], z up.
        faces: normals outwards, shape (F, 3).
        together: whether a body is compared with a mesh that lacks the bodies found before.
    """
    component = components(faces)
    bodies = np.unique(component)
    if not 1 < len(bodies) <= MOST_BODIES:
        return
    remaining = np.ones(len(faces), dtype=bool)
    whole = _held(vertices, faces)
    for body in bodies:
        chosen = component == body
        rest = remaining & ~chosen
        corners, others = vertices[faces[chosen]], vertices[faces[rest]]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        if np.all(low <= others.min(axis=(0, 1))) and np.all(high >= others.max(axis=(0, 1))):
            continue
        middle = corners.mean(axis=(0, 1))[:2]
        over = np.all(middle >= others.min(axis=(0, 1))[:2]) and np.all(middle <= others.max(axis=(0, 1))[:2])
        if not over or whole is None:
            continue
        without = _held(vertices, faces[rest])
        solid = abs(float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) / 6.0
        if without is None or without - whole <= min(FILLED * whole, IMMERSED * solid):
            continue
        size = " × ".join(f"{1e3 * x:.0f}" for x in np.ptp(corners.reshape(-1, 3), axis=0))
        both = f"it holds {1e6 * whole:.0f} mL with it and {1e6 * without:.0f} mL without it"
        yield Filler(chosen, f"{size} mm", both)
        if together:
            remaining, whole = rest, without


def _held(vertices: Floats, faces: Integers) -> float | None:
    """Volume of the cavity [m³]; None if the surface is not closed."""
    try:
        return exact_cavity(vertices, faces).volume
    except VesselError:
        return None


def _plane(corners: Floats, z: float, layout: GridLayout, free: Flags) -> Flags:
    """Free nodes of a plane and, between them, the open connections: shape (2 nx - 1, 2 ny - 1)."""
    nx, ny = free.shape
    plane = np.zeros((2 * nx - 1, 2 * ny - 1), dtype=bool)
    plane[::2, ::2] = free
    plane[1::2, ::2] = free[1:] & free[:-1]
    plane[::2, 1::2] = free[:, 1:] & free[:, :-1]
    if not len(corners):
        return plane
    above = corners[:, :, 2] > z
    alone = np.where(above.sum(axis=1) == 1, np.argmax(above, axis=1), np.argmin(above, axis=1))
    row = np.arange(len(corners))
    top = corners[row, alone]
    ends = []
    for turn in (1, 2):
        other = corners[row, (alone + turn) % 3]
        fraction = (z - top[:, 2]) / (other[:, 2] - top[:, 2])
        ends.append((top + fraction[:, None] * (other - top))[:, :2])
    # slightly displaced, so that no row of nodes runs exactly along a wall
    first, second = ((end - layout.origin[:2]) / layout.spacing - 1e-5 * math.sqrt(2.0) for end in ends)
    for across in (0, 1):  # rows of nodes along the other axis cross the segments
        along = 1 - across
        start, stop = (pick(first[:, across], second[:, across]) for pick in (np.minimum, np.maximum))
        begin = np.ceil(start).astype(np.int64)
        count = np.maximum(np.ceil(stop).astype(np.int64) - begin, 0)
        segment = np.repeat(np.arange(len(first)), count)
        line = begin[segment] + np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
        length = second[segment, across] - first[segment, across]
        place = first[segment, along] + (line - first[segment, across]) / length * (
            second[segment, along] - first[segment, along]
        )
        edge = 2 * np.floor(place).astype(np.int64) + 1
        inside = (edge >= 0) & (edge < plane.shape[along])
        plane[(edge[inside], 2 * line[inside]) if along == 0 else (2 * line[inside], edge[inside])] = False
    return plane


def _between(hits: Crossings, layout: GridLayout) -> tuple[Floats, Floats]:
    """Heights of the lowest and of the highest crossing between a node and the one above it [m], ±inf without."""
    shape = layout.shape
    lowest, highest = np.full(shape, np.inf), np.full(shape, -np.inf)
    k = np.floor((hits.z - layout.origin[2]) / layout.spacing).astype(np.int64)
    inside = (k >= 0) & (k < shape[2])
    at = (hits.i[inside], hits.j[inside], k[inside])
    np.minimum.at(lowest, at, hits.z[inside])
    np.maximum.at(highest, at, hits.z[inside])
    return lowest, highest


def _brim(fill: CavityFill, corners: Floats, layout: GridLayout, solid: Flags) -> float:
    from scipy import ndimage

    k = fill.brim
    pool, outside = fill.pool[:, :, k - 1], fill.outside[:, :, k - 1]
    high = layout.origin[2] + layout.spacing * k
    low = high - layout.spacing
    bottom, top = corners[:, :, 2].min(axis=1), corners[:, :, 2].max(axis=1)
    near = corners[(bottom < high) & (top > low)]
    bottom, top = near[:, :, 2].min(axis=1), near[:, :, 2].max(axis=1)
    for _ in range(BISECTIONS):
        z = 0.5 * (low + high)
        # of a thick wall the nodes between two slices are taken for those of the slice above
        plane = _plane(near[(bottom < z) & (top > z)], z, layout, ~(solid[:, :, k - 1] & solid[:, :, k]))
        labels, _ = ndimage.label(plane)
        joined = np.intersect1d(labels[pool & plane], labels[outside & plane])
        low, high = (low, z) if joined.any() else (z, high)
    return float(0.5 * (low + high))


def _volume(pool: Flags, lowest: Floats, highest: Floats, layout: GridLayout, brim: float) -> float:
    """Sum of the lengths of the columns in the cavity, times their cross-section."""
    h = layout.spacing
    i, j, k = np.nonzero(pool)
    z = layout.origin[2] + h * k
    shifted = np.zeros_like(pool)
    shifted[:, :, :-1] = pool[:, :, 1:]
    linked = shifted & ~np.isfinite(lowest)
    up = np.where(linked[i, j, k], h, np.minimum(np.minimum(lowest[i, j, k], brim) - z, h))
    below = np.maximum(k - 1, 0)
    down = np.where(linked[i, j, below], 0.0, z - np.maximum(highest[i, j, below], z - h))
    return float((np.maximum(up, 0.0) + down).sum()) * h * h
