"""`Costing` converts outcomes of pours and simulations to the number that deployment minimises."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.objectives import Objectives, Vector
from orchestrator.learning.requests import Failed, Outcome, Simulated
from orchestrator.learning.strategy import is_sound
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Fractions, Loss, PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space


@dataclass(frozen=True)
class Costing:
    """A loss, or objectives, in a scene. A loss is treated as a vector with one element.

    Attributes:
        parameters: θ_s of the simulations; their number of particles is the unit of the loss `particles`.
        objectives: objectives that replace the loss, with the action space that they are searched in.
    """

    loss: Loss
    scene: Scene
    parameters: SimulationParameters
    objectives: tuple[Objectives, Space] | None = None

    @classmethod
    def of(cls, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters) -> Costing:
        """Costing of a plan in one of its scenes."""
        objectives = None if plan.objectives is None else (plan.objectives, plan.actions)
        return cls(plan.loss, scene, parameters, objectives)

    def of_theta(self, parameters: SimulationParameters) -> Costing:
        """The same for simulations with another θ, which may have another number of particles."""
        return self if parameters.particles == self.parameters.particles else replace(self, parameters=parameters)

    @cached_property
    def worst_vector(self) -> Vector:
        """Worst possible costs: everything spilled or nothing poured, whichever is larger.

        They are assigned to failed pours, so that the optimiser avoids such actions.
        """
        if self.objectives is not None:
            return tuple(2.0 * value for value in self.limits)
        losses = (self.everything_spilled, self._loss(Fractions(0.0, 0.0, 1.0)))
        return (max(loss for loss in losses if loss is not None),)

    @property
    def everything_spilled(self) -> float:
        """The loss of spilling everything, in the unit of the loss."""
        loss = self._loss(Fractions(1.0, 1.0, 0.0))
        assert loss is not None
        return loss

    @property
    def worst(self) -> float:
        """The minimised number at `worst_vector`."""
        return self.total(self.worst_vector)

    @cached_property
    def limits(self) -> Vector:
        """Largest values of a pour that delivers enough."""
        if self.objectives is None:
            return self.worst_vector
        objectives, actions = self.objectives
        return objectives.worst(self.scene, actions)

    def simulated(self, outcome: Outcome, action: Action) -> Vector | None:
        """Costs of a simulation: the worst for an impossible action, None if it failed or is unusable."""
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

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objectives; empty with a plain loss."""
        return () if self.objectives is None else self.objectives[0].names

    def total(self, vector: Vector) -> float:
        """The number that is minimised."""
        return vector[0] if self.objectives is None else self.objectives[0].total(vector)

    def _vector(self, fractions: Fractions, action: Action) -> Vector:
        if self.objectives is not None:
            return self.objectives[0].vector(fractions, action, self.scene, self.limits)
        loss = self._loss(fractions)
        # an undefined loss (too little poured) counts as the worst: not pouring is not a solution
        return self.worst_vector if loss is None else (loss,)

    def _loss(self, fractions: Fractions) -> float | None:
        return self.loss(fractions, loaded_mass=self.scene.liquid.mass, particles=self.parameters.particles)
