"""The arm handles the vessels: it carries them between the places of a laboratory, and pours the receiver back.

`VesselHandling` takes the place of the operator's hands between two pours. The weighings stay those of
`actors.balance.weighing_plan`; only the steps that need hands are carried out by the arm, after one consent for each
sequence of motions (`actors.bench.consent`). One cycle:

1. After the pour the arm puts the pourer down, takes the receiver off the balance, and weighs the pourer.
2. Before the next pour it pours the receiver back into the pourer on the balance, weighs the pourer, and has it
   topped up. Then it weighs the receiver, whose film is thereby known, and takes the pourer.
3. What has left the receiver has to be in the pourer, within the uncertainty of the weighings. If not, a person is
   asked.

Every place is entered in a `PlaceRecord` before and after each motion. A vessel whose motion was interrupted is
UNKNOWN; nothing moves then until a person has laid out the vessels again, or has corrected the record.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Protocol

from actors.arm.arm_device import STUCK, DeviceArm
from actors.arm.arm_interface import ArmRefusedError, PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.planned_pour import PlaceWay
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSettings
from actors.balance.weighing_plan import GRIP, SURE, PourMasses, weighing_uncertainty
from actors.bench.ground_truth import GroundTruth
from actors.bench.held_vessel import HeldVessel, grip_limits
from actors.bench.liquid_supply import LiquidSupply
from actors.bench.pour_feasibility import vessel as built
from actors.grippers.gripper_interface import GripperError, GripperSettings
from actors.interfaces import InvalidActionError, LaboratoryError, Notice, OperatorQuestion
from actors.places import ROLES, Layout, PlaceRecord, PlaceSettings, Role
from sim_engine.action import DEG, Action
from sim_engine.lip_flow import flow_course
from sim_engine.motion import plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselSpec
from sim_engine.vessel.vessel import Vessel

FILMED = 5e-3
"""A vessel that holds less liquid than this is carried as an empty one [kg]."""

WRONG = 5e-3
"""Difference of an empty vessel from the mass that its file states [kg], above which it may be another one."""

REFILLS = 2
"""Largest number of fillings by the refill device for one pour."""

GONE_TIME = 6.0
"""Longest time for the balance to show that a vessel was lifted off it [s of bench time]."""

BACK_SPEED, BACK_ANGLE, BACK_HOLD = 20 * DEG, 135 * DEG, 4.0
"""Pouring back: slow, as far as the arm may tilt, and held until the last drops have left."""

IN_GRIPPER = ""
"""Place of the vessel in the gripper."""

TRAY, RESERVOIR = "tray", "reservoir"
"""Their names in the account of vessels."""

SET_UP = "put the pourer down, put the receiver on the balance, and take the pourer"
CLEAR = "put the pourer down, and take the receiver off the balance"
WEIGH = "put the pourer on the balance"
BACK = "pour the receiver back into the pourer on the balance, slowly, and put it down"
"""Sequences of motions, as the operator agrees to them."""


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
class _Poured:
    """Weighings of the last pour, while its liquid is in the receiver."""

    received: PourMasses
    pourer_after: PourMasses


def _vessels(scene: Scene) -> dict[Role, Vessel]:
    return {"pourer": built(scene.pourer), "receiver": built(scene.receiver)}


def _things(scene: Scene) -> tuple[VesselSpec, VesselSpec, str]:
    return scene.pourer, scene.receiver, scene.liquid.name


def check_handling(
    places: Sequence[PlaceSettings], spec: ArmSettings, gripper: GripperSettings, scene: Scene
) -> dict[tuple[str, bool], PlaceWay]:
    """Check that an arm can carry the vessels of a scene between all places.

    Args:
        places: of the laboratory.
        spec: of the arm.
        gripper: its settings.
        scene: vessels and liquid.

    Returns:
        The ways by the name of the place, and whether liquid is carried.

    Raises:
        InvalidActionError: it cannot; the text states why.
    """
    vessels, kind = _vessels(scene), arm_kind(spec)
    if (room := Layout.of(places).balance.tray) is not None and room < scene.liquid.volume:
        raise InvalidActionError(
            f"the spill tray holds {1e6 * room:.0f} ml, and one pour may spill {1e6 * scene.liquid.volume:.0f} ml"
        )
    for role in ROLES:
        name, grip = vessels[role].name, vessels[role].spec.grip
        if grip is None or grip.mass is None:
            raise InvalidActionError(
                f"'{name}' is carried between places: its vessel file needs its empty mass, 'grip: {{mass: 312 g}}'"
            )
        full = grip.mass + scene.liquid.mass
        if spec.payload_limit is not None and full > spec.payload_limit:
            raise InvalidActionError(
                f"'{name}' is too heavy when full: {1e3 * full:.0f} g without the gripper, and arm.payload is "
                f"{1e3 * spec.payload_limit:.0f} g"
            )
        try:
            grip_limits(vessels[role], gripper, spec)
        except LaboratoryError as error:
            raise InvalidActionError(str(error)) from error
    if problems := [text for _, text in kind.place_problems(places, vessels)]:
        raise InvalidActionError("; ".join(problems))
    layout, volumes = Layout.of(places), {False: None, True: scene.liquid.volume}
    return {
        (place.name, full): kind.way(place, places, vessels, volume)
        for place in (layout.balance, *layout.rest.values())
        for full, volume in volumes.items()
    }


def plan_back(places: Sequence[PlaceSettings], spec: ArmSettings, scene: Scene) -> PlannedPour:
    """Plan the pour from the receiver into the pourer on the balance, slow enough for its stream to stay near the lip.

    Args:
        places: of the laboratory.
        spec: of the arm.
        scene: vessels and liquid of the campaign.

    Raises:
        InvalidActionError: none of the tried actions is possible; the text states why the first one is not.
    """
    vessels, kind = _vessels(scene), arm_kind(spec)
    source, target = vessels["receiver"], vessels["pourer"]
    back = replace(scene, pourer=scene.receiver, receiver=scene.pourer, fixed={})
    angle = min(BACK_ANGLE, getattr(getattr(spec, "limits", None), "tilt", BACK_ANGLE) - 1 * DEG)
    speed = min(BACK_SPEED, spec.tilt_speed_limit or BACK_SPEED)
    reason = ""
    for above, share in product((0.02, 0.04, 0.08), (0.5, 0.25, 0.75)):
        action = Action(
            angular_velocity=speed, x_offset=0.0, height=source.rim_height + above, max_angle=angle,
            hold_time=BACK_HOLD, return_velocity=2.0 * speed, angular_acceleration=100 * DEG,
        )  # fmt: skip
        try:
            course = flow_course(plan_motion(back, action, source, target), scene.liquid, source, target)
            jet = source.opening_radius if course is None else course.landing()
            # the first liquid flies, the last drops fall from the lip: the opening is between them
            offset = source.opening_radius + share * max(jet - source.opening_radius, 0.0)
            path = kind.plan(back, replace(action, x_offset=offset))
        except (InvalidActionError, ValueError) as error:
            reason = reason or str(error)
            continue
        problems = kind.in_the_way(path, source, places, vessels)
        if not problems:
            return path
        reason = reason or problems[0]
    raise InvalidActionError(f"the receiver cannot be poured back into the pourer on the balance: {reason}")


class VesselHandling:
    """The vessels of a bench, and the arm that carries them.

    Args:
        places: of the laboratory.
        arm: with a gripper.
        spec: of the arm.
        held: the gripper.
        balance, weighing: the balance under the receiver, and its settings.
        record: account of what stands where.
        supply: has the refill device, if there is one.
        truth: of the bench.
        tell: receives notices.
    """

    def __init__(
        self,
        places: Sequence[PlaceSettings],
        arm: DeviceArm,
        spec: ArmSettings,
        held: HeldVessel,
        balance: DeviceBalance,
        weighing: BalanceSettings,
        record: PlaceRecord,
        supply: LiquidSupply | None,
        truth: GroundTruth,
        tell: Callable[[Notice], None],
    ) -> None:
        self._places, self._layout = {place.name: place for place in places}, Layout.of(places)
        self._arm, self._spec, self._held, self._balance, self._weighing = arm, spec, held, balance, weighing
        self._record, self._supply, self._truth, self._tell = record, supply, truth, tell
        self._scene: Scene | None = None
        self._at: dict[Role, str] = {}
        self._mass: dict[Role, float] = {}
        self._ways: dict[tuple[str, bool], PlaceWay] = {}
        self._way: PlannedPour | PlaceWay | None = None
        self._motion: tuple[Role, str] | None = None
        self._away = False
        self._back: PlannedPour | None = None
        self._poured: _Poured | None = None
        self._dry: PourMasses | None = None
        self._gross: PourMasses | None = None
        self._pending: tuple[_Poured, PourMasses, PourMasses] | None = None
        self._cycle: dict[str, float] = {}
        self._agreed: tuple[str, ...] = ()
        self._asked = False
        self._in_tray = (0.0, 0.0)

    # ---- checks

    def fit(self, spec: ArmSettings, scene: Scene, path: PlannedPour) -> None:
        """Check, before anything is asked or moves, that the vessels of a scene can be handled.

        Args:
            spec: of the connected arm.
            scene: vessels and liquid.
            path: of the pour.

        Raises:
            InvalidActionError: they cannot; the text states why.
        """
        places, before = tuple(self._places.values()), (self._spec, self._scene)
        if self._scene is not None and _things(self._scene) != _things(scene):
            self.forget()  # the operator brings other vessels, or another liquid
        self._spec, self._scene = spec, scene
        if not self._ways or before != (spec, scene):
            self._ways = check_handling(places, spec, self._held.spec, scene)
            self._back = plan_back(places, spec, scene)
        if problems := arm_kind(spec).in_the_way(path, built(scene.pourer), places, _vessels(scene)):
            raise InvalidActionError("; ".join(problems))

    # ---- the cycle

    async def prepare(self, consent: MotionConsent, empty: PourMasses | None, seed: int) -> dict[str, PourMasses]:
        """Prepare the next pour: lay out the vessels, or pour back what the last one has poured.

        Args:
            consent: of the pour.
            empty: weighing of the empty pourer, if there is one.
            seed: of a virtual bench.

        Returns:
            The weighing of the full pourer, if it is known now; empty if the operator fills and weighs it.

        Raises:
            LaboratoryError: something failed; nothing was poured in this pour yet.
        """
        self._cycle = {}
        await self._room_for_spills(consent)
        if self._poured is None or empty is None or self._gross is None:
            await self._lay_out(consent)
            return {}
        assert self._scene is not None
        self._require_known()
        poured, before = self._poured, self._gross
        async with self._driving(consent, BACK, *([self._fill] if self._refills else []), SET_UP):
            await self._take("receiver", consent)
            await self._pour_back(consent, seed)
            self._mass["receiver"] = 0.0
            back = await self._weigh()  # while the arm waits for the warning time after its release
            await self._put("receiver", self._layout.rest["receiver"].name)
        self._poured, self._pending = None, (poured, before, back)
        full = await self._topped_up(consent, back, empty, seed)
        self._mass["pourer"] = full.mass - empty.mass
        self._enter("pourer", full.mass - empty.mass, math.hypot(full.uncertainty, empty.uncertainty))
        return {"pourer_full": full}

    async def _room_for_spills(self, consent: MotionConsent) -> None:
        """Have the spill tray emptied if the liquid of one more pour could overflow it."""
        assert self._scene is not None
        room, liquid, held = self._layout.balance.tray, self._scene.liquid, self._record.held(TRAY)
        if room is None:
            return
        if held is None or held[0] + SURE * held[1] + liquid.mass > room * liquid.density:
            holds = "An unknown mass" if held is None else f"About {1e3 * held[0]:.0f} g"
            question = OperatorQuestion(
                f"{holds} is in the spill tray, and one more pour may spill up to {1e3 * liquid.mass:.0f} g. Empty it.",
                "done",
                about="tray_full",
                details={} if held is None else {"held_g": 1e3 * held[0]},
            )
            await self._ask(question, consent)
            held = (0.0, 0.0)
            self._enter(TRAY, *held)
        self._in_tray = held

    def _spilled(self, mass: float, deviation: float) -> None:
        """Add what was spilled [kg]; a loss within its uncertainty counts as well, a gain does not."""
        self._in_tray = (self._in_tray[0] + max(mass, 0.0), math.hypot(self._in_tray[1], deviation))

    async def _pour_back(self, consent: MotionConsent, seed: int) -> None:
        """Pour from the receiver in the gripper into the pourer on the balance; the arm ends at home."""
        path = self._back
        assert path is not None
        self._unknown_contents()
        self._way, self._away = path, True
        await self._arm.move_to_start(path)
        try:
            await self._truth.lasting(self._arm.execute(path, lambda state: None), path.pour_time)
        except ArmRefusedError:
            raise
        except STUCK as error:
            await consent.bring_upright(error, path)
            await self._arm.release()
            await self._arm.retreat(path)
            self._away = False
            raise LaboratoryError(f"pouring back was interrupted: {error}") from error
        await self._truth.poured_back(seed)
        await self._arm.retreat(path)
        self._away = False
        await self._arm.release()  # to the rest of what was agreed to

    async def _topped_up(self, consent: MotionConsent, back: PourMasses, empty: PourMasses, seed: int) -> PourMasses:
        """Fill the pourer up, by the refill device or the operator, until it holds what is asked for."""
        assert self._scene is not None
        liquid, now, problem, tries = self._scene.liquid, back, "", 0
        stand = self._layout.rest["pourer"]
        while True:
            missing = liquid.mass - (now.mass - empty.mass)
            if abs(missing) <= 0.5 * self._weighing.load_tolerance:
                return now
            if missing > 0.0 and tries < REFILLS and self._refills and self._supply is not None:
                tries += 1
                reserve = await self._reserve(missing, consent)
                async with self._driving(consent, self._fill, SET_UP):
                    await self._move("pourer", stand.name, consent)
                    filled = await self._supply.top_up(missing, liquid.density, seed)
                    self._mass["pourer"] = liquid.mass
                    await self._move("pourer", self._layout.balance.name, consent)
                if filled:
                    problem, before, now = "the refill device has not filled it up", now, await self._weigh()
                    if reserve is not None:
                        spread = math.hypot(reserve[1], before.uncertainty, now.uncertainty)
                        self._enter(RESERVOIR, reserve[0] - (now.mass - before.mass), spread)
                    continue
            question = OperatorQuestion(
                f"The pourer on the balance should hold {1e3 * liquid.mass:.1f} g and holds "
                f"{1e3 * (now.mass - empty.mass):.1f} g. Fill it up, or take some out, and leave it there.",
                "done",
                problem,
                about="top_up",
                details={"missing_g": 1e3 * missing},
            )
            await self._ask(question, consent)
            now, problem = await self._weigh(), "it does not hold what is asked for"

    @property
    def _refills(self) -> bool:
        return self._layout.rest["pourer"].use == "source" and self._supply is not None

    @property
    def _fill(self) -> str:
        return f"carry the pourer to '{self._layout.rest['pourer'].name}', where it is filled up"

    async def _reserve(self, missing: float, consent: MotionConsent) -> tuple[float, float] | None:
        """What the reservoir of the refill device holds [kg]; None if the account has no content of it.

        While it may hold less than is `missing` [kg], a person is asked to fill it and to enter what it holds.
        """
        problem = ""
        while (held := self._record.held(RESERVOIR)) is not None and held[0] - SURE * held[1] < missing:
            question = OperatorQuestion(
                f"The reservoir of the refill device holds {1e3 * held[0]:.0f} g by the account of vessels, and "
                f"{1e3 * missing:.0f} g are needed. Fill it, and enter what it holds with 'decant materials weigh "
                f"LABORATORY/{RESERVOIR}', where LABORATORY is the name of this one.",
                "done",
                problem,
                about="reservoir",
                details={"held_g": 1e3 * held[0], "missing_g": 1e3 * missing},
            )
            await self._ask(question, consent)
            problem = "the account has not enough for it yet"
        return held

    async def _lay_out(self, consent: MotionConsent) -> None:
        """Have the operator lay out the vessels; afterwards it is known where they stand."""
        if self._held.holds:
            await self._held.let_go(consent.asked)
        await self._held.activated(consent.asked)
        unknown = [f"where the {name} stands" for name, place in self._record.stands().items() if place is None]
        stand = self._layout.rest["receiver"].name
        question = OperatorQuestion(
            f"Put the empty, dry receiver on the place '{stand}'. Leave the gripper and all other places empty. Keep "
            "the pourer: you weigh and fill it next.",
            "done",
            f"it is unknown {' and '.join(unknown)}" if unknown else "",
            about="laid_out",
            details={"receiver": stand},
        )
        await self._ask(question, consent)
        self._at, self._mass, self._dry, self._gross = {"receiver": stand}, {}, None, None
        self._poured = self._pending = None
        for name in self._record.stands():  # frees the places before they are filled
            self._record.put(name, None, "laid out again")
        self._record.put("receiver", stand, "laid out by the operator")
        self._record.put("pourer", None, "with the operator")
        self._enter("receiver", 0.0, 0.0)
        self._enter("pourer", None, 0.0)

    async def around(self, question: OperatorQuestion, consent: MotionConsent) -> str:
        """Carry out the step of a weighing with the arm; other questions go to the operator."""
        balance, stands = self._layout.balance.name, self._layout.rest
        about = question.about
        if not question.problem and self._at.get("pourer") is not None:
            if about == "set_up":
                await self._set_up(consent)
                return "done"
            if about == "cleared_after":
                async with self._driving(consent, CLEAR, WEIGH):
                    await self._put("pourer", stands["pourer"].name)
                    await self._move("receiver", stands["receiver"].name, consent)
                return "done"
            if about == "pourer_after":
                async with self._driving(consent, WEIGH):
                    await self._move("pourer", balance, consent)
                return "done"
        details = {**question.details, "place": balance}
        answer = await self._ask(replace(question, text=question.text.replace(GRIP, ""), details=details), consent)
        if about in ("pourer_empty", "pourer_full"):
            self._at["pourer"] = balance
            self._record.put("pourer", balance, "put there by the operator")
            if about == "pourer_full" and self._scene is not None:
                self._mass["pourer"] = self._scene.liquid.mass
        return answer

    async def _set_up(self, consent: MotionConsent) -> None:
        """Receiver on the balance, weighed with what stuck to it; pourer in the gripper."""
        balance, stands = self._layout.balance.name, self._layout.rest
        async with self._driving(consent, SET_UP):
            await self._move("pourer", stands["pourer"].name, consent)
            await self._move("receiver", balance, consent)
            gross = await self._weigh()
            await self._account(gross, consent)
            self._dry, self._gross = self._dry or gross, gross
            await self._take("pourer", consent)
        self._unknown_contents()

    async def _account(self, gross: PourMasses, consent: MotionConsent) -> None:
        """Compare the masses of a whole cycle; ask a person if they do not close."""
        if self._dry is None:
            await self._right_vessel(gross, consent)
        else:
            self._cycle["film_g"] = 1e3 * (gross.mass - self._dry.mass)
        if self._pending is None:
            return
        (poured, before, back), self._pending = self._pending, None
        left = before.mass + poured.received.mass - gross.mass
        gained = back.mass - poured.pourer_after.mass
        parts = (before, poured.received, gross, back, poured.pourer_after)
        sigma = math.sqrt(sum(amount.uncertainty**2 for amount in parts))
        missing = left - gained
        self._spilled(missing, sigma)
        self._cycle |= {"poured_back_g": 1e3 * gained, "missing_g": 1e3 * missing, "uncertainty_g": 1e3 * sigma}
        self._tell(
            Notice(
                "note",
                f"poured back: {1e3 * left:.2f} g left the receiver, {1e3 * gained:.2f} g are in the pourer, missing "
                f"{1e3 * missing:.2f} ± {1e3 * sigma:.2f} g; film in the receiver "
                f"{self._cycle.get('film_g', 0.0):.2f} g",
                about="accounted",
            )
        )
        if abs(missing) <= SURE * sigma:
            return
        question = OperatorQuestion(
            f"The masses do not close: {1e3 * left:.2f} g left the receiver when it was poured back, and the pourer "
            f"gained {1e3 * gained:.2f} g, {1e3 * missing:.2f} ± {1e3 * sigma:.2f} g less. Look for spilled liquid, "
            "and for a wrong vessel; leave the vessels where they stand. Shall it go on?",
            "yes or no",
            about="mass",
            details={"missing_g": 1e3 * missing, "uncertainty_g": 1e3 * sigma},
        )
        await self._go_on(question, consent)

    async def _right_vessel(self, gross: PourMasses, consent: MotionConsent) -> None:
        """Ask a person if the dry receiver on the balance does not weigh what its file states."""
        grip = self._vessel("receiver").spec.grip
        assert grip is not None
        assert grip.mass is not None
        if abs(gross.mass - grip.mass) <= WRONG:
            return
        question = OperatorQuestion(
            f"The empty receiver on the balance weighs {1e3 * gross.mass:.1f} g, and its file states "
            f"{1e3 * grip.mass:.1f} g. Is it the right vessel, empty and dry? Shall it go on?",
            "yes or no",
            about="mass",
            details={"missing_g": 1e3 * (grip.mass - gross.mass)},
        )
        await self._go_on(question, consent)

    async def _go_on(self, question: OperatorQuestion, consent: MotionConsent) -> None:
        """Ask a person about masses, and then for the rest of the sequence."""
        if (await self._ask(question, consent)).strip().lower() not in ("yes", "y"):
            raise LaboratoryError("the masses are not what they should be, and the operator ended the cycle")
        await consent.given(move_question("take the pourer"))

    def poured(self, weighed: Mapping[str, PourMasses]) -> None:
        """The pour was weighed: what it poured is in the receiver, and the pourer stands on the balance."""
        received, full, after, empty = (
            weighed[key] for key in ("received", "pourer_full", "pourer_after", "pourer_empty")
        )
        self._poured = _Poured(received, after)
        gross, dry = self._gross, self._dry
        film = () if gross is None or dry is None or gross is dry else (gross, dry)
        left = film[0].mass - film[1].mass if film else 0.0
        self._mass = {"pourer": after.mass - empty.mass, "receiver": received.mass + left}
        for role, parts in (("pourer", (after, empty)), ("receiver", (received, *film))):
            self._enter(role, self._mass[role], math.hypot(*(amount.uncertainty for amount in parts)))  # type: ignore[index]
        spread = math.hypot(*(amount.uncertainty for amount in (full, received, after)))
        self._spilled(full.mass - after.mass - received.mass, spread)
        if self._layout.balance.tray is not None:
            self._enter(TRAY, *self._in_tray)

    @property
    def cycle(self) -> dict[str, float]:
        """Accounted masses of the cycle before this pour [g]: film in the receiver, poured back, missing."""
        return {name: round(value, 4) for name, value in self._cycle.items()}

    def forget(self) -> None:
        """The cycle was interrupted: the vessels are laid out again before the next pour."""
        self._at, self._poured, self._pending, self._agreed = {}, None, None, ()

    async def _ask(self, question: OperatorQuestion, consent: MotionConsent) -> str:
        """Ask a person, who may reach into the cell: motions that follow are agreed to again."""
        self._agreed, self._asked = (), True
        return await consent.asked(question)

    # ---- moves

    @contextlib.asynccontextmanager
    async def _driving(self, consent: MotionConsent, does: str, *then: str) -> AsyncIterator[None]:
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
        self._agreed, self._asked = (), False
        try:
            yield
            self._agreed = () if self._asked else then
        except LaboratoryError as error:
            self.forget()
            if self._motion is not None:
                role, note = self._motion
                self._motion = None
                with contextlib.suppress(LaboratoryError):  # the reason stands in `error`
                    self._record.put(role, None, f"interrupted: {note}")
            if self._away or isinstance(error, STUCK):
                await consent.bring_home(error, begun=False, path=self._way)
                self._away = False
            raise

    async def _move(self, role: Role, place: str, consent: MotionConsent) -> None:
        if self._at.get(role) == place:
            return
        await self._take(role, consent)
        await self._put(role, place)

    async def _take(self, role: Role, consent: MotionConsent) -> None:
        """Take a vessel from its place; the arm ends at home with it."""
        place, vessel = self._at[role], self._vessel(role)
        on_balance = place == self._layout.balance.name
        width = grip_limits(vessel, self._held.spec, self._spec).width
        self._note_motion(role, f"the arm began to take it from '{place}'")
        await self._held.open_at(vessel)
        await self._drive(place, full=False, homewards=False)
        shown = (await self._balance.read()).mass if on_balance else math.nan
        await self._grip(role, place, width, consent)
        await self._truth.lifted(role)
        self._at[role] = IN_GRIPPER
        await self._drive(place, full=self._mass.get(role, 0.0) > FILMED, homewards=True)
        if on_balance:
            await self._gone(role, shown)

    async def _grip(self, role: Role, place: str, width: float, consent: MotionConsent) -> None:
        """Close the gripper at a place until the grasp is checked; a failed one needs the operator."""
        vessel = self._vessel(role)
        await self._truth.between(role, place, width)
        try:
            await self._held.grip_at(vessel, role)
            return
        except GripperError as error:
            problem = f"the {role} was not grasped at '{place}': {error}"
        while True:
            question = OperatorQuestion(
                f"Put the {role} upright between the fingers, on the place '{place}', and take your hands away. The "
                "fingers open and close at once when you say so. May they?",
                "yes or no",
                problem,
                about="grasp_failed",
                details={"role": role, "place": place},
            )
            if (await self._ask(question, consent)).strip().lower() not in ("yes", "y"):
                raise LaboratoryError(problem)
            await self._held.open_at(vessel)
            await self._truth.between(role, place, width)
            try:
                await self._held.grip_at(vessel, role)
            except GripperError as error:
                problem = f"the {role} was not grasped at '{place}' again: {error}"
                continue
            await consent.given(move_question(f"carry the {role} on"))
            return

    async def _gone(self, role: Role, shown: float) -> None:
        """Check that the balance has lost the weight of a vessel that was taken off it."""
        grip = self._vessel(role).spec.grip
        assert grip is not None
        assert grip.mass is not None
        waited = 0.0
        while True:
            now = (await self._balance.read()).mass
            if shown - now > 0.5 * grip.mass:
                return
            if waited >= GONE_TIME:
                raise LaboratoryError(
                    f"the {role} was gripped on the balance and lifted, and the balance shows {1e3 * now:.1f} g "
                    f"instead of {1e3 * grip.mass:.0f} g less than {1e3 * shown:.1f} g: is it still there?"
                )
            await self._truth.wait(0.5)
            waited += 0.5

    async def _put(self, role: Role, place: str) -> None:
        """Put the vessel in the gripper down at a free place; the arm ends at home, the gripper empty."""
        others = {name: stands for name, stands in self._record.stands().items() if name != role}
        if taken := [name for name, stands in others.items() if stands in (None, place)]:
            raise LaboratoryError(f"'{place}' may not be free: where does '{taken[0]}' stand?")
        self._note_motion(role, f"the arm began to carry it to '{place}'")
        await self._drive(place, full=self._mass.get(role, 0.0) > FILMED, homewards=False)
        await self._held.open_at(self._vessel(role))
        await self._truth.placed(role, place, on_balance=place == self._layout.balance.name)
        self._at[role] = place
        self._record.put(role, place)
        self._motion = None
        await self._drive(place, full=False, homewards=True)

    def _note_motion(self, role: Role, note: str) -> None:
        self._record.put(role, None, note)
        self._motion = role, note

    async def _drive(self, place: str, *, full: bool, homewards: bool) -> None:
        way = replace(self._ways[place, full], homewards=homewards)
        if not self._away:  # an arm that was left away from home has to return by the way that it came
            self._way, self._away = way, True
        loaded = IN_GRIPPER in self._at.values()
        await self._truth.lasting(self._arm.carry(way, loaded=loaded), way.approach_time)
        self._away = not homewards

    def _vessel(self, role: Role) -> Vessel:
        assert self._scene is not None
        return _vessels(self._scene)[role]

    def _require_known(self) -> None:
        """Compare the places with the record, which a person may have changed."""
        recorded = self._record.stands()
        for role, place in self._at.items():
            if recorded.get(role) != place:
                raise LaboratoryError(
                    f"the {role} stood at '{place}', and the account of vessels has "
                    f"{recorded.get(role) or 'UNKNOWN'}: nothing moves before the vessels are laid out again"
                )

    # ---- weights

    async def _weigh(self) -> PourMasses:
        weight = await self._balance.weigh()
        return PourMasses(weight.mass, weighing_uncertainty(weight.step, self._weighing.deviation))

    def _enter(self, vessel: str, mass: float | None, deviation: float) -> None:
        assert self._scene is not None
        self._record.content(vessel, mass, deviation, self._scene.liquid.name)

    def _unknown_contents(self) -> None:
        """A pour begins: the contents are unknown until they are weighed."""
        for name in (*ROLES, *([] if self._layout.balance.tray is None else [TRAY])):
            self._enter(name, None, 0.0)


def move_question(text: str) -> OperatorQuestion:
    """Ask for consent to a sequence of motions."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will {text}; its gripper opens and closes. May it?",
        "yes or no",
        about="move",
        hands=False,
    )
