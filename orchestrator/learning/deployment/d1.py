"""D1: plan in simulation only, then pour once. `D1Settings` holds the settings, `OneShotPlanning` is the strategy.

D1 does not learn from real pours.
"""

from __future__ import annotations

import math
from functools import partial
from statistics import NormalDist
from typing import ClassVar, Literal

from actors.optimizer.questions import MinimumQuery, Point, RegressionQuery, Suggestion
from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment, observed_scatter
from orchestrator.learning.deployment.deployment_ledger import SearchSettings
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.requests import Outcome, Prediction, Request, Simulate, Simulated
from orchestrator.learning.strategy import Progress, Strategy, is_sound, plural
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import SampleStatistics, lacking_shift, shift_of
from sim_engine.scene import Scene
from sim_engine.settings.model import PositiveSimulationCount, PourCount


class D1Settings(SearchSettings):
    """D1: plan in simulation, then pour once."""

    learns_on_pours: ClassVar[bool] = False

    strategy: Literal["D1"] = "D1"
    """Plan in simulation, then pour once."""

    pours: PourCount = 1
    """Whether the planned action is poured; 0 only plans."""

    iterations: PositiveSimulationCount | None = None
    """Iterations of the optimiser; 15 unless given."""

    simulations_per_iteration: PositiveSimulationCount = 2
    """Simulations averaged per iteration."""

    @property
    def rounds(self) -> int:
        """Iterations of the optimiser."""
        return self.iterations or 15

    @property
    def simulations(self) -> int:
        """Simulations of all iterations."""
        return self.rounds * self.simulations_per_iteration

    @property
    def spending(self) -> str:
        """The budget per receiver, as text."""
        simulations = plural(self.simulations_per_iteration, "simulation")
        return f"{plural(self.rounds, 'iteration')} of {simulations}, one pour"

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""
        return OneShotPlanning(plan, scene, parameters, seed)


class OneShotPlanning(Deployment[D1Settings]):
    """D1: minimise the simulated loss, then pour once. No sensor is needed.

    Bayesian optimisation of f̄_s(a) = 1/m1 Σ_j f_s(a, seed_j) with m1 simulations per iteration, starting at Sobol
    points instead of random ones. The last iteration simulates the minimiser of the posterior mean over the whole box.
    The recommended action is the simulated action with the smallest posterior mean, or the gentlest of those that are
    equal to it (`Equality`), and it is poured if the budget allows. It has thus been simulated, and is not selected by
    a single low observation.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D1); that m1 simulations are averaged is our interpretation.
    Limitations: an error of the simulator is an error of the plan.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._repeats = self._settings.simulations_per_iteration
        self._spillages: dict[Simulate, float | None] = {}

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in the base class; the spillage of each simulation is recorded as well, whatever the loss is."""
        super().tell(request, outcome)
        if isinstance(request, Simulate) and (
            isinstance(outcome, Simulated) and outcome.outcome.invalid is None and is_sound(outcome.outcome.fractions)
        ):
            self._spillages[request] = outcome.outcome.fractions.spillage

    def _next(self) -> None:
        trials, done, wanted = self._trials, self._ledger.spent, self._settings.rounds
        plan = partial(self._simulate, purpose="plan")
        if self._width_known and trials.all == []:
            # slots count simulations; a trial takes m1 of them
            trials.width = math.ceil(trials.width / self._repeats)
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
                self._questions.put(self._search(), "plan", plan)
        elif done < wanted:
            if trials.idle:
                query = self._search(everything=True, acquisition="posterior_minimum")
                self._questions.put(query, "plan", plan)
        elif trials.idle:
            self._ask_for_the_best()

    def _simulations_of(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        return self._requests.simulations(action, purpose, self._repeats)

    def _search(
        self, *, everything: bool = False, acquisition: Literal["lcb", "posterior_minimum"] = "lcb"
    ) -> MinimumQuery:
        """A query for the next action to simulate; with `everything`, of all simulations."""
        return self._requests.query(
            MinimumQuery,
            self._ledger.simulated(everything=everything),
            everything=everything,
            pending=self._trials.pending(everything=everything),
            acquisition=acquisition,
        )

    # -- the recommendation ----------------------------------------------------------------------------------------

    def _ask_for_the_best(self) -> None:
        data, equality = self._ledger.simulated(everything=True), self._requests.equality
        query = self._requests.query(RegressionQuery, data, equality=equality, map_resolution=MAP_RESOLUTION)
        self._questions.put(query, "conclude", self._recommend)

    def _recommend(self, suggestion: Suggestion) -> None:
        self._report.final = suggestion
        if suggestion.best_point is None or self._plan.pours < 1:
            self._finished = True  # without a point, too few simulations succeeded; the result reports how many
        else:
            self._pour(suggestion.best_point, self._prediction(suggestion))

    def _prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for the pour of the recommended action."""
        if suggestion.best_mean is None or suggestion.best_deviation is None:
            return None
        scatter = self._scatter(suggestion, suggestion.best_noise)
        return Prediction(suggestion.best_mean, suggestion.best_deviation, scatter)

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: between seeds, and by the simulator's inaccuracy.

        The observations are means over m1 seeds, so that their scatter is scaled by √m1. A loss is treated as spilled
        liquid whose stream is shifted (`sim_engine.prediction_band`); an objective is not a loss.
        """
        of_means = observed_scatter(suggestion, noise)
        if of_means is None or suggestion.best_mean is None:
            return None
        of_seeds = of_means * math.sqrt(self._repeats)
        if self._plan.objective is not None:
            return of_seeds
        costing = self._ledger.costing
        worst, particles = costing.everything_spilled, costing.parameters.particles
        steep = worst * NormalDist().pdf(shift_of(suggestion.best_mean / worst, particles))
        lacking = lacking_shift(particles, self._plan.left_over, of_seeds / steep)
        return math.hypot(of_seeds, steep * lacking)

    # -- results ---------------------------------------------------------------------------------------------------

    def progress(self) -> Progress:
        """Simulations and pours done, and their total numbers."""
        pours = 1 if self._plan.pours else 0
        answered = self._trials.answered - self._repeats * self._ledger.unspent
        return Progress(answered, self._settings.simulations, self._ledger.counted, pours)

    def result(self) -> Deployed:
        """The result so far, with the spillage of the recommended action."""
        final = self._report.final
        return self._report.result(
            scatter=self._scatter,
            spillage=None if final is None or final.best_point is None else self._spillage(final.best_point),
        )

    def _spillage(self, point: Point) -> SampleStatistics | None:
        """Statistics over seeds that took part in the selection; `orchestrator.learning.single_action` uses new
        ones."""
        tried = [trial for trial in self._trials.all if trial.point == point]
        return SampleStatistics.of(
            [r for trial in tried for q in trial.requests if (r := self._spillages.get(q)) is not None]
        )
