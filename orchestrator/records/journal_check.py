"""Checks that the records of a run are complete: the ledger of its pours, and the check of its journal against it.

The ledger is a text file next to the journal: one JSON line per entry about a pour, flushed to the disk. A journal that
has lost entries can't report that itself. Each line has the journal's digest at its entry, and a digest of itself and
of the line before it. The journal's entry is always written first: a journal may be ahead of its ledger by the entries
of one write, the ledger is never ahead of its journal.

`check_journal` compares both, also while a run is being written. Resuming, `decant runs check` and the report use it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from orchestrator.records.codec import canonical
from orchestrator.records.journal_file import JournalError, chain_of, check_format, connect

LEDGER_NAME = "pours.jsonl"

BEGUN = "begun"
"""The kind of the first line; its body has the campaign's name, when the journal was created, and how many entries the
journal had when the ledger was begun."""

_LINE_DIGEST = "line"


class LedgerError(JournalError):
    """The ledger can't be read, or one of its lines was changed."""


@dataclass(frozen=True)
class LedgerLine:
    """One line of a ledger.

    Attributes:
        seq: sequence number of the journal's entry that it repeats; of the last entry, for the first line.
        digest: the journal's digest at that entry, in hexadecimal.
        t: seconds since 1970.
        kind, stage, body: as in the journal's entry.
    """

    seq: int
    digest: str
    t: float
    kind: str
    stage: str
    body: dict[str, Any]


