"""Pours as values: planned, and executed.

- `PourPath` and `JointPath` are a pour for the joints of an arm: planning creates them, checks examine them, the driver
  executes them. `ExecutedPath` is the measured motion.
- `MotionPath` and `ExecutedMotion` are the same for arms without joints: the plan is the motion itself, and poses of
  the pourer are read back.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmRefusedError, PathReport
from sim_engine.motion import PourMotion
from sim_engine.scene import SampledMotion

FloatArray = NDArray[np.float64]

JOINT_UNIT = 1e-6
"""Resolution of joints in records [rad]: a thousandth of an arm's repeatability."""

TIME_UNIT = 1e-5
"""Resolution of times in records [s]."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joints over time, from rest to rest, linear in between.

    Attributes:
        times: (T,) increasing from 0 [s]; T ≥ 2.
        joints: (T, n) [rad], without jumps by full turns.
    """

    times: FloatArray
    joints: FloatArray

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])

    def at(self, times: FloatArray) -> FloatArray:
        """Joints at times [s], clamped at both ends, shape (T, n) [rad]."""
        return np.stack([np.interp(times, self.times, column) for column in self.joints.T], axis=-1)


def checked(path: JointPath, count: int) -> JointPath:
    """Check that an arm can follow a path. Returns the path.

    Raises:
        ArmRefusedError: its shape, its times or its numbers are invalid.
    """
    times, joints = np.asarray(path.times, dtype=float), np.asarray(path.joints, dtype=float)
    if times.ndim != 1 or len(times) < 2 or joints.shape != (len(times), count):
        raise ArmRefusedError(
            f"a path has two or more times and {count} joints for each, not {times.shape} and {joints.shape}"
        )
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(joints))):
        raise ArmRefusedError("a path must be made of finite numbers")
    if times[0] != 0.0 or np.any(np.diff(times) <= 0.0):
        raise ArmRefusedError("a path's times must begin at 0 and increase")
    return JointPath(times, joints)


@dataclass(frozen=True, eq=False)
class PourPath:
    """A whole pour for the arm: checked and ready for execution.

    Attributes:
        approach: from home to the pour's start, the pourer upright.
        pour: tilt, hold, return.
        retreat: back home.
        tilts: (T,) of the pourer at `pour.times` [rad].
        phases: (name, start, end) of the pour's parts [s].
        report: results of the checks.
        calibration: checksum of the robot's calibration with which it was planned; '' for nominal lengths, None for a
            path that was not made from poses.
    """

    approach: JointPath
    pour: JointPath
    retreat: JointPath
    tilts: FloatArray
    phases: tuple[tuple[str, float, float], ...]
    report: PathReport
    calibration: str | None = None

    @property
    def approach_time(self) -> float:
        """Duration [s]."""
        return self.approach.duration

    @property
    def pour_time(self) -> float:
        """Duration [s]."""
        return self.pour.duration

    @property
    def retreat_time(self) -> float:
        """Duration [s]."""
        return self.retreat.duration

    @property
    def tilt_part(self) -> tuple[FloatArray, FloatArray]:
        """Increasing tilts of the first phase, (T,) [rad], and the joints at them, (T, n) [rad]."""
        during = self.pour.times <= self.phases[0][2] + 1e-9
        tilts, joints = self.tilts[during], self.pour.joints[during]
        rising = np.concatenate([[True], tilts[1:] > np.maximum.accumulate(tilts)[:-1] + 1e-5])
        return tilts[rising], joints[rising]

    def slowed(self, factor: float) -> PourPath:
        """The same path with all its times divided by a factor in (0, 1]."""
        if factor == 1.0:
            return self
        approach, pour, retreat = (
            JointPath(path.times / factor, path.joints) for path in (self.approach, self.pour, self.retreat)
        )
        r = self.report
        return PourPath(
            approach,
            pour,
            retreat,
            self.tilts,
            tuple((name, start / factor, end / factor) for name, start, end in self.phases),
            replace(
                r,
                joint_speed=factor * r.joint_speed,
                tool_speed=factor * r.tool_speed,
                tilt_speed=factor * r.tilt_speed,
                duration=r.duration / factor,
            ),
            self.calibration,
        )


