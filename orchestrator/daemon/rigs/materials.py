"""Materials of a station: liquids, vessels and positions, and what their contents can serve.

`Materials` registers them in the daemon's `Store`; the contents and the places of vessels are in the account of this
machine (`orchestrator.materials.vessel_account`). A position is a place of a rig's laboratory. `Materials.refusal` is
the reason why vessels can't serve a pour; it is checked before anything moves. A vessel `LABORATORY/VESSEL`, the source
of a campaign, needs no registration.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator.campaigns.file_loading import liquid_from, vessel_from
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.daemon.rigs.pour_request import ResponseModel
from orchestrator.daemon.state.daemon_store import ENDED, Store, StoreError
from orchestrator.learning.dispense import ENOUGH
from orchestrator.learning.run_errors import RunError
from orchestrator.materials.vessel_account import FILE_NAME, MIXTURE, ContentOut, VesselAccount, VesselContent
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import Liquid
from sim_engine.settings.quantity import QuantityError, parse_quantity
from sim_engine.vessel.shapes import VesselError
from sim_engine.vessel.vessel import build_vessel

SURE = ENOUGH
"""Number of standard deviations by which a content may be smaller than its estimate, and larger."""


class MaterialError(RunError):
    """A material can't be registered, found, or used; the message gives the reason and a remedy."""

    exit_code = 2


@dataclass(frozen=True)
class RegisteredVessel:
    """A vessel of the station.

    Attributes:
        id: name that callers use.
        code: bar code; '' without one. Callers may use it instead of the id.
        shape: as in a vessel file.
        capacity: up to the brim [m³].
        position: id of the position where it belongs; '' if it belongs nowhere.
    """

    id: str
    code: str
    shape: dict[str, Any]
    capacity: float
    position: str


class VesselOut(ResponseModel):
    """A vessel with its content."""

    id: str
    code: str
    position: str
    capacity_ml: float
    content: ContentOut
    promised_g: float
    """Amounts that queued pours will take."""


class SourceOut(ResponseModel):
    """A vessel that is not registered: the source of a campaign."""

    id: str
    """LABORATORY/VESSEL."""

    position: str
    """Place of the laboratory where it stands; UNKNOWN after an interrupted motion; '' without places."""

    in_use: bool
    """Whether a campaign runs in its laboratory: it may move, and its content be weighed later."""

    content: ContentOut


class LiquidOut(ResponseModel):
    """A liquid."""

    id: str
    code: str
    properties: dict[str, Any]


class PositionOut(ResponseModel):
    """A position."""

    id: str
    code: str
    rig: str
    note: str


class MaterialsOut(ResponseModel):
    """All materials of the station."""

    liquids: list[LiquidOut]
    vessels: list[VesselOut]
    sources: list[SourceOut]
    """Sources of campaigns, which need no registration."""

    positions: list[PositionOut]


