"""The account of vessels: the content of each one with its uncertainty, across doses, campaigns, orders and restarts.

`VesselAccount` is a small SQLite file in the state directory. Its entries are append-only and state the content after a
filling, a weighing or a pour; the last entry of a vessel counts. A pour that has begun and has no outcome makes the
content uncertain by its amount; one with unknown outcome makes it unknown until the vessel is weighed.

    account = VesselAccount.open()
    account.weigh("virtual/beaker", 0.412, 1e-4, liquid="water")
    account.content("virtual/beaker")

`composition` has the liquids of a vessel since it was empty, each with its mass as it was dosed.

The command line, the library, runs and the daemon share the file. A vessel of the station has its id as its name, the
source of a campaign 'LABORATORY/VESSEL'. `VesselAccount.follow` is a subscriber of a run
(`orchestrator.records.events`). Entries have a key, so that the events of a resumed run are written once.

Limitations: liquids that were poured together become a mixture. Evaporation is not estimated. Of a campaign, the doses
of `dispense` are in the account; the pourer of other campaigns is refilled by an operator.
"""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from actors.interfaces import LaboratoryError
from orchestrator.learning.campaign_plan import DispensePlan
from orchestrator.learning.dispense import ENOUGH, KnownSource, left_after
from orchestrator.learning.requests import Failed, Outcome, Pour, Poured
from orchestrator.learning.stage_result import DOSE, entered_by_hand
from orchestrator.records.events import CampaignOpened, Event, RequestFinished, RequestStarted
from orchestrator.records.run_registry import make_state_directory, state_directory
from sim_engine.errors import InvalidArgumentError
from sim_engine.settings.quantity import LARGEST
from sim_engine.vessel.vessel import build_vessel

FILE_NAME = "vessels.sqlite"

MIXTURE = "mixture"
"""Liquid of a vessel that several liquids were poured into."""

EntryKind = Literal["filled", "weighed", "begun", "poured", "unknown"]

_SCHEMA = """
create table if not exists entry (
    id integer primary key, key text unique not null, vessel text not null, t real not null, kind text not null,
    mass real, deviation real not null, liquid text not null, pour text not null, by text not null,
    note text not null, weighed real, knowledge text check (knowledge is null or json_valid(knowledge))
) strict;
create index if not exists entry_by_vessel on entry (vessel, id);
create table if not exists stand (
    id integer primary key, vessel text not null, t real not null, place text, by text not null, note text not null
) strict;
create table if not exists component (
    id integer primary key, vessel text not null, t real not null, liquid text not null, mass real,
    deviation real not null, source text not null
) strict;
create trigger if not exists entry_is_never_changed before update on entry begin
    select raise(abort, 'account entries are append-only'); end;
create trigger if not exists entry_is_never_deleted before delete on entry begin
    select raise(abort, 'account entries are append-only'); end;
"""

LATEST = "id in (select max(id) from stand group by vessel)"

LOCK_TIMEOUT = 1.0
"""Longest wait for another process that writes [s]."""


class ContentOut(BaseModel):
    """Content of a vessel."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    mass_g: float | None
    """Null if a pour with unknown outcome has changed it."""

    deviation_g: float
    liquid: str
    since: float
    pour: str
    """The pour that changed it last: its caller's id, or run and number; '' after a weighing."""

    weighed: float | None
    """Time of the last weighing."""


