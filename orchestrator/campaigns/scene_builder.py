"""Builds scenes and action spaces from a campaign's sections.

`SceneBuilder` combines the campaign's defaults with the overrides of a section, and checks that every dimension has a
value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

from actors.optimizer.questions import Linear
from orchestrator.campaigns.action_assignments import parse_constraint
from orchestrator.campaigns.campaign_file import CampaignFile
from orchestrator.campaigns.file_references import References
from orchestrator.campaigns.search_ranges import EXAMPLES, ActionsBase, MotionBase
from orchestrator.campaigns.yaml.yaml_errors import dotted
from orchestrator.campaigns.yaml.yaml_source import Place, Report
from orchestrator.learning.calibration.action_prior import actions_of_prior
from orchestrator.learning.campaign_plan import NormalPrior
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.liquids import Liquid
from sim_engine.scene import Pivot, Scene
from sim_engine.search_space import Space
from sim_engine.settings.quantity import QuantityError
from sim_engine.vessel.shapes import VesselSpec

NEEDED = ("angular_velocity", "max_angle", "x_offset", "height")
"""Dimensions without a default: each campaign fixes or searches them."""

LEAST_LEFT = 64
"""Minimum number of actions, out of about 30,000 spread over the ranges, that must satisfy the constraints."""

DEFAULTS = {
    name: value
    for name, value in Action(angular_velocity=1.0, x_offset=0.0, height=0.0).values().items()
    if name not in NEEDED
}
"""Values of the other dimensions where a campaign states none."""


@dataclass
class _StatedMotion:
    """The motion of a scene as the file states it, with the default of what it does not state.

    Attributes:
        fixed: dimensions of the action that are not searched.
        origin: where the file states them.
    """

    fixed: dict[str, float | None] = field(default_factory=DEFAULTS.copy)
    origin: dict[str, Place] = field(default_factory=dict)
    pivot: Pivot = field(default_factory=Pivot)
    max_hold_time: float = 5.0


@dataclass
class SceneBuilder:
    """Combines the campaign's defaults with a section's overrides.

    Attributes:
        file: the campaign as written (its valid part).
        root: place of the file's root.
        liquid: None after a problem.
    """

    file: CampaignFile
    root: Place
    references: References
    liquid: Liquid | None

    @property
    def report(self) -> Report:
        """The report that receives problems."""
        return self.references.report

    def space(self, actions: ActionsBase | None, motion: MotionBase | None, place: Place) -> Space | None:
        """The action space of a section; a searched dimension must not be fixed as well."""
        local = actions is not None
        used = actions if local else self.file.actions
        if used is None:
            if not self.hidden_by_problems(place, "actions"):
                message = "searches nothing; add for example 'actions: {angular_velocity: [15 deg/s, 120 deg/s]}'"
                self.report.add(place, message, key=True)
            return None
        at = (place if local else self.root).at("actions")
        space: Space | None = used.space()
        if space is None:
            if not self.hidden_by_problems(place, "actions"):
                self.report.add(at, "names no dimension; add for example 'angular_velocity: [15 deg/s, 120 deg/s]'")
            return None
        beside = [(motion, place.at("motion"))] + ([] if local else [(self.file.motion, self.root.at("motion"))])
        for fixed, fixed_at in beside:
            for name in space.names:
                if fixed is not None and name in fixed.fixed():
                    searched = dotted(at.at(name).loc)
                    self.report.add(fixed_at.at(name), f"is searched by {searched} too; keep one of them", key=True)
        return space

    def constraints(self, actions: ActionsBase | None, place: Place, space: Space | None) -> tuple[Linear, ...]:
        """The constraints of a section's action space; they must leave a part of it."""
        used, at = (self.file.actions, self.root) if actions is None else (actions, place)
        if space is None or used is None or not used.constraints:
            return ()
        at, before = at.at("actions").at("constraints"), len(self.report.problems)
        parsed = []
        for i, text in enumerate(used.constraints):
            try:
                parsed.append(parse_constraint(text, space))
            except QuantityError as error:
                self.report.add(at.at(i), str(error))
        if len(self.report.problems) == before:
            try:
                actions_of_prior(space, LEAST_LEFT, 0, parsed)
            except ValueError:
                self.report.add(at, "leave next to nothing of the ranges beside them; loosen one, or widen a range")
        return tuple(parsed)

    def prior(
        self, actions: ActionsBase | None, place: Place, space: Space | None, constraints: Sequence[Linear]
    ) -> tuple[NormalPrior, ...]:
        """C4's prior over the action space; it must have mass inside the constraints."""
        used, at = (self.file.actions, self.root) if actions is None else (actions, place)
        prior: tuple[NormalPrior, ...] = () if space is None or used is None else used.prior()
        if space is None or not prior:
            return ()
        at, before = at.at("actions"), len(self.report.problems)
        for normal in prior:
            axis, info = space.axes[space.names.index(normal.name)], ACTION_DIMENSIONS[normal.name]
            if not axis.lower <= normal.mean <= axis.upper:
                mean, lower, upper = (f"{value / info.factor:g}" for value in (normal.mean, axis.lower, axis.upper))
                text = f"{mean} {info.display_unit} is outside the range, {lower} … {upper} {info.display_unit}"
                self.report.add(at.at(normal.name, "prior", "mean"), text)
        if constraints and len(self.report.problems) == before:
            try:
                actions_of_prior(space, LEAST_LEFT, 0, constraints, prior)
            except ValueError:
                text = "leave next to nothing where the prior lies; loosen one, or move or widen the prior"
                self.report.add(at.at("constraints"), text)
        return prior

    def refuse_prior(self, actions: ActionsBase | None, place: Place, why: str) -> None:
        """Report every prior of a section's own dimensions as unused."""
        for normal in () if actions is None else actions.prior():
            self.report.add(place.at("actions").at(normal.name, "prior"), f"{why}; remove it", key=True)

    def scene(
        self,
        name: str,
        pourer: VesselSpec | None,
        receiver: VesselSpec | None,
        motions: tuple[tuple[MotionBase | None, Place], ...],
        searched: tuple[str, ...],
        place: Place,
        *,
        recorded: bool = False,
        constants: Mapping[str, float] | None = None,
        constants_win: bool = False,
        unread: bool = False,
    ) -> Scene | None:
        """A scene.

        Args:
            name: key for journal and strategies.
            pourer: None after a problem.
            receiver: None after a problem.
            motions: sections that override the campaign's motion; the last has priority.
            searched: dimensions that the action space (or a varying column of a record) gives.
            place: section of the scene.
            recorded: the scene replays weighed pours, so that a step and no return are allowed.
            constants: values that the whole record has; a different value in `motion` is an error, unless
                `constants_win`.
            constants_win: the record's scene only inherits the motion, so that its constants have priority.
            unread: the record could not be read, so that dimensions that it may give are not missed.
        """
        stated = self._stated_motion(motions)
        constants = constants or {}
        fixed = {name: value for name, value in {**stated.fixed, **constants}.items() if name not in searched}
        checks = (
            constants_win or self._constants_fit(constants, stated),
            self._nothing_missing({*fixed, *searched}, place, unread=unread),
            recorded or self._arm_can_do(fixed, stated, place),
        )
        if pourer is None or receiver is None or self.liquid is None or not all(checks):
            return None
        simulated = self.file.calibration is not None or self.file.deployment is not None
        half = simulated and self.file.simulator.mirrors and fixed.get("y_offset") == 0.0
        mirrored = True if half else None
        return Scene(name, pourer, receiver, self.liquid, stated.pivot, fixed, stated.max_hold_time, mirrored)

    def _stated_motion(self, motions: tuple[tuple[MotionBase | None, Place], ...]) -> _StatedMotion:
        """The campaign's motion with the sections that override it; the last has priority."""
        stated = _StatedMotion()
        for motion, at in ((self.file.motion, self.root.at("motion")), *motions):
            if motion is not None:
                own = motion.fixed()
                stated.fixed |= own
                stated.origin |= {dimension: at.at(dimension) for dimension in own}
                stated.pivot = motion.pivot_value() or stated.pivot
                stated.max_hold_time = stated.max_hold_time if motion.max_hold_time is None else motion.max_hold_time
        return stated

    def _constants_fit(self, constants: Mapping[str, float], stated: _StatedMotion) -> bool:
        """Check that the motion states no other value than all pours of a record have."""
        fit = True
        for dimension, value in constants.items():
            own = stated.fixed.get(dimension)
            if dimension in stated.origin and (own is None or abs(own - value) > 1e-6):
                fit, info = False, ACTION_DIMENSIONS[dimension]
                shown = f"{value / info.factor:g} {info.display_unit}"
                text = f"the weighed pours were all made at {shown}; remove this key"
                self.report.add(stated.origin[dimension], text)
        return fit

    def _nothing_missing(self, dimensions: Set[str], place: Place, *, unread: bool) -> bool:
        """Check that the dimensions without a default are fixed or searched; `unread` as in `scene`."""
        missing = [name for name in NEEDED if name not in dimensions]
        for name in () if unread else missing:
            if not self.hidden_by_problems(place, name):
                self.report.add(place, self._needs(name, place), key=True)
        return not missing

    def _arm_can_do(self, fixed: Mapping[str, float | None], stated: _StatedMotion, place: Place) -> bool:
        """Check that the motion has a finite acceleration and a return."""
        switched_off = [d for d in ("angular_acceleration", "return_velocity") if d in fixed and fixed[d] is None]
        for dimension in switched_off:
            word, example = ACTION_DIMENSIONS[dimension].switched_off, EXAMPLES[dimension]
            self.report.add(
                stated.origin[dimension],
                f"'{word}' only replays recorded pours, no arm can do it; write for example '{example}' "
                f"(or override it under {dotted(place.at('motion').loc)})",
            )
        return not switched_off

    def pourer(self, value: Any, place: Place) -> VesselSpec | None:
        """A section's pourer, or the campaign's."""
        return self._vessel("pourer", value, place)

    def receiver(self, value: Any, place: Place) -> VesselSpec | None:
        """A section's receiver, or the campaign's."""
        return self._vessel("receiver", value, place)

    def receivers(self, section: Any, place: Place, *, inherit: bool = True) -> list[VesselSpec | None]:
        """A section's receivers: its own, or the campaign's; `inherit` includes the campaign's 'receivers'."""
        owners = ((section, place), (self.file, self.root))
        for owner, at in owners if inherit else owners[:1]:
            if owner.receiver is not None and owner.receivers is not None:
                self.report.add(at.at("receiver"), "stands beside 'receivers'; keep one of them", key=True)
            if owner.receivers is not None:
                if not owner.receivers:
                    self.report.add(at.at("receivers"), "is empty; name at least one vessel")
                vessels = [self.references.vessel(v, at.at("receivers", i)) for i, v in enumerate(owner.receivers)]
                taken: set[str] = set()
                for i, vessel in enumerate(vessels):
                    if vessel is not None and vessel.name in taken:
                        message = f"a receiver is called '{vessel.name}' already; results need different names"
                        self.report.add(at.at("receivers", i), message)
                    taken |= set() if vessel is None else {vessel.name}
                return vessels
            if owner.receiver is not None:
                return [self.references.vessel(owner.receiver, at.at("receiver"))]
        return [self._vessel("receiver", None, place)]

    def _vessel(self, role: str, value: Any, place: Place) -> VesselSpec | None:
        if value is not None:
            return self.references.vessel(value, place.at(role))
        default = self.file.value(role)
        if default is not None:
            return self.references.vessel(default, self.root.at(role))
        if not self.hidden_by_problems(place, role) and not self.hidden_by_problems(self.root, role):
            message = f"has no {role}; add for example '{role}: ../vessels/{_SAMPLE[role]}.yaml' here or at the top"
            self.report.add(place, message, key=True)
        return None

    def _needs(self, dimension: str, place: Place) -> str:
        unit = ACTION_DIMENSIONS[dimension].display_unit
        low, high = {"deg/s": (15, 120), "deg": (70, 125), "mm": (60, 120)}[unit]
        return (
            f"{dimension} has no value; fix it under motion ('{dimension}: {EXAMPLES[dimension]}') "
            f"or search it under {dotted(place.at('actions').loc)} ('{dimension}: [{low} {unit}, {high} {unit}]')"
        )

    def hidden_by_problems(self, place: Place, word: str) -> bool:
        """Whether a reported problem may explain that a word has no value: one cause, one message."""
        return any(
            path == place.document.path and (word in loc or (loc and loc[-1] in ("motion", "actions")))
            for path, loc in self.report.broken
        )


_SAMPLE = {"pourer": "beaker", "receiver": "tumbler"}
