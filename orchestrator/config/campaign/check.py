"""What a campaign file can't show by itself: whether its vessels exist as solids, hold the liquid, and stay clear."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from actors.arm.spec import ArmSpec
from actors.bench.planning import vessel as built
from actors.protocols import InvalidActionError, UnreachablePlaceError
from orchestrator.config.campaign.sense import senseless
from orchestrator.config.yaml.errors import ConfigError, Problem
from orchestrator.config.yaml.files import why_not_writable
from orchestrator.config.yaml.source import Document, Loc
from orchestrator.plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from orchestrator.strategies.calibration.prior import actions_all_over
from sim_engine.action import Action
from sim_engine.contact import contact_during, describe_contact
from sim_engine.hydrostatics import level
from sim_engine.motion import plan_motion
from sim_engine.space import Space
from sim_engine.task import Scene
from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.spec import MeshShape, VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

CORNERS, DRAWN = 64, 16
"""Actions of a space that are tried beside its middle before saying that all of it touches."""


@dataclass(frozen=True)
class _Role:
    """A scene's part in a campaign.

    Attributes:
        text: for messages.
        section: of the file, which overrides what stands at its top.
        receiver: where the receiver may be named, the most particular place first.
    """

    text: str
    section: Loc = ()
    receiver: tuple[Loc, ...] = ()

    def places(self, *keys: Loc) -> tuple[Loc, ...]:
        """Where keys may stand, the most particular place first; the section itself where they don't."""
        return (*(self.section + key for key in keys), *keys, self.section)


Place = tuple[float, float, float]


def _place(action: Action) -> Place:
    """Where a pour begins: what the way there depends on."""
    return action.x_offset, action.y_offset, action.height


def _nothing(told: object) -> None:
    """Where nobody listens."""