class AccountOut(BaseModel):
    """One entry of a vessel's account."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    t: float
    vessel: str
    kind: EntryKind
    mass_g: float | None
    """Content after it; null if it is unknown."""

    deviation_g: float
    liquid: str
    pour: str
    by: str
    note: str


@dataclass(frozen=True)
class VesselContent:
    """Content of a vessel after one entry of the account.

    Attributes:
        vessel: its name.
        time: of the entry, seconds since 1970.
        kind: 'filled', 'weighed', 'begun' (a pour), 'poured', or 'unknown' (a pour whose amount is not known).
        mass: [kg]; None if it is unknown.
        deviation: standard deviation of the mass [kg].
        liquid: name of the liquid, 'mixture', or '' if it is empty.
        pour: the pour that changed it; '' after a filling or weighing.
        by: who made the entry; '' for a run.
        note: for people.
        weighed: time of the last filling or weighing; None without one.
        knowledge: what doses have shown, fields of `actors.interfaces.DoseKnowledge`; None if there are none.
    """

    vessel: str
    time: float
    kind: EntryKind
    mass: float | None
    deviation: float
    liquid: str = ""
    pour: str = ""
    by: str = ""
    note: str = ""
    weighed: float | None = None
    knowledge: dict[str, Any] | None = None

    @property
    def content(self) -> ContentOut:
        """The content for programs."""
        return ContentOut(
            mass_g=None if self.mass is None else 1e3 * self.mass,
            deviation_g=1e3 * self.deviation,
            liquid=self.liquid,
            since=self.time,
            pour=self.pour,
            weighed=self.weighed,
        )

    @property
    def entry(self) -> AccountOut:
        """The entry for programs."""
        return AccountOut(
            t=self.time,
            vessel=self.vessel,
            kind=self.kind,
            mass_g=None if self.mass is None else 1e3 * self.mass,
            deviation_g=1e3 * self.deviation,
            liquid=self.liquid,
            pour=self.pour,
            by=self.by,
            note=self.note,
        )


@dataclass(frozen=True)
class VesselPlace:
    """Where a vessel stands after one entry of the account.

    Attributes:
        vessel: its name.
        time: of the entry, seconds since 1970.
        place: name of the place; None: UNKNOWN, since a motion with it has begun and not ended.
        by: who made the entry; '' for a run.
        note: for people, such as the motion that was under way.
        origin: the last place that was known; '' if none was.
    """

    vessel: str
    time: float
    place: str | None
    by: str = ""
    note: str = ""
    origin: str = ""

    @property
    def moving(self) -> bool:
        """Whether a motion with it has begun, and was not noted as interrupted."""
        return self.place is None and self.note.startswith(("the arm began to take it ", "the arm began to carry it "))

    @property
    def moving_text(self) -> str:
        """The same as `text`, while a campaign moves it: "in the gripper, from 'left' to 'pan'"."""
        if not self.moving:
            return self.text
        origin, (_, to, target) = f"from '{self.origin}'" if self.origin else "", self.note.partition(" to '")
        return ", ".join(filter(None, ("in the gripper", origin + to + target)))

    @property
    def text(self) -> str:
        """For tables: the place, or that it is unknown, and since which motion."""
        return self.place if self.place is not None else f"UNKNOWN ({self.note})" if self.note else "UNKNOWN"


@dataclass(frozen=True)
class Component:
    """One liquid of a mixture, as it was poured in.

    Attributes:
        liquid: its name; '' in the entry of an empty vessel, whose own mass it is.
        mass: [kg]; None: UNKNOWN, since a dose has begun and not been weighed, or an empty vessel that was not weighed.
        deviation: standard deviation of the mass [kg].
        source: vessel that it was poured from.
        time: of the entry, seconds since 1970.
    """

    liquid: str
    mass: float | None
    deviation: float
    source: str
    time: float


@dataclass(frozen=True)
class Transfer:
    """Masses that a pour has moved [kg], each with its standard deviation; None: unknown."""

    taken: tuple[float, float] | None
    received: tuple[float, float] | None


class VesselAccount:
    """The account in one file.

    Args:
        path: of the file; it need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @classmethod
    def open(cls, state: Path | None = None) -> VesselAccount:
        """The account in a state directory.

        Args:
            state: the directory; None: that of this machine's user.

        Raises:
            OSError: the state directory can't be made.
        """
        folder = state or state_directory()
        make_state_directory(folder)
        return cls(folder / FILE_NAME)

    # ---- reading

    def content(self, vessel: str) -> VesselContent | None:
        """The last entry of a vessel; None without any.

        Raises:
            OSError: the file can't be read.
        """
        entries = self.history(vessel, 1)
        return entries[0] if entries else None

    def history(self, vessel: str = "", count: int = 1000) -> list[VesselContent]:
        """The last entries of a vessel ('' for all), the newest first.

        Raises:
            OSError: the file can't be read.
        """
        return self._entries("where ? in ('', vessel) order by id desc limit ?", (vessel, count))

    def all(self) -> list[VesselContent]:
        """The last entry of every vessel, by name.

        Raises:
            OSError: the file can't be read.
        """
        return self._entries("where id in (select max(id) from entry group by vessel) order by vessel", ())

    def _entries(self, condition: str, values: tuple[Any, ...]) -> list[VesselContent]:
        if not self._path.is_file():
            return []
        with self._connection() as connection:
            return _read(connection, condition, values)

    def known(self, plan: DispensePlan) -> dict[str, KnownSource]:
        """Content and knowledge of a series' sources, by the names of the vessels.

        A source of unknown content, or with another liquid, is absent. If the series begins with full sources, all
        are. The lag of the balance is measured again.

        Raises:
            InvalidArgumentError: a source can't hold what was entered for it.
            OSError: the file can't be read.
        """
        sources: dict[str, KnownSource] = {}
        for name in plan.sources if plan.as_left else ():
            entry = self.content(plan.tracked(name))
            if entry is not None and entry.mass is not None and entry.liquid == plan.liquid(name):
                scene = next(scene for scene in plan.scenes if scene.pourer.name == name)
                full = scene.liquid.density * build_vessel(scene.pourer).capacity
                if entry.mass - ENOUGH * entry.deviation > 1.02 * full:
                    raise InvalidArgumentError(
                        f"{plan.tracked(name)}: holds {1e3 * entry.mass:.4g} g of {entry.liquid} by its account, and "
                        f"there is room for {1e3 * full:.4g} g; correct it: decant materials weigh {plan.tracked(name)}"
                        " 'MASS'"
                    )
                knowledge = None if entry.knowledge is None else {**entry.knowledge, "lag": None}
                sources[name] = KnownSource(mass=entry.mass, deviation=entry.deviation, knowledge=knowledge)
        return sources

    # ---- entries of people and devices

    def fill(
        self, vessel: str, mass: float, deviation: float, *, liquid: str = "", by: str = "", note: str = "",
        key: str = "",
    ) -> None:  # fmt: skip
        """A vessel was emptied and filled; see `weigh`."""
        self._set("filled", vessel, mass, deviation, liquid, by, note, key)

    def weigh(
        self, vessel: str, mass: float, deviation: float, *, liquid: str = "", by: str = "", note: str = "",
        key: str = "",
    ) -> None:  # fmt: skip
        """The content of a vessel was weighed: it replaces the estimate.

        Args:
            vessel: its name.
            mass: content, without the vessel [kg].
            deviation: its standard deviation [kg].
            liquid: name of the liquid; '' keeps the present one.
            by: who weighed it.
            note: for people.
            key: a second entry with the same key changes nothing; '' for a new one.

        Raises:
            InvalidArgumentError: a value is invalid, or the vessel was empty and the liquid is missing.
            OSError: the file can't be written.
        """
        self._set("weighed", vessel, mass, deviation, liquid, by, note, key)

    def _set(
        self, kind: EntryKind, vessel: str, mass: float, deviation: float, liquid: str, by: str, note: str, key: str
    ) -> None:
        _check_stated(mass, deviation)
        if mass == 0.0 and by and self.composition(vessel):
            self.add_component(vessel, "", None, 0.0)  # a person has emptied it, or brought another one
        with self._writing() as connection:
            before = _last(connection, vessel)
            held = liquid or ("" if before is None else before.liquid)
            if mass > 0.0 and not held:
                raise InvalidArgumentError(f"{vessel}: is empty so far; name the liquid that it was filled with")
            now = time.time()
            knowledge = None if before is None else before.knowledge
            liquid = held if mass > 0.0 else ""
            entry = VesselContent(
                vessel, now, kind, mass, deviation, liquid, by=by, note=note, weighed=now, knowledge=knowledge
            )
            _write(connection, key or f"{kind} {vessel} {time.time_ns()}", entry)

    def lose(self, vessel: str) -> None:
        """The content of a vessel is unknown from now on: a pour from it or into it has begun.

        Raises:
            OSError: the file can't be written.
        """
        with self._writing() as connection:
            before = _last(connection, vessel) or _empty(vessel)
            entry = replace(before, time=time.time(), kind="unknown", mass=None, deviation=0.0, pour="", note="")
            _write(connection, f"unknown {vessel} {time.time_ns()}", entry)

    def pour_by_hand(
        self, pour: str, source: str, receiver: str, mass: float, deviation: float, *, by: str = "", note: str = ""
    ) -> bool:
        """Enter a pour that a person has made and weighed, once.

        Args:
            pour: its id, chosen by the person.
            source, receiver: names of the vessels.
            mass: weighed [kg].
            deviation: its standard deviation [kg].
            by: who made it.
            note: for people.

        Returns:
            Whether it is a new entry; a second call with the same id changes nothing.

        Raises:
            InvalidArgumentError: the mass can't be meant, or the source holds less.
            OSError: the file can't be read or written.
        """
        _check_stated(mass, deviation)
        pour, held = f"by hand {pour}", self.content(source)
        if self._entries("where key = ?", (f"{pour} from",)):
            return False
        if held is not None and held.mass is not None:
            most = held.mass + ENOUGH * math.hypot(held.deviation, deviation)
            if mass > most:
                raise InvalidArgumentError(
                    f"{source}: holds {1e3 * held.mass:.4g} g by its account, and {1e3 * mass:.4g} g were poured from "
                    "it; weigh it first if it holds more"
                )
        self.transfer(pour, source, receiver, Transfer((mass, deviation), (mass, deviation)), by=by, note=note)
        return True

    def transfer(self, pour: str, source: str, receiver: str, moved: Transfer, *, by: str = "", note: str = "") -> None:
        """Enter a pour in the account of both vessels, once: a second call for the same pour changes nothing.

        Args:
            pour: its unique name.
            source, receiver: names of the vessels; a vessel without entries is empty.
            moved: masses.
            by: who ordered or made it.
            note: for people.

        Raises:
            OSError: the file can't be written.
        """
        with self._writing() as connection:
            held, target = (_last(connection, name) or _empty(name) for name in (source, receiver))
            mixed = held.liquid if target.liquid in ("", held.liquid) else MIXTURE
            for before, change, sign, liquid, role in (
                (held, moved.taken, -1.0, held.liquid, "from"),
                (target, moved.received, 1.0, mixed, "into"),
            ):
                kind, mass, deviation = _after(before, change, sign)
                entry = VesselContent(
                    before.vessel, time.time(), kind, mass, deviation, liquid, pour, by, note, before.weighed,
                    before.knowledge,
                )  # fmt: skip
                _write(connection, f"{pour} {role}", entry)

    # ---- compositions

    def composition(self, vessel: str) -> list[Component]:
        """The liquids in a vessel since it was empty, the first entry the empty vessel itself if that was entered.

        Raises:
            OSError: the file can't be read.
        """
        if not self._path.is_file():
            return []
        with self._connection() as connection:
            if not connection.execute("select 1 from sqlite_master where name = 'component'").fetchone():
                return []
            empty = "select coalesce(max(id), 0) from component where vessel = ? and liquid = ''"
            rows = connection.execute(
                f"select liquid, mass, deviation, source, t from component where vessel = ? and id >= ({empty}) "
                "order by id",
                (vessel, vessel),
            ).fetchall()
        latest = {row[0]: Component(*row) for row in rows}  # a begun dose is followed by its outcome
        return list(latest.values())

    def add_component(self, vessel: str, liquid: str, mass: float | None, deviation: float, source: str = "") -> None:
        """Enter a liquid that was poured into a vessel, or that a dose of it begins; '' for the empty vessel.

        Args:
            vessel: its name.
            liquid: its name. A second entry of a liquid replaces the first one.
            mass, deviation: [kg]; a mass of None is UNKNOWN.
            source: vessel that it was poured from.

        Raises:
            OSError: the file can't be written.
        """
        with self._writing() as connection:
            connection.execute(
                "insert into component (vessel, t, liquid, mass, deviation, source) values (?, ?, ?, ?, ?, ?)",
                (vessel, time.time(), liquid, mass, deviation, source),
            )

    # ---- places

    def places(self) -> dict[str, VesselPlace]:
        """Where vessels stand, by their names.

        Raises:
            OSError: the file can't be read.
        """
        if not self._path.is_file():
            return {}
        with self._connection() as connection:
            if not connection.execute("select 1 from sqlite_master where name = 'stand'").fetchone():
                return {}
            origin = "select place from stand as former where former.vessel = stand.vessel and place is not null"
            rows = connection.execute(
                f"select vessel, t, place, by, note, coalesce(({origin} order by id desc limit 1), '') from stand "
                f"where {LATEST}"
            ).fetchall()
        return {str(row[0]): VesselPlace(*row) for row in rows}

    def put(self, vessel: str, place: str | None, *, by: str = "", note: str = "") -> None:
        """Enter where a vessel stands; None for UNKNOWN. The entry is on disk when this returns.

        Args:
            vessel: 'LABORATORY/VESSEL'; places belong to the laboratory.
            place: name of the place; '' outside the cell.
            by: who corrected it; '' for a run.
            note: for people.

        Raises:
            InvalidArgumentError: another vessel of the laboratory stands there.
            OSError: the file can't be written.
        """
        laboratory = vessel.partition("/")[0]
        with self._writing() as connection:
            rows = connection.execute(f"select vessel, place from stand where {LATEST} and vessel != ?", (vessel,))
            for other, taken in rows.fetchall():
                if place and taken == place and str(other).partition("/")[0] == laboratory:
                    raise InvalidArgumentError(
                        f"{vessel}: {other} stands at '{place}' already; a place holds one vessel"
                    )
            connection.execute(
                "insert into stand (vessel, t, place, by, note) values (?, ?, ?, ?, ?)",
                (vessel, time.time(), place, by, note),
            )

    # ---- entries of runs

    def begin(self, vessel: str, pour: Pour, liquid: str, *, key: str) -> None:
        """A dose begins: until it has an outcome, between nothing and all of its amount may be gone.

        Raises:
            OSError: the file can't be written.
        """
        assert pour.dose is not None
        if (of := pour.dose.source) is None:
            return
        if of.fill:
            self.fill(vessel, of.mass, of.deviation, liquid=liquid, key=f"{key} filled")
        half = 0.5 * pour.dose.amount
        begun = KnownSource(mass=max(of.mass - half, 0.0), deviation=math.hypot(of.deviation, half))
        self._note_dose(vessel, "begun", begun, f"{key} begun", liquid)

    def finish(self, vessel: str, pour: Pour, outcome: Outcome, liquid: str, *, key: str) -> None:
        """A dose has an outcome.

        Raises:
            OSError: the file can't be written.
        """
        assert pour.dose is not None
        left = left_after(pour.dose, outcome)
        self._note_dose(vessel, "unknown" if left is None else "poured", left, key, liquid)

    def _note_dose(self, vessel: str, kind: EntryKind, left: KnownSource | None, key: str, liquid: str) -> None:
        with self._writing() as connection:
            before = _last(connection, vessel) or _empty(vessel)
            mass, deviation = (None, 0.0) if left is None else (left.mass, left.deviation)
            knowledge = before.knowledge if left is None or left.knowledge is None else left.knowledge
            name = key.rpartition("/")[2].removesuffix(" begun")  # without the folder of the run
            entry = VesselContent(
                vessel, time.time(), kind, mass, deviation, liquid, name, weighed=before.weighed, knowledge=knowledge
            )
            _write(connection, key, entry)

    def _note_cup(self, plan: DispensePlan, pour: Pour, outcome: Outcome | None, *, key: str) -> None:
        """A dose into a cup that a person put under the arm begins, or has an outcome; each is entered once."""
        dose = pour.dose
        assert dose is not None
        assert dose.source is not None
        cup, liquid, source = (
            f"{plan.laboratory}/{dose.cup}",
            plan.liquid(dose.source.name),
            plan.tracked(dose.source.name),
        )
        key = f"{key} into" if outcome is not None else f"{key} into begun"
        if self._entries("where key = ?", (key,)):
            return
        if outcome is None and dose.held is None:
            self.fill(cup, 0.0, 0.0, by="operator", note="empty, as asked for", key=f"{key} empty")
        mass, deviation = None, 0.0
        if isinstance(outcome, Poured):
            about = outcome.measurement.notes.get(DOSE, {})
            mass, deviation = float(about.get("received", outcome.measurement.delivered)), about.get("deviation", 0.0)
        elif isinstance(outcome, Failed) and outcome.kind == "invalid_action":  # nothing was poured
            mass = 0.0
        self.add_component(cup, liquid, mass, deviation, source)
        parts = [part for part in self.composition(cup) if part.liquid and part.mass != 0.0]
        content = None
        if all(part.mass is not None for part in parts):
            spread = math.hypot(*(part.deviation for part in parts))
            content = KnownSource(mass=math.fsum(part.mass or 0.0 for part in parts), deviation=spread)
        kind: EntryKind = "begun" if outcome is None else "unknown" if content is None else "poured"
        self._note_dose(cup, kind, content, key, parts[0].liquid if len(parts) == 1 else MIXTURE if parts else "")

    def follow(self, plan: DispensePlan, *, carried: bool = False) -> Callable[[Event], None]:
        """A subscriber that writes the doses of a run.

        Args:
            plan: of its series.
            carried: whether the arm carries the cups, whose contents the bench then enters, but for a dose that a
                person has entered.
        """
        run = ""

        def subscriber(event: Event) -> None:
            nonlocal run
            match event:
                case CampaignOpened():
                    run = str(event.run_directory.resolve())
                case RequestStarted(request=Pour() as pour) if pour.dose is not None and pour.dose.source is not None:
                    name = pour.dose.source.name
                    key = f"{run} {event.stage} {pour.number}"
                    self.begin(plan.tracked(name), pour, plan.liquid(name), key=key)
                    if pour.dose.cup and not carried:
                        self._note_cup(plan, pour, None, key=key)
                case RequestFinished(request=Pour() as pour, outcome=Poured() | Failed() as outcome) if (
                    pour.dose is not None and pour.dose.source is not None
                ):
                    name = pour.dose.source.name
                    key = f"{run} {event.stage} {pour.number}"
                    self.finish(plan.tracked(name), pour, outcome, plan.liquid(name), key=key)
                    entered = isinstance(outcome, Poured) and entered_by_hand(outcome.measurement)
                    if pour.dose.cup and (entered or not carried):
                        self._note_cup(plan, pour, outcome, key=key)

        return subscriber

    # ---- the file

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction: nobody else writes between the reading of a content and the entry that follows from it."""
        with self._connection() as connection:
            connection.executescript(_SCHEMA)
            connection.execute("begin immediate")
            yield connection

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(sqlite3.connect(self._path, timeout=LOCK_TIMEOUT)) as connection, connection:
                yield connection
        except sqlite3.Error as error:
            raise OSError(f"{self._path}: {error}") from error


class LaboratoryPlaces:
    """The account of one laboratory's vessels, for its bench; see `actors.places.PlaceRecord`.

    Args:
        account: the account.
        laboratory: name of the laboratory.
    """

    def __init__(self, account: VesselAccount, laboratory: str) -> None:
        self._account, self._prefix = account, f"{laboratory}/"

    def stands(self) -> dict[str, str | None]:
        """See `PlaceRecord.stands`."""
        with _writable():
            places = self._account.places()
        return {
            name.removeprefix(self._prefix): entry.place
            for name, entry in places.items()
            if name.startswith(self._prefix)
        }

    def put(self, vessel: str, place: str | None, note: str = "") -> None:
        """See `PlaceRecord.put`."""
        with _writable():
            self._account.put(self._prefix + vessel, place, note=note)

    def content(self, vessel: str, mass: float | None, deviation: float, liquid: str) -> None:
        """See `PlaceRecord.content`."""
        with _writable():
            if mass is None:
                self._account.lose(self._prefix + vessel)
            else:
                self._account.weigh(self._prefix + vessel, max(mass, 0.0), deviation, liquid=liquid)

    def held(self, vessel: str) -> tuple[float, float] | None:
        """See `PlaceRecord.held`."""
        with _writable():
            content = self._account.content(self._prefix + vessel)
        return None if content is None or content.mass is None else (content.mass, content.deviation)

    def unknown(self, vessel: str) -> bool:
        """See `PlaceRecord.unknown`."""
        with _writable():
            content = self._account.content(self._prefix + vessel)
        return content is not None and content.mass is None

    def composition(self, vessel: str) -> dict[str, tuple[float | None, float]]:
        """See `PlaceRecord.composition`."""
        with _writable():
            components = {c.liquid: (c.mass, c.deviation) for c in self._account.composition(self._prefix + vessel)}
            entered = self._account.content(self._prefix + vessel)
        if entered is not None and entered.by and entered.liquid and not any(components):  # a person has poured it
            components[entered.liquid] = entered.mass, entered.deviation
        return components

    def add_component(self, vessel: str, liquid: str, mass: float | None, deviation: float, source: str = "") -> None:
        """See `PlaceRecord.add_component`."""
        with _writable():
            origin = self._prefix + source if source else ""
            self._account.add_component(self._prefix + vessel, liquid, mass, deviation, origin)


@contextlib.contextmanager
def _writable() -> Iterator[None]:
    try:
        yield
    except (OSError, InvalidArgumentError) as error:
        raise LaboratoryError(f"the account of vessels: {error}") from error


def _check_stated(mass: float, deviation: float) -> None:
    """Raise InvalidArgumentError for a mass [kg] that a person can't mean."""
    for name, value in (("mass", mass), ("deviation", deviation)):
        if not (math.isfinite(value) and value >= 0.0):
            raise InvalidArgumentError(f"{name}: {value} kg should be a number of 0 or more")
        if value > LARGEST["kg"]:
            raise InvalidArgumentError(f"{name}: {value:g} kg is more than {LARGEST['kg']:g} kg; is it in grams?")


