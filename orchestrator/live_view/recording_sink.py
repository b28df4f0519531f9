"""One recording, written to a file and optionally sent to a server, and the playback of recorded motion in it.

`RecordingSink` takes rows and sends the rows of one entity together as columns, since a call for each row costs three
times as much. Two separate streams are needed: Rerun completes a file only after all sinks of its stream have received
everything, so a server that hangs would leave an incomplete file.

`Playback` is one recorded motion with its tracks; `PlaybackQueue` logs the frames when they are due. On the timeline of
simulated time, playbacks follow one another. On the wall clock, a playback starts when it becomes known and runs in
real time, so live viewers see the liquid move even if the bench runs in scaled time. Playbacks that would start too
late are left out of the wall clock.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from orchestrator.live_view.viewer_server import SENDING

FILING = 2.0
"""Time for which rows of the file are collected [s]: packing a few rows at a time costs more than making them."""

LAST_WORDS = 5.0
"""Time that a server may take for the last rows [s]."""

LARGEST = 2 << 20
"""Largest size of collected rows of one entity [bytes]; only a single larger row exceeds it."""

Moment = Mapping[str, int]
"""Times by timeline: 'wall' in nanoseconds since 1970, 'step' as a number, all others in nanoseconds."""

Columns = Sequence[tuple[Any, Any]]
"""Components of some rows: descriptors, and Arrow lists with one element per row."""


class RecordingSink:
    """The sink of all rows. For one thread.

    Args:
        path: `.rrd` to write; its folder is created if needed.
        application: recordings of one application share the settings of the viewer.
        name: display name of the recording.
        url: URL of a Rerun server that gets the same rows; '' for none.

    Raises:
        OSError: the file can't be written.
    """

    def __init__(self, path: Path, *, application: str, name: str, url: str = "") -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # FileSink only logs if it can't write; detect this while the caller can still report it.
        path.open("wb").close()
        self._now: dict[str, int] = {}
        recording_id = uuid.uuid4().hex
        # Static rows are logged one by one. Many small chunks slow a viewer down more than their size does.
        filed, sent = rr.ChunkBatcherConfig(), rr.ChunkBatcherConfig()
        filed.flush_tick, sent.flush_tick = FILING, SENDING
        file = rr.RecordingStream(application, recording_id=recording_id, batcher_config=filed)
        file.set_sinks(rr.FileSink(str(path)))
        self._ends = [_End(file, FILING)]
        if url:
            live = rr.RecordingStream(application, recording_id=recording_id, batcher_config=sent)
            live.set_sinks(rr.GrpcSink(url))
            self._ends.append(_End(live, 0.0))  # the caller of `send` sets the pace
        for end in self._ends:
            end.stream.set_log_tick_enabled(False)
            end.stream.set_log_time_enabled(False)
            end.stream.send_recording_name(name)

    def times(self, **times: float | int) -> None:
        """Set the times of the following rows: 'step' as a number, others in seconds, 'wall' since 1970."""
        self._now |= moment(**times)

    def without(self, *names: str) -> None:
        """Remove timelines from the following rows."""
        for name in names:
            self._now.pop(name, None)

    @property
    def now(self) -> Moment:
        """The times of rows that are logged now."""
        return dict(self._now)

    def log(self, entity: str, *archetypes: Any, static: bool = False, at: Moment | None = None) -> None:
        """Log a row.

        Args:
            entity: path of the entity.
            archetypes: archetypes.
            static: whether the row is valid at all times.
            at: times of the row, if they differ from `now`.
        """
        if static:
            for end in self._ends:
                end.stream.log(entity, *archetypes, static=True)
            return
        batches = [batch for each in archetypes for batch in each.as_component_batches()]
        arrays = [batch.as_arrow_array() for batch in batches]
        columns = [
            (batch.component_descriptor(), pa.ListArray.from_arrays([0, len(array)], array))
            for batch, array in zip(batches, arrays, strict=True)
        ]
        self.rows(entity, [self.now if at is None else at], columns)

    def number(self, entity: str, value: float) -> None:
        """Log one value of a curve; the same as logging a scalar, but faster, since most rows are of this kind."""
        at = self.now
        for end in self._ends:
            end.take_number(entity, at, value)

    def rows(self, entity: str, moments: Sequence[Moment], columns: Columns) -> None:
        """Log several rows on the same timelines.

        Args:
            entity: path of the entity.
            moments: times of each row.
            columns: components of the rows.
        """
        size = sum(array.nbytes for _, array in columns)
        if size <= LARGEST or len(moments) == 1:
            for end in self._ends:
                end.take(entity, moments, columns, size)
            return
        half = len(moments) // 2
        for side in (slice(half), slice(half, None)):
            self.rows(entity, moments[side], [(name, array[side]) for name, array in columns])

    def clear(self, entity: str, *, recursive: bool = False) -> None:
        """Hide the previous content of an entity from now on.

        Args:
            entity: path of the entity.
            recursive: also clear the entities below it.
        """
        # If several rows have the same time, the last one sent is valid.
        for end in self._ends:
            end.send(entity)
        self.log(entity, rr.Clear(recursive=recursive))
        for end in self._ends:
            end.send(entity)

    def send(self, *, everything: bool = False) -> None:
        """Send the rows that have been collected for long enough.

        Args:
            everything: send all rows.
        """
        now = time.monotonic()
        for end in self._ends:
            if everything or end.due <= now:
                end.send()

    @property
    def wait(self) -> float | None:
        """Time until there are rows to send [s]; None if no rows are waiting."""
        due = min(end.due for end in self._ends)
        return None if due == float("inf") else max(due - time.monotonic(), 0.0)

    def show(self, blueprint: rrb.Blueprint) -> None:
        """Set the layout for live viewers."""
        for end in self._ends[1:]:
            end.stream.send_blueprint(blueprint)

    def keep(self, blueprint: rrb.Blueprint) -> None:
        """Set the layout of the file. Call it once: `rerun rrd optimize` reorders layouts, and the last one is used."""
        self._ends[0].stream.send_blueprint(blueprint)

    @property
    def on_wall(self) -> bool:
        """Whether the following rows are on the wall clock."""
        return "wall" in self._now

    def close(self) -> None:
        """Complete the file; the server gets a limited time for the rest."""
        self.send(everything=True)
        file, *others = (end.stream for end in self._ends)
        file.disconnect()
        for stream in others:
            ending = threading.Thread(target=stream.disconnect, daemon=True)
            ending.start()
            ending.join(LAST_WORDS)


def moment(**times: float | int) -> dict[str, int]:
    """Convert times: 'step' as a number, others in seconds, 'wall' since 1970."""
    return {name: int(value) if name == "step" else round(1e9 * value) for name, value in times.items()}


def columns_of(*parts: Iterable[Any]) -> Columns:
    """Combine the `columns` of archetypes to rows of one entity."""
    return [(column.component_descriptor(), column.as_arrow_array()) for batch in parts for column in batch]


@dataclass
class _Gathered:
    """Rows of one entity with the same timelines and components."""

    moments: list[Moment] = field(default_factory=list)
    columns: list[list[Any]] = field(default_factory=list)
    """Arrow lists of each component; empty for rows of a curve."""
    numbers: list[float] = field(default_factory=list)
    """Values of a curve."""
    size: int = 0
    """Size [bytes]."""


class _End:
    """A stream with its collected rows.

    Args:
        stream: Rerun's stream.
        every: time for which rows are collected [s].
    """

    def __init__(self, stream: Any, every: float) -> None:
        self.stream, self._every = stream, every
        self._gathered: dict[tuple[str, tuple[str, ...], tuple[Any, ...]], _Gathered] = {}
        self.due = float("inf")
        """Time at which rows must be sent [s of the monotonic clock]."""

    def take(self, entity: str, moments: Sequence[Moment], columns: Columns, size: int) -> None:
        """Collect rows of a given size."""
        rows = self._rows_of(entity, moments[0], tuple(name for name, _ in columns))
        if rows.moments and rows.size + size > LARGEST:
            self.send(entity)
            rows = self._rows_of(entity, moments[0], tuple(name for name, _ in columns))
        rows.columns = rows.columns or [[] for _ in columns]
        rows.moments.extend(moments)
        rows.size += size
        for chunks, (_, array) in zip(rows.columns, columns, strict=True):
            chunks.append(array)

    def take_number(self, entity: str, at: Moment, value: float) -> None:
        """Collect one value of a curve."""
        rows = self._rows_of(entity, at, ())
        rows.moments.append(at)
        rows.numbers.append(value)

    def _rows_of(self, entity: str, at: Moment, components: tuple[Any, ...]) -> _Gathered:
        if not self._gathered:
            self.due = time.monotonic() + self._every
        key = (entity, tuple(sorted(at)), components)
        if (rows := self._gathered.get(key)) is None:
            rows = self._gathered[key] = _Gathered()
        return rows

    def send(self, under: str = "") -> None:
        """Send the collected rows.

        Args:
            under: only rows of this entity and of those below it.
        """
        chosen = [key for key in self._gathered if not under or f"{key[0]}/".startswith(f"{under}/")]
        for key in chosen:
            self._send(key[0], key[1], key[2], self._gathered.pop(key))
        if not self._gathered:
            self.due = float("inf")

    def _send(self, entity: str, timelines: Iterable[str], components: Iterable[Any], rows: _Gathered) -> None:
        indexes = [_index(name, [moment[name] for moment in rows.moments]) for name in timelines]
        columns: Iterable[Any] = (
            rr.Scalars.columns(scalars=rows.numbers)
            if rows.numbers
            else [_Column(key, pa.concat_arrays(some)) for key, some in zip(components, rows.columns, strict=True)]
        )
        self.stream.send_columns(entity, indexes, columns)


@dataclass(frozen=True)
class _Column:
    """A column that is already an Arrow list, with the interface that `send_columns` requires."""

    descriptor: Any
    array: Any

    def component_descriptor(self) -> Any:
        return self.descriptor

    def as_arrow_array(self) -> Any:
        return self.array


def _index(name: str, values: list[int]) -> Any:
    if name == "wall":
        return rr.TimeColumn(name, timestamp=np.array(values, "datetime64[ns]"))
    if name == "step":
        return rr.TimeColumn(name, sequence=np.array(values, np.int64))
    return rr.TimeColumn(name, duration=np.array(values, "timedelta64[ns]"))


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
                self._sink.rows(track.entity, moments, [(name, rows[first:last]) for name, rows in track.columns])
        if until >= film.length:
            self._sink.times(**showing.times(film.length))
            film.end()
