"""Base of the deployment strategies D1, D2 and D3: requests, pours, counts and results, and their common settings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar, cast

from actors.optimizer.questions import (
    Data,
    Point,
    PourQuery,
    RegressionQuery,
    SpaceFillingQuery,
    Suggestion,
    SurrogateQuery,
)
from orchestrator.requests import (
    ADDED,
    Decision,
    Failed,
    Outcome,
    Pour,
    Prediction,
    Request,
    Simulate,
    Slots,
    Suggest,
)
from orchestrator.strategies.calibration.calibration_base import Kappa
from orchestrator.strategies.campaign_plan import DeploymentPlan, DeploymentSettings
from orchestrator.strategies.deployment.costing import Costing
from orchestrator.strategies.deployment.deployment_result import Deployed, Recommended, RiskFound, SimulatedAction
from orchestrator.strategies.deployment.model_monitoring import Believed
from orchestrator.strategies.deployment.objectives import Vector
from orchestrator.strategies.deployment.real_pours import (
    PourTrial,
    PredictionCheck,
    expecting,
    point_of,
    prior_pours,
    scaled_interval,
    trust,
)
from orchestrator.strategies.deployment.safe_window import WindowFound
from orchestrator.strategies.deployment.scalarization import Scalarization
from orchestrator.strategies.stage_result import displayed_map
from orchestrator.strategies.strategy import Progress
from orchestrator.strategies.trials import OptimizerQueries, SeedStream, Trial, Trials
from sim_engine.action import Action, described
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics
from sim_engine.scene import Scene
from sim_engine.settings.model import PositiveSimulationCount


class SearchSettings(DeploymentSettings):
    """Settings of D1, D2 and D3: Bayesian optimisation."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    initial_samples: PositiveSimulationCount = 3
    """Random actions before the surrogate takes over."""


MAX_REFUSED = 20
"""Number of refused actions (touching vessels, out of reach) that are free: pours before a strategy gives up, and
simulations before further ones count against the budget."""

MAP_RESOLUTION = 25

GOLDEN_RATIO = 0.6180339887498949
"""Multiples of it modulo 1 cover the unit interval evenly, however many there are."""

S = TypeVar("S", bound=DeploymentSettings)
"""Settings of a deployment."""

Q = TypeVar("Q", bound=SurrogateQuery)
"""Type of a query."""


