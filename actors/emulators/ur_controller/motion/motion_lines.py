"""Straight lines in joint space, and speed profiles along them."""

from __future__ import annotations

from math import sqrt

from actors.arm.ur.robot_models import Joints


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
