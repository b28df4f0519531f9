"""The actions of the arm in a control cycle: following a path, servoing, holding a speed, stopping.

Every class implements `MotionAction`; the `Mover` runs one action at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, sqrt
from typing import Protocol

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.motion.motion_lines import Corner, KinematicArm, Line, Profile, UnreachableError
from actors.emulators.ur_controller.robot_kinematics import Transform, multiply, norm3, rotation_matrix

STILL = 1e-9
"""Joint speed below which a joint counts as still [rad/s]."""


class MotionAction(Protocol):
    """One motion."""

    finished: bool

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """Return the joint positions one cycle later.

        Args:
            q, qd: current positions and speeds [rad], [rad/s].
            dt: time that passes for the motion [s]; less than the cycle time if motion is slowed down.

        Raises:
            UnreachableError: the path leaves the workspace.
        """
        ...


class Path:
    """Follows a line with a trapezoidal profile. It blends with the line before and, with a radius, with the next.

    Args:
        line: creates the line from its start positions, once the arm stands there or its corner is known.
        speed, acceleration: along the line.
        limits: joint speeds [rad/s].
        duration: if positive, the duration of the whole line [s].
        radius: of the blend at its end [m]; 0 stops there.
        prelude: action that must end before. If it is a path on its way to a corner and both lines are of one kind, the
            two are blended instead.

    Attributes:
        released: the next path may begin: the end is reached, or the blend's radius.
    """

    def __init__(
        self,
        line: Callable[[Joints], Line],
        speed: float,
        acceleration: float,
        limits: Joints,
        *,
        duration: float = 0.0,
        radius: float = 0.0,
        prelude: MotionAction | None = None,
    ) -> None:
        self._make, self._speed, self._acceleration = line, speed, acceleration
        self._duration, self._radius, self._limits = duration, radius, limits
        self._prelude = prelude
        self._line: Line | None = None
        self._corner: Corner | None = None
        self._corner_time = 0.0
        self._from = 0.0
        self._entry = 0.0
        self._time = 0.0
        self.finished = False
        self.released = False

    def _start(self, line: Line) -> Line:
        way = line.length - self._from
        speed = min(self._speed, line.speed_limit(self._limits))
        into = self._blend_distance(line, way) if self._radius > 0.0 else 0.0
        self._main = Profile(way - into, speed, self._acceleration, self._entry, speed if into else 0.0)
        if self._duration > 0.0 and self._corner is None and not into and way > 0.0:
            self._main = Profile.timed(way, self._duration, self._acceleration)
        # Used if no path follows: brake within the blend radius.
        self._tail = Profile(into, self._main.end, self._acceleration, self._main.end)
        self._line, self._prelude = line, None
        return line

    def _round(self, before: Path, q: Joints) -> Line | None:
        """Begin with a blend out of another path, if possible."""
        if before._line is None or not before.released or before.finished:
            return None
        done, speed = before._progress()
        into = before._line.length - done
        if speed <= 0.0 or into <= 0.0:
            return None
        line = self._make(before._line.at(before._line.length, q))
        if line.length <= 0.0 or not Corner.fits(before._line, line):
            return None
        self._corner_time = 2.0 * into / speed
        self._entry = min(self._speed, line.speed_limit(self._limits), line.length / self._corner_time)
        self._from = 0.5 * self._entry * self._corner_time
        self._corner = Corner(before._line, line, into, self._from)
        return self._start(line)

    def _blend_distance(self, line: Line, way: float) -> float:
        """Length of the line's end that lies within the blend radius: at most half of the line."""
        low, high = line.length - 0.5 * way, line.length
        if line.distance_to_end(low) <= self._radius:
            return high - low
        for _ in range(30):
            middle = 0.5 * (low + high)
            if line.distance_to_end(middle) > self._radius:
                low = middle
            else:
                high = middle
        return line.length - high

    @property
    def target(self) -> Line | None:
        """The line that is followed; None before it begins."""
        return self._line

    def _progress(self) -> tuple[float, float]:
        """Return the distance along the line, and the speed."""
        time = self._time - self._corner_time
        if time < self._main.duration:
            return self._from + self._main.at(time), self._main.speed(time)
        time -= self._main.duration
        return self._from + self._main.length + self._tail.at(time), self._tail.speed(time)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """See `MotionAction.step`."""
        line = self._line
        if line is None:
            before = self._prelude
            if isinstance(before, Path):
                line = self._round(before, q)
            if line is None and before is not None and not before.finished:
                return before.step(q, qd, dt)
            line = line or self._start(self._make(q))
        self._time += dt
        if self._corner is not None and self._time < self._corner_time:
            return self._corner.at(self._time / self._corner_time, q)
        passed = self._time - self._corner_time - self._main.duration
        self.released = passed >= 0.0
        self.finished = passed >= self._tail.duration
        return line.at(line.length if self.finished else self._progress()[0], q)