class LedgerWriter:
    """The only writer of a ledger. Its caller holds the journal's lock."""

    def __init__(self, path: Path, descriptor: int, size: int, last: str) -> None:
        self._path, self._descriptor, self._size, self._last = path, descriptor, size, last

    @classmethod
    def begin(cls, path: Path, lines: Sequence[LedgerLine]) -> Self:
        """Write a new ledger with its first lines: the whole file, or nothing.

        Raises:
            OSError: it can't be written.
        """
        text, last = _text(lines, "")
        draft = path.with_suffix(".part")
        with draft.open("wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        _flush_folder(path.parent)
        return cls(path, os.open(path, os.O_WRONLY | os.O_CLOEXEC), len(text), last)

    @classmethod
    def resume(cls, path: Path) -> Self:
        """Continue a ledger; an incomplete last line is removed.

        Raises:
            LedgerError: it is damaged.
            OSError: it can't be opened.
        """
        last, size = "", 0
        for text in _whole_lines(path):
            _, last = _parsed(path, text, last)
            size += len(text)
        os.truncate(path, size)
        return cls(path, os.open(path, os.O_WRONLY | os.O_CLOEXEC), size, last)

    def append(self, lines: Sequence[LedgerLine]) -> None:
        """Write lines; they are on the disk when this returns. A failed write leaves no partial line.

        Raises:
            OSError: they can't be written.
        """
        text, last = _text(lines, self._last)
        try:
            written = 0
            while written < len(text):
                written += os.pwrite(self._descriptor, text[written:], self._size + written)
            os.fdatasync(self._descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size, self._last = self._size + len(text), last

    def close(self) -> None:
        """Close the file. May be called twice."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def read_ledger(path: Path) -> list[LedgerLine]:
    """The lines of a ledger, also while a run is writing it; an incomplete last line is left out.

    Raises:
        LedgerError: a line was changed, removed or inserted; the text gives its number.
        OSError: the file can't be read.
    """
    lines: list[LedgerLine] = []
    last = ""
    for text in _whole_lines(path):
        line, last = _parsed(path, text, last, len(lines) + 1)
        lines.append(line)
    return lines


def readable_lines(path: Path) -> list[LedgerLine]:
    """The lines of a ledger up to the first damaged one; none if there is no ledger."""
    lines: list[LedgerLine] = []
    last = ""
    with contextlib.suppress(LedgerError, OSError):
        for text in _whole_lines(path):
            line, last = _parsed(path, text, last)
            lines.append(line)
    return lines


def pours_in_ledger(lines: Sequence[LedgerLine]) -> list[str]:
    """One text per pour that has begun: 'pour 2 of stage calibration (began 2030-03-01 14:30:05, no outcome)'."""
    pours: dict[tuple[str, Any], str] = {}
    numbers: dict[tuple[str, Any], Any] = {}
    for line in lines:
        if line.kind == BEGUN:
            continue
        key = (line.stage, line.body.get("id"))
        numbers[key] = line.body.get("number", numbers.get(key))
        match line.kind:
            case "pour.started":
                pours[key] = f"began {_when(line.t)}, no outcome"
            case "pour.withdrawn":
                pours.pop(key, None)
            case "pour.finished":
                pours[key] = _outcome(line.body.get("outcome") or {})
    return [f"{_named(*key, numbers[key])} ({text})" for key, text in pours.items()]


def _named(stage: str, key: Any, number: Any) -> str:
    return f"pour {number} of stage {stage}" if number is not None else f"request {key} of stage {stage}"


def _outcome(outcome: dict[str, Any]) -> str:
    measured = outcome.get("measurement")
    if isinstance(measured, dict) and all(isinstance(measured.get(k), int | float) for k in ("spilled", "retained")):
        return f"weighed: {1e3 * measured['spilled']:.1f} g spilled, {1e3 * measured['retained']:.1f} g retained"
    return f"failed: {outcome.get('reason', 'without a reason')}"


def _when(t: float) -> str:
    from datetime import datetime

    return datetime.fromtimestamp(t).strftime("%Y-%m-%d %H:%M:%S")


def _text(lines: Sequence[LedgerLine], last: str) -> tuple[bytes, str]:
    """Encode lines that follow a line with the digest `last`; also returns the digest of the last line."""
    parts = []
    for line in lines:
        content = dict(line.__dict__)
        last = _digest(last, content)
        parts.append(canonical({**content, _LINE_DIGEST: last}) + "\n")
    return "".join(parts).encode(), last


def _digest(last: str, content: dict[str, Any]) -> str:
    return hashlib.sha256(f"{last}\0{canonical(content)}".encode()).hexdigest()


def _whole_lines(path: Path) -> Iterator[bytes]:
    for text in path.read_bytes().splitlines(keepends=True):
        if text.endswith(b"\n"):
            yield text


def _parsed(path: Path, text: bytes, last: str, number: int | None = None) -> tuple[LedgerLine, str]:
    where = path.name if number is None else f"{path.name}, line {number}"
    try:
        content = json.loads(text)
        digest = content.pop(_LINE_DIGEST)
        if digest != _digest(last, content):
            raise LedgerError(f"{where}: was changed after it was written, or a line before it is missing")
        return LedgerLine(**content), digest
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise LedgerError(f"{where}: is damaged ({type(error).__name__}: {error})") from None


def _flush_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some network file systems do not support it
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


_WRITTEN_BY_A_RUN = ("resolved.json", "versions.json", "summary.json", "theta.json", "report.html", LEDGER_NAME)


class JournalDamagedError(JournalError):
    """A journal has lost or changed entries; resuming its run could repeat pours."""

    exit_code = 2


@dataclass(frozen=True)
class JournalCheck:
    """Result of a check.

    Attributes:
        path: path of the journal.
        problems: one text each; empty: the records are complete and unchanged.
        pours: pours that have begun, from the ledger.
        entries: number of entries in the journal.
        begun: whether there is a run; False in a folder where a run died before its first entry.
    """

    path: Path
    problems: tuple[str, ...] = ()
    pours: tuple[str, ...] = ()
    entries: int = 0
    begun: bool = True

    @property
    def verdict(self) -> str:
        """The result as one sentence without a full stop."""
        if self.problems:
            return f"damaged or incomplete: {'; '.join(self.problems)}"
        return f"complete and unchanged ({self.entries} entries)"

    def require(self) -> None:
        """Raise an error if the journal fails the check.

        Raises:
            JournalDamagedError: with every problem, the pours that may have been made, and advice.
        """
        if not self.problems:
            return
        pours = "; ".join(self.pours) or f"unknown: {LEDGER_NAME} names none"
        raise JournalDamagedError(
            f"{self.path}: this run can't be resumed, because its records are damaged or incomplete, and pours could "
            f"be repeated. Nothing was poured now.\n  problems: {'; '.join(self.problems)}\n"
            f"  pours that may have been made: {pours}\n"
            f"  what to do: restore {self.path.name} and {LEDGER_NAME} from a copy, or begin a new run without "
            f"--resume, with the pourer refilled and the receiver empty. `decant runs check {self.path.parent}` checks "
            "again"
        )


def traces_of_a_run(path: Path) -> list[str]:
    """Names of files that only a run leaves next to its journal, the lock and recordings included.

    Args:
        path: of the journal, which may be missing.
    """
    names = [*_WRITTEN_BY_A_RUN, path.with_suffix(".reserve").name, path.with_suffix(".lock").name]
    names += [f"{path.name}-wal"] if not path.is_file() else []
    recordings = sorted(file.name for file in path.parent.glob("*.rrd"))
    return [name for name in names if (path.parent / name).exists()] + recordings


def has_begun(path: Path) -> bool:
    """Whether a run was begun, so that its journal must be resumed and no new one may be made.

    Args:
        path: of the journal, which may be missing.
    """
    return path.is_file() or bool(traces_of_a_run(path))


def check_journal(path: Path) -> JournalCheck:
    """Check a run's records: SQLite's own check, the hash chain over all entries, and the ledger of pours.

    Args:
        path: of the journal.

    Raises:
        OSError: a file can't be read.
    """
    traces = [name for name in traces_of_a_run(path) if not name.endswith(".lock")]
    # The ledger is read first: the journal of a running campaign can then only be ahead of it, never behind.
    ledger, problems = _ledger(path.with_name(LEDGER_NAME))
    pours = tuple(pours_in_ledger(ledger if ledger is not None else readable_lines(path.with_name(LEDGER_NAME))))
    if not path.is_file() or path.stat().st_size == 0:
        wal = path.with_name(f"{path.name}-wal")
        if wal.exists() and wal.stat().st_size:
            traces.append(wal.name)
        if not traces and not path.is_file():
            problems.append(f"{path.name} is missing")
        elif traces:
            lost = "is empty" if path.is_file() else "is missing"
            problems.append(f"{path.name} {lost}, but the folder has {', '.join(dict.fromkeys(traces))} of a run")
        return JournalCheck(path, tuple(problems), pours, begun=bool(traces))
    try:
        with closing(connect(f"{path.absolute().as_uri()}?mode=ro")) as connection:
            connection.execute("begin")
            if not connection.execute("select count(*) from sqlite_master").fetchone()[0]:
                if traces:
                    problems.append(f"{path.name} has no entries, but the folder has {', '.join(traces)} of a run")
                return JournalCheck(path, tuple(problems), pours, begun=bool(traces))
            return _checked(connection, path, ledger, problems, pours, traces)
    except (sqlite3.DatabaseError, ValueError) as error:
        return JournalCheck(path, (*problems, f"{path.name} is damaged, or not a journal of Decant ({error})"), pours)


def _ledger(path: Path) -> tuple[list[LedgerLine] | None, list[str]]:
    try:
        return read_ledger(path), []
    except FileNotFoundError:
        return None, []
    except LedgerError as error:
        return None, [str(error)]


def _checked(
    connection: sqlite3.Connection,
    path: Path,
    ledger: list[LedgerLine] | None,
    problems: list[str],
    pours: tuple[str, ...],
    traces: list[str],
) -> JournalCheck:
    faults = connection.execute("pragma integrity_check(3)").fetchall()
    if faults != [("ok",)]:
        problems.append(f"SQLite's integrity check of {path.name}: {'; '.join(str(row[0]) for row in faults)}")
    header = connection.execute("select format from header").fetchone()
    if header is None:
        return JournalCheck(path, (*problems, f"{path.name} has no header"), pours)
    check_format(header[0], path)
    repeated = {line.seq: line for line in ledger or ()}
    entries = 0
    stored = dict(connection.execute("select seq, digest from chain").fetchall())
    for place, (row, digest) in enumerate(chain_of(connection)):
        if row[0] != place:
            problems.append(f"entry {place} of the journal is missing")
            break
        if place and stored.pop(place, None) != digest:
            problems.append(f"entry {place} of the journal ({row[3]}) was changed after it was written")
            break
        line = repeated.pop(place, None)
        if line is not None and line.digest != digest.hex():
            problems.append(f"entry {place} of the journal ({row[3]}) is not the one that {LEDGER_NAME} has")
            break
        entries = place
    else:
        if stored:
            problems.append(f"the journal ends with entry {entries}, but its chain with entry {max(stored)}")
        if repeated:
            problems.append(
                f"the journal ends with entry {entries}, but {LEDGER_NAME} has entries about pours up to entry "
                f"{max(repeated)}: entries were lost"
            )
    if ledger is None and not problems and (entries or [name for name in traces if _is_record(name)]):
        problems.append(f"{LEDGER_NAME}, the ledger of pours, is missing")
    return JournalCheck(path, tuple(problems), pours, entries)


def _is_record(name: str) -> bool:
    """Whether a run writes that file only when its ledger is there."""
    return not name.endswith((".rrd", "-wal"))
