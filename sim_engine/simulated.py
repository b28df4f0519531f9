"""A simulated pour: what came of it, and its particles at some times where those were asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.outcome import PourOutcome


@dataclass(frozen=True)
class RecordedFrames:
    """Particles at some times.

    Attributes:
        times: (F,) [s].
        positions: F arrays (N, 3) float32, world [m].
        states: F arrays (N,) uint8, `sim_engine.outcome.ParticleState`.
        pourer_poses: (F, 7): x y z qw qx qy qz of the pourer.
    """

    times: NDArray[np.float64]
    positions: list[NDArray[np.float32]]
    states: list[NDArray[np.uint8]]
    pourer_poses: NDArray[np.float64]

    def copied(self) -> RecordedFrames:
        """The same in memory of its own."""
        positions, states = [np.array(p) for p in self.positions], [np.array(s) for s in self.states]
        return RecordedFrames(np.array(self.times), positions, states, np.array(self.pourer_poses))


@dataclass(frozen=True)
class SimulatedPour:
    """A simulated pour; `frames` only if the task asked for any."""

    outcome: PourOutcome
    frames: RecordedFrames | None = None

    def copied(self) -> SimulatedPour:
        """The same in memory of its own: arrays from a shared store would hold that for as long as they live."""
        return self if self.frames is None else SimulatedPour(self.outcome, self.frames.copied())