def _empty(vessel: str) -> VesselContent:
    return VesselContent(vessel, 0.0, "weighed", 0.0, 0.0)


def _after(
    before: VesselContent, change: tuple[float, float] | None, sign: float
) -> tuple[EntryKind, float | None, float]:
    """Kind, mass and deviation of an entry after a pour; a content that was unknown remains so."""
    if change is None:
        return "unknown", None, 0.0
    if before.mass is None:
        return "poured", None, 0.0
    return "poured", max(before.mass + sign * change[0], 0.0), math.hypot(before.deviation, change[1])


_COLUMNS = "vessel, t, kind, mass, deviation, liquid, pour, by, note, weighed, knowledge"


def _read(connection: sqlite3.Connection, condition: str, values: tuple[Any, ...]) -> list[VesselContent]:
    rows = connection.execute(f"select {_COLUMNS} from entry {condition}", values).fetchall()
    return [VesselContent(*(*row[:-1], None if row[-1] is None else json.loads(row[-1]))) for row in rows]


def _last(connection: sqlite3.Connection, vessel: str) -> VesselContent | None:
    entries = _read(connection, "where vessel = ? order by id desc limit 1", (vessel,))
    return entries[0] if entries else None


def _write(connection: sqlite3.Connection, key: str, row: VesselContent) -> None:
    knowledge = None if row.knowledge is None else json.dumps(row.knowledge)
    values = (row.vessel, row.time, row.kind, row.mass, row.deviation, row.liquid, row.pour, row.by, row.note)
    connection.execute(
        f"insert or ignore into entry (key, {_COLUMNS}) values ({', '.join('?' * 12)})",
        (key, *values, row.weighed, knowledge),
    )
