"""The account of the source vessels: how much liquid each one holds, with its uncertainty, across runs and restarts.

`SourceAccount` is a small SQLite file in the state directory. Its entries are absolute contents: after a filling, after
a weighing, and after every dose. The last entry of a source counts. A dose that has begun and has no outcome makes the
content uncertain by its amount.

    account = SourceAccount.open()
    account.weigh("virtual/beaker/water", 0.412, 1e-4)
    account.content("virtual/beaker/water")

`SourceAccount.follow` is a subscriber of a run (`orchestrator.runs.events`). Entries have a key, so that the events of
a resumed run are written once.
"""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from orchestrator.catalogue.run_registry import make_state_directory, state_directory
from orchestrator.requests import Failed, Outcome, Pour, Poured
from orchestrator.runs.events import CampaignOpened, Event, RequestFinished, RequestStarted
from orchestrator.strategies.campaign_plan import DispensePlan
from orchestrator.strategies.dispense import KnownSource, left_after

FILE_NAME = "sources.sqlite"

EntryKind = Literal["filled", "weighed", "begun", "dosed", "unknown"]

_SCHEMA = """
create table if not exists entries (
    id integer primary key autoincrement, key text unique not null, source text not null, time real not null,
    kind text not null, mass real not null, deviation real not null, knowledge text);
create index if not exists by_source on entries (source, id);
"""

PATIENCE = 1.0
"""Longest wait for another process that writes [s]."""


@dataclass(frozen=True)
class SourceEntry:
    """One entry of the account.

    Attributes:
        source: name of the source: laboratory, vessel and liquid.
        time: seconds since 1970.
        kind: 'filled', 'weighed', 'begun' (a dose), 'dosed', or 'unknown' (a dose whose amount is not known).
        mass, deviation: content after it, and its standard deviation [kg].
        knowledge: fields of `actors.interfaces.DoseKnowledge`; None if there are none.
    """

    source: str
    time: float
    kind: EntryKind
    mass: float
    deviation: float
    knowledge: dict[str, Any] | None = None


class SourceAccount:
    """The account in one file.

    Args:
        path: of the file; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @classmethod
    def open(cls) -> SourceAccount:
        """The account of this machine, in its state directory.

        Raises:
            OSError: the state directory can't be made.
        """
        folder = state_directory()
        make_state_directory(folder)
        return cls(folder / FILE_NAME)

    # ---- reading

    def content(self, source: str) -> SourceEntry | None:
        """The last entry of a source; None if there is none, or if its content is unknown.

        Raises:
            OSError: the file can't be read.
        """
        found = self.history(source, 1)
        return None if not found or found[0].kind == "unknown" else found[0]

    def history(self, source: str, count: int = 100) -> list[SourceEntry]:
        """The last entries of a source, the newest first.

        Raises:
            OSError: the file can't be read.
        """
        return self._entries("where source = ? order by id desc limit ?", (source, count))

    def all(self) -> list[SourceEntry]:
        """The last entry of every source, by name.

        Raises:
            OSError: the file can't be read.
        """
        last = "where id in (select max(id) from entries group by source) order by source"
        return self._entries(last, ())

    def _entries(self, condition: str, values: tuple[Any, ...]) -> list[SourceEntry]:
        if not self._path.is_file():
            return []
        with self._connection() as connection:
            rows = connection.execute(
                f"select source, time, kind, mass, deviation, knowledge from entries {condition}", values
            ).fetchall()
        return [
            SourceEntry(source, moment, kind, mass, deviation, None if text is None else json.loads(text))
            for source, moment, kind, mass, deviation, text in rows
        ]

    def known(self, plan: DispensePlan) -> dict[str, KnownSource]:
        """Content and knowledge of a series' sources, by the names of the vessels.

        Where the series begins with full sources, only the knowledge counts. The lag of the balance is measured again.

        Raises:
            OSError: the file can't be read.
        """
        found = {}
        for name in plan.sources:
            entry = self.content(plan.tracked(name))
            if plan.as_left and entry is not None:
                knowledge = None if entry.knowledge is None else {**entry.knowledge, "lag": None}
                found[name] = KnownSource(mass=entry.mass, deviation=entry.deviation, knowledge=knowledge)
        return found

    # ---- writing

    def fill(self, source: str, mass: float, deviation: float, *, key: str = "") -> None:
        """A source was filled to a content [kg].

        Raises:
            OSError: the file can't be written.
        """
        self._write(source, "filled", mass, deviation, self._knowledge(source), key)

    def weigh(self, source: str, mass: float, deviation: float, *, key: str = "") -> None:
        """The content of a source was weighed [kg]: it replaces the estimate.

        Raises:
            OSError: the file can't be written.
        """
        self._write(source, "weighed", mass, deviation, self._knowledge(source), key)

    def begin(self, source: str, pour: Pour, *, key: str) -> None:
        """A dose begins: until it has an outcome, between nothing and all of its amount may be gone.

        Raises:
            OSError: the file can't be written.
        """
        assert pour.dose is not None
        if (of := pour.dose.source) is None:
            return
        if of.fill:
            self.fill(source, of.mass, of.deviation, key=f"{key} filled")
        half = 0.5 * pour.dose.amount
        deviation = math.hypot(of.deviation, half)
        self._write(source, "begun", of.mass - half, deviation, self._knowledge(source), f"{key} begun")

    def finish(self, source: str, pour: Pour, outcome: Outcome, *, key: str) -> None:
        """A dose has an outcome.

        Raises:
            OSError: the file can't be written.
        """
        assert pour.dose is not None
        left = left_after(pour.dose, outcome)
        if left is None:
            self._write(source, "unknown", 0.0, 0.0, self._knowledge(source), key)
        else:
            self._write(source, "dosed", left.mass, left.deviation, left.knowledge, key)

    def follow(self, plan: DispensePlan) -> Callable[[Event], None]:
        """A subscriber that writes the doses of a run.

        Args:
            plan: of its series.
        """
        run = ""

        def subscriber(event: Event) -> None:
            nonlocal run
            match event:
                case CampaignOpened():
                    run = str(event.run_directory.resolve())
                case RequestStarted(request=Pour() as pour) if pour.dose is not None and pour.dose.source is not None:
                    self.begin(plan.tracked(pour.dose.source.name), pour, key=f"{run} {event.stage} {pour.number}")
                case RequestFinished(request=Pour() as pour, outcome=Poured() | Failed() as outcome) if (
                    pour.dose is not None and pour.dose.source is not None
                ):
                    name = plan.tracked(pour.dose.source.name)
                    self.finish(name, pour, outcome, key=f"{run} {event.stage} {pour.number}")

        return subscriber

    def _knowledge(self, source: str) -> dict[str, Any] | None:
        found = self.history(source, 1)
        return found[0].knowledge if found else None

    def _write(
        self,
        source: str,
        kind: EntryKind,
        mass: float,
        deviation: float,
        knowledge: dict[str, Any] | None,
        key: str,
    ) -> None:
        now = time.time()
        text = None if knowledge is None else json.dumps(knowledge)
        with self._connection() as connection:
            connection.executescript(_SCHEMA)
            connection.execute(
                "insert or ignore into entries (key, source, time, kind, mass, deviation, knowledge) "
                "values (?, ?, ?, ?, ?, ?, ?)",
                (key or f"{source} {kind} {time.time_ns()}", source, now, kind, max(mass, 0.0), deviation, text),
            )

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(sqlite3.connect(self._path, timeout=PATIENCE)) as connection, connection:
                yield connection
        except sqlite3.Error as error:
            raise OSError(f"{self._path}: {error}") from error