class Deployment(ABC, Generic[S]):
    """Base of D1, D2 and D3 in one scene. Subclasses choose the next query (`_next`) and conclude.

    An impossible action, because the vessels touch or the arm can't reach it, is refused before anything is simulated
    or moved. It has no cost. The optimiser is given the place, and avoids places where another refusal is likely. A
    refusal does not count against a budget; at most `MAX_REFUSED` are free. A pour that failed after something had
    moved counts, and enters the data with the worst cost (`on_failed_pour: penalise`) or not at all (`ignore`).

    If the plan has posterior draws of θ, the simulations use them in turn, so that the expected loss over all θ that
    fit the weighed pours is minimised. Where many θ fit equally well, θ* is one of them that rounding may decide; the
    mean over the draws is stable.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        self._plan = plan
        self._settings = cast(S, plan.settings)
        self._data = plan.data if plan.settings.learns_on_pours else None
        self._scene = scene
        self._parameters = parameters
        self._simulated_thetas = 0
        self._costing = Costing.of(plan, scene, parameters)
        self._seeds = SeedStream(seed, f"{plan.strategy} {scene.name}")
        self._scalarization = Scalarization(self._costing, self._seeds.rng)
        self._questions = OptimizerQueries(self._seeds)
        self._trials = Trials()
        self._width_known = False
        self._pours: list[PourTrial] = []
        self._prior_pours = () if self._data is None else prior_pours(self._data, scene, plan.actions, self._costing)
        self._added: list[PourTrial] = []
        self._queued_pour: Pour | None = None
        self._pouring: Pour | None = None
        self._final: Suggestion | None = None
        self._latest_map: Suggestion | None = None
        self._finished = False
        self.decisions: list[Decision] = []
        if self._data is not None:
            path = self._data.path
            text = f"{len(self._prior_pours)} former pours enter the data ({path.parent.name}/{path.name})"
            self.decisions.append(Decision("; left out: ".join([text, *self._data.left_out])))

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
            self._next(slots.simulations - len(simulations))
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
            avoided = request.pose_error is None  # under an error, touching is what may happen
            if avoided and isinstance(outcome, Failed) and outcome.kind == "invalid_action":
                self._trials.settle(request, None, refused=True)
            else:
                vector = self._costing.of_theta(request.parameters).simulated(outcome, request.action)
                self._trials.settle(request, self._scalarization.note(request, vector))
        elif request == self._pouring:
            self._pouring = None
            trial = self._pours[-1]
            trial.take(outcome, self._scene, self._costing, penalised=self._settings.on_failed_pour == "penalise")
            if trial.status == "weighed" and trial.cost is not None:
                self.decisions.append(Decision(f"pour {trial.number}: loss {trial.cost:.4g}", {"loss": trial.cost}))
        elif isinstance(request, Pour) and request.purpose == ADDED:
            self._add(request.action, outcome)
        else:
            raise ValueError(f"this pour was not asked for: {request}")

    def _add(self, action: Action, outcome: Outcome) -> None:
        """Take a pour that was not asked for into the data."""
        values = {name: float(getattr(action, name)) for name in self._plan.actions.names}
        trial = PourTrial(0, point_of(action, self._plan.actions), values, None, 0.0)
        trial.take(outcome, self._scene, self._costing, penalised=False)
        if trial.cost is not None:
            trial.status = "added"
            self._added.append(trial)
            text = f"a pour was added: {described(values)}  loss {trial.cost:.4g}"
            self.decisions.append(Decision(text, {"loss": trial.cost}))

    @property
    def _may_think(self) -> bool:
        """Whether nothing is queued and no query is pending, so that the next query can be made."""
        return not self._questions.out and not self._trials.queued

    @abstractmethod
    def _next(self, free_simulations: int) -> None:
        """Put the next query, or finish. It is called if `_may_think` and no pour is queued."""

    # -- pieces for subclasses -------------------------------------------------------------------------------------

    def _simulate(self, suggestion: Suggestion, purpose: str, *, first: int = 0, repeats: int = 1) -> None:
        """Queue simulations of the suggested points, from the `first`."""
        for i, point in enumerate(suggestion.points[first:], start=first):
            values = self._plan.actions.decode(point)
            self._trials.add(Trial(point, self._repeated(self._scene.action(values), purpose, repeats)))
            self._decide(f"simulate ({purpose})", values, suggestion, i)

    def _repeated(self, action: Action, purpose: str, repeats: int) -> tuple[Simulate, ...]:
        """Simulations of one action, each with the next θ."""
        name, seeds = self._scene.name, self._seeds
        return tuple(Simulate(name, action, self._next_theta(), seeds.next(), purpose) for _ in range(repeats))

    def _next_theta(self) -> SimulationParameters:
        """The next of the plan's draws of θ, in an order of which any section covers them evenly; θ* without draws."""
        thetas = self._plan.thetas
        if not thetas:
            return self._parameters
        self._simulated_thetas += 1
        return thetas[int(self._simulated_thetas * GOLDEN_RATIO % 1.0 * len(thetas))]

    def _pour(self, point: Point, prediction: Prediction | None) -> None:
        """Queue a pour."""
        values = self._plan.actions.decode(point)
        noise = 0.0 if prediction is None or prediction.scatter is None else prediction.scatter
        trial = PourTrial(self._counted + 1, point, values, prediction, noise)
        self._pours.append(trial)
        action = self._scene.action(values)
        self._queued_pour = Pour(self._scene.name, action, trial.number, self._seeds.next(), prediction)
        text = f"pour {trial.number}/{self._plan.pours}  {described(values)}"
        self.decisions.append(Decision(text) if prediction is None else expecting(text, prediction))

    def _pour_first(self, suggestion: Suggestion) -> None:
        """Queue a pour of the first suggested point, with the surrogate's prediction if there is one."""
        self._latest_map = suggestion if suggestion.surrogate is not None else self._latest_map
        known = None
        if suggestion.means and not self._scalarization.exploring:
            noise = suggestion.noises[0] if suggestion.noises else None
            band = suggestion.bands[0] if suggestion.bands else None
            known = Prediction(suggestion.means[0], suggestion.deviations[0], self._scatter(suggestion, noise), band)
            if band is not None and suggestion.discrepancy is not None:
                known = replace(known, band=scaled_interval(known, self._pours, self._costing.worst))
            elif band is not None:  # averaged over hyperparameters; the largest loss is unknown there
                known = replace(known, band=(min(band[0], self._costing.worst), min(band[1], self._costing.worst)))
        self._pour(suggestion.points[0], known)

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Standard deviation of one observation around the surrogate [the loss' unit]: from pour to pour, or in
        simulation from seed to seed, as fitted; None without a surrogate.

        Args:
            noise: of the answer at this point; None: the noise of the whole surrogate.
        """
        return (suggestion.hyperparameters or {}).get("noise") if noise is None else noise

    def _real(self) -> Data:
        """Observations of the real cost; those from before the campaign come first."""
        poured = self._poured
        return self._scalarization.data(
            poured, [*poured, *self._scalarization.of(self._trials.counting(everything=True))]
        )

    def _simulated(self, *, everything: bool = False) -> Data:
        """Observations of the simulated cost."""
        if not self._scalarization.exploring:
            return self._trials.data(everything=everything)
        observed = self._scalarization.of(self._trials.counting(everything=everything))
        return self._scalarization.data(observed, [*self._poured, *observed])

    @property
    def _poured(self) -> list[tuple[Point, Vector]]:
        return [*self._known, *((p.point, p.vector) for p in self._pours if p.vector is not None)]

    @property
    def _known(self) -> list[tuple[Point, Vector]]:
        """Pours that the strategy did not ask for: from before the campaign, and added by hand."""
        return [*self._prior_pours, *((p.point, p.vector) for p in self._added if p.vector is not None)]

    @property
    def _counted(self) -> int:
        """Pours that count against the budget."""
        former = len(self._prior_pours) if self._data is not None and self._data.counts else 0
        return former + sum(p.status in ("weighed", "failed") for p in self._pours)

    @property
    def _warned(self) -> bool:
        """Whether failed pours indicate more failures near them; in the paper they are pours that lost everything."""
        return True

    @property
    def _refused(self) -> int:
        return sum(p.status == "refused" for p in self._pours)

    @property
    def _spent(self) -> int:
        """Simulated trials before any pour that count against their budget, as known to the next choice."""
        return len(self._trials) - self._unspent

    @property
    def _unspent(self) -> int:
        counting = self._trials.counting(everything=self._trials.idle)
        return min(sum(t.refused and t.requests[0].purpose not in ("refine", "window") for t in counting), MAX_REFUSED)

    @property
    def _pours_left(self) -> bool:
        return self._counted < self._plan.pours and self._refused < MAX_REFUSED

    def _conclude(self, suggestion: Suggestion) -> None:
        self._final = suggestion
        self._finish()

    def _finish(self) -> None:
        """Finish; if a front is searched, first regress each objective."""
        if not self._scalarization.wanted or self._scalarization.front is not None:
            self._finished = True
            return
        simulated = self._scalarization.of(self._trials.counting(everything=True))
        self._scalarization.look_for_front(
            simulated, self._poured, self._plan.actions, self._front_query, self._questions, self._finish
        )

    def _front_query(self, simulated: Data, poured: Data) -> RegressionQuery | PourQuery:
        """How one objective is regressed: of the simulations, unless a strategy pours."""
        return self._query(RegressionQuery, simulated)

    def _decide(self, what: str, values: dict[str, float], suggestion: Suggestion, index: int) -> None:
        text = f"{what}  {described(values)}"
        if not suggestion.means:
            found = Decision(f"{text}  (no surrogate yet)")
        elif self._scalarization.exploring:
            found = Decision(f"{text}  (a scalarization under random weights)")
        else:
            found = expecting(text, Prediction(suggestion.means[index], suggestion.deviations[index]))
        self.decisions.append(found)

    def _query(self, kind: type[Q], data: Data, *, everything: bool = True, **parts: Any) -> Q:
        """A query about the loss.

        Args:
            kind: its type.
            data: observations of the loss.
            everything: use all refusals of simulations; else those that the next choice may know.
            parts: further fields of the query.
        """
        if isinstance(self._settings, SearchSettings):
            parts["kappa"] = self._settings.kappa
        return kind(self._plan.actions, data, noise=self._settings.noise, **self._limits(everything), **parts)

    def _space_filling(self, **parts: Any) -> SpaceFillingQuery:
        """A query for points that fill the space of actions."""
        return SpaceFillingQuery(self._plan.actions, **self._limits(everything=True), **parts)

    def _limits(self, everything: bool) -> dict[str, Any]:
        """Constraints, refusals and failures, as fields of a query."""
        trials = self._trials.counting(everything=everything)
        return {
            "constraints": self._plan.constraints,
            "infeasible": tuple(trial.point for trial in trials if trial.refused),
            "refused": tuple(p.point for p in self._pours if p.status == "refused"),
            "failed": tuple(p.point for p in self._pours if p.mishap and p.cost is not None) if self._warned else (),
        }

    # -- results ---------------------------------------------------------------------------------------------------

    @property
    def best_values(self) -> dict[str, float] | None:
        """The recommended action, by posterior mean [SI]; None before the end, and without any usable outcome."""
        if self._final is None or self._final.best_point is None:
            return None
        return self._plan.actions.decode(self._final.best_point)

    def progress(self) -> Progress:
        """Requests done, and their total number."""
        return Progress(pours=min(self._counted, self._plan.pours), of_pours=self._plan.pours)

    def _trusted(self, weighed: Sequence[PourTrial]) -> PredictionCheck | Believed:
        """Compare the pours with their predictions."""
        return trust(weighed)

    def result(self) -> Deployed:
        """The result so far."""
        names, front = self._scalarization.names, self._scalarization.front
        latest = self._final or self._latest_map
        return Deployed(
            strategy=self._plan.strategy,
            scene=self._scene.name,
            loss=self._plan.loss_name,
            simulations=self._trials.answered,
            simulations_lost=self._trials.lost,
            simulations_refused=sum(trial.refused for trial in self._trials.all),
            pours=tuple(
                p.row(names, self._scene.liquid) for p in [*self._added, *self._pours] if p.status != "pouring"
            ),
            simulated=tuple(
                SimulatedAction(action_si=self._plan.actions.decode(trial.point), loss=trial.cost)
                for trial in self._trials.all
                if trial.closed and trial.cost is not None
            ),
            former_pours=len(self._prior_pours),
            refused_pours=self._refused,
            failed_pours=sum(p.status == "failed" for p in self._pours),
            model_check=self._trusted([p for p in self._pours if p.status == "weighed" and p.cost is not None]),
            gave_up=self._gave_up,
            objectives=names,
            pareto_front=None if front is None else tuple(front),
            map=None if latest is None else displayed_map(latest.surrogate, self._plan.actions),
            recommended=None if self._final is None else self._recommended(self._final),
            risk=None if self._final is None else self._risk_found(self._final),
            window=self._window_found(),
        )

    @property
    def _gave_up(self) -> str | None:
        if self._refused < MAX_REFUSED:
            return None
        return f"{self._refused} pours were refused as invalid; the action space hardly allows any"

    def _recommended(self, final: Suggestion) -> Recommended | None:
        """The recommendation of the last answer, with its prediction."""
        spillage = None if final.best_point is None else self._spillage(final.best_point)
        return Recommended.of(final, self._plan.actions, self._scatter(final, final.best_noise), spillage)

    def _spillage(self, point: Point) -> SampleStatistics | None:
        """Statistics of r = spilled / poured over the simulations of an action, if they are recorded."""
        return None

    def _risk_found(self, final: Suggestion) -> RiskFound | None:
        """Effect of execution errors on the recommended action, if it was planned under them."""
        return None

    def _window_found(self) -> WindowFound | None:
        """The safe window around the recommended action, if it was searched."""
        return None
