"""Straight lines in joint space and in tool space, blends between two of a kind, and speed profiles.

`JointLine` and `ToolLine` implement `Line`; `Corner` is the blend between two lines. `Profile` is a trapezoidal speed
profile along a path, between any two end speeds.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import Protocol

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.robot_kinematics import (
    Kinematics,
    Transform,
    Vector,
    compose,
    distance,
    invert,
    multiply,
    norm3,
    rotation_between,
    rotation_matrix,
)


class UnreachableError(Exception):
    """A point of a path, or its target, is outside the tool's workspace."""


class Line(Protocol):
    """A path between two points, parameterised by its length s, 0 … `length`."""

    length: float

    def at(self, s: float, near: Joints) -> Joints:
        """Joint positions at s [rad].

        Raises:
            UnreachableError: there are none.
        """
        ...

    def distance_to_end(self, s: float) -> float:
        """Distance of the tool to the end [m]; blend radii refer to it."""
        ...

    def speed_limit(self, limits: Joints) -> float:
        """Highest speed along the line that the joint limits allow, as far as known in advance."""
        ...


class KinematicArm:
    """Kinematics with the current tool.

    Args:
        kinematics: of the model.
        tool: tool centre point in the flange's frame.
    """

    def __init__(self, kinematics: Kinematics, tool: Transform) -> None:
        self.kinematics = kinematics
        self.tool = tool
        self._back = invert(tool)

    def frame(self, q: Joints) -> Transform:
        """Transform of the tool centre point."""
        return compose(self.kinematics.flange(q), self.tool)

    def joints(self, frame: Transform, near: Joints) -> Joints:
        """Joint positions for a transform of the tool centre point, nearest to the given ones.

        Raises:
            UnreachableError: there are none.
        """
        q = self.kinematics.nearest(compose(frame, self._back), near)
        if q is None:
            x, y, z = frame[1]
            raise UnreachableError(f"no joint positions for a tool at [{x:.4f}, {y:.4f}, {z:.4f}] m")
        return q


class JointLine:
    """All joints move in proportion; s is the angle of the joint with the largest motion [rad].

    Args:
        arm: computes tool distances.
        start, end: joint positions [rad].
    """

    def __init__(self, arm: KinematicArm, start: Joints, end: Joints) -> None:
        self.start, self.end = start, end
        self._arm = arm
        self.delta = tuple(b - a for a, b in zip(start, end, strict=True))
        self.length = max(abs(d) for d in self.delta)

    def at(self, s: float, near: Joints) -> Joints:
        """See `Line.at`."""
        k = s / self.length if self.length else 1.0
        a, d = self.start, self.delta
        return (
            a[0] + k * d[0],
            a[1] + k * d[1],
            a[2] + k * d[2],
            a[3] + k * d[3],
            a[4] + k * d[4],
            a[5] + k * d[5],
        )

    def distance_to_end(self, s: float) -> float:
        """See `Line.distance_to_end`."""
        return distance(self._arm.frame(self.at(s, self.start))[1], self._arm.frame(self.end)[1])

    def speed_limit(self, limits: Joints) -> float:
        """See `Line.speed_limit`."""
        rates = [limit * self.length / abs(d) for limit, d in zip(limits, self.delta, strict=True) if d]
        return min(rates, default=1.0)


class ToolLine:
    """The tool moves straight while it turns about one axis; s is the larger of distance [m] and angle [rad].

    Args:
        arm: kinematics and tool.
        start, end: of the tool centre point.
    """

    def __init__(self, arm: KinematicArm, start: Transform, end: Transform) -> None:
        self.arm = arm
        self.start, self.end = start, end
        self.shift: Vector = (end[1][0] - start[1][0], end[1][1] - start[1][1], end[1][2] - start[1][2])
        self.turn = rotation_between(start[0], end[0])
        self.length = max(norm3(self.shift), norm3(self.turn))

    def frame(self, s: float) -> Transform:
        """Transform of the tool centre point at s."""
        k = s / self.length if self.length else 1.0
        (x, y, z), (dx, dy, dz), (rx, ry, rz) = self.start[1], self.shift, self.turn
        turned = multiply(self.start[0], rotation_matrix((k * rx, k * ry, k * rz)))
        return turned, (x + k * dx, y + k * dy, z + k * dz)

    def at(self, s: float, near: Joints) -> Joints:
        """See `Line.at`."""
        return self.arm.joints(self.frame(s), near)

    def distance_to_end(self, s: float) -> float:
        """See `Line.distance_to_end`."""
        return norm3(self.shift) * (1.0 - s / self.length) if self.length else 0.0

    def speed_limit(self, limits: Joints) -> float:
        """See `Line.speed_limit`; unknown in advance, so infinite."""
        return float("inf")


