"""The account of vessels: the content of each one with its uncertainty, across doses, campaigns, orders and restarts.

`VesselAccount` is a small SQLite file in the state directory. Its entries are append-only and state the content after a
filling, a weighing or a pour; the last entry of a vessel counts. A pour that has begun and has no outcome makes the
content uncertain by its amount; one with unknown outcome makes it unknown until the vessel is weighed.

    account = VesselAccount.open()
    account.weigh("virtual/beaker", 0.412, 1e-4, liquid="water")
    account.content("virtual/beaker")

`composition` has the liquids of a vessel since it was empty, each with its mass as it was dosed.

A vessel has one name: its id at the station, or else its address 'LABORATORY/VESSEL', under which the laboratory's
bench knows it. A vessel with an id that belongs at a place of a laboratory has an address, too: 'LABORATORY/PLACE'.
Every function takes an address, and looks up in the file itself whose it is, so that a run at the terminal and an order
of the daemon find the same cup. The file refuses an entry under the address of a vessel that has an id.

The command line, the library, runs and the daemon share the file. `VesselAccount.follow` is a subscriber of a run
(`orchestrator.records.events`). Entries have a key, so that the events of a resumed run are written once. A file of an
earlier format is converted when it is opened.

Limitations: liquids that were poured together become a mixture. Evaporation is not estimated. Of a campaign, the doses
of `dispense` are in the account; the pourer of other campaigns is refilled by an operator.
"""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from actors.interfaces import LaboratoryError
from actors.places import OUTSIDE
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

FORMAT = 1
"""Version of the file (`user_version`). Files of the development versions of 0.3.0 and of 0.2.1 have 0."""

LATEST = "id in (select max(id) from stand group by vessel)"

_ADDRESS = "laboratory || '/' || home"

_IDENTITY = f"coalesce((select vessel from stand where {LATEST} and {_ADDRESS} = ?1), ?1)"
"""The name of the vessel that has a name or an address."""

_RENAMED = f"exists (select 1 from stand where {LATEST} and {_ADDRESS} = new.vessel and vessel != new.vessel)"

_SCHEMA = (
    """create table if not exists entry (
    id integer primary key, key text unique not null, vessel text not null, t real not null, kind text not null,
    mass real, deviation real not null, liquid text not null, pour text not null, by text not null,
    note text not null, weighed real, knowledge text check (knowledge is null or json_valid(knowledge))
    ) strict""",
    "create index if not exists entry_by_vessel on entry (vessel, id)",
    """create table if not exists component (
    id integer primary key, vessel text not null, t real not null, liquid text not null, mass real,
    deviation real not null, source text not null
    ) strict""",
    """create table stand (
    id integer primary key, vessel text not null, t real not null, laboratory text not null, home text not null,
    place text, by text not null, note text not null
    ) strict""",
    "create index stand_by_vessel on stand (vessel, id)",
    """create trigger if not exists entry_is_never_changed before update on entry begin
    select raise(abort, 'account entries are append-only'); end""",
    """create trigger if not exists entry_is_never_deleted before delete on entry begin
    select raise(abort, 'account entries are append-only'); end""",
    f"""create trigger entry_has_the_id_of_its_vessel before insert on entry when {_RENAMED} begin
    select raise(abort, 'the vessel at this place has an id, and this entry does not name it'); end""",
    f"""create trigger component_has_the_id_of_its_vessel before insert on component when {_RENAMED} begin
    select raise(abort, 'the vessel at this place has an id, and this entry does not name it'); end""",
)
"""Of a new file, and of one of format 0, whose entries and components stay. A program that knows format 0 can't enter
a motion in it, since it gives no `home`: one that runs while the file is converted stops before its next motion."""

_PLACES_OF_FORMAT_0 = """insert into stand select id, vessel, t, substr(vessel, 1, instr(vessel, '/') - 1),
    substr(vessel, instr(vessel, '/') + 1), place, by, note from former_stand"""

