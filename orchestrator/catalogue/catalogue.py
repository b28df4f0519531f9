"""The catalogue of this machine's runs: one SQLite file with the tables `run`, `pour`, `posterior` and `note`.

- `Catalogue` serves the command line, the HTTP API and the library. The daemon's client has the same queries for
  another machine.
- The file is an index over the runs' folders and may be deleted at any time. `Catalogue.refresh` reads the runs that
  changed since they were last read, and all runs if another version of Decant has written the index.
- Several processes may use it at the same time: runs are read without a lock, and each is entered in a transaction.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

from orchestrator.catalogue.annotations import ANNOTATIONS_NAME, add_note
from orchestrator.catalogue.queries import condition_sql
from orchestrator.catalogue.run_reading import TABLES, UNREADABLE, Column, RunRows, read_run, unreadable
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import has_begun
from orchestrator.records.run_record import Row
from orchestrator.records.run_registry import known, make_state_directory, state_directory
from orchestrator.records.states import RESTING
from sim_engine.settings.plugin_registry import DISTRIBUTION

if TYPE_CHECKING:
    from orchestrator.campaigns.campaign_prior import KnownPosterior, PosteriorSource
    from orchestrator.catalogue.control_charts import LaboratoryChart
    from orchestrator.catalogue.known_posteriors import PosteriorAge

INDEX_NAME = "catalogue.sqlite"

FORMAT = 8
"""Version of the index's content. An index of another format, or of another version of Decant, is made again."""


class CatalogueError(RunError):
    """The catalogue can't fulfil a request; the text gives the reason and a correct form."""


class NoSuchRunError(CatalogueError):
    """The catalogue has no such run."""


def posterior_source() -> PosteriorSource:
    """The posteriors of this machine, for a campaign that is being loaded."""
    from orchestrator.campaigns.campaign_prior import PosteriorSource
    from orchestrator.runs.run_folder import simulator_version

    def every() -> list[KnownPosterior]:
        with Catalogue() as catalogue:
            catalogue.refresh()
            return catalogue.posteriors()

    def of_run(name: str) -> KnownPosterior:
        with Catalogue() as catalogue:
            catalogue.refresh()
            return catalogue.posterior(name)

    def stale(posterior: KnownPosterior) -> str:
        with Catalogue() as catalogue:
            age = catalogue.posterior_ages([posterior]).get(posterior.posterior)
        return "" if age is None else age.text

    return PosteriorSource(simulator_version(), every, of_run, stale)


@dataclass
class Refreshed:
    """Result of a refresh.

    Attributes:
        missing: number of runs whose folders are gone since the last refresh.
        problems: reasons why runs can't be read.
    """

    missing: int = 0
    problems: list[str] = field(default_factory=list)


