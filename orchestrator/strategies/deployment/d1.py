"""D1: plan in simulation only, then pour once.

- `OneShotPlanning` minimises the simulated loss of one pour.
- `RobustPlanning` minimises the expected loss or the CVaR under errors of execution and uncertain θ.
- `D1Settings` holds the settings of both and selects one of them.

D1 does not learn from real pours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Any, ClassVar, Literal

from actors.optimizer.questions import (
    Data,
    MinimumQuery,
    Point,
    RegressionQuery,
    Risk,
    RiskQuery,
    Suggestion,
)
from orchestrator.requests import Decision, Failed, Outcome, Prediction, Request, Simulate, Simulated, Slots
from orchestrator.strategies.campaign_plan import DeploymentPlan, Draw, Premises
from orchestrator.strategies.deployment.deployment_base import MAP_RESOLUTION, MAX_REFUSED, Deployment, SearchSettings
from orchestrator.strategies.deployment.deployment_result import RiskFound
from orchestrator.strategies.deployment.disturbances import Disturbances, RiskSettings
from orchestrator.strategies.deployment.safe_window import SafeWindow, WindowFound, WindowSettings
from orchestrator.strategies.strategy import Progress, Strategy, is_sound
from orchestrator.strategies.trials import Trial
from sim_engine.action import Action, described
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Fractions, normalised_spillage
from sim_engine.prediction_band import SampleStatistics, lacking_shift, shift_of
from sim_engine.scene import Scene
from sim_engine.settings.model import PositiveSimulationCount, PourCount, Problems

FEWEST_CHECKS = 2
"""Minimum number of simulations of an action in the safe window; `simulations_per_iteration` is used if it is
larger."""


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

    window: WindowSettings | None = None
    """Search for the safe window around the action, and check it by simulations."""

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
        return f"{self.rounds} iterations of {self.simulations_per_iteration} simulations, one pour"

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Check that risk and window are combined with a loss, and that risk names at least one error."""
        for key, value in (("risk", self.risk), ("window", self.window)):
            if value is not None and premises.objectives:
                complaints.add("is about a loss; it can't be combined with 'objectives'", key, key=True)
        if self.risk is None:
            return
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

        return (OneShotPlanning if self.risk is None else RobustPlanning)(plan, scene, parameters, seed)


