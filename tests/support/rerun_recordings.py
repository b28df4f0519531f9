"""Reads what a Rerun recording contains, and records what a live view sends to a viewer without a screen."""

from __future__ import annotations

import contextlib
import re
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow as pa

from actors.runtime.child_process import child_environment
from orchestrator.live_view.viewer_server import environment, rerun_program, run_rerun
from tests.support.waiting import PATIENCE


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


def tabs_as_they_came(path: Path) -> list[str]:
    """Names of the tabs that the arrangements in an .rrd turn to, in the order in which a viewer takes them."""
    from rerun.chunk import RrdReader

    reader, turned = RrdReader(str(path)), {}
    for store in reader.blueprints():
        names: dict[str, str] = {}
        active = ""
        for chunk in reader.stream(store=store):
            table = chunk.to_record_batch()
            rows = {
                name.rpartition(":")[2]: column.to_pylist()
                for name, column in zip(table.schema.names, table.columns, strict=True)
            }
            names[str(chunk.entity_path).lstrip("/")] = (rows.get("display_name") or [[""]])[0][0]
            active = (rows.get("active_tab") or [[active]])[0][0] or active
        turned[store.recording_id] = names[active]
    said = run_rerun("rrd", "print", str(path)).stdout
    return [
        turned[found]
        for found in re.findall(r'BlueprintActivationCommand\(StoreId\(Blueprint, "[^"]*", "([^"]*)"', said)
    ]


@contextlib.contextmanager
def viewer(stream: str, kept: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Connected while the context lasts; writes to `kept`."""
    process = subprocess.Popen(
        [rerun_program(), "--save", str(kept), "--connect", stream, "--port", "auto"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=child_environment(environment()),
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def seen(kept: Path, enough: Callable[[Contents], bool]) -> Contents:
    """What a viewer has been sent, once it is enough."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        time.sleep(0.3)
        with contextlib.suppress(Exception), warnings.catch_warnings():  # half-written
            warnings.simplefilter("ignore")
            contents = Contents(kept)
            if enough(contents):
                return contents
    raise AssertionError(f"not enough came to the viewer within {PATIENCE:g} s")


def timeline(path: Path) -> str:
    """The timeline of the last arrangement in an .rrd."""
    from rerun.chunk import RrdReader

    reader, found = RrdReader(str(path)), ""
    for chunk in reader.stream(store=reader.blueprints()[-1]):
        table = chunk.to_record_batch()
        if str(chunk.entity_path) == "/time_panel" and "TimePanelBlueprint:timeline" in table.schema.names:
            ((found,),) = table.column("TimePanelBlueprint:timeline").to_pylist()
    return found


def views(path: Path) -> dict[str, list[str]]:
    """What the views of the last arrangement in an .rrd show: entities by the view's name, '/**' for all below one."""
    from rerun.chunk import RrdReader

    reader, found = RrdReader(str(path)), {}
    store = reader.blueprints()[-1]
    kept: dict[str, dict[str, list[object]]] = {}
    for chunk in reader.stream(store=store):
        table = chunk.to_record_batch()
        for name, column in zip(table.schema.names, table.columns, strict=True):
            for row in column.to_pylist():
                if row:
                    kept.setdefault(str(chunk.entity_path), {})[name.rpartition(":")[2]] = row
    for entity, rows in kept.items():
        if "space_origin" in rows:
            origin = str(rows["space_origin"][0])
            queries = kept.get(f"{entity}/ViewContents", {}).get("query", ["$origin/**"])
            name = str((rows.get("display_name") or [entity])[0])
            found[name] = [str(q).lstrip("+ ").replace("$origin", origin) for q in queries]
    return found
