"""The actions of the arm in a control cycle: following a path, servoing, holding a speed, stopping.

Every action implements `MotionAction`; the `Mover` runs one action at a time. A `Path` follows a `JointLine` with the
speeds of a `Profile`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, sqrt
from typing import Protocol

from actors.arm.ur.robot_models import Joints

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
        """
        ...


class JointLine:
    """All joints move in proportion; s is the angle of the joint with the largest motion, 0 … `length` [rad].

    Args:
        start, end: joint positions [rad].
    """

    def __init__(self, start: Joints, end: Joints) -> None:
        self.start = start
        self.delta = tuple(b - a for a, b in zip(start, end, strict=True))
        self.length = max(abs(d) for d in self.delta)

    def at(self, s: float) -> Joints:
        """Joint positions at s [rad]."""
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

    def speed_limit(self, limits: Joints) -> float:
        """Highest speed along the line that the joint limits allow [rad/s]."""
        rates = [limit * self.length / abs(d) for limit, d in zip(limits, self.delta, strict=True) if d]
        return min(rates, default=1.0)


class Profile:
    """Distance over time, from rest to rest: accelerate, cruise, decelerate.

    Args:
        length: of the path; > 0 or the profile is empty.
        speed: maximum speed.
        acceleration: maximum acceleration and deceleration.

    Attributes:
        duration: [s].
    """

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        self.length, self.acceleration = max(length, 0.0), max(acceleration, 1e-9)
        self.peak = min(max(speed, 1e-9), sqrt(self.acceleration * self.length))
        self.duration = self.length / self.peak + self.peak / self.acceleration if self.length > 0.0 else 0.0

    @classmethod
    def timed(cls, length: float, duration: float, acceleration: float) -> Profile:
        """Return the profile with the given duration; the acceleration is raised if necessary."""
        acceleration = max(acceleration, 4.0 * length / duration**2)
        root = sqrt(max((acceleration * duration) ** 2 - 4.0 * acceleration * length, 0.0))
        return cls(length, 0.5 * (acceleration * duration - root), acceleration)

    def at(self, time: float) -> float:
        """Distance covered at a time since the start, clipped to the profile's range."""
        left = self.duration - time
        if left <= 0.0:
            return self.length
        ramp = self.peak / self.acceleration
        if time < ramp:
            return 0.5 * self.acceleration * max(time, 0.0) ** 2
        if left < ramp:
            return self.length - 0.5 * self.acceleration * left * left
        return self.peak * (time - 0.5 * ramp)


class Path:
    """Follows a line with a trapezoidal profile.

    Args:
        line: creates the line from its start positions, once the arm stands there.
        speed, acceleration: along the line.
        limits: joint speeds [rad/s].
        duration: if positive, the duration of the whole line [s].
        prelude: a stop that must end before.
    """

    def __init__(
        self,
        line: Callable[[Joints], JointLine],
        speed: float,
        acceleration: float,
        limits: Joints,
        *,
        duration: float = 0.0,
        prelude: MotionAction | None = None,
    ) -> None:
        self._make, self._speed, self._acceleration = line, speed, acceleration
        self._duration, self._limits, self._prelude = duration, limits, prelude
        self._line: JointLine | None = None
        self._time = 0.0
        self.finished = False

    def step(self, q: Joints, qd: Joints, dt: float) -> Joints:
        """See `MotionAction.step`."""
        if self._line is None:
            if self._prelude is not None and not self._prelude.finished:
                return self._prelude.step(q, qd, dt)
            line = self._line = self._make(q)
            self._profile = Profile(line.length, min(self._speed, line.speed_limit(self._limits)), self._acceleration)
            if self._duration > 0.0 and line.length > 0.0:
                self._profile = Profile.timed(line.length, self._duration, self._acceleration)
        self._time += dt
        self.finished = self._time >= self._profile.duration
        return self._line.at(self._profile.at(self._time))


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
