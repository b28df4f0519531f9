"""Prediction for one action: the same pour is simulated with several new seeds.

`RepeatedSimulation` requests the simulations; `PredictionStatistics` is its result. It does not search for better
actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from orchestrator.requests import Decision, Outcome, Request, Simulate, Simulated, Slots
from orchestrator.strategies.deployment.costing import Costing
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Progress
from orchestrator.strategies.trials import SeedStream
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourOutcome
from sim_engine.prediction_band import PredictionInterval, SampleStatistics, band_of, spreads
from sim_engine.scene import PoseError


class PredictionStatistics(StageResult):
    """Statistics of repeated simulations of one action with new seeds.

    The loss includes simulations in which the cups touched because of an error. The fractions do not, because they are
    undefined in that case.
    """

    kind: Literal["prediction"] = "prediction"

    scene: str
    """Name of the scene."""

    simulations: int
    """Number of simulations with an answer."""

    simulations_lost: int
    """Number of answered simulations that could not be used."""

    thetas: int
    """Number of different posterior θ that the seeds cycle through; 0 if a single θ is used."""

    touching: int
    """Number of simulations whose cups touched because of a pose error or a shape error."""

    over_seeds: dict[str, SampleStatistics]
    """Mean and standard deviation of every fraction, of 'spillage' r = spilled / poured, and of the 'loss'."""

    interval: PredictionInterval | None = None
    """Prediction interval for r of a single pour; null if no simulation has an r."""


class RepeatedSimulation:
    """Simulate an action again to predict its mean and scatter.

    Vessels with a declared shape tolerance get a different shape in each simulation.

    An action is selected because its simulations spilled little, which is partly chance. Seeds that were not used for
    the selection give an unbiased prediction, and the scatter of a single pour around it.
    """

    def __init__(
        self,
        costing: Costing,
        action: Action | None,
        count: int,
        seed: int,
        thetas: Sequence[SimulationParameters] = (),
        errors: Sequence[PoseError | None] = (),
        discrepancy: float | None = None,
    ) -> None:
        """Queue the simulations.

        Args:
            costing: scene, θ and loss.
            action: action to simulate. None if the search found no action that can be repeated; nothing is requested
                then.
            count: number of seeds.
            thetas: draws of a posterior that the seeds cycle through instead of the single θ.
            errors: pose errors that the seeds cycle through. If the cups touch because of such an error, the simulation
                has the worst loss; it does not count as lost.
            discrepancy: residual shift of the calibration (`sim_engine.prediction_band`); None if unknown.
        """
        scene, parameters = costing.scene, costing.parameters
        seeds = SeedStream(seed, f"prediction {scene.name}")
        self._costing = costing
        self._discrepancy = discrepancy
        self._unissued: list[Simulate] = []
        self._open: set[Simulate] = set()
        self._outcomes: list[PourOutcome] = []
        self._losses: list[float] = []
        self._lost = 0
        self.decisions: list[Decision] = []
        if action is not None:
            seeds_of_all = [seeds.next() for _ in range(count)]
            turns, missed, drawn = thetas or (parameters,), errors or (None,), scene.uncertain
            self._unissued = [
                Simulate(scene.name, action, turns[i % len(turns)], s, "predict", missed[i % len(missed)], drawn)
                for i, s in enumerate(seeds_of_all)
            ]
            among = f" and {len(set(thetas))} θ of the posterior" if thetas else ""
            among += f" under {len(errors)} draws of the pose error" if any(errors) else ""
            among += ", each with shapes that the vessels may have" if drawn else ""
            self.decisions.append(Decision(f"simulate the planned action with {count} fresh seeds{among}"))
        self._thetas = len(set(thetas))
        self._touching = 0

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return not self._unissued and not self._open

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next simulations."""
        now, self._unissued = self._unissued[: slots.simulations], self._unissued[slots.simulations :]
        self._open.update(now)
        return list(now)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a simulation.

        Raises:
            ValueError: the simulation was not requested or has been answered already.
        """
        if not isinstance(request, Simulate) or request not in self._open:
            raise ValueError(f"this simulation was not asked for, or has been answered already: {request}")
        self._open.discard(request)
        costing = replace(self._costing, parameters=request.parameters)
        cost = costing.simulated(outcome, request.action)
        if isinstance(outcome, Simulated) and cost is not None:
            self._outcomes.append(outcome.outcome)
            self._losses.append(costing.total(cost))
        elif cost is not None and (request.pose_error is not None or request.drawn_shapes):
            self._touching += 1
            self._losses.append(costing.total(cost))
        else:
            self._lost += 1

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        answered = len(self._losses) + self._lost
        return Progress(answered, answered + len(self._open) + len(self._unissued))

    def result(self) -> PredictionStatistics:
        """Mean and standard deviation over the seeds answered so far."""
        over_seeds = spreads(self._outcomes)
        loss = SampleStatistics.of(self._losses)
        if loss is not None:
            over_seeds["loss"] = loss
        return PredictionStatistics(
            scene=self._costing.scene.name,
            simulations=self.progress().simulations,
            simulations_lost=self._lost,
            thetas=self._thetas,
            touching=self._touching,
            over_seeds=over_seeds,
            interval=band_of(self._outcomes, self._discrepancy),
        )
