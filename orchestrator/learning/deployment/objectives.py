"""Objectives of a pour: little liquid spilled, little left, short duration, a given volume.

`Objective` is the base class; `Spilled`, `Retained`, `Time` and `TargetVolume` are the built-in objectives. A
deployment minimises one of them instead of a loss.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from sim_engine.action import Action
from sim_engine.motion import turn
from sim_engine.outcome import Fractions
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from sim_engine.settings.model import Problems

STOPS = ("max_angle", "hold_time")
"""Dimensions of an action that can end a pour before the pourer is empty."""


class Objective(Settings):
    """One objective of a pour: dimensionless, and about 1 for a bad pour.

    A derived class defines one objective: its settings, its equation and its worst value. It is registered as an entry
    point of the group `decant.objectives` under its `name`, a literal. Its value must be a function of fractions,
    action and scene alone.

    Not pouring spills nothing and takes no time. A pour that delivers less than `floor` of the wanted volume (the load,
    or the target volume) is therefore worse than any pour that delivers enough.
    """

    tag: ClassVar[str] = "name"
    plugins: ClassVar[str] = "decant.objectives"
    required: ClassVar[dict[str, str]] = {"name": "spilled"}

    name: str = ""
    """Name of the objective."""

    floor: Annotated[float, Quantity("1", "0.5", 0.01, 1.0)] = 0.5
    """Minimum share of the load (of the target volume) that a pour must deliver to be better than none."""

    @abstractmethod
    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """Value f of a pour that delivers enough; smaller is better."""

    def worst(self, scene: Scene, actions: Space) -> float:
        """Largest f of a pour that delivers enough."""
        return 1.0

    def wanted(self, scene: Scene) -> float:
        """Fraction of the load that should arrive."""
        return 1.0

    def check(self, scene: Scene, actions: Space, complaints: Problems) -> None:
        """Add problems that the objective has in a scene."""

    def bounded_cost(self, fractions: Fractions, action: Action, scene: Scene, worst: float) -> float:
        """The minimised value of a pour.

        If the pour delivers too little, it is the worst one times 1 + the missing fraction of the floor. The slope
        leads the search back to pouring.

        Args:
            worst: result of `worst`.
        """
        least = self.floor * self.wanted(scene)
        delivered = max(fractions.poured - fractions.spilled, 0.0)
        if delivered < least:
            return (2.0 - delivered / least) * worst
        return min(self.cost(fractions, action, scene), worst)


class Spilled(Objective):
    """spilled / loaded: unlike the spillage, it is defined for every pour, and a small miss counts little."""

    name: Literal["spilled"] = "spilled"
    """Fraction of the load that is spilled."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The spilled fraction."""
        return fractions.spilled


class Retained(Objective):
    """retained / loaded."""

    name: Literal["retained"] = "retained"
    """Fraction of the load that stays in the pourer."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The retained fraction."""
        return fractions.retained


class Time(Objective):
    """Duration of the motion / scale."""

    name: Literal["time"] = "time"
    """Duration of the motion."""

    scale: Annotated[float, Quantity("s", "10 s", 0.01, 3600.0)] = 10.0
    """Duration that is rated like spilling everything."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The duration in units of the scale."""
        return duration(action) / self.scale

    def worst(self, scene: Scene, actions: Space) -> float:
        """Duration of the slowest corner of the action space, in units of the scale."""
        corners = itertools.product((0.0, 1.0), repeat=actions.dimension)
        return max(duration(scene.action(actions.decode(corner))) for corner in corners) / self.scale

    def check(self, scene: Scene, actions: Space, complaints: Problems) -> None:
        """Check that the hold has a known duration."""
        if "hold_time" not in actions.names and scene.fixed.get("hold_time") is None:
            text = "needs a hold that lasts a known time; search hold_time, or fix it under motion ('hold_time: 1.5 s')"
            complaints.add(text)


class TargetVolume(Objective):
    """max(|poured − V| − tolerance, 0) / loaded + spilled / loaded, in volumes.

    The action must be able to stop the pour (`max_angle`, `hold_time`). The outcome includes liquid that drips
    afterwards.
    """

    name: Literal["target_volume"] = "target_volume"
    """Pour a given volume and stop."""

    volume: Annotated[float, Quantity("m^3", "150 mL", 1e-7, 0.1)] | None = None
    """Volume to pour; required."""

    tolerance: Annotated[float, Quantity("m^3", "2 mL", 0.0, 0.1)] = 0.0
    """Deviation from the volume that is not penalised."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """Deviation of the poured volume from the target, plus the spilled volume."""
        off = abs(fractions.poured - self.wanted(scene)) - self.tolerance / scene.liquid.volume
        return max(off, 0.0) + fractions.spilled

    def worst(self, scene: Scene, actions: Space) -> float:
        """Nothing or everything poured, whichever is farther from the target, and all of it spilled."""
        share = self.wanted(scene)
        return max(share, 1.0 - share) + 1.0

    def wanted(self, scene: Scene) -> float:
        """Target volume as a fraction of the load."""
        assert self.volume is not None, "checked"
        return self.volume / scene.liquid.volume

    def check(self, scene: Scene, actions: Space, complaints: Problems) -> None:
        """Check that the target is within the load, and that an action can stop the pour."""
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


def duration(action: Action) -> float:
    """Duration of an action's motion [s].

    Raises:
        ValueError: the action holds until the flow ends, so that its duration depends on the vessel.
    """
    if action.hold_time is None:
        raise ValueError("the duration of a hold 'until_flow_ends' is not known from the action")
    out = turn(0.0, 0.0, action.max_angle, action.angular_velocity, action.angular_acceleration)
    back = []
    if action.return_velocity is not None:
        back = turn(0.0, action.max_angle, 0.0, action.return_velocity, action.angular_acceleration)
    return sum(segment.duration for segment in (*out, *back)) + action.hold_time
