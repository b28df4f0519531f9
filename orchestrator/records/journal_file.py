"""The file of a journal: tables, header, hash chain, lock, and the disk space that a run reserves.

Every entry has a digest of itself and of the digest before it. The first digest is that of the header. A changed,
removed or inserted entry therefore changes all digests from there on. Only `journal.py` and `journal_check.py` read
these tables.

A file next to the journal occupies the space from the start of the run. If the disk fills up while a pour is running,
the file is deleted and the pour's records use its space. The file must exist again before the next pour.

Limitations: on file systems that copy on write or compress (btrfs, zfs), a file's length does not guarantee its space.
"""

from __future__ import annotations

import contextlib
import errno
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

from orchestrator.learning.run_errors import RunError
from orchestrator.records.codec import canonical

FORMAT = 4
"""Version of the tables and of the entries' bodies. A journal of another version is refused."""

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


class JournalFormatError(JournalError):
    """The journal has the format of another version."""

    exit_code = 2


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


def check_format(version: int, path: Path) -> None:
    """Check that this version of Decant can read and resume a journal.

    Raises:
        JournalFormatError: another version wrote it.
    """
    if version != FORMAT:
        raise JournalFormatError(
            f"{path}: written in format {version}, this version of Decant reads format {FORMAT}; "
            "use the version that began the run (see versions.json next to it), or begin a new run"
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
        JournalError: another process holds the lock.
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
        raise JournalError(f"{path.parent}: {who} is running this campaign; wait for it, or stop it before you resume")
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


MB = 1_000_000

RESERVE = 12 * MB
"""Size of the reserve [bytes].

A pour's records need about 200 kB, including all pages of the journal that they change. SQLite's write-ahead log grows
to 4 MB before it is copied into the journal, and the journal then grows by the same amount.
"""

FOR_A_POUR = 8 * MB
"""Free space needed in addition to the reserve when a pour begins, because recording and figures also grow [bytes]."""

TO_BEGIN = RESERVE + FOR_A_POUR + 20 * MB
"""Free space needed when a run begins: journal, recording and figures of a small campaign [bytes]."""


class NoSpaceError(RunError):
    """The disk has too little free space for the next step; nothing was begun, and nothing is lost."""

    exit_code = 3


def free_space(path: Path) -> int:
    """Bytes that this user may still write on the disk of a path; the path need not exist."""
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    space = os.statvfs(existing)
    return space.f_bavail * space.f_frsize


def require_space(path: Path, needed: int, purpose: str) -> None:
    """Check that there is enough free space.

    Args:
        path: file or folder on the disk.
        needed: [bytes].
        purpose: completes the message 'N MB are needed …'.

    Raises:
        NoSpaceError: with path, needed space and free space.
    """
    free = free_space(path)
    if free < needed:
        raise NoSpaceError(
            f"{path}: {free / MB:.1f} MB are free on its disk, and {needed / MB:.0f} MB are needed {purpose}"
        )


class Reserve:
    """The reserved space of one run.

    Args:
        path: path of the file that occupies it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._held = False

    def take(self) -> None:
        """Reserve the space, unless it is reserved already.

        Raises:
            NoSpaceError: there is not enough.
        """
        if self._held:
            return
        try:
            with self._path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, RESERVE)
        except OSError as error:
            self._remove()
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            require_space(self._path.parent, RESERVE + FOR_A_POUR, _PURPOSE)
            raise NoSpaceError(  # a quota, which the free space of the disk does not show
                f"{self._path.parent}: {RESERVE / MB:.0f} MB are needed {_PURPOSE}, and can't be had "
                f"({error.strerror}; {free_space(self._path) / MB:.0f} MB are free on the disk)"
            ) from None
        self._held = True

    def check_pour(self) -> None:
        """Check that the next pour can be recorded; reserve the space again if it was used.

        Raises:
            NoSpaceError: it can't be recorded.
        """
        require_space(self._path.parent, FOR_A_POUR + (0 if self._held else RESERVE), _PURPOSE)
        self.take()

    def release(self) -> bool:
        """Free the reserved space for a write that needs it. Returns whether it was reserved."""
        held, self._held = self._held, False
        if held:
            self._remove()
        return held

    def _remove(self) -> None:
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)


_PURPOSE = "before anything is poured, so that whatever comes of a pour can be written down"
