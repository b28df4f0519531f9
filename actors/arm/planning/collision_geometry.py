"""Collision geometry: the pourer's outermost points, its distance from the receiver, and links as capsules."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from actors.arm.planning.kinematics import cell_transforms
from actors.arm.planning.trajectory import SampledPath
from sim_engine.collision import clearance, thinned, way_of
from sim_engine.vessel.distance_grid import MARGIN
from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

COARSE, FINE = 10e-3, 2e-3
"""Largest displacement of any point of the pourer between two checked poses, far from and near to the receiver [m]."""

_hulls: WeakKeyDictionary[Vessel, FloatArray] = WeakKeyDictionary()


def hull(vessel: Vessel) -> FloatArray:
    """Corners of a vessel's convex hull, shape (V, 3) [m]: no point of the vessel lies outside."""
    if vessel not in _hulls:
        corners = vessel.solid_vertices
        if vessel.spec.shape.outline() is None:
            from scipy.spatial import ConvexHull  # takes a third of a second to import

            _hulls[vessel] = corners[ConvexHull(corners).vertices]
        else:
            _hulls[vessel] = corners[_outermost_rings(corners)]
    return _hulls[vessel]


def _outermost_rings(corners: FloatArray) -> NDArray[np.bool_]:
    """Which corners (V, 3) of a body of revolution, made of whole rings, are on its convex hull.

    The upper chain of the half section, by Andrew's monotone chain, seen from the axis. Of rings at one height only the
    widest is kept, and no ring that lies within the cone of two others.
    """
    radius, height = np.round(np.hypot(corners[:, 0], corners[:, 1]), 12), corners[:, 2]
    chain: list[tuple[float, float]] = []
    for z in sorted(set(height.tolist())):
        r = float(radius[height == z].max())
        while len(chain) > 1 and _bent_in(chain[-2], chain[-1], (r, z)):
            chain.pop()
        chain.append((r, z))
    outermost = np.zeros(len(corners), dtype=bool)
    for r, z in chain:
        outermost |= (height == z) & (radius == r)
    return outermost


def _bent_in(below: tuple[float, float], middle: tuple[float, float], above: tuple[float, float]) -> bool:
    """Whether a ring (radius, height) is no wider than the cone through one below and one above it."""
    (r0, z0), (r1, z1), (r2, z2) = below, middle, above
    return (r1 - r0) * (z2 - z0) <= (r2 - r0) * (z1 - z0)


@dataclass(frozen=True)
class Nearest:
    """Position of the smallest distance between two objects.

    Attributes:
        distance: [m]; negative if they overlap.
        index: of the path's sample.
        name: of the link, for links.
    """

    distance: float
    index: int
    name: str = ""


def nearest_to_receiver(sampled: SampledPath, until: float, pourer: Vessel, receiver: Vessel) -> Nearest:
    """Smallest distance between the pourer and the receiver.

    Near the receiver, no point of the pourer moves by more than `FINE` between two checked poses. In between, the
    pourer may therefore be nearer by at most half of that.

    Args:
        sampled: the path.
        until: time after which no new poses occur [s].
        pourer, receiver: geometry.
    """
    last = int(np.searchsorted(sampled.times, until + 1e-9))
    poses = sampled.poses[:last]
    way = way_of(poses, pourer)
    coarse = thinned(way, COARSE)
    away = clearance(pourer, receiver, poses[coarse], within=0.5 * COARSE)
    # between two poses that differ by a displacement w, no point comes nearer than the nearer pose's distance − w/2
    least = np.minimum(away[:-1], away[1:]) - 0.5 * np.diff(way[coarse])
    # beyond the range of a vessel's grid only a lower bound of the distance is known
    lower_bounds = least - np.maximum(np.minimum(away[:-1], away[1:]) - MARGIN, 0.0)
    doubtful = (lower_bounds < sampled.spec.limits.clearance) | (least < float(away.min()))
    dense = thinned(way, FINE)
    gap = np.clip(np.searchsorted(coarse, dense, side="right") - 1, 0, len(doubtful) - 1)
    fine = dense[doubtful[gap]]
    indices = np.concatenate([coarse, fine])
    away = np.concatenate([away, clearance(pourer, receiver, poses[fine], within=FINE)])
    best = int(np.argmin(away))
    return Nearest(float(away[best]) - _pourer_error(sampled, pourer), int(indices[best]))


