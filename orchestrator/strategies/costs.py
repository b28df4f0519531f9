"""From outcomes to the number that deployment minimises."""

from __future__ import annotations

from dataclasses import dataclass

from orchestrator.requests import Failed, Outcome, Simulated
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import Loss
from sim_engine.outcome import Fractions, PourMeasurement
from sim_engine.task import Scene


@dataclass(frozen=True)
class Costing:
    """A loss in a scene.

    Attributes:
        parameters: θ_s of the simulations; their number of particles is the unit of the loss `particles`.
    """

    loss: Loss
    scene: Scene
    parameters: SimulationParameters

    @property
    def worst(self) -> float:
        """Loss of the worst that can happen: everything spilled, or nothing poured, whichever is more.

        It stands for actions that can't be made and for pours that failed, so that the optimiser keeps away.
        """
        everything_spilled, nothing_poured = Fractions(1.0, 1.0, 0.0), Fractions(0.0, 0.0, 1.0)
        losses = [self._loss(everything_spilled), self._loss(nothing_poured)]
        return max(loss for loss in losses if loss is not None)

    def simulated(self, outcome: Outcome) -> float | None:
        """Cost of a simulation: worst for an invalid action, None for one that failed or is not to be used."""
        match outcome:
            case Simulated(result) if result.invalid is None:
                return self._defined(self._loss(result.fractions))
            case Failed("invalid_action"):
                return self.worst
            case _:
                return None

    def poured(self, measurement: PourMeasurement) -> float:
        """Cost of a weighed pour."""
        return self._defined(self._loss(measurement.fractions))

    def _loss(self, fractions: Fractions) -> float | None:
        return self.loss(fractions, loaded_mass=self.scene.liquid.mass, particles=self.parameters.particles)

    def _defined(self, loss: float | None) -> float:
        """An undefined loss (too little poured) counts as the worst: not pouring is no solution."""
        return self.worst if loss is None else loss
