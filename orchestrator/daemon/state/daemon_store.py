"""Persistent state of the daemon: queue, questions, flags and audit entries.

`Store` is the only writer of one SQLite file and flushes every change to disk. `QueueItem` is a submitted campaign with
its desired state (`DesiredState`); `QuestionOut` is a question to the operator. The journal of a run remains the
authoritative record of its events; this file holds the operators' intentions. The tables of ordered pours and of
materials are read and written by `pour_orders` and `materials`; the contents of vessels are a file of their own.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, computed_field

from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal_file import locked_alone
from orchestrator.records.run_registry import make_state_directory

FORMAT = 7

_UPGRADES = {
    5: "alter table campaign add column verdict text check (verdict is null or json_valid(verdict));"
    "alter table campaign add column after text;",
    6: "alter table vessel rename column position to former_position;",
}
"""Format → statements that convert it to the next one."""

_SCHEMA = """
create table campaign (
    id text primary key, name text not null, task text not null, rig text not null, mode text not null,
    priority integer not null, rank real not null, state text not null, desired_state text not null,
    reason text not null,
    by text not null, created real not null, begun real, ended real, run text, motion_enabled integer not null,
    answers text not null check (json_valid(answers)),
    caller_id text not null default '', body_hash text not null default '', not_before real,
    verdict text check (verdict is null or json_valid(verdict)), after text check (after is null or json_valid(after))
) strict;
create unique index campaign_by_caller_id on campaign (caller_id) where caller_id != '';
create index campaign_by_state on campaign (state, rig);
create table question (
    id integer primary key, campaign text not null, rig text not null, kind text not null, about text not null,
    text text not null, problem text not null, wants text not null, options text not null check (json_valid(options)),
    details text not null check (json_valid(details)), hands integer not null, asked real not null,
    answer text, by text, answered real, closed text
) strict;
create index question_open on question (closed, answered);
create table flag (name text primary key, value text not null check (json_valid(value))) strict;
create table audit (
    id integer primary key, t real not null, by text not null, what text not null, campaign text not null,
    detail text not null
) strict;
create trigger audit_is_never_changed before update on audit begin
    select raise(abort, 'audit entries are append-only'); end;
create trigger audit_is_never_deleted before delete on audit begin
    select raise(abort, 'audit entries are append-only'); end;
"""

_STATION = """
create table pour_order (
    id text primary key, campaign text not null unique, body text not null check (json_valid(body)),
    source text not null, receiver text not null, amount real,
    predicted text check (predicted is null or json_valid(predicted)),
    result text check (result is null or json_valid(result))
) strict;
create index order_by_source on pour_order (source);
create table liquid (
    id text primary key, code text unique, properties text not null check (json_valid(properties)),
    created real not null
) strict;
create table position (
    id text primary key, code text unique, rig text not null, note text not null, created real not null
) strict;
create table vessel (
    id text primary key, code text unique, shape text not null check (json_valid(shape)), capacity real not null,
    former_position text unique, liquid text, created real not null
) strict;
create table node_action (
    id text primary key, name text not null, args text not null check (json_valid(args)), created real not null,
    started real, error text, json_result text
) strict;
"""
"""Ordered pours and materials. Masses in kg, capacities in m³. Where vessels stand is in their account; a
`former_position` is what formats up to 6 had of it, until the daemon has entered it there."""


class StoreError(RunError):
    """The state directory can't be used; the message gives the reason and a remedy."""


class StoreFormatError(StoreError):
    """The state directory has the format of another version."""

    exit_code = 2


class DesiredState(StrEnum):
    """The state that operators want a campaign to be in.

    It is stored separately from the current state, so that a crash loses neither.
    """

    RUN = "run"
    PAUSE = "pause"
    STOP = "stop"
    ABORT = "abort"


PAUSED = "paused"
"""Flag: the queue is paused."""

STOPPED, WITHDRAWN = "stopped", "withdrawn"
"""States of a campaign in addition to those of its run: ended by an operator, after or before its run started."""

CHECKING, REFUSED = "checking", "refused"
"""States of a campaign before it is queued: its check runs, or has ended with an error that the reason has."""

AT_REST = ("queued", "paused", "unknown", "failed", "finished", STOPPED, WITHDRAWN, REFUSED)
"""States in which a campaign may rest; any other state found at the start means that the daemon crashed."""

