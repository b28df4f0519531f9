"""A robot at the end of a cable, for the example `seven_joints.py`."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class SimulatedRobot:
    """A robot that follows joint trajectories. It measures its joints, and keeps all measurements, as the independent
    witness of the driver's tests.

    Args:
        joints: where it stands [rad].
        time_scale: seconds of the robot per second of the clock.

    Attributes:
        slip: share of each turn of the last joint that its gear loses.
        plugged: its cable is connected; without it, the robot stops.
        tripped: a protective stop is in force; it ends at the robot, not over the cable.
        readings: time [s] and joints [rad] of each measurement.
    """

    LAG = 0.02
    """Time constant with which the joints follow [s]."""

    def __init__(self, joints: tuple[float, ...], time_scale: float) -> None:
        self._scale, self._lock = time_scale, threading.Lock()
        self._joints = np.array(joints)
        self._path: tuple[float, FloatArray, FloatArray] | None = None
        self._now = time.monotonic() * time_scale
        self.slip, self.plugged, self.tripped = 0.0, True, False
        self.readings: list[tuple[float, FloatArray]] = []

    def measure(self) -> tuple[float, FloatArray]:
        """Read the encoders: time [s] and joints [rad]."""
        with self._lock:
            now = time.monotonic() * self._scale
            if self.tripped or not self.plugged:
                self._path = None
            while self._path is not None and self._now < now:
                self._now = min(self._now + 0.005, now)
                begun, times, joints = self._path
                wanted = np.array([np.interp(self._now - begun, times, column) for column in joints.T])
                wanted[-1] -= self.slip * (wanted[-1] - joints[0, -1])
                self._joints = self._joints + (1.0 - math.exp(-0.005 / self.LAG)) * (wanted - self._joints)
            self._now = now
            self.readings.append((now, self._joints))
            return self.readings[-1]

    def read(self) -> tuple[float, FloatArray, bool]:
        """Time [s], joints [rad], and whether a protective stop is in force, over the cable.

        Raises:
            ConnectionError: the cable is not connected.
        """
        moment, joints = self.measure()
        if not self.plugged:
            raise ConnectionError("the robot does not answer")
        return moment, joints, self.tripped

    def follow(self, times: FloatArray, joints: FloatArray) -> None:
        """Follow a trajectory from now on. Raises as `read`."""
        begun, _, _ = self.read()
        with self._lock:
            self._path = begun, times, joints

    def hold(self) -> None:
        """Stand. Raises as `read`."""
        self.read()
        with self._lock:
            self._path = None
