"""The write-ahead record of a run: one SQLite file, append-only, with one writer and any number of readers.

Each `Entry` is one row: sequence number, stage, time, kind, JSON body. `Journal` writes events
(`orchestrator.records.events`) and then passes them to the subscribers, `JournalReader` reads them.

- Entries are never changed or deleted; triggers refuse it.
- Entries written together are all present or all absent, whenever the process dies.
- Pours are flushed to the disk before the arm moves and before their outcome is used (synchronous=FULL). All other
  entries survive the death of the process; a power cut can lose the most recent ones.
- At a pour, the write-ahead log is copied into the file, and the entry is repeated in a ledger. A lost or changed
  journal is thus detected (`orchestrator.records.journal_check`).
- A full disk does not prevent the records of a pour (`orchestrator.records.journal_file`).
"""

from __future__ import annotations

import contextlib
import json
import logging
import sqlite3
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from orchestrator.learning.stage_result import StageResult
from orchestrator.records.codec import CodecError, canonical, first_difference
from orchestrator.records.events import (
    CampaignStateChanged,
    Event,
    Kind,
    Level,
    LogLine,
    Requested,
    StageClosed,
    Subscriber,
    event_of,
)
from orchestrator.records.journal_check import (
    BEGUN,
    LEDGER_NAME,
    LedgerLine,
    LedgerWriter,
    check_journal,
    has_begun,
    read_ledger,
    traces_of_a_run,
)
from orchestrator.records.journal_file import (
    MB,
    EventRow,
    Header,
    JournalError,
    Reserve,
    chain_of,
    chained,
    check_format,
    checkpoint,
    connect,
    connect_writer,
    free_space,
    has_tables,
    lay_out,
    take_lock,
)
from orchestrator.records.run_clock import begin_run, end_run
from orchestrator.records.states import State

JOURNAL_NAME = "journal.sqlite"

_log = logging.getLogger(__name__)


_IN_LEDGER = frozenset({Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED})
_DURABLE = _IN_LEDGER | {Kind.OPERATOR_ANSWERED}


@dataclass(frozen=True)
class Entry:
    """One row."""

    seq: int
    stage: str
    t: float
    kind: str
    body: dict[str, Any]


class JournalReader:
    """Reads a journal, also while a run is writing it."""

    def __init__(self, path: Path) -> None:
        """Open for reading.

        Raises:
            JournalError: there is no journal at that path, or it is not one of Decant's.
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
        """Close the file. May be called twice."""
        self._connection.close()

    def entries(
        self, *, after: int = 0, stage: str | None = None, kinds: Iterable[Kind] | None = None
    ) -> Iterator[Entry]:
        """Entries in the order in which they were written.

        Args:
            after: only entries with a larger sequence number.
            stage: only entries of this stage.
            kinds: only entries of these kinds.

        Raises:
            JournalError: the file is damaged.
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
        try:
            for row in self._connection.execute(query + " order by seq", arguments):
                yield Entry(row[0], row[1], row[2], row[3], _body(row[0], row[4]))
        except (sqlite3.DatabaseError, _BodyError) as error:
            raise JournalError(f"{self.path}: is damaged ({error}); see `decant runs check`") from error

    def events(
        self,
        requests: dict[int, Requested] | None = None,
        *,
        after: int = 0,
        stage: str | None = None,
        kinds: Iterable[Kind] | None = None,
    ) -> Iterator[tuple[int, Event]]:
        """The events that the entries record, with their sequence numbers.

        Args:
            requests: unfinished requests before `after`; updated.
            after, stage, kinds: see `entries`.

        Raises:
            JournalError: the file is damaged.
        """
        requests = {} if requests is None else requests
        for entry in self.entries(after=after, stage=stage, kinds=kinds):
            try:
                yield entry.seq, event_of(entry.kind, entry.body, requests, time=entry.t, stage=entry.stage)
            except (CodecError, ValueError) as error:
                raise JournalError(
                    f"{self.path}: entry {entry.seq} is damaged ({error}); see `decant runs check`"
                ) from None

    def state(self) -> State:
        """The campaign's last recorded state."""
        last = State.QUEUED
        for _, event in self.events(kinds=[Kind.CAMPAIGN_STATE]):
            assert isinstance(event, CampaignStateChanged)
            last = event.after
        return last

    def stage_results(self) -> dict[str, StageResult]:
        """Results of the closed stages by name, in the order in which the stages were closed.

        Raises:
            RunError: a result can't be decoded.
        """
        closed = (event for _, event in self.events(kinds=[Kind.STAGE_CLOSED]))
        return {event.stage: event.result for event in closed if isinstance(event, StageClosed)}

    def last_id(self) -> int:
        """The largest request id in use; 0 before the first request."""
        row = self._connection.execute(
            "select max(json_extract(body, '$.id')) from event where kind = ?", [str(Kind.REQUESTED)]
        ).fetchone()
        return int(row[0] or 0)

    def _read_header(self) -> Header:
        try:
            row = self._connection.execute("select format, name, fingerprint, created from header").fetchone()
        except sqlite3.DatabaseError as error:
            raise JournalError(f"{self.path}: not a journal of Decant ({error})") from error
        if row is None:
            raise JournalError(f"{self.path}: the journal has no header; it is damaged")
        check_format(row[0], self.path)
        try:
            return Header(row[1], json.loads(row[2]), row[3])
        except ValueError as error:
            raise JournalError(f"{self.path}: the journal's header is damaged ({error})") from None


