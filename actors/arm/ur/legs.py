"""A motion and what to call its parts; what to say about one that was broken off. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from actors.arm.errors import ArmRefusedError, ArmStoppedError
from actors.arm.joint_path import ExecutedPath, FloatArray, JointPath, PourPath
from actors.arm.spec import UrArmSpec
from actors.arm.ur.messages import Outcome
from actors.arm.ur.script import checked
from actors.arm.ur.ways import HARDLY, leans, rejoin

UPRIGHT = 0.02
"""Tilts below this aren't worth a word [rad]."""


@dataclass(frozen=True, eq=False)
class Leg:
    """One motion, and what to call it.

    Attributes:
        path: to be followed.
        phases: (name, start, end) [s].
        tilts: of the pourer at the path's times [rad].
    """

    path: JointPath
    phases: tuple[tuple[str, float, float], ...]
    tilts: FloatArray

    @classmethod
    def of(cls, name: str, path: JointPath, spec: UrArmSpec) -> Leg:
        """A way of one phase.

        Raises:
            ArmRefusedError: it is not a path.
        """
        path = checked(path)
        return cls(path, ((name, 0.0, path.duration),), leans(path.joints, spec))

    @classmethod
    def of_pour(cls, path: PourPath) -> Leg:
        """A pour's tilt, hold and return.

        Raises:
            ArmRefusedError: it is not a path.
        """
        if path.tilts.shape != path.pour.times.shape or not path.phases:
            raise ArmRefusedError("a pour's path has a tilt for each of its times, and phases")
        return cls(checked(path.pour), path.phases, path.tilts)

    @property
    def name(self) -> str:
        """Name of its first phase."""
        return self.phases[0][0]

    def phase(self, time: float) -> str:
        """What goes on at a time [s]."""
        return next((name for name, _, end in self.phases if time < end), self.phases[-1][0])

    def tilt(self, time: float) -> float:
        """Tilt of the pourer then [rad]."""
        return float(np.interp(time, self.path.times, self.tilts))

    def tilt_left(self, outcome: Outcome) -> float:
        """Tilt of the pourer where the arm was stopped [rad]: it braked for a while after the path's clock stopped."""
        if outcome.standing is not None:
            time, apart = rejoin(self.path, np.array(outcome.joints))
            if apart <= HARDLY:
                return self.tilt(time)
        return self.tilt(outcome.clock)

    def stopped(self, outcome: Outcome, executed: ExecutedPath) -> ArmStoppedError:
        """What to tell of a motion that was broken off."""
        phase, tilt = self.phase(outcome.clock), self.tilt_left(outcome)
        tilted = f", the pourer tilted by {np.degrees(tilt):.0f}°" if tilt > UPRIGHT else ""
        return ArmStoppedError(
            f"{outcome.kind} during {phase}, {outcome.clock:.2f} s after its begin{tilted}: {outcome.text}. "
            "The arm holds still; look into it, then release",
            *(outcome.kind, phase, outcome.clock, tilt, executed),
        )

    def last_seen(self, clock: float) -> str:
        """What to tell of a motion that was lost from sight."""
        return (
            f"Last seen during {self.phase(clock)}, {clock:.2f} s after its begin, the pourer tilted by "
            f"{np.degrees(self.tilt(clock)):.0f}°; the program on the controller ends by its watchdog"
        )
