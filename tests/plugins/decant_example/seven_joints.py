"""An arm with seven joints, with its kinematics, its planner, its driver and a simulated robot:

    arm: {kind: seven-joint, approach_speed: 40 deg/s}
    cell: {receiver: {x: 700 mm, y: 0 mm, z: 150 mm}, direction: 90 deg}

- `SevenJointSettings` are the settings; `SevenJointKind` joins them with the rest, and plans pours (`SevenJointPour`).
- `SevenJointArm` is the driver. It sends joint positions over a cable at a steady rate.
- `SimulatedRobot` is at the other end of the cable; replace it by the interface of your robot.
- `SevenJointFigure` draws the arm in the live view.

The lengths are those of a lightweight arm of 1.3 m, and were not measured. The planner checks joint ranges, joint
speeds, singularities and the table. It does not check the links against the receiver.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from decant.plugins import (
    SET_BY_PROGRAM,
    Action,
    ArmFacts,
    ArmKind,
    ArmLostError,
    ArmNotReleasedError,
    ArmPose,
    ArmRefusedError,
    ArmSettings,
    ArmState,
    ArmStoppedError,
    Bar,
    ExecutedMotion,
    InvalidActionError,
    PathReport,
    Pose,
    Problems,
    Quantity,
    RobotCell,
    Scene,
    plan_pour,
)

FloatArray = NDArray[np.float64]
DEG = math.pi / 180.0

LENGTHS = (0.34, 0.0, 0.40, 0.0, 0.40, 0.0, 0.126)
"""Distance from each joint to the next along the arm, the last one to the flange [m]."""

AXES = np.array([[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], dtype=float)
"""Axis of each joint while the arm points straight up."""

RANGES = np.radians([170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 175.0])
SPEEDS = np.radians([98.0, 98.0, 100.0, 130.0, 140.0, 180.0, 180.0])

HOME = np.radians([-25.0, 35.0, 0.0, -107.0, 0.0, -52.0, 0.0])
"""Waiting pose: the pourer is upright next to the receiver."""

GRIP = Rotation.from_matrix([[0, 0, -1], [1, 0, 0], [0, -1, 0]]), np.array([0.05, 0.0, 0.10])
"""Pose of the pourer in the flange's frame: held from the side, so that the last joint tilts it."""

UP = GRIP[0].as_matrix()[:, 2]
"""Direction of the pourer's axis in the flange's frame."""

SINGULAR = 0.05
"""Smallest singular value of the Jacobian (lengths in metres) at which a pose is accepted."""

LINKS = tuple(Bar(f"link {k}", radius) for k, radius in enumerate((0.07, 0.065, 0.055, 0.05), start=1))


# ---- kinematics


