"""The numbered sequence of all events of the daemon, for subscribers that may reconnect.

`Feed` keeps the newest events in memory and on disk. Each reader has its own position: it continues from the last event
it saw and never blocks other readers. A slow reader misses events that are no longer stored. `event_json` converts
events to typed JSON, without recorded particles and without values that other routes return.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import sqlite3
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from actors.optimizer.questions import WRITTEN_IF_SET
from orchestrator.learning.requests import Suggest, Suggested
from orchestrator.records.events import (
    CampaignOpened,
    Event,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    SpeculationProgressed,
    StrategyProgressed,
)

PASSING = (PourProgressed, StrategyProgressed, SpeculationProgressed)
"""Progress events. Each replaces the one before it, so they are not stored on disk."""


def event_json(event: Event) -> dict[str, Any]:
    """Return the fields of an event, with the name of its class under 'type'.

    Recorded particles are left out, since the recording contains them. A suggestion query is reduced to its purpose and
    its outcome to the points. A strategy's stage result is part of the event that closes the stage.
    """
    sent = [f.name for f in dataclasses.fields(event) if f.metadata.get("sent") is not False]
    table = {name: plain(getattr(event, name)) for name in sent}
    if isinstance(event, CampaignOpened):
        table["run_directory"] = event.run_directory.name
    if isinstance(event, RequestStarted | RequestFinished) and isinstance(event.request, Suggest):
        table["request"] = {"type": "Suggest", "purpose": event.request.purpose}
    if isinstance(event, RequestFinished) and isinstance(event.outcome, Suggested):
        table["outcome"] = {"type": "Suggested", "points": plain(event.outcome.suggestion.points)}
    return {"type": type(event).__name__, **table}


def plain(value: Any) -> Any:
    """Convert any value to JSON types.

    Values without a JSON equivalent, such as NaN, become null; dataclasses are given a field with their type.
    """
    if value is None or isinstance(value, bool | int | str):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="python"))
    if dataclasses.is_dataclass(value):
        values = {f: getattr(value, f.name) for f in dataclasses.fields(value)}
        table = {f.name: plain(v) for f, v in values.items() if f.metadata != WRITTEN_IF_SET or v != f.default}
        return {"type": type(value).__name__, **table}
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)


def text(data: Any) -> str:
    """Return JSON on one line."""
    return json.dumps(data, ensure_ascii=False, separators=(",", ":"))


RING = 1_000
"""Number of events kept in memory."""

FLUSH = 0.25
"""Interval at which events are written to disk [s]; journals contain the important ones before that."""

LEAP = 10_000
"""Numbers skipped at each start, since the last ones before a crash may not have been written."""

_BATCH = 200

_SCHEMA = """
create table if not exists event (
    id integer primary key, t real not null, campaign text not null, type text not null, data text not null
) strict;
create index if not exists event_by_campaign on event (campaign, id);
create index if not exists event_by_type on event (type, id);
"""


@dataclass(frozen=True)
class SentEvent:
    """One event as it is sent.

    Attributes:
        id: larger than that of any earlier event.
        campaign: campaign of the event; '' if it concerns the daemon.
        type: name of its class in `orchestrator.records.events`, or the name of one of the daemon's own events.
        data: JSON on one line.
    """

    id: int
    t: float
    campaign: str
    type: str
    data: str


class Feed:
    """The sequence of events.

    Args:
        path: path of its SQLite file.
        keep: number of events kept there.
        broken: called if events can't be written.

    Limitations: a crash loses the events of the last quarter of a second from this file, though not from the journals.
    """

    def __init__(self, path: Path, keep: int = 50_000, broken: Callable[[str], None] = lambda text: None) -> None:
        self._keep, self._broken = keep, broken
        self._db: sqlite3.Connection | None = sqlite3.connect(path, isolation_level=None, timeout=5.0)
        self._db.execute("pragma journal_mode = wal")
        self._db.execute("pragma synchronous = normal")
        self._db.executescript(_SCHEMA)
        last = self._db.execute("select coalesce(max(id), 0) from event").fetchone()[0]
        self._next = int(last) + (LEAP if last else 1)
        self._ring: deque[SentEvent] = deque(maxlen=RING)
        self._unwritten: list[SentEvent] = []
        self._news = asyncio.Event()
        self.readers = 0

    @property
    def last(self) -> int:
        """Number of the newest event."""
        return self._next - 1

    def subscriber(self, campaign: str) -> Callable[[Event], None]:
        """Return a subscriber that adds a campaign's events to the feed."""

        def receive(event: Event) -> None:
            if event.internal:
                return
            data = event_json(event)
            self.publish(data.pop("type"), data, campaign, kept=not isinstance(event, PASSING), t=event.time)

        return receive

    def publish(
        self, kind: str, data: dict[str, Any], campaign: str = "", *, kept: bool = True, t: float = 0.0
    ) -> None:
        """Add an event."""
        t = t or time.time()
        number, self._next = self._next, self._next + 1
        body = {"type": kind, "campaign": campaign, **data, "time": t}
        sent = SentEvent(number, t, campaign, kind, text(body))
        self._ring.append(sent)
        if kept:
            self._unwritten.append(sent)
        news, self._news = self._news, asyncio.Event()
        news.set()

    async def flushing(self) -> None:
        """Write events to disk periodically, until cancelled."""
        while True:
            await asyncio.sleep(FLUSH)
            self.flush()

    def flush(self) -> None:
        """Write pending events and delete the oldest. Never raises: a failure here must not end the daemon."""
        if not self._unwritten or self._db is None:
            return
        batch, self._unwritten = self._unwritten, []
        try:
            self._db.execute("begin immediate")
            self._db.executemany(
                "insert into event values (?, ?, ?, ?, ?)", [(e.id, e.t, e.campaign, e.type, e.data) for e in batch]
            )
            self._db.execute(
                "delete from event where id <= (select id from event order by id desc limit 1 offset ?)", [self._keep]
            )
            self._db.execute("commit")
        except sqlite3.Error as error:
            if self._db.in_transaction:
                self._db.execute("rollback")
            self._broken(f"events can't be written down: {error}")

    def close(self) -> None:
        """Write pending events and end all readers."""
        self.flush()
        if self._db is not None:
            self._db.close()
            self._db = None
        self._news.set()

    async def read(
        self,
        after: int | None = None,
        campaign: str | None = None,
        kinds: Collection[str] = (),
        *,
        until: int | None = None,
        beat: float = 3600.0,
    ) -> AsyncIterator[SentEvent | None]:
        """Yield events after a number, and then new ones.

        Args:
            after: number of the last event seen; None: only new events.
            campaign: only events of this campaign.
            kinds: only events of these types; all by default.
            until: end with the event of this number, whether it is one of those or not.
            beat: yield None after so long without an event [s].
        """
        seen = self.last if after is None else min(after, self.last)
        self.readers += 1
        try:
            while self._db is not None and (until is None or seen < until):
                news = self._news
                batch, seen = self._after(seen, campaign, kinds)
                for sent in batch:
                    if until is None or sent.id <= until:
                        yield sent
                if not batch and seen >= self.last and seen != until:
                    try:
                        async with asyncio.timeout(beat):
                            await news.wait()
                    except TimeoutError:
                        yield None
        finally:
            self.readers -= 1

    def _after(self, seen: int, campaign: str | None, kinds: Collection[str]) -> tuple[list[SentEvent], int]:
        """Return the next matching events after a number, at most one batch, and the number that they reach to."""
        if self._ring and seen + 1 >= self._ring[0].id:
            # Numbers in the ring have no gaps.
            begin = seen + 1 - self._ring[0].id
            batch = [self._ring[i] for i in range(begin, min(begin + _BATCH, len(self._ring)))]
            matching = [e for e in batch if campaign in (None, e.campaign) and (not kinds or e.type in kinds)]
            return matching, batch[-1].id if batch else seen
        self.flush()
        if self._db is None:
            return [], seen
        end = self._ring[0].id if self._ring else self._next
        conditions = ["id > ?", "id < ?"]
        arguments: list[int | str] = [seen, end]
        if campaign is not None:
            conditions.append("campaign = ?")
            arguments.append(campaign)
        if kinds:
            conditions.append(f"type in ({', '.join('?' * len(kinds))})")
            arguments += kinds
        rows = self._db.execute(
            f"select id, t, campaign, type, data from event where {' and '.join(conditions)} order by id limit ?",
            [*arguments, _BATCH],
        )
        events = [SentEvent(*row) for row in rows]
        return events, events[-1].id if len(events) == _BATCH else end - 1
