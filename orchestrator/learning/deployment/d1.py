"""D1: plan in simulation only, then pour once. `D1Settings` holds the settings, `OneShotPlanning` is the strategy.

D1 does not learn from real pours. `action_evaluation` makes the simulations and queries of an action, with and without
disturbances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import ClassVar, Literal

from actors.optimizer.questions import Point, Suggestion
from orchestrator.learning.campaign_plan import DeploymentPlan, Draw, Premises
from orchestrator.learning.deployment.action_evaluation import RiskMeasure, SeedMean
from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment
from orchestrator.learning.deployment.deployment_ledger import SearchSettings
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.disturbances import Disturbances, RiskSettings
from orchestrator.learning.requests import Outcome, Request, Simulate, Simulated
from orchestrator.learning.strategy import Progress, Strategy, is_sound, plural
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics
from sim_engine.scene import Scene
from sim_engine.settings.model import PositiveSimulationCount, PourCount, Problems


class D1Settings(SearchSettings):
    """D1: plan in simulation, then pour once."""

    learns_on_pours: ClassVar[bool] = False

    strategy: Literal["D1"] = "D1"
    """Plan in simulation, then pour once."""

    pours: PourCount = 1
    """Whether the planned action is poured; 0 only plans."""

    iterations: PositiveSimulationCount | None = None
    """Iterations of the optimiser; 15 unless given, 30 with 'risk'."""

    simulations_per_iteration: PositiveSimulationCount = 2
    """Simulations averaged per iteration; with 'risk', one is as planned and the others are under errors."""

    risk: RiskSettings | None = None
    """Errors of execution and of θ under which the loss is minimised."""

    @property
    def rounds(self) -> int:
        """Iterations of the optimiser."""
        return self.iterations or (15 if self.risk is None else 30)

    @property
    def needs_posterior(self) -> bool:
        """Whether the risk includes the uncertainty of θ."""
        return self.risk is not None and self.risk.theta == "posterior"

    @property
    def simulations(self) -> int:
        """Simulations of all iterations."""
        return self.rounds * self.simulations_per_iteration

    @property
    def spending(self) -> str:
        """The budget per receiver, as text."""
        simulations = plural(self.simulations_per_iteration, "simulation")
        return f"{plural(self.rounds, 'iteration')} of {simulations}, one pour"

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Check that risk is combined with a loss, and that it names at least one error."""
        if self.risk is None:
            return
        if premises.objectives:
            complaints.add("is about a loss; it can't be combined with 'objectives'", "risk", key=True)
        self.risk.check(complaints)
        if self.simulations_per_iteration == 1:
            text = "one simulation of each action is made as planned, so that with 'risk' at least 2 are needed"
            complaints.add(text, "simulations_per_iteration")

    def draws(self, plan: DeploymentPlan, parameters: SimulationParameters, count: int, seed: int) -> Sequence[Draw]:
        """Errors and θ of the planning."""
        if self.risk is None:
            return ()
        return Disturbances(self.risk, plan.actions, parameters, seed, plan.thetas).draws(count)

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""
        return OneShotPlanning(plan, scene, parameters, seed)


class OneShotPlanning(Deployment[D1Settings]):
    """D1: minimise the simulated loss, then pour once. No sensor is needed.

    Bayesian optimisation of f̄_s(a) = 1/m1 Σ_j f_s(a, seed_j) with m1 simulations per iteration, starting at Sobol
    points instead of random ones; with `risk`, of a measure over disturbances (`RiskMeasure`). The last iteration
    simulates the minimiser of the posterior mean over the whole box. The recommended action is the simulated action
    with the smallest posterior mean, or the gentlest of those that are equal to it (`Equality`), and it is poured if
    the budget allows. It has thus been simulated, and is not selected by a single low observation.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D1); that m1 simulations are averaged is our interpretation.
    Limitations: an error of the simulator is an error of the plan.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        risk, repeats = self._settings.risk, self._settings.simulations_per_iteration
        self._evaluation = SeedMean(self._requests, repeats)
        if risk is not None:
            disturbances = Disturbances(risk, plan.actions, parameters, self._seeds.next(), plan.thetas)
            self._evaluation = RiskMeasure(self._requests, repeats, disturbances, self._settings.rounds)
        self._spillages: dict[Simulate, float | None] = {}

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in the base class; the spillage of each simulation is recorded as well, whatever the loss is."""
        super().tell(request, outcome)
        if isinstance(request, Simulate):
            self._evaluation.record(request, outcome)
            if (
                isinstance(outcome, Simulated)
                and outcome.outcome.invalid is None
                and is_sound(outcome.outcome.fractions)
            ):
                self._spillages[request] = outcome.outcome.fractions.spillage

    def _next(self) -> None:
        trials, done, wanted = self._trials, self._ledger.spent, self._settings.rounds
        plan = partial(self._simulate, purpose="plan")
        if self._width_known and trials.all == []:
            # slots count simulations; a trial takes m1 of them
            trials.width = math.ceil(trials.width / self._settings.simulations_per_iteration)
        if self._report.final is not None:
            if self._pouring is not None:
                return
            if self._ledger.counted == 0 and self._ledger.pours_left:  # the pour was refused
                self._ask_for_the_best()
            else:  # the only pour has been weighed
                self._finished = True
        elif len(trials) == 0:
            count = min(max(self._settings.initial_samples, 1), max(wanted - 1, 1))
            self._questions.put(self._requests.space_filling(count=count), "start", plan)
        elif done < wanted - 1:
            if trials.ready:
                self._questions.put(self._evaluation.search(), "plan", plan)
        elif done < wanted:
            if trials.idle:
                query = self._evaluation.search(everything=True, acquisition="posterior_minimum")
                self._questions.put(query, "plan", plan)
        elif trials.idle:
            self._ask_for_the_best()

    def _simulations_of(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        return self._evaluation.simulations(action, purpose)

    # -- the recommendation ----------------------------------------------------------------------------------------

    def _ask_for_the_best(self) -> None:
        query = self._evaluation.regression(map_resolution=MAP_RESOLUTION)
        self._questions.put(query, "conclude", self._recommend)

    def _recommend(self, suggestion: Suggestion) -> None:
        suggestion = self._report.final = self._evaluation.allowed(suggestion)
        if suggestion.best_point is None or self._plan.pours < 1:
            self._finished = True  # without a point, too few simulations succeeded; the result reports how many
        else:
            self._pour(suggestion.best_point, self._evaluation.prediction(suggestion))

    # -- results ---------------------------------------------------------------------------------------------------

    def progress(self) -> Progress:
        """Simulations and pours done, and their total numbers."""
        repeats = self._settings.simulations_per_iteration
        pours = 1 if self._plan.pours else 0
        answered = self._trials.answered - repeats * self._ledger.unspent
        return Progress(answered, self._settings.rounds * repeats, self._ledger.counted, pours)

    def result(self) -> Deployed:
        """The result so far, with the risk."""
        final = self._report.final
        return self._report.result(
            gave_up=self._evaluation.gave_up,
            scatter=self._evaluation.scatter,
            spillage=None if final is None or final.best_point is None else self._spillage(final.best_point),
            risk=None if final is None else self._evaluation.risk_found(final),
        )

    def _spillage(self, point: Point) -> SampleStatistics | None:
        """Statistics over seeds that took part in the selection; `orchestrator.learning.single_action` uses new
        ones."""
        tried = [trial for trial in self._trials.all if trial.point == point]
        return SampleStatistics.of(
            [r for trial in tried for q in trial.requests if (r := self._spillages.get(q)) is not None]
        )