class _BodyError(ValueError):
    """The body of an entry is damaged."""


def _body(seq: int, text: str) -> dict[str, Any]:
    try:
        body = json.loads(text)
    except ValueError as error:
        raise _BodyError(f"entry {seq}: {error}") from None
    if not isinstance(body, dict):
        raise _BodyError(f"entry {seq}: its body is not a mapping")
    return body


class Journal(JournalReader):
    """The only writer of a journal. Created by `Journal.create` and `Journal.resume`."""

    def __init__(
        self, path: Path, lock: IO[str], connection: sqlite3.Connection, subscribers: Sequence[Subscriber]
    ) -> None:
        self.path = path
        self._subscribers = list(subscribers)
        self._lock = lock
        self._connection = connection
        self._durable = False
        self._reserve = Reserve(path.with_suffix(".reserve"))
        self.header = self._read_header()
        self._last = _last_of_chain(connection)
        self._unwritten: list[LedgerLine] = []
        self._ledger: LedgerWriter
        self._runs = False

    @classmethod
    def create(cls, path: Path, header: Header, subscribers: Sequence[Subscriber] = ()) -> Journal:
        """Begin a new journal.

        Raises:
            JournalError: another process is writing it.
            JournalError: a run or traces of one exist already, or the file can't be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        # A recording may exist already: the program that will run the campaign has opened it.
        traces = [name for name in traces_of_a_run(path) if not name.endswith(".rrd")]
        with contextlib.ExitStack() as opened:
            lock = opened.enter_context(take_lock(path))
            if traces and not path.is_file():
                raise JournalError(
                    f"{path}: a run was begun here ({', '.join(traces)}), and its journal is missing: pours could be "
                    "repeated. Restore the journal, or begin in another directory"
                )
            connection = opened.enter_context(closing(connect_writer(path)))
            if has_tables(connection, path):
                raise JournalError(f"{path}: holds a run already; resume that one, or begin in another directory")
            lay_out(connection, header, path)
            journal = cls(path, lock, connection, subscribers)
            journal._ledger = journal._open_ledger()
            opened.pop_all()
            return journal._begun()

    @classmethod
    def resume(cls, path: Path, header: Header, subscribers: Sequence[Subscriber] = ()) -> Journal:
        """Continue a journal. If its process died before it wrote anything, the journal is begun again.

        Raises:
            JournalError: another process is writing it.
            JournalDamagedError: it has lost or changed entries.
            JournalError: there is none, it has another format, or it belongs to another campaign.
        """
        if not has_begun(path):
            raise JournalError(f"{path}: there is no journal to resume; begin the campaign without --resume")
        with contextlib.ExitStack() as opened:
            lock = opened.enter_context(take_lock(path))
            check_journal(path).require()
            connection = opened.enter_context(closing(connect_writer(path)))
            if not has_tables(connection, path):
                lay_out(connection, header, path)
            journal = cls(path, lock, connection, subscribers)
            journal._check_same_campaign(header)
            journal._ledger = journal._open_ledger()
            opened.pop_all()
            return journal._begun()

    def reserve_space(self) -> None:
        """Reserve disk space for a pour's records, until the journal is closed.

        Raises:
            NoSpaceError: there is not enough.
        """
        self._reserve.take()

    def check_space_for_pour(self) -> None:
        """Check that a pour can be recorded, whatever its outcome.

        Raises:
            NoSpaceError: it can't; the pour must not begin.
        """
        self._reserve.check_pour()

    def append(self, *events: Event) -> None:
        """Write the events that have a kind, in one transaction, then publish all of them.

        They are in the file when this returns. On a full disk the reserved space is used. Of a `replayed` event, the
        subscribers hear when its stage is replayed.

        Raises:
            JournalError: the file can't be written; then nothing is published.
        """
        if written := [event for event in events if event.kind is not None]:
            self._write(written)
        self.publish(*(event for event in events if not event.replayed))

    def publish(self, *events: Event) -> None:
        """Pass events to the subscribers, without writing them. Never raises."""
        for event in events:
            failed: list[tuple[Subscriber, Exception]] = []
            for subscriber in self._subscribers:
                try:
                    subscriber(event)
                except Exception as error:
                    failed.append((subscriber, error))
            for subscriber, problem in failed:
                self._subscribers.remove(subscriber)
                name = getattr(subscriber, "__qualname__", type(subscriber).__qualname__)
                text = f"{name} can't watch any longer: {type(problem).__name__}: {problem}"
                _log.warning(text, exc_info=problem)
                self.log("warning", text)

    def log(self, level: Level, text: str, *, stage: str = "", kept: bool = False) -> None:
        """Append a `LogLine`."""
        self.append(LogLine(level=level, text=text, stage=stage, kept=kept))

    def _write(self, events: Sequence[Event]) -> None:
        durable = any(event.kind in _DURABLE for event in events)
        if durable != self._durable:
            self._connection.execute(f"pragma synchronous = {'full' if durable else 'normal'}")
            self._durable = durable
        now, (seq, digest) = events[0].time, self._last  # entries that were written together have one time
        rows: list[EventRow] = []
        links: list[tuple[int, bytes]] = []
        lines: list[LedgerLine] = []
        for event in events:
            seq, kind, body = seq + 1, str(event.kind), event.body()
            rows.append((seq, event.stage, now, kind, canonical(body)))
            digest = chained(digest, rows[-1])
            links.append((seq, digest))
            if event.kind in _IN_LEDGER:
                lines.append(LedgerLine(seq, digest.hex(), now, kind, event.stage, body))
        try:
            self._with_reserve(lambda: self._insert(rows, links))
            self._last = seq, digest
            if lines:
                self._unwritten += lines
                self._with_reserve(lambda: self._ledger.append(self._unwritten))
                self._unwritten = []
        except (sqlite3.OperationalError, OSError) as error:
            raise JournalError(
                f"{self.path}: can't be written ({error}; {free_space(self.path) / MB:.1f} MB are free on its disk); "
                "what is in it is safe. Fix that and resume the run"
            ) from error
        if durable:
            checkpoint(self._connection)

    def _with_reserve(self, write: Callable[[], None]) -> None:
        """Write; if that fails, free the reserve and write once more."""
        try:
            write()
        except (sqlite3.OperationalError, OSError):
            if not self._reserve.release():
                raise
            write()

    def _insert(self, rows: Sequence[EventRow], links: Sequence[tuple[int, bytes]]) -> None:
        try:
            self._connection.execute("begin immediate")
            self._connection.executemany("insert into event (seq, stage, t, kind, body) values (?, ?, ?, ?, ?)", rows)
            self._connection.executemany("insert into chain values (?, ?)", links)
            self._connection.execute("commit")
        except BaseException:
            if self._connection.in_transaction:  # SQLite itself rolls back if the disk is full
                self._connection.execute("rollback")
            raise

    def _open_ledger(self) -> LedgerWriter:
        """The ledger, with all entries of the journal about pours.

        Raises:
            JournalError: it can't be written.
        """
        path = self.path.with_name(LEDGER_NAME)
        try:
            if not path.is_file():
                (seq, digest), created = self._last, self.header.created
                body = {"name": self.header.name, "created": created, "entries": seq}
                ledger = LedgerWriter.begin(path, [LedgerLine(seq, digest.hex(), created, BEGUN, "", body)])
            else:
                ledger = LedgerWriter.resume(path)
                if missing := self._lines_about_pours(after=max(line.seq for line in read_ledger(path))):
                    ledger.append(missing)
            return ledger
        except (sqlite3.OperationalError, OSError) as error:
            raise JournalError(
                f"{path}: can't be written ({error}; {free_space(self.path) / MB:.1f} MB are free)"
            ) from error

    def _lines_about_pours(self, *, after: int) -> list[LedgerLine]:
        return [
            LedgerLine(row[0], digest.hex(), row[2], row[3], row[1], json.loads(row[4]))
            for row, digest in chain_of(self._connection)
            if row[0] > after and row[3] in _IN_LEDGER
        ]

    def close(self) -> None:
        """Release file, lock and reserve. May be called twice."""
        self._reserve.release()
        self._connection.close()
        self._ledger.close()
        self._lock.close()
        if self._runs:
            self._runs = False
            end_run()

    def _begun(self) -> Self:
        """From now on, times of the run do not jump with the system's clock; see `orchestrator.records.run_clock`."""
        self._runs = True
        begin_run()
        return self

    def _check_same_campaign(self, header: Header) -> None:
        difference = first_difference(self.header.fingerprint, header.fingerprint)
        if difference is None:
            return
        if difference.path[-1:] == ("mirrored",) and difference.actual is True:
            raise JournalError(
                f"{self.path}: this run simulated whole pours, and now one half would be simulated. Write 'symmetry: "
                "off' under 'simulator' in the campaign's file to resume it, or begin a new run"
            )
        raise JournalError(
            f"{self.path}: this run was begun with other settings, and its next steps depend on them: {difference}. "
            "Set that back, use the version that began the run (see versions.json next to it), or begin a new run"
        )


def _last_of_chain(connection: sqlite3.Connection) -> tuple[int, bytes]:
    """The last entry's sequence number and digest; the header's, as number 0, if there is none."""
    ((row, digest),) = deque(chain_of(connection), maxlen=1)
    return row[0], digest
