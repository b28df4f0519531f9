"""The arm carries vessels between the places of a laboratory, in the place of the operator's hands.

`VesselCarrier` takes, grips, carries and puts down any vessel by its name, after one consent for each sequence of
motions (`actors.bench.consent`). Roles belong to the pour: `actors.bench.vessel_handling` carries pourer and receiver
of calibration pours, `actors.bench.dose_handling` the sources and cups of doses. `check_carrying` plans all ways and
checks them before anything moves.

Every place is entered in a `PlaceRecord` before and after each motion. A vessel whose motion was interrupted is
UNKNOWN; nothing moves then until a person has laid out the vessels again, or has corrected the record.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from actors.arm.arm_device import STUCK, DeviceArm
from actors.arm.arm_interface import ArmRefusedError, PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.planned_pour import PlaceWay
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSettings
from actors.balance.weighing_plan import Weighing, weighing_uncertainty
from actors.bench.ground_truth import GroundTruth
from actors.bench.held_vessel import HeldVessel, grip_limits
from actors.grippers.gripper_interface import GripperError, GripperSettings
from actors.interfaces import InvalidActionError, LaboratoryError, OperatorQuestion
from actors.places import OUTSIDE, ROLES, PlaceRecord, PlaceSettings
from sim_engine.vessel.vessel import Vessel

FILMED = 5e-3
"""A vessel that holds less liquid than this is carried as an empty one [kg]."""

GONE_TIME = 6.0
"""Longest time for the balance to show that a vessel was lifted off it [s of bench time]."""

WRONG = 5e-3
"""Difference of an empty vessel from the mass that its file states [kg], above which it may be another one."""

SHOWN = 5
"""Largest number of problems of places that one error states."""

IN_GRIPPER = ""
"""Place of the vessel in the gripper."""


class MotionConsent(Protocol):
    """The operator's consent to motions; see `actors.bench.consent.Consent`."""

    async def asked(self, question: OperatorQuestion) -> str:
        """Ask the operator."""
        ...

    async def given(self, question: OperatorQuestion) -> None:
        """Ask for consent to a motion, and release the arm."""
        ...

    async def bring_upright(self, error: Exception, path: PlannedPour | None = None) -> None:
        """Bring a stopped, tilted vessel upright."""
        ...

    async def bring_home(self, error: Exception, *, begun: bool, path: PlannedPour | PlaceWay | None = None) -> None:
        """Bring the arm home after a stop."""
        ...


@dataclass(frozen=True)
class Load:
    """A vessel as it is carried.

    Attributes:
        vessel: with its empty mass in `grip`.
        mass, volume: largest load of liquid [kg], [m³].
    """

    vessel: Vessel
    mass: float
    volume: float

    @property
    def empty_mass(self) -> float:
        """Mass of the empty vessel [kg]; `check_carrying` has refused a vessel without."""
        grip = self.vessel.spec.grip
        assert grip is not None
        assert grip.mass is not None
        return grip.mass


Ways = dict[tuple[str, bool], PlaceWay]
"""The ways by the name of the place, and whether liquid is carried."""


def check_carrying(
    stops: Iterable[PlaceSettings],
    places: Sequence[PlaceSettings],
    spec: ArmSettings,
    gripper: GripperSettings,
    loads: Mapping[str, Load],
    others: Mapping[str, Vessel] = {},
) -> Ways:
    """Check that an arm can carry vessels between places.

    Args:
        stops: places to which vessels are carried.
        places: all places; `holds` names the vessels in `loads` that may stand there.
        spec: of the arm.
        gripper: its settings.
        loads: the vessels by name.
        others: vessels that stay where they stand, by name.

    Raises:
        InvalidActionError: it cannot; the text states why, for all places.
    """
    kind = arm_kind(spec)
    widths, unfit = dict[Load, float](), dict[str, str]()
    for name, load in loads.items():
        if load in widths:
            continue
        try:
            widths[load] = _check_load(load, spec, gripper)
        except InvalidActionError as error:
            unfit.setdefault(str(error), name)
    if unfit:
        raise _refused(unfit)
    vessels = {name: load.vessel for name, load in loads.items()} | dict(others)
    opened = {name: widths[load] for name, load in loads.items()}
    first = {place.name: next((name for name in place.holds if name in loads), "") for place in places}
    if problems := {text: first[places[i].name] for i, text in kind.place_problems(places, vessels, opened)}:
        raise _refused(problems)
    ways, impossible = Ways(), dict[str, str]()
    for place in stops:
        largest = max((loads[name].volume for name in place.holds if name in loads), default=0.0)
        for full, volume in ((False, None), (True, largest)):
            try:
                ways[place.name, full] = kind.way(place, places, vessels, volume)
            except InvalidActionError as error:
                impossible.setdefault(str(error), first[place.name])
    if impossible:
        raise _refused(impossible)
    return ways