ENDED = ("finished", STOPPED, WITHDRAWN, REFUSED)
"""Final states."""


# Some 20 fields: a flat JSON object that programs read.
class CampaignFields(BaseModel):
    """A submitted campaign, as far as the store and the API have the same of it."""

    model_config = ConfigDict(
        frozen=True, use_attribute_docstrings=True, json_schema_serialization_defaults_required=True
    )

    id: str
    """Unique and short enough to type."""

    name: str
    task: str
    """'run', 'calibrate', 'plan', or 'pour' for an ordered pour."""

    rig: str = ""
    """Rig that it leases; 'none' if it pours nothing."""

    mode: str = "none"
    """'virtual', 'hardware', or 'none' if nothing is poured."""

    priority: int
    """Higher priorities run first."""

    state: str = CHECKING
    """One of: checking, refused, queued, preparing, running, pausing, paused, waiting for operator, stopping, finished,
    failed, unknown, stopped, withdrawn.
    """

    desired_state: str = DesiredState.RUN.value
    """run, pause, stop or abort."""

    reason: str = ""
    """Reason of the state, for the operator."""

    by: str
    """User who submitted it."""

    created: float = 0.0
    begun: float | None = None
    ended: float | None = None
    run: str | None = None
    """Name of its run's folder; null before the run starts."""

    motion_enabled: bool = False
    """Whether motion is enabled for the coming part of its run."""

    caller_id: str = ""
    """Id that its caller chose; '' without one."""

    not_before: float | None = None
    """Earliest start."""


class QueueItem(CampaignFields):
    """A campaign in the store.

    Attributes:
        rank: order within one priority, smallest first.
        answers: of operators to questions that its run asks when it continues.
        body_hash: digest of its caller's request, by which a repeated one is recognised.
        verdict: `orchestrator.records.verdict.Verdict` of its run as it came to rest, JSON-ready; None while it runs,
            and without a run that can be read.
        after: id of the campaign that has to end before it, and the verdict that this needs: `campaign`, `verdict`.
    """

    rank: float = 0.0
    answers: dict[str, Any] = Field(default_factory=dict)
    body_hash: str = ""
    verdict: dict[str, Any] | None = None
    after: dict[str, str] | None = None


def is_complete(verdict: Mapping[str, Any] | None) -> bool:
    """Whether a campaign's verdict says that it reached all that was wanted."""
    return verdict is not None and verdict["word"] == "complete"


def verdict_text(verdict: Mapping[str, Any] | None) -> str:
    """The verdict in a line, also if there is none."""
    return "its records can't be read, so that its verdict is unknown" if verdict is None else str(verdict["text"])


class QuestionOut(BaseModel):
    """A question to the operator."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    id: int
    campaign: str
    rig: str
    kind: str
    """'bench': a step at the arm; 'unknown': a pour with unknown outcome; 'strategy': a decision."""

    about: str
    text: str
    problem: str
    """Why the question is repeated; '' the first time."""

    wants: str
    """Kind of answer: 'done', 'weight', 'yes or no', or 'option'."""

    options: list[str]
    details: dict[str, Any]
    hands: bool
    """Whether the step requires hands in the cell."""

    asked: float
    answer: str | None
    by: str | None
    answered: float | None
    closed: str | None
    """Why it needs no answer any more; null while it is open."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def open(self) -> bool:
        """Whether the question waits for an answer."""
        return self.closed is None


_JSON = {"answers", "options", "details", "after", "verdict"}
_BOOLEAN = {"motion_enabled", "hands"}


