"""`Costing` converts outcomes of pours and simulations to the number that deployment minimises."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.objectives import Objective
from orchestrator.learning.requests import Failed, Outcome, Simulated
from orchestrator.learning.strategy import is_sound
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Fractions, Loss, PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space


@dataclass(frozen=True)
class Costing:
    """A loss, or an objective, in a scene.

    Attributes:
        parameters: θ_s of the simulations; their number of particles is the unit of the loss `particles`.
        objective: replaces the loss, with the action space that it is searched in.
    """

    loss: Loss
    scene: Scene
    parameters: SimulationParameters
    objective: tuple[Objective, Space] | None = None

    @classmethod
    def of(cls, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters) -> Costing:
        """Costing of a plan in one of its scenes."""
        objective = None if plan.objective is None else (plan.objective, plan.actions)
        return cls(plan.loss, scene, parameters, objective)

    def of_theta(self, parameters: SimulationParameters) -> Costing:
        """The same for simulations with another θ, which may have another number of particles."""
        return self if parameters.particles == self.parameters.particles else replace(self, parameters=parameters)

    @cached_property
    def worst(self) -> float:
        """Worst possible cost: everything spilled or nothing poured, whichever is larger.

        It is assigned to failed pours, so that the optimiser avoids such actions.
        """
        if self.objective is not None:
            return 2.0 * self._limit
        losses = (self.everything_spilled, self._loss(Fractions(0.0, 0.0, 1.0)))
        return max(loss for loss in losses if loss is not None)

    @property
    def everything_spilled(self) -> float:
        """The loss of spilling everything, in the unit of the loss."""
        loss = self._loss(Fractions(1.0, 1.0, 0.0))
        assert loss is not None
        return loss

    @cached_property
    def _limit(self) -> float:
        """Largest value of the objective for a pour that delivers enough."""
        assert self.objective is not None
        objective, actions = self.objective
        return objective.worst(self.scene, actions)

    def simulated(self, outcome: Outcome, action: Action) -> float | None:
        """Cost of a simulation: the worst for an impossible action, None if it failed or is unusable."""
        match outcome:
            case Simulated(result) if result.invalid is None and is_sound(result.fractions):
                return self._cost(result.fractions, action)
            case Failed("invalid_action"):
                return self.worst
            case _:
                return None

    def poured(self, measurement: PourMeasurement, action: Action) -> float:
        """Cost of a weighed pour."""
        return self._cost(measurement.fractions, action)

    def _cost(self, fractions: Fractions, action: Action) -> float:
        if self.objective is not None:
            return self.objective[0].bounded_cost(fractions, action, self.scene, self._limit)
        loss = self._loss(fractions)
        # an undefined loss (too little poured) counts as the worst: not pouring is not a solution
        return self.worst if loss is None else loss

    def _loss(self, fractions: Fractions) -> float | None:
        return self.loss(fractions, loaded_mass=self.scene.liquid.mass, particles=self.parameters.particles)
