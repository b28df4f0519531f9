"""A stand as an arm: a slide lifts the pourer, a motor turns it about its lip. All that an arm needs, in one file.

`Stand` is the driver, `Drive` what it moves, `StandSettings` what stands in a laboratory's file, and `StandKind` joins
them:

    arm: {kind: stand, fastest: 60 deg/s}
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

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
    ExecutedMotion,
    InvalidActionError,
    MotionPath,
    Pose,
    Problems,
    Quantity,
    RobotCell,
    Scene,
    plan_pour,
)

HOME_HEIGHT = 0.05
"""Where the slide waits, above where it pours [m]."""


class StandSettings(ArmSettings):
    """A stand whose motor turns the pourer."""

    kind: Literal["stand"] = "stand"
    """A stand with a motor."""

    fastest: Annotated[float, Quantity("rad/s", "90 deg/s", 0.0, 10.0, positive=True)] = math.radians(90.0)
    """Largest speed of its motor."""

    warning_time: Annotated[float, SET_BY_PROGRAM] = 0.5
    """Time from the operator's consent to the first movement [s]."""


class StandKind(ArmKind[StandSettings]):
    """Stands with a motor."""

    settings = StandSettings

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        if mode == "hardware":
            problems.add("this example has no motor; write 'mode: virtual'", "arm")

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmKind.driver`; a stand has no safety settings that could be accepted."""
        return Stand, (self.spec,)

    def plan(self, scene: Scene, action: Action) -> MotionPath:
        """See `ArmKind.plan`: the motor makes any motion that isn't too fast for it."""
        path = MotionPath(plan_pour(scene, action), approach_time=1.0, retreat_time=1.0)
        if path.report.tilt_speed > self.spec.fastest * 1.001:
            asked, most = math.degrees(path.report.tilt_speed), math.degrees(self.spec.fastest)
            raise InvalidActionError(
                f"the stand turns at most at {most:.0f} deg/s (arm.fastest), {asked:.0f} deg/s are asked for"
            )
        return path


class Drive:
    """The stand itself: a motor that turns the pourer, a slide that lifts it, and their encoders.

    In this example it is an object; a real one is at the end of a cable. It is the witness of the driver's tests, for
    it keeps what it truly did.

    Attributes:
        slip: share of every commanded turn that the belt loses.
        plugged: its cable is connected.
    """

    def __init__(self, time_scale: float = 1.0) -> None:
        self._scale = time_scale
        self._commanded = 0.0
        self.slip = 0.0
        self.plugged = True
        self.now, self.tilt, self.height = 0.0, 0.0, HOME_HEIGHT
        self.readings: list[tuple[float, float, float]] = []
        """Time [s of bench time], tilt [rad] and height [m]."""
        self.tick()

    def tick(self) -> float:
        """Read the encoders; the time of that reading [s of bench time]."""
        self.now = time.monotonic() * self._scale
        self.readings.append((self.now, self.tilt, self.height))
        return self.now

    def read(self) -> tuple[float, float, float]:
        """A reading over the cable.

        Raises:
            ConnectionError: the cable is not connected.
        """
        if not self.plugged:
            raise ConnectionError("the stand does not answer")
        self.tick()
        return self.readings[-1]

    def go(self, tilt: float, height: float) -> None:
        """Be there at the time of the last reading [rad], [m]. Raises as `read`."""
        if not self.plugged:
            raise ConnectionError("the stand does not answer")
        self.tilt += (1.0 - self.slip) * (tilt - self._commanded)
        self._commanded, self.height = tilt, height
        self.readings[-1] = (self.now, self.tilt, self.height)


class Stand:
    """The driver: see `decant.plugins.Arm`.

    Args:
        spec: its settings.
        drive: what it moves; its own by default.
    """

    def __init__(self, spec: StandSettings, drive: Drive | None = None) -> None:
        self._spec = spec
        self._drive = drive or Drive(spec.time_scale)
        self._one = threading.Lock()
        self._halt = threading.Event()
        self._free = False
        self._state = ArmState()

    def connect(self) -> ArmFacts:
        self._free = False
        return self.facts()

    def facts(self) -> ArmFacts:
        self._read()
        return ArmFacts(model="stand", serial="1")

    def hands_in(self) -> None:
        self._free = False
        self._read()

    def release(self) -> None:
        self._halt.clear()
        self._free = True
        self._state = replace(self._state, stopped=False)

    def state(self) -> ArmState:
        return self._state

    def where(self) -> ArmPose:
        return ArmPose(Pose(z=self._read()[2]))

    def move_to_start(self, path: MotionPath) -> None:
        self._consent()
        _, tilt, height = self._read()
        self._way("approach", path.approach_time, lambda t: tilt, _ramp(height, 0.0, path.approach_time))

    def execute(self, path: MotionPath) -> ExecutedMotion:
        def phase(t: float) -> str:
            return next((name for name, _, end in path.phases if t < end), "return")

        readings = self._turn(path.pour_time, phase, lambda t: float(path.tilt(np.array([t]))[0]), lambda t: 0.0)
        reached, measured = readings[-1][0], np.array(readings)
        measured = measured[np.append(True, np.diff(measured[:, 0]) > 0.0)]
        poses = poses_of(path, measured[:, 1], measured[:, 2])
        executed = ExecutedMotion(measured[:, 0], poses, completed=reached >= path.pour_time)
        if not executed.completed:
            raise ArmStoppedError(
                f"stopped {reached:.1f} s into the pour",
                "operator",
                phase(reached),
                reached,
                self._state.tilt,
                executed,
            )
        return executed

    def retreat(self, path: MotionPath) -> None:
        self._consent()
        if self._read()[1] > 0.0:
            self._upright("retreat")
        _, tilt, height = self._read()
        self._way("retreat", path.retreat_time, lambda t: tilt, _ramp(height, HOME_HEIGHT, path.retreat_time))
        self._free = False

    def untilt(self, path: MotionPath | None = None) -> None:
        self._upright("untilt")
        self._free = False

    def recover(self) -> str:
        self._consent()
        self._free = False
        return ""

    def stop(self) -> float:
        begun, moved = time.monotonic(), self._state.moving
        self._halt.set()
        self._free = False
        with self._one:  # whatever turned has come to rest
            self._state = replace(self._state, moving=False, stopped=True)
        return time.monotonic() - begun if moved else 0.0

    def jog(self, axis: str, amount: float, speed: float) -> None:
        if axis != "z" or abs(amount) > 0.05:
            raise ArmRefusedError("a stand goes up and down, by 50 mm at most: axis 'z'")
        self._consent()
        _, tilt, height = self._read()
        duration = abs(amount) / speed
        self._way("jog", duration, lambda t: tilt, _ramp(height, height + amount, duration))
        self._free = False

    def close(self) -> None:
        self.stop()

    def _read(self) -> tuple[float, float, float]:
        """Time, tilt and height that the encoders report."""
        try:
            return self._drive.read()
        except ConnectionError as error:
            raise self._lost(error) from error

    def _lost(self, error: ConnectionError) -> ArmLostError:
        """Consent ends with the connection."""
        self._free = False
        self._state = replace(self._state, moving=False, stopped=True)
        return ArmLostError(f"{error}; look at its cable")

    def _consent(self) -> None:
        if not self._free:
            raise ArmNotReleasedError("the stand is locked: the operator has to release it before it moves")

    def _upright(self, name: str) -> None:
        self._consent()
        _, tilt, height = self._read()
        duration = abs(tilt) / self._spec.upright_speed
        self._way(name, duration, _ramp(tilt, 0.0, duration), lambda t: height)

    def _way(
        self, name: str, duration: float, tilt: Callable[[float], float], height: Callable[[float], float]
    ) -> None:
        reached = self._turn(duration, lambda t: name, tilt, height)[-1][0]
        if reached < duration:
            raise ArmStoppedError(f"stopped during {name}", "operator", name, reached, self._state.tilt)

    def _turn(
        self,
        duration: float,
        phase: Callable[[float], str],
        tilt: Callable[[float], float],
        height: Callable[[float], float],
    ) -> list[tuple[float, float, float]]:
        """Move tilt and height over time; what the encoders read: time since the begin [s], tilt and height."""
        if not self._one.acquire(blocking=False):
            raise ArmRefusedError("the stand turns already")
        try:
            self._consent()
            begun, at, lift = self._drive.read()
            readings = [(0.0, at, lift)]
            while (now := readings[-1][0]) < duration and not self._halt.wait(0.01):
                now = min(self._drive.read()[0] - begun, duration)
                self._drive.go(tilt(now), height(now))
                readings.append((now, self._drive.tilt, self._drive.height))
                self._state = ArmState(True, False, now, now / duration, phase(now), self._drive.tilt)
            self._state = ArmState(False, self._halt.is_set(), now, 1.0, "idle", self._drive.tilt)
            return readings
        except ConnectionError as error:
            raise self._lost(error) from error
        finally:
            self._one.release()


def poses_of(path: MotionPath, tilts: NDArray[np.float64], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses of the pourer in the world, shape (T, 7), from what the encoders read, both of shape (T,)."""
    pivot = replace(path.motion, segments=())
    poses = np.array([replace(pivot, tilt_error=float(tilt)).sample(np.zeros(1))[0] for tilt in tilts])
    poses[:, 2] += heights
    return poses


def _ramp(begin: float, end: float, duration: float) -> Callable[[float], float]:
    return lambda t: begin + (end - begin) * min(t / duration, 1.0) if duration > 0.0 else end
