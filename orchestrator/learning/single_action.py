"""Strategies that run one given action and search for no better one.

- `OnePour` pours once with the user's action; `SingleResult` is its result.
- `Confirmation` repeats the action that a deployment recommends; `Confirmed` is its result.
- `RepeatedSimulation` simulates an action with new seeds to predict it; `ActionPrediction` is its result.

A failed pour is never repeated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.deployment_result import Recommended
from orchestrator.learning.deployment.real_pours import DeploymentTrial
from orchestrator.learning.requests import (
    Decision,
    Failed,
    Outcome,
    Pour,
    Poured,
    Prediction,
    Request,
    Simulate,
    Simulated,
    Slots,
)
from orchestrator.learning.stage_result import StageResult, WeighedMasses, weighed_masses
from orchestrator.learning.strategy import Progress
from orchestrator.learning.trials import SeedStream
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.prediction_band import (
    CalibrationResidual,
    PredictionInterval,
    SampleStatistics,
    band_of,
    shift_of,
    spreads,
)
from sim_engine.scene import Scene

FINE = 20_000
"""Number of particles of the simulation that shows how much the resolution matters."""


class DeliveredMasses(WeighedMasses):
    """Masses of a single pour."""

    delivered_ml: float
    """The delivered mass as a volume [ml], from the liquid's density."""


class SingleResult(StageResult):
    """Result of a single pour with a user's action."""

    kind: Literal["pour"] = "pour"

    weighed: DeliveredMasses | None = None
    """The weights; None before the weighing and after a failure."""

    failed: str | None = None
    """Reason why there are no weights."""


