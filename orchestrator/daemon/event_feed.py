"""Everything that happens, in order and numbered, for whoever watches: from now on, or from where they left off.

Readers wait for nothing that they have not asked for and keep nobody waiting: each has seen so much of the sequence and
takes from there what is still kept. One that is too slow is sent how much it has missed.

Events as typed JSON: every field of every event, but for particles and for what can be asked for elsewhere.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import sqlite3
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from orchestrator.requests import Suggest, Suggested
from orchestrator.runs.events import (
    CampaignOpened,
    Event,
    MadeAhead,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StrategyProgressed,
)

PASSING = (PourProgressed, StrategyProgressed, MadeAhead)
"""Events that say where something stands just now: the next one takes their place, so they are not kept on disk."""


def event_json(event: Event) -> dict[str, Any]:
    """The fields of an event, with the name of its class under 'type'.

    Recorded particles are left out (they are in the recording), a question to the optimiser has its purpose, its
    answer its points; what a strategy has learnt is in the event that closes its stage.
    """
    left_out = {"frames"}
    if isinstance(event, StrategyProgressed):
        left_out.add("result")
    table = {f.name: plain(getattr(event, f.name)) for f in dataclasses.fields(event) if f.name not in left_out}
    if isinstance(event, CampaignOpened):
        table["run_directory"] = event.run_directory.name
    if isinstance(event, RequestStarted | RequestFinished) and isinstance(event.request, Suggest):
        table["request"] = {"type": "Suggest", "purpose": event.request.purpose}
    if isinstance(event, RequestFinished) and isinstance(event.outcome, Suggested):
        table["outcome"] = {"type": "Suggested", "points": plain(event.outcome.suggestion.points)}
    return {"type": type(event).__name__, **table}


def plain(value: Any) -> Any:
    """JSON-ready, whatever it is: what has no word in JSON becomes null, what is a value of ours names its type."""
    if value is None or isinstance(value, bool | int | str):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="python"))
    if dataclasses.is_dataclass(value):
        table = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **table}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(one) for one in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)


def text(data: Any) -> str:
    """On one line."""
    return json.dumps(data, ensure_ascii=False, separators=(",", ":"))


RING = 1_000
"""Events kept in memory."""

FLUSH = 0.25
"""Between two times that events are written to the disk [s]; a journal has what matters before that."""

LEAP = 10_000
"""Numbers that are left out at each start, since the last ones before a crash may never have been written."""

_BATCH = 200

_SCHEMA = """
create table if not exists event (
    id integer primary key, t real not null, campaign text not null, type text not null, data text not null
) strict;
"""


@dataclass(frozen=True)
class SentEvent:
    """One event as it goes out.

    Attributes:
        id: larger than that of any event before it.
        campaign: that it belongs to; '' for what concerns the daemon.
        type: name of its class in `orchestrator.runs.events`, or a word for what the daemon itself says.
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
        path: of its file.
        keep: events that are kept there.
        broken: called once if they can't be written any more.

    Limitations: a crash loses what happened in the last quarter of a second from here, though not from the journals.
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

    def watcher(self, campaign: str) -> Callable[[Event], None]:
        """A watcher that tells of a campaign's events."""

        def watch(event: Event) -> None:
            data = event_json(event)
            self.tell(data.pop("type"), data, campaign, kept=not isinstance(event, PASSING), t=event.time)

        return watch

    def tell(self, kind: str, data: dict[str, Any], campaign: str = "", *, kept: bool = True, t: float = 0.0) -> None:
        """Something happened."""
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
        """Write events down every now and then, until cancelled."""
        while True:
            await asyncio.sleep(FLUSH)
            self.flush()

    def flush(self) -> None:
        """Write down what waits, and forget what is too old. Never raises: who watches is no reason to end."""
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
        """Write down what waits, and let everybody go who reads."""
        self.flush()
        if self._db is not None:
            self._db.close()
            self._db = None
        self._news.set()

    async def read(
        self, after: int | None = None, campaign: str | None = None, *, beat: float = 3600.0
    ) -> AsyncIterator[SentEvent | None]:
        """Events after a number, and then those that come.

        Args:
            after: the last one that was seen; None: only what comes from now on.
            campaign: only what belongs to it.
            beat: after so long without news [s] None comes instead.
        """
        seen = self.last if after is None else min(after, self.last)
        self.readers += 1
        try:
            while self._db is not None:
                news = self._news
                found = self._after(seen)
                for sent in found:
                    seen = sent.id
                    if campaign is None or sent.campaign == campaign:
                        yield sent
                if not found:
                    try:
                        async with asyncio.timeout(beat):
                            await news.wait()
                    except TimeoutError:
                        yield None
        finally:
            self.readers -= 1

    def _after(self, seen: int) -> list[SentEvent]:
        """The next few events behind a number."""
        if self._ring and seen + 1 >= self._ring[0].id:
            # Numbers in the ring have no gaps.
            begin = seen + 1 - self._ring[0].id
            return [self._ring[i] for i in range(begin, min(begin + _BATCH, len(self._ring)))]
        self.flush()
        if self._db is None:
            return []
        rows = self._db.execute(
            "select id, t, campaign, type, data from event where id > ? order by id limit ?", [seen, _BATCH]
        )
        found = [SentEvent(*row) for row in rows]
        return found or ([self._ring[0]] if self._ring else [])