class Corner:
    """A blend from one line into the next without a stop: a parabola tangent to both, with constant acceleration.

    Args:
        before, after: lines of one kind; the corner is where `before` ends and `after` starts.
        into: distance to the corner at which the blend leaves `before`.
        out: distance from the corner at which the blend joins `after`.
    """

    def __init__(self, before: Line, after: Line, into: float, out: float) -> None:
        self._before, self._after, self._into, self._out = before, after, into, out

    @staticmethod
    def fits(before: Line, after: Line) -> bool:
        """Whether both lines are of one kind."""
        return type(before) is type(after)

    def at(self, k: float, near: Joints) -> Joints:
        """Joint positions at fraction k of the blend's time.

        Raises:
            UnreachableError: there are none.
        """
        w1, w2 = (1.0 - k) ** 2 * self._into, k**2 * self._out
        if isinstance(self._before, JointLine) and isinstance(self._after, JointLine):
            earlier, two = self._before, self._after
            q = [
                c - w1 * d1 / earlier.length + w2 * d2 / two.length
                for c, d1, d2 in zip(two.start, earlier.delta, two.delta, strict=True)
            ]
            return q[0], q[1], q[2], q[3], q[4], q[5]
        assert isinstance(self._before, ToolLine)
        assert isinstance(self._after, ToolLine)
        first, second = self._before, self._after
        k1, k2 = w1 / first.length, w2 / second.length
        x, y, z = second.start[1]
        turn = [k2 * b - k1 * a for a, b in zip(first.turn, second.turn, strict=True)]
        frame = (
            multiply(second.start[0], rotation_matrix(turn)),
            (
                x - k1 * first.shift[0] + k2 * second.shift[0],
                y - k1 * first.shift[1] + k2 * second.shift[1],
                z - k1 * first.shift[2] + k2 * second.shift[2],
            ),
        )
        return second.arm.joints(frame, near)


class Profile:
    """Distance over time: accelerate, cruise, decelerate.

    Args:
        length: of the path; > 0 or the profile is empty.
        speed: maximum speed.
        acceleration: maximum acceleration and deceleration; exceeded only if the path is too short to stop with it.
        start, end: speeds at both ends. `end` is an upper limit: a short path may not allow it.

    Attributes:
        duration: [s].
        end: speed at the end.
    """

    def __init__(self, length: float, speed: float, acceleration: float, start: float = 0.0, end: float = 0.0) -> None:
        length, speed, acceleration = max(length, 0.0), max(speed, 1e-9), max(acceleration, 1e-9)
        end = min(end, speed)
        self.length = length
        if start * start - end * end > 2.0 * acceleration * length:
            # The path is too short to reach `end` with the given deceleration: use a higher one.
            acceleration = (start * start - end * end) / (2.0 * length) if length > 0.0 else inf
        end = min(end, sqrt(start * start + 2.0 * acceleration * length)) if acceleration < inf else end
        self.start, self.end, self.acceleration = start, end, acceleration
        if length == 0.0:
            self.peak, self.t1, self.t2, self.duration = start, 0.0, 0.0, 0.0
            return
        self.peak = min(speed, sqrt(acceleration * length + 0.5 * (start * start + end * end)))
        up = abs(self.peak - start) / acceleration
        down = (self.peak - end) / acceleration
        cruise = length - 0.5 * (start + self.peak) * up - 0.5 * (self.peak + end) * down
        self.t1 = up
        self.t2 = up + max(cruise, 0.0) / self.peak
        self.duration = self.t2 + down

    @classmethod
    def timed(cls, length: float, duration: float, acceleration: float) -> Profile:
        """Return the profile from rest to rest with the given duration; the acceleration is raised if necessary."""
        acceleration = max(acceleration, 4.0 * length / duration**2)
        root = sqrt(max((acceleration * duration) ** 2 - 4.0 * acceleration * length, 0.0))
        return cls(length, 0.5 * (acceleration * duration - root), acceleration)

    def at(self, time: float) -> float:
        """Distance covered at a time since the start, clipped to the profile's range."""
        if time >= self.duration:
            return self.length
        if time <= 0.0:
            return 0.0
        sign = 1.0 if self.peak >= self.start else -1.0
        if time < self.t1:
            return self.start * time + 0.5 * sign * self.acceleration * time * time
        covered = 0.5 * (self.start + self.peak) * self.t1
        if time < self.t2:
            return covered + self.peak * (time - self.t1)
        left = self.duration - time
        return self.length - self.end * left - 0.5 * self.acceleration * left * left

    def speed(self, time: float) -> float:
        """Speed at a time since the start."""
        if time >= self.duration:
            return self.end
        if time < self.t1:
            sign = 1.0 if self.peak >= self.start else -1.0
            return self.start + sign * self.acceleration * max(time, 0.0)
        if time < self.t2:
            return self.peak
        return self.end + self.acceleration * (self.duration - time)
