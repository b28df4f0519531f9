"""Checks of a campaign beyond its file: vessels, reachable actions, and settings that make little sense.

- `check_campaign` and `check_vessels` build the vessels and try actions. Vessels must be valid solids, hold the liquid
  and not touch; the arm must be able to make some action.
- One dose out of each vessel that is no straight cup is simulated (`orchestrator.campaigns.dose_flows`).
- `senseless` finds settings that can run but waste pours: streams that miss the receiver (range of a free jet), and
  tilt speeds that the arm refuses.

Nothing is poured, and nothing else is simulated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from actors.arm.arm_interface import PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.pour_feasibility import path_of
from actors.arm.pour_feasibility import vessel as built
from actors.grippers.gripper_interface import GripperSettings
from actors.interfaces import DoseTarget, InvalidActionError, LaboratoryError, UnreachablePlaceError
from actors.laboratory_settings import BenchSettings, LaboratorySettings
from actors.places import CellVessel, PlaceSettings, all_places
from orchestrator.campaigns.dose_flows import dose_flows
from orchestrator.campaigns.yaml.file_access import why_not_writable
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.campaigns.yaml.yaml_source import Document, Loc
from orchestrator.learning.calibration.action_prior import actions_all_over
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan, DispensePlan
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.collision import contact_during, describe_contact
from sim_engine.hydrostatics import level, retained_volume
from sim_engine.lip_flow import flow_course
from sim_engine.liquids import SimulationParameters
from sim_engine.motion import plan_motion
from sim_engine.scene import MIRRORED_FROM, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.simulator import why_whole
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselError, VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

BESIDE = 0.015
"""Largest distance outside the opening at which part of a stream still enters it [m]."""

LEAST = 1.0 / 3.0
"""Minimum share of a range of offsets from which a stream must hit; below it, most pours of a campaign are wasted."""

MOST_TRIED = 9
"""Maximum number of pours whose streams are computed, in all dimensions other than x_offset."""

DOSE_TILTS = Space((Axis("angular_velocity", math.radians(5.0), math.radians(40.0)),))
"""Speeds of the tilt within which most of a dose flows."""

FULLEST, ASKEW = 0.97, 2.0 * SimulationParameters.info()["tilt_zero"].tolerance
"""Largest share of what a source of doses holds at rest, if it is held askew by twice the tolerance of the grip [rad].
Its surface is not at rest when it is carried and begins to turn."""

Senseless = tuple[tuple[Loc, ...], str]
"""Keys that the finding may concern, the most specific first, and the message."""


def senseless(
    plan: CalibrationPlan | DeploymentPlan,
    scene: Scene,
    pourer: Vessel,
    receiver: Vessel,
    arm: ArmSettings | None,
    landings: dict[tuple[object, ...], float | None],
) -> list[Senseless]:
    """Settings of a stage's actions that make little sense in one of its scenes.

    Args:
        plan: plan of the stage.
        scene: one of its scenes.
        pourer, receiver: geometry of the scene's vessels, which hold its load.
        arm: arm of the laboratory, if it has one.
        landings: landings computed before, which do not depend on the receiver. Filled here.
    """
    findings = [_misses(plan.actions, scene, pourer, receiver, landings)]
    if arm is not None and arm.tilt_speed_limit is not None:
        findings += [
            _too_fast(plan.actions, scene, name, arm.tilt_speed_limit)
            for name in ("angular_velocity", "return_velocity")
        ]
    return [finding for finding in findings if finding is not None]


def _misses(
    actions: Space, scene: Scene, pourer: Vessel, receiver: Vessel, landings: dict[tuple[object, ...], float | None]
) -> Senseless | None:
    """An x_offset from which the stream misses the receiver."""
    half, hits, beside, below = receiver.opening_radius + BESIDE, [], 0.0, False
    for values in _spread(tuple(axis for axis in actions.axes if axis.name != "x_offset")):
        try:
            action = scene.action({"x_offset": 0.0, **values})
        except ValueError:
            continue  # no such action, which is reported elsewhere
        key = (scene.pourer, scene.liquid, scene.pivot, scene.max_hold_time, action)
        if key not in landings:
            landings[key] = _landing(scene, action, pourer, receiver)
        landing = landings[key]
        if landing is not None and math.isnan(landing):
            below = True
        elif landing is not None and abs(action.y_offset) < half:
            chord = math.sqrt(half**2 - action.y_offset**2)
            hits.append((landing - chord, landing + chord))
        elif landing is not None:
            beside = min(beside or math.inf, abs(action.y_offset))
    if not hits and below:
        text = (
            f"the liquid leaves the lip below the rim of '{scene.receiver.name}'; a larger height would bring it above"
        )
        return _where(actions, "height"), text
    if not hits:
        if not beside:
            return None  # no liquid leaves, which is reported elsewhere
        return (
            _where(actions, "y_offset"),
            f"the stream passes {1e3 * beside:.0f} mm beside the axis of '{scene.receiver.name}', whose opening has a "
            f"radius of {1e3 * receiver.opening_radius:.0f} mm",
        )
    low, high = min(low for low, _ in hits), max(high for _, high in hits)
    axis = next((axis for axis in actions.axes if axis.name == "x_offset"), None)
    fixed = scene.fixed.get("x_offset")
    if axis is not None:
        hitting = max(0.0, min(high, axis.upper) - max(low, axis.lower)) / (axis.upper - axis.lower)
        if hitting >= LEAST:
            return None
        share = (
            "from no x_offset in this range can a stream hit"
            if hitting == 0.0
            else f"only from {100 * hitting:.0f} % of this range can a stream hit"
        )
    elif fixed is not None and not low <= fixed <= high:
        share = "from this x_offset no stream can hit"
    else:
        return None
    ends = f"{math.ceil(1e3 * low):d} … {math.floor(1e3 * high):d} mm"
    return (
        _where(actions, "x_offset"),
        f"{share} '{scene.receiver.name}': a free jet comes down in it from an x_offset of {ends}",
    )


def _landing(scene: Scene, action: Action, pourer: Vessel, receiver: Vessel) -> float | None:
    """Where the stream lands if the pourer is above the receiver's axis [m]; None if no liquid leaves.

    NaN if most of the liquid leaves below the receiver's rim.
    """
    try:
        course = flow_course(plan_motion(scene, action, pourer, receiver), scene.liquid, pourer, receiver)
    except ValueError:
        return None  # an impossible motion, which is reported elsewhere
    if course is None:
        return None
    return course.landing() if course.quantile(course.fall, 0.5) > 0.0 else math.nan


def _too_fast(actions: Space, scene: Scene, name: str, most: float) -> Senseless | None:
    """A range of speeds whose fastest part the arm would refuse."""
    axis = next((axis for axis in actions.axes if axis.name == name), None)
    if axis is None or axis.upper <= most * (1.0 + 1e-9):
        return None
    middle = {other.name: other.decode(0.5) for other in actions.axes}
    try:
        action = scene.action({**middle, name: axis.upper})
    except ValueError:
        return None
    peak = axis.upper
    if action.angular_acceleration is not None:  # a short rotation does not reach this speed
        peak = min(peak, math.sqrt(action.max_angle * action.angular_acceleration))
    if peak <= most * (1.0 + 1e-4):
        return None
    unit = ACTION_DIMENSIONS[name]
    return (
        _where(actions, name),
        f"goes up to {axis.upper / unit.factor:.4g} {unit.display_unit}, and the arm turns the pourer at "
        f"{most / unit.factor:.4g} {unit.display_unit} at most (arm.limits): the search ends there",
    )


def _where(actions: Space, name: str) -> tuple[Loc, ...]:
    """Keys that may define an action dimension."""
    return (("actions", name), ("actions",)) if name in actions.names else (("motion", name),)


def _spread(axes: tuple[Axis, ...]) -> list[dict[str, float]]:
    """The middle, and corners up to the maximum number."""
    corners = itertools.islice(itertools.product((0.0, 1.0), repeat=len(axes)), MOST_TRIED - 1)
    points = [(0.5,) * len(axes), *corners] if axes else [()]
    return [{axis.name: axis.decode(u) for axis, u in zip(axes, point, strict=True)} for point in points]


CORNERS, DRAWN = 64, 16
"""Number of corners and of random actions that are tried, besides the middle, before the whole space counts as
touching."""


@dataclass(frozen=True)
class _Role:
    """Role of a scene in a campaign.

    Attributes:
        text: for messages.
        section: section of the file that overrides the top level.
        receiver: places that may name the receiver, the most specific first.
    """

    text: str
    section: Loc = ()
    receiver: tuple[Loc, ...] = ()

    def places(self, *keys: Loc) -> tuple[Loc, ...]:
        """Places that may contain keys, the most specific first; the section itself comes last."""
        return (*(self.section + key for key in keys), *keys, self.section)


CheckedPlace = tuple[float, float, float]


def _place(action: Action) -> CheckedPlace:
    """Start of a pour, which determines the transfer motion."""
    return action.x_offset, action.y_offset, action.height


def _ignore(findings: object) -> None:
    """Default callback: does nothing."""


@dataclass
class _Checker:
    source: Path
    arm: ArmSettings | None = None
    gripper: GripperSettings | None = None
    places: tuple[PlaceSettings, ...] = ()
    document: Document | None = None
    warn: Callable[[Problem], None] = _ignore
    doing: Callable[[str], None] = _ignore
    particles: int = MIRRORED_FROM
    problems: list[Problem] = field(default_factory=list)
    vessels: dict[VesselSpec, Vessel | None] = field(default_factory=dict)
    landings: dict[tuple[object, ...], float | None] = field(default_factory=dict)

    def add(self, places: tuple[Loc, ...], text: str) -> None:
        """Add a problem at the first of these places that exists in the campaign's file."""
        self.problems.append(self.problem(places, text))

    def problem(self, places: tuple[Loc, ...], text: str) -> Problem:
        """A problem at the first of these places that exists in the campaign's file."""
        document = self.document
        first = None if document is None else next((loc for loc in places if loc in document.marks), None)
        if document is None or first is None:
            return Problem(self.source, 0, 0, "", text)
        return document.problem(first, text)

    def vessel(self, spec: VesselSpec, places: tuple[Loc, ...]) -> Vessel | None:
        if spec not in self.vessels:
            where = f" ({spec.shape.path})" if isinstance(spec.shape, MeshShape) else ""
            try:
                cup = self.vessels[spec] = built(spec)
            except (VesselError, OSError) as error:
                self.add(places, f"vessel '{spec.name}'{where}: {error}")
                self.vessels[spec] = None
            else:
                for text in cup.warnings:
                    self.warn(self.problem(places, f"vessel '{spec.name}'{where}: {text}"))
        return self.vessels[spec]

    def scene(
        self, scene: Scene, role: _Role, wanted: float | None = None, *, dosed: bool = False
    ) -> tuple[Vessel, Vessel] | None:
        """The scene's vessels, if both are valid and hold the liquid.

        Args:
            wanted: volume that the receiver has to hold [m³]; the whole load unless given.
            dosed: a controller ends the pour at this volume.
        """
        places = {"pourer": role.places(("pourer",)), "receiver": (*role.receiver, *role.places(("receiver",)))}
        pourer = self.vessel(scene.pourer, places["pourer"])
        receiver = self.vessel(scene.receiver, places["receiver"])
        if pourer is None or receiver is None:
            return None
        ok = self._grippable(pourer, places["pourer"])
        load = f"the {scene.liquid.name} ({scene.liquid.mass * 1e3:g} g)"
        less = wanted is not None and wanted < scene.liquid.volume
        for vessel, name in ((pourer, "pourer"), (receiver, "receiver")):
            purpose, volume = (
                (load, scene.liquid.volume) if wanted is None or vessel is pourer else ("what is asked for", wanted)
            )
            try:
                check_holds(vessel, volume)
            except VesselError as error:
                ok = False
                self.add(places[name], f"{role.text}: {name} can't hold {purpose if less else load}: {error}")
        for vessel, name in ((pourer, "pourer"), (receiver, "receiver")):
            if scene.mirrored and (why := why_whole(vessel, scene.liquid.volume, self.particles)):
                self.warn(self.problem(places[name], f"vessel '{vessel.name}': {why}"))
        if ok and less and not dosed and scene.liquid.volume > receiver.capacity:
            text = (
                f"{role.text}: the receiver holds {1e6 * receiver.capacity:.4g} mL, enough for what is asked for, not "
                f"for {load}: a pour that misses its target may run over"
            )
            self.warn(self.problem(places["receiver"], text))
        return (pourer, receiver) if ok else None

    def reachable(self, plan: CalibrationPlan | DeploymentPlan, scene: Scene, role: _Role) -> None:
        """At least one action of the space must pour without contact, and the arm must be able to make it."""
        wanted = plan.wanted(scene) if isinstance(plan, DeploymentPlan) else None
        vessels = self.scene(scene, role, wanted)
        self._payload(scene)
        actions = plan.actions
        trials = actions_all_over(actions, plan.constraints, corners=CORNERS, drawn=DRAWN)
        if vessels is None or self._never_pours(scene, trials, vessels[0], role):
            return
        self._carried(scene, role)
        first = beyond = ""
        barred: set[CheckedPlace] = set()
        for i, chosen in enumerate(trials, start=1):
            if i > 1:
                self.doing(f"{role.text}: {len(trials)} actions are tried, none of {i - 1} can be made")
            try:
                action = scene.action(chosen)
                if _place(action) in barred:
                    continue
                contact = touch(scene, action, *vessels)
            except ValueError as error:  # an action out of bounds, or an impossible motion
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

    def _grippable(self, pourer: Vessel, places: tuple[Loc, ...]) -> bool:
        """Whether the laboratory's gripper can hold the pourer; if not, a problem is added."""
        if self.gripper is None or self.arm is None:
            return True
        from actors.bench.held_vessel import grip_limits

        try:
            grip_limits(pourer, self.gripper, self.arm)
        except LaboratoryError as error:
            self.add(places, str(error))
            return False
        return True

    def _carried(self, scene: Scene, role: _Role) -> None:
        """Whether the arm can carry the vessels between the places of the laboratory, and pour the receiver back."""
        if not self.places or self.gripper is None or self.arm is None:
            return
        from actors.bench.vessel_handling import check_handling, plan_back

        try:
            check_handling(self.places, self.arm, self.gripper, scene)
            plan_back(self.places, self.arm, scene)
        except InvalidActionError as error:
            self.add(role.places(("receiver",), ("pourer",)), f"{role.text}: {error}")

    def carried_doses(self, plan: DispensePlan, vessels: tuple[CellVessel, ...]) -> None:
        """Whether the arm can carry the vessels of doses.

        Args:
            plan: of the doses.
            vessels: of mixtures; empty: the only source, and one cup after the other.
        """
        from actors.bench.dose_handling import check_vessels, plan_waste, shapes_of, vessels_of
        from actors.bench.vessel_carrying import SHOWN, check_pour_path

        assert self.arm is not None
        assert self.gripper is not None
        section = dose_section(plan)
        if not vessels and len(plan.sources) > 1:
            text = "with places these doses have one source; several ones, each with its place, are those of 'mixtures'"
            self.add((section,), text)
            return
        series = [(vessels, plan.scenes)] if vessels else []
        if not vessels:
            for name, mass, limit in dict.fromkeys((dose.receiver, dose.amount, dose.limit) for dose in plan.doses):
                scene = plan.scene(plan.sources[0], name)
                series.append((vessels_of(self.places, scene, DoseTarget(mass, limit)), (scene,)))
        for each, scenes in series:
            try:
                at_places, loads, _ = check_vessels(self.places, each, self.arm, self.gripper)
                shapes = shapes_of(self.places, loads)
                for scene in scenes:
                    try:
                        path = arm_kind(self.arm).plan(scene, scene.action({}))
                    except InvalidActionError:
                        continue  # which `doses` reports
                    check_pour_path(path, built(scene.pourer), at_places, self.arm, shapes)
                if plan.mixtures is not None and plan.mixtures.on_miss != "accept" and not plan.mixtures.spares:
                    cup = next(vessel for vessel in each if not vessel.liquid)
                    for scene in scenes:
                        plan_waste(at_places, self.arm, scene, cup, shapes)
            except InvalidActionError as error:
                for text, vessel in itertools.islice(error.problems.items(), SHOWN):
                    self.add((*_dosed(plan, vessel), section), text)
                if len(error.problems) > SHOWN:
                    self.add((section,), f"and {len(error.problems) - SHOWN} more problems of the same kind")
                return

    def _payload(self, scene: Scene) -> None:
        """The configured payload of the arm can't be less than the mass of the liquid."""
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
        """Whether the liquid stays below the lip at the largest tilt of the space; if so, a problem is added."""
        tilts = []
        for chosen in trials:
            try:
                tilts.append(scene.action(chosen).max_angle)
            except ValueError:
                continue  # no such action, which `touch` reports
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

    def _for_the_arm(self, scene: Scene, action: Action, actions: Space, barred: set[CheckedPlace]) -> str:
        """Reason why the laboratory's arm can't make the action; '' if it can or there is no arm.

        Args:
            barred: places that the arm can't reach from home with any motion. Filled here.
        """
        try:
            check_action(scene, action, self.arm, self.places)
        except InvalidActionError as error:
            if isinstance(error, UnreachablePlaceError):
                barred.add(_place(action))
            return f"{action.display(*actions.names)}: {error}"
        return ""

    def pour(self, scene: Scene) -> None:
        """The pour must be possible without contact, and the arm must be able to make it."""
        role = _Role(f"pour into '{scene.receiver.name}'")
        self._payload(scene)
        if (vessels := self.scene(scene, role)) is None:
            return
        self._carried(scene, role)
        try:
            problem = touch(scene, action := scene.action({}), *vessels)
            if problem is None:
                check_action(scene, action, self.arm, self.places)
        except (InvalidActionError, ValueError) as error:
            problem = str(error)
        if problem is not None:
            self.add(role.places(("motion",)), f"{role.text}: {problem}")

    def doses(self, plan: DispensePlan, laboratory: LaboratorySettings) -> None:
        """Every dose must fit into its receiver and come out of a full source."""
        section = dose_section(plan)
        for scene in plan.scenes:
            doses = [
                d for d in plan.doses if d.receiver == scene.receiver.name and d.liquid in (None, scene.liquid.name)
            ]
            largest = max((planned.amount + planned.limit for planned in doses), default=0.0)
            role = _Role(f"doses from '{scene.pourer.name}' into '{scene.receiver.name}'", section)
            self._payload(scene)
            if (vessels := self.scene(scene, role, largest / scene.liquid.density, dosed=True)) is None:
                continue
            if missed := _misses(DOSE_TILTS, scene, *vessels, self.landings):
                self.add(role.places(*missed[0]), f"{role.text}: {missed[1]}")
            smallest = min((planned.amount for planned in doses), default=math.inf)
            self._dosable(scene, vessels[0], (smallest, largest), role, laboratory.bench)
            if self.arm is not None and not arm_kind(self.arm).doses:
                self.add(role.places(), f"an arm of the kind '{self.arm.kind}' can't pour wanted amounts")
                continue
            try:
                path_of(scene, scene.action({}), self.arm)
            except InvalidActionError as error:
                unable = (
                    "it can't be poured from at this placement" if self.arm is None else "the arm can't make the tilt"
                )
                self.add(role.places(("motion",)), f"{role.text}: {unable}: {error}")
        if plan.mixtures is not None:
            return  # whose amounts are compared with their own sources when they are read
        full = min(scene.liquid.mass for scene in plan.scenes)
        for i, dose in enumerate(plan.doses):
            if dose.amount + dose.limit + plan.refill_below >= full:
                text = (
                    f"a full source holds {1e3 * full:g} g, and the dose, its tolerance and refill_below need "
                    f"{1e3 * (dose.amount + dose.limit + plan.refill_below):g} g"
                )
                self.add((("dispense", "doses", i, "amount"), ("dispense", "doses")), text)

    def _dosable(
        self, scene: Scene, pourer: Vessel, amounts: tuple[float, float], role: _Role, bench: BenchSettings | None
    ) -> None:
        """Whether doses [kg] from the smallest to the largest one can be poured out of a full source."""
        from actors.dosing.cup_flow import LARGEST_TILT
        from actors.dosing.particle_liquid import check_particles
        from actors.dosing.simulated_dose import check_straight

        source = role.places(("sources",), ("pourer",))
        most = FULLEST * scene.liquid.density * retained_volume(pourer, ASKEW)
        if scene.liquid.mass > most:
            self.add(
                role.places(("liquid", "mass"), ("liquid",), ("liquids",)),
                f"{role.text}: '{pourer.name}' is too full to be tilted with {1e3 * scene.liquid.mass:.4g} g of "
                f"{scene.liquid.name}, and holds {1e3 * scene.liquid.density * pourer.capacity:.4g} g to the brim: "
                f"fill it with {1e3 * most:.4g} g at most",
            )
        kept = scene.liquid.density * retained_volume(pourer, LARGEST_TILT)
        if scene.liquid.mass - kept < amounts[1]:
            self.add(
                source,
                f"{role.text}: '{pourer.name}' keeps {1e3 * kept:.4g} g of {1e3 * scene.liquid.mass:.4g} g when it is "
                f"tilted by {math.degrees(LARGEST_TILT):.0f} deg; a dose with its tolerance takes up to "
                f"{1e3 * amounts[1]:.4g} g: fill it with more, or use a vessel with a wider opening",
            )
        try:
            if bench is not None and bench.doses == "particles":
                source = role.places(("doses",))
                check_particles(scene, amounts[0], bench.theta)
            elif bench is not None:
                check_straight(scene)
        except InvalidActionError as error:
            self.add(source, f"{role.text}: {error}")

    def display(self, plan: DispensePlan, laboratory: LaboratorySettings) -> None:
        """The balance must be fast enough for the tolerance of every dose, as far as its settings state it."""
        from actors.dosing.dose_controller import check_display
        from actors.laboratory import expected_display

        display = expected_display(laboratory.balance)
        if display is None:
            return
        for i, dose in enumerate(plan.doses):
            try:
                check_display(display, dose.limit, laboratory.dosing)
            except InvalidActionError as error:
                self.add((("dispense", "doses", i), ("mixtures", "tolerance"), dose_section(plan)), str(error))
                return  # mostly all doses have one tolerance

    def mixtures(self, plan: CampaignPlan, tell: Callable[[str], None]) -> None:
        """Balance and sources must support every amount of the mixtures, and no cup may be open for too long."""
        from orchestrator.campaigns.mixture_forecast import MixtureForecast

        assert plan.dispense is not None
        assert plan.dispense.mixtures is not None
        try:
            forecast = MixtureForecast(plan, self.doing)
        except InvalidActionError as error:
            self.add((("mixtures",),), str(error))
            return
        for line in forecast.lines():
            tell(line)
        for cups, liquid, text in forecast.refused():
            name = cups[0].partition("/")[2]
            places = (("mixtures", "wanted", name, liquid), ("mixtures", "from"), ("mixtures", "wanted"))
            self.add(places, f"{liquid} into {', '.join(cups)}: {text}")
        longest, supply = plan.dispense.mixtures.max_open, plan.laboratory.source
        if longest is not None and forecast.open_time > longest:
            text = f"a cup is open for up to {forecast.open_time / 60.0:.1f} min; pour fewer liquids, or raise it"
            self.add((("mixtures", "max_open"),), text)
        again = [f"{name} {count - 1} times" for name, count in forecast.fills.items() if count > 1]
        if again and plan.laboratory.unattended is not None and (supply is None or supply.refill is None):
            text = f"have to be filled again ({', '.join(again)}), and nobody is there; add stands with the same liquid"
            self.add((("mixtures", "liquids"),), text)

    def recorded(self, scene: Scene, recorded: list[Action], role: _Role, place: Loc) -> None:
        """Recorded pours were possible: if their vessels touch, the description of the scene is wrong."""
        vessels = self.scene(scene, role)
        if vessels is None:
            return
        # Sorted by place: pours with the same place and maximum tilt have the same poses.
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


