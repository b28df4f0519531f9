"""Several recordings in one, side by side: each under a name of its own, on the timelines that they share."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from orchestrator.monitor.blueprint import beside_blueprint


def put_beside(recordings: Mapping[str, Path], path: Path) -> Path:
    """Write one recording of several.

    Args:
        recordings: `.rrd` files by the name that each is to have; a part of an entity's path.
        path: `.rrd` to write.

    Returns:
        `path`.

    Raises:
        OSError: a file can't be read or written.
    """
    import rerun as rr
    from rerun.chunk import RrdReader

    path.open("wb").close()
    stream = rr.RecordingStream("decant beside")
    stream.set_sinks(rr.FileSink(str(path)))
    stream.send_recording_name(" beside ".join(recordings))
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for name, file in recordings.items():
        for chunk in RrdReader(str(file)).stream():
            entity = str(chunk.entity_path)
            if entity != "/" and not entity.startswith("/__"):
                stream.send_chunks([chunk.with_entity_path(f"/{name}{entity}")])
    stream.send_blueprint(beside_blueprint(tuple(recordings)))
    stream.disconnect()
    return path
