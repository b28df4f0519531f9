"""An event loop whose clock leaves waiting out: a campaign of 15 pours at 90 s each passes in seconds.

Its time is the CPU time of this thread, all of it, plus every wait, which is skipped. So scheduler, journal and
strategy take as long as they do, also on a machine that is busy with other work, and 90 s of sleep take no time.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class _Skipping(selectors.DefaultSelector):
    """Never waits for a timer."""

    skipped = 0.0

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0 if timeout is not None else None)
        if not ready and timeout is not None and timeout > 0.0:
            self.skipped += timeout
        return ready


class SkippingLoop(asyncio.SelectorEventLoop):
    """See the module."""

    def __init__(self) -> None:
        self._waits = _Skipping()
        self._started = time.thread_time()
        super().__init__(self._waits)

    def time(self) -> float:
        """Seconds since the loop was made."""
        return time.thread_time() - self._started + self._waits.skipped

    async def spend(self, seconds: float, computed: float) -> None:
        """Let `seconds` pass in place of `computed` CPU seconds that another process would have spent."""
        self._started += computed
        await asyncio.sleep(seconds)


def run(work: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` on such a loop."""
    with asyncio.Runner(loop_factory=SkippingLoop) as runner:
        return runner.run(work)
