"""How D1 evaluates an action in simulation: by the mean over seeds, or by a risk measure over disturbances.

- `SeedMean` averages simulations of an action as planned.
- `RiskMeasure` simulates it under errors of execution and uncertain θ, and minimises the mean or the CVaR.

Both make the simulations of an action, the queries about them, and the prediction of its pour. `d1` decides when.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from statistics import NormalDist
from typing import Any

from actors.optimizer.questions import Data, MinimumQuery, Point, RegressionQuery, RiskQuery, Suggestion
from orchestrator.learning.campaign_plan import Draw
from orchestrator.learning.deployment.deployment_base import observed_scatter
from orchestrator.learning.deployment.deployment_ledger import MAX_REFUSED, DeploymentRequests
from orchestrator.learning.deployment.deployment_result import RiskFound
from orchestrator.learning.deployment.disturbances import Disturbances
from orchestrator.learning.requests import Failed, Outcome, Prediction, Simulate
from sim_engine.action import Action
from sim_engine.prediction_band import lacking_shift, shift_of


class SeedMean:
    """Evaluates an action by its mean loss over seeds.

    Args:
        repeats: simulations per action.

    Attributes:
        gave_up: reason why no action can be recommended; None if one can, or before the end.
    """

    def __init__(self, requests: DeploymentRequests, repeats: int) -> None:
        self._requests, self._ledger, self._plan = requests, requests.ledger, requests.ledger.plan
        self._repeats = repeats
        self.gave_up: str | None = None

    # -- simulations -----------------------------------------------------------------------------------------------

    def simulations(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        """Simulations of an action during the search."""
        return self._requests.simulations(action, purpose, self._repeats)

    def record(self, request: Simulate, outcome: Outcome) -> None:
        """Record the outcome of a simulation, in addition to its cost in the ledger."""

    # -- queries ---------------------------------------------------------------------------------------------------

    def search(self, *, everything: bool = False, **parts: Any) -> MinimumQuery | RiskQuery:
        """A query for the next action to simulate."""
        pending = self._ledger.trials.pending(everything=everything)
        data = self._data(everything=everything)
        return self._requests.query(MinimumQuery, data, everything=everything, pending=pending, **parts)

    def regression(self, **parts: Any) -> RegressionQuery | RiskQuery:
        """A query about all simulations, without a proposal."""
        parts["equality"] = self._requests.equality
        return self._requests.query(RegressionQuery, self._data(everything=True), **parts)

    def _data(self, *, everything: bool) -> Data:
        """Observations of the simulated cost."""
        return self._ledger.simulated(everything=everything)

    # -- recommendation --------------------------------------------------------------------------------------------

    def allowed(self, suggestion: Suggestion) -> Suggestion:
        """The answer without its best point, if this must not be recommended."""
        return suggestion

    def prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for the pour of the recommended action."""
        if suggestion.best_mean is None or suggestion.best_deviation is None:
            return None
        scatter = self.scatter(suggestion, suggestion.best_noise)
        return Prediction(suggestion.best_mean, suggestion.best_deviation, scatter)

    def scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: between seeds, and by the simulator's inaccuracy. The observations are means over
        m1 seeds, so their scatter is scaled by √m1."""
        of_means = observed_scatter(suggestion, noise)
        if of_means is None or suggestion.best_mean is None:
            return None
        return self._of_a_pour(suggestion.best_mean, of_means * math.sqrt(self._repeats))

    def _of_a_pour(self, loss: float, simulated: float) -> float:
        """Scatter of a pour, given that of its simulations, in the unit of the loss: with the simulator's inaccuracy.
        The loss is treated as spilled liquid whose stream is shifted (`sim_engine.prediction_band`)."""
        if self._plan.objectives is not None:
            return simulated  # objectives are not a loss
        costing = self._ledger.costing
        worst, particles = costing.everything_spilled, costing.parameters.particles
        steep = worst * NormalDist().pdf(shift_of(loss / worst, particles))
        lacking = lacking_shift(particles, self._plan.left_over, simulated / steep)
        return math.hypot(simulated, steep * lacking)

    def risk_found(self, final: Suggestion) -> RiskFound | None:
        """Effect of execution errors on the recommended action, if it was planned under them."""
        return None


class RiskMeasure(SeedMean):
    """Evaluates an action by the mean or the CVaR of the loss over errors of execution and θ.

    Every iteration simulates one action m1 times: first as planned with θ*, then under the next draws of a quasi-random
    sequence. A GP of the single losses over executed actions pools the data of all actions. The minimised quantity is
    the measure of its mean over the same J draws for every action (`actors.optimizer.risk_measures`). The raw CVaR of
    m1 losses would equal their maximum, which is biased and has a large variance.

    Cups that touch under an error give this draw the worst loss. An action with which the cups touch as planned is
    never recommended.

    Source: Cakmak et al., Bayesian optimization of risk measures, 2020.
    Limitations: errors are normal and independent, and drawn once for a whole pour. Inaccuracies that the simulator has
    for every θ are not included.

    Args:
        disturbances: errors, their draws, and the measure.
        iterations: number of actions that the search simulates.
    """

    def __init__(self, requests: DeploymentRequests, repeats: int, disturbances: Disturbances, iterations: int) -> None:
        super().__init__(requests, repeats)
        self._disturbances = disturbances
        self._sequence = iter(disturbances.draws((iterations + MAX_REFUSED) * repeats))
        self._draws: dict[Simulate, Draw] = {}
        self._touching: set[Action] = set()

    # -- simulations -----------------------------------------------------------------------------------------------

    def simulations(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        """One simulation as planned, and the others under the sequence's next draws."""
        return self._under(action, purpose, [self._disturbances.nominal, *islice(self._sequence, self._repeats - 1)])

    def _under(self, action: Action, purpose: str, draws: Sequence[Draw]) -> tuple[Simulate, ...]:
        requests = self._requests.simulations_under(action, purpose, draws)
        self._draws.update(zip(requests, draws, strict=True))
        return requests

    def record(self, request: Simulate, outcome: Outcome) -> None:
        """Exclude an action with which the cups touch as planned."""
        if request.pose_error is None and isinstance(outcome, Failed) and outcome.kind == "invalid_action":
            self._touching.add(request.action)

    # -- queries ---------------------------------------------------------------------------------------------------

    def search(self, *, everything: bool = False, **parts: Any) -> MinimumQuery | RiskQuery:
        """A query for the next action to simulate."""
        pending = self._ledger.trials.pending(everything=everything)
        risk = self._risk_query(everything=everything, pending=pending, **parts)
        return risk or super().search(everything=everything, **parts)

    def regression(self, **parts: Any) -> RegressionQuery | RiskQuery:
        """A query about all simulations, without a proposal."""
        return self._risk_query(everything=True, count=0, **parts) or super().regression(**parts)

    def _risk_query(self, *, everything: bool, **parts: Any) -> RiskQuery | None:
        """A query about the risk measure; None before any observation."""
        data = self._data(everything=everything)
        if len(data) == 0:
            return None
        parts["predict_at"] = self._allowed(everything=everything) or (data.points[0][: self._plan.actions.dimension],)
        risk = self._disturbances.risk
        return self._requests.query(RiskQuery, data, everything=everything, risk=risk, **parts)

    def _data(self, *, everything: bool) -> Data:
        """Single losses at the executed actions, where the surrogate observes them."""
        data = Data()
        for trial in self._ledger.trials.counting(everything=everything):
            for index, request in enumerate(trial.requests):
                if (cost := trial.costs[index]) is not None:
                    data = data.added(self._disturbances.executed(trial.point, self._draws[request]), cost)
        return data

    # -- recommendation --------------------------------------------------------------------------------------------

    def _allowed(self, *, everything: bool) -> tuple[Point, ...]:
        """Tried actions that may be recommended: they have a cost, and the cups do not touch as planned."""
        tried = [t for t in self._ledger.trials.counting(everything=everything) if t.cost is not None]
        return tuple(dict.fromkeys(t.point for t in tried if t.requests[0].action not in self._touching))

    def allowed(self, suggestion: Suggestion) -> Suggestion:
        """The answer without its best point, if no tried action may be recommended."""
        if self._allowed(everything=True):
            return suggestion
        self.gave_up = "at every action that was tried the cups touch as planned, or every simulation failed"
        return replace(suggestion, best_point=None)

    def prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for one pour: mean and scatter over the disturbances, whatever measure is minimised."""
        known = self._answer(suggestion)
        if known is None or suggestion.best_deviation is None:
            return None
        return Prediction(known[0], suggestion.best_deviation, self.scatter(suggestion, suggestion.best_noise))

    def scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: between seeds, between errors and θ, and by the simulator's inaccuracy."""
        of_seeds, known = observed_scatter(suggestion, noise), self._answer(suggestion)
        if of_seeds is None or known is None:
            return None
        return self._of_a_pour(known[0], math.hypot(of_seeds, known[1]))

    def _answer(self, suggestion: Suggestion) -> tuple[float, float] | None:
        """Mean and standard deviation over the disturbances for the recommended action."""
        if suggestion.risk is None or suggestion.best_point is None:
            return None
        index = min(range(len(suggestion.predictions)), key=suggestion.predictions.__getitem__)
        return suggestion.risk.expected[index], suggestion.risk.spreads[index]

    def risk_found(self, final: Suggestion) -> RiskFound | None:
        """The measure, and mean and scatter over the disturbances."""
        known = self._answer(final)
        if known is None or final.best_mean is None:
            return None
        return RiskFound(
            measure=self._disturbances.settings.measure,
            level=self._disturbances.settings.tail,
            value=final.best_mean,
            expected=known[0],
            spread=known[1],
            thetas=len(self._plan.thetas) if self._disturbances.settings.theta == "posterior" else 0,
        )
