"""An arm without a robot: it makes a `PourMotion` in scaled time, a little wrong, and can be stopped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from actors.arm.protocol import ArmState, ExecutedMotion
from actors.pacing import Pace
from actors.protocols import LaboratoryError
from sim_engine.motion import PourMotion

SAMPLE_RATE = 50.0
"""Poses that an arm reads back per bench second [Hz]."""

APPROACH_TIME = 4.0
"""Bench time from the rest pose to the motion's first one [s]."""

POSITION_NOISE = 3e-5
"""Standard deviation of a pose read back [m]: an industrial arm's repeatability."""

_STEP = 0.02
"""Wall time between two looks at a stop button [s]."""


@dataclass(frozen=True)
class Grip:
    """What is wrong with the next pour's execution; hidden from those who learn from it.

    Attributes:
        speed_factor: executed over commanded angular velocity.
        seed: of the readings' noise.
    """

    speed_factor: float = 1.0
    seed: tuple[int, ...] = (0,)


class VirtualArm:
    """Plain and blocking; `actors.device` puts it into a thread or a process.

    What it reads back depends on the motion, the grip and nothing else: neither on the clock nor on earlier pours.

    Args:
        time_scale: bench seconds per wall second; 0 waits for nothing.
    """

    def __init__(self, time_scale: float) -> None:
        self._pace = Pace(time_scale)
        self._grip = Grip()
        self._lock = threading.Lock()
        self._state = ArmState()

    def grip(self, grip: Grip) -> None:
        """Hold the vessel for the next pour with these errors."""
        self._grip = grip

    def move_to_start(self, motion: PourMotion) -> None:
        """See `Arm.move_to_start`."""
        tilt = float(motion.tilt(np.zeros(1))[0])
        if self._travel(APPROACH_TIME, lambda t: ("approach", tilt)) < APPROACH_TIME:
            raise LaboratoryError("the arm was stopped on its way to the start pose; nothing was poured")

    def execute(self, motion: PourMotion) -> ExecutedMotion:
        """See `Arm.execute`.

        The grip's speed factor stretches or shrinks the tilting phase; hold and return keep their times.
        """
        executed = _Executed(motion, self._grip.speed_factor)
        reached = self._travel(executed.duration, executed.where)
        times = np.arange(0.0, reached, 1.0 / SAMPLE_RATE)
        # The last sample stands at the end itself, and no closer to the one before than half a sample.
        times = np.append(times[times < reached - 0.5 / SAMPLE_RATE], reached)
        if len(times) < 2:
            raise LaboratoryError("the arm was stopped before it had moved; nothing was poured")
        poses = motion.sample(executed.commanded(times))
        poses[:, :3] += np.random.default_rng(self._grip.seed).normal(0.0, POSITION_NOISE, (len(times), 3))
        return ExecutedMotion(times, poses, completed=reached >= executed.duration)

    def stop(self) -> None:
        """See `Arm.stop`."""
        self._pace.interrupt()
        with self._lock:
            self._state = replace(self._state, stopped=True)

    def release(self) -> None:
        """See `Arm.release`."""
        self._pace.resume()
        with self._lock:
            self._state = replace(self._state, stopped=False)

    def state(self) -> ArmState:
        """See `Arm.state`."""
        with self._lock:
            return self._state

    def _travel(self, duration: float, where: Callable[[float], tuple[str, float]]) -> float:
        """Let bench time pass on a way.

        Args:
            duration: of the way [s].
            where: phase and tilt [rad] at a time on the way.

        Returns:
            Time reached [s]: `duration`, or less if the arm was stopped.
        """
        if self._pace.interrupted:
            raise LaboratoryError("the arm is stopped: see to it, then release it")
        self._pace.restart()
        reached = 0.0
        while reached < duration:
            phase, tilt = where(reached)
            self._tell(ArmState(True, False, reached, reached / duration, phase, tilt))
            going_on = self._pace.nap(_STEP)
            reached = min(self._pace.now, duration)
            if not going_on:
                break
        phase, tilt = where(reached)
        self._tell(ArmState(False, self._pace.interrupted, reached, reached / duration, "idle", tilt))
        return reached

    def _tell(self, state: ArmState) -> None:
        with self._lock:
            self._state = state


class _Executed:
    """A motion whose tilting phase runs at another speed than commanded."""

    def __init__(self, motion: PourMotion, speed_factor: float) -> None:
        self._motion = motion
        self._tilted = next(phase.end for phase in motion.phases if phase.name == "tilt")
        self._factor = speed_factor

    @property
    def duration(self) -> float:
        """[s]."""
        return self._tilted / self._factor + self._motion.duration - self._tilted

    def commanded(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times of the commanded motion at which it is where this one is at `times`, both shape (T,) [s]."""
        tilting = times * self._factor
        later = times - self._tilted / self._factor + self._tilted
        return np.where(tilting < self._tilted, tilting, later)

    def where(self, moment: float) -> tuple[str, float]:
        """Phase and tilt [rad] at a time [s]."""
        commanded = self.commanded(np.array([moment]))
        begun = [phase.name for phase in self._motion.phases if phase.start <= commanded[0] + 1e-9]
        return begun[-1], float(self._motion.tilt(commanded)[0])
