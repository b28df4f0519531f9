"""Doses in a laboratory with places: the arm carries the cup to the balance and back, and takes the source.

`DoseHandling` takes the place of the operator's hands around one dose of `actors.bench.dose_procedure`:

1. Have the vessels laid out: once, and again after an interruption.
2. Put the cup on the balance, unless it stands there. Weigh it, unless nothing has happened since: that is its tare,
   and has to be what the account says.
3. Take the source. After the dose put it back, and weigh the cup again.
4. Put the cup back, unless the next dose goes into it.

A cup may be emptied first: at the waste place, to whose content it is added, or by the operator.

A cup whose content is UNKNOWN is not used before a person has entered it. No liquid is dosed into a cup twice. The
moves are those of `actors.bench.vessel_carrying`, and so are their entries in the account of vessels.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from actors.arm.arm_interface import PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.pour_feasibility import vessel as built
from actors.balance.weighing_plan import SURE, Weighing
from actors.bench.cell_liquids import RESERVOIR, CellLiquids
from actors.bench.ground_truth import GroundTruth
from actors.bench.liquid_supply import LiquidSupply
from actors.bench.vessel_carrying import (
    Load,
    MotionConsent,
    VesselCarrier,
    Ways,
    check_carrying,
    check_pour_path,
    label,
)
from actors.bench.vessel_handling import plan_emptying
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import source_of
from actors.grippers.gripper_interface import GripperSettings
from actors.interfaces import DoseSource, DoseTarget, InvalidActionError, LaboratoryError, OperatorQuestion
from actors.places import CellVessel, Layout, PlaceRecord, PlaceSettings, Role
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.vessel import Vessel

OPEN_LOSS = 0.3e-3
"""Mass that a cup may lose unweighed, by evaporation and at its outside, before a person is asked about it [kg]."""

BEFORE_PLACED, AFTER_PLACED = 1.5, 3.0
"""Readings around the moment when a cup is let go of on the balance, which show its lag [s]."""

FILM = 0.5e-3
"""Liquid that an emptied cup keeps, and its standard deviation, until it is weighed [kg]."""

WATER, FULL = 998.0, 0.9
"""Density that a waste container is filled with [kg/m³], and the part of its capacity that is used."""

MOST_SPILLED = 20e-3
"""Largest mass that a dose is expected to spill into the tray [kg]."""


@dataclass(frozen=True)
class CarriedDose:
    """Weighings of the cup of one dose.

    Attributes:
        cup, source: names of the vessels.
        tare, gross: of the cup before and after the dose.
        missing: content by the account less the weighed one, before the dose [kg]; None if it was not known.
    """

    cup: str
    source: str
    tare: Weighing
    gross: Weighing
    missing: float | None

    @property
    def record(self) -> dict[str, object]:
        """For the record of the dose, JSON-ready [kg]."""
        weighed = {name: [getattr(self, name).mass, getattr(self, name).uncertainty] for name in ("tare", "gross")}
        return {"cup": self.cup, "vessel": self.source, **weighed, "missing": self.missing}


@dataclass(frozen=True)
class _Tare:
    """Weight of the cup before a dose, its content then (mass and deviation), and what was missing [kg]."""

    weight: Weighing
    content: tuple[float, float]
    missing: float | None


def vessels_of(places: Sequence[PlaceSettings], scene: Scene, dose: DoseTarget) -> tuple[CellVessel, CellVessel]:
    """The only source and the only cup of a laboratory, for a dose that names none.

    Args:
        places: of the laboratory.
        scene: vessels and liquid.
        dose: wanted amount.

    Raises:
        InvalidActionError: its places do not suffice for a pour.
    """
    rest, liquid = Layout.of(places).rest, scene.liquid
    cup = scene.receiver.name if scene.receiver.name != scene.pourer.name else f"{scene.receiver.name}-cup"
    stand, most, fill = rest["pourer"].name, dose.amount + dose.limit, source_of(scene, dose).fill
    return (
        CellVessel(scene.pourer.name, scene.pourer, liquid.name, liquid.mass, liquid.volume, fill, stand),
        CellVessel(cup, scene.receiver, "", most, most / liquid.density, False, rest["receiver"].name),
    )


def check_vessels(
    places: Sequence[PlaceSettings], vessels: Sequence[CellVessel], spec: ArmSettings, gripper: GripperSettings
) -> tuple[tuple[PlaceSettings, ...], dict[str, Load], Ways]:
    """Check that an arm can carry all vessels of a series of doses.

    Args:
        places: of the laboratory.
        vessels: of the series.
        spec: of the arm.
        gripper: its settings.

    Returns:
        The places, each with the names of the vessels that may stand there; the vessels; the ways.

    Raises:
        InvalidActionError: it cannot; the text has all reasons.
    """
    pan = [place for place in places if place.use == "balance" and "receiver" in place.holds]
    if len(pan) != 1:
        raise InvalidActionError("doses need one place with 'use: balance' that holds a receiver")
    by_name, homes, problems = {place.name: place for place in places}, dict[str, str](), dict[str, str]()
    for vessel in vessels:
        role: Role = "pourer" if vessel.liquid else "receiver"
        place, text = by_name.get(vessel.place), ""
        if place is None:
            text = f"there is no place '{vessel.place}' for a vessel; there are {', '.join(sorted(by_name))}"
        elif role not in place.holds or place.use == "balance":
            text = f"place '{place.name}' is not for a {role}: see its 'use' and 'holds'"
        elif vessel.place in homes:
            text = f"two vessels belong to place '{vessel.place}': {homes[vessel.place]} and {vessel.name}"
        if text:
            problems.setdefault(text, vessel.name)
        homes.setdefault(vessel.place, vessel.name)
    if problems:
        raise InvalidActionError("; ".join(problems), problems)
    loads = {vessel.name: Load(built(vessel.spec), vessel.mass, vessel.volume) for vessel in vessels}
    cups = [vessel.name for vessel in vessels if not vessel.liquid]
    # of several cups with one shape, the fullest stands for all of them
    shapes = {loads[name].vessel: name for name in sorted(cups, key=lambda name: loads[name].volume)}
    at_places = []
    for place in places:
        names = tuple(shapes.values()) if place is pan[0] else (homes[place.name],) if place.name in homes else ()
        names = (place.name,) if place.container is not None else names
        at_places.append(place.with_values(holds=names))
    stops = [place for place in at_places if place.holds and place.container is None]
    return tuple(at_places), loads, check_carrying(stops, at_places, spec, gripper, loads, _containers(places))


def plan_waste(
    places: Sequence[PlaceSettings], spec: ArmSettings, scene: Scene, cup: CellVessel, vessels: Mapping[str, Vessel]
) -> PlannedPour | None:
    """Plan to empty a cup at the waste place; None if there is none.

    Args:
        places: of the laboratory, each with the names of the vessels that may stand there.
        spec: of the arm.
        scene: of a dose into the cup.
        cup: with its largest load.
        vessels: by name, with the waste container.

    Raises:
        InvalidActionError: the arm can't; the text states why.
    """
    waste = next((place for place in places if place.container is not None), None)
    if waste is None or waste.container is None:
        return None
    liquid = scene.liquid.model_copy(update={"mass": cup.mass, "density": cup.mass / cup.volume})
    emptying = replace(scene, pourer=cup.spec, receiver=waste.container.vessel, liquid=liquid)
    others = [place for place in places if place.name != waste.name]
    try:
        return plan_emptying(emptying, others, arm_kind(spec).pouring_at(waste), vessels)
    except InvalidActionError as error:
        text = f"'{cup.name}' cannot be emptied at '{waste.name}': {error}"
        raise InvalidActionError(text, {text: cup.name}) from error


def shapes_of(places: Sequence[PlaceSettings], loads: Mapping[str, Load]) -> dict[str, Vessel]:
    """The vessels that are carried, and the containers at places, by name."""
    return {name: load.vessel for name, load in loads.items()} | _containers(places)


def _containers(places: Sequence[PlaceSettings]) -> dict[str, Vessel]:
    return {place.name: built(place.container.vessel) for place in places if place.container is not None}


def _step(readings: Sequence[DoseReading], rise: float) -> tuple[DoseReading, ...]:
    """The readings from before a rise [kg] until it has settled; none without one."""
    moment = next((reading.time for reading in readings if reading.mass - readings[0].mass > rise), None)
    if moment is None:
        return ()
    begin, end = moment - BEFORE_PLACED, moment + AFTER_PLACED
    return tuple(reading for reading in readings if begin <= reading.time <= end)


class DoseHandling:
    """The vessels of doses on a bench, and the arm that carries them.

    Args:
        places: of the laboratory.
        vessels: of the series; empty: the only source and the only cup.
        carrier: the arm with its gripper.
        liquids: contents of the cell.
        record: the account of vessels.
        supply: has the refill device, if there is one.
        truth: of the bench.

    Attributes:
        placed: readings of the balance while the cup on it was put there.
    """

    def __init__(
        self,
        places: Sequence[PlaceSettings],
        vessels: Sequence[CellVessel],
        carrier: VesselCarrier,
        liquids: CellLiquids,
        record: PlaceRecord,
        supply: LiquidSupply | None,
        truth: GroundTruth,
    ) -> None:
        self._places, self._given = tuple(places), tuple(vessels)
        self._carrier, self._liquids, self._record = carrier, liquids, record
        self._supply, self._truth = supply, truth
        self._pan = next(place for place in places if place.use == "balance").name
        self._vessels: dict[str, CellVessel] = {}
        self._checked: tuple[ArmSettings, tuple[CellVessel, ...]] | None = None
        self._at_places: tuple[PlaceSettings, ...] = ()
        self._loads: dict[str, Load] = {}
        self._ways: Ways = {}
        self._emptying: PlannedPour | None = None
        self._laid_out = False
        self._filled: set[str] = set()
        self._tare: _Tare | None = None
        self._stayed: tuple[str, Weighing] | None = None
        self.placed: tuple[DoseReading, ...] = ()

    # ---- checks

    def names(self, scene: Scene, dose: DoseTarget) -> tuple[str, str]:
        """Names of the source and the cup of a dose."""
        if self._given:
            return source_of(scene, dose).vessel, dose.cup
        source, cup = vessels_of(self._places, scene, dose)
        return source.name, cup.name

    def fit(self, spec: ArmSettings, scene: Scene, dose: DoseTarget, path: PlannedPour) -> None:
        """Check, before anything is asked or moves, that the vessels of a dose can be handled.

        Args:
            spec: of the connected arm.
            scene: vessels and liquid.
            dose: wanted amount.
            path: of the dose.

        Raises:
            InvalidActionError: they cannot; the text states why.
        """
        vessels = self._given or vessels_of(self._places, scene, dose)
        carrier, source_name = self._carrier, self.names(scene, dose)[0]
        by_name = {vessel.name: vessel for vessel in vessels}
        for name, cup in zip(self.names(scene, dose), (False, True), strict=True):
            if name not in by_name or cup != (not by_name[name].liquid):
                kind = "cup" if cup else "source"
                raise InvalidActionError(f"'{name}' is no {kind} of this series; it has {', '.join(sorted(by_name))}")
        if self._checked != (spec, vessels):
            self._at_places, self._loads, self._ways = check_vessels(self._places, vessels, spec, carrier.held.spec)
            if {v.name: (v.spec, v.place) for v in vessels} != {n: (v.spec, v.place) for n, v in self._vessels.items()}:
                self.forget()  # the operator brings other vessels
                self._laid_out = False
            self._checked, self._vessels = (spec, vessels), by_name
        carrier.spec, carrier.loads, carrier.ways = spec, self._loads, self._ways
        shapes = shapes_of(self._places, self._loads)
        cup_vessel = self._vessels[self.names(scene, dose)[1]]
        self._emptying = plan_waste(self._at_places, spec, scene, cup_vessel, shapes) if dose.emptied else None
        check_pour_path(path, shapes[source_name], self._at_places, spec, shapes)

    # ---- before the dose

    async def prepare(self, consent: MotionConsent, scene: Scene, dose: DoseTarget, seed: int) -> DoseTarget:
        """Have the vessels laid out, and the source filled.

        Args:
            consent: of the dose.
            scene: vessels and liquid.
            dose: wanted amount.
            seed: of a virtual bench.

        Returns:
            The dose with its source as it is then.

        Raises:
            InvalidActionError: the cup has this liquid already.
            LaboratoryError: something failed; nothing was poured.
        """
        source_name, cup = self.names(scene, dose)
        if self._carrier.at.keys() != self._vessels.keys():
            await self._lay_out(consent)
        elif not dose.cup and self._record.composition(cup):
            await self._exchange(cup, consent)
        self._carrier.require_known()
        await self._known(cup, consent)
        if dose.emptied and any(self._record.composition(cup)):
            emptying = self._emptying
            await (
                self._exchange(cup, consent) if emptying is None else self._empty_at_waste(cup, emptying, consent, seed)
            )
        mass = self._record.composition(cup).get(scene.liquid.name, (0.0, 0.0))[0]
        if mass != 0.0:
            held = "an UNKNOWN mass" if mass is None else f"{1e3 * mass:.1f} g"
            raise InvalidActionError(
                f"'{cup}' has {held} of {scene.liquid.name} already, and no liquid is dosed into a cup twice"
            )
        await self._liquids.room_for_spills(scene.liquid, MOST_SPILLED, consent)
        source, fresh = source_of(scene, dose), source_name in self._filled
        self._filled.discard(source_name)
        if source.fill and not fresh:
            source = await self._refilled(source, source_name, scene.liquid, consent, seed)
        self._carrier.mass[source_name] = source.mass
        return replace(dose, source=replace(source, fill=False, before=None))

    async def _lay_out(self, consent: MotionConsent) -> None:
        """Have the operator lay out all vessels; afterwards it is known where they stand."""
        await self._carrier.let_go(consent)
        self._lose_moved()
        vessels, held = self._vessels.values(), {name: self._record.held(name) for name in self._vessels}
        masses = {name: 0.0 if content is None else content[0] for name, content in held.items()}
        cups = [vessel.name for vessel in vessels if not vessel.liquid]
        used = [cup for cup in cups if masses[cup] > 0.0]
        empty = {cup for cup in cups if masses[cup] <= 0.0 and not self._record.unknown(cup)}
        if used:
            content = ", ".join(f"{name} ({1e3 * masses[name]:.1f} g)" for name in used)
            begins = not self._laid_out and any(vessel.filled for vessel in vessels if vessel.liquid)
            question = OperatorQuestion(
                f"By the account of vessels these cups hold something: {content}. Are they these, with what they hold? "
                "'no': you have put empty, dry ones in their place.",
                "yes or no",
                about="cups_kept",
                details={"begins": float(begins)},
            )
            if (await self._carrier.ask(question, consent)).strip().lower() not in ("yes", "y"):
                empty |= {*used}
        fill = {v.name: v.mass for v in vessels if v.liquid and v.filled and not self._laid_out}
        details: dict[str, float | str] = {vessel.name: vessel.place for vessel in vessels}
        details |= {f"{name} filled_g": 1e3 * mass for name, mass in (fill | dict.fromkeys(empty, 0.0)).items()}
        details |= {f"{name} held_g": 1e3 * masses[name] for name, content in held.items() if content is not None}
        text = "; ".join(
            [f"'{v.name}' on '{v.place}' with {1e3 * v.mass:.0f} g of {v.liquid}, weighed"
             for v in vessels if v.name in fill]
            + [f"'{v.name}' on '{v.place}' as it is" for v in vessels if v.name not in empty and v.name not in fill]
            + ([f"empty, dry cups on {', '.join(v.place for v in vessels if v.name in empty)}"] if empty else [])
        )  # fmt: skip
        question = OperatorQuestion(
            f"Lay out the vessels: {text}. Leave the gripper, the balance and all other places empty.",
            "done",
            self._carrier.unknown(),
            about="vessels_laid_out",
            details=details,
        )
        await self._carrier.ask(question, consent)
        for name in empty:
            self._empty(name)
        for name, mass in fill.items():
            self._liquids.enter(name, mass, 0.5e-3, self._vessels[name].liquid)
        # a source that an interrupted series has filled, and not used, is still full
        full = {v.name for v in vessels if v.liquid and not v.filled and masses[v.name] >= v.mass}
        self._filled |= fill.keys() | full
        self._laid_out = True
        laid_out = {name: (self._record.held(name) or (self._vessels[name].mass,))[0] for name in self._vessels}
        self._carrier.laid_out({vessel.name: vessel.place for vessel in vessels}, laid_out)

    def _empty(self, cup: str) -> None:
        """An empty, dry cup stands there."""
        self._liquids.enter(cup, 0.0, 0.0, "")
        self._record.add_component(cup, "", None, 0.0)
        self._carrier.mass[cup] = 0.0

    async def _empty_at_waste(self, cup: str, path: PlannedPour, consent: MotionConsent, seed: int) -> None:
        """Empty a cup at the waste place, and put it back; what has left it is added there."""
        carrier, waste = self._carrier, next(place for place in self._places if place.container is not None)
        assert waste.container is not None
        content, own = self._record.held(cup) or (0.0, 0.0), self._record.composition(cup).get("", (None, 0.0))
        before = self._record.held(waste.name) or (0.0, 0.0)
        room = WATER * built(waste.container.vessel).capacity
        if before[0] + content[0] > FULL * room:
            question = OperatorQuestion(
                f"The container at '{waste.name}' holds {1e3 * before[0]:.0f} g, and {1e3 * content[0]:.0f} g more are "
                "poured into it. Empty it.",
                "done",
                about="waste_full",
            )
            await carrier.ask(question, consent)
            before = (0.0, 0.0)
        async with carrier.driving(consent, f"empty {label(cup)} at '{waste.name}', and put it back"):
            place = self._vessels[cup].place
            await carrier.take(cup, consent)
            self._liquids.enter(cup, None, 0.0, self._mixture(cup))
            self._liquids.enter(waste.name, None, 0.0, "mixture")
            await carrier.pour_out(path, consent, f"emptying {label(cup)}")
            await self._truth.emptied(cup, seed)
            await carrier.back_home(path)
            carrier.mass[cup] = 0.0
            spread = math.hypot(before[1], content[1], FILM)
            self._liquids.enter(waste.name, before[0] + content[0], spread, "mixture")
            self._liquids.enter(cup, FILM, FILM, self._mixture(cup))
            self._record.add_component(cup, "", *own)
            await carrier.put(cup, place)

    async def _exchange(self, cup: str, consent: MotionConsent) -> None:
        """Have a cup emptied by the operator, or exchanged for an empty one."""
        place = self._carrier.at[cup]
        question = OperatorQuestion(
            f"Take '{cup}' from '{place}', and put it back there empty and dry, or another one.",
            "done",
            about="cup_exchanged",
        )
        await self._carrier.ask(question, consent)
        self._empty(cup)

    async def _known(self, cup: str, consent: MotionConsent) -> None:
        """Wait until a person has entered the content of a cup that is UNKNOWN."""
        problem = ""
        while self._record.unknown(cup):
            question = OperatorQuestion(
                f"What '{cup}' on '{self._carrier.at[cup]}' holds is UNKNOWN. Weigh it and enter its content with "
                f"'decant materials weigh LABORATORY/{cup}', or put an empty, dry cup there and enter 0 g.",
                "done",
                problem,
                about="cup_unknown",
            )
            await self._carrier.ask(question, consent)
            problem = "the account has no content for it yet"

    async def _refilled(
        self, source: DoseSource, name: str, liquid: Liquid, consent: MotionConsent, seed: int
    ) -> DoseSource:
        """Fill a source where it stands: by the refill device if that is there, else by the operator."""
        place = next(place for place in self._at_places if place.name == self._vessels[name].place)
        if place.use == "source" and self._supply is not None and source.before is not None:
            missing = max(source.mass - source.before, 0.0)
            reserve = await self._liquids.reserve(missing, consent)
            await self._supply.connect()
            filled = await self._supply.filled(source, liquid.density, seed)
            if filled is not None:
                if reserve is not None:
                    spread = math.hypot(reserve[1], filled.deviation)
                    self._liquids.enter(RESERVOIR, reserve[0] - missing, spread, liquid.name)
                return filled
        question = OperatorQuestion(
            f"Fill '{name}' on '{place.name}' with {liquid.name} to {1e3 * source.mass:.0f} g, weighed, and put it "
            "back there.",
            "done",
            about="source_refill",
        )
        await self._carrier.ask(question, consent)
        return source

    async def set_up(
        self, consent: MotionConsent, scene: Scene, dose: DoseTarget, readings: Callable[[], Sequence[DoseReading]]
    ) -> Weighing:
        """Put the cup on the balance, weigh it, and take the source. Returns the tare.

        Args:
            consent: of the dose.
            scene: vessels and liquid.
            dose: wanted amount.
            readings: all readings of the balance so far.

        Raises:
            LaboratoryError: something failed; nothing was poured.
        """
        source, cup = self.names(scene, dose)
        carrier = self._carrier
        other = next((name for name, place in carrier.at.items() if place == self._pan and name != cup), None)
        stayed = None if carrier.asked or carrier.at[cup] != self._pan else self._stayed
        self._stayed = None
        steps = [f"put {label(other)} back"] if other is not None else []
        steps += [f"put {label(cup)} on the balance"] if carrier.at[cup] != self._pan else []
        async with carrier.driving(consent, " and ".join([*steps, f"take {label(source)}"])):
            if other is not None:
                await carrier.move(other, self._vessels[other].place, consent)
            if carrier.at[cup] != self._pan:
                begin = len(readings())
                await carrier.move(cup, self._pan, consent)
                self.placed = _step(readings()[begin:], 0.5 * self._loads[cup].empty_mass)
            tare = stayed[1] if stayed is not None and stayed[0] == cup else await carrier.weigh()
            missing = await self._closed(cup, tare, source, consent)
            self._tare = _Tare(tare, self._record.held(cup) or (0.0, 0.0), missing)
            await carrier.take(source, consent)
        return tare

    async def _closed(self, cup: str, gross: Weighing, source: str, consent: MotionConsent) -> float | None:
        """Compare the weight of a cup with its account; a person is asked if they differ. Returns what is missing."""
        held, empty = self._record.held(cup), self._record.composition(cup).get("", (None, 0.0))
        content, spread = held or (0.0, 0.0)
        if empty[0] is None:  # its own mass is not known yet
            if content == 0.0:
                await self._carrier.check_empty(cup, gross, f"take {label(source)}", consent)
                self._record.add_component(cup, "", gross.mass, gross.uncertainty)
            return None
        missing = empty[0] + content - gross.mass
        sigma = math.sqrt(empty[1] ** 2 + spread**2 + gross.uncertainty**2)
        if abs(missing) > OPEN_LOSS + SURE * sigma:
            text = (
                f"'{cup}' on the balance holds {1e3 * (gross.mass - empty[0]):.2f} g, and {1e3 * content:.2f} g by the "
                f"account of vessels: {1e3 * missing:.2f} ± {1e3 * sigma:.2f} g are missing. Look for spilled liquid, "
                "and for a wrong cup; leave the vessels where they stand."
            )
            await self._carrier.ask_about_mass(text, {"missing_g": 1e3 * missing}, f"take {label(source)}", consent)
        self._liquids.enter(cup, gross.mass - empty[0], math.hypot(gross.uncertainty, empty[1]), self._mixture(cup))
        return missing

    def _mixture(self, cup: str) -> str:
        liquids = [name for name, (mass, _) in self._record.composition(cup).items() if name and mass != 0.0]
        return liquids[0] if len(liquids) == 1 else "mixture" if liquids else ""

    # ---- the dose

    def begins(self, scene: Scene, dose: DoseTarget) -> None:
        """The source is about to tilt: the contents are UNKNOWN until they are weighed."""
        source, cup = self.names(scene, dose)
        self._record.add_component(cup, scene.liquid.name, None, 0.0, source)
        self._liquids.unknown((cup,), self._mixture(cup))
        of, half = source_of(scene, dose), 0.5 * dose.amount  # until it is weighed, none or all of it may be gone
        left = max(of.mass - half, 0.0), math.hypot(of.deviation, half)
        self._liquids.enter(source, *left, scene.liquid.name)

    def withdraw(self, scene: Scene, dose: DoseTarget) -> None:
        """The source was not tilted: the contents are again what they were before `begins`."""
        source, cup = self.names(scene, dose)
        assert self._tare is not None
        self._record.add_component(cup, scene.liquid.name, 0.0, 0.0, source)
        self._liquids.enter(cup, *self._tare.content, self._mixture(cup))
        of = source_of(scene, dose)
        self._liquids.enter(source, of.mass, of.deviation, scene.liquid.name)

    async def finish(
        self,
        consent: MotionConsent,
        scene: Scene,
        dose: DoseTarget,
        amount: tuple[float, float],
        lost: tuple[float, float],
    ) -> CarriedDose:
        """Put the source back, weigh the cup, and put it back unless the next dose goes into it.

        Args:
            consent: of the dose.
            scene: vessels and liquid.
            dose: wanted amount.
            amount: dosed, and its standard deviation [kg].
            lost: from the source beyond it, and its standard deviation [kg].
        """
        source, cup = self.names(scene, dose)
        assert self._tare is not None
        tare, content = self._tare.weight, self._tare.content
        self._record.add_component(cup, scene.liquid.name, *amount, source)
        self._liquids.enter(cup, content[0] + amount[0], math.hypot(content[1], amount[1]), self._mixture(cup))
        of = source_of(scene, dose)
        left = max(of.mass - amount[0] - lost[0], 0.0), math.hypot(of.deviation, lost[1])
        self._liquids.enter(source, *left, scene.liquid.name)
        self._liquids.spilled(*lost)
        self._liquids.enter_tray(scene.liquid.name)
        carrier = self._carrier
        back = f"put {label(source)} back" + ("" if dose.stays else f", and {label(cup)} once it is weighed")
        carrier.mass[source] = max(carrier.mass[source] - amount[0], 0.0)
        async with carrier.driving(consent, back):
            await carrier.put(source, self._vessels[source].place)
            gross = await carrier.weigh()
            carrier.mass[cup] = content[0] + gross.mass - tare.mass
            spread = math.hypot(content[1], tare.uncertainty, gross.uncertainty)
            self._liquids.enter(cup, carrier.mass[cup], spread, self._mixture(cup))
            self._stayed = (cup, gross) if dose.stays else None  # the tare of the next dose, unless a person is asked
            if not dose.stays:
                await carrier.move(cup, self._vessels[cup].place, consent)
        return CarriedDose(cup, source, tare, gross, self._tare.missing)

    def _lose_moved(self) -> None:
        """A cup whose motion was interrupted, also by the end of the program, may have spilled: it is UNKNOWN."""
        for name in [name for name, place in self._record.stands().items() if place is None]:
            if name in self._vessels and not self._vessels[name].liquid and self._mixture(name):
                self._liquids.enter(name, None, 0.0, self._mixture(name))

    def forget(self) -> None:
        """The dose was interrupted: the vessels are laid out again before the next one."""
        with contextlib.suppress(LaboratoryError):
            self._lose_moved()
        self._carrier.forget()
        self._tare = self._stayed = None
