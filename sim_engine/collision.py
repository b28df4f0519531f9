"""Detects contact between two vessels while the pourer moves, before anything is simulated or moved.

Both solids are sampled on their surfaces, and each sample is looked up in the other's signed distance grid. Samples are
grouped in patches with bounding spheres. A patch whose centre is farther from the other solid than its radius cannot
touch it, so only the few patches near a wall are examined closely. A lip that dips into the other's opening without
touching its wall is not contact.

A motion is sampled along the path of the pourer's points (`poses_along`), not along time: a long hold does not make the
sampling coarser.

Limitations:

- Poses are checked one by one. A contact between two of them may be missed if it is less than half of `WAY` deep.
- Walls are sampled about every half wall thickness. A contact shallower than the samples' spacing on a curved wall may
  be detected late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sim_engine.motion import Motion, PourMotion
from sim_engine.vessel.distance_grid import MARGIN
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]
Part = Literal["rim", "wall", "underside"]

TOLERANCE = 2e-4
"""Overlap that counts as contact: below it is the error of the interpolated distance at sharp edges [m]."""

WAY = 3e-3
"""Largest displacement of any point of the pourer between two checked poses [m]: less than most walls."""

_FIRST_LOOK = 0.02
"""Interval of the first sampling of a motion [s]: no pour moves away and back within that time."""

FEWEST_POINTS, MOST_POINTS = 3_000, 16_000
PATCHES, BATCH = 160, 16


@dataclass(frozen=True)
class Contact:
    """A contact of two vessels.

    Attributes:
        index: of the pose.
        depth: of the deepest sample inside the other's material [m]. A thin wall that has passed completely through
            another reports at most half a wall.
        point: that sample, in the world, shape (3,) [m].
        part: part of the pourer that touches.
    """

    index: int
    depth: float
    point: Floats
    part: Part


@dataclass(frozen=True, eq=False)
class _Samples:
    """Surface samples in patches: points (P, k, 3), their patches' centres (P, 3) and radii (P,) [m]."""

    points: Floats
    centres: Floats
    radii: Floats


_samples: WeakKeyDictionary[Vessel, _Samples] = WeakKeyDictionary()


