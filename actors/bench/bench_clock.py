"""Bench time: scaled against the wall clock, or not waited for at all."""

from __future__ import annotations

import math
import threading
import time


class Pace:
    """Waits for bench time to pass, and can be interrupted from another thread.

    Args:
        time_scale: bench seconds per wall second; 0 waits for nothing.
    """

    def __init__(self, time_scale: float) -> None:
        if time_scale < 0.0:
            raise ValueError(f"time_scale must be 0 (wait for nothing) or more, got {time_scale}")
        self._scale = time_scale
        self._interrupted = threading.Event()
        self._start = time.monotonic()

    def restart(self) -> None:
        """Bench time is 0 now."""
        self._start = time.monotonic()

    @property
    def now(self) -> float:
        """Bench time since `restart` [s]; infinite where nothing is waited for."""
        return (time.monotonic() - self._start) * self._scale if self._scale > 0.0 else math.inf

    def nap(self, wall: float) -> bool:
        """Wait for some wall time [s], or not at all where nothing is waited for.

        Returns:
            False if interrupted.
        """
        return not self._interrupted.wait(wall if self._scale > 0.0 else 0.0)

    def wait_until(self, moment: float) -> bool:
        """Wait for a bench time since `restart` [s].

        Returns:
            False if interrupted before it.
        """
        left = (moment - self.now) / self._scale if self._scale > 0.0 else 0.0
        return not self._interrupted.wait(max(left, 0.0))

    def interrupt(self) -> None:
        """End waits now and later ones at once, until `resume`."""
        self._interrupted.set()

    def resume(self) -> None:
        """Let waits last again."""
        self._interrupted.clear()

    @property
    def interrupted(self) -> bool:
        """Whether `interrupt` is in force."""
        return self._interrupted.is_set()