class Servo:
    """Moves towards a target that is set in each cycle, smoothed by a critically damped filter.

    For a target with constant speed, the delay is the lookahead time at gain 300; a higher gain shortens it. The filter
    is an assumption: the real controller's servoj filter is not published.
    """

    def __init__(self) -> None:
        self.finished = False
        self.target: Joints = (0.0,) * 6
        self.omega = 20.0
        self._velocity: list[float] | None = None

    def aim(self, target: Joints, lookahead: float, gain: float) -> None:
        """Set target [rad], lookahead time [s] and gain (dimensionless)."""
        self.target = target
        self.omega = 2.0 / max(lookahead, 0.005) * sqrt(max(gain, 1.0) / 300.0)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """See `MotionAction.step`."""
        if self._velocity is None:
            self._velocity = list(qd)
        decay = exp(-self.omega * dt)
        result = []
        for i in range(6):
            error = q[i] - self.target[i]
            push = (self._velocity[i] + self.omega * error) * dt
            result.append(self.target[i] + (error + push) * decay)
            self._velocity[i] = (self._velocity[i] - self.omega * push) * decay
        return result[0], result[1], result[2], result[3], result[4], result[5]


class JointSpeed:
    """Approaches joint speeds; the joint with the largest change uses the given acceleration. A target of 0 is a stop.

    Args:
        target: [rad/s].
        acceleration: [rad/s²].
    """

    def __init__(self, target: Sequence[float], acceleration: float) -> None:
        self.aim(target, acceleration)
        self.finished = False

    def aim(self, target: Sequence[float], acceleration: float) -> None:
        """Set a new target."""
        self.target, self.acceleration = tuple(target), acceleration
        self._stops = not any(self.target)

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """See `MotionAction.step`."""
        if dt <= 0.0:
            return q
        change = [t - v for t, v in zip(self.target, qd, strict=True)]
        most = max(abs(c) for c in change)
        share = 1.0 if most <= self.acceleration * dt else self.acceleration * dt / most
        self.finished = self._stops and share == 1.0
        r = [a + dt * (v + share * c) for a, v, c in zip(q, qd, change, strict=True)]
        return r[0], r[1], r[2], r[3], r[4], r[5]


class ToolSpeed:
    """Approaches a tool velocity; a target of 0 is a stop along the current path.

    Args:
        arm: kinematics and tool.
        target: vx vy vz wx wy wz in the base's axes [m/s], [rad/s].
        acceleration: [m/s²].
        turning: [rad/s²].
    """

    def __init__(self, arm: KinematicArm, target: Sequence[float], acceleration: float, turning: float) -> None:
        self.finished = False
        self._arm = arm
        self._frame: Transform | None = None
        self._velocity: list[float] = [0.0] * 6
        self.aim(target, acceleration, turning)

    def aim(self, target: Sequence[float], acceleration: float, turning: float) -> None:
        """Set a new target."""
        self.target, self.acceleration, self.turning = tuple(target), acceleration, turning
        self._stops = not any(self.target)
        self._ceiling: float | None = None

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """See `MotionAction.step`."""
        if dt <= 0.0:
            return q
        if self._frame is None:
            self._frame = self._arm.frame(q)
            self._velocity = list(self._arm.kinematics.velocity(q, qd, self._frame[1]))
        change = [t - v for t, v in zip(self.target, self._velocity, strict=True)]
        most = max(norm3(change[:3]) / self.acceleration, norm3(change[3:]) / self.turning)
        share = 1.0 if most <= dt else dt / most
        v = self._velocity = [v + share * c for v, c in zip(self._velocity, change, strict=True)]
        self.finished = self._stops and share == 1.0
        rotation, (x, y, z) = self._frame
        turned = multiply(rotation_matrix((v[3] * dt, v[4] * dt, v[5] * dt)), rotation)
        self._frame = (turned, (x + v[0] * dt, y + v[1] * dt, z + v[2] * dt))
        joints = self._arm.joints(self._frame, q)
        if self._stops and self._ceiling is None:
            self._ceiling = 1.2 * max(abs(v) for v in qd)
        if self._ceiling is not None and max(abs(b - a) for a, b in zip(q, joints, strict=True)) > self._ceiling * dt:
            raise UnreachableError("near a singularity a straight stop would make a joint faster")
        return joints
