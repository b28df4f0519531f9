"""A vessel from points on its surface, as scanners measure them.

**Scans** (`scan_of`). The axis is the line about which the points of every height are closest to circles. If points of
both the inner and the outer surface were measured, their distance from the axis distinguishes them. Limitations: along
a ray from the axis each surface is met at most once (no handle, no bulge that hides another part), and the vessel
stands roughly upright. Remove points of the table beforehand.

**Meshes** (`mesh_of`). A vessel that is not round becomes a mesh: the radius by direction and height, and the wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import VesselError
from sim_engine.vessel_acquisition.measurements import Radii

Floats = NDArray[np.float64]

LEAST_POINTS = 300
LAYERS = 40
"""Number of heights at which circles are fitted."""

FEW_POINTS, MOST_POINTS = 2_500, 12_000
"""Numbers of points used to search for the axis, and to compute it."""

APART = 0.0012
"""Least distance at which two surfaces are distinguished [m]."""

ROUND = 0.0006
"""A vessel is round if its radius varies around it by less than this [m], or by less than its points scatter."""

LEAST_DEVIATION = 5e-5
"""Least standard deviation of a scanner [m]."""

FOOT = 0.06
"""Fraction of the height in which a floor, a foot or a rim is excluded from the circles."""


@dataclass(frozen=True)
class Layer:
    """Points of one height.

    Attributes:
        z: mean height [m].
        inner, outer: radius of each surface; None for an inner one that was not measured [m].
        scatter: standard deviation of the points about it [m].
        count: of points.
    """

    z: float
    inner: float | None
    outer: float
    scatter: float
    count: int


@dataclass(frozen=True)
class Scan:
    """Points about their axis.

    Attributes:
        points: z up, x = y = 0 on the axis, underside at z = 0, shape (n, 3) [m].
        height: from the underside to the rim [m].
        layers: from below.
        scatter: of the points about the surface of revolution, median over the layers [m].
        out_of_round: standard deviation of the radius around the vessel [m].
        both: whether the inner surface was measured, too, and not only the outer one.
    """

    points: Floats
    height: float
    layers: tuple[Layer, ...]
    scatter: float
    out_of_round: float
    both: bool

    @property
    def round(self) -> bool:
        """Whether it counts as a surface of revolution."""
        return self.out_of_round <= max(ROUND, 0.5 * self.scatter)


def scan_of(points: Floats) -> Scan:
    """Find the axis and the surfaces of a cloud of points.

    Args:
        points: z up, shape (n, 3) [m].

    Raises:
        VesselError: too few points, or no axis.
    """
    from scipy.optimize import minimize

    if len(points) < LEAST_POINTS:
        raise VesselError(f"{len(points)} points; a vessel needs at least {LEAST_POINTS}")
    if not np.isfinite(points).all():
        raise VesselError("some points are not finite numbers")
    centred = points - [*(points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2.0, points[:, 2].min()]
    chosen = centred[np.random.default_rng(0).permutation(len(centred))[:MOST_POINTS]]
    few = chosen[:FEW_POINTS]
    size = float(np.ptp(centred, axis=0).max())
    extent = float(np.hypot(chosen[:, 0], chosen[:, 1]).max())

    def spread(values: Floats, of: Floats) -> float:
        """Mean scatter of the layers' radii relative to the size, after a shift and a lean."""
        return _scatter(_moved(of, values, size)) / size

    def sought(start: Any, of: Floats, step: float) -> Any:
        simplex = np.vstack([start, np.asarray(start) + step * np.eye(4)])
        options: Any = {"xatol": 1e-5, "fatol": 1e-8, "initial_simplex": simplex}
        return minimize(spread, start, args=(of,), method="Nelder-Mead", options=options)

    # the axis of a cloud from one side is behind it, so start at several positions
    aside = 0.5 * extent / size
    begins = ((0.0, 0.0), (-aside, 0.0), (aside, 0.0), (0.0, -aside), (0.0, aside))
    tried = sorted((sought((x, y, 0.0, 0.0), few, 0.04) for x, y in begins), key=lambda each: float(each.fun))
    polished = min((sought(each.x, chosen, 0.01) for each in tried[:2]), key=lambda each: float(each.fun))
    moved = _moved(centred, polished.x, size)
    low, high = _ends(moved, min(float(polished.fun) * size, ROUND))
    moved = moved[(moved[:, 2] >= low - 0.1 * (high - low)) & (moved[:, 2] <= high + 0.1 * (high - low))]
    moved[:, 2] -= low
    layers, both = _layers(moved)
    if len(layers) < LAYERS // 4:
        raise VesselError("the points don't lie around an axis; is the vessel upright in them, and alone?")
    if len(layers) < 0.75 * LAYERS and both:
        raise VesselError(
            f"inner and outer surface can be told apart at only {len(layers)} of {LAYERS} heights: cut a handle away, "
            "or give the points of one surface"
        )
    scatter = float(np.median([layer.scatter for layer in layers]))
    return Scan(moved, high - low, tuple(layers), scatter, _out_of_round(moved, layers), both)