def _assumed(plan: CampaignPlan) -> Iterator[tuple[Loc, str]]:
    """What was assumed about the files of weighed pours, with the keys that name them."""
    if plan.calibration is not None and plan.calibration.records is not None:
        yield ("calibration", "pours", "from"), plan.calibration.records.assumed
    if plan.calibration is not None and plan.calibration.transfer is not None:
        yield ("calibration", "pours", "transfer", "from"), plan.calibration.transfer.assumed
    if plan.deployment is not None and plan.deployment.data is not None:
        yield ("deployment", "data", "from"), plan.deployment.data.assumed


def check_campaign(
    plan: CampaignPlan,
    *,
    as_written: bool = True,
    warn: Callable[[Problem], None] = _ignore,
    doing: Callable[[str], None] = _ignore,
    tell: Callable[[str], None] = _ignore,
) -> list[Problem]:
    """Build the vessels of a campaign and try its actions.

    Also checks that the output folder can be created. For every scene:

    - Both vessels can be built and hold the liquid.
    - Some action of the space tilts far enough for the liquid to leave.
    - Some action avoids contact between the vessels, and the laboratory's arm can make it. The middle, corners and a
      few random actions are tried.
    - Recorded pours avoid contact.

    Args:
        plan: plan of the campaign.
        as_written: whether its vessels are those of its file; otherwise places in the file would be misleading.
        warn: called with settings that can run but make little sense.
        doing: called with a description of each slow step.
        tell: called with each line of a prediction.

    Returns:
        Problems, with their places if the campaign's file has them; empty if the campaign can start.
    """
    try:
        document = Document.read(plan.source) if as_written else None
    except ConfigError:
        document = None  # a plan without a file
    lab = plan.laboratory
    checker = _Checker(
        plan.source,
        lab.expected_arm,
        lab.gripper,
        all_places(lab.places),
        document,
        warn,
        doing,
        plan.parameters.particles,
    )
    at: Loc
    if (problem := why_not_writable(plan.outputs.folder)) is not None:
        checker.add((("outputs", "directory"),), problem)
    for at, assumed in _assumed(plan):
        if assumed:
            warn(checker.problem((at,), assumed))
    planned: list[int | None] = [0 if plan.calibration is None else plan.calibration.pour_count]
    planned += [] if plan.deployment is None else [plan.deployment.settings.pours, plan.deployment.confirm]
    if plan.outputs.pour_recordings and lab.mode == "virtual" and lab.arm is None and any(planned):
        text = (
            f"records doses alone in laboratory '{lab.name}': its bench has no arm, whose tilt a recorded pour needs; "
            "name a laboratory with an arm"
        )
        warn(checker.problem((("outputs", "pour_recordings"),), text))
    if plan.calibration is not None:
        _check_calibration(plan.calibration, checker)
    if plan.deployment is not None:
        for i, scene in enumerate(plan.deployment.scenes):
            receiver = (("deployment", "receiver"), ("deployment", "receivers", i), ("receivers", i))
            role = _Role(f"deployment into '{scene.receiver.name}'", ("deployment",), receiver)
            checker.reachable(plan.deployment, scene, role)
    if plan.pour is not None:
        checker.pour(plan.pour)
    if plan.dispense is not None:
        _check_doses(plan, plan.dispense, checker, tell)
    return list(dict.fromkeys(checker.problems))


