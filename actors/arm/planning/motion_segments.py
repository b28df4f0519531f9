"""Motion segments: a pour's phases, the way back after a stop, and small steps for setting up.

- `MotionSegment` is a path with names for its phases and messages about its interruption.
- `upright_way` and `way_home` lead slowly from where an arm was stopped back to home, along the checked paths.
- `jog_path` makes small steps, checked and limited, as paths like any other.

These functions are pure: nothing here moves an arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from actors.arm.arm_interface import ArmRefusedError, ArmStoppedError
from actors.arm.joint_arm import JointArmSettings, UnreachedError
from actors.arm.planned_pour import ExecutedPath, FloatArray, JointPath, PlaceWay, PourPath, checked
from actors.arm.planning.kinematics import cell_transforms, flange_transforms, pourer_transforms
from actors.arm.planning.path_checks import outside

OFF_PATH = 0.1
"""Joints farther than this from every point of a path are not on it [rad]; the arm was moved by other means."""

HARDLY = 0.01
"""Joints closer than this to a point count as at that point [rad]."""

RAMP = 0.6
"""Time to accelerate, and to decelerate [s]."""

_GRID = 0.02


def leans(joints: FloatArray, spec: JointArmSettings) -> FloatArray:
    """Tilt of the pourer for joints (T, n) [rad], shape (T,) [rad]."""
    tilts: FloatArray = np.arccos(np.clip(pourer_transforms(joints, spec).rotation[..., 2, 2], -1.0, 1.0))
    return tilts


def rejoin(path: JointPath, joints: FloatArray) -> tuple[float, float]:
    """The position of an arm on a path.

    Args:
        path: any.
        joints: (n,) [rad].

    Returns:
        Time of the nearest point of the path [s], and the largest distance of any joint from it [rad].
    """
    begin, along = path.joints[:-1], np.diff(path.joints, axis=0)
    squares = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", joints - begin, along) / np.where(squares > 0.0, squares, 1.0)
    share = np.clip(share, 0.0, 1.0)
    apart = np.abs(begin + share[:, None] * along - joints)
    nearest = int(np.argmin(np.einsum("ij,ij->i", apart, apart)))
    time = path.times[nearest] + share[nearest] * (path.times[nearest + 1] - path.times[nearest])
    return float(time), float(apart[nearest].max())


def upright_way(
    path: PourPath, joints: FloatArray, spec: JointArmSettings, ramp: float = RAMP
) -> tuple[JointPath, FloatArray]:
    """From a stopped pour to an upright pourer: back along the path, or forward if the pourer was already returning.

    Args:
        path: that was being executed.
        joints: (n,) where the arm stands [rad].
        spec: its speeds.
        ramp: time in which it reaches its speed [s].

    Returns:
        The way, from rest to rest, and the pourer's tilt at its times [rad].

    Raises:
        ArmRefusedError: the arm does not stand on the path.
    """
    start, apart = rejoin(path.pour, joints)
    if apart > OFF_PATH:
        raise ArmRefusedError(_astray("the pour's path", apart, "bring the pourer upright at the pendant, by hand"))
    tilt = float(np.interp(start, path.pour.times, path.tilts))
    back, on = _between(path.pour.times, start, 0.0), _between(path.pour.times, start, path.pour.duration)
    back_tilts, on_tilts = (np.interp(times, path.pour.times, path.tilts) for times in (back, on))
    goes_back = back_tilts.max() <= max(on_tilts.max(), tilt + 1e-3)
    times, tilts = (back, back_tilts) if goes_back else (on, on_tilts)
    points = np.vstack([joints, path.pour.at(times)])
    tilts = np.concatenate([[tilt], tilts])
    turning = np.abs(np.diff(tilts)) / spec.upright_speed
    costs = np.maximum(turning, np.abs(np.diff(points, axis=0)).max(axis=1) / (0.5 * spec.approach_speed))
    return _paced(points, tilts, costs, ramp)


def way_home(path: PourPath | PlaceWay, joints: FloatArray, spec: JointArmSettings) -> JointPath:
    """From any upright point of the approach or the retreat to home.

    Args:
        path: that was being executed.
        joints: (n,) where the arm stands [rad].
        spec: its speeds.

    Raises:
        ArmRefusedError: the arm stands on neither way.
    """
    if np.abs(path.retreat.joints[0] - joints).max() <= HARDLY:
        return path.retreat
    on, off_retreat = rejoin(path.retreat, joints)
    back, off_approach = rejoin(path.approach, joints)
    apart = min(off_retreat, off_approach)
    if apart > OFF_PATH:
        raise ArmRefusedError(_astray("the way home", apart, "un-tilt the pourer first, or bring the arm home by hand"))
    if off_retreat <= off_approach:
        chosen, times = path.retreat, _between(path.retreat.times, on, path.retreat.duration)
    else:
        chosen, times = path.approach, _between(path.approach.times, back, 0.0)
    points = np.vstack([joints, chosen.at(times)])
    # A way back may begin tilted, after a pour without a return.
    turning = np.abs(np.diff(leans(points, spec))) / spec.upright_speed
    costs = np.maximum(turning, np.abs(np.diff(points, axis=0)).max(axis=1) / (0.5 * spec.approach_speed))
    return _paced(points, np.zeros(len(points)), costs)[0]


def _between(times: FloatArray, start: float, end: float) -> FloatArray:
    """A path's times from one to another, in the order in which they are passed."""
    low, high = min(start, end), max(start, end)
    inner = times[(times > low) & (times < high)]
    chosen = np.concatenate([[low], inner, [high]])
    return chosen if end >= start else chosen[::-1]