class Store:
    """The store of one daemon; the only writer of its file.

    Args:
        path: path of the SQLite file.

    Raises:
        StoreError: another daemon uses the file, another version wrote it, or it can't be written.
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
                f"{path.parent}: another daemon (process {owner}) has this state directory; 'decant server stop' ends "
                "it, --state names another one"
            )
        self._lock.truncate(0)
        self._lock.write(str(os.getpid()))
        self._lock.flush()
        try:
            with ExitStack() as failed:
                failed.callback(self._lock.close)
                self._db = sqlite3.connect(path, isolation_level=None, timeout=10.0)
                failed.callback(self._db.close)
                self._prepare()
                failed.pop_all()
        except sqlite3.OperationalError as error:  # the disk, the folder or their permissions, rather than the content
            raise StoreError(f"{path}: can't be opened for writing ({error}); --state names another folder") from error
        except sqlite3.DatabaseError as error:
            raise StoreError(f"{path}: not the daemon's memory, or damaged ({error})") from error

    def _prepare(self) -> None:
        version = self._db.execute("pragma user_version").fetchone()[0]
        if version not in (0, FORMAT, *_UPGRADES):
            raise StoreFormatError(
                f"{self.path}: written in format {version}, this version of Decant reads formats {min(_UPGRADES)} to "
                f"{FORMAT}; use the version that wrote it, or name another folder with --state"
            )
        self._db.row_factory = sqlite3.Row
        self._db.execute("pragma journal_mode = wal")
        self._db.execute("pragma synchronous = full")
        if version == 0:
            self._db.executescript(f"begin immediate; {_SCHEMA} {_STATION} pragma user_version = {FORMAT}; commit;")
        while (version := self._db.execute("pragma user_version").fetchone()[0]) != FORMAT:
            self._db.executescript(
                f"begin immediate; {_UPGRADES[version]} pragma user_version = {version + 1}; commit;"
            )

    def close(self) -> None:
        """Close the file and release the lock. May be called twice."""
        self._db.close()
        self._lock.close()

    # ---- campaigns

    def add(self, item: QueueItem) -> None:
        """Add a submitted campaign."""
        values = {name: _written(name, getattr(item, name)) for name in QueueItem.model_fields}
        names = ", ".join(values)
        self.write(f"insert into campaign ({names}) values ({', '.join('?' * len(values))})", *values.values())

    def change(self, key: str, **values: Any) -> None:
        """Set fields of a campaign in one transaction."""
        names = ", ".join(f"{name} = ?" for name in values)
        self.write(f"update campaign set {names} where id = ?", *(_written(n, v) for n, v in values.items()), key)

    def item(self, key: str) -> QueueItem | None:
        """Return a campaign, or None if the id is unknown."""
        row = self._db.execute("select * from campaign where id = ?", [key]).fetchone()
        return None if row is None else _item(row)

    def items(self, states: Iterable[str] = (), limit: int = 1000) -> list[QueueItem]:
        """Return campaigns: running ones, then the queue in its order, then the others, newest first.

        Args:
            states: only campaigns in these states; all by default.
            limit: largest number of campaigns.
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

    def active(self) -> list[QueueItem]:
        """Return the campaigns that are in no state of rest, and not being checked."""
        states = _quoted((*AT_REST, CHECKING))
        return [_item(row) for row in self._db.execute(f"select * from campaign where state not in ({states})")]

    def wanted(self, rig: str) -> list[QueueItem]:
        """Return the campaigns of a rig that rest, have not ended and should run: the queue in its order first."""
        rows = self._db.execute(
            f"select * from campaign where state in ({_quoted(AT_REST)}) and state not in ({_quoted(ENDED)}) and "
            "rig = ? and desired_state = ? order by case when state = 'queued' then 0 else 1 end, "
            "priority desc, rank",
            [rig, str(DesiredState.RUN)],
        )
        return [_item(row) for row in rows]

    def by_caller_id(self, caller_id: str) -> QueueItem | None:
        """Return the campaign with an id of its caller, or None."""
        row = self._db.execute("select * from campaign where caller_id = ? and caller_id != ''", [caller_id]).fetchone()
        return None if row is None else _item(row)

    def followers(self, key: str) -> list[str]:
        """Return the ids of the campaigns that wait for the end of one, in the order of the queue."""
        states = _quoted((*ENDED, "failed"))
        rows = self.rows(
            f"select id from campaign where json_extract(after, '$.campaign') = ? and run is null and "
            f"state not in ({states}) order by priority desc, rank",
            key,
        )
        return [row["id"] for row in rows]

    def counts(self) -> dict[str, int]:
        """Return the number of campaigns in each state."""
        return dict(self._db.execute("select state, count(*) from campaign group by state").fetchall())

    def coming(self, rig: str, now: float) -> list[float]:
        """Return the later times at which queued campaigns of a rig may start."""
        rows = self.rows(
            "select not_before as at from campaign where state = 'queued' and rig = ? and not_before > ?", rig, now
        )
        return [float(row["at"]) for row in rows]

    # ---- questions

    def ask(self, **values: Any) -> QuestionOut:
        """Store an open question."""
        values["asked"] = time.time()
        names = ", ".join(values)
        written = [_written(n, v) for n, v in values.items()]
        key = self.write(f"insert into question ({names}) values ({', '.join('?' * len(values))})", *written)
        question = self.question(key)
        assert question is not None
        return question

    def answer(self, key: int, answer: str, by: str) -> None:
        """Store an answer, before anything acts on it."""
        self.write(
            "update question set answer = ?, by = ?, answered = ?, closed = 'answered' where id = ? and closed is null",
            *(answer, by, time.time(), key),
        )

    def close_question(self, key: int, reason: str) -> None:
        """Close a question that needs no answer any more."""
        self.write("update question set closed = ? where id = ? and closed is null", reason, key)

    def question(self, key: int) -> QuestionOut | None:
        """Return a question, or None if the id is unknown."""
        row = self._db.execute("select * from question where id = ?", [key]).fetchone()
        return None if row is None else QuestionOut(**_read(row))

    def questions(self, *, only_open: bool = True, campaign: str | None = None, limit: int = 200) -> list[QuestionOut]:
        """Return open questions, oldest first, or all questions, newest first."""
        conditions = ["closed is null"] if only_open else ["1"]
        arguments: list[Any] = []
        if campaign is not None:
            conditions.append("campaign = ?")
            arguments.append(campaign)
        order = "id" if only_open else "id desc"
        query = f"select * from question where {' and '.join(conditions)} order by {order} limit ?"
        return [QuestionOut(**_read(row)) for row in self._db.execute(query, [*arguments, limit])]

    # ---- flags and audit entries

    def flag(self, name: str) -> Any:
        """Return a value that persists across restarts, or None if it is not set."""
        row = self._db.execute("select value from flag where name = ?", [name]).fetchone()
        return None if row is None else json.loads(row[0])

    def set_flag(self, name: str, value: Any) -> None:
        """Set a flag; None removes it."""
        if value is None:
            self.write("delete from flag where name = ?", name)
        else:
            self.write("insert into flag values (?, ?) on conflict do update set value = excluded.value",
                        name, json.dumps(value))  # fmt: skip

    def note(self, by: str, what: str, campaign: str = "", detail: str = "") -> None:
        """Append an audit entry: who did what."""
        self.write("insert into audit (t, by, what, campaign, detail) values (?, ?, ?, ?, ?)",
                    time.time(), by, what, campaign, detail)  # fmt: skip

    def audit(self, campaign: str | None = None, limit: int = 200) -> list[dict[str, Any]]:
        """Return the audit entries, newest first."""
        where, arguments = ("", []) if campaign is None else ("where campaign = ?", [campaign])
        query = f"select t, by, what, campaign, detail from audit {where} order by id desc limit ?"
        return [dict(row) for row in self._db.execute(query, [*arguments, limit])]

    # ---- for the modules that have tables of their own here

    @contextmanager
    def together(self) -> Iterator[None]:
        """Store all changes made inside, or none of them. Must not be nested, and must not be left open by `await`."""
        self.write("begin immediate")
        try:
            yield
            self.write("commit")
        except BaseException:
            if self._db.in_transaction:
                self._db.execute("rollback")
            raise

    def rows(self, query: str, *arguments: Any) -> list[dict[str, Any]]:
        """Return the rows of a query."""
        return [dict(row) for row in self._db.execute(query, arguments)]

    def write(self, statement: str, *arguments: Any) -> int:
        """Execute a statement and return the id of the inserted row, if any.

        Raises:
            StoreError: the disk is full or can't be written.
            sqlite3.IntegrityError: a constraint is violated.
        """
        try:
            return int(self._db.execute(statement, arguments).lastrowid or 0)
        except sqlite3.OperationalError as error:
            raise StoreError(f"{self.path}: can't be written ({error}); what is in it is safe") from error


def _written(name: str, value: Any) -> Any:
    if name in _JSON and value is not None:
        return json.dumps(value, ensure_ascii=False)
    return int(value) if name in _BOOLEAN else value


def _read(row: sqlite3.Row) -> dict[str, Any]:
    values: Mapping[str, Any] = dict(row)
    return {
        name: json.loads(value) if name in _JSON and value is not None else bool(value) if name in _BOOLEAN else value
        for name, value in values.items()
    }


def _item(row: sqlite3.Row) -> QueueItem:
    return QueueItem(**_read(row))


def _quoted(words: Iterable[str]) -> str:
    return ", ".join(f"'{word}'" for word in words)