class Materials:
    """Materials of one daemon.

    Args:
        store: its store.
        laboratories: names of the laboratories, by their rigs; a rig without one has its own name.

    Attributes:
        account: the contents and places of vessels.
    """

    def __init__(self, store: Store, laboratories: Mapping[str, str] | None = None) -> None:
        self._store, self.account = store, VesselAccount(store.path.parent / FILE_NAME)
        self._laboratories = laboratories or {}

    def move_positions(self) -> None:
        """Enter in the account where vessels stand that former versions had in the store; each once.

        Raises:
            StoreError: the account can't be read or written.
        """
        try:
            places = self.account.places()
            for row in self._store.rows("select id, former_position from vessel where former_position is not null"):
                if row["id"] not in places:
                    self.account.assign(row["id"], self._address(row["former_position"]))
                self._store.write("update vessel set former_position = null where id = ?", row["id"])
        except (OSError, InvalidArgumentError) as error:
            raise StoreError(str(error)) from error

    def _address(self, position: str) -> tuple[str, str]:
        """Laboratory and place of a position; both '' if it is ''. Raises MaterialError if it is unknown."""
        if not position:
            return "", ""
        row = self._row("position", position)
        return self._laboratories.get(row["rig"], row["rig"]), str(row["id"])

    # ---- registration

    def add_liquid(self, key: str, code: str, properties: Mapping[str, Any]) -> None:
        """Register a liquid.

        Args:
            key: its id.
            code: bar code; '' for none.
            properties: the keys of a campaign's `liquid`, without its mass and volume.

        Raises:
            MaterialError: the properties are invalid, or the id or code is in use.
        """
        if key == MIXTURE:
            raise MaterialError(f"'{MIXTURE}' stands for liquids that were poured together; choose another id")
        if wrong := {"mass", "volume"} & set(properties):
            raise MaterialError(f"{sorted(wrong)[0]}: belongs to a vessel's content; weigh the vessel")
        liquid_of(key, properties, 0.1)
        self._add("liquid", key, code, properties=json.dumps(dict(properties), ensure_ascii=False))

    def add_position(self, key: str, code: str, rig: str, note: str) -> None:
        """Register a position of a rig. Raises MaterialError if the id or code is in use."""
        self._add("position", key, code, rig=rig, note=note)

    def add_vessel(self, key: str, code: str, shape: Mapping[str, Any], position: str, by: str) -> None:
        """Register an empty vessel. `weigh` enters what is in it.

        Raises:
            MaterialError: the shape is invalid, the position is unknown or taken, or the id or code is in use.
        """
        if "mesh" in shape:
            raise MaterialError(f"{key}: a vessel is registered by its profile; its mesh is a file, which is not sent")
        text = json.dumps({"name": key, **shape}, ensure_ascii=False)
        try:
            capacity = build_vessel(vessel_from(Document.parse(text, Path("vessel.json")))).capacity
        except ConfigError as error:
            raise MaterialError("; ".join(f"{p.where or 'shape'}: {p.message}" for p in error.problems)) from None
        except (VesselError, ValueError) as error:
            raise MaterialError(f"shape: {error}") from None
        address, home = self._address(position), self._homes().get(key)
        if home not in (None, address[1]):
            raise MaterialError(f"vessel '{key}' is registered already, at another position")
        if position and (other := self.account.identity("/".join(address))) not in (key, "/".join(address)):
            raise MaterialError(f"position {address[1]} is taken by vessel {other}; move that one first")
        self._add("vessel", key, code, shape=text, capacity=float(capacity))
        if self.account.content(key) is None:  # also if an earlier registration was interrupted here
            self.account.weigh(key, 0.0, 0.0, by=by, note="registered as empty", key=f"registered {key}")
        if home is None and position:
            self._assign(key, address, by)

    def _add(self, table: str, key: str, code: str, **values: Any) -> None:
        """Insert a row; an identical row may be registered again."""
        rows = self._store.rows(f"select * from {table} where id = ?", key)
        if rows:
            if any(rows[0][name] != value for name, value in {"code": code or None, **values}.items()):
                raise MaterialError(f"{table} '{key}' is registered already, with other properties")
            return
        if code and any(self._store.rows(f"select id from {t} where code = ?", code) for t in _TABLES):
            raise MaterialError(f"code {code} is in use already")
        values = {"id": key, "code": code or None, **values, "created": time.time()}
        names, marks = ", ".join(values), ", ".join("?" * len(values))
        self._store.write(f"insert into {table} ({names}) values ({marks})", *values.values())

    def place(self, vessel: str, position: str, by: str) -> None:
        """Record that a vessel was moved to a position, where it belongs from now on; '' for none.

        A vessel `LABORATORY/VESSEL` is moved to a place of its laboratory, and belongs where it did.

        Raises:
            MaterialError: vessel or position is unknown, or another vessel belongs there.
            OSError: the account can't be written.
        """
        if "/" not in vessel:
            self._assign(self.vessel(vessel).id, self._address(position), by)
            return
        try:
            self.account.put(vessel, position or None, by=by, note="corrected")
        except InvalidArgumentError as error:
            raise MaterialError(str(error)) from None

    def _assign(self, vessel: str, address: tuple[str, str], by: str) -> None:
        try:
            self.account.assign(vessel, address, by=by)
        except InvalidArgumentError as error:
            raise MaterialError(str(error)) from None

    # ---- contents

    def weigh(self, vessel: str, mass: float, deviation: float, liquid: str, by: str, note: str = "") -> None:
        """Correct the content of a vessel by a weighing: an operator's correction, or a filling.

        Args:
            vessel: id or code, or `LABORATORY/VESSEL`.
            mass: content [kg].
            deviation: its standard deviation [kg].
            liquid: id or code; '' keeps the present one.
            by: who weighed it.
            note: text of the account's entry.

        Raises:
            MaterialError: vessel or liquid is unknown, the liquid is missing, or the vessel can't hold that much.
            OSError: the account can't be written.
        """
        vessel = self.account.identity(vessel)
        if "/" not in vessel:
            registered = self.vessel(vessel)
            vessel, liquid = registered.id, self.liquid_id(liquid) if liquid else self.content(registered.id).liquid
            is_registered = bool(self._store.rows("select 1 from liquid where id = ?", liquid))  # runs have others, too
            volume = mass / self.liquid(liquid).density if is_registered else 0.0
            if volume > registered.capacity:
                raise MaterialError(
                    f"{registered.id}: holds {1e6 * registered.capacity:.0f} ml, and {1e6 * volume:.0f} ml are stated"
                )
        try:
            self.account.weigh(vessel, mass, deviation, liquid=liquid, by=by, note=note)
        except InvalidArgumentError as error:
            raise MaterialError(str(error)) from None

    def poured_by_hand(
        self, pour: str, source: str, receiver: str, mass: float, deviation: float, by: str, note: str = ""
    ) -> None:
        """Enter a pour that a person has made and weighed, once: a second call with the same id changes nothing.

        Args:
            pour: its id, chosen by the person.
            source, receiver: ids or codes, or `LABORATORY/VESSEL`.
            mass: weighed [kg].
            deviation: its standard deviation [kg].
            by: who poured it.
            note: text of the account's entries.

        Raises:
            MaterialError: a vessel is unknown, both are the same one, or the source holds less.
            OSError: the account can't be written.
        """
        source, receiver = (
            name if "/" in name else self.vessel(name).id for name in map(self.account.identity, (source, receiver))
        )
        if source == receiver:
            raise MaterialError(f"{source}: is source and receiver at once")
        try:
            self.account.pour_by_hand(pour, source, receiver, mass, deviation, by=by, note=note)
        except InvalidArgumentError as error:
            raise MaterialError(str(error)) from None

    def content(self, vessel: str) -> VesselContent:
        """Return the content of a registered vessel. Raises MaterialError if it is unknown."""
        key = self.vessel(vessel).id
        return self.account.content(key) or VesselContent(key, 0.0, "weighed", 0.0, 0.0)

    def on_rig(self, rig: str) -> dict[str, str]:
        """Return the ids of the vessels that may stand at a rig, by id, by code and by position.

        A campaign's source with one of these names is that vessel.
        """
        homes, rigs = self._homes(), self._rigs()
        names: dict[str, str] = {}
        for row in self._store.rows("select id, coalesce(code, '') as code from vessel"):
            home = homes.get(row["id"], "")
            if rigs.get(home, rig) == rig:
                names |= {name: row["id"] for name in (home, row["code"], row["id"]) if name}
        return names

    def _homes(self) -> dict[str, str]:
        """Positions where registered vessels belong, by their ids; '' if they belong nowhere."""
        return {name: place.home for name, place in self.account.places().items() if "/" not in name}

    def _rigs(self) -> dict[str, str]:
        """Rigs of the positions."""
        return {row["id"]: row["rig"] for row in self._store.rows("select id, rig from position")}

    # ---- look-up

    def vessel(self, key: str) -> RegisteredVessel:
        """Return a vessel by its id or code, or by the position where it belongs. Raises MaterialError."""
        homes = self._homes()
        if not self._store.rows("select 1 from vessel where ? in (id, code)", key):
            for position in self._store.rows("select id from position where ? in (id, code)", key):
                key = next((vessel for vessel, home in homes.items() if home == position["id"]), key)
        row = self._row("vessel", key)
        home = homes.get(row["id"], "")
        return RegisteredVessel(row["id"], row["code"] or "", json.loads(row["shape"]), row["capacity"], home)

    def liquid(self, key: str, mass: float = 0.1) -> Liquid:
        """Return a liquid by its id or code, as a load with this mass [kg]. Raises MaterialError."""
        return liquid_of(key, self.properties(key), mass)

    def properties(self, key: str) -> dict[str, Any]:
        """Return the properties of a liquid, as in a campaign. Raises MaterialError."""
        stored: dict[str, Any] = json.loads(self._row("liquid", key)["properties"])
        return stored

    def liquid_id(self, key: str) -> str:
        """Return the id of a liquid given by its id or code. Raises MaterialError."""
        return str(self._row("liquid", key)["id"])

    def rig_of(self, vessel: str) -> str:
        """Return the rig on which a vessel stands; '' if it stands nowhere. Raises MaterialError."""
        return self._rigs().get(self.vessel(vessel).position, "")

    def _row(self, table: str, key: str) -> dict[str, Any]:
        rows = self._store.rows(f"select * from {table} where id = ? or code = ?", key, key)
        if not rows:
            ids = [row["id"] for row in self._store.rows(f"select id from {table} order by created desc limit 20")]
            raise MaterialError(f"there is no {table} '{key[:80]}'; there are {', '.join(ids) or 'none'}")
        return rows[0]

    def everything(self, running: Collection[str] = ()) -> MaterialsOut:
        """Return all materials, with the contents of the vessels.

        Args:
            running: names of the laboratories in which a campaign runs.
        """
        contents = {content.vessel: content for content in self.account.all()}
        places = self.account.places()
        vessels = []
        for row in self._store.rows(
            "select id, coalesce(code, '') as code, 1e6 * capacity as capacity_ml from vessel order by id"
        ):
            held = contents.pop(row["id"], None) or VesselContent(row["id"], 0.0, "weighed", 0.0, 0.0)
            place, promised = places.get(row["id"]), 1e3 * self.promised(row["id"])
            position = "" if place is None else place.home if place.place is not None else place.shown(running)
            vessels.append(VesselOut(**row, position=position, content=held.content, promised_g=promised))
        sources = []
        for name, held in contents.items():
            place, in_use = places.get(name), name.partition("/")[0] in running
            position = "" if place is None else place.shown(running)
            sources.append(SourceOut(id=name, position=position, in_use=in_use, content=held.content))
        liquids = [
            LiquidOut(id=row["id"], code=row["code"] or "", properties=json.loads(row["properties"]))
            for row in self._store.rows("select * from liquid order by id")
        ]
        rows = self._store.rows("select id, coalesce(code, '') as code, rig, note from position order by id")
        positions = [PositionOut(**row) for row in rows]
        return MaterialsOut(liquids=liquids, vessels=vessels, sources=sources, positions=positions)

    # ---- requests

    def promised(self, source: str, but: str = "") -> float:
        """Return the amounts that queued and running pours will take from a source [kg].

        Args:
            source: its id.
            but: caller's id of a pour that does not count.
        """
        rows = self._store.rows(
            "select coalesce(sum(amount), 0) as total from pour_order join campaign on campaign.id = campaign "
            f"where source = ? and result is null and pour_order.id != ? and state not in ({_ENDED}, 'failed')",
            *(source, but),
        )
        return float(rows[0]["total"])

    def refusal(
        self, source: str, receiver: str, liquid: str, amount: float | None, margin: float = 0.0, *, pour: str = ""
    ) -> str:
        """Return the reason why the vessels can't serve a pour; '' if they can.

        Args:
            source, receiver: ids or codes.
            liquid: id or code that the source has to hold; '' for any.
            amount: wanted [kg]; None for an action, which may pour anything up to the whole content.
            margin: possible excess [kg].
            pour: caller's id of the pour.
        """
        try:
            return self._refusal(self.vessel(source), self.vessel(receiver), liquid, amount, margin, pour)
        except MaterialError as error:
            return str(error)

    def _refusal(
        self, source: RegisteredVessel, receiver: RegisteredVessel, liquid: str, amount: float | None, margin: float,
        pour: str,
    ) -> str:  # fmt: skip
        if source.id == receiver.id:
            return f"{source.id}: is source and receiver at once"
        for vessel in (source, receiver):
            if other := self._open_pour(vessel.id, pour):
                return (
                    f"{vessel.id}: pour {other} has begun and has no outcome; answer its question, resume or cancel it"
                )
        held, target = self.content(source.id), self.content(receiver.id)
        for vessel, content in ((source, held), (receiver, target)):
            if content.mass is None:
                cause = f"pour {content.pour} left it with an unknown content" if content.pour else "holds UNKNOWN"
                return f"{vessel.id}: {cause}; weigh the vessel"
        assert held.mass is not None
        assert target.mass is not None
        if not held.liquid or held.mass <= 0.0:
            return f"{source.id}: is empty; fill and weigh it"
        if held.liquid == MIXTURE:
            return f"{source.id}: holds a mixture of liquids, whose properties are not known"
        if liquid and self.liquid_id(liquid) != held.liquid:
            return f"{source.id}: holds {held.liquid}, and {self.liquid_id(liquid)} is wanted"
        promised = self.promised(source.id, pour)
        sure = held.mass - SURE * held.deviation - promised
        wanted = 0.0 if amount is None else amount
        if sure <= (0.0 if amount is None else amount + margin):
            spoken = f", {1e3 * promised:.4g} g of it are promised to other pours" if promised else ""
            return (
                f"{source.id}: holds {1e3 * held.mass:.4g} ± {1e3 * SURE * held.deviation:.2g} g{spoken}, and "
                f"{1e3 * wanted:.4g} g are wanted; fill and weigh it"
            )
        density = self.liquid(held.liquid).density
        most = (held.mass if amount is None else amount + margin) + target.mass + SURE * target.deviation
        if most / density > receiver.capacity:
            return (
                f"{receiver.id}: holds {1e6 * receiver.capacity:.0f} ml up to the brim, and there could be "
                f"{1e6 * most / density:.0f} ml in it afterwards"
            )
        return ""

    def _open_pour(self, vessel: str, pour: str) -> str:
        rows = self._store.rows(
            "select pour_order.id from pour_order join campaign on campaign.id = campaign where result is null and "
            "run is not null and state in ('unknown', 'waiting for operator', 'paused', 'failed') and "
            "pour_order.id != ? and (source = ? or receiver = ?)",
            *(pour, vessel, vessel),
        )
        return str(rows[0]["id"]) if rows else ""


_TABLES = ("liquid", "vessel", "position")
_ENDED = ", ".join(f"'{state}'" for state in ENDED)


def liquid_of(key: str, properties: Mapping[str, Any], mass: float) -> Liquid:
    """Return a liquid with these properties as a load.

    Args:
        key: its id, for messages.
        properties: as in a campaign.
        mass: [kg].

    Raises:
        MaterialError: the properties are invalid.
    """
    text = json.dumps({"name": "water", **properties, "mass": f"{1e3 * mass:.9g} g"})
    try:
        return liquid_from(Document.parse(text, Path("liquid.json")))
    except ConfigError as error:
        told = "; ".join(f"{problem.where or 'liquid'}: {problem.message}" for problem in error.problems)
        raise MaterialError(f"liquid {key}: {told}") from None


def mass_of(text: str, name: str) -> float:
    """Return a mass given as text, such as '30 g' [kg].

    Raises:
        MaterialError: it is none, or negative; the message names the field.
    """
    try:
        mass = parse_quantity(text, "kg", "30 g")
    except QuantityError as error:
        raise MaterialError(f"{name}: {error}") from None
    if mass < 0.0:
        raise MaterialError(f"{name}: {text} is negative; a mass should be 0 g or more")
    return mass
