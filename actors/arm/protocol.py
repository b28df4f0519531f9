"""What a pouring arm can be asked, and what it tells about what it did. Values and a protocol; no driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_engine.motion import PourMotion
from sim_engine.sampled_motion import SampledMotion

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ArmState:
    """Where an arm is now.

    Attributes:
        moving: a motion is under way.
        stopped: `stop` is in force; nothing moves until `release`.
        time: bench time since the motion began [s].
        fraction: of the motion, 0 … 1.
        phase: 'approach', or the pour's 'tilt', 'hold', 'return'; 'idle'.
        tilt: of the pourer [rad].
    """

    moving: bool = False
    stopped: bool = False
    time: float = 0.0
    fraction: float = 0.0
    phase: str = "idle"
    tilt: float = 0.0


@dataclass(frozen=True, eq=False)
class ExecutedMotion:
    """What the arm did, as it read it from its own joints.

    Attributes:
        times: (T,) since the motion's begin [s].
        poses: (T, 7) of the pourer's frame: x y z [m] qw qx qy qz. An arm knows where its flange is, not how the
            vessel sits in the fingers: errors of grip are not in it.
        completed: False if it was stopped on the way.
    """

    times: FloatArray
    poses: FloatArray
    completed: bool

    @property
    def motion(self) -> SampledMotion:
        """As a motion that can be simulated again."""
        return SampledMotion(self.times, self.poses)


ArmProgress = Callable[[ArmState], None]


class Arm(Protocol):
    """A robot arm that pours. Motions are never repeated by software: a lost one is lost."""

    async def move_to_start(self, motion: PourMotion) -> None:
        """Bring the upright pourer to the motion's first pose.

        Raises:
            LaboratoryError: the arm is stopped, was stopped on the way, or is lost.
        """
        ...

    async def execute(self, motion: PourMotion, progress: ArmProgress | None = None) -> ExecutedMotion:
        """Make a pour's motion, from its first pose on.

        Args:
            motion: as planned.
            progress: told some ten times a second where the arm is; it can't hold the motion up.

        Raises:
            LaboratoryError: the arm is stopped, or was lost on the way.
        """
        ...

    async def stop(self) -> None:
        """End any motion now; does not wait for it. Nothing moves until `release`."""
        ...

    async def release(self) -> None:
        """An operator has seen to the arm: it may move again."""
        ...

    async def state(self) -> ArmState:
        """Where the arm is now; answered at once, also during a motion."""
        ...
