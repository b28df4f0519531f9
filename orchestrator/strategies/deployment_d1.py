"""D1: plan in simulation only."""

from __future__ import annotations

import math
from typing import Any

from actors.optimizer.core.problem import Data, Suggestion, SuggestProblem
from orchestrator.plan import DeploymentPlan
from orchestrator.requests import Outcome, Prediction, Request, Simulate, Simulated
from orchestrator.strategies.deployment import MAP_RESOLUTION, Deployment
from orchestrator.strategies.sound import is_sound
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import normalised_spillage
from sim_engine.spread import Spread
from sim_engine.task import Scene


class OneShotPlanning(Deployment):
    """D1: minimise the simulated loss, then pour once. Needs no sensor.

    Bayesian optimisation of f̄_s(a) = 1/m1 Σ_j f_s(a, seed_j), with m1 simulations an iteration, started at Sobol points
    in place of random ones. The last iteration simulates the minimiser of the posterior mean over the whole box;
    what is recommended, and poured if there is a budget for it, is the best simulated action by posterior mean: an
    action that was at least tried in simulation, and not merely the luckiest.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D1); that m1 simulations are averaged is our reading.
    Limitations: an error of the simulator is an error of the plan.
    """

    NAME = "D1"
    LEARNS_ON_POURS = False

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._spillages: dict[Simulate, float | None] = {}

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As every deployment; and how much each simulation spilled, whatever the loss is."""
        super().tell(request, outcome)
        if (
            isinstance(request, Simulate)
            and isinstance(outcome, Simulated)
            and outcome.outcome.invalid is None
            and is_sound(outcome.outcome.fractions)
        ):
            self._spillages[request] = normalised_spillage(outcome.outcome.fractions)

    def _next(self, free_simulations: int) -> None:
        done, wanted = self._spent, max(self._plan.iterations, 1)
        repeats = max(self._plan.simulations_per_iteration, 1)
        if self._width_known and self._trials.all == []:
            # slots count simulations, a trial takes `repeats` of them
            self._trials.width = math.ceil(self._trials.width / repeats)

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "plan", repeats=repeats)

        if self._final is not None:
            if self._pouring is not None:
                return
            if self._counted == 0 and self._avoids and self._pours_left:  # it was refused
                self._recommend_again()
            else:  # the one pour has been weighed
                self._finish()
        elif len(self._trials) == 0:
            count = min(max(self._plan.initial, 1), max(wanted - 1, 1))
            self._questions.put(self._problem(Data(), acquisition="sobol", count=count), "start", simulate)
        elif done < wanted - 1:
            if self._trials.ready:
                self._questions.put(self._model(), "plan", simulate)
        elif done < wanted:
            if self._trials.idle:
                self._questions.put(self._model(everything=True, acquisition="posterior_minimum"), "plan", simulate)
        elif self._trials.idle:
            self._recommend_again()

    def _recommend_again(self) -> None:
        problem = self._model(everything=True, count=0, map_resolution=MAP_RESOLUTION)
        self._questions.put(problem, "conclude", self._recommend)

    def _model(self, *, everything: bool = False, **changes: Any) -> SuggestProblem:
        self._compromise.weigh(exploring=not everything)
        data = self._simulated(everything=everything)
        pending = self._trials.pending(everything=everything)
        return self._problem(data, everything=everything, pending=pending, **changes)

    def _recommend(self, suggestion: Suggestion) -> None:
        self._final = suggestion
        if suggestion.best_point is None or suggestion.best_mean is None or suggestion.best_deviation is None:
            self._finish()  # too few simulations succeeded; the result says how many were lost
        elif self._plan.pours < 1:
            self._finish()
        else:
            scatter = self._scatter(suggestion, suggestion.best_noise)
            prediction = Prediction(suggestion.best_mean, suggestion.best_deviation, scatter)
            self._pour(suggestion, suggestion.best_point, prediction)

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Of a single seed: what is observed here are means of m1 of them."""
        of_means = super()._scatter(suggestion, noise)
        return None if of_means is None else of_means * math.sqrt(max(self._plan.simulations_per_iteration, 1))

    def progress(self) -> tuple[int, int]:
        """Simulations and pours done, and in all."""
        repeats = max(self._plan.simulations_per_iteration, 1)
        pours = 1 if self._plan.pours else 0
        answered = self._trials.answered - repeats * self._unspent
        return answered + self._counted, max(self._plan.iterations, 1) * repeats + pours

    def result(self) -> dict[str, object]:
        """As every deployment; with r = spilled / poured over the simulations of the recommended action.

        These seeds took part in choosing the action; `orchestrator.strategies.repeats` has fresh ones.
        """
        result = super().result()
        if self._final is not None and self._final.best_point is not None:
            tried = [trial for trial in self._trials.all if trial.point == self._final.best_point]
            known = [r for trial in tried for q in trial.requests if (r := self._spillages.get(q)) is not None]
            spillage = Spread.of(known)
            result["predicted_spillage"] = None if spillage is None else spillage.mean
            result["predicted_spillage_deviation"] = None if spillage is None else spillage.deviation
        return result
