"""The geometry of a vessel for the rest of the simulator: solid, distance grid, cavity, opening and lip.

`build_vessel` makes a `Vessel` from a `VesselSpec`.

Vessel frame: z up along the vessel's axis, the underside at z = 0, x = y = 0 at the centre of the opening.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel import profile as profiles
from sim_engine.vessel.distance_grid import MARGIN, SignedDistanceGrid, choose_spacing
from sim_engine.vessel.mesh_surface import sample_surface
from sim_engine.vessel.shapes import ProfileShape, VesselError, VesselSpec

Floats = NDArray[np.float64]

QUADRATURE_POINTS = 120_000
"""Number of points that `Vessel.cavity_points` aims at."""


LATTICE_TURN = 0.3820
"""Angle between the quadrature's rows and a mesh's axes, not close to a simple fraction of a right angle [rad]."""


@dataclass(frozen=True, eq=False)
class Vessel:
    """One vessel, ready for the solver. Build it with `sim_engine.vessel.vessel.build_vessel`.

    Attributes:
        spec: the specification from which it was built.
        solid_vertices: of the closed surface of the solid, shape (V, 3) [m].
        solid_faces: triangles of it, normals outwards, shape (F, 3).
        grid: signed distance to the solid and the cavity's mask.
        inner_floor: lowest z of the cavity [m].
        rim_height: z of the lip's lowest point [m].
        opening_radius: radius of the largest circle that fits the opening [m].
        outer_radius: largest distance of solid material from the axis [m].
        capacity: volume of the cavity below the rim, upright [m³].
        wall_thickness: smallest thickness of the solid [m].
        meridians: curves on the cavity's surface from its bottom to the lip's crest, in half planes through the axis at
            equal angles from +x, shape (directions, points, 3) [m]. Leaving liquid crosses one of them.
        warnings: what makes its shape doubtful, such as a body in its cavity.
    """

    spec: VesselSpec
    solid_vertices: Floats
    solid_faces: NDArray[np.int64]
    grid: SignedDistanceGrid
    inner_floor: float
    rim_height: float
    opening_radius: float
    outer_radius: float
    capacity: float
    wall_thickness: float
    meridians: Floats
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name from the spec."""
        return self.spec.name

    def lip_point(self, direction: float = 0.0) -> Floats:
        """The inner lip's point in a horizontal direction, at which liquid leaves if the vessel tips that way.

        Args:
            direction: angle from +x in the xy plane [rad].

        Returns:
            Shape (3,) [m]. Between the stored directions it is interpolated in angle, radius and height.
        """
        crest = self.meridians[:, -1]
        place = (direction / (2.0 * np.pi)) % 1.0 * len(crest)
        first = int(place) % len(crest)
        second = (first + 1) % len(crest)
        fraction = place - int(place)
        radius = np.hypot(crest[:, 0], crest[:, 1])
        r = (1.0 - fraction) * radius[first] + fraction * radius[second]
        z = (1.0 - fraction) * crest[first, 2] + fraction * crest[second, 2]
        return np.array([r * np.cos(direction), r * np.sin(direction), z])

    def width_at(self, height: float) -> float:
        """Width of the solid at a height: twice its largest distance from the axis there [m].

        Args:
            height: above the underside [m].

        Returns:
            0 if there is no solid at this height.
        """
        corners = self.solid_vertices[self.solid_faces]  # (F, 3, 3)
        widest = 0.0
        for a, b in ((0, 1), (1, 2), (2, 0)):
            start, end = corners[:, a], corners[:, b]
            low, high = start[:, 2] - height, end[:, 2] - height
            cut = low * high <= 0.0
            if not cut.any():
                continue
            start, end, low, high = start[cut], end[cut], low[cut], high[cut]
            fraction = np.where(low == high, 0.0, low / np.where(low == high, 1.0, low - high))[:, None]
            points = start + fraction * (end - start)
            widest = max(widest, float(np.hypot(points[:, 0], points[:, 1]).max()))
        return 2.0 * widest

    def surface_points(self, count: int) -> Floats:
        """Points on the solid's surface for contact checks: a third on its sharp edges, the others even by area.

        Args:
            count: number of points, at least 10.

        Returns:
            Shape (count, 3) [m]; the same points at every call.
        """
        return sample_surface(self.solid_vertices, self.solid_faces, count)

    @cached_property
    def bounding_sphere(self) -> tuple[Floats, float]:
        """Centre (3,) and radius of a sphere around the solid [m]."""
        low, high = self.solid_vertices.min(axis=0), self.solid_vertices.max(axis=0)
        centre = (low + high) / 2.0
        return centre, float(np.linalg.norm(self.solid_vertices - centre, axis=1).max())

    @cached_property
    def asymmetry(self) -> float:
        """How far the shape is from its mirror image in the plane of the tilt, y = 0: the largest difference of the
        signed distances of points near its surface and of their images [m]; 0 for a surface of revolution."""
        if self.spec.shape.outline() is not None:
            return 0.0
        grid = self.grid
        nodes = np.argwhere(np.abs(grid.values) < 2.0 * grid.spacing)
        points = grid.origin + grid.spacing * nodes
        return float(np.abs(grid.sample(points) - grid.sample(points * np.array([1.0, -1.0, 1.0]))).max())

    def cavity_points(self) -> tuple[Floats, float]:
        """Midpoint quadrature of the cavity below the rim, upright.

        The lattice is cubic, except for a stretch in z that puts the floor's and the rim's planes between its layers.

        Returns:
            Points, shape (M, 3) [m], and the volume of each [m³]; their sum is the capacity.
        """
        return self._quadrature

    @cached_property
    def _quadrature(self) -> tuple[Floats, float]:
        points, _ = lattice(self.spec, self.grid, self.inner_floor, self.rim_height, QUADRATURE_POINTS)
        return points, self.capacity / len(points)