def _check_calibration(plan: CalibrationPlan, checker: _Checker) -> None:
    at: Loc
    section = ("calibration",)
    if plan.records is None:
        for scene in plan.poured:
            checker.reachable(plan, scene, _Role("calibration", section))
    else:
        at = ("calibration", "pours")
        actions = [pour.action for pour in plan.records.pours]
        checker.recorded(plan.scene, actions, _Role("calibration.pours", section), at)
    if plan.transfer is not None:
        at = ("calibration", "pours", "transfer")
        role = _Role("calibration.pours.transfer", section, ((*at, "receiver"),))
        checker.recorded(plan.transfer.scene, [pour.action for pour in plan.transfer.pours], role, at)


def _check_doses(plan: CampaignPlan, dispense: DispensePlan, checker: _Checker, tell: Callable[[str], None]) -> None:
    laboratory, balance = plan.laboratory, plan.laboratory.balance
    if laboratory.places:
        checker.carried_doses(dispense, laboratory.vessels)
    if laboratory.arm is not None and (balance is None or balance.placement not in ("receiver", "everything")):
        text = (
            f"laboratory '{laboratory.name}': wanted amounts need a connected balance under the receiver; "
            "write 'balance: {placement: receiver}' and set it up so"
        )
        checker.add((dose_section(dispense), ("laboratory",)), text)
    before = len(checker.problems)
    checker.doses(dispense, laboratory)
    checker.display(dispense, laboratory)
    if dispense.mixtures is not None and len(checker.problems) == before:
        checker.mixtures(plan, tell)
    if len(checker.problems) == before:
        for flow in dose_flows(plan, checker.doing):
            places = (*_dosed(dispense, flow.scene.pourer.name), dose_section(dispense))
            for text in flow.warnings():
                checker.warn(checker.problem(places, text))
            if (misses := flow.misses()) is not None:
                checker.add((("motion", "x_offset"), ("motion",), *places), misses)


