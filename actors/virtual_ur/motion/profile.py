"""Trapezoidal profile of speed along a path, from any speed to any other."""

from __future__ import annotations

from math import inf, sqrt


class Profile:
    """Distance over time: accelerate, cruise, decelerate.

    Args:
        length: of the path; > 0 or the profile is empty.
        speed: at most.
        acceleration: and deceleration, at most; more is used only where the path is too short to stop with it.
        start, end: speeds at both ends. `end` is what it will be at most: a short path may not allow it.

    Attributes:
        duration: [s].
        end: speed at the end.
    """

    def __init__(self, length: float, speed: float, acceleration: float, start: float = 0.0, end: float = 0.0) -> None:
        length, speed, acceleration = max(length, 0.0), max(speed, 1e-9), max(acceleration, 1e-9)
        end = min(end, speed)
        self.length = length
        if start * start - end * end > 2.0 * acceleration * length:
            # Too short to come down to `end`: brake as hard as it takes.
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
        """The profile from rest to rest that takes just so long; harder acceleration where it must be."""
        acceleration = max(acceleration, 4.0 * length / duration**2)
        root = sqrt(max((acceleration * duration) ** 2 - 4.0 * acceleration * length, 0.0))
        return cls(length, 0.5 * (acceleration * duration - root), acceleration)

    def at(self, time: float) -> float:
        """Distance covered at a time since the start, both 0 … their ends."""
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