class OnePour:
    """Pour once and keep the weights.

    Args:
        scene: scene to pour in.
        action: action of the pour.
        seed: seed of a virtual bench's random numbers.
    """

    def __init__(self, scene: Scene, action: Action, seed: int) -> None:
        self._request = Pour(scene.name, action, 1, SeedStream(seed, "one pour").next())
        self._liquid = scene.liquid
        self._asked = False
        self._outcome: PourMeasurement | Failed | None = None
        self.decisions = [Decision(f"one pour, as requested: {action.display()}")]

    @property
    def finished(self) -> bool:
        """The pour has been made or has failed."""
        return self._outcome is not None

    def ask(self, slots: Slots) -> list[Request]:
        """Return the pour, once."""
        if self._asked or slots.pours < 1:
            return []
        self._asked = True
        return [self._request]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of the pour.

        Raises:
            ValueError: the pour was not requested.
        """
        if request != self._request or not self._asked:
            raise ValueError(f"this pour was not asked for: {request}")
        match outcome:
            case Poured(measurement):
                self._outcome = measurement
            case Failed():
                self._outcome = outcome
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")

    def progress(self) -> Progress:
        """Pours done, and their total number."""
        return Progress(pours=int(self.finished), of_pours=1)

    def result(self) -> SingleResult:
        """The weights, or the reason why there are none."""
        match self._outcome:
            case PourMeasurement() as measured:
                volume = self._liquid.millilitres(measured.delivered)
                masses = weighed_masses(measured).model_dump()
                return SingleResult(weighed=DeliveredMasses(**masses, delivered_ml=volume))
            case Failed(kind, reason):
                return SingleResult(failed=f"{kind}: {reason}")
        return SingleResult()


class ActionPrediction(StageResult):
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

    Some fast pours splash the more, the finer the particles. If pours are mirrored and the scene is not one of the
    calibration, whose residual contains the resolution, the first simulation is repeated with `FINE` particles, and the
    prediction interval contains the difference.
    """

    def __init__(
        self,
        costing: Costing,
        action: Action | None,
        count: int,
        seed: int,
        thetas: Sequence[SimulationParameters] = (),
        residual: CalibrationResidual | None = None,
    ) -> None:
        """Queue the simulations.

        Args:
            costing: scene, θ and loss.
            action: action to simulate. None if the search found no action that can be repeated; nothing is requested
                then.
            count: number of seeds.
            thetas: draws of a posterior that the seeds cycle through instead of the single θ.
            residual: of the calibration, for the scene; None if unknown.
        """
        scene, parameters = costing.scene, costing.parameters
        seeds = SeedStream(seed, f"prediction {scene.name}")
        self._costing = costing
        self._residual = residual
        self._unissued: list[Simulate] = []
        self._open: set[Simulate] = set()
        self._outcomes: list[PourOutcome] = []
        self._losses: list[float] = []
        self._lost = 0
        self._coarse: Simulate | None = None
        self._fine: Simulate | None = None
        self._spilled: dict[Simulate, float | None] = {}
        self.decisions: list[Decision] = []
        if action is not None:
            seeds_of_all = [seeds.next() for _ in range(count)]
            turns, uncertain = thetas or (parameters,), scene.uncertain
            self._unissued = [
                Simulate(scene.name, action, turns[i % len(turns)], s, "predict", drawn_shapes=uncertain)
                for i, s in enumerate(seeds_of_all)
            ]
            first = self._unissued[0]
            here = residual is not None and residual.here
            if scene.mirrored and first.parameters.particles < FINE and not here:
                self._coarse = first
                self._fine = replace(first, parameters=first.parameters.model_copy(update={"particles": FINE}))
                self._unissued.insert(0, self._fine)
            among = f" and {len(set(thetas))} θ of the posterior" if thetas else ""
            among += ", each with shapes that the vessels may have" if uncertain else ""
            self.decisions.append(Decision(f"simulate the planned action with {count} new seeds{among}"))
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
        valid = isinstance(outcome, Simulated) and outcome.outcome.invalid is None
        self._spilled[request] = (
            outcome.outcome.fractions.spillage if isinstance(outcome, Simulated) and valid else None
        )
        if request == self._fine:
            return
        costing = self._costing.of_theta(request.parameters)
        cost = costing.simulated(outcome, request.action)
        if isinstance(outcome, Simulated) and cost is not None:
            self._outcomes.append(outcome.outcome)
            self._losses.append(cost)
        elif cost is not None and request.drawn_shapes:
            self._touching += 1
            self._losses.append(cost)
        else:
            self._lost += 1

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        answered = len(self._spilled)
        return Progress(answered, answered + len(self._open) + len(self._unissued))

    def result(self) -> ActionPrediction:
        """Mean and standard deviation over the seeds answered so far."""
        over_seeds = spreads(self._outcomes)
        loss = SampleStatistics.of(self._losses)
        if loss is not None:
            over_seeds["loss"] = loss
        return ActionPrediction(
            scene=self._costing.scene.name,
            simulations=self.progress().simulations,
            simulations_lost=self._lost,
            thetas=self._thetas,
            touching=self._touching,
            over_seeds=over_seeds,
            interval=band_of(self._outcomes, self._residual, self._shift_of_finer()),
        )

    def _shift_of_finer(self) -> float:
        """Shift of the simulation with more particles from the same with the usual number; 0 without one."""
        coarse, fine = (
            None if request is None else self._spilled.get(request) for request in (self._coarse, self._fine)
        )
        if self._coarse is None or coarse is None or fine is None:
            return 0.0
        # Of both, half a particle of the coarser one is the least that can be seen.
        particles = self._coarse.parameters.particles
        return shift_of(fine, particles) - shift_of(coarse, particles)


CONFIRM = "confirm"
"""Purpose of these pours."""


class ConfirmationRow(WeighedMasses):
    """A pour of the recommended action."""

    number: int
    """Number of the pour, from 1."""

    failed: str
    """Reason why nothing was weighed; '' if it was weighed."""

    loss: float | None
    """Loss in its own unit; None if nothing was weighed."""

    delivered_ml: float | None
    """The delivered mass as a volume [ml], from the liquid's density."""