@dataclass
class _Checker:
    source: Path
    arm: ArmSpec | None = None
    document: Document | None = None
    warn: Callable[[Problem], None] = _nothing
    doing: Callable[[str], None] = _nothing
    problems: list[Problem] = field(default_factory=list)
    vessels: dict[VesselSpec, Vessel | None] = field(default_factory=dict)
    landings: dict[tuple[object, ...], float | None] = field(default_factory=dict)

    def add(self, places: tuple[Loc, ...], text: str) -> None:
        """Note a problem at the first of some places that the campaign's file has."""
        self.problems.append(self.problem(places, text))

    def problem(self, places: tuple[Loc, ...], text: str) -> Problem:
        """A problem at the first of some places that the campaign's file has."""
        document = self.document
        found = None if document is None else next((loc for loc in places if loc in document.marks), None)
        if document is None or found is None:
            return Problem(self.source, 0, 0, "", text)
        return document.problem(found, text)

    def vessel(self, spec: VesselSpec, places: tuple[Loc, ...]) -> Vessel | None:
        if spec not in self.vessels:
            try:
                self.vessels[spec] = built(spec)
            except (VesselError, OSError) as error:
                where = f" ({spec.shape.path})" if isinstance(spec.shape, MeshShape) else ""
                self.add(places, f"vessel '{spec.name}'{where}: {error}")
                self.vessels[spec] = None
        return self.vessels[spec]

    def scene(self, scene: Scene, role: _Role, wanted: float | None = None) -> tuple[Vessel, Vessel] | None:
        """The scene's vessels, if both exist and hold the liquid.

        Args:
            wanted: volume that the receiver has to hold [m³]; the whole load unless given.
        """
        places = {"pourer": role.places(("pourer",)), "receiver": (*role.receiver, *role.places(("receiver",)))}
        pourer = self.vessel(scene.pourer, places["pourer"])
        receiver = self.vessel(scene.receiver, places["receiver"])
        if pourer is None or receiver is None:
            return None
        ok = True
        load = f"the {scene.liquid.name} ({scene.liquid.mass * 1e3:g} g)"
        less = wanted is not None and wanted < scene.liquid.volume
        for vessel, name in ((pourer, "pourer"), (receiver, "receiver")):
            what, volume = (
                (load, scene.liquid.volume) if wanted is None or vessel is pourer else ("what is asked for", wanted)
            )
            try:
                check_holds(vessel, volume)
            except VesselError as error:
                ok = False
                self.add(places[name], f"{role.text}: {name} can't hold {what if less else load}: {error}")
        if ok and less and scene.liquid.volume > receiver.capacity:
            text = (
                f"{role.text}: the receiver holds {1e6 * receiver.capacity:.4g} mL, enough for what is asked for, not "
                f"for {load}: a pour that misses its target may run over"
            )
            self.warn(self.problem(places["receiver"], text))
        return (pourer, receiver) if ok else None

    def reachable(self, plan: CalibrationPlan | DeploymentPlan, scene: Scene, role: _Role) -> None:
        """Some action of the space must pour, not touch, and be one that the arm can make."""
        wanted = plan.wanted(scene) if isinstance(plan, DeploymentPlan) else None
        vessels = self.scene(scene, role, wanted)
        self._payload(scene)
        actions = plan.actions
        trials = actions_all_over(actions, plan.constraints, corners=CORNERS, drawn=DRAWN)
        if vessels is None or self._never_pours(scene, trials, vessels[0], role):
            return
        first = beyond = ""
        barred: set[Place] = set()
        for i, chosen in enumerate(trials, start=1):
            if i > 1:
                self.doing(f"{role.text}: {len(trials)} actions are tried, none of {i - 1} can be made")
            try:
                action = scene.action(chosen)
                if _place(action) in barred:
                    continue
                contact = touch(scene, action, *vessels)
            except ValueError as error:  # an action out of bounds, or a motion that can't be made
                contact = str(error)
            if contact is None:
                problem = self._for_the_arm(scene, action, actions, barred)
                if not problem:
                    for places, text in senseless(plan, scene, *vessels, self.arm, self.landings):
                        self.warn(self.problem(role.places(*places), f"{role.text}: {text}"))
                    return
                beyond = beyond or problem
            else:
                first = first or contact
        if beyond:
            text = f"{role.text}: the arm can make none of {len(trials)} actions that were tried; for example {beyond}"
            self.add(role.places(("actions",)), text)
            return
        text = (
            f"{role.text}: the vessels touch at every action that was tried; for example {first}. "
            f"A larger x_offset or height would clear them"
        )
        self.add(role.places(("actions",)), text)

    def _payload(self, scene: Scene) -> None:
        """What the arm believes to carry can't weigh less than the liquid alone."""
        carries = None if self.arm is None else self.arm.payload_limit
        if carries is None or carries >= scene.liquid.mass:
            return
        text = (
            f"the arm is set to carry {carries * 1e3:g} g (arm.payload), less than the {scene.liquid.name} "
            f"alone, {scene.liquid.mass * 1e3:g} g; the payload is gripper and filled pourer, in the laboratory's file "
            "and on the pendant"
        )
        self.add((("liquid", "mass"), ("liquid",)), text)

    def _never_pours(self, scene: Scene, trials: Sequence[dict[str, float]], pourer: Vessel, role: _Role) -> bool:
        """Whether the liquid stays below the lip at the largest tilt of the space; warned of if not."""
        tilts = []
        for chosen in trials:
            try:
                tilts.append(scene.action(chosen).max_angle)
            except ValueError:
                continue  # no such action, which `touch` will tell
        volume = scene.liquid.volume
        if not tilts or level(pourer, volume, max(tilts)) > 0.0:
            return False
        steps = np.radians(np.arange(math.ceil(math.degrees(max(tilts))), 181))
        lip = next((math.degrees(tilt) for tilt in steps if level(pourer, volume, float(tilt)) > 0.0), None)
        when = "never reaches the lip" if lip is None else f"reaches the lip at {lip:.0f} deg; raise max_angle"
        text = (
            f"{role.text}: no action that was tried pours anything: max_angle is at most "
            f"{math.degrees(max(tilts)):.4g} deg, and the {scene.liquid.name} ({scene.liquid.mass * 1e3:g} g) {when}"
        )
        self.add(role.places(("actions", "max_angle"), ("motion", "max_angle")), text)
        return True

    def _for_the_arm(self, scene: Scene, action: Action, actions: Space, barred: set[Place]) -> str:
        """Why the laboratory's arm, if it has one, can't make it; '' if it can.

        Args:
            barred: places that the arm can't get to from home, whatever it does there. Filled here.
        """
        if self.arm is None:
            return ""
        try:
            self.arm.plan(scene, action)
        except InvalidActionError as error:
            if isinstance(error, UnreachablePlaceError):
                barred.add(_place(action))
            return f"{action.display(*actions.names)}: {error}"
        return ""

    def recorded(self, scene: Scene, recorded: list[Action], role: _Role, place: Loc) -> None:
        """Weighed pours have been poured: if their vessels touch, the scene is described wrongly."""
        vessels = self.scene(scene, role)
        if vessels is None:
            return
        # The slowest to vary is the place: pours of one place and one largest tilt go through the same poses.
        seen = set()
        for action in recorded:
            at = (action.x_offset, action.y_offset, action.height)
            tilts = [a.max_angle for a in recorded if (a.x_offset, a.y_offset, a.height) == at]
            if at in seen or action.max_angle < max(tilts):
                continue
            seen.add(at)
            contact = touch(scene, action, *vessels)
            if contact is not None:
                shown = action.display("x_offset", "height", "max_angle")
                text = (
                    f"{role.text}: a recorded pour ({shown}) could not have been made: {contact}. Is the scene right?"
                )
                self.add((place, role.section), text)
                return


