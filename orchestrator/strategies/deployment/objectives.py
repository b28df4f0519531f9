"""Several things wanted of a pour at once: spilling little, leaving little, taking little time, pouring so much."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from sim_engine.action import Action
from sim_engine.motion import turn
from sim_engine.outcome import Fractions
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import Section
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from sim_engine.settings.model import Problems

Vector = tuple[float, ...]
"""One number for each objective, smaller is better."""

STOPS = ("max_angle", "hold_time")
"""Dimensions of an action that end a pour before the pourer is empty."""


class Objective(Section):
    """One thing wanted of a pour: dimensionless, and about 1 where it is bad.

    A class derived from it is one objective: its settings, its equation, its worst value. It is registered at the door
    `decant.objectives` under its `name`, a literal. It must follow from fractions, action and scene alone.
    """

    tag: ClassVar[str] = "name"
    required: ClassVar[dict[str, str]] = {"name": "spillage"}

    name: str = ""
    """Which objective."""

    weight: Annotated[float, Quantity("1", "1.0", 1e-6, 1e6)] = 1.0
    """In the weighted sum."""

    @abstractmethod
    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """f of a pour that delivers enough."""

    def worst(self, scene: Scene, actions: Space) -> float:
        """Largest f of a pour that delivers enough."""
        return 1.0

    def wanted(self, scene: Scene) -> float:
        """Share of the load that should arrive."""
        return 1.0

    def check(self, scene: Scene, actions: Space, beside: frozenset[str], complaints: Problems) -> None:
        """Complain of what does not make sense in a scene, or beside the other objectives."""

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Which plug-in would have it, if it could be loaded."""
        objectives = resolve_name("orchestrator.strategies.strategy_registry:OBJECTIVES")
        return next((str(broken) for broken in objectives.broken if broken.name == word), "")


class Spillage(Objective):
    """spilled / loaded."""

    name: Literal["spillage"] = "spillage"
    """Share of the load that is spilled."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The share that is spilled."""
        return fractions.spilled


class Retained(Objective):
    """retained / loaded."""

    name: Literal["retained"] = "retained"
    """Share of the load that stays in the pourer."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The share that is retained."""
        return fractions.retained

    def check(self, scene: Scene, actions: Space, beside: frozenset[str], complaints: Problems) -> None:
        """It contradicts a volume to stop at."""
        if "target_volume" in beside:
            text = "wants the pourer to be emptied, and target_volume what is over to stay in it; keep one of them"
            complaints.add(text)


class Time(Objective):
    """Duration of the motion / scale."""

    name: Literal["time"] = "time"
    """Duration of the motion."""

    scale: Annotated[float, Quantity("s", "10 s", 0.01, 3600.0)] = 10.0
    """A duration that is as bad as spilling everything."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The duration in units of the scale."""
        return duration(action) / self.scale

    def worst(self, scene: Scene, actions: Space) -> float:
        """The duration of the slowest corner of the action space."""
        corners = itertools.product((0.0, 1.0), repeat=actions.dimension)
        return max(duration(scene.action(actions.decode(corner))) for corner in corners) / self.scale

    def check(self, scene: Scene, actions: Space, beside: frozenset[str], complaints: Problems) -> None:
        """The hold has to last a known time."""
        if "hold_time" not in actions.names and scene.fixed.get("hold_time") is None:
            text = "needs a hold that lasts a known time; search hold_time, or fix it under motion ('hold_time: 1.5 s')"
            complaints.add(text)


