"""Bench time: the clock of a virtual bench, scaled against the wall clock.

`Pace` converts bench time to wall time and waits. With a time scale of 0 it does not wait at all.
"""

from __future__ import annotations

import math
import threading
import time


class Pace:
    """Waits until bench time has passed; another thread can interrupt the wait.

    Args:
        time_scale: bench seconds per wall second; 0 disables waiting.
    """

    def __init__(self, time_scale: float) -> None:
        if time_scale < 0.0:
            raise ValueError(f"time_scale must be 0 (wait for nothing) or more, got {time_scale}")
        self._scale = time_scale
        self._interrupted = threading.Event()
        self._start = time.monotonic()

    def restart(self) -> None:
        """Set bench time to 0."""
        self._start = time.monotonic()

    @property
    def now(self) -> float:
        """Bench time since `restart` [s]; infinite if waiting is disabled."""
        return (time.monotonic() - self._start) * self._scale if self._scale > 0.0 else math.inf

    def nap(self, wall: float) -> bool:
        """Wait for a wall time [s]; return at once if waiting is disabled.

        Returns:
            False if interrupted.
        """
        return not self._interrupted.wait(wall if self._scale > 0.0 else 0.0)

    def wait_until(self, moment: float) -> bool:
        """Wait until a bench time since `restart` [s].

        Returns:
            False if interrupted before that time.
        """
        left = (moment - self.now) / self._scale if self._scale > 0.0 else 0.0
        return not self._interrupted.wait(max(left, 0.0))

    def interrupt(self) -> None:
        """End current waits, and end later waits at once until `resume` is called."""
        self._interrupted.set()

    def resume(self) -> None:
        """Allow waits again after `interrupt`."""
        self._interrupted.clear()

    @property
    def interrupted(self) -> bool:
        """Whether `interrupt` was called without a later `resume`."""
        return self._interrupted.is_set()
