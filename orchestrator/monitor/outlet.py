"""One recording, written to a file and, where somebody may look, sent to a server: two streams that get the same.

They are two, and not one with two ends, because Rerun completes a file only once the other end has taken everything: a
server that hangs would leave a file that can't be opened quickly, or not at all.
"""

from __future__ import annotations

import os
import threading
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Said before the SDK is loaded: a laboratory's daemon talks to nobody unasked.
os.environ.setdefault("RERUN_ANALYTICS", "off")

if TYPE_CHECKING:
    import rerun.blueprint as rrb

FILING = 2.0
"""Rows of the file are kept together for so long [s]: packing each few of them costs more than making them."""

SENDING = 0.5
"""Rows for those who watch, likewise [s]."""

LAST_WORDS = 5.0
"""How long a server may take for the last of it [s]."""


class Outlet:
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
        self._on_wall = False
        recording_id = uuid.uuid4().hex
        # Some rows at a time: a viewer chokes on many small pieces long before their bytes are many.
        # Not by size either: a film's frames would be packed one by one.
        filed, sent = rr.ChunkBatcherConfig(), rr.ChunkBatcherConfig()
        filed.flush_tick, sent.flush_tick = FILING, SENDING
        self._file = rr.RecordingStream(application, recording_id=recording_id, batcher_config=filed)
        self._file.set_sinks(rr.FileSink(str(path)))
        self._streams = [self._file]
        if url:
            live = rr.RecordingStream(application, recording_id=recording_id, batcher_config=sent)
            live.set_sinks(rr.GrpcSink(url))
            self._streams.append(live)
        for stream in self._streams:
            stream.set_log_tick_enabled(False)
            stream.set_log_time_enabled(False)
            stream.send_recording_name(name)

    def times(self, **times: float | int) -> None:
        """Set the times of what follows: whole numbers as they are, others in seconds, 'wall' since 1970."""
        for stream in self._streams:
            for name, value in times.items():
                if name == "wall":
                    self._on_wall = True
                    stream.set_time(name, timestamp=value)
                elif isinstance(value, int):
                    stream.set_time(name, sequence=value)
                else:
                    stream.set_time(name, duration=value)

    def without(self, *names: str) -> None:
        """What follows is not on these timelines."""
        self._on_wall &= "wall" not in names
        for stream in self._streams:
            for name in names:
                stream.disable_timeline(name)

    def log(self, entity: str, *what: Any, static: bool = False) -> None:
        """A row."""
        for stream in self._streams:
            stream.log(entity, *what, static=static)

    def show(self, blueprint: rrb.Blueprint) -> None:
        """What those who look now are shown from now on."""
        for stream in self._streams[1:]:
            stream.send_blueprint(blueprint)

    def keep(self, blueprint: rrb.Blueprint) -> None:
        """How the file is shown. One for each file: `rerun rrd optimize` shuffles several, and the last one counts."""
        self._file.send_blueprint(blueprint)

    @property
    def on_wall(self) -> bool:
        """Whether what follows is on the wall clock."""
        return self._on_wall

    def close(self) -> None:
        """Complete the file; the server gets a little time for the rest."""
        self._file.disconnect()
        for stream in self._streams[1:]:
            ending = threading.Thread(target=stream.disconnect, daemon=True)
            ending.start()
            ending.join(LAST_WORDS)