@dataclass(frozen=True, eq=False)
class PlaceWay:
    """A way from home to a place where vessels stand, and back by the same points.

    Attributes:
        place: name of the place.
        approach: from home to the place.
        calibration: as in `PourPath`.
        homewards: whether it is to be driven back home.
    """

    place: str
    approach: JointPath
    calibration: str | None = None
    homewards: bool = False

    @property
    def retreat(self) -> JointPath:
        """From the place to home."""
        return JointPath(self.approach.times[-1] - self.approach.times[::-1], self.approach.joints[::-1])

    @property
    def approach_time(self) -> float:
        """Duration of one way [s]."""
        return self.approach.duration

    @property
    def retreat_time(self) -> float:
        """Duration of one way [s]."""
        return self.approach.duration

    def slowed(self, factor: float) -> PlaceWay:
        """The same way with all its times divided by a factor in (0, 1]."""
        return replace(self, approach=JointPath(self.approach.times / factor, self.approach.joints))


@dataclass(frozen=True, eq=False)
class ExecutedPath:
    """The motion that an arm's own encoders measured; a driver may fill gaps between two readings on the planned path.

    Attributes:
        times: (T,) since the path's start, increasing from 0 [s of controller time], at 100 Hz or more where the arm
            followed its path.
        joints: (T, n) [rad].
        completed: False if it was stopped before its end.
        tracking: errors in following the path: 'rms_angle', 'max_angle' [rad] of the joints, 'rms_tool', 'max_tool'
            [m], the 'lag' [s] that was removed from them, and the 'longest_gap' between two readings [s].
        poses: of the pourer in the world, (T, 7); empty if the cell is unknown, as after `unpack`.
        forces: rows of time [s], external force and torque at the TCP (6) [N], [N m], and of the wrist's sensor (6)
            likewise, in its own frame, shifted by an unknown constant with each motion. NaN if the robot does not
            report them.
    """

    times: FloatArray
    joints: FloatArray
    completed: bool
    tracking: dict[str, float] = field(default_factory=dict)
    poses: FloatArray = field(default_factory=lambda: np.zeros((0, 7)))
    forces: FloatArray = field(default_factory=lambda: np.zeros((0, 13)))

    def record(self) -> dict[str, Any]:
        """See `actors.arm.arm_interface.Executed`."""
        return pack(self)


def pack(executed: ExecutedPath) -> dict[str, Any]:
    """Convert to JSON-ready values; a ten-second pour at 125 Hz takes about ten kilobytes.

    Args:
        executed: as read back.
    """
    columns = np.column_stack([executed.times / TIME_UNIT, executed.joints / JOINT_UNIT])
    integers = np.round(columns).astype("<i4")
    data = np.diff(integers, axis=0, prepend=np.zeros((1, columns.shape[1]), "<i4")).astype("<i4").T.tobytes()
    return {
        "samples": len(integers),
        "completed": executed.completed,
        "tracking": dict(executed.tracking),
        "packed": base64.b85encode(zlib.compress(data, 9)).decode("ascii"),
        **_forces(executed.forces),
    }


def _forces(forces: FloatArray) -> dict[str, Any]:
    """Forces in hundredths, each kind only if it was reported."""
    kinds = {"external_force": forces[:, 1:7], "wrist_force": forces[:, 7:]}
    series = {name: np.round(rows, 2).tolist() for name, rows in kinds.items() if np.isfinite(rows).any()}
    return {"forces": {"times": np.round(forces[:, 0], 2).tolist(), **series}} if series else {}


def unpack(data: dict[str, Any]) -> ExecutedPath:
    """Inverse of `pack`. Of readings that are nearer than `TIME_UNIT` and have equal times there, the first is kept.

    Raises:
        ValueError: `pack` did not make these values.
    """
    try:
        raw = zlib.decompress(base64.b85decode(data["packed"]))
        steps = np.frombuffer(raw, "<i4").reshape(-1, int(data["samples"])).T if raw else np.zeros((0, 7), "<i4")
        integers = np.cumsum(steps, axis=0)
        integers = integers[np.diff(integers[:, 0], prepend=-1) > 0]
        times, joints = integers[:, 0].astype(float) * TIME_UNIT, integers[:, 1:].astype(float) * JOINT_UNIT
        return ExecutedPath(times, joints, bool(data["completed"]), dict(data["tracking"]))
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise ValueError(f"not an executed path: {error!r}") from error


