"""An event loop whose clock skips waits: a campaign of 15 pours at 90 s each takes seconds.

The loop's time is the CPU time of this thread plus all waits, which are skipped. Scheduler, journal and strategy thus
take their own CPU time, even on a machine with other load, and 90 s of sleep take no real time.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class _Skipping(selectors.DefaultSelector):
    """A selector that never waits for a timer."""

    skipped = 0.0

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0 if timeout is not None else None)
        if not ready and timeout is not None and timeout > 0.0:
            self.skipped += timeout
        return ready


class SkippingLoop(asyncio.SelectorEventLoop):
    """An event loop with the clock described in the module's docstring."""

    def __init__(self) -> None:
        self._waits = _Skipping()
        self._started = time.thread_time()
        super().__init__(self._waits)

    def time(self) -> float:
        """Return the seconds since the loop was created."""
        return time.thread_time() - self._started + self._waits.skipped

    async def spend(self, seconds: float, computed: float) -> None:
        """Advance the clock by `seconds` instead of the `computed` CPU seconds, for work of another process."""
        self._started += computed
        await asyncio.sleep(seconds)


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine like `asyncio.run`, on a `SkippingLoop`."""
    with asyncio.Runner(loop_factory=SkippingLoop) as runner:
        return runner.run(work)
