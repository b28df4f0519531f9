"""A simulated arm. It executes a `PourMotion` in scaled time, with small errors, and can be stopped.

`SimulatedArmSettings` are its settings, `Grip` the hidden errors of a pour. No hardware moves.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmFacts, ArmNotReleasedError, ArmPose, ArmRefusedError, ArmState, ArmStoppedError
from actors.arm.arm_settings import ArmSettings
from actors.arm.planned_pour import ExecutedMotion, MotionPath
from actors.arm_geometry import Pose
from actors.runtime.bench_clock import Pace
from sim_engine.motion import PourMotion

FloatArray = NDArray[np.float64]

SAMPLE_RATE = 50.0
"""Rate of the poses that the arm reads back, in bench time [Hz]."""

APPROACH_TIME = 4.0
"""Bench time from the home pose to the motion's first pose [s]."""

POSITION_NOISE = 3e-5
"""Standard deviation of a pose read back [m]: an industrial arm's repeatability."""

FARTHEST_TURN, FARTHEST_WAY = math.radians(10.0), 0.05
"""Largest manual step (jog) [rad], [m]."""

_STEP = 0.02
"""Wall-clock time between two checks of the stop flag [s]."""

_UPRIGHT_TIME = 4.0


@dataclass(frozen=True)
class Grip:
    """Errors of the next pour's execution; hidden from the learning algorithms.

    Attributes:
        speed_factor: executed over commanded angular velocity.
        seed: of the readings' noise.
    """

    speed_factor: float = 1.0
    seed: tuple[int, ...] = (0,)


class SimulatedArmSettings(ArmSettings):
    """A simulated arm without protocol: it makes every motion and has no geometry."""

    kind: Literal["simulated"] = "simulated"
    """A simulated arm without protocol."""