def _dosed(plan: DispensePlan, vessel: str) -> tuple[Loc, ...]:
    """Keys that may describe a vessel of doses, the most specific first; none without a vessel."""
    if vessel in plan.sources and plan.mixtures is not None:
        i = list(dict.fromkeys(map(plan.liquid, plan.sources))).index(plan.liquid(vessel))
        return ("mixtures", "liquids", i, "source"), ("mixtures", "liquids", i, "stands"), ("pourer",)
    if vessel in plan.sources:
        return ("dispense", "sources"), ("pourer",)
    return (("mixtures", "cups", "vessel"), ("receiver",)) if vessel else ()


def dose_section(plan: DispensePlan) -> Loc:
    """The section of a campaign's file that a series of doses comes from."""
    return ("dispense",) if plan.mixtures is None else ("mixtures",)


def check_vessels(
    scene: Scene, source: Path, wanted: float | None = None, *, warn: Callable[[Problem], None] = _ignore
) -> list[Problem]:
    """Build the vessels of one scene.

    Args:
        scene: the scene.
        source: the campaign's file.
        wanted: volume that the receiver has to hold [m³]; the whole load unless given.
        warn: called with what makes a vessel doubtful.

    Returns:
        Problems: a vessel that is invalid, or can't hold the load.
    """
    checker = _Checker(source, warn=warn)
    checker.scene(scene, _Role(f"{scene.pourer.name} into {scene.receiver.name}"), wanted)
    return checker.problems


