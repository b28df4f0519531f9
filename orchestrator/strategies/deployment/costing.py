"""From outcomes to the number that deployment minimises.

What a pour and a simulation cost in seconds, and so what is worth its time: no clock, only what was told.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

from orchestrator.requests import Failed, Outcome, Simulated
from orchestrator.strategies.campaign_plan import DeploymentPlan
from orchestrator.strategies.deployment.objectives import Objectives, Vector
from orchestrator.strategies.strategy import is_sound
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Fractions, Loss, PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import Section
from sim_engine.settings.quantity import Quantity


@dataclass(frozen=True)
class Costing:
    """A loss, or objectives, in a scene. A loss is a vector of one number.

    Attributes:
        parameters: θ_s of the simulations; their number of particles is the unit of the loss `particles`.
        objectives: in place of the loss, with the action space that they are searched in.
    """

    loss: Loss
    scene: Scene
    parameters: SimulationParameters
    objectives: tuple[Objectives, Space] | None = None

    @classmethod
    def of(cls, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters) -> Costing:
        """What a plan minimises in one of its scenes."""
        objectives = None if plan.objectives is None else (plan.objectives, plan.actions)
        return cls(plan.loss, scene, parameters, objectives)

    @cached_property
    def worst_vector(self) -> Vector:
        """The worst that can happen: everything spilled, or nothing poured, whichever is more.

        It stands for pours that failed, so that the optimiser keeps away.
        """
        if self.objectives is not None:
            return tuple(2.0 * value for value in self.limits)
        everything_spilled, nothing_poured = Fractions(1.0, 1.0, 0.0), Fractions(0.0, 0.0, 1.0)
        losses = [self._loss(everything_spilled), self._loss(nothing_poured)]
        return (max(loss for loss in losses if loss is not None),)

    @property
    def worst(self) -> float:
        """The number that is minimised at `worst_vector`."""
        return self.total(self.worst_vector)

    @cached_property
    def limits(self) -> Vector:
        """Largest values of a pour that delivers enough."""
        if self.objectives is None:
            return self.worst_vector
        objectives, actions = self.objectives
        return objectives.worst(self.scene, actions)

    def simulated(self, outcome: Outcome, action: Action) -> Vector | None:
        """Costs of a simulation: worst for an action that can't be made, None where it failed or is not to be used."""
        match outcome:
            case Simulated(result) if result.invalid is None and is_sound(result.fractions):
                return self._vector(result.fractions, action)
            case Failed("invalid_action"):
                return self.worst_vector
            case _:
                return None

    def poured(self, measurement: PourMeasurement, action: Action) -> Vector:
        """Costs of a weighed pour."""
        return self._vector(measurement.fractions, action)

    def total(self, vector: Vector) -> float:
        """The one number that is minimised."""
        return vector[0] if self.objectives is None else self.objectives[0].total(vector)

    def _vector(self, fractions: Fractions, action: Action) -> Vector:
        if self.objectives is not None:
            return self.objectives[0].vector(fractions, action, self.scene, self.limits)
        loss = self._loss(fractions)
        # an undefined loss (too little poured) counts as the worst: not pouring is not a solution
        return self.worst_vector if loss is None else (loss,)

    def _loss(self, fractions: Fractions) -> float | None:
        return self.loss(fractions, loaded_mass=self.scene.liquid.mass, particles=self.parameters.particles)


LEARNT_FROM = 25
"""Latest simulations whose median is their price: one that was slow by accident changes nothing."""

WITHOUT_OUTCOME = 2.0
"""CPU seconds of a simulation while no outcome has any."""


class PricesSettings(Section):
    """D3 with `per_pour: free`: what things cost, by which simulations are chosen and ended."""

    retired: ClassVar[dict[str, str]] = {
        "simulation": "was retired; remove it: outcomes say what a simulation costs before anything depends on it"
    }

    pour: Annotated[float, Quantity("s", "90 s", 0.0, 86400.0, positive=True)] = 90.0
    """Time that a pour takes, refilling and wiping included."""

    worth: Annotated[float, Quantity("1", "0.005", 0.0, 1.0)] = 0.005
    """Share of the worst loss: where all simulations that fit beside a pour promise less together, the pool rests."""


class Prices:
    """Values in the loss' unit, over seconds of the wall clock.

    The price of a pour is a setting. That of a simulation is learnt from the CPU seconds in outcomes, which are
    journalled, so that a replay learns the same.
    """

    def __init__(self, settings: PricesSettings, worst: float) -> None:
        self._settings, self._worst = settings, worst
        self._seen: deque[float] = deque(maxlen=LEARNT_FROM)

    def learn(self, seconds: float) -> None:
        """A simulation took so many CPU seconds."""
        if seconds > 0.0:
            self._seen.append(seconds)

    @property
    def pour(self) -> float:
        """Seconds that a pour takes."""
        return self._settings.pour

    def simulation(self, width: int) -> float:
        """Seconds from one simulated outcome to the next with `width` of them at a time."""
        return (statistics.median(self._seen) if self._seen else WITHOUT_OUTCOME) / max(width, 1)

    def prefers_pour(self, simulation: float, pour: float, width: int) -> bool:
        """Whether a pour is worth more per second than a simulation, given what each is worth."""
        return simulation / self.simulation(width) <= pour / self.pour

    def is_idle(self, simulation: float, width: int) -> bool:
        """Whether as many simulations as fit beside a pour are worth next to nothing together, given what one is."""
        return simulation * self.pour / self.simulation(width) < self._settings.worth * self._worst
