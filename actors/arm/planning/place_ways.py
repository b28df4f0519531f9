"""Ways from home to the places where vessels stand, and back: planned, checked, and slow enough for a full vessel.

- `plan_way` plans one way. All ways begin and end at home, so that a laboratory of N places has N ways to check.
- `full_acceleration` is the acceleration at which the liquid of a carried vessel stays below its rim.
- `way_to` and `in_the_way` serve the ways and the pours of a laboratory.
- `Standing` is a vessel that may stand at another place; `standing_problems` checks a path against it.
- `place_problems` checks the places of a laboratory before anything starts.

A vessel is carried upright, along straight lines: first to above the place, then straight down.

Limitations: standing vessels count as cylinders, links of the arm as capsules with rough radii.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import JointArmSettings
from actors.arm.planned_pour import JointPath, PlaceWay, PourPath
from actors.arm.planning.collision_geometry import from_cylinder, hull
from actors.arm.planning.kinematics import Transforms, cell_transforms, flange_poses, quaternions, transform_of
from actors.arm.planning.path_checks import UPRIGHT, check_way_limits, outside
from actors.arm.planning.trajectory import (
    TOOL_ACCELERATION,
    TOOL_SPEED,
    OutOfReachError,
    RacingJointError,
    SampledPath,
    home_pose,
    routes,
    travel,
)
from actors.interfaces import InvalidActionError
from actors.places import PlaceSettings
from sim_engine.hydrostatics import GRAVITY, level
from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

FULL_SPEED = 0.15
"""Speed at which a vessel with liquid is carried [m/s]; an empty gripper or vessel moves at `TOOL_SPEED`."""

SWINGS = 4.0
"""Largest amplification of the surface's lean while a vessel is carried along one straight line. The liquid counts as
an undamped oscillator. Each of the four steps in acceleration (begin and end of speeding up and of braking) then adds
at most the static lean a/g to its amplitude. Source: the equivalent pendulum of lateral sloshing, Ibrahim, Liquid
Sloshing Dynamics, Cambridge 2005, chapter 5, without its damping."""

LEAST_ACCELERATION = 0.05
"""Acceleration below which a vessel is too full to be carried [m/s²]."""

FINGER = 15e-3
"""Thickness of a finger outside the vessel that it grips [m]."""

OFF_CENTRE = 5e-3
"""Largest distance of the place on the balance from `cell.receiver` [m]."""


@dataclass(frozen=True)
class Standing:
    """A vessel that may stand somewhere, as a cylinder.

    Attributes:
        place: name of the place.
        foot: middle of its underside in the room's frame [m].
        radius, height: [m]; 0 without a vessel.
        clearance: gap to keep from it [m].
    """

    place: str
    foot: tuple[float, float, float]
    radius: float
    height: float
    clearance: float


def full_acceleration(vessel: Vessel, volume: float) -> float:
    """Acceleration at which a carried liquid stays below the rim [m/s²]: the surface rises by `SWINGS` · R · a / g.

    Args:
        vessel: that holds it.
        volume: of the liquid [m³].
    """
    # `level` counts points, so that near the rim the free volume over the opening is more exact
    free = (vessel.capacity - volume) / (math.pi * vessel.opening_radius**2)
    freeboard = max(min(-level(vessel, volume, 0.0), free), 0.0)
    return min(TOOL_ACCELERATION, GRAVITY * freeboard / (SWINGS * vessel.opening_radius))


def vessel_at(place: PlaceSettings, spec: JointArmSettings) -> Transforms:
    """Frame of a vessel that stands at a place, in the room's frame."""
    return cell_transforms(spec).base @ transform_of(place.pose) @ transform_of(spec.grip)


def standing_at(place: PlaceSettings, vessels: Mapping[str, Vessel], spec: JointArmSettings) -> Standing:
    """The largest of the vessels that may stand at a place."""
    standing = [vessels[role] for role in place.holds if role in vessels]
    x, y, z = map(float, vessel_at(place, spec).position)
    radius, height = (max((getattr(v, name) for v in standing), default=0.0) for name in ("outer_radius", "rim_height"))
    return Standing(place.name, (x, y, z), radius, height, place.clearance)