def frames(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Axes and origins of the joints and the flange.

    Args:
        q: joints, shape (7,) [rad].

    Returns:
        Axes (7, 3), origins (8, 3) [m], the last one of the flange, in the base frame; rotation (3, 3) of the flange.
    """
    rotation, place = np.eye(3), np.zeros(3)
    axes, origins = np.empty((7, 3)), np.empty((8, 3))
    for k in range(7):
        axes[k], origins[k] = rotation @ AXES[k], place
        c, s, (_, y, z) = math.cos(q[k]), math.sin(q[k]), AXES[k]
        # every axis is ±y or z
        turn = np.array([[c, -s * z, s * y], [s * z, c if z else 1.0, 0.0], [-s * y, 0.0, 1.0 if z else c]])
        rotation = rotation @ turn
        place = place + LENGTHS[k] * rotation[:, 2]
        origins[k] = place - LENGTHS[k] * rotation[:, 2]
    origins[7] = place
    return axes, origins, rotation


def jacobian(axes: FloatArray, origins: FloatArray) -> FloatArray:
    """Velocity and angular velocity of the flange per joint speed, shape (6, 7)."""
    return np.concatenate([np.cross(axes, origins[7] - origins[:7]), axes], axis=1).T


def follow(rotations: Rotation, places: FloatArray, start: FloatArray) -> tuple[FloatArray, float]:
    """Joints along poses of the flange. The spare joint is used to stay near `start`.

    Args:
        rotations, places: of the flange in the base frame, T of each [m].
        start: joints near the first pose, shape (7,) [rad].

    Returns:
        Joints (T, 7) [rad], and the smallest singular value on the way.

    Raises:
        InvalidActionError: a pose is out of reach.
    """
    q, found, least = start.copy(), [], math.inf
    for wanted, place in zip(rotations.as_matrix(), places, strict=True):
        for step in range(40):
            axes, origins, there = frames(q)
            apart = 0.5 * np.cross(there, wanted, axis=0).sum(axis=1)  # sine of the angle, about its axis
            error = np.concatenate([place - origins[7], apart])
            if np.abs(error).max() < 1e-8:
                break
            slopes = jacobian(axes, origins)
            inverse = slopes.T @ np.linalg.inv(slopes @ slopes.T + 1e-8 * np.eye(6))
            q = q + inverse @ error
            if step == 0:
                q = q + 0.02 * (np.eye(7) - inverse @ slopes) @ (start - q)
        else:
            raise InvalidActionError(
                f"the arm does not reach x = {place[0]:.3f} m, y = {place[1]:.3f} m, z = {place[2]:.3f} m of its base "
                "with its flange; move the receiver nearer"
            )
        least = min(least, float(np.linalg.svd(jacobian(*frames(q)[:2]), compute_uv=False)[-1]))
        found.append(q.copy())
    return np.array(found), least


# ---- plans


@dataclass(frozen=True, eq=False)
class Way:
    """Joints over time, linear in between.

    Attributes:
        times: (T,) increasing from 0 [s].
        joints: (T, 7) [rad].
    """

    times: FloatArray
    joints: FloatArray

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    def at(self, moment: float) -> FloatArray:
        return np.array([np.interp(moment, self.times, column) for column in self.joints.T])

    def slowed(self, factor: float) -> Way:
        return Way(self.times / factor, self.joints)

    def back(self, index: int | None = None) -> Way:
        """From a waypoint, the last one unless given, back to the first one."""
        last = len(self.times) - 1 if index is None else index
        return Way(self.times[last] - self.times[last::-1], self.joints[last::-1])

    def nearest(self, joints: FloatArray) -> tuple[int, float]:
        """The waypoint nearest to joints, and the distance of the farthest joint from it [rad]."""
        apart = np.abs(self.joints - joints).max(axis=1)
        return int(np.argmin(apart)), float(apart.min())


def smooth(joints: FloatArray, speed: float) -> Way:
    """A way from rest to rest through joints at equal distances, its fastest joint at `speed` [rad/s]."""
    share = np.linspace(0.0, 1.0, len(joints))
    rate = np.abs(np.gradient(joints, share, axis=0)).max(axis=1) * 1.5  # of 3s² − 2s³ in the middle
    duration = max(float(rate.max()) / speed, 0.2)
    times = np.linspace(0.0, duration, 4 * len(joints))
    s = times / duration
    along = 3.0 * s**2 - 2.0 * s**3
    return Way(times, np.stack([np.interp(along, share, column) for column in joints.T], axis=1))


@dataclass(frozen=True, eq=False)
class SevenJointPour:
    """See `decant.plugins.PlannedPour`.

    Attributes:
        tilts: of the pourer at `pour.times` [rad].
    """

    approach: Way
    pour: Way
    tilts: FloatArray
    phases: tuple[tuple[str, float, float], ...]
    report: PathReport

    @property
    def approach_time(self) -> float:
        return self.approach.duration

    @property
    def pour_time(self) -> float:
        return self.pour.duration

    @property
    def retreat_time(self) -> float:
        return self.approach.duration

    def slowed(self, factor: float) -> SevenJointPour:
        r = self.report
        slower = replace(
            r,
            joint_speed=factor * r.joint_speed,
            tool_speed=factor * r.tool_speed,
            tilt_speed=factor * r.tilt_speed,
            duration=r.duration / factor,
        )
        phases = tuple((name, start / factor, end / factor) for name, start, end in self.phases)
        return replace(
            self, approach=self.approach.slowed(factor), pour=self.pour.slowed(factor), phases=phases, report=slower
        )


@dataclass(frozen=True, eq=False)
class MeasuredMotion(ExecutedMotion):
    """The measured motion of the pourer, with the joints from which it was computed, shape (T, 7) [rad]."""

    joints: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))

    def record(self) -> dict[str, Any]:
        """Times and joints at 25 Hz."""
        if not len(self.times):
            return {}
        times = np.arange(0.0, self.times[-1], 0.04)
        joints = np.stack([np.interp(times, self.times, column) for column in self.joints.T], axis=1)
        return {"times": np.round(times, 3).tolist(), "joints": np.round(joints, 5).tolist()}


# ---- settings


class SevenJointSettings(ArmSettings):
    """An arm with seven joints that holds the pourer from the side."""

    kind: Literal["seven-joint"] = "seven-joint"
    """An arm with seven joints."""

    approach_speed: Annotated[float, Quantity("rad/s", "40 deg/s", 0.0, 2.0, positive=True)] = 40.0 * DEG
    """Speed of the fastest joint between home and pour."""

    cell: Annotated[RobotCell | None, SET_BY_PROGRAM] = None
    """Objects around the arm."""

    warning_time: Annotated[float, SET_BY_PROGRAM] = 0.5
    """Time from the operator's consent to the first movement [s]."""

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """See `ArmSettings.in_laboratory`."""
        return self.with_values(cell=cell, time_scale=time_scale)

    # ---- frames

    @property
    def _cell(self) -> RobotCell:
        assert self.cell is not None, "`in_laboratory` sets it; `check_laboratory` requires it"
        return self.cell

    def _flanges(self, poses: FloatArray) -> tuple[Rotation, FloatArray]:
        """Poses of the flange in the base frame for poses (T, 7) of the pourer in the world."""
        world = Rotation.from_euler("z", self._cell.direction)
        held = world * Rotation.from_quat(np.roll(poses[:, 3:], -1, axis=1))
        rotations = held * GRIP[0].inv()
        places = world.apply(poses[:, :3]) + self._cell.receiver.vector - rotations.apply(GRIP[1])
        return rotations, places

    def poses(self, joints: FloatArray) -> FloatArray:
        """Poses of the pourer in the world, shape (T, 7), for joints (T, 7)."""
        chain = [frames(q) for q in joints]
        rotations = Rotation.from_matrix(np.array([rotation for _, _, rotation in chain]))
        places = np.array([origins[7] for _, origins, _ in chain]) + rotations.apply(GRIP[1])
        world = Rotation.from_euler("z", self._cell.direction).inv()
        quaternions = np.roll((world * rotations * GRIP[0]).as_quat(), 1, axis=1)
        signs = np.cumprod(np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1.0, 1.0))
        quaternions[1:] *= signs[:, None]  # no jumps between a quaternion and its negative
        return np.concatenate([world.apply(places - self._cell.receiver.vector), quaternions], axis=1)

    def tilt(self, joints: FloatArray) -> float:
        """Tilt of the pourer [rad]."""
        return math.acos(float(np.clip(frames(joints)[2][2] @ UP, -1.0, 1.0)))


