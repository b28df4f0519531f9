"""The write-ahead record of a run: one SQLite file, append-only, one writer, any number of readers.

Every entry is one row: sequence number, stage, time, kind, JSON body. Nothing is ever changed or deleted (triggers
refuse it). Entries written together (`append_all`) are there together or not at all, whenever the process dies. Pours
are flushed to the disk before the arm moves and before their outcome is used (synchronous=FULL), everything else
survives the death of the process, and a power cut but for its last moments. A full disk takes no pour's records away:
see `orchestrator.reserve`.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from orchestrator.codec import canonical, digest, first_difference
from orchestrator.journal_file import (
    FORMAT,
    Header,
    JournalError,
    connect,
    connect_writer,
    has_tables,
    lay_out,
    take_lock,
)
from orchestrator.reserve import MB, Reserve, free_space
from orchestrator.states import State

JOURNAL_NAME = "journal.sqlite"


class Kind(StrEnum):
    """What an entry says. The bodies' keys stand behind each."""

    CAMPAIGN_STATE = "campaign.state"  # before, after, reason, pid
    STAGE_OPENED = "stage.opened"  # seed
    STAGE_CLOSED = "stage.closed"  # result
    ASKED = "asked"  # simulations, pours (the free slots), ids (of the requests it brought)
    REQUESTED = "requested"  # id, request
    STARTED = "started"  # id
    FINISHED = "finished"  # id, outcome, seconds
    POUR_STARTED = "pour.started"  # id, attempt
    POUR_WITHDRAWN = "pour.withdrawn"  # id, reason: nothing was poured, it may be poured later
    POUR_FINISHED = "pour.finished"  # id, outcome, seconds
    TOLD = "told"  # id
    DECISION = "decision"  # text, values
    OPERATOR_ASKED = "operator.asked"  # id, question, options
    OPERATOR_ANSWERED = "operator.answered"  # id, answer
    NOTE = "note"  # text


_DURABLE = frozenset({Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED, Kind.OPERATOR_ANSWERED})


@dataclass(frozen=True)
class Entry:
    """One row."""

    seq: int
    stage: str
    t: float
    kind: str
    body: dict[str, Any]


@dataclass(frozen=True)
class Draft:
    """An entry that is still to be written."""

    kind: Kind
    body: dict[str, Any]
    stage: str = ""


class JournalReader:
    """Reads a journal, also while a run is writing it."""

    def __init__(self, path: Path) -> None:
        """Open for reading.

        Raises:
            JournalError: there is no journal at that path, or it is not one of ours.
        """
        self.path = path
        if not path.is_file():
            raise JournalError(f"{path}: there is no journal here; has the run been started?")
        self._connection = connect(f"{path.absolute().as_uri()}?mode=ro")
        try:
            self.header = self._read_header()
        except BaseException:
            self._connection.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Give the file back. May be called twice."""
        self._connection.close()

    def entries(
        self, *, after: int = 0, stage: str | None = None, kinds: Iterable[Kind] | None = None
    ) -> Iterator[Entry]:
        """Entries in the order in which they were written.

        Args:
            after: only those with a larger sequence number.
            stage: only those of one stage.
            kinds: only those of some kinds.
        """
        query = "select seq, stage, t, kind, body from event where seq > ?"
        arguments: list[Any] = [after]
        if stage is not None:
            query += " and stage = ?"
            arguments.append(stage)
        if kinds is not None:
            names = [str(kind) for kind in kinds]
            query += f" and kind in ({', '.join('?' * len(names))})"
            arguments += names
        for row in self._connection.execute(query + " order by seq", arguments):
            yield Entry(row[0], row[1], row[2], row[3], json.loads(row[4]))

    def state(self) -> State:
        """The campaign's last written state."""
        last = State.QUEUED
        for entry in self.entries(kinds=[Kind.CAMPAIGN_STATE]):
            last = State(entry.body["after"])
        return last

    def stage_results(self) -> dict[str, dict[str, Any]]:
        """Results of the closed stages by name, in the order in which they were closed; see `orchestrator.results`."""
        return {entry.stage: entry.body["result"] for entry in self.entries(kinds=[Kind.STAGE_CLOSED])}

    def last_id(self) -> int:
        """The largest request id in use; 0 before the first request."""
        found = self._connection.execute(
            "select max(json_extract(body, '$.id')) from event where kind = ?", [str(Kind.REQUESTED)]
        ).fetchone()
        return int(found[0] or 0)

    def _read_header(self) -> Header:
        try:
            row = self._connection.execute("select format, name, fingerprint, created from header").fetchone()
        except sqlite3.DatabaseError as error:
            raise JournalError(f"{self.path}: not a journal of Decant ({error})") from error
        if row is None:
            raise JournalError(f"{self.path}: the journal has no header; it is damaged")
        if row[0] != FORMAT:
            raise JournalError(
                f"{self.path}: written in format {row[0]}, this version of Decant reads format {FORMAT}; "
                "go on with the version that began the run (see versions.json beside it) or begin a new run"
            )
        return Header(row[1], json.loads(row[2]), row[3])