class SimulatedArm:
    """See `actors.arm.arm_interface.Arm`.

    Its readings depend only on the motion and the grip, not on the clock or on earlier pours.

    Args:
        spec: its time scale.
    """

    def __init__(self, spec: SimulatedArmSettings) -> None:
        self._spec = spec
        self._pace = Pace(spec.time_scale)
        self._grip = Grip()
        self._lock = threading.Lock()
        self._working = threading.Lock()
        self._state = ArmState()
        self._released = False
        self._place = [0.0] * 6

    def grip(self, grip: Grip) -> None:
        """Set the errors of the next pour."""
        self._grip = grip

    # ---- nothing moves

    def connect(self) -> ArmFacts:
        """See `Arm.connect`."""
        self._released = False
        return self.facts()

    def facts(self) -> ArmFacts:
        """See `Arm.facts`."""
        return ArmFacts(model="simulated")

    def hands_in(self) -> None:
        """See `Arm.hands_in`."""
        self._released = False

    def release(self) -> None:
        """See `Arm.release`."""
        self._pace.resume()
        self._released = True
        with self._lock:
            self._state = replace(self._state, stopped=False)

    def state(self) -> ArmState:
        """See `Arm.state`."""
        with self._lock:
            return self._state

    def where(self) -> ArmPose:
        """See `Arm.where`."""
        return ArmPose(Pose.of(*self._place))

    def recover(self) -> str:
        """See `Arm.recover`."""
        self._consent()
        self._released = False
        return ""

    # ---- motions

    def move_to_start(self, path: MotionPath) -> None:
        """See `Arm.move_to_start`."""
        tilt, pose = float(path.motion.tilt(np.zeros(1))[0]), _seven(path.motion.sample(np.zeros(1))[0])
        self._way("approach", path.approach_time, lambda t: tilt, lambda t: pose)

    def execute(self, path: MotionPath) -> ExecutedMotion:
        """See `Arm.execute`.

        The grip's speed factor stretches or shortens the tilting phase; hold and return keep their durations.
        """
        executed = _Executed(path.motion, self._grip.speed_factor, path.factor)
        reached = self._travel(executed.duration, executed.where, executed.pose)
        done = self._read_back(path.motion, executed, reached)
        if reached < executed.duration:
            phase, tilt = executed.where(reached)
            raise ArmStoppedError(
                f"the arm was stopped {reached:.1f} s into the pour, of {executed.duration:.1f} s",
                *("operator", phase, reached, tilt, done),
            )
        return done

    def retreat(self, path: MotionPath) -> None:
        """See `Arm.retreat`; takes no time."""
        self._way("retreat", path.retreat_time, lambda t: 0.0)
        self._released = False

    def untilt(self, path: MotionPath | None = None) -> None:
        """See `Arm.untilt`."""
        begin = self.state().tilt
        self._way("untilt", _UPRIGHT_TIME, lambda t: begin * max(1.0 - t / _UPRIGHT_TIME, 0.0))
        self._released = False

    def jog(self, axis: str, amount: float, speed: float) -> None:
        """See `Arm.jog`."""
        axes = ("x", "y", "z", "rx", "ry", "rz")
        if axis not in axes:
            raise ArmRefusedError(f"a simulated arm has no axis '{axis}'; there are {', '.join(axes)}")
        if not 0.0 < abs(amount) <= (FARTHEST_WAY if axis in axes[:3] else FARTHEST_TURN) or speed <= 0.0:
            raise ArmRefusedError("a step is at most 50 mm or 10°, with a speed above 0")
        self._way("jog", abs(amount) / speed, lambda t: self._state.tilt)
        self._place[axes.index(axis)] += amount
        self._released = False

    def stop(self) -> float:
        """See `Arm.stop`."""
        self._pace.interrupt()
        self._released = False
        with self._lock:
            self._state = replace(self._state, stopped=True)
        with self._working:  # wait until the running motion has ended
            return 0.0

    def close(self) -> None:
        """See `Arm.close`."""
        self.stop()

    # ---- implementation

    def _consent(self) -> None:
        if not self._released or self._pace.interrupted:
            raise ArmNotReleasedError("the arm is locked: an operator has to release it before it moves")

    def _way(
        self,
        name: str,
        duration: float,
        tilt: Callable[[float], float],
        pose: Callable[[float], tuple[float, ...]] = lambda t: (),
    ) -> None:
        reached = self._travel(duration, lambda t: (name, tilt(t)), pose)
        if reached < duration:
            raise ArmStoppedError(
                f"the arm was stopped during {name}, {reached:.1f} s after its begin",
                *("operator", name, reached, tilt(reached)),
            )

    def _travel(
        self,
        duration: float,
        where: Callable[[float], tuple[str, float]],
        pose: Callable[[float], tuple[float, ...]] = lambda t: (),
    ) -> float:
        """Let bench time pass during a motion.

        Args:
            duration: of the motion [s].
            where: phase and tilt [rad] at a time of the motion.
            pose: of the pourer at that time, see `ArmState.pourer`.

        Returns:
            Time reached [s]: `duration`, or less if the arm was stopped.
        """
        if not self._working.acquire(blocking=False):
            raise ArmRefusedError("the arm is busy; another motion has to wait")
        try:
            self._consent()
            self._pace.restart()
            reached = 0.0
            while reached < duration:
                phase, tilt = where(reached)
                self._report(ArmState(True, False, reached, reached / duration, phase, tilt, pourer=pose(reached)))
                going_on = self._pace.nap(_STEP)
                reached = min(self._pace.now, duration)
                if not going_on:
                    break
            phase, tilt = where(reached)
            share = reached / duration if duration > 0.0 else 1.0
            self._report(ArmState(False, self._pace.interrupted, reached, share, "idle", tilt))
            return reached
        finally:
            self._working.release()

    def _read_back(self, motion: PourMotion, executed: _Executed, reached: float) -> ExecutedMotion:
        times = np.arange(0.0, reached, 1.0 / SAMPLE_RATE)
        # The last sample is at the end itself; the one before is at least half a sample earlier.
        times = np.append(times[times < reached - 0.5 / SAMPLE_RATE], reached)
        poses = motion.sample(executed.commanded(times))
        poses[:, :3] += np.random.default_rng(self._grip.seed).normal(0.0, POSITION_NOISE, (len(times), 3))
        return ExecutedMotion(times, poses, completed=reached >= executed.duration)

    def _report(self, state: ArmState) -> None:
        with self._lock:
            self._state = state


class _Executed:
    """A motion whose tilting phase runs at a speed other than the commanded one."""

    def __init__(self, motion: PourMotion, speed_factor: float, slowed: float = 1.0) -> None:
        self._motion = motion
        self._tilted = next(phase.end for phase in motion.phases if phase.name == "tilt")
        self._factor, self._slowed = speed_factor, slowed

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return (self._tilted / self._factor + self._motion.duration - self._tilted) / self._slowed

    def commanded(self, times: FloatArray) -> FloatArray:
        """Times at which the commanded motion has the state that this one has at `times`; both of shape (T,) [s]."""
        times = times * self._slowed
        tilting = times * self._factor
        later = times - self._tilted / self._factor + self._tilted
        return np.where(tilting < self._tilted, tilting, later)

    def where(self, moment: float) -> tuple[str, float]:
        """Phase and tilt [rad] at a time [s]."""
        commanded = self.commanded(np.array([moment]))
        begun = [phase.name for phase in self._motion.phases if phase.start <= commanded[0] + 1e-9]
        return begun[-1], float(self._motion.tilt(commanded)[0])

    def pose(self, moment: float) -> tuple[float, ...]:
        """Pose of the pourer at a time [s], see `ArmState.pourer`."""
        return _seven(self._motion.sample(self.commanded(np.array([moment])))[0])


def _seven(pose: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in pose)