@functools.lru_cache(maxsize=512)
def plan_way(
    place: PlaceSettings,
    spec: JointArmSettings,
    carried: tuple[Vessel, ...],
    others: tuple[Standing, ...],
    fastest: float = TOOL_SPEED,
    hardest: float = TOOL_ACCELERATION,
) -> PlaceWay:
    """Plan and check the way from home to a place; it is kept, since a rack has many that are checked repeatedly.

    Args:
        place: where it ends.
        spec: of the arm and its cell.
        carried: vessels that may be in the gripper on this way.
        others: what may stand at other places.
        fastest: speed of the tool [m/s].
        hardest: its acceleration [m/s²].

    Raises:
        InvalidActionError: the way is forbidden or impossible; the text lists all problems of the best route.
    """
    at = cell_transforms(spec).world.inverse @ vessel_at(place, spec)
    end = np.concatenate([at.position, quaternions(at.rotation[None])[0]])
    start = home_pose(spec)
    if float(np.dot(start[3:], end[3:])) < 0.0:  # the shorter turn
        end[3:] *= -1.0
    above = end.copy()
    above[2] += place.approach
    floor = spec.cell.receiver.vector[2]
    over = max((each.foot[2] - floor + each.height + each.clearance for each in others), default=0.0) + 0.01
    points = np.concatenate([hull(vessel) for vessel in carried]) if carried else np.zeros((1, 3))
    best: tuple[JointPath, list[str]] | None = None
    way_problems: list[str] = []
    for knots in routes(start, above, over):
        try:
            path = travel([*knots, end], np.array(spec.home_joints), spec, fastest, hardest)
        except OutOfReachError as error:
            way_problems = [_unreached(error, spec)]
            continue
        except RacingJointError:
            way_problems = [
                "on a straight way from home two joints would turn about one axis and race; teach another pose"
            ]
            continue
        sampled = SampledPath.of("way", path, spec)
        way_problems = [*check_way_limits(sampled, points), *standing_problems(sampled, points, others, own=place.name)]
        if best is None or len(way_problems) < len(best[1]):
            best = (path, way_problems)
        if not way_problems:
            break
    if best is None or best[1]:
        problems = way_problems if best is None else best[1]
        raise InvalidActionError(f"place '{place.name}': " + "; ".join(problems))
    return PlaceWay(place.name, best[0], spec.kinematics.checksum)


def way_to(
    place: PlaceSettings,
    places: Sequence[PlaceSettings],
    spec: JointArmSettings,
    vessels: Mapping[str, Vessel],
    volume: float | None,
) -> PlaceWay:
    """The way to a place of a laboratory, among the vessels of a campaign.

    Args:
        place: where it ends.
        places: all places.
        spec: of the arm and its cell.
        vessels: of the campaign.
        volume: largest volume of liquid in a carried vessel [m³]; None for a way on which none is carried.

    Raises:
        InvalidActionError: as `plan_way`; or a vessel is too full to be carried.
    """
    carried = tuple(vessels[role] for role in place.holds if role in vessels)
    standing = [standing_at(each, vessels, spec) for each in places]
    others = tuple(each for each in standing if each.radius > 0.0)
    if volume is None:
        return plan_way(place, spec, carried, others)
    hardest = TOOL_ACCELERATION
    for vessel in carried:
        allowed = 0.0 if volume > vessel.capacity else full_acceleration(vessel, volume)
        hardest = min(hardest, allowed)
        if hardest < LEAST_ACCELERATION:
            raise InvalidActionError(
                f"'{vessel.name}' would be too full to be carried: {1e6 * volume:.0f} ml could swing over its rim"
            )
    return plan_way(place, spec, carried, others, FULL_SPEED, hardest)


def in_the_way(
    path: PourPath,
    pourer: Vessel,
    places: Sequence[PlaceSettings],
    spec: JointArmSettings,
    vessels: Mapping[str, Vessel],
) -> list[str]:
    """Problems of a pour over the balance with vessels that may stand at the other places.

    Args:
        path: of the pour.
        pourer: vessel in the gripper.
        places: all places.
        spec: of the arm and its cell.
        vessels: of the campaign.
    """
    others = [standing_at(each, vessels, spec) for each in places if each.use != "balance"]
    points = hull(pourer)
    parts = (("approach", path.approach, ()), ("pour", path.pour, path.phases))
    return [
        problem
        for name, points_of_part, phases in parts
        for problem in standing_problems(SampledPath.of(name, points_of_part, spec, phases), points, others)
    ]


def _unreached(error: OutOfReachError, spec: JointArmSettings) -> str:
    flange = flange_poses(error.poses, spec)
    _, text = spec.kinematics.out_of_reach(flange.rotation, flange.position, np.array(spec.home_joints))
    return f"{text.partition(';')[0]}, on the way from home in the posture of home"