class Catalogue:
    """The catalogue of this machine, with JSON-ready results. Open it, call `refresh`, then query it.

    Every query may raise RunError, whose text gives the reason. Conditions are those of `queries.condition_sql`, and
    'limit', the maximum number of rows. A run is named by its folder, the folder's name, or an unambiguous prefix of
    the name.

    Args:
        state: the state directory, if not the default.

    Attributes:
        warning: why the index is kept in memory only, if it can't be written; empty otherwise.
    """

    def __init__(self, state: Path | None = None) -> None:
        self.state = state_directory() if state is None else state
        self.warning = ""
        path = self.state / INDEX_NAME
        try:
            make_state_directory(self.state)
            try:
                self._connection = _opened(str(path))
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise  # a folder that can't be written, a full disk: not an error of the index
                for suffix in ("", "-wal", "-shm"):  # damaged: all of its content is in the runs
                    path.with_name(path.name + suffix).unlink(missing_ok=True)
                self._connection = _opened(str(path))
        except (OSError, sqlite3.OperationalError) as error:
            self.warning = f"{path}: can't be written ({error}); the runs are read again each time"
            self._connection = _opened(":memory:")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._connection.close()

    def refresh(self, progress: Callable[[int, int], None] | None = None) -> Refreshed:
        """Read the runs that were written since they were last read, and remove those whose folders are gone.

        Args:
            progress: called with the number of runs read so far, and their total.

        Raises:
            CatalogueError: the list of runs or the index can't be read or written.
        """
        try:
            stamps = dict(self._connection.execute("select path, stamp from run").fetchall())
            folders = {str(path): _stamp(path) for path in dict.fromkeys((*known(self.state), *map(Path, stamps)))}
            changed = [path for path, stamp in folders.items() if stamp and stamp != stamps.get(path)]
            missing = [path for path, stamp in folders.items() if not stamp and path in stamps]
            self._connection.executemany("delete from run where path = ?", [[path] for path in missing])
            for number, path in enumerate(changed, start=1):
                if progress is not None:
                    progress(number, len(changed))
                self._read(path, folders[path])
            query = "select reason from run where state = ? order by path"
            problems = [row[0] for row in self._connection.execute(query, [UNREADABLE])]
        except (OSError, sqlite3.Error) as error:
            raise CatalogueError(
                f"{self.state}: the catalogue can't be brought up to date ({error}); correct that, or name another "
                "state directory with --state"
            ) from None
        return Refreshed(len(missing), problems)

    def runs(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Runs, the newest first; see `run_reading.RUNS`. Raises ValueError for an invalid condition."""
        return self._rows("run", *condition_sql("run", conditions), "begun desc, path", conditions.get("limit"))

    def pours(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Pours, the oldest first; see `run_reading.POURS`. Raises ValueError for an invalid condition."""
        newest = self._rows(
            "pour", *condition_sql("pour", conditions), "time desc, path desc, id desc", conditions.get("limit")
        )
        return newest[::-1]

    def charts(self, conditions: Mapping[str, Any]) -> list[LaboratoryChart]:
        """The control charts of all laboratories, or of the pours that the conditions hold for.

        They begin again with a note on a run that starts with 'new limits'.
        """
        from orchestrator.catalogue.control_charts import COLUMNS, NEW_LIMITS, charts_of  # numpy

        where, values = condition_sql("pour", conditions)
        names = ("laboratory", "mode", "path", "time", *COLUMNS)
        laboratory = "(select coalesce(laboratory, '') from run where run.path = pour.path) as laboratory"
        query = f"select {', '.join((laboratory, *names[1:]))} from pour where outcome = 'weighed' and {where}"
        rows = self._connection.execute(f"{query} order by time, id", values).fetchall()
        query = "select laboratory, mode, max(time) from note join run using (path) where lower(note.text) like ?"
        noted = self._connection.execute(f"{query} group by laboratory, mode", [f"{NEW_LIMITS}%"]).fetchall()
        begun = {(laboratory, mode): time for laboratory, mode, time in noted}
        pours = (dict(zip(names, row, strict=True)) for row in rows if row[3] is not None)
        return charts_of([pour for pour in pours if pour["time"] >= begun.get((pour["laboratory"], pour["mode"]), 0.0)])

    def run(self, name: str) -> Row:
        """One run, with its notes (time, by, text) and its pours under 'list_of_pours'."""
        row = self._find(name)
        notes = self._connection.execute("select time, by, text from note where path = ?", [row["path"]]).fetchall()
        written = [dict(zip(("time", "by", "text"), note, strict=True)) for note in notes]
        return {**row, "notes": written, "list_of_pours": self.pours({"run": row["path"]})}

    def note(self, name: str, text: str, by: str | None = None) -> Row:
        """Add a note to a run; returns 'run' and 'notes'.

        Args:
            by: author of the note; the user of this process unless given.
        """
        row = self._find(name)
        notes = add_note(Path(row["path"]), text, by)
        return {"run": row["run"], "notes": [note.model_dump() for note in notes]}

    def posteriors(self) -> list[KnownPosterior]:
        """The posteriors of all calibrations, the oldest first, and then the imported ones of other runs.

        Raises:
            RunError, OSError: an imported one can't be read.
        """
        from orchestrator.campaigns.campaign_prior import KnownPosterior
        from orchestrator.catalogue.known_posteriors import imported  # slow import

        query = "select content from posterior join run using (path) order by begun, path"
        measured_here = [KnownPosterior.model_validate_json(row[0]) for row in self._connection.execute(query)]
        names = {posterior.posterior for posterior in measured_here}
        return [*measured_here, *(posterior for posterior in imported(self.state) if posterior.posterior not in names)]

    def posterior(self, name: str) -> KnownPosterior:
        """The posterior of a run, or an imported one.

        Raises:
            RunError: there is no such run, or it has none; the text gives the reason.
        """
        from orchestrator.catalogue.known_posteriors import imported, posterior_of

        try:
            return posterior_of(Path(self._find(name)["path"]))
        except NoSuchRunError:
            for entry in imported(self.state):
                if entry.posterior == name:
                    return entry
            raise

    def posterior_ages(self, posteriors: Iterable[KnownPosterior]) -> dict[str, PosteriorAge]:
        """The ages of posteriors by name; imported ones have none."""
        from orchestrator.catalogue.known_posteriors import age_of  # slow import

        made = {run["run"]: run["ended"] for run in self.runs({})}
        charts = self.charts({})
        return {p.posterior: age_of(p, made[p.posterior], charts) for p in posteriors if made.get(p.posterior)}

    def _find(self, name: str) -> Row:
        path = str(Path(name).absolute())
        runs = self._rows("run", "path = ?", [path])
        runs = runs or self._rows("run", "run = ?", [name])
        runs = runs or self._rows("run", "substr(run, 1, length(?)) = ?", [name, name], "run")
        if len(runs) == 1:
            return runs[0]
        if not runs:
            raise NoSuchRunError(
                f"{name}: no such run in the catalogue; `decant runs` lists the newest, `decant runs add FOLDER` "
                "enters runs that it doesn't know"
            )
        places = "\n  ".join(row["path"] for row in runs[:10])
        raise CatalogueError(f"{name}: {len(runs)} runs are called so; name one by its folder:\n  {places}")

    def _rows(
        self, table: str, where: str, values: Sequence[Any], order: str = "path", limit: int | None = None
    ) -> list[Row]:
        columns = TABLES[table]
        names = ", ".join(column.name for column in columns)
        query = f"select {names} from {_SOURCES[table]} where {where} order by {order} limit ?"
        rows = self._connection.execute(query, [*values, -1 if limit is None else limit]).fetchall()
        return [{c.name: _value(c, stored) for c, stored in zip(columns, row, strict=True)} for row in rows]

    def _read(self, path: str, stamp: str) -> None:
        read = read_run(Path(path))
        try:
            self._enter(path, stamp, read)
        except (sqlite3.Error, OverflowError, TypeError, ValueError) as error:
            if isinstance(error, sqlite3.OperationalError):
                raise  # a full disk, a locked index: not an error of the run
            # Its content doesn't fit the columns: it is damaged, or exceeds the limits of SQLite.
            problem = f"{path}: its journal has values that can't be entered ({error}); see `decant runs check`"
            self._enter(path, stamp, unreadable(Path(path), problem, read.notes))

    def _enter(self, path: str, stamp: str, read: RunRows) -> None:
        """Replace the rows of a run."""
        run = read.run
        with _transaction(self._connection):
            self._connection.execute("delete from run where path = ?", [path])
            self._insert("run", [[*_stored("run", run), stamp]])
            self._insert("pour", [_stored("pour", pour) for pour in read.pours])
            self._insert("posterior", [[path, read.posterior]] if read.posterior else [])
            self._insert("note", [[path, note.time, note.by, note.text] for note in read.notes])

    def _insert(self, table: str, rows: Sequence[Sequence[Any]]) -> None:
        if rows:
            self._connection.executemany(f"insert into {table} values ({', '.join('?' * len(rows[0]))})", rows)


_TYPES = {"text": "text", "texts": "text", "integer": "integer", "number": "real", "time": "real", "values": "text"}
_NOTES = "notes"
"""The column of runs that is a table of its own."""

_SOURCES = {"run": "runs", "pour": "pour"}
"""Sources of the rows of `TABLES`. The view `runs` adds notes and the present state to the table."""

_BELONGS = "path text references run on delete cascade"


def _layout() -> Iterator[str]:
    """The statements that create the tables."""
    layout = {name: [c for c in columns if c.name != _NOTES] for name, columns in TABLES.items()}
    declared = {name: ", ".join(f"{c.name} {_TYPES[c.type]}" for c in columns) for name, columns in layout.items()}
    yield "drop view if exists runs"
    for table in ("tag", "note", "posterior", "pour", "run"):  # earlier versions have tags
        yield f"drop table if exists {table}"
    yield f"create table run ({declared['run'].replace('path text', 'path text primary key')}, stamp text) strict"
    yield f"create table pour ({declared['pour'].replace('path text', _BELONGS)}) strict"
    yield f"create table posterior ({_BELONGS}, content text) strict"
    yield f"create table note ({_BELONGS}, time real, by text, text text) strict"
    for table in ("pour", "posterior", "note"):
        yield f"create index {table}_by_path on {table} (path)"
    columns = [f"state_now(state, path) as {c.name}" if c.name == "state" else c.name for c in layout["run"]]
    columns.append(f"(select json_group_array(text) from note where note.path = run.path) as {_NOTES}")
    yield f"create view runs as select {', '.join(columns)} from run"


def _opened(path: str) -> sqlite3.Connection:
    connection = sqlite3.connect(path, isolation_level=None, timeout=10.0, check_same_thread=False)
    try:
        connection.create_function("state_now", 2, _state_now)
        # A power cut may lose the latest rows: the next refresh reads those runs again.
        connection.executescript("pragma journal_mode = wal; pragma synchronous = normal; pragma foreign_keys = on")
        if not _has_format(connection):
            with _transaction(connection):
                if not _has_format(connection):  # another process may have created the tables
                    for statement in (*_layout(), f"pragma user_version = {_user_version()}"):
                        connection.execute(statement)
    except BaseException:
        connection.close()
        raise
    return connection


def _has_format(connection: sqlite3.Connection) -> bool:
    return bool(connection.execute("pragma user_version").fetchone()[0] == _user_version())


def _user_version() -> int:
    """A number that differs between formats, and between versions of Decant, which may read more from a run."""
    return crc32(f"{FORMAT} {version(DISTRIBUTION)}".encode()) >> 1  # SQLite's is signed


@contextlib.contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("begin immediate")
    try:
        yield
    except BaseException:
        connection.execute("rollback")
        raise
    connection.execute("commit")


def _stamp(run: Path) -> str:
    """A text that changes with every write to a run; empty if there is no run."""
    marks = []
    for name in (JOURNAL_NAME, f"{JOURNAL_NAME}-wal", ANNOTATIONS_NAME):
        try:
            status = (run / name).stat()
            marks.append(f"{status.st_mtime_ns}:{status.st_size}")
        except OSError:
            if name == JOURNAL_NAME and not has_begun(run / JOURNAL_NAME):
                return ""
            marks.append("")
    return " ".join(marks)


def _stored(table: str, row: Row) -> list[Any]:
    """The values of a row, without those that are tables of their own."""
    stored = []
    for column in TABLES[table]:
        if column.name != _NOTES:
            value = row.get(column.name)
            is_json = column.type in ("texts", "values") and value is not None
            stored.append(json.dumps(value, ensure_ascii=False) if is_json else value)
    return stored


def _value(column: Column, stored: Any) -> Any:
    if column.type in ("texts", "values"):
        return ([] if column.type == "texts" else {}) if stored is None else json.loads(stored)
    return stored


def _state_now(state: str | None, path: str) -> str:
    """The state in the journal; 'interrupted' for an active state if no process holds the journal."""
    busy = state not in (None, "", UNREADABLE, *RESTING)
    return "interrupted" if busy and not _held(Path(path) / JOURNAL_NAME) else state or ""


def _held(journal: Path) -> bool:
    """Whether a process holds a journal's lock, from the system's list of locks; trying the lock would block others."""
    try:
        lock = journal.with_suffix(".lock").stat().st_ino
        lines = Path("/proc/locks").read_text(encoding="ascii").splitlines()
    except OSError:
        return True  # unknown: the state in the journal is used
    return any(len(fields := line.split()) > 5 and fields[-3].rpartition(":")[2] == str(lock) for line in lines)