def _paced(
    points: FloatArray, tilts: FloatArray, costs: FloatArray, ramp: float = RAMP
) -> tuple[JointPath, FloatArray]:
    """Pass points one after another, each part within at most its time [s], with a smooth start and end."""
    along = np.concatenate([[0.0], np.cumsum(costs)])
    length = float(along[-1])
    ramp = min(ramp, max(length, 1e-3))
    duration = max(length + ramp, 0.1)
    times = np.linspace(0.0, duration, max(3, int(duration / _GRID)))
    done = np.where(times < ramp, times**2 / (2.0 * ramp), times - 0.5 * ramp)
    left = np.where(duration - times < ramp, (duration - times) ** 2 / (2.0 * ramp), duration - times - 0.5 * ramp)
    place = np.where(times < 0.5 * duration, done, duration - ramp - left) * length / max(duration - ramp, 1e-9)
    place = np.clip(place, 0.0, length)
    joints = np.stack([np.interp(place, along, column) for column in points.T], axis=-1)
    joints[0], joints[-1] = points[0], points[-1]
    return JointPath(times, joints), np.interp(place, along, tilts)


def _astray(where: str, apart: float, remedy: str) -> str:
    return f"the arm does not stand on {where}: a joint is {np.degrees(apart):.1f}° away from it; {remedy}"


class Ending(Protocol):
    """How a motion ended; see `actors.arm.ur.worker_messages.MotionOutcome`."""

    @property
    def kind(self) -> str:
        """'completed', or why it was interrupted, see `ArmStoppedError`."""
        ...

    @property
    def text(self) -> str:
        """The reason, as a message."""
        ...

    @property
    def clock(self) -> float:
        """Time on the path where it ended [s]."""
        ...

    @property
    def joints(self) -> Sequence[float]:
        """Where the arm stands [rad]; as last seen, if `standing` is None."""
        ...

    @property
    def standing(self) -> float | None:
        """When it was first seen at rest [s of `time.monotonic`]."""
        ...


UPRIGHT = 0.02
"""Tilts below this are not mentioned in messages [rad]."""