def _moved(points: Floats, values: Floats, size: float) -> Floats:
    """Shifted by values[:2] and tilted by values[2:], both small; [size] and [rad]."""
    x, y, lean_x, lean_y = values
    axis = np.array([lean_x, lean_y, 1.0]) / np.sqrt(1.0 + lean_x**2 + lean_y**2)
    first = np.cross([0.0, 1.0, 0.0], axis)
    first /= np.linalg.norm(first)
    moved: Floats = (points - [x * size, y * size, 0.0]) @ np.column_stack([first, np.cross(axis, first), axis])
    return moved


def _ends(points: Floats, scatter: float) -> tuple[float, float]:
    """Heights of the underside and of the rim [m]. The outermost points themselves are the least accurate.

    Args:
        points: about their axis.
        scatter: of a point, standard deviation [m].
    """
    ends = []
    for z in (points[:, 2], -points[:, 2]):
        first, second = np.quantile(z, [0.01, 0.02])
        flat = second - first < scatter  # many points at one height: these are the tail of a plane's distribution
        ends.append(float(2.0 * first - second + (1.7 * scatter if flat else 0.0)))
    return ends[0], -ends[1]


def _slices(points: Floats) -> list[Floats]:
    ordered = points[np.argsort(points[:, 2])]
    edges = _edges(ordered[0, 2], ordered[-1, 2])
    return np.split(ordered, np.searchsorted(ordered[:, 2], edges))[1:-1]


def _edges(low: float, high: float) -> Floats:
    """Heights between the layers of points from `low` to `high`, shape (LAYERS + 1,) [m]."""
    margin = FOOT * (high - low)
    return np.linspace(low + margin, high - 0.5 * margin, LAYERS + 1)


