"""Vessels of revolution: from an inner profile (r, z) to a solid, its exact distance and its cavity.

The outer surface is the true normal offset of the inner one by the wall: the boundary of all points within one wall of
the cavity, with rounded corners. From the inner floor's level it continues straight down to a flat underside. The rim
is flat. Thus a bowl gets a foot, a cylinder remains one, and the wall is nowhere thinner than stated.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import ProfileShape, VesselError

Floats = NDArray[np.float64]

TOLERANCE = 1e-6
"""Lengths below this are due to rounding [m]."""

SMALLEST, LARGEST = 0.010, 1.0
"""Plausible outer height and diameter of a vessel [m]."""

THINNEST = 0.0003
"""Thinnest wall or floor [m]: a thinner one is more likely an error of the unit."""


def _mm(point: Floats) -> str:
    return f"({1e3 * point[0]:.6g}, {1e3 * point[1]:.6g}) mm"


def check_profile(shape: ProfileShape) -> Floats:
    """Refuse profiles that are not a vessel.

    Returns:
        The inner profile, shape (n, 2), (r, z) above the inner floor [m].

    Raises:
        VesselError: with the reason and the remedy.
    """
    inner = np.array(shape.inner, dtype=float).reshape(-1, 2)
    if len(inner) < 2:
        raise VesselError(f"the profile has {len(inner)} point(s); it needs at least the floor's centre and the rim")
    if np.any(inner[:, 0] < -TOLERANCE):
        bad = inner[int(np.argmin(inner[:, 0]))]
        raise VesselError(f"the profile has the negative radius of {_mm(bad)}; radii are distances from the axis")
    if inner[0, 0] > TOLERANCE:
        raise VesselError(f"the profile starts at {_mm(inner[0])}; it must start on the axis, r = 0: the floor is open")
    if np.any(inner[1:, 0] <= TOLERANCE):
        bad = inner[1 + int(np.argmin(inner[1:, 0]))]
        raise VesselError(f"the profile comes back to the axis at {_mm(bad)}; only its first point may lie on it")
    if abs(inner[:, 1].min()) > TOLERANCE:
        raise VesselError(
            f"the profile's lowest point is at z = {1e3 * inner[:, 1].min():g} mm; "
            "z counts from the inner floor's lowest point, which must be 0"
        )
    lengths = np.linalg.norm(np.diff(inner, axis=0), axis=1)
    if np.any(lengths <= TOLERANCE):
        raise VesselError(f"the profile names the point {_mm(inner[int(np.argmin(lengths))])} twice in a row")
    height = float(inner[-1, 1])
    if height < inner[:, 1].max() - TOLERANCE:
        raise VesselError(
            f"the profile ends at z = {1e3 * height:g} mm, below its highest point "
            f"({1e3 * inner[:, 1].max():g} mm); it must end at the rim"
        )
    _check_size(inner, shape)
    _check_crossings(inner)
    return inner


def _check_size(inner: Floats, shape: ProfileShape) -> None:
    width, height = 2.0 * (inner[:, 0].max() + shape.wall), inner[-1, 1] + shape.floor
    if max(width, height) > LARGEST:
        raise VesselError(
            f"the profile is {width:g} m wide and {height:g} m high; vessels are at most {LARGEST:g} m: "
            "are its numbers in millimetres?"
        )
    if max(width, height) < SMALLEST or min(shape.wall, shape.floor) < THINNEST:
        raise VesselError(
            f"the profile is {1e3 * width:g} mm wide and {1e3 * height:g} mm high with a wall of "
            f"{1e3 * shape.wall:g} mm and a floor of {1e3 * shape.floor:g} mm; vessels are at least "
            f"{1e3 * SMALLEST:g} mm large and {1e3 * THINNEST:g} mm thick: check the units"
        )
    if inner[-1, 0] < 0.002:
        raise VesselError(f"the opening has a radius of {1e3 * inner[-1, 0]:g} mm; at least 2 mm let liquid through")
    if shape.wall > 5.0 * inner[:, 0].max():
        raise VesselError(f"the wall of {1e3 * shape.wall:g} mm is thicker than the vessel is wide: check the units")


def _check_crossings(inner: Floats) -> None:
    a, b = inner[:-1], inner[1:]

    def side(p: Floats, q: Floats, x: Floats) -> Floats:
        result: Floats = (q[..., 0] - p[..., 0]) * (x[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (
            x[..., 0] - p[..., 0]
        )
        return result

    for i in range(len(a) - 2):
        p, q, r, s = a[i], b[i], a[i + 2 :], b[i + 2 :]
        across = (side(p, q, r) * side(p, q, s) <= 0.0) & (side(r, s, p) * side(r, s, q) <= 0.0)
        # for two parallel pieces of one line all sides are zero, so their extents are compared
        overlap = np.all(
            np.maximum(np.minimum(r, s), np.minimum(p, q)) <= np.minimum(np.maximum(r, s), np.maximum(p, q)), axis=1
        )
        crossing = np.flatnonzero(across & overlap)
        if crossing.size:
            j = i + 2 + int(crossing[0])
            raise VesselError(
                f"the profile crosses itself: its piece from {_mm(a[i])} to {_mm(b[i])} meets the piece from "
                f"{_mm(a[j])} to {_mm(b[j])}"
            )


def outer_profile(inner: Floats, wall: float, floor: float) -> Floats:
    """Outer profile from the underside's edge to the rim's outer edge.

    Args:
        inner: checked inner profile, shape (n, 2) [m].
        wall: [m].
        floor: [m].

    Returns:
        Shape (m, 2), (r, z) above the inner floor, z from −floor up to the rim [m].
    """
    height = float(inner[-1, 1])
    # The wall continues in its direction beyond the rim before it is cut flat, so a flared wall keeps its thickness
    # there.
    direction = inner[-1] - inner[-2]
    beyond = inner[-1] + direction / np.linalg.norm(direction) * 2.0 * wall
    points = np.vstack([inner, [max(beyond[0], 0.0), beyond[1]]])
    a, b = points[:-1], points[1:]
    normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shifted = [(a + s * wall * normal, b + s * wall * normal) for s in (1.0, -1.0)]
    levels = np.concatenate(
        [
            np.linspace(0.0, height, max(2, int(np.ceil(8.0 * height / wall)))),
            points[:, 1],
            *(end[:, 1] for pair in shifted for end in pair),
        ]
    )
    between = np.round(levels[(levels >= 0.0) & (levels <= height)], 9)
    levels = np.array(sorted({*between.tolist(), 0.0, height}))  # np.unique imports masked arrays
    reach = wall**2 - (levels[:, None] - points[:, 1]) ** 2
    radius = np.where(reach >= 0.0, points[:, 0] + np.sqrt(np.maximum(reach, 0.0)), 0.0).max(axis=1)
    for start, end in shifted:
        rise = end[:, 1] - start[:, 1]
        fraction = (levels[:, None] - start[:, 1]) / np.where(np.abs(rise) < 1e-12, np.inf, rise)
        within = (fraction >= 0.0) & (fraction <= 1.0) & (np.abs(rise) >= 1e-12)
        on = start[:, 0] + fraction * (end[:, 0] - start[:, 0])
        radius = np.maximum(radius, np.where(within, on, 0.0).max(axis=1))
    curve = simplified(np.column_stack([radius, levels]), 2e-6)
    return np.vstack([[curve[0, 0], -floor], curve])


def simplified(curve: Floats, tolerance: float) -> Floats:
    """Douglas–Peucker: drop points that lie within a tolerance of the chord."""
    keep = np.zeros(len(curve), dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, len(curve) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        chord = curve[last] - curve[first]
        offset = curve[first + 1 : last] - curve[first]
        distance = np.abs(chord[0] * offset[:, 1] - chord[1] * offset[:, 0]) / max(float(np.linalg.norm(chord)), 1e-12)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            keep[first + 1 + worst] = True
            stack += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return curve[keep]


def solid_polygon(inner: Floats, outer: Floats) -> Floats:
    """The solid's half section: along the inner profile to the rim, down the outer one, to the axis; (n, 2) [m].

    The edge that closes it lies on the axis and is not a surface.
    """
    return np.vstack([inner, outer[::-1], [0.0, outer[0, 1]]])


def contains(polygon: Floats, r: Floats, z: Floats) -> NDArray[np.bool_]:
    """Whether points lie inside a closed polygon in the (r, z) half plane (even–odd rule). Arrays of any shape."""
    inside = np.zeros(np.broadcast(r, z).shape, dtype=bool)
    for (r1, z1), (r2, z2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if z1 == z2:
            continue
        straddles = (z1 > z) != (z2 > z)
        inside ^= straddles & (r < r1 + (z - z1) * (r2 - r1) / (z2 - z1))
    return inside


def distance(polygon: Floats, r: Floats, z: Floats) -> Floats:
    """Signed distance [m] from points (r, z), arrays of equal shape, to the solid; negative inside. Exact when
    revolved.

    The nearest point of a surface of revolution lies in the same half plane as the query point.
    """
    shape = np.broadcast(r, z).shape
    nearest = np.full(shape, np.inf)
    for a, b in itertools.pairwise(polygon):  # the closing edge on the axis is not a surface
        edge = b - a
        length2 = float(edge @ edge)
        if length2 == 0.0:
            continue
        t = np.clip(((r - a[0]) * edge[0] + (z - a[1]) * edge[1]) / length2, 0.0, 1.0)
        np.minimum(nearest, (r - a[0] - t * edge[0]) ** 2 + (z - a[1] - t * edge[1]) ** 2, out=nearest)
    result: Floats = np.sqrt(nearest) * np.where(contains(polygon, r, z), -1.0, 1.0)
    return result


def volume(inner: Floats) -> float:
    """Brimful volume of the cavity [m³]: the sum of the profile's cone frustums."""
    r, z = inner[:, 0], inner[:, 1]
    return float(np.sum(np.pi / 3.0 * np.diff(z) * (r[:-1] ** 2 + r[:-1] * r[1:] + r[1:] ** 2)))


