"""Tells who watches where a pour stands."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

from actors.protocols import PourProgress, ProgressCallback
from sim_engine.simulated import RecordedFrames


class PourReport:
    """In bench time done of bench time expected; never runs backwards.

    Args:
        progress: told; what it raises is its own affair.
        parts: expected time of each checkpoint, in order [s].
        motion_time: of tilt, hold and return together [s].
    """

    def __init__(self, progress: ProgressCallback | None, parts: Mapping[str, float], motion_time: float) -> None:
        self._progress, self._parts, self._motion_time = progress, dict(parts), motion_time
        self._checkpoint = "operator"
        self._fraction = 0.0
        self._tilt: float | None = None
        self._balance: float | None = None
        self._stable: bool | None = None
        self._joints: tuple[float, ...] = ()
        self._pourer: tuple[float, ...] = ()

    def enter(self, checkpoint: str, done: float = 0.0) -> None:
        """A checkpoint is reached, or `done` (0 … 1) of it."""
        self._checkpoint = checkpoint
        before = 0.0
        for name, duration in self._parts.items():
            if name == checkpoint:
                before += done * duration
                break
            before += duration
        self._fraction = max(self._fraction, before / sum(self._parts.values()))
        self._tell()

    def move(self, phase: str, fraction: float, tilt: float | None, *, moving: bool = True) -> None:
        """Where the arm is during the pour itself.

        Args:
            phase: 'tilt', 'hold' or 'return'.
            fraction: of the pour's motion, 0 … 1.
            tilt: of the pourer [rad].
            moving: whether it is on its way; else only the tilt is noted.
        """
        self._tilt = tilt
        if not moving:
            return
        start = sum(duration for name, duration in self._parts.items() if name in ("operator", "tare", "approach"))
        self._checkpoint = phase if phase in self._parts else self._checkpoint
        self._fraction = max(self._fraction, (start + fraction * self._motion_time) / sum(self._parts.values()))
        self._tell()

    def stand(self, joints: tuple[float, ...], pourer: tuple[float, ...]) -> None:
        """Where the arm is, see `PourProgress`; as far as it tells."""
        self._joints, self._pourer = joints or self._joints, pourer or self._pourer
        self._tell()

    def show(self, balance: float, stable: bool | None = None) -> None:
        """The balance's display [kg], and whether it says that it is at rest."""
        self._balance, self._stable = balance, stable
        self._tell()

    @property
    def watched(self) -> bool:
        """Whether anybody gets it."""
        return self._progress is not None

    def pour(self, liquid: RecordedFrames) -> None:
        """What the liquid of a virtual bench does in this pour."""
        self._tell(liquid)

    def _tell(self, liquid: RecordedFrames | None = None) -> None:
        if self._progress is not None:
            told = PourProgress(
                self._checkpoint,
                self._fraction,
                self._tilt,
                self._balance,
                self._stable,
                self._joints,
                self._pourer,
                liquid,
            )
            with contextlib.suppress(Exception):
                self._progress(told)