def _scatter(points: Floats) -> float:
    """Mean standard deviation of the layers' radii, each of one or of two surfaces [m]; for layers of at least six
    points.

    If the radii of a layer have a wide gap with enough of them on both sides, they are split at the widest one.
    """
    z, radii = points[:, 2], np.hypot(points[:, 0], points[:, 1])
    layer = np.searchsorted(_edges(z.min(), z.max()), z, side="right") - 1
    layer[(layer < 0) | (layer >= LAYERS)] = LAYERS
    counts = np.bincount(layer, minlength=LAYERS + 1)
    counts[LAYERS] = 0
    used = counts[layer] >= 6
    if not used.any():
        return float("inf")
    wide = 2.0 * radii.max()  # one sort for both: layers, and the radii in each
    both = np.sort(wide * layer[used] + radii[used])
    layer = np.repeat(np.arange(LAYERS + 1), np.where(counts >= 6, counts, 0))
    radii = both - wide * layer
    starts = np.flatnonzero(np.diff(layer, prepend=-1))
    sizes = np.diff(starts, append=len(layer))
    index = np.repeat(np.arange(len(starts)), sizes)
    place, least = np.arange(len(layer)) - starts[index], np.maximum(sizes // 8, 3)[index]
    # a gap belongs to the point below it
    may_cut = (place >= least - 1) & (place < sizes[index] - least)
    gaps = np.where(may_cut, np.diff(radii, append=np.inf), 0.0)
    widest = np.maximum.reduceat(gaps, starts)
    first = np.minimum.reduceat(np.where(gaps == widest[index], place, len(layer)), starts)
    bin_index = 2 * index + ((widest >= APART)[index] & (place > first[index]))
    number = np.bincount(bin_index)
    means = np.bincount(bin_index, radii) / np.maximum(number, 1)
    squares = np.bincount(bin_index, (radii - means[bin_index]) ** 2)
    return float(np.sqrt(squares * number).sum()) / len(points)


def surfaces(radii: Floats) -> list[Floats]:
    """The radii of one or of two surfaces, from inside; radii farther out, or of few points, belong to a handle."""
    ordered = np.sort(radii)
    parts = np.split(ordered, 1 + np.flatnonzero(np.diff(ordered) > APART))
    return [surface for surface in parts if len(surface) >= max(len(ordered) // 8, 3)][:2] or [ordered]


def _layers(points: Floats) -> tuple[list[Layer], bool]:
    layers: list[Layer] = []
    slices = [
        (points_of_slice, surfaces(np.hypot(points_of_slice[:, 0], points_of_slice[:, 1])))
        for points_of_slice in _slices(points)
        if len(points_of_slice) >= 6
    ]
    twice = sum(len(parts) == 2 for _, parts in slices) > len(slices) // 2
    for points_of_slice, parts in slices:
        if twice and len(parts) < 2:
            continue
        radii = [float(np.median(each)) for each in parts]
        if not twice:
            radii = radii[:1]
        scatter = float(np.median([1.4826 * np.median(np.abs(each - np.median(each))) for each in parts]))
        inner = radii[0] if twice else None
        layers.append(Layer(float(points_of_slice[:, 2].mean()), inner, radii[-1], scatter, len(points_of_slice)))
    return layers, twice


def _out_of_round(points: Floats, layers: list[Layer]) -> float:
    """Standard deviation of the radius around the vessel, without the part due to the points' own scatter [m]."""
    z = np.array([layer.z for layer in layers])
    r = np.array([layer.outer for layer in layers])
    inside = (points[:, 2] >= z[0]) & (points[:, 2] <= z[-1])
    radius = np.hypot(points[inside, 0], points[inside, 1])
    offset = radius - np.interp(points[inside, 2], z, r)
    near = np.abs(offset) < max(6.0 * float(np.median([layer.scatter for layer in layers])), 0.1 * r.mean())
    if all(layer.inner is not None for layer in layers):
        walls = np.interp(points[inside, 2], z, [layer.outer - (layer.inner or 0.0) for layer in layers])
        near = np.abs(offset) < walls / 2.0
    angle = np.arctan2(points[inside, 1], points[inside, 0])[near]
    place = np.floor((angle + np.pi) / (2.0 * np.pi) * 24.0).astype(int) % 24
    means, errors = [], []
    for sector in range(24):
        offsets_of_sector = offset[near][place == sector]
        if len(offsets_of_sector) >= 12:
            means.append(float(offsets_of_sector.mean()))
            errors.append(float(offsets_of_sector.var()) / len(offsets_of_sector))
    return float(np.sqrt(max(float(np.var(means) - np.mean(errors)), 0.0))) if len(means) >= 4 else 0.0


def radii_of(scan: Scan, wall: float, floor: float) -> Radii:
    """The inner profile according to a round scan; for an outer surface the wall is subtracted normal to it.

    Args:
        wall, floor: thickness [m]. If the inner surface was measured, the wall is not needed.
    """
    z = np.array([layer.z for layer in scan.layers])
    if not scan.both:
        outer = np.array([layer.outer for layer in scan.layers], dtype=float)
        slope = np.gradient(outer, z)
        inner = outer - wall * np.sqrt(1.0 + np.clip(slope, -3.0, 3.0) ** 2)
    else:
        inner = np.array([layer.inner for layer in scan.layers], dtype=float)
    counts: Floats = np.array([layer.count for layer in scan.layers], dtype=float)
    scatter = np.array([layer.scatter for layer in scan.layers])
    deviations = np.hypot(scatter / np.sqrt(counts), max(LEAST_DEVIATION, 0.3 * scan.out_of_round))
    usable = (z >= floor) & (inner > 0.0)
    return Radii("points", z[usable] - floor, inner[usable], deviations[usable])


def wall_between(scan: Scan) -> float | None:
    """Thickness of the wall if both surfaces were measured: median over the layers [m]."""
    both = [layer.outer - layer.inner for layer in scan.layers if layer.inner is not None]
    return float(np.median(both)) if both else None


Integers = NDArray[np.int64]

MOST_DIRECTIONS, LEAST_DIRECTIONS = 48, 16
"""Number of directions in which the radius is given; there are two thirds as many heights."""

IN_A_CELL = 20
"""Desired number of points for each direction and height."""


def mesh_of(scan: Scan, wall: float | None, floor: float | None) -> tuple[Floats, Integers]:
    """A closed mesh of a vessel that is not round.

    Args:
        wall: thickness [m]; None: the measured distance of the two surfaces.
        floor: thickness [m]; None: as the wall.

    Returns:
        Vertices (V, 3) [m] and faces (F, 3), normals outwards; the inner floor at z = 0.

    Raises:
        VesselError: more than a quarter of its surface was not measured, or the wall's thickness is unknown.
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
    seen = [len(radii_of_slice) for radii_of_slice in parts if radii_of_slice]
    if len(seen) < 0.75 * len(cells):
        raise VesselError(
            f"only {len(seen) / len(cells):.0%} of the surface was seen, and the vessel is not round: scan it from all "
            "sides"
        )
    both = float(np.mean([count == 2 for count in seen])) > 0.5
    if both and wall is None:
        wall = float(
            np.median(
                [
                    np.median(radii_of_slice[1]) - np.median(radii_of_slice[0])
                    for radii_of_slice in parts
                    if len(radii_of_slice) == 2
                ]
            )
        )
    if wall is None:
        raise VesselError(
            "the points are of one surface: how thick is the wall? Say it with --wall, such as --wall 3mm"
        )
    grid = np.array(
        [np.median(radii_of_slice[0]) if len(radii_of_slice) == 1 + both else np.nan for radii_of_slice in parts]
    )
    inner = _whole(grid.reshape(rows, directions)) - (0.0 if both else wall)
    below = wall if floor is None else floor
    levels = np.linspace(0.0, scan.height - below, rows)
    return _between(inner, inner + wall, levels, below)


def _whole(grid: Floats) -> Floats:
    """A surface over heights and directions with its gaps (NaN) filled, slightly smoothed."""
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