class OneShotPlanning(Deployment[D1Settings]):
    """D1: minimise the simulated loss, then pour once. No sensor is needed.

    Bayesian optimisation of f̄_s(a) = 1/m1 Σ_j f_s(a, seed_j) with m1 simulations per iteration, starting at Sobol
    points instead of random ones. The last iteration simulates the minimiser of the posterior mean over the whole box.
    The recommended action is the simulated action with the smallest posterior mean, and it is poured if the budget
    allows. It has thus been simulated, and is not selected by a single low observation.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D1); that m1 simulations are averaged is our interpretation.
    Limitations: an error of the simulator is an error of the plan.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._spillages: dict[Simulate, float | None] = {}
        self._window: SafeWindow | None = None
        self._searched: list[Trial] = []

    def ask(self, slots: Slots) -> list[Request]:
        """As in the base class, except that window checks and the following pour are requested at once: they do not
        depend on an answer of the optimiser."""
        requests = super().ask(slots)
        return requests if requests or self._window is None else super().ask(slots)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in the base class; the spillage of each simulation is recorded as well, whatever the loss is."""
        super().tell(request, outcome)
        if (
            isinstance(request, Simulate)
            and isinstance(outcome, Simulated)
            and outcome.outcome.invalid is None
            and is_sound(outcome.outcome.fractions)
        ):
            self._spillages[request] = normalised_spillage(outcome.outcome.fractions)

    def _next(self, free_simulations: int) -> None:
        done, wanted = self._spent, self._settings.rounds
        repeats = self._settings.simulations_per_iteration
        if self._width_known and self._trials.all == []:
            # slots count simulations; a trial takes `repeats` of them
            self._trials.width = math.ceil(self._trials.width / repeats)

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "plan", repeats=repeats)

        if self._window is not None and not self._window.closed:
            if self._trials.idle:
                self._check_window(self._window)
        elif self._final is not None:
            if self._pouring is not None:
                return
            if self._counted == 0 and self._pours_left:  # the pour was refused
                self._recommend_again()
            else:  # the only pour has been weighed
                self._finish()
        elif len(self._trials) == 0:
            count = min(max(self._settings.initial_samples, 1), max(wanted - 1, 1))
            self._questions.put(self._space_filling(count=count), "start", simulate)
        elif done < wanted - 1:
            if self._trials.ready:
                self._questions.put(self._search(), "plan", simulate)
        elif done < wanted:
            if self._trials.idle:
                self._questions.put(self._search(everything=True, acquisition="posterior_minimum"), "plan", simulate)
        elif self._trials.idle:
            self._recommend_again()

    def _recommend_again(self) -> None:
        self._questions.put(self._regression(map_resolution=MAP_RESOLUTION), "conclude", self._recommend)

    def _search(self, *, everything: bool = False, **parts: Any) -> MinimumQuery | RiskQuery:
        """A query for the next action to simulate."""
        self._scalarization.weigh(exploring=not everything)
        pending = self._trials.pending(everything=everything)
        data = self._simulated(everything=everything)
        return self._query(MinimumQuery, data, everything=everything, pending=pending, **parts)

    def _regression(self, **parts: Any) -> RegressionQuery | RiskQuery:
        """A query about all simulations, without a proposal."""
        self._scalarization.weigh(exploring=False)
        return self._query(RegressionQuery, self._simulated(everything=True), **parts)

    def _recommend(self, suggestion: Suggestion) -> None:
        self._final, self._searched = suggestion, list(self._trials.all)
        if suggestion.best_point is None:
            self._finish()  # too few simulations succeeded; the result reports how many were lost
        elif self._settings.window is None:
            self._use(suggestion)
        else:
            tolerated = self._tolerated(self._settings.window.tolerated)
            window = SafeWindow(self._plan.actions, suggestion.best_point, tolerated)
            query = replace(self._regression(), predict_at=window.places)
            self._questions.put(query, "window", lambda outline: self._outlined(window, query, outline))

    def _use(self, suggestion: Suggestion) -> None:
        """Pour the recommended action, or finish if no pour is planned."""
        if self._plan.pours < 1 or suggestion.best_point is None:
            self._finish()
        else:
            self._pour(suggestion.best_point, self._prediction(suggestion))

    def _prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for the pour of the recommended action."""
        if suggestion.best_mean is None or suggestion.best_deviation is None:
            return None
        return Prediction(
            suggestion.best_mean, suggestion.best_deviation, self._scatter(suggestion, suggestion.best_noise)
        )

    # -- the safe window -------------------------------------------------------------------------------------------

    def _tolerated(self, share: float) -> float:
        """Tolerated loss: a fraction of the loss of spilling everything, in the unit of the loss."""
        all_spilled = self._plan.loss(
            Fractions(1.0, 1.0, 0.0),
            loaded_mass=self._scene.liquid.mass,
            particles=self._parameters.particles,
        )
        assert all_spilled is not None
        return share * all_spilled

    def _outlined(self, window: SafeWindow, query: RegressionQuery | RiskQuery, outline: Suggestion) -> None:
        """Continue with checks when the surrogate's answer for the window's places has arrived."""
        window.outline(outline.predictions, () if outline.risk is None else outline.risk.worst)
        self._window = window
        self._check_window(window)

    def _check_window(self, window: SafeWindow) -> None:
        """Evaluate the simulated checks; queue the remaining ones, or conclude."""
        if window.waiting:
            tried = self._trials.all[-len(window.waiting) :]
            for check, trial in zip(tuple(window.waiting), tried, strict=True):
                window.judge(check, trial.cost)
        for check in window.next_checks():
            action = self._scene.action(self._plan.actions.decode(check.point))
            self._trials.add(Trial(check.point, self._checking(action, window.worst(check), self._checks)))
            self.decisions.append(Decision(f"check {check.what}  {described(self._plan.actions.decode(check.point))}"))
        if window.closed:
            assert self._final is not None
            self._use(self._final)

    @property
    def _checks(self) -> int:
        """Number of simulations per place."""
        return max(self._settings.simulations_per_iteration, FEWEST_CHECKS)

    def _checking(self, action: Action, worst: Sequence[int], repeats: int) -> tuple[Simulate, ...]:
        """Simulations that check whether an action is inside the window; `worst`: see `RiskAnswer`."""
        return self._repeated(action, "window", repeats)

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: between seeds, and by the simulator's inaccuracy. The observations are means over
        m1 seeds, so their scatter is scaled by √m1."""
        of_means = super()._scatter(suggestion, noise)
        if of_means is None or suggestion.best_mean is None:
            return None
        of_seeds = of_means * math.sqrt(self._settings.simulations_per_iteration)
        return math.hypot(of_seeds, self._inaccuracy(suggestion.best_mean))

    def _inaccuracy(self, loss: float) -> float:
        """Deviation of a pour from its simulations caused by the simulator's inaccuracy, in the unit of the loss. The
        loss is treated as spilled liquid whose stream is shifted (`sim_engine.prediction_band`)."""
        if self._plan.objectives is not None:
            return 0.0  # objectives are not a loss
        worst, particles = self._tolerated(1.0), self._parameters.particles
        shift = lacking_shift(particles, self._plan.left_over)
        return worst * NormalDist().pdf(shift_of(loss / worst, particles)) * shift

    def progress(self) -> Progress:
        """Simulations and pours done, and their total numbers."""
        repeats = self._settings.simulations_per_iteration
        pours = 1 if self._plan.pours else 0
        answered = self._trials.answered - repeats * self._unspent
        checks = 0 if self._window is None else sum(len(t.requests) for t in self._trials.all[len(self._searched) :])
        return Progress(answered, self._settings.rounds * repeats + checks, self._counted, pours)

    def _spillage(self, point: Point) -> SampleStatistics | None:
        """Statistics over seeds that took part in the selection; `orchestrator.strategies.single_action` uses new
        ones."""
        tried = [trial for trial in self._searched if trial.point == point]
        return SampleStatistics.of(
            [r for trial in tried for q in trial.requests if (r := self._spillages.get(q)) is not None]
        )

    def _window_found(self) -> WindowFound | None:
        if self._window is None or not self._window.closed:
            return None
        return self._window.result(sum(len(trial.requests) for trial in self._trials.all[len(self._searched) :]))