def slipped(motion: SampledMotion, grip_tilt: float) -> SampledMotion:
    """The motion of a pourer that is rotated in the grip by `grip_tilt` [rad] about the y axis of its underside."""
    c, s = math.cos(0.5 * grip_tilt), math.sin(0.5 * grip_tilt)
    w, x, y, z = (motion.poses[:, k] for k in range(3, 7))
    turned = np.stack([c * w - s * y, c * x - s * z, c * y + s * w, c * z + s * x], axis=-1)
    return SampledMotion(motion.times, np.concatenate([motion.poses[:, :3], turned], axis=-1))


@dataclass(frozen=True, eq=False)
class MotionPath:
    """A pour for an arm that makes any motion and does not use joints: the motion itself.

    Attributes:
        motion: of the pourer.
        approach_time, retreat_time: durations of the ways there and back [s].
        factor: of its speed.
    """

    motion: PourMotion
    approach_time: float = 4.0
    retreat_time: float = 0.0
    factor: float = 1.0

    @property
    def pour_time(self) -> float:
        """Duration [s]."""
        return self.motion.duration / self.factor

    @property
    def phases(self) -> tuple[tuple[str, float, float], ...]:
        """See `PlannedPour.phases`."""
        return tuple((phase.name, phase.start / self.factor, phase.end / self.factor) for phase in self.motion.phases)

    def tilt(self, times: FloatArray) -> FloatArray:
        """Tilt of the pourer at times of the pour, shape (T,) [rad]."""
        return self.motion.tilt(times * self.factor)

    def poses(self, times: FloatArray) -> FloatArray:
        """Poses of the pourer in the world at times of the pour, shape (T, 7)."""
        return self.motion.sample(times * self.factor)

    def slowed(self, factor: float) -> MotionPath:
        """See `PlannedPour.slowed`."""
        return replace(self, factor=self.factor * factor)

    @property
    def report(self) -> PathReport:
        """See `PlannedPour.report`."""
        return motion_report(self.motion, self.approach_time + self.retreat_time, self.factor)


def motion_report(motion: PourMotion, travel_time: float = 0.0, factor: float = 1.0) -> PathReport:
    """The report of a motion, for arms that do not use joints: the pourer's origin represents the tool.

    Args:
        motion: of the pourer.
        travel_time: of the ways there and back together [s].
        factor: of the motion's speed.
    """
    times = np.linspace(0.0, motion.duration, 500)
    poses, tilts = motion.sample(times), motion.tilt(times)
    step = times[1] / factor
    low, high = poses[:, :3].min(axis=0), poses[:, :3].max(axis=0)
    return PathReport(
        joint_speed=0.0,
        fastest_joint=0,
        tool_speed=float(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=-1).max() / step),
        tilt=float(np.abs(tilts).max()),
        tilt_speed=float(np.abs(np.diff(tilts)).max() / step),
        singularity=1.0,
        clearance=0.0,
        low=(float(low[0]), float(low[1]), float(low[2])),
        high=(float(high[0]), float(high[1]), float(high[2])),
        duration=motion.duration / factor + travel_time,
    )


@dataclass(frozen=True, eq=False)
class ExecutedMotion:
    """See `actors.arm.arm_interface.Executed`; poses as the arm read them back.

    Attributes:
        times: shape (T,) [s].
        poses: shape (T, 7).
        completed: False if it was stopped before its end.
    """

    times: FloatArray
    poses: FloatArray
    completed: bool
    tracking: Mapping[str, float] = field(default_factory=dict)

    @property
    def motion(self) -> SampledMotion:
        """The executed motion, which can be simulated again."""
        return SampledMotion(self.times, self.poses)

    def record(self) -> dict[str, Any]:
        """See `Executed.record`: empty, since the action describes the motion completely."""
        return {}
