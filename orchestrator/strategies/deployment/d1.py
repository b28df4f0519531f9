"""D1: plan in simulation only.

D1 where the robot misses, and θ is not known exactly: expected loss or CVaR in place of the loss of one pour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Any, ClassVar, Literal

from actors.optimizer.questions import Data, Point, Risk, Suggestion, SuggestProblem
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
"""Simulations of an action that is to lie inside the safe window; `simulations_per_iteration` where that is more."""


class D1Settings(SearchSettings):
    """D1: plan in simulation, then pour once."""

    required: ClassVar[dict[str, str]] = {"strategy": "D1"}
    learns_on_pours: ClassVar[bool] = False

    strategy: Literal["D1"] = "D1"
    """Plan in simulation, then pour once."""

    pours: PourCount = 1
    """Whether it pours what it has planned; 0 only plans."""

    iterations: PositiveSimulationCount | None = None
    """Iterations of the optimiser; 15 unless given, 30 with 'risk'."""

    simulations_per_iteration: PositiveSimulationCount = 2
    """Simulations averaged in each, under 'risk' one as planned and the others under errors."""

    risk: RiskSettings | None = None
    """Errors of execution, and of θ, that the action has to bear."""

    window: WindowSettings | None = None
    """Look for the safe window around the action, and check it by simulations."""

    @property
    def rounds(self) -> int:
        """Iterations of the optimiser."""
        return self.iterations or (15 if self.risk is None else 30)

    @property
    def needs_posterior(self) -> bool:
        """If the action has to bear not knowing θ."""
        return self.risk is not None and self.risk.theta == "posterior"

    @property
    def simulations(self) -> int:
        """Those of all iterations."""
        return self.rounds * self.simulations_per_iteration

    @property
    def spending(self) -> str:
        """What it spends into one receiver, in words."""
        return f"{self.rounds} iterations of {self.simulations_per_iteration} simulations, one pour"

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Risk and window are about a loss, and risk names something that could go wrong."""
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
        """Errors and θ that the action had to bear."""
        if self.risk is None:
            return ()
        return Disturbances(self.risk, plan.actions, parameters, seed, plan.thetas).draws(count)

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""

        return (OneShotPlanning if self.risk is None else RobustPlanning)(plan, scene, parameters, seed)


