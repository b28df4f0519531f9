"""One recording, written to a file and, where somebody may look, sent to a server: two streams that get the same.

They are two, and not one with two ends, because Rerun completes a file only once the other end has taken everything: a
server that hangs would leave a file that can't be opened quickly, or not at all.

Rows are gathered, and those of one entity sent as columns: a call for each row and stream costs three times as much.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import rerun.blueprint as rrb

FILING = 2.0
"""Rows of the file are kept together for so long [s]: packing each few of them costs more than making them."""

SENDING = 0.75
"""Rows for those who watch, likewise: `RecordingSink.send` is called so often [s]."""

LAST_WORDS = 5.0
"""How long a server may take for the last of it [s]."""

LARGEST = 2 << 20
"""Rows of one entity are sent before they are more than that [bytes], but for a row that is: no message is huge."""

Moment = Mapping[str, int]
"""Times by timeline: 'wall' in nanoseconds since 1970, 'step' as it is, all others in nanoseconds."""

Columns = Sequence[tuple[Any, Any]]
"""Components of some rows: descriptors, and Arrow lists as long as there are rows."""


class RecordingSink:
    """Where rows go. For one thread.

    Args:
        path: `.rrd` to write; its folder is made if needed.
        application: recordings of one application share what a viewer has been set to show.
        name: of the recording, for people.
        url: of a Rerun server that gets the same; '' for none.

    Raises:
        OSError: the file can't be written.
    """

    def __init__(self, path: Path, *, application: str, name: str, url: str = "") -> None:
        import rerun as rr

        path.parent.mkdir(parents=True, exist_ok=True)
        # FileSink only logs that it can't write; find out while somebody still listens.
        path.open("wb").close()
        self._now: dict[str, int] = {}
        recording_id = uuid.uuid4().hex
        # What is static is logged row by row. A viewer chokes on many small pieces long before their bytes are many.
        filed, sent = rr.ChunkBatcherConfig(), rr.ChunkBatcherConfig()
        filed.flush_tick, sent.flush_tick = FILING, SENDING
        file = rr.RecordingStream(application, recording_id=recording_id, batcher_config=filed)
        file.set_sinks(rr.FileSink(str(path)))
        self._ends = [_End(file, FILING)]
        if url:
            live = rr.RecordingStream(application, recording_id=recording_id, batcher_config=sent)
            live.set_sinks(rr.GrpcSink(url))
            self._ends.append(_End(live, 0.0))  # whoever calls `send` takes his time
        for end in self._ends:
            end.stream.set_log_tick_enabled(False)
            end.stream.set_log_time_enabled(False)
            end.stream.send_recording_name(name)

    def times(self, **times: float | int) -> None:
        """Set the times of what follows: 'step' as it is, others in seconds, 'wall' since 1970."""
        self._now |= moment(**times)

    def without(self, *names: str) -> None:
        """What follows is not on these timelines."""
        for name in names:
            self._now.pop(name, None)

    @property
    def now(self) -> Moment:
        """The times of what is logged now."""
        return dict(self._now)

    def log(self, entity: str, *what: Any, static: bool = False, at: Moment | None = None) -> None:
        """A row.

        Args:
            entity: its path.
            what: archetypes.
            static: at all times.
            at: its times, if not now's.
        """
        if static:
            for end in self._ends:
                end.stream.log(entity, *what, static=True)
            return
        import pyarrow as pa

        batches = [batch for each in what for batch in each.as_component_batches()]
        arrays = [batch.as_arrow_array() for batch in batches]
        columns = [
            (batch.component_descriptor(), pa.ListArray.from_arrays([0, len(array)], array))
            for batch, array in zip(batches, arrays, strict=True)
        ]
        self.rows(entity, [self.now if at is None else at], columns)

    def number(self, entity: str, value: float) -> None:
        """A row of a curve. The same as to log a scalar; most rows are such."""
        at = self.now
        for end in self._ends:
            end.take_number(entity, at, value)

    def rows(self, entity: str, moments: Sequence[Moment], columns: Columns) -> None:
        """Some rows, which are all on the same timelines.

        Args:
            entity: its path.
            moments: one for each.
            columns: their components.
        """
        size = sum(array.nbytes for _, array in columns)
        if size <= LARGEST or len(moments) == 1:
            for end in self._ends:
                end.take(entity, moments, columns, size)
            return
        half = len(moments) // 2
        for part in (slice(half), slice(half, None)):
            self.rows(entity, moments[part], [(what, array[part]) for what, array in columns])

    def clear(self, entity: str, *, recursive: bool = False) -> None:
        """What was logged of an entity is not shown any more from now on.

        Args:
            entity: its path.
            recursive: those below it as well.
        """
        import rerun as rr

        # Of rows with the same time the last that was sent counts.
        for end in self._ends:
            end.send(entity)
        self.log(entity, rr.Clear(recursive=recursive))
        for end in self._ends:
            end.send(entity)

    def send(self, *, everything: bool = False) -> None:
        """Send what has been gathered for long enough.

        Args:
            everything: however short a time it has been.
        """
        now = time.monotonic()
        for end in self._ends:
            if everything or end.due <= now:
                end.send()

    @property
    def wait(self) -> float | None:
        """How long there is nothing to be sent [s]; None: until more is logged."""
        due = min(end.due for end in self._ends)
        return None if due == float("inf") else max(due - time.monotonic(), 0.0)

    def show(self, blueprint: rrb.Blueprint) -> None:
        """What those who look now are shown from now on."""
        for end in self._ends[1:]:
            end.stream.send_blueprint(blueprint)

    def keep(self, blueprint: rrb.Blueprint) -> None:
        """How the file is shown. One for each file: `rerun rrd optimize` shuffles several, and the last one counts."""
        self._ends[0].stream.send_blueprint(blueprint)

    @property
    def on_wall(self) -> bool:
        """Whether what follows is on the wall clock."""
        return "wall" in self._now

    def close(self) -> None:
        """Complete the file; the server gets a little time for the rest."""
        self.send(everything=True)
        file, *others = (end.stream for end in self._ends)
        file.disconnect()
        for stream in others:
            ending = threading.Thread(target=stream.disconnect, daemon=True)
            ending.start()
            ending.join(LAST_WORDS)


def moment(**times: float | int) -> dict[str, int]:
    """Times: 'step' as it is, others in seconds, 'wall' since 1970."""
    return {name: int(value) if name == "step" else round(1e9 * value) for name, value in times.items()}


def columns_of(*parts: Iterable[Any]) -> Columns:
    """What the `columns` of archetypes give, to be sent as rows of one entity."""
    return [(column.component_descriptor(), column.as_arrow_array()) for part in parts for column in part]


@dataclass
class _Gathered:
    """Rows of one entity with the same timelines and components."""

    moments: list[Moment] = field(default_factory=list)
    columns: list[list[Any]] = field(default_factory=list)
    """Arrow lists of each component; none for rows of a curve."""
    numbers: list[float] = field(default_factory=list)
    """Rows of a curve."""
    size: int = 0
    """[bytes]."""


class _End:
    """A stream, and what is gathered for it.

    Args:
        stream: where rows go.
        every: so long they are gathered [s].
    """

    def __init__(self, stream: Any, every: float) -> None:
        self.stream, self._every = stream, every
        self._gathered: dict[tuple[str, tuple[str, ...], tuple[Any, ...]], _Gathered] = {}
        self.due = float("inf")
        """When rows are to be sent [s of the monotonic clock]."""

    def take(self, entity: str, moments: Sequence[Moment], columns: Columns, size: int) -> None:
        """Gather some rows of some bytes."""
        rows = self._rows_of(entity, moments[0], tuple(what for what, _ in columns))
        if rows.moments and rows.size + size > LARGEST:
            self.send(entity)
            rows = self._rows_of(entity, moments[0], tuple(what for what, _ in columns))
        rows.columns = rows.columns or [[] for _ in columns]
        rows.moments.extend(moments)
        rows.size += size
        for kept, (_, array) in zip(rows.columns, columns, strict=True):
            kept.append(array)

    def take_number(self, entity: str, at: Moment, value: float) -> None:
        """Gather a row of a curve."""
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
        """Send what is gathered.

        Args:
            under: only what belongs to this entity and those below it.
        """
        chosen = [key for key in self._gathered if not under or f"{key[0]}/".startswith(f"{under}/")]
        for key in chosen:
            self._send(key[0], key[1], key[2], self._gathered.pop(key))
        if not self._gathered:
            self.due = float("inf")

    def _send(self, entity: str, timelines: Iterable[str], components: Iterable[Any], rows: _Gathered) -> None:
        import pyarrow as pa
        import rerun as rr

        indexes = [_index(name, [moment[name] for moment in rows.moments]) for name in timelines]
        columns: Iterable[Any] = (
            rr.Scalars.columns(scalars=rows.numbers)
            if rows.numbers
            else [_Column(what, pa.concat_arrays(some)) for what, some in zip(components, rows.columns, strict=True)]
        )
        self.stream.send_columns(entity, indexes, columns)


@dataclass(frozen=True)
class _Column:
    """A column that is an Arrow list already; what `send_columns` asks of one."""

    descriptor: Any
    array: Any

    def component_descriptor(self) -> Any:
        return self.descriptor

    def as_arrow_array(self) -> Any:
        return self.array


def _index(name: str, values: list[int]) -> Any:
    import numpy as np
    import rerun as rr

    if name == "wall":
        return rr.TimeColumn(name, timestamp=np.array(values, "datetime64[ns]"))
    if name == "step":
        return rr.TimeColumn(name, sequence=np.array(values, np.int64))
    return rr.TimeColumn(name, duration=np.array(values, "timedelta64[ns]"))
