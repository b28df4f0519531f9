"""The index of the catalogue: one SQLite file with a table of runs and a table of pours.

- `Catalogue.refresh` reads all journals that changed since they were last read, so queries are never outdated. Only the
  process that queries the catalogue writes the index.
- The index may be deleted at any time; it is rebuilt from the runs.
- The columns of both tables are declared once here, for the index, exports and their data dictionary.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from orchestrator.catalogue.annotations import REMARKS_NAME
from orchestrator.catalogue.run_reading import UNREADABLE, RunRead, read_run, unreadable
from orchestrator.catalogue.run_registry import known, make_state_directory, state_directory
from orchestrator.journal.journal import JOURNAL_NAME
from orchestrator.journal.journal_check import has_begun
from orchestrator.journal.run_record import Row
from orchestrator.run_errors import RunError
from orchestrator.states import RESTING
from orchestrator.strategies.stage_result import displayed_action
from sim_engine.action import ACTION_DIMENSIONS

ColumnType = Literal["text", "texts", "integer", "number", "time", "values"]
"""'texts' are several texts, 'values' a mapping; both are stored as JSON in the index and in CSV."""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        unit: unit of its numbers; empty without one.
        meaning: description in one line.
    """

    name: str
    type: ColumnType
    meaning: str
    unit: str = ""


_WHICH_RUN = (
    Column("run", "text", "name of the run's folder"),
    Column("campaign", "text", "name of the campaign"),
    Column("mode", "text", "'virtual', or 'hardware' for a real bench"),
)

RUNS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("begun", "time", "when its journal was begun"),
    Column("ended", "time", "when the last entry was written; of a run that goes on, until now"),
    Column(
        "state",
        "text",
        "of the campaign, as in its journal; 'interrupted' where its process died without a word; "
        "'unreadable' if its journal is missing or damaged",
    ),
    Column("reason", "text", "why it is in that state, where there is something to report"),
    Column("laboratory", "text", "name of the laboratory"),
    Column("seed", "integer", "of every random choice"),
    Column("liquid", "texts", "names of the liquids"),
    Column("pourer", "texts", "names of the vessels that were poured from"),
    Column("receiver", "texts", "names of the vessels that were poured into"),
    Column("strategy", "texts", "of calibration and deployment"),
    Column("simulations", "integer", "that were finished, failed ones included"),
    Column("pours", "integer", "that were weighed"),
    Column("failed_pours", "integer", "that failed, or were lost"),
    Column("open_pours", "integer", "that had begun and have no outcome: under way, or UNKNOWN"),
    Column("spilled_g", "number", "beside the receiver, of all weighed pours together", "g"),
    Column("test_discrepancy", "number", "mean |measured − simulated| spillage of θ* on pours kept for testing", "1"),
    Column("theta", "values", "θ*, in SI units"),
    Column("recommended", "values", "by receiver: action to use from now on (display units), expected and best loss"),
    Column("tags", "texts", "given by people: `decant runs tag`"),
    Column("notes", "texts", "written by people: `decant runs note`"),
)
"""Columns of the table of runs."""

POURS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("time", "time", "when it was weighed, or had failed; when it began where it has no outcome"),
    Column("stage", "text", "of the campaign"),
    Column("id", "integer", "of the request within the run"),
    Column("number", "integer", "of the pour within its stage, from 1"),
    Column("purpose", "text", "'calibration', or 'pour' where something is minimised"),
    Column("strategy", "text", "that asked for it"),
    Column("pourer", "text", "vessel that was poured from"),
    Column("receiver", "text", "vessel that was poured into"),
    Column("liquid", "text", "what was poured"),
    *(
        Column(displayed, "number", dimension.meaning, dimension.display_unit)
        for displayed, dimension in zip(
            displayed_action(dict.fromkeys(ACTION_DIMENSIONS)), ACTION_DIMENSIONS.values(), strict=True
        )
    ),
    Column("outcome", "text", "'weighed', 'failed', or 'open': begun, no outcome; UNKNOWN once its process has died"),
    Column("loaded_g", "number", "in the pourer before", "g"),
    Column("spilled_g", "number", "beside the receiver", "g"),
    Column("retained_g", "number", "left in the pourer", "g"),
    Column("spillage", "number", "spilled / poured; empty where less than 5 % was poured", "1"),
    Column("loss", "number", "what the deployment minimised, as measured", "of loss_name"),
    Column("predicted_loss", "number", "what its strategy expected", "of loss_name"),
    Column("predicted_deviation", "number", "how well that was known: its standard deviation", "of loss_name"),
    Column("loss_name", "text", "which loss, see `loss` of a campaign; 'objectives' for a weighted sum"),
    Column("reason", "text", "why it failed"),
    Column("seconds", "number", "from its request to its outcome", "s"),
)
"""Columns of the table of pours; one row for each pour that had begun."""

