"""What the daemon remembers: queue, questions, flags, and who did what. One SQLite file, one writer, flushed to disk.

A run's own journal stays the truth about what happened in it. Here stands what people want of it.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from orchestrator.catalogue.run_registry import make_state_directory
from orchestrator.journal.journal_file import locked_alone
from orchestrator.run_errors import RunError

FORMAT = 1

_SCHEMA = """
create table campaign (
    id text primary key, name text not null, verb text not null, rig text not null, mode text not null,
    priority integer not null, rank real not null, state text not null, wish text not null, reason text not null,
    by text not null, created real not null, begun real, ended real, run text, armed integer not null,
    answers text not null check (json_valid(answers))
) strict;
create index campaign_by_state on campaign (state, rig);
create table question (
    id integer primary key, campaign text not null, rig text not null, kind text not null, about text not null,
    text text not null, problem text not null, wants text not null, options text not null check (json_valid(options)),
    details text not null check (json_valid(details)), hands integer not null, asked real not null,
    answer text, by text, answered real, closed text
) strict;
create index question_open on question (closed, answered);
create table flag (name text primary key, value text not null check (json_valid(value))) strict;
create table deed (
    id integer primary key, t real not null, by text not null, what text not null, campaign text not null,
    detail text not null
) strict;
create trigger deed_is_never_changed before update on deed begin select raise(abort, 'deeds are append-only'); end;
create trigger deed_is_never_deleted before delete on deed begin select raise(abort, 'deeds are append-only'); end;
"""


class StoreError(RunError):
    """The state directory can't be used; the text says why and what to do."""


class DesiredState(StrEnum):
    """What people want of a campaign: kept apart from what it does, so that a crash forgets neither."""

    RUN = "run"
    PAUSE = "pause"
    STOP = "stop"
    ABORT = "abort"


STOPPED, WITHDRAWN = "stopped", "withdrawn"
"""States of a campaign beside those of its run: ended by people, with and without having begun."""

AT_REST = ("queued", "paused", "unknown", "failed", "finished", STOPPED, WITHDRAWN)
"""In which a campaign may be left: any other, found at the start, means that the daemon died."""

ENDED = ("finished", STOPPED, WITHDRAWN)
"""From which nothing goes on."""


@dataclass(frozen=True)
class QueueItem:
    """One submitted campaign.

    Attributes:
        id: unique, for people to type.
        verb: 'run', 'calibrate' or 'plan'.
        rig: that it leases; 'desk' where it pours nothing.
        mode: of that rig: 'virtual', 'hardware' or 'none'.
        priority: higher ones come first.
        rank: among those of one priority, the smallest first.
        state: of the run (`orchestrator.states`), or 'stopped', 'withdrawn'.
        wish: what people want.
        reason: of the state, in words.
        by: who submitted it.
        run: name of its run's folder, once it has begun.
        armed: whether hardware may move in the coming part of its run.
    """

    id: str
    name: str
    verb: str
    rig: str
    mode: str
    priority: int
    rank: float
    state: str
    wish: str
    reason: str
    by: str
    created: float
    begun: float | None = None
    ended: float | None = None
    run: str | None = None
    armed: bool = False
    answers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StoredQuestion:
    """Something that a person is asked.

    Attributes:
        kind: 'bench' (a step at the arm), 'unknown' (a pour without outcome), 'strategy' (a decision).
        wants: 'done', 'weight', 'yes or no', or 'option'.
        options: where it wants one of them.
        hands: whether it invites hands into the cell.
        closed: why it needs no answer any more; None while it is open.
    """

    id: int
    campaign: str
    rig: str
    kind: str
    about: str
    text: str
    problem: str
    wants: str
    options: tuple[str, ...]
    details: dict[str, Any]
    hands: bool
    asked: float
    answer: str | None = None
    by: str | None = None
    answered: float | None = None
    closed: str | None = None

    @property
    def open(self) -> bool:
        """Whether an answer is waited for."""
        return self.closed is None