FRESH = 2
"""Stream of the draws for window checks, different from those of the surrogate and of the simulations."""

FEWEST_DRAWS = 4
"""Minimum number of draws per place in the safe window; m1 is used if it is larger."""


class RobustPlanning(OneShotPlanning):
    """D1 under disturbances: minimise the mean or the CVaR of the loss over errors of execution and θ.

    Every iteration simulates one action m1 times: first as planned with θ*, then under the next draws of a quasi-random
    sequence. A GP of the single losses over executed actions pools the data of all actions. The minimised quantity is
    the measure of its mean over the same J draws for every action (`actors.optimizer.risk_measures`). The raw CVaR of
    m1 losses would equal their maximum, which is biased and has a large variance.

    Cups that touch under an error give this draw the worst loss. An action with which the cups touch as planned is
    never recommended.

    Source: Cakmak et al., Bayesian optimization of risk measures, 2020.
    Limitations: errors are normal and independent, and drawn once for a whole pour. Inaccuracies that the simulator has
    for every θ are not included.
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
        """One simulation as planned, and the others under the sequence's next draws."""
        begin, self._used = self._used, self._used + repeats - 1
        return self._under(action, purpose, [self._disturbances.nominal, *self._sequence[begin : self._used]])

    def _outlined(self, window: SafeWindow, query: RegressionQuery | RiskQuery, outline: Suggestion) -> None:
        """For the mean, the surrogate's expectation over the draws of the checks is needed, too."""
        if not isinstance(query, RiskQuery) or query.risk.level > 0.0:
            super()._outlined(window, query, outline)
            return
        few = tuple(self._disturbances.disturbance(draw) for draw in self._check_draws)

        def known(expected: Suggestion) -> None:
            window.allow_for(outline.predictions, expected.predictions)
            super(RobustPlanning, self)._outlined(window, query, outline)

        self._questions.put(replace(query, risk=Risk(few)), "window", known)

    @property
    def _checks(self) -> int:
        return max(self._settings.simulations_per_iteration, FEWEST_DRAWS)

    @property
    def _check_draws(self) -> list[Draw]:
        return self._disturbances.draws(self._checks, FRESH)

    def _checking(self, action: Action, worst: Sequence[int], repeats: int) -> tuple[Simulate, ...]:
        """For the mean, the same few draws at every place. For CVaR, draws that are the worst according to the
        surrogate: the mean over any subset of this share of all draws is at most CVaR."""
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
        """Single losses at the executed actions, where the surrogate observes them."""
        data = Data()
        for trial in self._trials.counting(everything=everything):
            for index, request in enumerate(trial.requests):
                if (cost := trial.costs[index]) is not None:
                    data = data.added(self._disturbances.executed(trial.point, self._draws[request]), cost)
        return data

    def _search(self, *, everything: bool = False, **parts: Any) -> MinimumQuery | RiskQuery:
        pending = self._trials.pending(everything=everything)
        risk = self._risk_query(everything=everything, pending=pending, **parts)
        return risk or super()._search(everything=everything, **parts)

    def _regression(self, **parts: Any) -> RegressionQuery | RiskQuery:
        return self._risk_query(everything=True, count=0, **parts) or super()._regression(**parts)

    def _risk_query(self, *, everything: bool, **parts: Any) -> RiskQuery | None:
        """A query about the risk measure; None before any observation."""
        data = self._simulated(everything=everything)
        if len(data) == 0:
            return None
        parts["predict_at"] = self._allowed(everything=everything) or (data.points[0][: self._plan.actions.dimension],)
        return self._query(RiskQuery, data, everything=everything, risk=self._disturbances.risk, **parts)

    def _allowed(self, *, everything: bool) -> tuple[Point, ...]:
        """Tried actions that may be recommended: they have a cost, and the cups do not touch as planned."""
        tried = [t for t in self._trials.counting(everything=everything) if t.cost is not None]
        return tuple(dict.fromkeys(t.point for t in tried if t.requests[0].action not in self._touching))

    def _recommend(self, suggestion: Suggestion) -> None:
        if not self._allowed(everything=True):
            self._nothing_allowed = True
            suggestion = replace(suggestion, best_point=None)
        super()._recommend(suggestion)

    # -- outcomes --------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in D1; cups that touch without an error exclude the action."""
        super().tell(request, outcome)
        match request, outcome:
            case Simulate(action=action, pose_error=None), Failed(kind="invalid_action"):
                self._touching.add(action)

    # -- results ---------------------------------------------------------------------------------------------------

    def _prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for one pour: mean and scatter over the disturbances, whatever measure is minimised."""
        known = self._answer(suggestion)
        if known is None or suggestion.best_deviation is None:
            return None
        return Prediction(known[0], suggestion.best_deviation, self._scatter(suggestion, suggestion.best_noise))

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: between seeds, between errors and θ, and by the simulator's inaccuracy."""
        of_seeds, known = Deployment._scatter(self, suggestion, noise), self._answer(suggestion)
        if of_seeds is None or known is None:
            return None
        return math.hypot(of_seeds, known[1], self._inaccuracy(known[0]))

    def _answer(self, suggestion: Suggestion) -> tuple[float, float] | None:
        """Mean and standard deviation over the disturbances for the recommended action."""
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
        """The measure, and mean and scatter over the disturbances."""
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
