"""Several things wanted of a pour at once: spilling little, leaving little, taking little time, pouring so much."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

from sim_engine.action import Action
from sim_engine.motion import turn
from sim_engine.outcome import Fractions
from sim_engine.space import Space
from sim_engine.task import Scene

ObjectiveName = Literal["spillage", "retained", "time", "target_volume"]

Vector = tuple[float, ...]
"""One number for each objective, smaller is better."""


@dataclass(frozen=True)
class Objective:
    """One thing wanted. All are dimensionless, and about 1 where they are bad.

    * `spillage`: spilled / loaded.
    * `retained`: retained / loaded.
    * `time`: duration of the motion / `scale`.
    * `target_volume`: max(|poured − V| − `tolerance`, 0) / loaded + spilled / loaded, in volumes. The tilt has to stop
      at the right place (`max_angle`, `hold_time`); what still drips afterwards is in the outcome.

    Attributes:
        weight: in the weighted sum.
        scale: of `time` [s].
        volume: V of `target_volume` [m³].
        tolerance: of `target_volume` [m³].
    """

    name: ObjectiveName
    weight: float = 1.0
    scale: float = 10.0
    volume: float = 0.0
    tolerance: float = 0.0


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
        """Of the objectives, in order."""
        return tuple(part.name for part in self.parts)

    def vector(self, fractions: Fractions, action: Action, scene: Scene, worst: Vector) -> Vector:
        """f_j of a pour.

        Args:
            worst: as `worst` gives it.
        """
        least = self.floor * self._wanted(scene)
        delivered = max(fractions.poured - fractions.spilled, 0.0)
        if delivered < least:
            missing = 1.0 - delivered / least
            return tuple((1.0 + missing) * value for value in worst)
        return tuple(
            min(_value(part, fractions, action, scene), value) for part, value in zip(self.parts, worst, strict=True)
        )

    def worst(self, scene: Scene, actions: Space) -> Vector:
        """Largest f_j of a pour that delivers enough."""
        corners = itertools.product((0.0, 1.0), repeat=actions.dimension)
        longest = max(duration(scene.action(actions.decode(corner))) for corner in corners) if self._timed else 0.0
        values = []
        for part in self.parts:
            if part.name == "time":
                values.append(longest / part.scale)
            elif part.name == "target_volume":
                share = part.volume / scene.liquid.volume
                values.append(max(share, 1.0 - share) + 1.0)
            else:
                values.append(1.0)
        return tuple(values)

    def total(self, vector: Vector) -> float:
        """Σ w_j f_j."""
        return sum(part.weight * value for part, value in zip(self.parts, vector, strict=True))

    @property
    def _timed(self) -> bool:
        return any(part.name == "time" for part in self.parts)

    def largest_wanted(self, load: float) -> float:
        """What the receiver has to hold of a load if a pour goes as it is wanted [m³]."""
        targets = [part.volume + part.tolerance for part in self.parts if part.name == "target_volume"]
        return min([load, *([max(targets)] if targets else [])])

    def _wanted(self, scene: Scene) -> float:
        """Share of the load that should arrive."""
        targets = [part.volume / scene.liquid.volume for part in self.parts if part.name == "target_volume"]
        return min(targets, default=1.0)


def _value(part: Objective, fractions: Fractions, action: Action, scene: Scene) -> float:
    match part.name:
        case "spillage":
            return fractions.spilled
        case "retained":
            return fractions.retained
        case "time":
            return duration(action) / part.scale
        case "target_volume":
            loaded = scene.liquid.volume
            off = abs(fractions.poured - part.volume / loaded) - part.tolerance / loaded
            return max(off, 0.0) + fractions.spilled


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