ACTION_COLUMNS = tuple(displayed_action(dict.fromkeys(ACTION_DIMENSIONS)))
"""Columns of POURS with the action."""

TABLES: dict[str, tuple[Column, ...]] = {"run": RUNS, "pour": POURS}
"""The index's tables."""


INDEX_NAME = "catalogue.sqlite"

FORMAT = 2
"""Version of the index's content; an index of another version is rebuilt."""

_SQL = {"text": "text", "texts": "text", "integer": "integer", "number": "real", "time": "real", "values": "text"}

Progress = Callable[[int, int], None]


class CatalogueError(RunError):
    """The catalogue can't fulfil a request; the text gives the reason and a correct form."""


@dataclass
class Refreshed:
    """Result of a refresh.

    Attributes:
        read: number of runs that were read.
        missing: known folders without a run.
        problems: reasons why runs, or parts of them, can't be read.
    """

    read: int = 0
    missing: int = 0
    problems: list[str] = field(default_factory=list)


class Catalogue:
    """The runs of this machine. Open it, call `refresh`, then query it."""

    def __init__(self, state: Path | None = None) -> None:
        """Open the catalogue, or create one.

        Args:
            state: the state directory, if not the default.
        """
        self.state = state_directory() if state is None else state
        self.warning = ""
        """Why the index is kept in memory only, if it can't be written; empty otherwise."""
        path = self.state / INDEX_NAME
        try:
            make_state_directory(self.state)
            try:
                self._connection = _opened(str(path))
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise  # a folder that can't be written, a full disk: not an error of the index
                _remove(path)  # damaged: all of its content is in the runs
                self._connection = _opened(str(path))
        except (OSError, sqlite3.OperationalError) as error:
            self.warning = f"{path}: can't be written ({error}); the runs are read anew each time"
            self._connection = _opened(":memory:")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._connection.close()

    def refresh(self, progress: Progress | None = None, *, anew: bool = False) -> Refreshed:
        """Read the runs that were written since they were last read.

        Args:
            progress: called with the number of runs read so far, and their total.
            anew: read all runs, and remove missing ones from the index.

        Raises:
            CatalogueError: the list of runs or the index can't be read or written.
        """
        found = Refreshed()
        try:
            stamps = {} if anew else dict(self._connection.execute("select path, stamp from source").fetchall())
            folders = {str(path): _stamp(path) for path in dict.fromkeys((*known(self.state), *map(Path, stamps)))}
            changed = [path for path, stamp in folders.items() if stamp and stamp != stamps.get(path)]
            with self._transaction():
                if anew:
                    self._forget_all()
                for path, stamp in folders.items():
                    if not stamp and path in stamps:
                        self._connection.execute("update source set missing = 1, stamp = '' where path = ?", [path])
                for number, path in enumerate(changed, start=1):
                    if progress is not None:
                        progress(number, len(changed))
                    self._read(path, folders[path])
            found.read = len(changed)
            found.missing = sum(not stamp for path, stamp in folders.items() if path in stamps)
            query = "select problem from source where problem != '' and not missing order by path"
            found.problems = [row[0] for row in self._connection.execute(query)]
        except (OSError, sqlite3.Error) as error:
            raise CatalogueError(
                f"{self.state}: the catalogue can't be brought up to date ({error}); mend that, or name another state "
                "directory with --state"
            ) from None
        return found

    def rows(self, table: str, where: str = "1", values: Sequence[Any] = (), order: str = "") -> list[Row]:
        """Rows of a table ('run' or 'pour') that satisfy a condition, with the columns of `TABLES`."""
        columns = TABLES[table]
        names = ", ".join(f"{table}.{column.name}" for column in columns)
        query = f"select {names} from {table} where {where} {f'order by {order}' if order else ''}"
        rows = self._connection.execute(query, values).fetchall()
        found = [{c.name: _read_value(c, value) for c, value in zip(columns, row, strict=True)} for row in rows]
        if table == "run":
            for row in found:
                row["state"] = _state_now(row)
        return found

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._connection.execute("begin immediate")
        try:
            yield
        except BaseException:
            self._connection.execute("rollback")
            raise
        self._connection.execute("commit")

    def _read(self, path: str, stamp: str) -> None:
        read = read_run(Path(path))
        self._connection.execute("savepoint one_run")
        try:
            self._enter(path, stamp, read)
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            if isinstance(error, sqlite3.OperationalError):
                raise  # a full disk, a locked index: not an error of the run
            # Its content doesn't fit the columns: it is damaged, or exceeds the limits of SQLite.
            self._connection.execute("rollback to one_run")
            problem = f"{path}: its journal has values that can't be entered ({error}); see `decant runs check`"
            self._enter(path, stamp, unreadable(Path(path), problem))
        finally:
            self._connection.execute("release one_run")

    def _enter(self, path: str, stamp: str, read: RunRead) -> None:
        for table in ("run", "pour", "source"):
            self._connection.execute(f"delete from {table} where path = ?", [path])
        self._drop_previous_folder(read.run)
        self._insert("run", [read.run])
        self._insert("pour", read.pours)
        self._connection.execute("insert into source values (?, ?, 0, ?)", [path, stamp, read.problem])

    def _drop_previous_folder(self, run: Row) -> None:
        """Remove the former folder of a run that was moved; a run is identified by its name and its start."""
        query = """select path from run join source using (path) where run = ? and begun = ? and missing"""
        for (path,) in self._connection.execute(query, [run.get("run"), run.get("begun")]).fetchall():
            for table in ("run", "pour", "source"):
                self._connection.execute(f"delete from {table} where path = ?", [path])

    def _forget_all(self) -> None:
        for table in ("run", "pour", "source"):
            self._connection.execute(f"delete from {table}")

    def _insert(self, table: str, rows: Sequence[Row]) -> None:
        columns = TABLES[table]
        query = f"insert into {table} values ({', '.join('?' * len(columns))})"
        written = [[_written(column, row.get(column.name)) for column in columns] for row in rows]
        self._connection.executemany(query, written)


