"""Films: what took place in simulated or bench time, shown at its own pace.

On the timeline of simulated time films lie one behind the other. On the wall clock a film runs from when it became
known, a second for a second: whoever watches live sees the liquid move, and a bench of scaled time is seen at the speed
of a real one. Frames are kept back until they are due. What would run too far behind is left out of the wall clock.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Sequence

from orchestrator.monitor.outlet import Outlet

LONGEST_BACKLOG = 20.0
"""Films that would begin later than so after they became known are not shown on the wall clock [s]."""

PAUSE = 0.5
"""Between two films [s]."""

Frame = Callable[[], object]
"""Logs one moment; the times are set."""


class Films:
    """What is still to be shown. For one thread.

    Args:
        outlet: that frames go to.
    """

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._planned: list[tuple[float, int, float, int, Frame]] = []
        self._numbers = itertools.count()
        self._free_at = 0.0
        self.end = 0.0
        """The end of the last film on the timeline of simulated time [s]."""

    def add(self, now: float, step: int, times: Sequence[float], frames: Sequence[Frame]) -> None:
        """A film that became known.

        Args:
            now: on the wall clock [s since 1970].
            step: of the campaign.
            times: of its frames, increasing [s].
            frames: one for each.
        """
        if not times:
            return
        begin = self.end + (PAUSE if self.end > 0.0 else 0.0)
        self.end = begin + times[-1] - times[0]
        start = max(now, self._free_at)
        if start - now > LONGEST_BACKLOG:
            self._outlet.without("wall")
            for time, frame in zip(times, frames, strict=True):
                self._outlet.times(step=step, sim_time=begin + time - times[0])
                frame()
            return
        self._free_at = start + times[-1] - times[0] + PAUSE
        for time, frame in zip(times, frames, strict=True):
            after = time - times[0]
            heapq.heappush(self._planned, (start + after, next(self._numbers), begin + after, step, frame))

    @property
    def next_due(self) -> float | None:
        """When the next frame is due [s since 1970]; None without one."""
        return self._planned[0][0] if self._planned else None

    def play(self, now: float) -> None:
        """Log all frames that are due by now."""
        while self._planned and self._planned[0][0] <= now:
            wall, _, sim_time, step, frame = heapq.heappop(self._planned)
            self._outlet.times(wall=wall, step=step, sim_time=sim_time)
            frame()