def check_pour_path(
    path: PlannedPour,
    pourer: Vessel,
    places: Sequence[PlaceSettings],
    spec: ArmSettings,
    vessels: Mapping[str, Vessel],
) -> None:
    """Check that a planned pour passes the vessels that may stand at the places.

    Args:
        path: of the pour.
        pourer: vessel in the gripper.
        places: as in `check_carrying`.
        spec: of the arm.
        vessels: by the names in `holds`.

    Raises:
        InvalidActionError: it comes too near to some; the text lists all.
    """
    if problems := arm_kind(spec).in_the_way(path, pourer, places, vessels):
        raise InvalidActionError("; ".join(problems))


def _refused(problems: Mapping[str, str]) -> InvalidActionError:
    """The error with all problems and their vessels; of a rack with many, its text has the first ones."""
    more = f"; and {len(problems) - SHOWN} more" if len(problems) > SHOWN else ""
    return InvalidActionError("; ".join(list(problems)[:SHOWN]) + more, problems)


def _check_load(load: Load, spec: ArmSettings, gripper: GripperSettings) -> float:
    """Width of the fingers that are open for a vessel [m]; raises InvalidActionError if it cannot be carried."""
    name, grip = load.vessel.name, load.vessel.spec.grip
    if grip is None or grip.mass is None:
        raise InvalidActionError(
            f"'{name}' is carried between places: its vessel file needs its empty mass, 'grip: {{mass: 312 g}}'"
        )
    full = grip.mass + load.mass
    if spec.payload_limit is not None and full > spec.payload_limit:
        raise InvalidActionError(
            f"'{name}' is too heavy when full: {1e3 * full:.0f} g without the gripper, and arm.payload is "
            f"{1e3 * spec.payload_limit:.0f} g"
        )
    try:
        return min(grip_limits(load.vessel, gripper, spec).width + gripper.clearance, gripper.widest)
    except LaboratoryError as error:
        raise InvalidActionError(str(error)) from error


def label(name: str) -> str:
    """A vessel in messages: by its role in calibration pours, else by its name."""
    return f"the {name}" if name in ROLES else f"'{name}'"


