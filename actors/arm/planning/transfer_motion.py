"""Transfer motions of a full, upright pourer along straight lines, and joints that follow poses in one posture."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_settings import UrArmSettings
from actors.arm.planned_pour import JointPath
from actors.arm.planning.frames import between, cell_transforms, flange_poses, pourer_transforms, quaternions
from actors.arm.planning.kinematics import MODELS, inverse, posture
from actors.arm.planning.trajectory import trapezoid

FloatArray = NDArray[np.float64]

TOOL_ACCELERATION = 0.5
"""Acceleration of a pourer that is carried [m/s²]. Its liquid leans by 3 deg, and twice as far while it swings."""

TOOL_SPEED = 0.4
"""Speed of a pourer that is carried [m/s], if the limits allow it."""

STEP = 0.02
"""Time between two waypoints [s]."""


MOST_TURNS = 3.0
"""Most turns of a joint along a line, at its fastest. Near a singularity it would make tens or thousands."""

LONGEST = 60.0
"""Longest duration of a line on which a joint rotates that much [s]."""


class RacingJointError(Exception):
    """A line leads through a singularity: a joint would rotate so much there that the way takes minutes.

    Attributes:
        joint: its index from 0.
        heading: of the pourer at the line's start, about the world's vertical [rad]; 0 is that of a pour.
        turn: of the pourer along the line [rad].
        seconds: duration of the line.
    """

    def __init__(self, joint: int, heading: float, turn: float, seconds: float) -> None:
        super().__init__("through a singularity")
        self.joint, self.heading, self.turn, self.seconds = joint, heading, turn, seconds


class OutOfReachError(Exception):
    """Poses that an arm cannot reach in its present posture.

    Attributes:
        poses: (T, 7) of the pourer in the world.
    """

    def __init__(self, poses: FloatArray) -> None:
        super().__init__("out of reach")
        self.poses = poses


def follow(poses: FloatArray, near: FloatArray, spec: UrArmSettings) -> FloatArray:
    """Joints that take the pourer through poses without jumps, in the posture of home.

    Args:
        poses: of the pourer in the world, shape (T, 7); the first one is close to the pose of `near`.
        near: joints before the first pose, shape (6,) [rad], which determine the full turns.
        spec: of the arm and its cell.

    Returns:
        Shape (T, 6) [rad]; joints may leave their ranges.

    Raises:
        OutOfReachError: some poses cannot be reached.
    """
    model = MODELS[spec.model]
    flange = flange_poses(poses, spec)
    joints = inverse(flange.rotation, flange.position, model)[:, posture(np.array(spec.home.angles), model)]
    if np.isnan(joints).any():
        raise OutOfReachError(poses)
    return np.unwrap(np.concatenate([near[None], joints]), axis=0)[1:]


def home_pose(spec: UrArmSettings) -> FloatArray:
    """Pose of the pourer in the world at the home pose, shape (7,)."""
    frame = cell_transforms(spec).world.inverse @ pourer_transforms(np.array([spec.home.angles]), spec)
    return np.concatenate([frame.position[0], quaternions(frame.rotation)[0]])


def routes(start: FloatArray, end: FloatArray, over: float) -> list[list[FloatArray]]:
    """Routes from one pose of the upright pourer to another, the shortest first: straight; up, across and down.

    Args:
        start, end: shape (7,).
        over: z of the pourer's underside at which it clears the receiver [m].
    """
    top = max(over, float(start[2]), float(end[2]))
    up, across = start.copy(), end.copy()
    up[2] = across[2] = top
    return [[start, end], [start, up, across, end]]


def travel(knots: list[FloatArray], near: FloatArray, spec: UrArmSettings) -> JointPath:
    """Move along straight lines from knot to knot, at rest at each.

    The slowest of these limits sets the time of each line: approach speed and acceleration of the fastest joint; tool
    speed and acceleration; tilt speed, if the pourer also rotates about the vertical.

    Args:
        knots: poses of the pourer in the world, each of shape (7,).
        near: joints at the first knot [rad].
        spec: of the arm and its cell.

    Raises:
        OutOfReachError: some pose cannot be reached.
        RacingJointError: a line passes a singularity.
    """
    times, joints = [np.zeros(1)], [near[None]]
    for a, b in pairwise(knots):
        distance, angle = float(np.linalg.norm(b[:3] - a[:3])), _angle(a, b)
        if distance < 1e-6 and angle < 1e-6:
            continue
        t, q = _line(a, b, distance, angle, joints[-1][-1], spec)
        times.append(times[-1][-1] + t[1:])
        joints.append(q[1:])
    path = np.concatenate(joints)
    if len(path) == 1:  # already there
        return JointPath(np.array([0.0, STEP]), np.repeat(path, 2, axis=0))
    return JointPath(np.concatenate(times), path)


def _line(
    a: FloatArray, b: FloatArray, distance: float, angle: float, near: FloatArray, spec: UrArmSettings
) -> tuple[FloatArray, FloatArray]:
    s = np.linspace(0.0, 1.0, max(math.ceil(distance / 0.005), math.ceil(angle / math.radians(1.0)), 8) + 1)
    joints = follow(_between(a, b, s), near, spec)
    rates = np.abs(np.diff(joints, axis=0)).max(axis=0) * (len(s) - 1)
    first = rates.max()
    second = np.abs(np.diff(joints, n=2, axis=0)).max() * (len(s) - 1) ** 2
    reach = float(np.linalg.norm(cell_transforms(spec).pourer.position)) + 0.1
    way = distance + angle * reach
    # half of the joints' acceleration is reserved for the curvature of the joint path at full speed
    half = 0.5 * spec.approach_acceleration
    speed = min(
        min(spec.limits.tool_speed, TOOL_SPEED) / way,
        spec.approach_speed / max(first, 1e-9),
        math.sqrt(half / max(second, 1e-9)),
        0.5 * spec.limits.tilt_speed / max(angle, 1e-9),
    )
    if first > MOST_TURNS * 2.0 * math.pi and 1.0 / speed > LONGEST:
        heading = 2.0 * math.atan2(a[6], a[3])
        raise RacingJointError(int(np.argmax(rates)), math.remainder(heading, 2.0 * math.pi), angle, 1.0 / speed)
    times, fraction = trapezoid(1.0, 0.98 * speed, min(TOOL_ACCELERATION / way, half / max(first, 1e-9)), STEP)
    return times, follow(_between(a, b, fraction), near, spec)


def _between(a: FloatArray, b: FloatArray, s: FloatArray) -> FloatArray:
    return np.concatenate([a[:3] + (b[:3] - a[:3]) * s[:, None], between(a[3:], b[3:], s)], axis=-1)


def _angle(a: FloatArray, b: FloatArray) -> float:
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(a[3:], b[3:])))))
