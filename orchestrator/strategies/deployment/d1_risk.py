"""D1 where the robot misses, and θ is not known exactly: expected loss or CVaR in place of the loss of one pour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from actors.optimizer.core.problem import Data, Point, Risk, Suggestion, SuggestProblem
from orchestrator.plan import DeploymentPlan, Draw
from orchestrator.requests import Failed, Outcome, Prediction, Request, Simulate
from orchestrator.strategies.deployment.base import MAX_REFUSED, Deployment
from orchestrator.strategies.deployment.d1 import OneShotPlanning
from orchestrator.strategies.deployment.learnt import RiskFound
from orchestrator.strategies.deployment.risk import Disturbances
from orchestrator.strategies.deployment.window import SafeWindow
from sim_engine.action import Action
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene

FRESH = 2
"""Stream of draws for checks of the window; the surrogate's own, and those that are simulated, are others."""

FEWEST_DRAWS = 4
"""With which an action that is to lie inside the safe window is simulated, unless m1 is more."""


class RobustPlanning(OneShotPlanning):
    """D1 under disturbances: minimise the mean or the CVaR of the loss over errors of execution and θ.

    Every iteration simulates one action m1 times: first as planned with θ*, then under the next draws of a quasi-random
    sequence. A GP of the single losses, over what was executed, pools them over all actions; what it minimises is the
    measure of its mean over the same J draws for every action (`actors.optimizer.core.risk`). The raw CVaR of m1 losses
    would be their worst one: biased, and mostly luck.

    Cups that touch under an error are the worst loss of that draw: that is the risk. Cups that touch as planned make
    the action one that is never recommended.

    Source: Cakmak et al., Bayesian optimization of risk measures, 2020; beside the raw measures of m1 draws in
        docs/how-it-works.md.
    Limitations: errors are normal and independent of each other, and drawn once for a whole pour; what the simulator
        lacks at any θ is not among them.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        assert self._settings.risk is not None
        self._risk = self._settings.risk
        self._disturbances = Disturbances(self._risk, plan.actions, parameters, self._seeds.next(), plan.thetas)
        trials = self._settings.rounds + MAX_REFUSED
        self._sequence = self._disturbances.draws(trials * self._settings.simulations_per_iteration)
        self._used = 0
        self._draws: dict[Simulate, Draw] = {}
        self._touching: set[Action] = set()
        self._nothing_allowed = False

    # -- asking ----------------------------------------------------------------------------------------------------

    def _repeated(self, action: Action, purpose: str, repeats: int) -> tuple[Simulate, ...]:
        """As planned, and under the sequence's next draws."""
        begin, self._used = self._used, self._used + repeats - 1
        return self._under(action, purpose, [self._disturbances.nominal, *self._sequence[begin : self._used]])

    def _outlined(self, window: SafeWindow, problem: SuggestProblem, outline: Suggestion) -> None:
        """For a mean, what the surrogate expects of just the draws that checks are made with has to be known, too."""
        if problem.risk is None or problem.risk.level > 0.0:
            super()._outlined(window, problem, outline)
            return
        few = tuple(self._disturbances.disturbance(draw) for draw in self._check_draws)

        def known(expected: Suggestion) -> None:
            window.allow_for(outline.predictions, expected.predictions)
            super(RobustPlanning, self)._outlined(window, problem, outline)

        self._questions.put(replace(problem, risk=Risk(few)), "window", known)

    @property
    def _checks(self) -> int:
        return max(self._settings.simulations_per_iteration, FEWEST_DRAWS)

    @property
    def _check_draws(self) -> list[Draw]:
        return self._disturbances.draws(self._checks, FRESH)

    def _checking(self, action: Action, worst: Sequence[int], repeats: int) -> tuple[Simulate, ...]:
        """For a mean, the same few draws at every place; for CVaR, some of those that the surrogate has for the worst:
        the mean over any choice of as large a share of all is no more than CVaR."""
        if not worst:
            return self._under(action, "window", self._check_draws)
        tried = self._disturbances.tried(max(worst) + 1)
        return self._under(action, "window", [tried[worst[i * len(worst) // repeats]] for i in range(repeats)])

    def _under(self, action: Action, purpose: str, draws: Sequence[Draw]) -> tuple[Simulate, ...]:
        name, requests = self._scene.name, []
        for draw in draws:
            seed = self._seeds.next()
            requests.append(Simulate(name, action, draw.parameters, seed, purpose, draw.error))
            self._draws[requests[-1]] = draw
        return tuple(requests)

    def _simulated(self, *, everything: bool = False) -> Data:
        """Single losses, where the surrogate sees them: at what was executed."""
        data = Data()
        for trial in self._trials.counting(everything=everything):
            for index, request in enumerate(trial.requests):
                if (cost := trial.costs[index]) is not None:
                    data = data.added(self._disturbances.executed(trial.point, self._draws[request]), cost)
        return data

    def _model(self, *, everything: bool = False, **changes: Any) -> SuggestProblem:
        problem = super()._model(everything=everything, **changes)
        if len(problem.data) == 0:
            return problem
        places = self._allowed(everything=everything) or (problem.data.points[0][: self._plan.actions.dimension],)
        return replace(problem, risk=self._disturbances.risk, predict_at=places)

    def _allowed(self, *, everything: bool) -> tuple[Point, ...]:
        """Tried actions that may be recommended: something came of them, and their cups don't touch as planned."""
        tried = [t for t in self._trials.counting(everything=everything) if t.cost is not None]
        return tuple(dict.fromkeys(t.point for t in tried if t.requests[0].action not in self._touching))

    def _recommend(self, suggestion: Suggestion) -> None:
        if not self._allowed(everything=True):
            self._nothing_allowed = True
            suggestion = replace(suggestion, best_point=None)
        super()._recommend(suggestion)

    # -- listening -------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As D1; cups that touch without an error rule the action out."""
        super().tell(request, outcome)
        match request, outcome:
            case Simulate(action=action, pose_error=None), Failed(kind="invalid_action"):
                self._touching.add(action)

    # -- results ---------------------------------------------------------------------------------------------------

    def _prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for one pour: the mean over the disturbances, whatever was minimised, and their spread."""
        known = self._answer(suggestion)
        if known is None or suggestion.best_deviation is None:
            return None
        return Prediction(known[0], suggestion.best_deviation, self._scatter(suggestion, suggestion.best_noise))

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: from seed to seed, from one error and θ to the next, by what simulations lack."""
        of_seeds, known = Deployment._scatter(self, suggestion, noise), self._answer(suggestion)
        if of_seeds is None or known is None:
            return None
        return math.hypot(of_seeds, known[1], self._lacking(known[0]))

    def _answer(self, suggestion: Suggestion) -> tuple[float, float] | None:
        """Mean and standard deviation over the disturbances, of what is recommended."""
        if suggestion.risk is None or suggestion.best_point is None:
            return None
        index = min(range(len(suggestion.predictions)), key=suggestion.predictions.__getitem__)
        return suggestion.risk.expected[index], suggestion.risk.spreads[index]

    @property
    def _gave_up(self) -> str | None:
        if self._nothing_allowed:
            return "at every action that was tried the cups touch as planned, or every simulation failed"
        return super()._gave_up

    def _risk_found(self, final: Suggestion) -> RiskFound | None:
        """The measure, and mean and spread over the disturbances."""
        known = self._answer(final)
        if known is None or final.best_mean is None:
            return None
        return RiskFound(
            measure=self._risk.measure,
            level=self._risk.tail,
            value=final.best_mean,
            expected=known[0],
            spread=known[1],
            thetas=len(self._plan.thetas) if self._risk.theta == "posterior" else 0,
        )
