"""Base of the deployment strategies D1, D2 and D3, composed of a ledger, queries and a report.

- `Deployment` makes the requests and passes on the outcomes. Its subclasses choose the next query or pour.
- `DeploymentReport` builds the result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, TypeVar, cast

from actors.optimizer.questions import Point, Suggestion
from orchestrator.learning.campaign_plan import DeploymentPlan, DeploymentSettings
from orchestrator.learning.deployment.deployment_ledger import MAX_REFUSED, DeploymentLedger, DeploymentRequests
from orchestrator.learning.deployment.deployment_result import Deployed, Recommended, SimulatedAction
from orchestrator.learning.deployment.model_monitoring import Believed
from orchestrator.learning.deployment.real_pours import PredictionCheck, expecting, scaled_interval, trust
from orchestrator.learning.requests import Decision, Outcome, Pour, Prediction, Request, Simulate, Slots, Suggest
from orchestrator.learning.stage_result import displayed_map
from orchestrator.learning.strategy import Progress
from orchestrator.learning.trials import OptimizerQueries, SeedStream, Trial
from sim_engine.action import Action, described
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics
from sim_engine.scene import Scene

MAP_RESOLUTION = 25

S = TypeVar("S", bound=DeploymentSettings)
"""Settings of a deployment."""


def observed_scatter(suggestion: Suggestion, noise: float | None) -> float | None:
    """Standard deviation of one observation around the surrogate [the loss' unit]: from pour to pour, or in simulation
    from seed to seed, as fitted; None without a surrogate.

    Args:
        noise: of the answer at this point; None: the noise of the whole surrogate.
    """
    return (suggestion.hyperparameters or {}).get("noise") if noise is None else noise


class DeploymentReport:
    """Builds the result of a deployment from its ledger and the answers of the optimiser.

    Attributes:
        final: the answer that the deployment concludes with; None before the end.
        latest_map: the latest answer with a map, which is shown until then.
    """

    def __init__(self, ledger: DeploymentLedger) -> None:
        self._ledger, self._plan = ledger, ledger.plan
        self.final: Suggestion | None = None
        self.latest_map: Suggestion | None = None

    def result(
        self,
        *,
        model_check: PredictionCheck | Believed | None = None,
        gave_up: str | None = None,
        scatter: Callable[[Suggestion, float | None], float | None] = observed_scatter,
        spillage: SampleStatistics | None = None,
        **parts: Any,
    ) -> Deployed:
        """The result so far.

        Args:
            model_check: conclusions about the simulator; by default, the pours are compared with their predictions.
            gave_up: reason of an early end other than refused pours.
            scatter: scatter of a single pour, as `observed_scatter`.
            spillage: statistics of r = spilled / poured over the simulations of the recommended action.
            parts: further fields of the result.
        """
        ledger, final, decode = self._ledger, self.final, self._plan.actions.decode
        latest = final or self.latest_map
        if gave_up is None and ledger.refused >= MAX_REFUSED:
            gave_up = f"{ledger.refused} pours were refused as invalid; the action space hardly allows any"
        recommended = None
        if final is not None:
            recommended = Recommended.of(final, self._plan.actions, scatter(final, final.best_noise), spillage)
        return Deployed(
            strategy=self._plan.strategy,
            scene=ledger.scene.name,
            loss=self._plan.loss_name,
            simulations=ledger.trials.answered,
            simulations_lost=ledger.trials.lost,
            simulations_refused=sum(trial.refused for trial in ledger.trials.all),
            pours=tuple(p.row(ledger.scene.liquid) for p in [*ledger.added, *ledger.pours] if p.status != "pouring"),
            simulated=tuple(
                SimulatedAction(action_si=decode(trial.point), loss=trial.cost)
                for trial in ledger.trials.all
                if trial.closed and trial.cost is not None
            ),
            former_pours=len(ledger.former),
            refused_pours=ledger.refused,
            failed_pours=sum(p.status == "failed" for p in ledger.pours),
            model_check=model_check or trust([p for p in ledger.pours if p.status == "weighed" and p.cost is not None]),
            gave_up=gave_up,
            map=None if latest is None else displayed_map(latest.surrogate, self._plan.actions),
            recommended=recommended,
            **parts,
        )


class Deployment(ABC, Generic[S]):
    """Base of D1, D2 and D3 in one scene. Subclasses choose the next query (`_next`) and conclude.

    An impossible action, because the vessels touch or the arm can't reach it, is refused before anything is simulated
    or moved. It has no cost. The optimiser is given the place, and avoids places where another refusal is likely.

    Parts: `_ledger` records trials, pours and costs; `_requests` builds simulations and queries; `_questions`
    holds the pending queries; `_report` builds the result.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        self._plan = plan
        self._settings = cast(S, plan.settings)
        self._scene = scene
        self._seeds = SeedStream(seed, f"{plan.strategy} {scene.name}")
        self._ledger = DeploymentLedger(plan, scene, parameters)
        self._trials = self._ledger.trials
        self._requests = DeploymentRequests(self._ledger, self._seeds)
        self._questions = OptimizerQueries(self._seeds)
        self._report = DeploymentReport(self._ledger)
        self._width_known = False
        self._queued_pour: Pour | None = None
        self._pouring: Pour | None = None
        self._finished = False
        self.decisions: list[Decision] = self._ledger.decisions
        if plan.memory is not None:
            self.decisions += [Decision(line) for line in plan.memory.lines]

    # -- requests and outcomes --------------------------------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether nothing is left to request and nothing is pending."""
        return self._finished and self._pouring is None and self._trials.idle

    def ask(self, slots: Slots) -> list[Request]:
        """Return the queued requests, and the next query as soon as the data it depends on is complete."""
        if not self._width_known and slots.simulations > 0:
            self._trials.width, self._width_known = slots.simulations, True
        simulations = self._trials.issue(slots.simulations)
        pours = self._issued_pour(slots)
        if not self._finished and self._may_think and self._queued_pour is None:
            self._next()
            pours += self._issued_pour(slots)
        # queries come first: with outcomes in request order, a query then does not wait for simulations
        return [*self._questions.issue(), *pours, *simulations]

    def _issued_pour(self, slots: Slots) -> list[Pour]:
        """The queued pour, if there is one and the arm is free."""
        if self._queued_pour is None or self._pouring is not None or slots.pours < 1:
            return []
        self._pouring, self._queued_pour = self._queued_pour, None
        return [self._pouring]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a query, a simulation or a pour."""
        if isinstance(request, Suggest):
            self._questions.answer(request, outcome)
        elif isinstance(request, Simulate):
            self._ledger.settle(request, outcome)
        elif request == self._pouring:
            self._pouring = None
            self._ledger.take(outcome)
        else:
            assert isinstance(request, Pour)
            self._ledger.add(request, outcome)

    def correct(self, request: Request, outcome: Outcome) -> None:
        """Replace the outcome of a pour that was told wrongly. Raises ValueError for any other request."""
        self._ledger.correct(request, outcome)

    @property
    def _may_think(self) -> bool:
        """Whether nothing is queued and no query is pending, so that the next query can be made."""
        return not self._questions.out and not self._trials.queued

    @abstractmethod
    def _next(self) -> None:
        """Put the next query, or finish. It is called if `_may_think` and no pour is queued."""

    # -- pieces for subclasses -------------------------------------------------------------------------------------

    def _simulate(self, suggestion: Suggestion, purpose: str, *, first: int = 0) -> None:
        """Queue simulations of the suggested points, from the `first`."""
        for i, point in enumerate(suggestion.points[first:], start=first):
            values = self._plan.actions.decode(point)
            self._trials.add(Trial(point, self._simulations_of(self._scene.action(values), purpose)))
            self._decide(f"simulate ({purpose})", values, suggestion, i)

    def _simulations_of(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        """The simulations that evaluate an action."""
        return self._requests.simulations(action, purpose)

    def _pour(self, point: Point, prediction: Prediction | None = None) -> None:
        """Queue a pour."""
        trial = self._ledger.begin(point, prediction)
        action = self._scene.action(trial.values)
        self._queued_pour = Pour(self._scene.name, action, trial.number, self._seeds.next(), prediction)
        begun, of = self._ledger.counted + 1, self._plan.pours
        name = f"pour {begun}/{of}" if trial.number == begun else f"pour {trial.number} ({begun} of {of})"
        text = f"{name}  {described(trial.values)}"
        self.decisions.append(Decision(text) if prediction is None else expecting(text, prediction))

    def _pour_first(self, suggestion: Suggestion) -> None:
        """Queue a pour of the first suggested point, with the surrogate's prediction if there is one."""
        if suggestion.surrogate is not None:
            self._report.latest_map = suggestion
        prediction, worst = None, self._ledger.costing.worst
        if suggestion.means:
            scatter = observed_scatter(suggestion, suggestion.noises[0] if suggestion.noises else None)
            band = suggestion.bands[0] if suggestion.bands else None
            prediction = Prediction(suggestion.means[0], suggestion.deviations[0], scatter, band)
            if band is not None and suggestion.discrepancy is not None:
                prediction = replace(prediction, band=scaled_interval(prediction, self._ledger.pours, worst))
            elif band is not None:  # averaged over hyperparameters; the largest loss is unknown there
                prediction = replace(prediction, band=(min(band[0], worst), min(band[1], worst)))
        self._pour(suggestion.points[0], prediction)

    def _conclude(self, suggestion: Suggestion) -> None:
        self._report.final = suggestion
        self._finished = True

    def _decide(self, purpose: str, values: dict[str, float], suggestion: Suggestion, index: int) -> None:
        text = f"{purpose}  {described(values)}"
        if not suggestion.means:
            decision = Decision(f"{text}  (no surrogate yet)")
        else:
            decision = expecting(text, Prediction(suggestion.means[index], suggestion.deviations[index]))
        self.decisions.append(decision)

    # -- results ---------------------------------------------------------------------------------------------------

    @property
    def best_values(self) -> dict[str, float] | None:
        """The recommended action, by posterior mean [SI]; None before the end, and without any usable outcome."""
        final = self._report.final
        return None if final is None or final.best_point is None else self._plan.actions.decode(final.best_point)

    def progress(self) -> Progress:
        """Requests done, and their total number."""
        return Progress(pours=min(self._ledger.counted, self._plan.pours), of_pours=self._plan.pours)

    def result(self) -> Deployed:
        """The result so far."""
        return self._report.result()
