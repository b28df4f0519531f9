"""What is in a recording."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa


class Contents:
    """What is in an .rrd: rows by entity, and the timelines they are on."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(str(path))
        self.blueprints = len(reader.blueprints())
        self.columns: dict[str, dict[str, list[object]]] = {}
        for chunk in (chunk for store in reader.recordings() for chunk in reader.stream(store=store)):
            table = chunk.to_record_batch()
            entity = self.columns.setdefault(str(chunk.entity_path), {})
            for name, column in zip(table.schema.names, table.columns, strict=True):
                if pa.types.is_temporal(column.type):  # nanoseconds, finer than Python's times
                    column = column.cast(pa.int64())  # noqa: PLW2901
                entity.setdefault(name, []).extend(column.to_pylist())

    def values(self, entity: str, component: str) -> list[object]:
        """All rows of a component, in no particular order of chunks."""
        return [v for name, rows in self.columns[entity].items() if component in name for v in rows if v is not None]

    def rows(self, entity: str, timeline: str = "wall") -> int:
        """Rows of an entity on a timeline."""
        return len(self.columns[entity].get(timeline, ()))