class Journal(JournalReader):
    """The one writer of a journal. Made by `Journal.create` and `Journal.resume`."""

    def __init__(self, path: Path, lock: IO[str], connection: sqlite3.Connection) -> None:
        self.path = path
        self._lock = lock
        self._connection = connection
        self._durable = False
        self._reserve = Reserve(path.with_suffix(".reserve"))
        self.header = self._read_header()

    @classmethod
    def create(cls, path: Path, header: Header) -> Journal:
        """Begin a new journal.

        Raises:
            JournalLockedError: another process is writing it.
            JournalError: it holds a run already, or can't be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as opened:
            lock = opened.enter_context(take_lock(path))
            connection = opened.enter_context(closing(connect_writer(path)))
            if has_tables(connection, path):
                raise JournalError(f"{path}: holds a run already; resume that one, or begin in another directory")
            lay_out(connection, header, path)
            journal = cls(path, lock, connection)
            opened.pop_all()
            return journal

    @classmethod
    def resume(cls, path: Path, header: Header) -> Journal:
        """Go on with a journal. One whose process died before it had written anything is begun anew.

        Raises:
            JournalLockedError: another process is writing it.
            JournalError: there is none, it has another format, or it belongs to another campaign.
        """
        if not path.is_file():
            raise JournalError(f"{path}: there is no journal to resume; begin the campaign without --resume")
        with contextlib.ExitStack() as opened:
            lock = opened.enter_context(take_lock(path))
            connection = opened.enter_context(closing(connect_writer(path)))
            if not has_tables(connection, path):
                lay_out(connection, header, path)
            journal = cls(path, lock, connection)
            journal._check_same_campaign(header)
            opened.pop_all()
            return journal

    def reserve_space(self) -> None:
        """Hold room on the disk for a pour's records, until the journal is closed.

        Raises:
            NoSpaceError: there isn't enough.
        """
        self._reserve.take()

    def check_space_for_pour(self) -> None:
        """See that whatever comes of a pour can be written down.

        Raises:
            NoSpaceError: it can't; the pour must not begin.
        """
        self._reserve.check_pour()

    def append(self, kind: Kind, body: dict[str, Any], *, stage: str = "") -> None:
        """Write one entry; it is in the file when this returns."""
        self.append_all([Draft(kind, body, stage)])

    def append_all(self, drafts: Sequence[Draft]) -> None:
        """Write several entries in one transaction: all or none. On a full disk the reserve makes room.

        Raises:
            JournalError: the file can't be written.
        """
        durable = any(draft.kind in _DURABLE for draft in drafts)
        if durable != self._durable:
            self._connection.execute(f"pragma synchronous = {'full' if durable else 'normal'}")
            self._durable = durable
        now = time.time()
        rows = [(draft.stage, now, str(draft.kind), canonical(draft.body)) for draft in drafts]
        try:
            try:
                self._insert(rows)
            except sqlite3.OperationalError:
                if not self._reserve.release():
                    raise
                self._insert(rows)
        except sqlite3.OperationalError as error:
            raise JournalError(
                f"{self.path}: can't be written ({error}; {free_space(self.path) / MB:.1f} MB are free on its disk); "
                "what is in it is safe. Mend that and resume the run"
            ) from error

    def _insert(self, rows: Sequence[tuple[str, float, str, str]]) -> None:
        try:
            self._connection.execute("begin immediate")
            self._connection.executemany("insert into event (stage, t, kind, body) values (?, ?, ?, ?)", rows)
            self._connection.execute("commit")
        except BaseException:
            if self._connection.in_transaction:  # SQLite itself rolls back where the disk is full
                self._connection.execute("rollback")
            raise

    def close(self) -> None:
        """Give file, lock and reserve back. May be called twice."""
        self._reserve.release()
        self._connection.close()
        self._lock.close()

    def _check_same_campaign(self, header: Header) -> None:
        if digest(self.header.fingerprint) == digest(header.fingerprint):
            return
        difference = first_difference(self.header.fingerprint, header.fingerprint)
        raise JournalError(
            f"{self.path}: this run was begun with other settings, and its next steps depend on them: {difference}. "
            "Set that back to resume it, or begin a new run"
        )