@dataclass(frozen=True, eq=False)
class MotionSegment:
    """One motion, with the names of its phases.

    Attributes:
        path: the path.
        phases: (name, start, end) [s].
        tilts: of the pourer at the path's times [rad].
    """

    path: JointPath
    phases: tuple[tuple[str, float, float], ...]
    tilts: FloatArray

    @classmethod
    def of(cls, name: str, path: JointPath, spec: JointArmSettings) -> MotionSegment:
        """A segment of one phase.

        Raises:
            ArmRefusedError: the path is invalid.
        """
        path = checked(path, len(spec.home_joints))
        return cls(path, ((name, 0.0, path.duration),), leans(path.joints, spec))

    @classmethod
    def of_pour(cls, path: PourPath) -> MotionSegment:
        """A pour's tilt, hold and return.

        Raises:
            ArmRefusedError: the path is invalid.
        """
        if path.tilts.shape != path.pour.times.shape or not path.phases:
            raise ArmRefusedError("a pour's path has a tilt for each of its times, and phases")
        return cls(checked(path.pour, path.approach.joints.shape[1]), path.phases, path.tilts)

    def slowed(self, factor: float) -> MotionSegment:
        """The same motion at a fraction of its speed."""
        path = JointPath(self.path.times / factor, self.path.joints)
        phases = tuple((name, start / factor, end / factor) for name, start, end in self.phases)
        return MotionSegment(path, phases, self.tilts)

    @property
    def name(self) -> str:
        """Name of its first phase."""
        return self.phases[0][0]

    def phase(self, time: float) -> str:
        """The phase at a time [s]."""
        return next((name for name, _, end in self.phases if time < end), self.phases[-1][0])

    def tilt(self, time: float) -> float:
        """Tilt of the pourer at a time [rad]."""
        return float(np.interp(time, self.path.times, self.tilts))

    def tilt_left(self, outcome: Ending) -> float:
        """Tilt of the pourer after a stop [rad]; the arm still braked for a while after the path's clock stopped."""
        if outcome.standing is not None:
            time, apart = rejoin(self.path, np.array(outcome.joints))
            if apart <= HARDLY:
                return self.tilt(time)
        return self.tilt(outcome.clock)

    def stopped(self, outcome: Ending, executed: ExecutedPath) -> ArmStoppedError:
        """The error for an interrupted motion."""
        phase, tilt = self.phase(outcome.clock), self.tilt_left(outcome)
        tilted = f", the pourer tilted by {np.degrees(tilt):.0f}°" if tilt > UPRIGHT else ""
        return ArmStoppedError(
            f"{outcome.kind} during {phase}, {outcome.clock:.2f} s after its begin{tilted}: {outcome.text}. "
            "The arm holds still; look into it, then release",
            *(outcome.kind, phase, outcome.clock, tilt, executed),
        )

    def last_seen(self, clock: float) -> str:
        """The message about a motion whose connection was lost."""
        return (
            f"Last seen during {self.phase(clock)}, {clock:.2f} s after its begin, the pourer tilted by "
            f"{np.degrees(self.tilt(clock)):.0f}°"
        )


FARTHEST_TURN, FARTHEST_WAY = math.radians(10.0), 0.05
"""The largest single step [rad], [m]."""

FASTEST_TURN, FASTEST_WAY = math.radians(20.0), 0.1
"""[rad/s], [m/s]."""

AXES = ("x", "y", "z", "rx", "ry", "rz")
_POINTS = 101


