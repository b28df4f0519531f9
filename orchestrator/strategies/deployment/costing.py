"""From outcomes to the number that deployment minimises."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from orchestrator.requests import Failed, Outcome, Simulated
from orchestrator.strategies.campaign_plan import DeploymentPlan
from orchestrator.strategies.deployment.objectives import Objectives, Vector
from orchestrator.strategies.strategy import is_sound
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Fractions, Loss, PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space


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