class Confirmed(StageResult):
    """Losses of the recommended action, without the bias of its selection."""

    kind: Literal["confirmation"] = "confirmation"

    scene: str
    """Name of the scene."""

    pours: tuple[ConfirmationRow, ...]
    """All completed pours, in the order made."""

    loss: SampleStatistics | None
    """Mean and scatter of the weighed pours; None without any."""

    delivered_g: SampleStatistics | None
    """Mean and scatter of the mass in the receiver [g]."""

    delivered_ml: float | None
    """Mean volume in the receiver [ml], from the liquid's density."""


class Confirmation:
    """Repeat the pour that a deployment recommends.

    The smallest of several measured losses is biased low. Pours after the selection give an unbiased estimate of the
    recommended action's loss. A failed pour is recorded as failed, and the next one is made. If the action is refused,
    no further pour is made.
    """

    def __init__(self, costing: Costing, recommended: Recommended | None, count: int, seed: int) -> None:
        """Plan the pours.

        Args:
            costing: scene and loss of the deployment.
            recommended: the recommendation; with None, nothing is poured.
            count: number of pours.
            seed: seed of a virtual bench's random numbers.
        """
        self._costing = costing
        self._recommended = recommended
        self._count = 0 if recommended is None else count
        self._seeds = SeedStream(seed, f"confirm {costing.scene.name}")
        self._pouring: Pour | None = None
        self._pours: list[ConfirmationRow] = []
        self.decisions: list[Decision] = []
        if recommended is None:
            self.decisions.append(Decision("no action is recommended, so there is nothing to confirm"))

    @property
    def finished(self) -> bool:
        """Whether all pours are completed."""
        return len(self._pours) >= self._count

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next pour, if none is running."""
        recommended = self._recommended
        if recommended is None or self.finished or self._pouring is not None or slots.pours < 1:
            return []
        predicted = Prediction(
            recommended.predicted_loss, recommended.predicted_deviation, recommended.predicted_scatter
        )
        action, number = self._costing.scene.action(dict(recommended.action_si)), len(self._pours) + 1
        self._pouring = Pour(self._costing.scene.name, action, number, self._seeds.next(), predicted, CONFIRM)
        self.decisions.append(Decision(f"confirm the recommended action, pour {number}/{self._count}"))
        return [self._pouring]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a pour.

        Raises:
            ValueError: the pour was not requested.
        """
        pour = self._pouring
        if pour is None or request != pour:
            raise ValueError(f"this pour was not asked for: {request}")
        self._pouring = None
        assert self._recommended is not None
        trial = DeploymentTrial(pour.number, (), dict(self._recommended.action_si), pour.predicted, 0.0)
        trial.take(outcome, self._costing.scene, self._costing, penalised=False)
        if trial.status == "refused":
            self._count = len(self._pours) + 1  # it would be refused again
        row = trial.row(self._costing.scene.liquid)
        self._pours.append(
            ConfirmationRow(
                number=row.number,
                failed=f"invalid_action: {row.reason}" if row.status == "refused" else row.reason,
                loss=row.loss,
                delivered_ml=row.delivered_ml,
                **row.model_dump(include=set(WeighedMasses.model_fields)),
            )
        )

    def progress(self) -> Progress:
        """Pours made, and their total number."""
        return Progress(pours=len(self._pours), of_pours=self._count)

    def result(self) -> Confirmed:
        """Outcomes of the pours so far."""
        weighed = [pour for pour in self._pours if not pour.failed]
        volume = SampleStatistics.of([pour.delivered_ml for pour in weighed if pour.delivered_ml is not None])
        return Confirmed(
            scene=self._costing.scene.name,
            pours=tuple(self._pours),
            loss=SampleStatistics.of([pour.loss for pour in weighed if pour.loss is not None]),
            delivered_g=SampleStatistics.of([pour.delivered_g for pour in weighed if pour.delivered_g is not None]),
            delivered_ml=None if volume is None else volume.mean,
        )