SAME = 0.5e-3
"""Largest difference between two accounts of one vessel, beyond their uncertainty [kg]."""

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
        laboratory: name of its laboratory; '' if it belongs to none.
        home: name under which the bench of its laboratory knows it: for a cup or source, the place where it belongs.
        place: name of the place; None: UNKNOWN, since a motion with it has begun and not ended.
        by: who made the entry; '' for a run.
        note: for people, such as the motion that was under way.
        origin: the last place that was known; '' if none was.
    """

    vessel: str
    time: float
    laboratory: str
    home: str
    place: str | None
    by: str = ""
    note: str = ""
    origin: str = ""

    def shown(self, running: Collection[str] = ()) -> str:
        """For tables: the place, or that it is unknown, and since which motion.

        Args:
            running: laboratories in which a campaign runs; it shows "in the gripper, from 'left' to 'pan'".
        """
        if self.place is not None:
            return self.place
        if self.laboratory in running and self.note.startswith(("the arm began to take", "the arm began to carry")):
            origin, (_, to, target) = f"from '{self.origin}'" if self.origin else "", self.note.partition(" to '")
            return ", ".join(filter(None, ("in the gripper", origin + to + target)))
        return f"UNKNOWN ({self.note})" if self.note else "UNKNOWN"


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
    source: str = ""
    time: float = 0.0


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
            OSError: the state directory can't be made, or the file is damaged or of a later version.
        """
        folder = state or state_directory()
        make_state_directory(folder)
        account = cls(folder / FILE_NAME)
        account.identity("")  # refuses the format of a later version before anything begins
        return account

    # ---- reading

    def identity(self, name: str) -> str:
        """The vessel that has a name or an address.

        Raises:
            OSError: the file can't be read.
        """
        rows = self._rows(f"select {_IDENTITY}", (name,))
        return str(rows[0][0]) if rows else name

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
        return self._entries(f"where ?1 = '' or vessel = {_IDENTITY} order by id desc limit ?2", (vessel, count))

    def all(self) -> list[VesselContent]:
        """The last entry of every vessel, by name.

        Raises:
            OSError: the file can't be read.
        """
        addresses = f"select {_ADDRESS} from stand where {LATEST} and vessel != {_ADDRESS}"
        last = "select max(id) from entry group by vessel"
        return self._entries(f"where id in ({last}) and vessel not in ({addresses}) order by vessel", ())

    def _entries(self, condition: str, values: tuple[Any, ...]) -> list[VesselContent]:
        return [_entry(row) for row in self._rows(f"select {_COLUMNS} from entry {condition}", values)]

    def _rows(self, query: str, values: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """Rows of the file; none before it exists."""
        if not self._path.is_file():
            return []
        with self._connection() as connection:
            return connection.execute(query, values).fetchall()

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
        with self._writing() as connection:
            vessel = _identity(connection, vessel)
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
            is_new = _write(connection, key or f"{kind} {vessel} {time.time_ns()}", entry)
            if is_new and mass == 0.0 and by and _composition(connection, vessel):
                _add_component(connection, Component("", None, 0.0), vessel)  # emptied by a person, or another one

    def lose(self, vessel: str, liquid: str = "") -> None:
        """The content of a vessel is unknown from now on: a pour from it or into it has begun.

        Args:
            vessel: its name.
            liquid: name of the liquid that is poured, for a vessel that was empty.

        Raises:
            OSError: the file can't be written.
        """
        with self._writing() as connection:
            vessel = _identity(connection, vessel)
            before = _last(connection, vessel) or _empty(vessel)
            entry = replace(
                before, time=time.time(), kind="unknown", mass=None, deviation=0.0, liquid=before.liquid or liquid,
                pour="", note="",
            )  # fmt: skip
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
            source, receiver = _identity(connection, source), _identity(connection, receiver)
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
                if _write(connection, f"{pour} {role}", entry) and role == "into" and held.liquid:
                    parts = {part.liquid: part for part in _composition(connection, receiver)}
                    earlier = parts.get(held.liquid, Component(held.liquid, 0.0, 0.0))
                    _, mass, deviation = _after(earlier, change, sign)
                    _add_component(connection, Component(held.liquid, mass, deviation, source), receiver)

    # ---- compositions

    def composition(self, vessel: str) -> list[Component]:
        """The liquids in a vessel since it was empty, the first entry the empty vessel itself if that was entered.

        Raises:
            OSError: the file can't be read.
        """
        if not self._path.is_file():
            return []
        with self._connection() as connection:
            return _composition(connection, vessel)

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
            source = _identity(connection, source)
            _add_component(connection, Component(liquid, mass, deviation, source), _identity(connection, vessel))

    # ---- places

    def places(self) -> dict[str, VesselPlace]:
        """Where vessels stand, by their names.

        Raises:
            OSError: the file can't be read.
        """
        origin = "select place from stand as former where former.vessel = stand.vessel and place is not null"
        columns = f"vessel, t, laboratory, home, place, by, note, coalesce(({origin} order by id desc limit 1), '')"
        return {row[0]: VesselPlace(*row) for row in self._rows(f"select {columns} from stand where {LATEST}", ())}

    def stands(self, laboratory: str) -> dict[str, str | None]:
        """The places of a laboratory's vessels, by the names that its bench has for them; None for UNKNOWN.

        Raises:
            OSError: the file can't be read.
        """
        return dict(self._rows(f"select home, place from stand where {LATEST} and laboratory = ?", (laboratory,)))

    def put(self, vessel: str, place: str | None, *, by: str = "", note: str = "") -> None:
        """Enter where a vessel stands; None for UNKNOWN. The entry is on disk when this returns.

        Args:
            vessel: its address, which stays.
            place: name of the place; '' outside the cell.
            by: who corrected it; '' for a run.
            note: for people.

        Raises:
            InvalidArgumentError: another vessel of the laboratory stands there.
            OSError: the file can't be written.
        """
        laboratory, _, home = vessel.partition("/")
        with self._writing() as connection:
            name = _identity(connection, vessel)
            others = f"select vessel from stand where {LATEST} and laboratory = ? and place = ? and vessel != ?"
            taken = connection.execute(others, (laboratory, place or None, name)).fetchone()
            if taken is not None:
                raise InvalidArgumentError(
                    f"{vessel}: {taken[0]} stands at '{place}' already; a place holds one vessel"
                )
            _put(connection, name, (laboratory, home), place, by, note)

    def assign(self, vessel: str, address: tuple[str, str], *, by: str = "") -> None:
        """A vessel with an id belongs at a place from now on, and stands there.

        The vessel without an id that the account has there is this one. If what the account has of both differs, the
        content is UNKNOWN until it is weighed, and a liquid that either has is in it.

        Args:
            vessel: its id.
            address: laboratory and place; both '' if it belongs nowhere.
            by: who has put it there; '': it stands where the vessel without an id does.

        Raises:
            InvalidArgumentError: another vessel belongs there.
            OSError: the file can't be written.
        """
        home = address[1]
        with self._writing() as connection:
            former = "/".join(address) if home else vessel
            owner = _identity(connection, former)
            if owner not in (vessel, former):
                raise InvalidArgumentError(f"position {home} is taken by vessel {owner}; move that one first")
            stood = connection.execute(f"select place, note from stand where {LATEST} and vessel = ?", (former,))
            place, note = stood.fetchone() or (home, "")
            if owner != vessel:
                _take_over(connection, vessel, former, moved=place is None)
                _put(connection, former, ("", ""), OUTSIDE, by, f"its id is {vessel}")
            if by:
                place, note = home, ""
            _put(connection, vessel, address, place, by, note)

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
            vessel = _identity(connection, vessel)
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
        cup, source = plan.tracked(dose.cup), plan.tracked(dose.source.name)
        liquid = plan.liquid(dose.source.name)
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
            connection.execute("begin immediate")
            yield connection

    @contextlib.contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(sqlite3.connect(self._path, timeout=LOCK_TIMEOUT)) as connection, connection:
                self._convert(connection)
                yield connection
        except sqlite3.Error as error:
            raise OSError(f"{self._path}: {error}") from error

    def _convert(self, connection: sqlite3.Connection) -> None:
        """Create the tables, or convert those of the earlier format: all in one transaction, or nothing."""
        if (version := _version(connection)) == FORMAT:
            return
        if version > FORMAT:
            raise OSError(
                f"{self._path}: the account of vessels was written in format {version}, and this version of Decant "
                f"reads formats up to {FORMAT}; use the version that wrote it, or another state directory"
            )
        connection.execute("begin immediate")
        if _version(connection) != FORMAT:  # no other process was first
            former = connection.execute("select 1 from sqlite_master where name = 'stand'").fetchone()
            renaming = ("alter table stand rename to former_stand",) if former else ()
            moving = (_PLACES_OF_FORMAT_0, "drop table former_stand") if former else ()
            for statement in (*renaming, *_SCHEMA, *moving, f"pragma user_version = {FORMAT}"):
                connection.execute(statement)
        connection.commit()


class LaboratoryPlaces:
    """The account of one laboratory's vessels, for its bench; see `actors.places.PlaceRecord`.

    Args:
        account: the account.
        laboratory: name of the laboratory.
    """

    def __init__(self, account: VesselAccount, laboratory: str) -> None:
        self._account, self._laboratory, self._prefix = account, laboratory, f"{laboratory}/"

    def stands(self) -> dict[str, str | None]:
        """See `PlaceRecord.stands`."""
        with _writable():
            return self._account.stands(self._laboratory)

    def put(self, vessel: str, place: str | None, note: str = "") -> None:
        """See `PlaceRecord.put`."""
        with _writable():
            self._account.put(self._prefix + vessel, place, note=note)

    def content(self, vessel: str, mass: float | None, deviation: float, liquid: str) -> None:
        """See `PlaceRecord.content`."""
        with _writable():
            if mass is None:
                self._account.lose(self._prefix + vessel, liquid)
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
    before: VesselContent | Component, change: tuple[float, float] | None, sign: float
) -> tuple[EntryKind, float | None, float]:
    """Kind, mass and deviation of an entry after a pour; a content that was unknown remains so."""
    if change is None:
        return "unknown", None, 0.0
    if before.mass is None:
        return "poured", None, 0.0
    return "poured", max(before.mass + sign * change[0], 0.0), math.hypot(before.deviation, change[1])