def check_action(
    scene: Scene, action: Action, arm: ArmSettings | None, places: Sequence[PlaceSettings]
) -> PlannedPour | None:
    """Check a pour as the bench does before it begins.

    Args:
        scene: vessels and liquid.
        action: how to pour.
        arm: as it is expected to be (`LaboratorySettings.expected_arm`); None on a bench without one.
        places: between which it carries the vessels.

    Returns:
        The planned pour; None without an arm.

    Raises:
        InvalidActionError: see `path_of`; or it comes too near to a vessel at another place.
    """
    path = path_of(scene, action, arm)
    if places and arm is not None and path is not None:
        from actors.bench.vessel_handling import check_path

        check_path(path, places, arm, scene)
    return path


def touch(scene: Scene, action: Action, pourer: Vessel, receiver: Vessel) -> str | None:
    """Place where the vessels touch during an action, as text; None if they do not touch.

    Raises:
        ValueError: the motion can't be made.
    """
    motion = plan_motion(scene, action, pourer, receiver)
    touching = contact_during(motion, pourer, receiver)
    if touching is None:
        return None
    contact, tilt = touching
    return describe_contact(
        contact, tilt=tilt, pourer=f"pourer '{scene.pourer.name}'", receiver=f"receiver '{scene.receiver.name}'"
    )