def jog_path(spec: JointArmSettings, joints: Sequence[float], axis: str, amount: float, speed: float) -> JointPath:
    """One step from the arm's present pose.

    Args:
        spec: limits and tool.
        joints: present ones [rad].
        axis: see `actors.arm.arm_interface.Arm.jog`.
        amount: [rad] or [m].
        speed: [rad/s] or [m/s].

    Raises:
        ArmRefusedError: too far, too fast, out of reach, or outside the limits.
    """
    joint_axes = [f"joint {k}" for k in range(1, len(joints) + 1)]
    if axis not in (*AXES, *joint_axes):
        raise ArmRefusedError(f"no axis '{axis}'; there are {', '.join((*joint_axes, *AXES))}")
    straight = axis in ("x", "y", "z")
    farthest, fastest = (FARTHEST_WAY, FASTEST_WAY) if straight else (FARTHEST_TURN, FASTEST_TURN)
    if not 0.0 < abs(amount) <= farthest:
        raise ArmRefusedError(f"a step is at most 50 mm or 10°; {_show(amount, straight)} was asked for")
    if not 0.0 < speed <= fastest:
        raise ArmRefusedError(f"a step's speed is at most 100 mm/s or 20°/s; {_show(speed, straight)}/s was asked for")
    duration = max(2.0 * abs(amount) / speed, 0.2)
    times = np.linspace(0.0, duration, _POINTS)
    share = 0.5 - 0.5 * np.cos(np.pi * times / duration)  # its highest speed is π/2 times the mean, and below the limit
    start = np.array(joints)
    if axis in joint_axes:
        points = np.repeat(start[None], _POINTS, axis=0)
        points[:, joint_axes.index(axis)] += share * amount
    else:
        points = _tool_steps(spec, start, axis, share * amount)
    _check(spec, points)
    return JointPath(times, points)


def _tool_steps(spec: JointArmSettings, start: FloatArray, axis: str, amounts: FloatArray) -> FloatArray:
    model, tool = spec.kinematics, cell_transforms(spec).tool
    rotation, position = model.forward(start[None])
    rotations, positions = np.repeat(rotation, _POINTS, axis=0), np.repeat(position, _POINTS, axis=0)
    along = np.eye(3)[AXES.index(axis) % 3]
    if axis in ("x", "y", "z"):
        positions = positions + amounts[:, None] * along
    else:
        point = position + rotation @ tool.position
        turns = np.stack([_turn(along, angle) for angle in amounts])
        rotations = turns @ rotation
        positions = point - (rotations @ tool.position[None, :, None])[..., 0]
    try:
        return model.step(rotations, positions, start)
    except UnreachedError:
        raise ArmRefusedError("the arm can't make this step: out of its reach, or past a singularity") from None


def _turn(axis: FloatArray, angle: float) -> FloatArray:
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turned: FloatArray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return turned


def _check(spec: JointArmSettings, points: FloatArray) -> None:
    model = spec.kinematics
    for name, positions, low, high in zip(model.joint_names, points.T, model.joint_low, model.joint_high, strict=True):
        if positions.min() < low or positions.max() > high:
            raise ArmRefusedError(f"{name} would leave its range")
    flange = flange_transforms(points[[0, -1]], spec)
    frames = {"tool": cell_transforms(spec).tool.position, "pourer": cell_transforms(spec).pourer.position}
    for thing, place in frames.items():
        begin, end = flange.apply(place)
        # An arm outside the limits may move back inside: only steps that increase a violation are refused.
        if np.any(_beyond(end, spec) > np.maximum(_beyond(begin, spec), 0.0) + 1e-9):
            raise ArmRefusedError(f"the {thing} would be {', '.join(outside(end, spec))}")


def _beyond(point: FloatArray, spec: JointArmSettings) -> FloatArray:
    """Distance of a point beyond each limit [m], negative inside."""
    limits = spec.limits
    planes = [plane.offset - float(np.dot(plane.normal, point)) for plane in limits.planes]
    low, high = np.array(limits.box.low.vector) - point, point - np.array(limits.box.high.vector)
    return np.concatenate([low, high, planes, [spec.cell.table - point[2]]])


def _show(value: float, straight: bool) -> str:
    return f"{1e3 * value:.1f} mm" if straight else f"{math.degrees(value):.1f}°"
