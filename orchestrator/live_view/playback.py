"""Films: what took place in simulated or bench time, shown at its own pace.

On the timeline of simulated time films lie one behind the other. On the wall clock a film runs from when it became
known, a second for a second: whoever watches live sees the liquid move, and a bench of scaled time is seen at the speed
of a real one. Frames are kept back until they are due. What would run too far behind is left out of the wall clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orchestrator.live_view.recording_sink import Columns, RecordingSink, moment

LONGEST_BACKLOG = 20.0
"""Films that would begin later than so after they became known are not shown on the wall clock [s]."""

PAUSE = 0.5
"""Between two films [s]."""

_SOON = 1e-6
"""Rounding of times [s]."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """One entity of a film.

    Attributes:
        entity: its path.
        times: since the film's beginning, increasing, shape (T,) [s].
        columns: components, T rows.
    """

    entity: str
    times: FloatArray
    columns: Columns


def _nothing() -> None:
    return


@dataclass(frozen=True)
class Playback:
    """A film.

    Attributes:
        length: [s].
        tracks: what is shown.
        begin: logs what stands still, with the times of the beginning.
        end: logs what is to be logged at the end, with its times.
    """

    length: float
    tracks: Sequence[Track]
    begin: Callable[[], object] = _nothing
    end: Callable[[], object] = _nothing


@dataclass
class _Showing:
    """A film that is to be shown, or is."""

    film: Playback
    step: int
    wall: float | None
    """Of its beginning [s since 1970]; None: it is not on the wall clock."""
    sim_time: float
    """Likewise [s]."""
    begun: bool = False
    shown: list[int] = field(default_factory=list)
    """Rows of each track that were shown."""

    def times(self, after: float) -> dict[str, float | int]:
        """So long after the beginning [s]."""
        wall: dict[str, float | int] = {} if self.wall is None else {"wall": self.wall + after}
        return {**wall, "step": self.step, "sim_time": self.sim_time + after}


class PlaybackQueue:
    """What is still to be shown. For one thread.

    Args:
        outlet: that frames go to.
    """

    def __init__(self, outlet: RecordingSink) -> None:
        self._outlet = outlet
        self._planned: deque[_Showing] = deque()
        self._free_at = 0.0
        self.end = 0.0
        """The end of the last film on the timeline of simulated time [s]."""

    def add(self, now: float, step: int, film: Playback) -> None:
        """A film that became known.

        Args:
            now: on the wall clock [s since 1970].
            step: of the campaign.
            film: to be shown.
        """
        begin = self.end + (PAUSE if self.end > 0.0 else 0.0)
        self.end = begin + film.length
        start = max(now, self._free_at)
        shown = [0] * len(film.tracks)
        if start - now > LONGEST_BACKLOG:
            self._outlet.without("wall")
            self._show(_Showing(film, step, None, begin, shown=shown), float("inf"))
            return
        self._free_at = start + film.length + PAUSE
        self._planned.append(_Showing(film, step, start, begin, shown=shown))

    @property
    def next_due(self) -> float | None:
        """When the next frame is due [s since 1970]; None without one."""
        if not self._planned:
            return None
        showing = self._planned[0]
        assert showing.wall is not None
        tracks = zip(showing.film.tracks, showing.shown, strict=True)
        following = [float(track.times[done]) for track, done in tracks if done < len(track.times)]
        return showing.wall + (min(following, default=showing.film.length) if showing.begun else 0.0)

    def play(self, now: float) -> None:
        """Log all frames that are due by now."""
        while self._planned and (showing := self._planned[0]).wall is not None and showing.wall <= now:
            if over := now - showing.wall >= showing.film.length:
                self._planned.popleft()
            self._show(showing, float("inf") if over else now - showing.wall)
            if not over:
                return

    def _show(self, showing: _Showing, until: float) -> None:
        """So much of a film [s]."""
        film = showing.film
        if not showing.begun:
            showing.begun = True
            self._outlet.times(**showing.times(0.0))
            film.begin()
        for number, track in enumerate(film.tracks):
            first = showing.shown[number]
            showing.shown[number] = last = int(np.searchsorted(track.times, until + _SOON, side="right"))
            if last > first:
                moments = [moment(**showing.times(float(each))) for each in track.times[first:last]]
                self._outlet.rows(track.entity, moments, [(what, rows[first:last]) for what, rows in track.columns])
        if until >= film.length:
            self._outlet.times(**showing.times(film.length))
            film.end()