class SevenJointKind(ArmKind[SevenJointSettings]):
    """Arms with seven joints."""

    settings = SevenJointSettings

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        if mode == "hardware":
            problems.add("this example has no robot; write 'mode: virtual'", "arm")
        if cell is None:
            problems.add("an arm needs to know what stands where; add 'cell: {receiver: …, direction: …}'", "arm")

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`; this robot has no safety checksum."""
        return SevenJointArm, (self.spec,)

    def figure(self) -> SevenJointFigure:
        """See `ArmKind.figure`."""
        return SevenJointFigure(self.spec)

    def plan(self, scene: Scene, action: Action) -> SevenJointPour:
        """See `ArmKind.plan`."""
        motion = plan_pour(scene, action)
        count = max(math.ceil(motion.duration / 0.02), 2) + 1
        times = np.linspace(0.0, motion.duration, count)
        poses = motion.sample(times)
        rotations, places = self.spec._flanges(poses)
        ways, start = self._approach(rotations[0], places[0])
        joints, singular = follow(rotations, places, start)
        path = Way(times, joints)
        approach = smooth(ways, self.spec.approach_speed)
        tilts = np.asarray(motion.tilt(times))
        self._check(approach, path, singular)
        speeds = np.abs(np.diff(joints, axis=0)).max(axis=0) / times[1]
        points = np.array([frames(q)[1][7] + frames(q)[2] @ GRIP[1] for q in [*approach.joints, *joints]])
        low, high = points.min(axis=0), points.max(axis=0)
        report = PathReport(
            joint_speed=float(speeds.max()),
            fastest_joint=int(np.argmax(speeds)),
            tool_speed=float(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1).max() / times[1]),
            tilt=float(tilts.max()),
            tilt_speed=float(np.abs(np.diff(tilts)).max() / times[1]),
            singularity=singular,
            clearance=0.0,
            low=(float(low[0]), float(low[1]), float(low[2])),
            high=(float(high[0]), float(high[1]), float(high[2])),
            duration=path.duration + 2.0 * approach.duration,
        )
        phases = tuple((phase.name, phase.start, phase.end) for phase in motion.phases)
        return SevenJointPour(approach, path, tilts, phases, report)

    def _approach(self, rotation: Rotation, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joints from home along a straight line, the pourer upright; and those at its end."""
        _, origins, waiting = frames(HOME)
        there = Rotation.from_matrix(waiting)
        turn = (rotation * there.inv()).as_rotvec()
        share = np.linspace(0.0, 1.0, 41)[:, None]
        rotations = Rotation.from_rotvec(share * turn) * there
        joints, _ = follow(rotations, origins[7] + share * (place - origins[7]), HOME)
        return joints, joints[-1]

    def _check(self, approach: Way, pour: Way, singular: float) -> None:
        """Raises `InvalidActionError` with all problems."""
        problems = []
        joints = np.concatenate([approach.joints, pour.joints])
        speeds = np.abs(np.diff(pour.joints, axis=0)).max(axis=0) / pour.times[1]
        for k in range(7):
            angle, speed = float(np.abs(joints[:, k]).max()), float(speeds[k])
            if angle > RANGES[k]:
                problems.append(f"joint {k + 1} would turn to {angle / DEG:.0f} deg; it has {RANGES[k] / DEG:.0f} deg")
            if speed > SPEEDS[k] * 1.001:
                problems.append(
                    f"joint {k + 1} would turn at {speed / DEG:.0f} deg/s; it makes {SPEEDS[k] / DEG:.0f} deg/s: lower "
                    "angular_velocity or return_velocity"
                )
        if singular < SINGULAR:
            problems.append("the arm would pass near a singular pose; move the receiver")
        lowest = min(float(frames(q)[1][2:, 2].min()) for q in joints[::5])
        if lowest < self.spec._cell.table + LINKS[-1].radius:
            problems.append(f"the arm would come {1e3 * (lowest - self.spec._cell.table):.0f} mm near the table")
        if problems:
            raise InvalidActionError("the arm can't make this pour: " + "; ".join(problems))


# ---- the robot


class SimulatedRobot:
    """A robot at the end of a cable. It moves to the last joint position that it received, no faster than its joints
    can, brakes if none arrives for `WATCHDOG`, and measures its joints. It keeps all measurements, as the independent
    witness of the driver's tests.

    Attributes:
        slip: share of each turn of the last joint that its gear loses.
        plugged: its cable is connected.
        tripped: a protective stop is in force; it ends at the robot, not over the cable.
    """

    WATCHDOG = 0.5
    """Longest time between two positions while it moves [s of bench time]."""

    LAG = 0.02
    """Time constant with which the joints follow [s of bench time]."""

    def __init__(self, time_scale: float = 1.0) -> None:
        self._scale = time_scale
        self._lock = threading.Lock()
        self._joints, self._wanted = HOME.copy(), HOME.copy()
        self._commanded = 0.0
        self._now = self._received = time.monotonic() * time_scale
        self.slip, self.plugged, self.tripped = 0.0, True, False
        self.readings: list[tuple[float, FloatArray]] = []
        """Time [s of bench time] and joints [rad]."""
        self.measure()

    def measure(self) -> tuple[float, FloatArray]:
        """Read the encoders: time [s of bench time] and joints [rad]."""
        with self._lock:
            now = time.monotonic() * self._scale
            moving = min(now, self._received + self.WATCHDOG) - self._now
            if moving > 0.0 and not self.tripped:
                step = (1.0 - math.exp(-moving / self.LAG)) * (self._wanted - self._joints)
                self._joints = self._joints + np.clip(step, -SPEEDS * moving, SPEEDS * moving)
            self._now = now
            self.readings.append((now, self._joints))
            return self.readings[-1]

    def read(self) -> tuple[float, FloatArray, bool]:
        """Time, joints and whether a protective stop is in force, over the cable.

        Raises:
            ConnectionError: the cable is not connected.
        """
        if not self.plugged:
            raise ConnectionError("the robot does not answer")
        return *self.measure(), self.tripped

    def move(self, joints: FloatArray) -> None:
        """Send a position. Raises as `read`."""
        self.read()
        with self._lock:
            wanted = joints.copy()
            wanted[6] = self._wanted[6] + (1.0 - self.slip) * (joints[6] - self._commanded)
            self._commanded, self._wanted, self._received = joints[6], wanted, self._now

    def hold(self) -> None:
        """Stand where it is. Raises as `read`."""
        _, joints, _ = self.read()
        with self._lock:
            self._wanted, self._commanded = joints.copy(), joints[6]


# ---- the driver


class SevenJointArm:
    """The driver: see `decant.plugins.Arm`.

    Args:
        spec: its settings.
        robot: the robot; a simulated one by default.
    """

    PERIOD = 0.01
    """Time between two positions [s of the clock]."""

    SETTLING = 1.0
    """Longest time from the end of a path to rest [s of bench time]."""

    NEAR = 5.0 * DEG
    """Largest distance of a joint from a path that leads back."""

    def __init__(self, spec: SevenJointSettings, robot: SimulatedRobot | None = None) -> None:
        self._spec = spec
        self._robot = robot or SimulatedRobot(spec.time_scale)
        self._one = threading.Lock()
        self._halt = threading.Event()
        self._free = False
        self._last: SevenJointPour | None = None
        self._state = ArmState()

    # ---- nothing moves

    def connect(self) -> ArmFacts:
        self._free = False
        return self.facts()

    def facts(self) -> ArmFacts:
        _, joints, tripped = self._read()
        self._state = replace(self._state, joints=tuple(joints.tolist()), tilt=self._spec.tilt(joints))
        problem = "a protective stop is in force: look for its cause, then reset it at the robot" if tripped else ""
        return ArmFacts(model="seven-joint", serial="7", version="1.0", problem=problem)

    def hands_in(self) -> None:
        self._free = False
        if not self._one.acquire(blocking=False):
            raise ArmRefusedError("the arm moves: keep hands out")
        self._one.release()
        self._read()

    def release(self) -> None:
        self._halt.clear()
        self._free = True
        self._state = replace(self._state, stopped=False)

    def recover(self) -> str:
        self._consent()
        self._free = False
        if problem := self.facts().problem:
            raise ArmRefusedError(problem)
        return ""

    def state(self) -> ArmState:
        return self._state

    def where(self) -> ArmPose:
        _, joints, _ = self._read()
        _, origins, rotation = frames(joints)
        place = origins[7] + rotation @ GRIP[1]
        return ArmPose(
            Pose.of(*place, *Rotation.from_matrix(rotation).as_rotvec()), tuple(joints.tolist()), tuple(HOME.tolist())
        )

    def close(self) -> None:
        self.stop()

    # ---- motions

    def move_to_start(self, path: SevenJointPour) -> None:
        self._consent()
        index, apart = path.approach.nearest(self._read()[1])
        if index > 0 or apart > self.NEAR:
            raise ArmRefusedError("the arm is not at home; bring it there with 'decant robot home'")
        self._go(path.approach, lambda t: "approach")

    def execute(self, path: SevenJointPour) -> MeasuredMotion:
        self._last = path
        return self._go(path.pour, lambda t: next((name for name, _, end in path.phases if t < end), "return"))

    def retreat(self, path: SevenJointPour) -> None:
        self._consent()
        index, apart = path.approach.nearest(self._read()[1])
        if apart > self.NEAR:
            raise ArmRefusedError(
                f"a joint is {apart / DEG:.0f} deg away from the way home; bring the arm there by hand"
            )
        if index > 0:
            self._go(path.approach.back(index), lambda t: "retreat")
        self._free = False

    def untilt(self, path: SevenJointPour | None = None) -> None:
        self._consent()
        poured = path or self._last
        if poured is None:
            raise ArmRefusedError("no pour is known that was stopped; bring the pourer upright at the robot")
        index, apart = poured.pour.nearest(self._read()[1])
        if apart > self.NEAR:
            raise ArmRefusedError(f"a joint is {apart / DEG:.0f} deg away from the pour; bring the arm upright by hand")
        # Back along the path that it came; from the return phase onwards, which does not tilt the pourer more.
        returns = poured.pour.times[index] >= poured.phases[-1][1]
        joints = poured.pour.joints[index:] if returns else poured.pour.joints[index::-1]
        tilts = poured.tilts[index:] if returns else poured.tilts[index::-1]
        moves = np.append(True, np.abs(np.diff(tilts)) > 1e-6)  # without the hold
        times = np.append(0.0, np.cumsum(np.abs(np.diff(tilts[moves])))) / self._spec.upright_speed
        if times[-1] > 0.0:
            self._go(Way(times, joints[moves]), lambda t: "untilt")
        self._free = False

    def jog(self, axis: str, amount: float, speed: float) -> None:
        axes = [f"joint {k}" for k in range(1, 8)]
        if axis not in axes or not 0.0 < abs(amount) <= 10.0 * DEG or speed <= 0.0:
            raise ArmRefusedError(f"a step is at most 10 deg of one of {', '.join(axes)}")
        self._consent()
        _, joints, _ = self._read()
        there = joints + amount * np.eye(7)[axes.index(axis)]
        if np.any(np.abs(there) > RANGES):
            raise ArmRefusedError(f"{axis} would leave its range")
        self._go(Way(np.array([0.0, abs(amount) / speed]), np.array([joints, there])), lambda t: "jog")
        self._free = False

    def stop(self) -> float:
        begun, moved = time.monotonic(), self._state.moving
        self._halt.set()
        self._free = False
        with self._one:  # the motion has ended, and the arm stands
            self._state = replace(self._state, moving=False, stopped=True)
        return time.monotonic() - begun if moved else 0.0

    # ---- implementation

    def _read(self) -> tuple[float, FloatArray, bool]:
        try:
            return self._robot.read()
        except ConnectionError as error:
            raise self._lost(error) from error

    def _lost(self, error: ConnectionError) -> ArmLostError:
        """Consent ends with the connection; the robot's watchdog stops it."""
        self._free = False
        self._state = replace(self._state, moving=False, stopped=True)
        return ArmLostError(f"{error}; look at its cable")

    def _consent(self) -> None:
        if not self._free:
            raise ArmNotReleasedError("the arm is locked: the operator has to release it before it moves")

    def _go(self, way: Way, phase: Callable[[float], str]) -> MeasuredMotion:
        """Follow a way, and report what the encoders read."""
        if not self._one.acquire(blocking=False):
            raise ArmRefusedError("the arm moves already")
        try:
            self._consent()
            return self._follow(way, phase)
        except ConnectionError as error:
            raise self._lost(error) from error
        finally:
            self._one.release()

    def _follow(self, way: Way, phase: Callable[[float], str]) -> MeasuredMotion:
        begun = self._robot.read()[0]
        times: list[float] = []
        joints: list[FloatArray] = []
        reason = ""
        while True:
            moment, there, tripped = self._robot.read()
            now = moment - begun
            if not times or now > times[-1]:
                times.append(now)
                joints.append(there)
            if tripped:
                reason = "protective stop"
            elif self._halt.is_set():
                reason = "operator"
                self._robot.hold()
            arrived = now >= way.duration
            if (reason or arrived) and (self._stands(times, joints) or now > way.duration + self.SETTLING):
                break
            if not reason:
                self._robot.move(way.at(min(now, way.duration)))
                share = min(now / way.duration, 1.0)
                self._state = self._seen(there, True, min(now, way.duration), share, phase(now))
            time.sleep(self.PERIOD)
        self._state = self._seen(joints[-1], False, times[-1], 1.0, "idle")
        measured = np.array(joints)
        poses = self._spec.poses(measured)
        executed = MeasuredMotion(np.array(times), poses, completed=not reason, joints=measured)
        if reason:
            self._free = False
            self._state = replace(self._state, stopped=True)
            text = f"{reason} {times[-1]:.1f} s after the begin of the motion"
            raise ArmStoppedError(text, reason, phase(times[-1]), times[-1], self._state.tilt, executed)
        return executed

    @staticmethod
    def _stands(times: list[float], joints: list[FloatArray]) -> bool:
        """Whether the last two readings show an arm at rest: slower than 0.2 deg/s."""
        if len(times) < 2:
            return False
        return bool(np.abs(joints[-1] - joints[-2]).max() < 0.2 * DEG * (times[-1] - times[-2]))

    def _seen(self, joints: FloatArray, moving: bool, now: float, share: float, phase: str) -> ArmState:
        tilt, stopped = self._spec.tilt(joints), self._halt.is_set()
        return ArmState(moving, stopped, now, share, phase, tilt, tuple(joints.tolist()))


# ---- the live view


@dataclass(frozen=True)
class SevenJointFigure:
    """See `decant.plugins.ArmFigure`: four links from the base to the flange, and no gripper."""

    spec: SevenJointSettings

    @property
    def bars(self) -> tuple[Bar, ...]:
        return LINKS

    @property
    def home(self) -> tuple[float, ...]:
        return tuple(HOME.tolist())

    @property
    def table(self) -> float:
        cell = self.spec._cell
        return cell.table - cell.receiver.z

    def ends(self, joints: FloatArray) -> FloatArray:
        q = np.asarray(joints, dtype=float)
        points = np.array([frames(one)[1][[0, 1, 3, 5, 7]] for one in q.reshape(-1, 7)])
        points = self._in_world(points.reshape(-1, 3)).reshape(*q.shape[:-1], 5, 3)
        return np.stack([points[..., :-1, :], points[..., 1:, :]], axis=-2)

    def tool(self, joints: FloatArray) -> FloatArray:
        return self.pourer(joints)

    def pourer(self, joints: FloatArray) -> FloatArray:
        return self.spec.poses(np.asarray(joints, dtype=float))

    def tool_of(self, poses: FloatArray) -> FloatArray:
        return np.asarray(poses, dtype=float)[:, :3]

    def executed(self, record: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        return (np.array(record["times"]), np.array(record["joints"])) if "joints" in record else None

    def _in_world(self, points: FloatArray) -> FloatArray:
        cell = self.spec._cell
        turned = Rotation.from_euler("z", cell.direction).inv().apply(points - np.array(cell.receiver.vector))
        return np.asarray(turned)
