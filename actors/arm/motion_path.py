"""Pours for arms that don't look at joints: planned as the motion itself, read back as poses of the pourer. Values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.arm.protocol import PathReport
from sim_engine.motion import PourMotion
from sim_engine.sampled_motion import SampledMotion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MotionPath:
    """A pour for an arm that makes any motion, and looks at no joints: the motion itself.

    Attributes:
        motion: of the pourer.
        approach_time, retreat_time: of the ways there and back [s].
        factor: of its speed.
    """

    motion: PourMotion
    approach_time: float = 4.0
    retreat_time: float = 0.0
    factor: float = 1.0

    @property
    def pour_time(self) -> float:
        """[s]."""
        return self.motion.duration / self.factor

    @property
    def phases(self) -> tuple[tuple[str, float, float], ...]:
        """See `PlannedPour.phases`."""
        return tuple((phase.name, phase.start / self.factor, phase.end / self.factor) for phase in self.motion.phases)

    def tilt(self, times: FloatArray) -> FloatArray:
        """Tilt of the pourer at times of the pour, shape (T,) [rad]."""
        return self.motion.tilt(times * self.factor)

    def poses(self, times: FloatArray) -> FloatArray:
        """Poses of the pourer in the world at times of the pour, shape (T, 7)."""
        return self.motion.sample(times * self.factor)

    def slowed(self, factor: float) -> MotionPath:
        """See `PlannedPour.slowed`."""
        return replace(self, factor=self.factor * factor)

    @property
    def report(self) -> PathReport:
        """See `PlannedPour.report`."""
        return motion_report(self.motion, self.approach_time + self.retreat_time, self.factor)


def motion_report(motion: PourMotion, travel_time: float = 0.0, factor: float = 1.0) -> PathReport:
    """What a motion says of a pour, for arms that don't look at their joints: the pourer's origin stands for the tool.

    Args:
        motion: of the pourer.
        travel_time: way there and back together [s].
        factor: of the motion's speed.
    """
    times = np.linspace(0.0, motion.duration, 500)
    poses, tilts = motion.sample(times), motion.tilt(times)
    step = times[1] / factor
    low, high = poses[:, :3].min(axis=0), poses[:, :3].max(axis=0)
    return PathReport(
        joint_speed=0.0,
        fastest_joint=0,
        tool_speed=float(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=-1).max() / step),
        tilt=float(np.abs(tilts).max()),
        tilt_speed=float(np.abs(np.diff(tilts)).max() / step),
        singularity=1.0,
        clearance=0.0,
        low=(float(low[0]), float(low[1]), float(low[2])),
        high=(float(high[0]), float(high[1]), float(high[2])),
        duration=motion.duration / factor + travel_time,
    )


@dataclass(frozen=True, eq=False)
class ExecutedMotion:
    """See `actors.arm.protocol.Executed`; poses as the arm read them back.

    Attributes:
        times: shape (T,) [s].
        poses: shape (T, 7).
        completed: False if it was stopped on the way.
    """

    times: FloatArray
    poses: FloatArray
    completed: bool
    tracking: Mapping[str, float] = field(default_factory=dict)

    @property
    def motion(self) -> SampledMotion:
        """As a motion that can be simulated again."""
        return SampledMotion(self.times, self.poses)

    def record(self) -> dict[str, Any]:
        """See `Executed.record`: the action says all of it."""
        return {}