def _pourer_error(sampled: SampledPath, pourer: Vessel) -> float:
    """Largest distance of a calibrated robot's pourer from where it is planned [m], by the driver's own check."""
    place, angle = sampled.model.pose_error
    if place == angle == 0.0:
        return 0.0
    lever = float(np.linalg.norm(cell_transforms(sampled.spec).pourer.apply(hull(pourer)), axis=-1).max())
    return place + angle * lever


def nearest_links(sampled: SampledPath, receiver: Vessel | None) -> tuple[Nearest, Nearest]:
    """Smallest distances of the arm's links from the table, and from the receiver as a cylinder, if there is one."""
    points = sampled.links
    world = cell_transforms(sampled.spec).world.inverse
    table, cup = [], []
    along = np.linspace(0.0, 1.0, 13)[:, None]
    for link in sampled.model.links:
        name, radius = link.name, link.radius + sampled.link_error
        a, b = points[:, link.first, None], points[:, link.second, None]
        line = a + (b - a) * along
        above = line[..., 2].min(axis=1) - radius - sampled.spec.cell.table
        table.append(Nearest(float(above.min()), int(np.argmin(above)), name))
        if receiver is None:
            cup.append(Nearest(np.inf, 0, name))
            continue
        inside = world.apply(line.reshape(-1, 3)).reshape(line.shape)
        apart = (from_cylinder(inside, receiver.outer_radius, receiver.rim_height) - radius).min(axis=1)
        cup.append(Nearest(float(apart.min()), int(np.argmin(apart)), name))
    return min(table, key=lambda n: n.distance), min(cup, key=lambda n: n.distance)


def nearest_to_itself(sampled: SampledPath, points: FloatArray) -> tuple[str, Nearest]:
    """Smallest distance of what the arm's end carries from the arm, and its name.

    The carried vessel, as a cylinder, is compared with `ArmModel.body`; links near the flange with `ArmModel.hand`.

    Args:
        sampled: the path.
        points: outermost points of the carried vessel, shape (V, 3) [m].
    """
    radius, height = float(np.hypot(points[:, 0], points[:, 1]).max()), float(points[:, 2].max())
    pose, ends, model = sampled.pourer, sampled.links, sampled.model
    along, coarse = (np.linspace(0.0, 1.0, count)[:, None] for count in (13, 4))
    nearest = []
    for link, others in zip(model.body, model.hand, strict=True):
        a, b = ends[:, link.first, None], ends[:, link.second, None]
        line, thickness = a + (b - a) * along, link.radius + 2.0 * sampled.link_error
        inside = np.einsum("nji,nkj->nki", pose.rotation, line - pose.position[:, None])
        pairs = [("the carried vessel", from_cylinder(inside, radius, height).min(axis=1) - thickness)]
        for other in others:
            c, d = ends[:, other.first, None], ends[:, other.second, None]
            apart = np.linalg.norm(line[:, :, None] - (c + (d - c) * coarse)[:, None], axis=-1)
            pairs.append((f"the {other.name}", apart.min(axis=(1, 2)) - thickness - other.radius))
        nearest += [(thing, Nearest(float(gap.min()), int(np.argmin(gap)), link.name)) for thing, gap in pairs]
    return min(nearest, key=lambda each: each[1].distance)


def from_cylinder(points: FloatArray, radius: float, height: float) -> FloatArray:
    """Distance of points (..., 3) from an upright cylinder on the origin, negative inside, shape (...) [m]."""
    aside = np.hypot(points[..., 0], points[..., 1]) - radius
    over = np.maximum(points[..., 2] - height, -points[..., 2])
    outer: FloatArray = np.hypot(np.maximum(aside, 0.0), np.maximum(over, 0.0))
    return np.where(outer > 0.0, outer, np.maximum(aside, over))