def _take_over(connection: sqlite3.Connection, vessel: str, former: str, *, moved: bool) -> None:
    """A vessel holds what the one without an id held, which is empty from now on.

    Args:
        vessel: its id.
        former: address of the one without an id.
        moved: whether a motion with it was interrupted: it may have spilled.
    """
    held, parts = _last(connection, former) or _empty(former), _composition(connection, former)
    if held.mass == 0.0 and not any(part.liquid and part.mass != 0.0 for part in parts):
        return
    own = _last(connection, vessel) or _empty(vessel)
    certain = False
    if held.mass is not None and own.mass is not None and not moved:
        spread = math.hypot(held.deviation, own.deviation)
        certain = held.liquid == own.liquid and abs(held.mass - own.mass) <= SAME + ENOUGH * spread
    both = [part for part in (*_composition(connection, vessel), *parts) if part.liquid]
    if not certain:
        entered = [Component(entry.liquid, entry.mass, entry.deviation) for entry in (own, held) if entry.liquid]
        both = [part for part in entered if part.liquid not in {one.liquid for one in both}] + both
    empty = [part if certain else replace(part, mass=None) for part in parts if not part.liquid]
    for part in (*empty, *both):
        _add_component(connection, part, vessel)
    liquids = {part.liquid for part in _composition(connection, vessel) if part.liquid and part.mass != 0.0}
    entry = replace(
        held,
        vessel=vessel,
        time=time.time(),
        kind="weighed" if certain else "unknown",
        mass=held.mass if certain else None,
        deviation=held.deviation if certain else 0.0,
        liquid=MIXTURE if len(liquids) > 1 else next(iter(liquids), held.liquid or own.liquid),
        pour="",
        by=held.by or own.by,
        note=f"is the vessel at {former}",
    )
    _write(connection, f"{vessel} is {former} {entry.time}", entry)
    gone = replace(_empty(former), time=entry.time, kind="filled", note=f"its id is {vessel}", weighed=entry.time)
    _write(connection, f"{former} is {vessel} {entry.time}", gone)
    _add_component(connection, Component("", None, 0.0), former)


