"""Playback of motion that took place in simulated or bench time, at its original speed.

`Playback` is one recorded motion with its tracks; `PlaybackQueue` logs the frames when they are due. On the timeline of
simulated time, playbacks follow one another. On the wall clock, a playback starts when it becomes known and runs in
real time, so live viewers see the liquid move even if the bench runs in scaled time. Playbacks that would start too
late are left out of the wall clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orchestrator.live_view.recording_sink import Columns, RecordingSink, moment

LONGEST_BACKLOG = 20.0
"""Playbacks that would start later than this after they became known are not shown on the wall clock [s]."""

PAUSE = 0.5
"""Pause between two playbacks [s]."""

_SOON = 1e-6
"""Rounding of times [s]."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """One entity of a playback.

    Attributes:
        entity: path of the entity.
        times: times since the start, increasing, shape (T,) [s].
        columns: components, T rows.
    """

    entity: str
    times: FloatArray
    columns: Columns


def _nothing() -> None:
    return


@dataclass(frozen=True)
class Playback:
    """A recorded motion.

    Attributes:
        length: duration [s].
        tracks: entities that change.
        begin: logs the static content, at the time of the start.
        end: logs the final content, at the time of the end.
    """

    length: float
    tracks: Sequence[Track]
    begin: Callable[[], object] = _nothing
    end: Callable[[], object] = _nothing


@dataclass
class _Showing:
    """A playback that is waiting or in progress."""

    film: Playback
    step: int
    wall: float | None
    """Wall time of its start [s since 1970]; None if it is not on the wall clock."""
    sim_time: float
    """Simulated time of its start [s]."""
    begun: bool = False
    shown: list[int] = field(default_factory=list)
    """Number of rows of each track that were logged."""

    def times(self, after: float) -> dict[str, float | int]:
        """Return the times at an offset from the start [s]."""
        wall: dict[str, float | int] = {} if self.wall is None else {"wall": self.wall + after}
        return {**wall, "step": self.step, "sim_time": self.sim_time + after}


class PlaybackQueue:
    """Waiting playbacks. For one thread.

    Args:
        sink: sink of the frames.
    """

    def __init__(self, sink: RecordingSink) -> None:
        self._sink = sink
        self._planned: deque[_Showing] = deque()
        self._free_at = 0.0
        self.end = 0.0
        """End of the last playback on the timeline of simulated time [s]."""

    def add(self, now: float, step: int, film: Playback) -> None:
        """Add a playback.

        Args:
            now: wall clock [s since 1970].
            step: step of the campaign.
            film: playback to add.
        """
        begin = self.end + (PAUSE if self.end > 0.0 else 0.0)
        self.end = begin + film.length
        start = max(now, self._free_at)
        shown = [0] * len(film.tracks)
        if start - now > LONGEST_BACKLOG:
            self._sink.without("wall")
            self._show(_Showing(film, step, None, begin, shown=shown), float("inf"))
            return
        self._free_at = start + film.length + PAUSE
        self._planned.append(_Showing(film, step, start, begin, shown=shown))

    @property
    def next_due(self) -> float | None:
        """Time at which the next frame is due [s since 1970]; None if there is none."""
        if not self._planned:
            return None
        showing = self._planned[0]
        assert showing.wall is not None
        tracks = zip(showing.film.tracks, showing.shown, strict=True)
        following = [float(track.times[done]) for track, done in tracks if done < len(track.times)]
        return showing.wall + (min(following, default=showing.film.length) if showing.begun else 0.0)

    def play(self, now: float) -> None:
        """Log all frames that are due."""
        while self._planned and (showing := self._planned[0]).wall is not None and showing.wall <= now:
            if over := now - showing.wall >= showing.film.length:
                self._planned.popleft()
            self._show(showing, float("inf") if over else now - showing.wall)
            if not over:
                return

    def _show(self, showing: _Showing, until: float) -> None:
        """Log a playback up to an offset from its start [s]."""
        film = showing.film
        if not showing.begun:
            showing.begun = True
            self._sink.times(**showing.times(0.0))
            film.begin()
        for number, track in enumerate(film.tracks):
            first = showing.shown[number]
            showing.shown[number] = last = int(np.searchsorted(track.times, until + _SOON, side="right"))
            if last > first:
                moments = [moment(**showing.times(float(each))) for each in track.times[first:last]]
                self._sink.rows(track.entity, moments, [(what, rows[first:last]) for what, rows in track.columns])
        if until >= film.length:
            self._sink.times(**showing.times(film.length))
            film.end()