def _opened(path: str) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, timeout=10.0, check_same_thread=False)
    try:
        connection.execute("pragma journal_mode = wal")
        if connection.execute("pragma user_version").fetchone()[0] != FORMAT:
            _lay_out(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _lay_out(connection: sqlite3.Connection) -> None:
    script = ["begin immediate"]
    for table, columns in TABLES.items():
        declared = ", ".join(f"{column.name} {_SQL[column.type]}" for column in columns)
        script += [f"drop table if exists {table}", f"create table {table} ({declared}) strict"]
        script.append(f"create index {table}_by_path on {table} (path)")
    script.append("drop table if exists source")
    script.append("create table source (path text primary key, stamp text, missing integer, problem text) strict")
    script += [f"pragma user_version = {FORMAT}", "commit"]
    connection.executescript("; ".join(script))


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def _stamp(run: Path) -> str:
    """A text that changes with every write to a run; empty if there is no run."""
    marks = []
    for name in (JOURNAL_NAME, f"{JOURNAL_NAME}-wal", REMARKS_NAME):
        try:
            found = (run / name).stat()
            marks.append(f"{found.st_mtime_ns}:{found.st_size}")
        except OSError:
            if name == JOURNAL_NAME and not has_begun(run / JOURNAL_NAME):
                return ""
            marks.append("")
    return " ".join(marks)


def _written(column: Column, value: Any) -> Any:
    if column.type in ("texts", "values"):
        return None if value is None else json.dumps(value, ensure_ascii=False)
    return value


def _read_value(column: Column, value: Any) -> Any:
    if column.type in ("texts", "values"):
        return ([] if column.type == "texts" else {}) if value is None else json.loads(value)
    return value


def _state_now(run: Row) -> str:
    """The state in the journal; 'interrupted' for an active state if no process holds the journal."""
    state = str(run["state"] or "")
    busy = state not in ("", UNREADABLE, *RESTING)
    return "interrupted" if busy and not _held(Path(run["path"]) / JOURNAL_NAME) else state


def _held(journal: Path) -> bool:
    """Whether a process holds a journal's lock, from the system's list of locks; trying the lock would block others."""
    try:
        lock = journal.with_suffix(".lock").stat().st_ino
        lines = Path("/proc/locks").read_text(encoding="ascii").splitlines()
    except OSError:
        return True  # unknown: the state in the journal is used
    return any(len(part := line.split()) > 5 and part[-3].rpartition(":")[2] == str(lock) for line in lines)