def lattice(
    spec: VesselSpec, grid: SignedDistanceGrid, inner_floor: float, rim_height: float, count: int
) -> tuple[Floats, float]:
    """Lattice points inside a cavity.

    Args:
        spec: for surfaces of revolution, whose cavity is known exactly.
        grid: for the others.
        inner_floor: [m].
        rim_height: [m].
        count: approximate number of points.

    Returns:
        Points, shape (M, 3) [m], and the volume of one lattice cell [m³].
    """
    nodes = np.argwhere(grid.cavity)
    if len(nodes) == 0:
        raise VesselError(f"{spec.name} has no cavity of at least {1e3 * grid.spacing:.2g} mm")
    low = grid.origin + grid.spacing * (nodes.min(axis=0) - 1)
    high = grid.origin + grid.spacing * (nodes.max(axis=0) + 1)
    step = float(np.cbrt(len(nodes) * grid.spacing**3 / count))
    layers = max(1, round((rim_height - inner_floor) / step))
    thickness = (rim_height - inner_floor) / layers
    z = np.asarray(inner_floor + (np.arange(layers) + 0.5) * thickness, dtype=np.float64)
    half = np.ceil(np.abs([low[:2], high[:2]]).max(axis=0) / step) + 1.0
    x, y = ((np.arange(-n, n) + 0.5) * step for n in half)
    outline = spec.shape.outline()
    if outline is not None:
        inner = np.array(outline.inner) + np.array([0.0, inner_floor])
        polygon = np.vstack([inner, [0.0, inner[-1, 1]]])
        inside = profiles.contains(polygon, np.hypot(x[:, None], y)[..., None], z)
        i, j, k = np.nonzero(inside)
        return np.column_stack([x[i], y[j], z[k]]), step * step * thickness
    # turned about z, so that no row of points runs along a flat wall and enters or leaves the cavity as a whole
    reach = np.hypot(half[0], half[1])
    steps = (np.arange(-np.ceil(reach), np.ceil(reach)) + 0.5) * step
    grid_points = np.stack(np.meshgrid(steps, steps, z, indexing="ij"), axis=-1).reshape(-1, 3)
    cos, sin = np.cos(LATTICE_TURN), np.sin(LATTICE_TURN)
    grid_points[:, :2] = grid_points[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    grid_points = grid_points[np.all((grid_points >= low) & (grid_points <= high), axis=1)]
    return grid_points[in_cavity(grid, grid_points)], step * step * thickness


def in_cavity(grid: SignedDistanceGrid, points: Floats) -> NDArray[np.bool_]:
    """Whether free points belong to the cavity, rather than to the outside or the solid.

    A point counts if the node next to it does. Close to a wall that node may be in solid; then the point counts if the
    node next to it along the wall's normal does.

    Args:
        grid: of the vessel.
        points: shape (N, 3) [m].

    Returns:
        Shape (N,).
    """
    free = grid.sample(points) > 0.0
    away = grid.gradient(points)
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    top = int(np.flatnonzero(grid.cavity.any(axis=(0, 1)))[-1])
    result = np.zeros(len(points), dtype=bool)
    for shift in (0.0, 0.75 * grid.spacing):
        index = np.rint((points + shift * away - grid.origin) / grid.spacing).astype(np.int64)
        index[:, 2] = np.minimum(index[:, 2], top)
        index = np.clip(index, 0, np.array(grid.shape) - 1)
        result |= grid.cavity[index[:, 0], index[:, 1], index[:, 2]].astype(bool)
    return free & result


def check_holds(vessel: Vessel, volume: float) -> None:
    """Refuse a load that the vessel cannot hold.

    Args:
        vessel: the pourer, or the receiver of all of it.
        volume: of the liquid [m³].

    Raises:
        VesselError: it would overflow.
    """
    if volume > vessel.capacity:
        raise VesselError(
            f"{vessel.name} holds {1e6 * vessel.capacity:.4g} mL to the brim, {1e6 * volume:.4g} mL asked for"
        )


DIRECTIONS = 72
"""Half planes in which a vessel's meridians are stored."""


def build_vessel(spec: VesselSpec, *, use_cache: bool = True) -> Vessel:
    """Build a vessel from its shape.

    Args:
        spec: the vessel's name and shape.
        use_cache: keep a mesh's distance grid in the cache directory, and read it from there for a known mesh. Profiles
            are fast and are always computed.

    Returns:
        The vessel in its own frame (z up, underside at z = 0, opening centred on the axis).

    Raises:
        VesselError: the shape is not a vessel; the message gives the reason and the remedy.
        OSError: one of its files cannot be read.
    """
    outline = spec.shape.outline()
    if outline is not None:
        return _build_profile(spec, outline)
    vessel = spec.shape.build(spec, use_cache=use_cache)
    if not isinstance(vessel, Vessel):
        raise TypeError(f"'{spec.shape.kind}' should build a Vessel, not {type(vessel).__name__}")
    return vessel


def _build_profile(spec: VesselSpec, shape: ProfileShape) -> Vessel:
    inner = profiles.check_profile(shape)
    outer = profiles.outer_profile(inner, shape.wall, shape.floor)
    up = np.array([0.0, shape.floor])
    inner, outer = inner + up, outer + up
    polygon = profiles.solid_polygon(inner, outer)
    vertices, faces = profiles.revolve(polygon)
    rim = float(inner[-1, 1])
    widest = float(outer[:, 0].max())
    wall = min(shape.wall, shape.floor)
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    meridians = np.stack(
        [
            inner[:, 0] * np.cos(angle)[:, None],
            inner[:, 0] * np.sin(angle)[:, None],
            np.broadcast_to(inner[:, 1], (DIRECTIONS, len(inner))),
        ],
        axis=-1,
    )
    return Vessel(
        spec=spec,
        solid_vertices=vertices,
        solid_faces=faces,
        grid=_profile_grid(polygon, inner, choose_spacing(np.array([2 * widest, 2 * widest, rim]), wall)),
        inner_floor=shape.floor,
        rim_height=rim,
        opening_radius=float(inner[-1, 0]),
        outer_radius=widest,
        capacity=profiles.volume(inner),
        wall_thickness=wall,
        meridians=meridians,
    )


def _profile_grid(polygon: Floats, inner: Floats, spacing: float) -> SignedDistanceGrid:
    """Exact distances at the nodes of a grid that is symmetric about the axis.

    Nodes at the same radius share their distance, so it is computed once for every radius that occurs.
    """
    half = int(np.ceil((polygon[:, 0].max() + MARGIN) / spacing))
    steps = np.arange(-half, half + 1)
    below = int(np.ceil(MARGIN / spacing))
    layers = below + int(np.ceil((polygon[:, 1].max() + MARGIN) / spacing)) + 1
    z = np.asarray((np.arange(layers) - below) * spacing, dtype=np.float64)
    squares, place = np.unique(steps[:, None] ** 2 + steps**2, return_inverse=True)
    r = np.sqrt(squares)[:, None] * spacing
    values = profiles.distance(polygon, r, z).astype(np.float32)
    closed = np.vstack([inner, [0.0, inner[-1, 1]]])
    cavity = (profiles.contains(closed, r, np.broadcast_to(z, values.shape)) & (values > 0.0)).astype(np.uint8)
    shape = (len(steps), len(steps), layers)
    origin = np.array([-half * spacing, -half * spacing, -below * spacing])
    place = place.reshape(-1)
    return SignedDistanceGrid(origin, spacing, values[place].reshape(shape), cavity[place].reshape(shape))
