"""The prediction for one action: the same pour simulated with several fresh seeds."""

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


class Foreseen(StageResult):
    """What fresh seeds of one action came to.

    The loss counts cups that touched because of an error; the fractions, of which nothing is known then, do not.
    """

    kind: Literal["prediction"] = "prediction"

    scene: str
    """Name of the scene."""

    simulations: int
    """Those that were answered."""

    simulations_lost: int
    """Those of them that could not be used."""

    thetas: int
    """Different θ of a posterior that the seeds took turns with; 0 where θ is one."""

    touching: int
    """Simulations whose cups touched because of an error, of the pose or of a shape."""

    over_seeds: dict[str, SampleStatistics]
    """Mean and standard deviation of every fraction, of 'spillage' r = spilled / poured, and of the 'loss'."""

    band: PredictionInterval | None = None
    """The band in which r of a single pour lies; null where no simulation has an r."""


class RepeatedSimulation:
    """Simulate an action again, for a prediction with its spread.

    Vessels of which a file says how far their shape may be off have another one in each simulation.

    An action was chosen because its simulations spilled little: part of that was luck. Seeds that took no part in the
    choice tell what to expect, and how much a single pour differs from it.
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
        """Plan.

        Args:
            costing: scene, θ and loss.
            action: None: nothing was found that could be repeated, and nothing is asked for.
            count: of seeds.
            thetas: that the seeds take turns with, in place of the one θ: draws of a posterior.
            errors: that they take turns with, too. Cups that touch because of one are the worst loss, not a lost
                simulation.
            discrepancy: shift that the calibration left over (`sim_engine.prediction_band`); None: nobody knows.
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
        """The next simulations."""
        now, self._unissued = self._unissued[: slots.simulations], self._unissued[slots.simulations :]
        self._open.update(now)
        return list(now)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """What came of a simulation.

        Raises:
            ValueError: it was not asked for.
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
        """Simulations answered, simulations in all."""
        answered = len(self._losses) + self._lost
        return Progress(answered, answered + len(self._open) + len(self._unissued))

    def result(self) -> Foreseen:
        """Mean and standard deviation over the seeds answered so far."""
        over_seeds = spreads(self._outcomes)
        loss = SampleStatistics.of(self._losses)
        if loss is not None:
            over_seeds["loss"] = loss
        return Foreseen(
            scene=self._costing.scene.name,
            simulations=self.progress().simulations,
            simulations_lost=self._lost,
            thetas=self._thetas,
            touching=self._touching,
            over_seeds=over_seeds,
            band=band_of(self._outcomes, self._discrepancy),
        )