def _identity(connection: sqlite3.Connection, name: str) -> str:
    return str(connection.execute(f"select {_IDENTITY}", (name,)).fetchone()[0])


def _version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("pragma user_version").fetchone()[0])


def _put(
    connection: sqlite3.Connection, vessel: str, address: tuple[str, str], place: str | None, by: str, note: str
) -> None:
    connection.execute(
        "insert into stand (vessel, t, laboratory, home, place, by, note) values (?, ?, ?, ?, ?, ?, ?)",
        (vessel, time.time(), *address, place, by, note),
    )


def _composition(connection: sqlite3.Connection, vessel: str) -> list[Component]:
    of_vessel = f"vessel = {_IDENTITY}"
    empty = f"select coalesce(max(id), 0) from component where {of_vessel} and liquid = ''"
    rows = connection.execute(
        f"select liquid, mass, deviation, source, t from component where {of_vessel} and id >= ({empty}) order by id",
        (vessel,),
    ).fetchall()
    latest = {row[0]: Component(*row) for row in rows}  # a begun dose is followed by its outcome
    return list(latest.values())


def _add_component(connection: sqlite3.Connection, component: Component, vessel: str) -> None:
    connection.execute(
        "insert into component (vessel, t, liquid, mass, deviation, source) values (?, ?, ?, ?, ?, ?)",
        (vessel, time.time(), component.liquid, component.mass, component.deviation, component.source),
    )


_COLUMNS = "vessel, t, kind, mass, deviation, liquid, pour, by, note, weighed, knowledge"


def _entry(row: tuple[Any, ...]) -> VesselContent:
    return VesselContent(*(*row[:-1], None if row[-1] is None else json.loads(row[-1])))


def _last(connection: sqlite3.Connection, vessel: str) -> VesselContent | None:
    of_vessel = f"select {_COLUMNS} from entry where vessel = ? order by id desc limit 1"
    row = connection.execute(of_vessel, (vessel,)).fetchone()
    return None if row is None else _entry(row)


def _write(connection: sqlite3.Connection, key: str, row: VesselContent) -> bool:
    """Make an entry, unless there is one with this key. Returns whether it is new."""
    knowledge = None if row.knowledge is None else json.dumps(row.knowledge)
    values = (row.vessel, row.time, row.kind, row.mass, row.deviation, row.liquid, row.pour, row.by, row.note)
    made = connection.execute(
        f"insert or ignore into entry (key, {_COLUMNS}) values ({', '.join('?' * 12)})",
        (key, *values, row.weighed, knowledge),
    )
    return made.rowcount > 0