_JSON = {"answers", "options", "details"}
_BOOLEAN = {"armed", "hands"}


class Store:
    """The one writer.

    Args:
        path: of the file.

    Raises:
        StoreError: another daemon has it, it is of another version, or can't be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        make_state_directory(path.parent)
        self._lock = path.with_suffix(".lock").open("a+", encoding="utf-8")
        try:
            alone = locked_alone(self._lock)
        except OSError as error:
            self._lock.close()
            raise StoreError(f"{error.filename}: {error.strerror}; --state names the folder") from None
        if not alone:
            self._lock.seek(0)
            owner = self._lock.read().strip() or "unknown"
            self._lock.close()
            raise StoreError(
                f"{path.parent}: another daemon (process {owner}) has this state directory; 'decant shutdown' ends it, "
                "--state names another one"
            )
        self._lock.truncate(0)
        self._lock.write(str(os.getpid()))
        self._lock.flush()
        try:
            self._open()
        except sqlite3.OperationalError as error:  # the disk, the folder or their permissions, not the content
            self._lock.close()
            raise StoreError(f"{path}: can't be opened for writing ({error}); --state names another folder") from error
        except sqlite3.DatabaseError as error:
            self._lock.close()
            raise StoreError(f"{path}: not the daemon's memory, or damaged ({error})") from error

    def _open(self) -> None:
        self._db = sqlite3.connect(self.path, isolation_level=None, timeout=10.0)
        self._db.row_factory = sqlite3.Row
        self._db.execute("pragma journal_mode = wal")
        self._db.execute("pragma synchronous = full")
        version = self._db.execute("pragma user_version").fetchone()[0]
        if version == 0:
            self._db.executescript(f"begin immediate; {_SCHEMA} pragma user_version = {FORMAT}; commit;")
        elif version != FORMAT:
            raise StoreError(f"{self.path}: written in format {version}, and this version of Decant has {FORMAT}")

    def close(self) -> None:
        """Give the file back. May be called twice."""
        self._db.close()
        self._lock.close()

    # ---- campaigns

    def add(self, item: QueueItem) -> None:
        """A campaign that was submitted."""
        values = {f.name: _written(f.name, getattr(item, f.name)) for f in fields(QueueItem)}
        names = ", ".join(values)
        self._write(f"insert into campaign ({names}) values ({', '.join('?' * len(values))})", *values.values())

    def change(self, key: str, **values: Any) -> None:
        """Set some fields of a campaign, together."""
        names = ", ".join(f"{name} = ?" for name in values)
        self._write(f"update campaign set {names} where id = ?", *(_written(n, v) for n, v in values.items()), key)

    def item(self, key: str) -> QueueItem | None:
        """A campaign; None: there is no such one."""
        row = self._db.execute("select * from campaign where id = ?", [key]).fetchone()
        return None if row is None else _item(row)

    def items(self, states: Iterable[str] = (), limit: int = 1000) -> list[QueueItem]:
        """Campaigns: what runs first, then the queue in its order, then the others, the newest first.

        Args:
            states: only those in one of them; all unless given.
            limit: at most so many.
        """
        wanted = tuple(states)
        where = f"where state in ({', '.join('?' * len(wanted))})" if wanted else ""
        rows = self._db.execute(
            f"select * from campaign {where} order by "
            f"case when state = 'queued' then 1 when state in ({_quoted(AT_REST)}) then 2 else 0 end, "
            "case when state = 'queued' then -priority else 0 end, case when state = 'queued' then rank else 0 end, "
            "created desc limit ?",
            [*wanted, limit],
        )
        return [_item(row) for row in rows]

    def last_rank(self) -> float:
        """The largest rank so far; 0 before the first campaign."""
        return float(self._db.execute("select coalesce(max(rank), 0) from campaign").fetchone()[0])

    def counts(self) -> dict[str, int]:
        """How many campaigns there are in each state."""
        return dict(self._db.execute("select state, count(*) from campaign group by state").fetchall())

    # ---- questions

    def ask(self, **values: Any) -> StoredQuestion:
        """Write a question down; it is open from now on."""
        values["asked"] = time.time()
        names = ", ".join(values)
        written = [_written(n, v) for n, v in values.items()]
        key = self._write(f"insert into question ({names}) values ({', '.join('?' * len(values))})", *written)
        found = self.question(key)
        assert found is not None
        return found

    def answer(self, key: int, answer: str, by: str) -> None:
        """Write an answer down, before anything follows from it."""
        self._write(
            "update question set answer = ?, by = ?, answered = ?, closed = 'answered' where id = ? and closed is null",
            *(answer, by, time.time(), key),
        )

    def close_question(self, key: int, reason: str) -> None:
        """Nobody needs the answer any more."""
        self._write("update question set closed = ? where id = ? and closed is null", reason, key)

    def question(self, key: int) -> StoredQuestion | None:
        """A question; None: there is no such one."""
        row = self._db.execute("select * from question where id = ?", [key]).fetchone()
        return None if row is None else _question(row)

    def questions(
        self, *, only_open: bool = True, campaign: str | None = None, limit: int = 200
    ) -> list[StoredQuestion]:
        """Questions, the oldest open one first, or all of them, the newest first."""
        conditions = ["closed is null"] if only_open else ["1"]
        arguments: list[Any] = []
        if campaign is not None:
            conditions.append("campaign = ?")
            arguments.append(campaign)
        order = "id" if only_open else "id desc"
        query = f"select * from question where {' and '.join(conditions)} order by {order} limit ?"
        return [_question(row) for row in self._db.execute(query, [*arguments, limit])]

    # ---- flags and deeds

    def flag(self, name: str) -> Any:
        """A value that outlives the daemon; None where it was never set."""
        row = self._db.execute("select value from flag where name = ?", [name]).fetchone()
        return None if row is None else json.loads(row[0])

    def set_flag(self, name: str, value: Any) -> None:
        """Set it; None takes it away."""
        if value is None:
            self._write("delete from flag where name = ?", name)
        else:
            self._write("insert into flag values (?, ?) on conflict do update set value = excluded.value",
                        name, json.dumps(value))  # fmt: skip

    def note(self, by: str, what: str, campaign: str = "", detail: str = "") -> None:
        """Write down who did what."""
        self._write("insert into deed (t, by, what, campaign, detail) values (?, ?, ?, ?, ?)",
                    time.time(), by, what, campaign, detail)  # fmt: skip

    def deeds(self, campaign: str | None = None, limit: int = 200) -> list[dict[str, Any]]:
        """Who did what, the newest first."""
        where, arguments = ("", []) if campaign is None else ("where campaign = ?", [campaign])
        query = f"select t, by, what, campaign, detail from deed {where} order by id desc limit ?"
        return [dict(row) for row in self._db.execute(query, [*arguments, limit])]

    def _write(self, statement: str, *arguments: Any) -> int:
        try:
            return int(self._db.execute(statement, arguments).lastrowid or 0)
        except sqlite3.OperationalError as error:
            raise StoreError(f"{self.path}: can't be written ({error}); what is in it is safe") from error


def _written(name: str, value: Any) -> Any:
    if name in _JSON:
        return json.dumps(value, ensure_ascii=False)
    return int(value) if name in _BOOLEAN else value


def _read(row: sqlite3.Row) -> dict[str, Any]:
    values: Mapping[str, Any] = dict(row)
    return {
        name: json.loads(value) if name in _JSON else bool(value) if name in _BOOLEAN else value
        for name, value in values.items()
    }


def _item(row: sqlite3.Row) -> QueueItem:
    return QueueItem(**_read(row))


def _question(row: sqlite3.Row) -> StoredQuestion:
    values = _read(row)
    return StoredQuestion(**values | {"options": tuple(values["options"])})


def _quoted(words: Iterable[str]) -> str:
    return ", ".join(f"'{word}'" for word in words)