def revolve(polygon: Floats, segments: int = 96) -> tuple[Floats, NDArray[np.int64]]:
    """Closed triangle mesh of the revolved half section, normals outwards.

    Args:
        polygon: first and last point on the axis, shape (n, 2) [m].
        segments: corners of the polygon that approximates a circle.

    Returns:
        Vertices (V, 3) [m] and faces (F, 3).
    """
    angle = 2.0 * np.pi * np.arange(segments) / segments
    ring = polygon[1:-1]
    count = len(ring)
    body = np.stack(
        [
            ring[:, 0] * np.cos(angle)[:, None],
            ring[:, 0] * np.sin(angle)[:, None],
            np.broadcast_to(ring[:, 1], (segments, count)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    bottom, top = segments * count, segments * count + 1
    vertices = np.vstack([body, [0.0, 0.0, polygon[0, 1]], [0.0, 0.0, polygon[-1, 1]]])
    here = np.arange(segments) * count
    there = np.roll(here, -1)
    faces = [np.column_stack([np.full(segments, bottom), here, there])]
    for k in range(count - 1):
        faces.append(np.column_stack([here + k, here + k + 1, there + k + 1]))
        faces.append(np.column_stack([here + k, there + k + 1, there + k]))
    faces.append(np.column_stack([here + count - 1, np.full(segments, top), there + count - 1]))
    return vertices, np.vstack(faces).astype(np.int64)
