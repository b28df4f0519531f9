"""What a pour is for the joints of an arm: values that planning makes, checks judge and the driver executes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joints over time, from rest to rest; linear in between.

    Attributes:
        times: (T,) increasing from 0 [s]; T ≥ 2.
        joints: (T, 6) [rad], without jumps by full turns.
    """

    times: FloatArray
    joints: FloatArray

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.times[-1])

    def at(self, times: FloatArray) -> FloatArray:
        """Joints at times [s], clamped at both ends, shape (T, 6) [rad]."""
        return np.stack([np.interp(times, self.times, self.joints[:, k]) for k in range(6)], axis=-1)


@dataclass(frozen=True)
class PathReport:
    """What was found out about a whole path before the first movement.

    Attributes:
        joint_speed: fastest joint [rad/s], and `fastest_joint` which one, 0 … 5.
        tool_speed: fastest point of tool or pourer [m/s].
        tilt: largest [rad]; tilt_speed: largest [rad/s].
        singularity: smallest distance from one, as `ArmLimits.singularity`.
        clearance: smallest distance of the pourer from the receiver [m].
        low, high: corners of the box that tool and pourer pass through, base frame [m].
        duration: of approach, pour and retreat together [s].
        deviation: largest difference between the tilt that was asked for and the path's at the same time [rad]; more
            than rounding only where a step in speed was asked for, which joints can't make.
    """

    joint_speed: float
    fastest_joint: int
    tool_speed: float
    tilt: float
    tilt_speed: float
    singularity: float
    clearance: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    duration: float
    deviation: float = 0.0


@dataclass(frozen=True, eq=False)
class PourPath:
    """A whole pour for the arm: checked, ready to be executed.

    Attributes:
        approach: from home to the pour's start, the pourer upright.
        pour: tilt, hold, return.
        retreat: back home.
        tilts: (T,) of the pourer at `pour.times` [rad].
        phases: (name, start, end) of the pour's parts [s].
        report: what the checks found.
    """

    approach: JointPath
    pour: JointPath
    retreat: JointPath
    tilts: FloatArray
    phases: tuple[tuple[str, float, float], ...]
    report: PathReport


@dataclass(frozen=True, eq=False)
class ExecutedPath:
    """What an arm's own encoders say it did.

    Attributes:
        times: (T,) since the path's begin, increasing from 0 [s of controller time], at least 100 Hz.
        joints: (T, 6) [rad].
        completed: False if it was stopped on the way.
        tracking: what the path was followed with: 'rms_angle', 'max_angle' [rad] of the joints, 'rms_tool',
            'max_tool' [m], 'lag' [s] taken out of them, 'longest_gap' between two readings [s].
    """

    times: FloatArray
    joints: FloatArray
    completed: bool
    tracking: dict[str, float] = field(default_factory=dict)