class VesselCarrier:
    """The arm of a bench as it carries vessels.

    Args:
        balance_place: name of the place on the balance.
        arm: with a gripper.
        spec: of the arm.
        held: the gripper.
        balance: under the receiver.
        weighing: its settings.
        record: account of what stands where.
        truth: of the bench.

    Attributes:
        at: place of each vessel that was laid out; `IN_GRIPPER` for the one in the gripper.
        mass: liquid in them as last weighed [kg].
        asked: whether a person was asked something since the last sequence began.
        loads, ways: of the vessels that are carried now, see `check_carrying`.
    """

    def __init__(
        self,
        balance_place: str,
        arm: DeviceArm,
        spec: ArmSettings,
        held: HeldVessel,
        balance: DeviceBalance,
        weighing: BalanceSettings,
        record: PlaceRecord,
        truth: GroundTruth,
    ) -> None:
        self.arm, self.spec, self.held, self.balance, self.record = arm, spec, held, balance, record
        self._on_balance, self._weighing, self._truth = balance_place, weighing, truth
        self.at: dict[str, str] = {}
        self.mass: dict[str, float] = {}
        self.loads: Mapping[str, Load] = {}
        self.ways: Ways = {}
        self._way: PlannedPour | PlaceWay | None = None
        self._motion: tuple[str, str] | None = None
        self._away = False
        self._agreed: tuple[str, ...] = ()
        self.asked = False

    # ---- masses

    async def weigh(self) -> Weighing:
        """Weigh what is on the balance."""
        weight = await self.balance.weigh()
        return Weighing(weight.mass, weighing_uncertainty(weight.step, self._weighing.deviation))

    async def check_empty(self, name: str, gross: Weighing, rest: str, consent: MotionConsent) -> None:
        """Ask a person if an empty vessel on the balance does not weigh what its file states; see `ask_about_mass`."""
        stated = self.loads[name].empty_mass
        if abs(gross.mass - stated) <= WRONG:
            return
        text = (
            f"The empty vessel on the balance, {label(name)}, weighs {1e3 * gross.mass:.1f} g, and its file states "
            f"{1e3 * stated:.1f} g. Is it the right one, empty and dry?"
        )
        await self.ask_about_mass(text, {"missing_g": 1e3 * (stated - gross.mass)}, rest, consent)

    async def ask_about_mass(self, text: str, details: dict[str, float], rest: str, consent: MotionConsent) -> None:
        """Ask a person about masses that do not agree, and then for the rest of the sequence.

        Args:
            text: the problem.
            details: numbers of the question.
            rest: motion that follows.
            consent: of the pour or dose.

        Raises:
            LaboratoryError: the answer is not yes.
        """
        question = OperatorQuestion(f"{text} Shall it go on?", "yes or no", about="mass", details={**details})
        if (await self.ask(question, consent)).strip().lower() not in ("yes", "y"):
            raise LaboratoryError("the masses are not what they should be, and the operator did not continue")
        await consent.given(move_question(rest))

    # ---- where they stand

    async def let_go(self, consent: MotionConsent) -> None:
        """Empty the gripper and make it ready, before the operator lays out the vessels."""
        if self.held.holds:
            await self.held.let_go(consent.asked)
        await self.held.activated(consent.asked)

    def unknown(self) -> str:
        """The vessels whose place is UNKNOWN, as the reason of a question; '' if there are none."""
        names = [f"where {label(name)} stands" for name, place in self.record.stands().items() if place is None]
        return f"it is unknown {' and '.join(names)}" if names else ""

    def laid_out(self, at: Mapping[str, str], mass: Mapping[str, float]) -> None:
        """The operator has laid out the vessels; all others are out of the cell."""
        self.at, self.mass = dict(at), dict(mass)
        for name in self.record.stands():  # frees the places before they are filled
            self.record.put(name, None if name in at else OUTSIDE, "laid out again")
        for name, place in at.items():
            self.record.put(name, place, "laid out by the operator")

    def require_known(self) -> None:
        """Compare the places with the record, which a person may have changed.

        Raises:
            LaboratoryError: they differ.
        """
        recorded = self.record.stands()
        for name, place in self.at.items():
            if recorded.get(name) != place:
                raise LaboratoryError(
                    f"{label(name)} stood at '{place}', and the account of vessels has "
                    f"{recorded.get(name) or 'UNKNOWN'}: nothing moves before the vessels are laid out again"
                )

    def forget(self) -> None:
        """A sequence was interrupted: the vessels are laid out again before the next pour."""
        self.at, self._agreed = {}, ()

    async def ask(self, question: OperatorQuestion, consent: MotionConsent) -> str:
        """Ask a person, who may reach into the cell: motions that follow are agreed to again."""
        self._agreed, self.asked = (), True
        return await consent.asked(question)

    # ---- moves

    @contextlib.asynccontextmanager
    async def driving(self, consent: MotionConsent, does: str, *then: str) -> AsyncIterator[None]:
        """Drive a sequence after one consent; a stop ends it, and a person brings the arm home.

        Args:
            consent: of the pour.
            does: the sequence.
            then: those that may follow once the balance is read, and need no other consent unless a person is asked
                something before them.

        Raises:
            LaboratoryError: it was interrupted; the vessel that was moved is UNKNOWN.
        """
        if does not in self._agreed:
            await consent.given(move_question("; once the balance is read, ".join((does, *then))))
        self._agreed, self.asked = (), False
        try:
            yield
            self._agreed = () if self.asked else then
        except LaboratoryError as error:
            self.forget()
            if self._motion is not None:
                name, note = self._motion
                self._motion = None
                with contextlib.suppress(LaboratoryError):  # the reason stands in `error`
                    self.record.put(name, None, f"interrupted: {note}")
            if self._away or isinstance(error, STUCK):
                await consent.bring_home(error, begun=False, path=self._way)
                self._away = False
            raise

    async def pour_out(self, path: PlannedPour, consent: MotionConsent, text: str) -> None:
        """Pour from the vessel in the gripper along a planned path; the arm ends at home, released for what follows.

        Args:
            path: of the pour.
            consent: of the pour.
            text: what was interrupted, for the error.
        """
        self._way, self._away = path, True
        await self.arm.move_to_start(path)
        try:
            await self._truth.lasting(self.arm.execute(path, lambda state: None), path.pour_time)
        except ArmRefusedError:
            raise
        except STUCK as error:
            await consent.bring_upright(error, path)
            await self.arm.release()
            await self.arm.retreat(path)
            self._away = False
            raise LaboratoryError(f"{text} was interrupted: {error}") from error

    async def back_home(self, path: PlannedPour) -> None:
        """End `pour_out`: home, and released for the rest of what was agreed to."""
        await self.arm.retreat(path)
        self._away = False
        await self.arm.release()

    async def move(self, name: str, place: str, consent: MotionConsent) -> None:
        """Carry a vessel to a free place, unless it stands there."""
        if self.at.get(name) == place:
            return
        await self.take(name, consent)
        await self.put(name, place)

    async def take(self, name: str, consent: MotionConsent) -> None:
        """Take a vessel from its place; the arm ends at home with it."""
        place, vessel = self.at[name], self.loads[name].vessel
        on_balance = place == self._on_balance
        width = grip_limits(vessel, self.held.spec, self.spec).width
        self._note_motion(name, f"the arm began to take it from '{place}'")
        await self.held.open_at(vessel)
        await self._drive(place, full=False, homewards=False)
        shown = (await self.balance.read()).mass if on_balance else math.nan
        await self._grip(name, place, width, consent)
        await self._truth.lifted(name)
        self.at[name] = IN_GRIPPER
        await self._drive(place, full=self.mass.get(name, 0.0) > FILMED, homewards=True)
        if on_balance:
            await self._gone(name, shown)

    async def _grip(self, name: str, place: str, width: float, consent: MotionConsent) -> None:
        """Close the gripper at a place until the grasp is checked; a failed one needs the operator."""
        vessel, thing = self.loads[name].vessel, label(name)
        await self._truth.between(name, place, width)
        try:
            await self.held.grip_at(vessel, thing)
            return
        except GripperError as error:
            problem = f"{thing} was not grasped at '{place}': {error}"
        while True:
            question = OperatorQuestion(
                f"Put {thing} upright between the fingers, on the place '{place}', and take your hands away. The "
                "fingers open and close at once when you say so. May they?",
                "yes or no",
                problem,
                about="grasp_failed",
                details={"role": name, "place": place},
            )
            if (await self.ask(question, consent)).strip().lower() not in ("yes", "y"):
                raise LaboratoryError(problem)
            await self.held.open_at(vessel)
            await self._truth.between(name, place, width)
            try:
                await self.held.grip_at(vessel, thing)
            except GripperError as error:
                problem = f"{thing} was not grasped at '{place}' again: {error}"
                continue
            await consent.given(move_question(f"carry {thing} on"))
            return

    async def _gone(self, name: str, shown: float) -> None:
        """Check that the balance has lost the weight of a vessel that was taken off it."""
        empty, waited = self.loads[name].empty_mass, 0.0
        while True:
            now = (await self.balance.read()).mass
            if shown - now > 0.5 * empty:
                return
            if waited >= GONE_TIME:
                raise LaboratoryError(
                    f"{label(name)} was gripped on the balance and lifted, and the balance shows {1e3 * now:.1f} g "
                    f"instead of {1e3 * empty:.0f} g less than {1e3 * shown:.1f} g: is it still there?"
                )
            await self._truth.wait(0.5)
            waited += 0.5

    async def put(self, name: str, place: str) -> None:
        """Put the vessel in the gripper down at a free place; the arm ends at home, the gripper empty."""
        others = {other: stands for other, stands in self.record.stands().items() if other != name}
        if taken := [other for other, stands in others.items() if stands in (None, place)]:
            raise LaboratoryError(f"'{place}' may not be free: where does '{taken[0]}' stand?")
        self._note_motion(name, f"the arm began to carry it to '{place}'")
        await self._drive(place, full=self.mass.get(name, 0.0) > FILMED, homewards=False)
        on_balance = place == self._on_balance
        async with self._truth.slowed() if on_balance else contextlib.nullcontext():  # the balance shows its lag
            await self.held.open_at(self.loads[name].vessel)
            await self._truth.placed(name, place, on_balance=on_balance)
            self.at[name] = place
            self.record.put(name, place)
            self._motion = None
            await self._drive(place, full=False, homewards=True)

    def _note_motion(self, name: str, note: str) -> None:
        self.record.put(name, None, note)
        self._motion = name, note

    async def _drive(self, place: str, *, full: bool, homewards: bool) -> None:
        way = replace(self.ways[place, full], homewards=homewards)
        if not self._away:  # an arm that was left away from home has to return by the way that it came
            self._way, self._away = way, True
        loaded = IN_GRIPPER in self.at.values()
        await self._truth.lasting(self.arm.carry(way, loaded=loaded), way.approach_time)
        self._away = not homewards


def move_question(text: str) -> OperatorQuestion:
    """Ask for consent to a sequence of motions."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will {text}; its gripper opens and closes. May it?",
        "yes or no",
        about="move",
        hands=False,
    )