class OneShotPlanning(Deployment[D1Settings]):
    """D1: minimise the simulated loss, then pour once. Needs no sensor.

    Bayesian optimisation of f̄_s(a) = 1/m1 Σ_j f_s(a, seed_j), with m1 simulations an iteration, started at Sobol points
    in place of random ones. The last iteration simulates the minimiser of the posterior mean over the whole box;
    what is recommended, and poured if there is a budget for it, is the best simulated action by posterior mean: an
    action that was at least tried in simulation, and not merely the luckiest.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D1); that m1 simulations are averaged is our reading.
    Limitations: an error of the simulator is an error of the plan.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._spillages: dict[Simulate, float | None] = {}
        self._window: SafeWindow | None = None
        self._searched: list[Trial] = []

    def ask(self, slots: Slots) -> list[Request]:
        """As every deployment; checks of the window, and the pour after them, follow from no answer of the optimiser:
        they are asked for at once."""
        requests = super().ask(slots)
        return requests if requests or self._window is None else super().ask(slots)

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
        done, wanted = self._spent, self._settings.rounds
        repeats = self._settings.simulations_per_iteration
        if self._width_known and self._trials.all == []:
            # slots count simulations, a trial takes `repeats` of them
            self._trials.width = math.ceil(self._trials.width / repeats)

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "plan", repeats=repeats)

        if self._window is not None and not self._window.closed:
            if self._trials.idle:
                self._check_window(self._window)
        elif self._final is not None:
            if self._pouring is not None:
                return
            if self._counted == 0 and self._pours_left:  # it was refused
                self._recommend_again()
            else:  # the one pour has been weighed
                self._finish()
        elif len(self._trials) == 0:
            count = min(max(self._settings.initial, 1), max(wanted - 1, 1))
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
        self._final, self._searched = suggestion, list(self._trials.all)
        if suggestion.best_point is None:
            self._finish()  # too few simulations succeeded; the result says how many were lost
        elif self._settings.window is None:
            self._use(suggestion)
        else:
            tolerated = self._tolerated(self._settings.window.tolerated)
            window = SafeWindow(self._plan.actions, suggestion.best_point, tolerated)
            problem = replace(self._model(everything=True, count=0), predict_at=window.places)

            self._questions.put(problem, "window", lambda outline: self._outlined(window, problem, outline))

    def _use(self, suggestion: Suggestion) -> None:
        """Pour what is recommended, or leave it at that."""
        if self._plan.pours < 1 or suggestion.best_point is None:
            self._finish()
        else:
            self._pour(suggestion.best_point, self._prediction(suggestion))

    def _prediction(self, suggestion: Suggestion) -> Prediction | None:
        """Prediction for the pour of what is recommended."""
        if suggestion.best_mean is None or suggestion.best_deviation is None:
            return None
        return Prediction(
            suggestion.best_mean, suggestion.best_deviation, self._scatter(suggestion, suggestion.best_noise)
        )

    # -- the safe window -------------------------------------------------------------------------------------------

    def _tolerated(self, share: float) -> float:
        """A share of what spilling everything would cost, in the loss' own unit."""
        all_spilled = self._plan.loss(
            Fractions(1.0, 1.0, 0.0),
            loaded_mass=self._scene.liquid.mass,
            particles=self._parameters.particles,
        )
        assert all_spilled is not None
        return share * all_spilled

    def _outlined(self, window: SafeWindow, problem: SuggestProblem, outline: Suggestion) -> None:
        """The surrogate's answer for the window's places is there: go on with checks."""
        window.outline(outline.predictions, () if outline.risk is None else outline.risk.worst)
        self._window = window
        self._check_window(window)

    def _check_window(self, window: SafeWindow) -> None:
        """Judge what was simulated of the window; simulate what is left to check, or conclude."""
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
        """Simulations of one place."""
        return max(self._settings.simulations_per_iteration, FEWEST_CHECKS)

    def _checking(self, action: Action, worst: Sequence[int], repeats: int) -> tuple[Simulate, ...]:
        """Simulations that tell whether an action is inside the window; `worst`: see `RiskAnswer`."""
        return self._repeated(action, "window", repeats)

    def _scatter(self, suggestion: Suggestion, noise: float | None) -> float | None:
        """Scatter of a single pour: from seed to seed, for what is observed here are means of m1 of them, and by what
        the simulator lacks."""
        of_means = super()._scatter(suggestion, noise)
        if of_means is None or suggestion.best_mean is None:
            return None
        of_seeds = of_means * math.sqrt(self._settings.simulations_per_iteration)
        return math.hypot(of_seeds, self._lacking(suggestion.best_mean))

    def _lacking(self, loss: float) -> float:
        """How far a pour may be from its simulations by what the simulator lacks [the loss' unit]: a loss is taken for
        spilled liquid, whose stream is shifted (`sim_engine.prediction_band`)."""
        if self._plan.objectives is not None:
            return 0.0  # not a loss
        worst, particles = self._tolerated(1.0), self._parameters.particles
        shift = lacking_shift(particles, self._plan.left_over)
        return worst * NormalDist().pdf(shift_of(loss / worst, particles)) * shift

    def progress(self) -> Progress:
        """Simulations and pours done, and in all."""
        repeats = self._settings.simulations_per_iteration
        pours = 1 if self._plan.pours else 0
        answered = self._trials.answered - repeats * self._unspent
        checks = 0 if self._window is None else sum(len(t.requests) for t in self._trials.all[len(self._searched) :])
        return Progress(answered, self._settings.rounds * repeats + checks, self._counted, pours)

    def _spillage(self, point: Point) -> SampleStatistics | None:
        """These seeds took part in choosing the action; `orchestrator.strategies.repeated_simulation` has fresh
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
"""Stream of draws for checks of the window; the surrogate's own, and those that are simulated, are others."""

FEWEST_DRAWS = 4
"""With which an action that is to lie inside the safe window is simulated, unless m1 is more."""


class RobustPlanning(OneShotPlanning):
    """D1 under disturbances: minimise the mean or the CVaR of the loss over errors of execution and θ.

    Every iteration simulates one action m1 times: first as planned with θ*, then under the next draws of a quasi-random
    sequence. A GP of the single losses, over what was executed, pools them over all actions; what it minimises is the
    measure of its mean over the same J draws for every action (`actors.optimizer.risk_measures`). The raw CVaR of m1
    losses
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
