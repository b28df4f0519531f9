"""Trajectories of a pour: time parameterisation, densely sampled paths for the checks, and transfer motions.

- `followable` limits a motion to accelerations that joints can make. `pour_times` and `trapezoid` choose the times of
  waypoints.
- `SampledPath` is a part of a planned pour, with the values that its checks use.
- `follow` computes joints that follow poses in one posture. Transfer motions move a full, upright pourer along straight
  lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import ArmModel, JointArmSettings, UnreachedError
from actors.arm.planned_pour import JointPath
from actors.arm.planning.kinematics import (
    Transforms,
    between,
    cell_transforms,
    flange_poses,
    flange_transforms,
    pourer_transforms,
    quaternions,
)
from sim_engine.motion import Phase, PourMotion, Segment, turn

FloatArray = NDArray[np.float64]

STEEPEST = math.radians(1000.0)
"""Largest acceleration of a tilt [rad/s²]. A wrist that holds a full vessel follows it closely; it replaces steps in
speed.
"""

TILT_STEP = math.radians(1.0)
"""Largest rotation between two waypoints [rad]: on a circle of 100 mm radius the chord deviates by 4 μm."""

RAMP_ERROR = math.radians(0.01)
"""Largest difference between an accelerated rotation and its chords [rad]."""


def followable(motion: PourMotion, steepest: float = STEEPEST) -> PourMotion:
    """The motion as joints can follow it: without steps in speed or accelerations above `steepest`.

    A turn that exceeds this limit keeps its speed and its ends and gets ramps of `steepest`. It lags by half a ramp and
    ends one ramp (speed / steepest) later; everything after it is delayed by the same time. Other motions are
    unchanged.

    Args:
        motion: as `sim_engine.motion.plan_motion` makes it: every phase a turn from rest to rest, or a hold.
        steepest: [rad/s²].
    """
    if _hardest(motion.segments) <= steepest * (1.0 + 1e-9):
        return motion
    segments: list[Segment] = []
    phases: list[Phase] = []
    late = 0.0
    for phase in motion.phases:
        own_segments = [s for s in motion.segments if phase.start - 1e-9 <= s.start < phase.end - 1e-9]
        start, end = phase.start + late, phase.end + late
        if own_segments:
            speed = max(max(abs(s.velocity), abs(s.velocity + s.acceleration * s.duration)) for s in own_segments)
            acceleration = min(_hardest(tuple(own_segments)), steepest)
            turned = turn(start, own_segments[0].tilt, own_segments[-1].end_tilt, speed, acceleration)
            segments += turned
            end = turned[-1].start + turned[-1].duration
            late = end - phase.end
        phases.append(Phase(phase.name, start, end))
    return replace(motion, segments=tuple(segments), phases=tuple(phases))


def _hardest(segments: tuple[Segment, ...]) -> float:
    """Largest acceleration, infinite for a step in speed [rad/s²]."""
    before, ended, hardest = 0.0, -math.inf, 0.0
    for s in segments:
        if s.start > ended + 1e-9:
            if abs(before) > 1e-9:
                return math.inf
            before = 0.0
        if abs(s.velocity - before) > 1e-6:
            return math.inf
        hardest = max(hardest, abs(s.acceleration))
        before, ended = s.velocity + s.acceleration * s.duration, s.start + s.duration
    return math.inf if abs(before) > 1e-6 else hardest


def pour_times(motion: PourMotion, finer: int = 1) -> FloatArray:
    """Times of a pour's waypoints, shape (T,) [s]: all ends of segments and phases, and as many in between as needed.

    Args:
        motion: a followable one.
        finer: multiplies the number of waypoints.
    """
    ends = {0.0, *(p.start for p in motion.phases), *(p.end for p in motion.phases)}
    pieces = [np.array(sorted(ends))]
    for s in motion.segments:
        count = max(
            abs(s.end_tilt - s.tilt) / TILT_STEP,
            s.duration * math.sqrt(abs(s.acceleration) / (8.0 * RAMP_ERROR)),
        )
        pieces.append(s.start + np.linspace(0.0, s.duration, finer * max(math.ceil(count), 1) + 1))
    times = np.sort(np.concatenate(pieces))
    # ends that were computed in two ways differ in the last bits; the phases' own ends are kept
    distinct = np.concatenate([[True], np.diff(times) > 1e-6])
    times_kept: FloatArray = times[distinct]
    for end in ends:
        times_kept[np.argmin(np.abs(times_kept - end))] = end
    return times_kept


def trapezoid(length: float, speed: float, acceleration: float, step: float) -> tuple[FloatArray, FloatArray]:
    """Motion from rest to rest along a length: times and distances, about every `step` seconds and at the ramps' ends.

    Args:
        length: > 0.
        speed: largest.
        acceleration: and deceleration.
        step: [s].
    """
    peak = min(speed, math.sqrt(length * acceleration))
    ramp = peak / acceleration
    cruise = max(length / peak - ramp, 0.0)
    count = max(math.ceil(ramp / step), 1)
    rising = np.linspace(0.0, ramp, count + 1)
    steady = np.linspace(ramp, ramp + cruise, max(math.ceil(cruise / step), 1) + 1)[1:] if cruise > 1e-9 else rising[:0]
    times = np.concatenate([rising, steady, ramp + cruise + rising[1:]])
    end = times[-1]
    way = np.where(
        times <= ramp,
        0.5 * acceleration * times**2,
        np.where(times <= ramp + cruise, peak * (times - 0.5 * ramp), length - 0.5 * acceleration * (end - times) ** 2),
    )
    way[-1] = length
    return times, way


Phases = tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, eq=False)
class SampledPath:
    """Approach, pour or retreat, sampled densely.

    Attributes:
        name: one of these.
        times: (N,) of waypoints, and of midpoints between them [s].
        joints: (N, n) [rad]; meaningless if `unreached` is set.
        spec: of the arm and its cell.
        phases: of a pour: name, start and end [s]; empty otherwise.
        unreached: flange in the base's frame, if the arm cannot reach some of the poses.
    """

    name: str
    times: FloatArray
    joints: FloatArray
    spec: JointArmSettings
    phases: Phases = ()
    unreached: Transforms | None = None

    @classmethod
    def of(cls, name: str, path: JointPath, spec: JointArmSettings, phases: Phases = ()) -> SampledPath:
        """A path with midpoints between its waypoints: joints are linear in between, poses nearly so."""
        times = np.sort(np.concatenate([path.times, 0.5 * (path.times[1:] + path.times[:-1])]))
        return cls(name, times, path.at(times), spec, phases)

    @classmethod
    def beyond(
        cls, name: str, times: FloatArray, poses: FloatArray, spec: JointArmSettings, phases: Phases = ()
    ) -> SampledPath:
        """Poses of the pourer in the world (N, 7), some of which cannot be reached."""
        return cls(name, times, np.zeros((len(times), len(spec.home_joints))), spec, phases, flange_poses(poses, spec))

    @cached_property
    def links(self) -> FloatArray:
        """Points of the arm's capsules, and its TCP; room frame, shape (N, P + 1, 3) [m]."""
        points = self.model.points(self.joints)
        room = cell_transforms(self.spec).base.apply(points.reshape(-1, 3)).reshape(points.shape)
        return np.concatenate([room, self.tool[:, None]], axis=1)

    @property
    def model(self) -> ArmModel:
        """The arm's kinematics."""
        return self.spec.kinematics

    @cached_property
    def link_error(self) -> float:
        """Largest distance of a link from where `links` has it [m]."""
        return self.model.link_error(self.joints)

    @cached_property
    def flange(self) -> Transforms:
        """Pose of the flange in the room's frame."""
        base = cell_transforms(self.spec).base
        return flange_transforms(self.joints, self.spec) if self.unreached is None else base @ self.unreached

    @cached_property
    def tool(self) -> FloatArray:
        """Position of the TCP in the room's frame, shape (N, 3) [m]."""
        return self.flange.apply(cell_transforms(self.spec).tool.position)

    @cached_property
    def pourer(self) -> Transforms:
        """Pose of the pourer in the room's frame."""
        return self.flange @ cell_transforms(self.spec).pourer

    @cached_property
    def poses(self) -> FloatArray:
        """Poses of the pourer in the world, shape (N, 7)."""
        world = cell_transforms(self.spec).world.inverse @ self.pourer
        return np.concatenate([world.position, quaternions(world.rotation)], axis=-1)

    @cached_property
    def tilts(self) -> FloatArray:
        """Tilts of the pourer from upright, shape (N,), ≥ 0 [rad]."""
        axis = self.pourer.rotation[:, :, 2]
        return np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2])

    @cached_property
    def steps(self) -> FloatArray:
        """Between two samples, shape (N − 1,) [s]."""
        return np.diff(self.times)

    @cached_property
    def joint_speeds(self) -> FloatArray:
        """Between two samples, shape (N − 1, n), ≥ 0 [rad/s]."""
        speeds: FloatArray = np.abs(np.diff(self.joints, axis=0)) / self.steps[:, None]
        return speeds

    @cached_property
    def turning(self) -> FloatArray:
        """Angular velocity of the pourer between two samples, shape (N − 1,) [rad/s]."""
        q = self.poses[:, 3:]
        half = np.linalg.norm(q[1:] - q[:-1], axis=-1)  # chord of unit quaternions, exact to third order in the angle
        turning: FloatArray = 4.0 * np.arcsin(np.minimum(0.5 * half, 1.0)) / self.steps
        return turning

    @cached_property
    def margins(self) -> FloatArray:
        """Distances from singularities, shape (N, m), see `ArmModel.margins`."""
        return self.model.margins(self.joints)

    def point_speeds(self, points: FloatArray) -> FloatArray:
        """Largest speed of the TCP and of points (V, 3) of the pourer between samples, shape (N − 1,) [m/s]."""
        turn, shift = np.diff(self.pourer.rotation, axis=0), np.diff(self.pourer.position, axis=0)
        moved = np.sqrt(np.square(turn @ points.T + shift[:, :, None]).sum(axis=1).max(axis=1))
        tool = np.linalg.norm(np.diff(self.tool, axis=0), axis=-1)
        speeds: FloatArray = np.maximum(moved, tool) / self.steps
        return speeds

    def when(self, index: int) -> str:
        """The time of a sample as text: '0.81 s into the tilt'."""
        t = float(self.times[index])
        for name, start, end in self.phases:
            if t <= end + 1e-6:
                if end - start > 1e-6 and t >= end - 1e-6:
                    return f"at the {name}'s end, {t:.2f} s into the pour"
                return f"{t - start:.2f} s into the {name}"
        if t >= self.times[-1] - 1e-6:
            return f"at the {self.name}'s end"
        return f"{t:.2f} s into the {self.name}"


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
        nominal: joints of an arm with nominal lengths (T, n) [rad], which reaches them all; the lengths of this arm
            give no joints near a singularity. None if that one cannot reach them either.
    """

    def __init__(self, poses: FloatArray, nominal: FloatArray | None = None) -> None:
        super().__init__("out of reach")
        self.poses, self.nominal = poses, nominal


def follow(poses: FloatArray, near: FloatArray, spec: JointArmSettings) -> FloatArray:
    """Joints that take the pourer through poses without jumps, in the posture of home.

    Args:
        poses: of the pourer in the world, shape (T, 7); the first one is close to the pose of `near`.
        near: joints before the first pose, shape (n,) [rad], which determine the full turns.
        spec: of the arm and its cell.

    Returns:
        Shape (T, n) [rad]; joints may leave their ranges.

    Raises:
        OutOfReachError: some poses cannot be reached.
    """
    flange = flange_poses(poses, spec)
    try:
        return spec.kinematics.follow(flange.rotation, flange.position, near, np.array(spec.home_joints))
    except UnreachedError as error:
        raise OutOfReachError(poses, error.nominal) from None


def home_pose(spec: JointArmSettings) -> FloatArray:
    """Pose of the pourer in the world at the home pose, shape (7,)."""
    frame = cell_transforms(spec).world.inverse @ pourer_transforms(np.array([spec.home_joints]), spec)
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


def travel(
    knots: list[FloatArray],
    near: FloatArray,
    spec: JointArmSettings,
    fastest: float = TOOL_SPEED,
    hardest: float = TOOL_ACCELERATION,
) -> JointPath:
    """Move along straight lines from knot to knot, at rest at each.

    The slowest of these limits sets the time of each line: approach speed and acceleration of the fastest joint; tool
    speed and acceleration; tilt speed, if the pourer also rotates about the vertical.

    Args:
        knots: poses of the pourer in the world, each of shape (7,).
        near: joints at the first knot [rad].
        spec: of the arm and its cell.
        fastest: speed of the tool [m/s].
        hardest: acceleration of the tool [m/s²].

    Raises:
        OutOfReachError: some pose cannot be reached.
        RacingJointError: a line passes a singularity.
    """
    times, joints = [np.zeros(1)], [near[None]]
    for a, b in pairwise(knots):
        distance, angle = float(np.linalg.norm(b[:3] - a[:3])), _angle(a, b)
        if distance < 1e-6 and angle < 1e-6:
            continue
        t, q = _line(a, b, distance, angle, joints[-1][-1], spec, fastest, hardest)
        times.append(times[-1][-1] + t[1:])
        joints.append(q[1:])
    path = np.concatenate(joints)
    if len(path) == 1:  # already there
        return JointPath(np.array([0.0, STEP]), np.repeat(path, 2, axis=0))
    return JointPath(np.concatenate(times), path)


def _line(
    a: FloatArray,
    b: FloatArray,
    distance: float,
    angle: float,
    near: FloatArray,
    spec: JointArmSettings,
    fastest: float,
    hardest: float,
) -> tuple[FloatArray, FloatArray]:
    s = np.linspace(0.0, 1.0, max(math.ceil(distance / 0.005), math.ceil(angle / math.radians(1.0)), 8) + 1)
    heading = math.remainder(2.0 * math.atan2(a[6], a[3]), 2.0 * math.pi)
    try:
        joints = follow(_between(a, b, s), near, spec)
    except OutOfReachError as error:
        if error.nominal is None:
            raise
        racing = np.abs(np.diff(np.unwrap(error.nominal, axis=0), axis=0)).max(axis=0)
        raise RacingJointError(int(np.argmax(racing)), heading, angle, math.inf) from None
    rates = np.abs(np.diff(joints, axis=0)).max(axis=0) * (len(s) - 1)
    first = rates.max()
    second = np.abs(np.diff(joints, n=2, axis=0)).max() * (len(s) - 1) ** 2
    reach = float(np.linalg.norm(cell_transforms(spec).pourer.position)) + 0.1
    way = distance + angle * reach
    # half of the joints' acceleration is reserved for the curvature of the joint path at full speed
    half = 0.5 * spec.approach_acceleration
    speed = min(
        min(spec.limits.tool_speed, fastest) / way,
        spec.approach_speed / max(first, 1e-9),
        math.sqrt(half / max(second, 1e-9)),
        0.5 * spec.limits.tilt_speed / max(angle, 1e-9),
    )
    if first > MOST_TURNS * 2.0 * math.pi and 1.0 / speed > LONGEST:
        raise RacingJointError(int(np.argmax(rates)), heading, angle, 1.0 / speed)
    times, fraction = trapezoid(1.0, 0.98 * speed, min(hardest / way, half / max(first, 1e-9)), STEP)
    return times, follow(_between(a, b, fraction), near, spec)


def _between(a: FloatArray, b: FloatArray, s: FloatArray) -> FloatArray:
    return np.concatenate([a[:3] + (b[:3] - a[:3]) * s[:, None], between(a[3:], b[3:], s)], axis=-1)


def _angle(a: FloatArray, b: FloatArray) -> float:
    return 2.0 * math.acos(min(1.0, abs(float(np.dot(a[3:], b[3:])))))
