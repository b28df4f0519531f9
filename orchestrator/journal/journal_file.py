"""The file format of a journal: tables, header, hash chain and lock.

Every entry has a digest of itself and of the digest before it. The first digest is that of the header. A changed,
removed or inserted entry therefore changes all digests from there on. Only `journal.py` and `journal_check.py` read
these tables.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from orchestrator.journal.codec import canonical
from orchestrator.journal.disk_reserve import MB, free_space
from orchestrator.run_errors import RunError

FORMAT = 3
"""Version of the tables and of the entries' bodies. A journal of another version is refused."""

WITHOUT_CHAIN = 2
"""The version before the hash chain. Such a journal can be read; resuming it adds the chain."""

_CHAIN = """
create table chain (seq integer primary key, digest blob not null) strict;
create trigger chain_is_never_changed before update on chain
    begin select raise(abort, 'the journal is append-only'); end;
create trigger chain_is_never_deleted before delete on chain
    begin select raise(abort, 'the journal is append-only'); end;
"""

_SCHEMA = """
create table header (
    format integer not null, name text not null, fingerprint text not null check (json_valid(fingerprint)),
    created real not null
) strict;
create table event (
    seq integer primary key, stage text not null, t real not null, kind text not null,
    body text not null check (json_valid(body))
) strict;
create index event_by_stage on event (stage, seq);
create trigger event_is_never_changed before update on event
    begin select raise(abort, 'the journal is append-only'); end;
create trigger event_is_never_deleted before delete on event
    begin select raise(abort, 'the journal is append-only'); end;
"""


class JournalError(RunError):
    """The journal can't be used; the text gives the reason and the remedy."""


class JournalLockedError(JournalError):
    """Another process is writing this journal."""


@dataclass(frozen=True)
class Header:
    """The campaign that a journal belongs to.

    Attributes:
        name: name of the campaign.
        fingerprint: JSON-ready; all values of the plan that decide which requests are made.
        created: seconds since 1970.
    """

    name: str
    fingerprint: dict[str, Any]
    created: float = 0.0


def check_format(found: int, path: Path) -> None:
    """Check that this version of Decant can read a journal.

    Raises:
        JournalError: another version wrote it.
    """
    if found not in (FORMAT, WITHOUT_CHAIN):
        raise JournalError(
            f"{path}: written in format {found}, this version of Decant reads format {FORMAT}; "
            "go on with the version that began the run (see versions.json beside it) or begin a new run"
        )


EventRow = tuple[int, str, float, str, str]
"""A row of the table of entries: sequence number, stage, time, kind, body."""


def chain_root(name: str, fingerprint: str, created: float) -> bytes:
    """The digest of a journal's header, from its columns as they are stored. The chain begins with it."""
    return hashlib.sha256("\0".join((name, fingerprint, repr(created))).encode()).digest()


def chained(previous: bytes, row: EventRow) -> bytes:
    """The digest of an entry, given the digest of the entry before it."""
    seq, stage, t, kind, body = row
    return hashlib.sha256(previous + "\0".join((str(seq), stage, repr(t), kind, body)).encode()).digest()


def chain_of(connection: sqlite3.Connection) -> Iterator[tuple[EventRow, bytes]]:
    """Every entry of a journal with its digest, computed from the stored columns; the first one is row 0, the header's.

    Raises:
        sqlite3.DatabaseError: the file is damaged.
    """
    name, fingerprint, created = connection.execute("select name, fingerprint, created from header").fetchone()
    digest = chain_root(name, fingerprint, created)
    yield (0, "", created, "header", name), digest
    for row in connection.execute("select seq, stage, t, kind, body from event order by seq"):
        digest = chained(digest, row)
        yield row, digest


def add_chain(connection: sqlite3.Connection) -> None:
    """Add the hash chain to a journal of the version before it, in one transaction."""
    digests = [(row[0], digest) for row, digest in chain_of(connection)][1:]
    connection.executescript(f"begin immediate; {_CHAIN}")
    connection.executemany("insert into chain values (?, ?)", digests)
    connection.execute("update header set format = ?", [FORMAT])
    connection.execute("commit")


