"""Checks a run's records: the journal's file, its hash chain, and its agreement with the ledger of pours.

`check_journal` returns a `JournalCheck`. Resuming, `decant runs check` and the report use it. It only reads, and works
while a run is being written.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from orchestrator.journal.journal_file import WITHOUT_CHAIN, JournalError, chain_of, check_format, connect
from orchestrator.journal.pour_ledger import (
    LEDGER_NAME,
    LedgerError,
    LedgerLine,
    pours_in_ledger,
    read_ledger,
    readable_lines,
)

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
        unchecked: number of entries written before the journal had a chain; earlier changes to them can't be found. In
            a journal of an older version, all entries.
        begun: whether there is a run; False in a folder where a run died before its first entry.
    """

    path: Path
    problems: tuple[str, ...] = ()
    pours: tuple[str, ...] = ()
    entries: int = 0
    unchecked: int = 0
    begun: bool = True

    @property
    def verdict(self) -> str:
        """The result as one sentence without a full stop."""
        if self.problems:
            return f"damaged or incomplete: {'; '.join(self.problems)}"
        if self.unchecked == 0:
            return f"complete and unchanged ({self.entries} entries)"
        if self.unchecked < self.entries:
            return f"complete; the first {self.unchecked} of {self.entries} entries are older than the hash chain"
        return f"not verifiable: the journal ({self.entries} entries) is of a version without a hash chain"

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
    recordings = sorted(found.name for found in path.parent.glob("*.rrd"))
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
    found = connection.execute("pragma integrity_check(3)").fetchall()
    if found != [("ok",)]:
        problems.append(f"SQLite's integrity check of {path.name}: {'; '.join(str(row[0]) for row in found)}")
    header = connection.execute("select format from header").fetchone()
    if header is None:
        return JournalCheck(path, (*problems, f"{path.name} has no header"), pours)
    check_format(header[0], path)
    old = header[0] == WITHOUT_CHAIN
    repeated = {line.seq: line for line in ledger or ()}
    entries = 0
    stored = {} if old else dict(connection.execute("select seq, digest from chain").fetchall())
    for place, (row, digest) in enumerate(chain_of(connection)):
        if row[0] != place:
            problems.append(f"entry {place} of the journal is missing")
            break
        if place and not old and stored.pop(place, None) != digest:
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
    if ledger is None and not problems and not old and (entries or [name for name in traces if _is_record(name)]):
        problems.append(f"{LEDGER_NAME}, the ledger of pours, is missing")
    before = ledger[0].body.get("entries", 0) if ledger else 0
    return JournalCheck(path, tuple(problems), pours, entries, entries if old else int(before))


def _is_record(name: str) -> bool:
    """Whether a run writes that file only when its ledger is there."""
    return not name.endswith((".rrd", "-wal"))