class TargetVolume(Objective):
    """max(|poured − V| − tolerance, 0) / loaded + spilled / loaded, in volumes.

    The tilt has to stop at the right place (`max_angle`, `hold_time`); what still drips afterwards is in the outcome.
    """

    name: Literal["target_volume"] = "target_volume"
    """Pour so much, and stop."""

    volume: Annotated[float, Quantity("m^3", "150 mL", 1e-7, 0.1)] | None = None
    """What should be poured; must be given."""

    tolerance: Annotated[float, Quantity("m^3", "2 mL", 0.0, 0.1)] = 0.0
    """By how much it may be missed."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """What is poured beside the target, and spilled."""
        off = abs(fractions.poured - self.wanted(scene)) - self.tolerance / scene.liquid.volume
        return max(off, 0.0) + fractions.spilled

    def worst(self, scene: Scene, actions: Space) -> float:
        """Nothing poured or everything, whichever is farther off, and all of it spilled."""
        share = self.wanted(scene)
        return max(share, 1.0 - share) + 1.0

    def wanted(self, scene: Scene) -> float:
        """The target's share of the load."""
        assert self.volume is not None, "checked"
        return self.volume / scene.liquid.volume

    def check(self, scene: Scene, actions: Space, beside: frozenset[str], complaints: Problems) -> None:
        """The target is loaded, and an action can stop there."""
        if self.volume is None:
            text = "key 'volume' is missing; add for example 'volume: 150 mL'"
            complaints.add(text, key=True, of="volume")
        elif self.volume > scene.liquid.volume:
            loaded = f"{scene.liquid.volume * 1e6:.4g} mL"
            complaints.add(f"is {self.volume * 1e6:g} mL, and only {loaded} are loaded (liquid.mass)", "volume")
        elif self.tolerance >= self.volume:
            complaints.add("is as much as the volume: not pouring would do", "tolerance")
        if not set(STOPS) & set(actions.names):
            text = "needs an action that stops the pour; search max_angle or hold_time ('hold_time: [0 s, 3 s]')"
            complaints.add(text)


@dataclass(frozen=True)
class Objectives:
    """What deployment minimises in place of a loss: Σ w_j f_j(a), or the front of all f_j that can't be had together.

    Not pouring spills nothing and takes no time. So a pour that delivers less than `floor` of what is wanted (the load,
    or the target volume) into the receiver is worse in every objective than any that does: it has each one's worst
    value, times 1 + the share of the floor that is missing. The slope leads back to pouring.

    Attributes:
        floor: share that must be delivered, > 0.
        pareto: look for the front; the weights then only choose the one action that is recommended.
    """

    parts: tuple[Objective, ...]
    floor: float = 0.5
    pareto: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objectives, in order."""
        return tuple(part.name for part in self.parts)

    def vector(self, fractions: Fractions, action: Action, scene: Scene, worst: Vector) -> Vector:
        """f_j of a pour.

        Args:
            worst: as `worst` gives it.
        """
        least = self.floor * self.wanted(scene)
        delivered = max(fractions.poured - fractions.spilled, 0.0)
        if delivered < least:
            missing = 1.0 - delivered / least
            return tuple((1.0 + missing) * value for value in worst)
        return tuple(
            min(part.cost(fractions, action, scene), value) for part, value in zip(self.parts, worst, strict=True)
        )

    def worst(self, scene: Scene, actions: Space) -> Vector:
        """Largest f_j of a pour that delivers enough."""
        return tuple(part.worst(scene, actions) for part in self.parts)

    def total(self, vector: Vector) -> float:
        """Σ w_j f_j."""
        return sum(part.weight * value for part, value in zip(self.parts, vector, strict=True))

    def wanted(self, scene: Scene) -> float:
        """Share of the load that should arrive."""
        return min(part.wanted(scene) for part in self.parts)


def duration(action: Action) -> float:
    """Duration of an action's motion [s].

    Raises:
        ValueError: it holds until the flow ends: when that is, the vessel decides.
    """
    if action.hold_time is None:
        raise ValueError("the duration of a hold 'until_flow_ends' is not known from the action")
    out = turn(0.0, 0.0, action.max_angle, action.angular_velocity, action.angular_acceleration)
    back = []
    if action.return_velocity is not None:
        back = turn(0.0, action.max_angle, 0.0, action.return_velocity, action.angular_acceleration)
    return sum(segment.duration for segment in (*out, *back)) + action.hold_time