def check_campaign(
    plan: CampaignPlan,
    *,
    as_written: bool = True,
    warn: Callable[[Problem], None] = _nothing,
    doing: Callable[[str], None] = _nothing,
) -> list[Problem]:
    """Build the vessels of a campaign and try its actions.

    Runs must find a folder. Checked for every scene: both vessels can be built and hold the liquid; some action of the
    space tilts far enough for the liquid to leave, and one lets the vessels stay clear of each other and can be made by
    the laboratory's arm (middle, corners and a few drawn at random are tried); recorded pours stay clear.

    Args:
        plan: of the campaign.
        as_written: whether its vessels are those of its file; places in it would else mislead.
        warn: called with what can be run and makes little sense.
        doing: called with what is being tried, where that takes long.

    Returns:
        What is wrong, with its place as far as the campaign's file has one; empty when the campaign can start.
    """
    try:
        document = Document.read(plan.source) if as_written else None
    except ConfigError:
        document = None  # a plan that was never a file
    checker = _Checker(plan.source, plan.laboratory.arm, document, warn, doing)
    at: Loc
    if (problem := why_not_writable(plan.outputs.directory)) is not None:
        checker.add((("outputs", "directory"),), problem)
    if plan.calibration is not None:
        calibration, section = plan.calibration, ("calibration",)
        if calibration.records is None:
            for scene in calibration.poured:
                checker.reachable(calibration, scene, _Role("calibration", section))
        else:
            pours, at = calibration.records.pours, ("calibration", "pours")
            checker.recorded(calibration.scene, [p.action for p in pours], _Role("calibration.pours", section), at)
        if calibration.transfer is not None:
            transfer, at = calibration.transfer, ("calibration", "pours", "transfer")
            role = _Role("calibration.pours.transfer", section, ((*at, "receiver"),))
            checker.recorded(transfer.scene, [p.action for p in transfer.pours], role, at)
    if plan.deployment is not None:
        for i, scene in enumerate(plan.deployment.scenes):
            receiver = (("deployment", "receiver"), ("deployment", "receivers", i), ("receivers", i))
            role = _Role(f"deployment into '{scene.receiver.name}'", ("deployment",), receiver)
            checker.reachable(plan.deployment, scene, role)
    return list(dict.fromkeys(checker.problems))


def check_vessels(scene: Scene, source: Path, wanted: float | None = None) -> list[Problem]:
    """Build the vessels of one scene.

    Args:
        scene: any.
        source: the campaign's file.
        wanted: volume that the receiver has to hold [m³]; the whole load unless given.

    Returns:
        What is wrong: a vessel that is none, or can't hold the load.
    """
    checker = _Checker(source)
    checker.scene(scene, _Role(f"{scene.pourer.name} into {scene.receiver.name}"), wanted)
    return checker.problems


def touch(scene: Scene, action: Action, pourer: Vessel, receiver: Vessel) -> str | None:
    """Where the vessels touch during an action, in words; None when they stay clear.

    Raises:
        ValueError: the motion can't be made.
    """
    motion = plan_motion(scene, action, pourer, receiver)
    found = contact_during(motion, pourer, receiver)
    if found is None:
        return None
    contact, tilt = found
    return describe_contact(
        contact, tilt=tilt, pourer=f"pourer '{scene.pourer.name}'", receiver=f"receiver '{scene.receiver.name}'"
    )