def standing_problems(
    sampled: SampledPath, points: FloatArray, others: Sequence[Standing], own: str = ""
) -> Iterator[str]:
    """Problems of a path with vessels that may stand at other places.

    Args:
        sampled: the path.
        points: outermost points of the carried vessel, shape (V, 3) [m].
        others: what may stand there.
        own: place where the path ends. The gripper reaches around the vessel there, so that only the links count.
    """
    pose, reach = sampled.pourer, float(np.linalg.norm(points, axis=1).max())
    along = np.linspace(0.0, 1.0, 13)[:, None]
    for each in others:
        near = np.flatnonzero(_distance(pose.position[:, None], each)[:, 0] < reach + each.clearance)
        if each.place != own and near.size:
            world = np.einsum("nij,vj->nvi", pose.rotation[near], points) + pose.position[near, None]
            apart = _distance(world, each).min(axis=1)
            if apart.min() < each.clearance:
                when = sampled.when(int(near[np.argmin(apart)]))
                yield _too_near("the carried vessel", float(apart.min()), each, when)
        for link in sampled.model.links:
            if each.place == own and link in sampled.model.hand[0]:
                continue
            a, b = sampled.links[:, link.first, None], sampled.links[:, link.second, None]
            thick, length = link.radius + sampled.link_error, np.linalg.norm(b - a, axis=-1)
            near = np.flatnonzero((_distance(a, each) - length)[:, 0] < thick + each.clearance)
            if not near.size:
                continue
            apart = _distance(a[near] + (b[near] - a[near]) * along, each).min(axis=1) - thick
            if apart.min() < each.clearance:
                when = sampled.when(int(near[np.argmin(apart)]))
                yield _too_near(f"the {link.name}", float(apart.min()), each, when)
                break


def _distance(points: FloatArray, standing: Standing) -> FloatArray:
    """Distance of points (N, V, 3) in the room from a cylinder, negative inside, shape (N, V) [m]."""
    return from_cylinder(points - np.array(standing.foot), standing.radius, standing.height)


def _too_near(thing: str, apart: float, each: Standing, when: str) -> str:
    how = f"come within {1e3 * apart:.0f} mm of" if apart > 0.0 else "run into"
    return f"{thing} would {how} a vessel at '{each.place}', {when}; {1e3 * each.clearance:.0f} mm have to stay free"


def _gap(distance: float) -> str:
    """A distance between two things [m], which is negative if they would take the same room."""
    return f"{1e3 * distance:.0f} mm apart" if distance >= 0.0 else f"{-1e3 * distance:.0f} mm within each other"


def place_problems(
    places: Sequence[PlaceSettings],
    spec: JointArmSettings,
    vessels: Mapping[str, Vessel],
    opened: Mapping[str, float] = {},
) -> Iterator[tuple[int, str]]:
    """Problems of a laboratory's places: number of the place, and the message.

    Args:
        places: all places.
        spec: of the arm and its cell.
        vessels: of a campaign; without them, only what does not depend on them is checked.
        opened: width of the fingers that are open for each vessel [m]; they keep the clearance of a neighbour in any
            direction.
    """
    standing = [standing_at(place, vessels, spec) for place in places]
    for (j, first), (i, other) in combinations(enumerate(standing), 2):
        apart = math.dist(first.foot[:2], other.foot[:2]) - first.radius - other.radius
        if apart < max(first.clearance, other.clearance):
            yield (
                i,
                f"places '{first.place}' and '{other.place}' overlap: what stands there is {_gap(apart)}, "
                f"{1e3 * max(first.clearance, other.clearance):.0f} mm have to stay free",
            )
            continue
        # a full circle: the fingers of a taught pose may stand in any direction
        reaches = [
            0.5 * width + FINGER + neighbour.radius
            for k, neighbour in ((j, other), (i, first))
            if (width := max((opened.get(name, 0.0) for name in places[k].holds), default=0.0)) and neighbour.radius
        ]
        free = math.dist(first.foot[:2], other.foot[:2]) - max(reaches, default=-math.inf)
        if free < max(first.clearance, other.clearance):
            yield (
                i,
                f"places '{first.place}' and '{other.place}' overlap when the gripper is open: its fingers and the "
                f"neighbour are {_gap(free)}, {1e3 * max(first.clearance, other.clearance):.0f} mm have to stay free",
            )
    for i, (place, foot) in enumerate(zip(places, standing, strict=True)):
        axis = vessel_at(place, spec).rotation[:, 2]
        lean = math.acos(float(np.clip(axis[2], -1.0, 1.0)))
        if lean > UPRIGHT:
            yield i, f"a vessel at '{place.name}' would lean by {math.degrees(lean):.1f} deg; teach it upright"
            continue
        if place.use == "balance" and (off := math.dist(foot.foot, spec.cell.receiver.vector)) > OFF_CENTRE:
            yield (
                i,
                f"place '{place.name}' is on the balance, and {1e3 * off:.0f} mm away from cell.receiver, where pours "
                "end; teach it again, or correct cell.receiver",
            )
        if texts := outside(np.array(foot.foot), spec):
            yield i, f"the foot of a vessel at '{place.name}' is {', '.join(texts)}"
            continue
        if place.use == "waste":
            continue
        carried = tuple(vessels[role] for role in place.holds if role in vessels)
        try:
            plan_way(place, spec, carried, tuple(each for each in standing if each.radius > 0.0))
        except InvalidActionError as error:
            yield i, str(error)
