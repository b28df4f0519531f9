"""Results that came through Ray's object store."""

from __future__ import annotations

import dataclasses

import numpy as np

from actors.protocols import Frames, SimulationResult


def own(result: SimulationResult) -> SimulationResult:
    """Copies of the frames: those in the store would hold its memory as long as they live.

    Args:
        result: as it came.
    """
    if result.frames is None:
        return result
    frames = result.frames
    copied = Frames(
        times=np.array(frames.times),
        positions=[np.array(p) for p in frames.positions],
        states=[np.array(s) for s in frames.states],
        pourer_poses=np.array(frames.pourer_poses),
    )
    return dataclasses.replace(result, frames=copied)