def checkpoint(connection: sqlite3.Connection) -> None:
    """Copy the write-ahead log into the journal's own file, and flush it. A reader may delay it, never block it.

    If the disk is full, the entries stay in the log, where they are safe; the next call tries again.
    """
    try:
        connection.execute("pragma busy_timeout = 0")
        connection.execute("pragma wal_checkpoint(truncate)").fetchall()
    except sqlite3.OperationalError:
        pass
    finally:
        connection.execute(f"pragma busy_timeout = {round(1000 * _TIMEOUT)}")


_TIMEOUT = 10.0
"""Longest time to wait for another connection [s]."""


def connect(uri: str) -> sqlite3.Connection:
    """Open a journal in autocommit mode: callers begin every transaction themselves."""
    return sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_TIMEOUT)


def connect_writer(path: Path) -> sqlite3.Connection:
    """Open a journal for its only writer.

    Raises:
        JournalError: the file is not a journal.
    """
    connection = connect(path.absolute().as_uri())
    try:
        connection.execute("pragma journal_mode = wal")
        connection.execute("pragma synchronous = normal")
    except sqlite3.DatabaseError as error:
        connection.close()
        raise JournalError(f"{path}: not a journal of Decant ({error})") from error
    return connection


def has_tables(connection: sqlite3.Connection, path: Path) -> bool:
    """Whether the file contains tables.

    Raises:
        JournalError: the file is not a journal.
    """
    try:
        with closing(connection.execute("select count(*) from sqlite_master")) as cursor:
            return bool(cursor.fetchone()[0])
    except sqlite3.DatabaseError as error:
        raise JournalError(f"{path}: not a journal of Decant ({error})") from error


def lay_out(connection: sqlite3.Connection, header: Header, path: Path) -> None:
    """Write tables and header.

    Raises:
        JournalError: it can't be written.
    """
    row = (FORMAT, header.name, canonical(header.fingerprint), header.created or time.time())
    # One transaction: a file with tables always has its header.
    try:
        connection.executescript(f"begin immediate; {_SCHEMA} {_CHAIN}")
        connection.execute("insert into header values (?, ?, ?, ?)", row)
        connection.execute("commit")
        checkpoint(connection)
    except sqlite3.OperationalError as error:
        raise JournalError(f"{path}: can't be written ({error}; {free_space(path) / MB:.1f} MB are free)") from error


def locked_alone(file: IO[str]) -> bool:
    """Lock a file for this process; the system releases the lock when the process ends, however it ends.

    Returns:
        False if another process holds the lock.

    Raises:
        OSError: the file system can't lock files; the text gives the remedy.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        text = f"can't be locked ({error.strerror}); name a folder on a local disk, or mount this one with locks"
        raise OSError(error.errno, text, file.name) from None
    return True


def take_lock(path: Path) -> IO[str]:
    """Lock the run for this process.

    Raises:
        JournalLockedError: another process holds the lock.
        JournalError: the file system can't lock files.
    """
    file = path.with_suffix(".lock").open("a+", encoding="utf-8")
    try:
        alone = locked_alone(file)
    except OSError as error:
        file.close()
        raise JournalError(f"{error.filename}: {error.strerror}") from None
    if not alone:
        file.seek(0)
        owner = file.read().strip()
        file.close()
        who = f"process {owner}" if owner else "another process"
        raise JournalLockedError(
            f"{path.parent}: {who} is running this campaign; wait for it, or stop it before you resume"
        )
    file.truncate(0)
    file.write(str(os.getpid()))
    file.flush()
    return file


def whole_copy(path: Path) -> bytes:
    """The journal as the bytes of a single file; also while it is being written."""
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True)) as source, closing(sqlite3.connect(":memory:")) as copy:
        source.backup(copy)
        copy.execute("pragma journal_mode = delete")
        return copy.serialize()
