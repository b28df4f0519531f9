"""The cycle of calibration pours: the arm carries pourer and receiver, and pours the receiver back after each pour.

`VesselHandling` takes the place of the operator's hands between two pours. The weighings stay those of
`actors.balance.weighing_plan`; only the steps that need hands are carried out by the arm
(`actors.bench.vessel_carrying`). One cycle:

1. After the pour the arm puts the pourer down, takes the receiver off the balance, and weighs the pourer.
2. Before the next pour it pours the receiver back into the pourer on the balance, weighs the pourer, and has it
   topped up. Then it weighs the receiver, whose film is thereby known, and takes the pourer.
3. What has left the receiver has to be in the pourer, within the uncertainty of the weighings. If not, a person is
   asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

from actors.arm.arm_interface import PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.pour_feasibility import vessel as built
from actors.balance.balance_settings import BalanceSettings
from actors.balance.weighing_plan import GRIP, SURE, Weighing
from actors.bench.cell_liquids import CellLiquids
from actors.bench.ground_truth import GroundTruth
from actors.bench.liquid_supply import LiquidSupply
from actors.bench.vessel_carrying import (
    Load,
    MotionConsent,
    VesselCarrier,
    Ways,
    check_carrying,
    check_pour_path,
)
from actors.grippers.gripper_interface import GripperSettings
from actors.interfaces import InvalidActionError, Notice, OperatorQuestion
from actors.places import ROLES, Layout, PlaceSettings
from sim_engine.action import DEG, Action
from sim_engine.lip_flow import flow_course
from sim_engine.motion import plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselSpec
from sim_engine.vessel.vessel import Vessel

REFILLS = 2
"""Largest number of fillings by the refill device for one pour."""

BACK_SPEED, BACK_ANGLE, BACK_HOLD = 20 * DEG, 135 * DEG, 4.0
"""Pouring back: slow, as far as the arm may tilt, and held until the last drops have left."""

TAKE = "take the pourer"
SET_UP = "put the pourer down, put the receiver on the balance, and take the pourer"
CLEAR = "put the pourer down, and take the receiver off the balance"
WEIGH = "put the pourer on the balance"
BACK = "pour the receiver back into the pourer on the balance, slowly, and put it down"
"""Sequences of motions, as the operator agrees to them."""


@dataclass(frozen=True)
class _LastWeighings:
    """Weighings of the last pour, while its liquid is in the receiver."""

    received: Weighing
    pourer_after: Weighing


def _loads(scene: Scene) -> dict[str, Load]:
    liquid = scene.liquid
    return {
        role: Load(built(spec), liquid.mass, liquid.volume)
        for role, spec in (("pourer", scene.pourer), ("receiver", scene.receiver))
    }


def _things(scene: Scene) -> tuple[VesselSpec, VesselSpec, str]:
    return scene.pourer, scene.receiver, scene.liquid.name


def check_handling(places: Sequence[PlaceSettings], spec: ArmSettings, gripper: GripperSettings, scene: Scene) -> Ways:
    """Check that an arm can carry the vessels of a scene between all places of a cycle.

    Args:
        places: of the laboratory.
        spec: of the arm.
        gripper: its settings.
        scene: vessels and liquid.

    Raises:
        InvalidActionError: it cannot; the text states why.
    """
    layout, liquid = Layout.of(places), scene.liquid
    if layout.balance.tray is not None and layout.balance.tray < liquid.volume:
        raise InvalidActionError(
            f"the spill tray holds {1e6 * layout.balance.tray:.0f} ml, and one pour may spill "
            f"{1e6 * liquid.volume:.0f} ml"
        )
    return check_carrying((layout.balance, *layout.rest.values()), places, spec, gripper, _loads(scene))


def check_path(path: PlannedPour, places: Sequence[PlaceSettings], spec: ArmSettings, scene: Scene) -> None:
    """Check that a planned pour passes the vessels of a scene at the places of a cycle; see `check_pour_path`."""
    vessels = {role: load.vessel for role, load in _loads(scene).items()}
    check_pour_path(path, vessels["pourer"], places, spec, vessels)


def plan_back(places: Sequence[PlaceSettings], spec: ArmSettings, scene: Scene) -> PlannedPour:
    """Plan the pour from the receiver into the pourer on the balance, slow enough for its stream to stay near the lip.

    Args:
        places: of the laboratory.
        spec: of the arm.
        scene: vessels and liquid of the campaign.

    Raises:
        InvalidActionError: none of the tried actions is possible; the text states why the first one is not.
    """
    vessels = {role: load.vessel for role, load in _loads(scene).items()}
    try:
        return plan_emptying(replace(scene, pourer=scene.receiver, receiver=scene.pourer), places, spec, vessels)
    except InvalidActionError as error:
        raise InvalidActionError(
            f"the receiver cannot be poured back into the pourer on the balance: {error}"
        ) from error


def plan_emptying(
    scene: Scene, places: Sequence[PlaceSettings], spec: ArmSettings, vessels: Mapping[str, Vessel]
) -> PlannedPour:
    """Plan to empty a vessel into another one, slowly enough for its stream to stay near the lip.

    Args:
        scene: the two vessels and the liquid.
        places: of the laboratory.
        spec: of the arm, with the place where the pour ends.
        vessels: that may stand at the places, by name.

    Raises:
        InvalidActionError: none of the tried actions is possible; the text states why the first one is not.
    """
    kind, back = arm_kind(spec), replace(scene, fixed={})
    source, target = built(scene.pourer), built(scene.receiver)
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
    raise InvalidActionError(reason)


class VesselHandling:
    """Pourer and receiver of a bench, and the arm that carries them.

    Args:
        places: of the laboratory.
        carrier: the arm with its gripper.
        liquids: contents of the cell.
        weighing: settings of the balance under the receiver.
        supply: has the refill device, if there is one.
        truth: of the bench.
        tell: receives notices.
    """

    def __init__(
        self,
        places: Sequence[PlaceSettings],
        carrier: VesselCarrier,
        liquids: CellLiquids,
        weighing: BalanceSettings,
        supply: LiquidSupply | None,
        truth: GroundTruth,
        tell: Callable[[Notice], None],
    ) -> None:
        self._places, self._layout = tuple(places), Layout.of(places)
        self._carrier, self._liquids, self._weighing = carrier, liquids, weighing
        self._supply, self._truth, self._tell = supply, truth, tell
        self._scene: Scene | None = None
        self._ways: Ways = {}
        self._back: PlannedPour | None = None
        self._poured: _LastWeighings | None = None
        self._dry: Weighing | None = None
        self._gross: Weighing | None = None
        self._pending: tuple[_LastWeighings, Weighing, Weighing] | None = None
        self._cycle: dict[str, float] = {}

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
        carrier, before = self._carrier, (self._carrier.spec, self._scene)
        if self._scene is not None and _things(self._scene) != _things(scene):
            self.forget()  # the operator brings other vessels, or another liquid
        carrier.spec, self._scene = spec, scene
        if not self._ways or before != (spec, scene):
            self._ways = check_handling(self._places, spec, carrier.held.spec, scene)
            self._back = plan_back(self._places, spec, scene)
        carrier.loads, carrier.ways = _loads(scene), self._ways
        check_path(path, self._places, spec, scene)

    # ---- the cycle

    async def prepare(self, consent: MotionConsent, empty: Weighing | None, seed: int) -> dict[str, Weighing]:
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
        assert self._scene is not None
        await self._liquids.room_for_spills(self._scene.liquid, self._scene.liquid.mass, consent)
        if self._poured is None or empty is None or self._gross is None:
            await self._lay_out(consent)
            return {}
        self._carrier.require_known()
        poured, before = self._poured, self._gross
        async with self._carrier.driving(consent, BACK, *([self._fill] if self._refills else []), SET_UP):
            await self._carrier.take("receiver", consent)
            await self._pour_back(consent, seed)
            self._carrier.mass["receiver"] = 0.0
            back = await self._carrier.weigh()  # while the arm waits for the warning time after its release
            await self._carrier.put("receiver", self._layout.rest["receiver"].name)
        self._poured, self._pending = None, (poured, before, back)
        full = await self._topped_up(consent, back, empty, seed)
        self._carrier.mass["pourer"] = full.mass - empty.mass
        self._enter("pourer", full.mass - empty.mass, math.hypot(full.uncertainty, empty.uncertainty))
        return {"pourer_full": full}

    async def _pour_back(self, consent: MotionConsent, seed: int) -> None:
        """Pour from the receiver in the gripper into the pourer on the balance; the arm ends at home."""
        path = self._back
        assert path is not None
        self._unknown_contents()
        await self._carrier.pour_out(path, consent, "pouring back")
        await self._truth.poured_back(seed)
        await self._carrier.back_home(path)

    async def _topped_up(self, consent: MotionConsent, back: Weighing, empty: Weighing, seed: int) -> Weighing:
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
                reserve = await self._liquids.reserve(missing, consent)
                async with self._carrier.driving(consent, self._fill, SET_UP):
                    await self._carrier.move("pourer", stand.name, consent)
                    filled = await self._supply.top_up(missing, liquid.density, seed)
                    self._carrier.mass["pourer"] = liquid.mass
                    await self._carrier.move("pourer", self._layout.balance.name, consent)
                if filled:
                    problem, before, now = "the refill device has not filled it up", now, await self._carrier.weigh()
                    self._liquids.taken(reserve, before, now, liquid.name)
                    continue
            question = OperatorQuestion(
                f"The pourer on the balance should hold {1e3 * liquid.mass:.1f} g and holds "
                f"{1e3 * (now.mass - empty.mass):.1f} g. Fill it up, or take some out, and leave it there.",
                "done",
                problem,
                about="top_up",
                details={"missing_g": 1e3 * missing},
            )
            await self._carrier.ask(question, consent)
            now, problem = await self._carrier.weigh(), "it does not hold what is asked for"

    @property
    def _refills(self) -> bool:
        return self._layout.rest["pourer"].use == "source" and self._supply is not None

    @property
    def _fill(self) -> str:
        return f"carry the pourer to '{self._layout.rest['pourer'].name}', where it is filled up"

    async def _lay_out(self, consent: MotionConsent) -> None:
        """Have the operator lay out the vessels; afterwards it is known where they stand."""
        await self._carrier.let_go(consent)
        stand = self._layout.rest["receiver"].name
        question = OperatorQuestion(
            f"Put the empty, dry receiver on the place '{stand}'. Leave the gripper and all other places empty. Keep "
            "the pourer: you weigh and fill it next.",
            "done",
            self._carrier.unknown(),
            about="laid_out",
            details={"receiver": stand},
        )
        await self._carrier.ask(question, consent)
        self._dry = self._gross = self._poured = self._pending = None
        self._carrier.laid_out({"receiver": stand}, {})
        self._carrier.record.put("pourer", None, "with the operator")
        self._enter("receiver", 0.0, 0.0)
        self._enter("pourer", None, 0.0)

    async def around(self, question: OperatorQuestion, consent: MotionConsent) -> str:
        """Carry out the step of a weighing with the arm; other questions go to the operator."""
        balance, stands = self._layout.balance.name, self._layout.rest
        about = question.about
        if not question.problem and self._carrier.at.get("pourer") is not None:
            if about == "set_up":
                await self._set_up(consent)
                return "done"
            if about == "cleared_after":
                async with self._carrier.driving(consent, CLEAR, WEIGH):
                    await self._carrier.put("pourer", stands["pourer"].name)
                    await self._carrier.move("receiver", stands["receiver"].name, consent)
                return "done"
            if about == "pourer_after":
                async with self._carrier.driving(consent, WEIGH):
                    await self._carrier.move("pourer", balance, consent)
                return "done"
        details = {**question.details, "place": balance}
        answer = await self._carrier.ask(
            replace(question, text=question.text.replace(GRIP, ""), details=details), consent
        )
        if about in ("pourer_empty", "pourer_full"):
            self._carrier.at["pourer"] = balance
            self._carrier.record.put("pourer", balance, "put there by the operator")
            if about == "pourer_full" and self._scene is not None:
                self._carrier.mass["pourer"] = self._scene.liquid.mass
        return answer

    async def _set_up(self, consent: MotionConsent) -> None:
        """Receiver on the balance, weighed with what stuck to it; pourer in the gripper."""
        balance, stands = self._layout.balance.name, self._layout.rest
        async with self._carrier.driving(consent, SET_UP):
            await self._carrier.move("pourer", stands["pourer"].name, consent)
            await self._carrier.move("receiver", balance, consent)
            gross = await self._carrier.weigh()
            await self._account(gross, consent)
            self._dry, self._gross = self._dry or gross, gross
            await self._carrier.take("pourer", consent)
        self._unknown_contents()

    async def _account(self, gross: Weighing, consent: MotionConsent) -> None:
        """Compare the masses of a whole cycle; ask a person if they do not close."""
        if self._dry is None:
            await self._carrier.check_empty("receiver", gross, TAKE, consent)
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
        self._liquids.spilled(missing, sigma)
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
        text = (
            f"The masses do not close: {1e3 * left:.2f} g left the receiver when it was poured back, and the pourer "
            f"gained {1e3 * gained:.2f} g, {1e3 * missing:.2f} ± {1e3 * sigma:.2f} g less. Look for spilled liquid, "
            "and for a wrong vessel; leave the vessels where they stand."
        )
        details = {"missing_g": 1e3 * missing, "uncertainty_g": 1e3 * sigma}
        await self._carrier.ask_about_mass(text, details, TAKE, consent)

    def poured(self, weighed: Mapping[str, Weighing]) -> None:
        """The pour was weighed: what it poured is in the receiver, and the pourer stands on the balance."""
        received, full, after, empty = (
            weighed[key] for key in ("received", "pourer_full", "pourer_after", "pourer_empty")
        )
        self._poured = _LastWeighings(received, after)
        gross, dry = self._gross, self._dry
        film = () if gross is None or dry is None or gross is dry else (gross, dry)
        left = film[0].mass - film[1].mass if film else 0.0
        self._carrier.mass = {"pourer": after.mass - empty.mass, "receiver": received.mass + left}
        for role, parts in (("pourer", (after, empty)), ("receiver", (received, *film))):
            self._enter(role, self._carrier.mass[role], math.hypot(*(amount.uncertainty for amount in parts)))
        spread = math.hypot(*(amount.uncertainty for amount in (full, received, after)))
        self._liquids.spilled(full.mass - after.mass - received.mass, spread)
        assert self._scene is not None
        self._liquids.enter_tray(self._scene.liquid.name)

    @property
    def cycle(self) -> dict[str, float]:
        """Accounted masses of the cycle before this pour [g]: film in the receiver, poured back, missing."""
        return {name: round(value, 4) for name, value in self._cycle.items()}

    def forget(self) -> None:
        """The cycle was interrupted: the vessels are laid out again before the next pour."""
        self._carrier.forget()
        self._poured = self._pending = None

    def _enter(self, vessel: str, mass: float | None, deviation: float) -> None:
        assert self._scene is not None
        self._liquids.enter(vessel, mass, deviation, self._scene.liquid.name)

    def _unknown_contents(self) -> None:
        assert self._scene is not None
        self._liquids.unknown(ROLES, self._scene.liquid.name)