def _sampled(vessel: Vessel) -> _Samples:
    if vessel not in _samples:
        corners = vessel.solid_vertices[vessel.solid_faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        wanted = area / (0.5 * vessel.wall_thickness) ** 2
        each = math.ceil(float(np.clip(wanted, FEWEST_POINTS, MOST_POINTS)) / PATCHES)
        points = vessel.surface_points(each * PATCHES)
        # slabs along the longest side, then halves of halves along theirs: compact patches of equal size
        groups = points[None]
        for parts in (PATCHES // 32, 2, 2, 2, 2, 2):
            longest = np.argmax(np.ptp(groups, axis=1), axis=1)[:, None, None]
            order = np.argsort(np.take_along_axis(groups, longest, axis=2), axis=1, kind="stable")
            groups = np.take_along_axis(groups, order, axis=1).reshape(-1, groups.shape[1] // parts, 3)
        centres = (groups.min(axis=1) + groups.max(axis=1)) / 2.0
        radii = np.linalg.norm(groups - centres[:, None], axis=2).max(axis=1)
        _samples[vessel] = _Samples(groups, centres, radii)
    return _samples[vessel]


def rotations(poses: Floats) -> Floats:
    """Rotation matrices (T, 3, 3) of poses (T, 7), x y z qw qx qy qz; the quaternions need not be normalised."""
    q = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def way_of(poses: Floats, vessel: Vessel) -> Floats:
    """Upper bound of the displacement of a vessel's points from pose to pose, accumulated.

    Args:
        poses: shape (T, 7), x y z [m] qw qx qy qz.
        vessel: that moves.

    Returns:
        Shape (T,) [m], from 0 on: no point of the vessel moves farther between two poses than the difference. Every
        step is that of the bounding sphere's centre plus that of a point on it which turns about the centre.
    """
    centre, radius = vessel.bounding_sphere
    steps = np.linalg.norm(np.diff(rotations(poses) @ centre + poses[:, :3], axis=0), axis=-1)
    q = poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    # the chord is exact for small angles, where the cosine's arc would lose all of its digits
    chord = np.minimum(np.linalg.norm(q[1:] - q[:-1], axis=1), np.linalg.norm(q[1:] + q[:-1], axis=1))
    steps += 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)) * radius
    return np.concatenate([[0.0], np.cumsum(steps)])


def thinned(way: Floats, step: float = WAY) -> NDArray[np.int64]:
    """Indices of as few samples along a way as possible that are at most `step` apart, or neighbours.

    The first and the last one are included.

    Args:
        way: accumulated displacement at every sample, shape (T,), see `way_of` [m].
        step: [m].
    """
    chosen, last = [0], len(way) - 1
    while chosen[-1] < last:
        here = chosen[-1]
        chosen.append(max(int(np.searchsorted(way, way[here] + step, side="right")) - 1, here + 1))
    return np.array(chosen, dtype=np.int64)


def poses_along(motion: Motion, pourer: Vessel, until: float) -> tuple[Floats, Floats]:
    """A motion's poses, so dense that no point of the pourer moves by more than `WAY` from one to the next.

    Args:
        motion: planned or read back.
        pourer: the moving vessel.
        until: time after which no new poses occur [s].

    Returns:
        Times (T,) [s] and poses (T, 7) x y z [m] qw qx qy qz; they include the first and the last one.
    """
    times = np.linspace(0.0, until, max(math.ceil(until / _FIRST_LOOK), 1) + 1)
    while True:
        poses = motion.sample(times)
        way = way_of(poses, pourer)
        # Finer than needed, so that thinning leaves few samples; a jump is not refined.
        wide = np.flatnonzero((np.diff(way) > 0.2 * WAY) & (np.diff(times) > 1e-9))
        if not wide.size:
            break
        times = np.insert(times, wide + 1, 0.5 * (times[wide] + times[wide + 1]))
    chosen = thinned(way)
    return times[chosen], poses[chosen]


def _check_poses(poses: Floats) -> Floats:
    poses = np.asarray(poses, dtype=float)
    if poses.ndim != 2 or poses.shape[1] != 7 or not np.all(np.isfinite(poses)):
        raise ValueError(f"poses: finite numbers of shape (T, 7), x y z qw qx qy qz, got shape {poses.shape}")
    if len(poses) and np.linalg.norm(poses[:, 3:], axis=1).min() < 1e-6:
        raise ValueError("poses: a quaternion of length 0 is not a rotation")
    return poses


@dataclass(frozen=True, eq=False)
class _Direction:
    """One vessel's samples in the other's frame: p ↦ p·turn[t] + shift[t], with turn (T, 3, 3) and shift (T, 3)."""

    samples: _Samples
    other: Vessel
    turn: Floats
    shift: Floats

    def centre_distances(self) -> Floats:
        """Smallest possible distance of every patch's points from the other solid, shape (T, P) [m]."""
        centres = np.einsum("pi,tij->tpj", self.samples.centres, self.turn) + self.shift[:, None]
        away = self.other.grid.lower_bound(centres.reshape(-1, 3)).reshape(centres.shape[:2])
        # the interpolant may deviate by a part of the spacing, so a patch is excluded only beyond that margin
        return away - self.samples.radii - self.other.grid.spacing

    def nearest(self, pose: int, patches: NDArray[np.int64]) -> tuple[float, Floats]:
        """Smallest signed distance of the patches' samples at a pose [m], and that sample in its own frame (3,)."""
        own = self.samples.points[patches].reshape(-1, 3)
        away = self.other.grid.sample(own @ self.turn[pose] + self.shift[pose])
        best = int(np.argmin(away))
        return float(away[best]), own[best]


def _directions(pourer: Vessel, receiver: Vessel, poses: Floats) -> tuple[_Direction, _Direction, Floats]:
    turn = rotations(poses)
    into_receiver = _Direction(_sampled(pourer), receiver, np.swapaxes(turn, 1, 2), poses[:, :3])
    into_pourer = _Direction(_sampled(receiver), pourer, turn, -np.einsum("ti,tij->tj", poses[:, :3], turn))
    return into_receiver, into_pourer, turn


def _part(vessel: Vessel, point: Floats) -> Part:
    """Part of a vessel that a point of its frame belongs to."""
    if point[2] > vessel.rim_height - 2.0 * vessel.wall_thickness:
        return "rim"
    return "underside" if point[2] < vessel.wall_thickness else "wall"


def first_contact(pourer: Vessel, receiver: Vessel, poses: Floats) -> Contact | None:
    """The first pose at which two vessels touch.

    Args:
        pourer: the moving one.
        receiver: stands upright at the world's origin.
        poses: of the pourer's frame in the world, shape (T, 7), x y z [m] qw qx qy qz; no more than a few millimetres
            apart (see `poses_along`), or a thin wall can pass another undetected.

    Returns:
        The contact, or None when they stay clear of each other.

    Raises:
        ValueError: poses of another shape, or not finite.
    """
    poses = _check_poses(poses)
    reach = pourer.bounding_sphere[1] + receiver.bounding_sphere[1]
    candidates = np.flatnonzero(_centre_gap(pourer, receiver, poses) < reach)
    if not candidates.size:
        return None
    into_receiver, into_pourer, turn = _directions(pourer, receiver, poses[candidates])
    possible = [(d, d.centre_distances() < 0.0) for d in (into_receiver, into_pourer)]
    for row, index in enumerate(candidates):
        contact = None
        for direction, close in possible:
            patches = np.flatnonzero(close[row])
            if not patches.size:
                continue
            away, own = direction.nearest(row, patches)
            if away < -TOLERANCE and (contact is None or away < contact[0]):
                contact = (away, own, direction)
        if contact is not None:
            away, own, direction = contact
            if direction is into_receiver:
                point, in_pourer = turn[row] @ own + poses[index, :3], own
            else:
                point, in_pourer = own, turn[row].T @ (own - poses[index, :3])
            return Contact(int(index), -away, point, _part(pourer, in_pourer))
    return None


def contact_during(
    motion: Motion,
    pourer: Vessel,
    receiver: Vessel,
    *,
    receiver_at: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Contact, float] | None:
    """The first contact of two vessels during a motion.

    Args:
        motion: of the pourer.
        pourer: the moving one.
        receiver: stands upright.
        receiver_at: displacement of the receiver from its intended position [m].

    Returns:
        The contact and the pourer's tilt there [rad]; None when they stay clear of each other.
    """
    # A planned pourer turns about one line and returns through the same poses.
    until = motion.phases[0].end if isinstance(motion, PourMotion) else motion.duration
    times, poses = poses_along(motion, pourer, until)
    poses[:, :3] -= receiver_at
    contact = first_contact(pourer, receiver, poses)
    if contact is None:
        return None
    return contact, float(motion.tilt(times[contact.index : contact.index + 1])[0])


def _centre_gap(pourer: Vessel, receiver: Vessel, poses: Floats) -> Floats:
    """Distance between the bounding spheres' centres, shape (T,) [m]."""
    centre = rotations(poses) @ pourer.bounding_sphere[0] + poses[:, :3]
    gap: Floats = np.linalg.norm(centre - receiver.bounding_sphere[0], axis=1)
    return gap


def clearance(pourer: Vessel, receiver: Vessel, poses: Floats, within: float = math.inf) -> Floats:
    """Smallest distance between two vessels at every pose.

    Args:
        pourer: the moving one.
        receiver: at the world's origin.
        poses: shape (T, 7), see `first_contact`.
        within: distances that exceed both the smallest one and the grids' margin by more than this may be returned too
            small, but by at least this more than the two [m].

    Returns:
        Shape (T,) [m]; negative if they overlap (then the depth as in `Contact`). Accurate to a part of the grids'
        spacing up to their margin (12 mm); farther apart it is an upper estimate, but never less than the margin.

    Raises:
        ValueError: poses of another shape, or not finite.
    """
    poses = _check_poses(poses)
    directions = _directions(pourer, receiver, poses)[:2]
    bounds = [direction.centre_distances() for direction in directions]
    orders = [np.argsort(least, axis=1) for least in bounds]
    bound = np.minimum(*(least.min(axis=1) for least in bounds))
    result = np.empty(len(poses))
    most = np.inf
    for row in np.argsort(bound).tolist():
        nearest = most
        for direction, least, order in zip(directions, bounds, orders, strict=True):
            # nearest patches first, until no other one can be closer
            for start in range(0, PATCHES, BATCH):
                batch = order[row, start : start + BATCH]
                if least[row, batch[0]] >= nearest:
                    break
                nearest = min(nearest, direction.nearest(row, batch)[0])
        result[row] = nearest
        most = min(most, max(nearest, MARGIN) + within)
    return result


def describe_contact(
    contact: Contact, tilt: float | None = None, *, pourer: str = "the pourer", receiver: str = "the receiver"
) -> str:
    """The message about a contact.

    Args:
        contact: from `first_contact`.
        tilt: of the pourer at that pose [rad], if known.
        pourer: its name in the message.
        receiver: its name in the message.

    Returns:
        For instance 'cups touch: at tilt 37° the pourer (its rim, at x = 12 mm, z = 96 mm) enters the receiver by 4.1
        mm'.
    """
    when = "" if tilt is None else f"at tilt {math.degrees(tilt):.0f}° "
    x, _, z = 1e3 * contact.point
    return (
        f"cups touch: {when}{pourer} (its {contact.part}, at x = {x:.0f} mm, z = {z:.0f} mm) enters {receiver} "
        f"by {1e3 * contact.depth:.1f} mm"
    )
