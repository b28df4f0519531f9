"""D3 with a pool that never waits for the arm, nor the arm for the optimiser: simulations where they pay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from actors.optimizer.core.problem import Data, Effort, Point, Suggestion, SuggestProblem
from orchestrator.plan import DeploymentPlan
from orchestrator.requests import Decision, Outcome, Pour, Request, Simulate, Simulated
from orchestrator.strategies.deployment.base import MAP_RESOLUTION
from orchestrator.strategies.deployment.d3 import Hybrid
from orchestrator.strategies.deployment.prices import Prices, PricesSettings
from orchestrator.strategies.deployment.thinning import thinned
from orchestrator.strategies.progress import Progress
from sim_engine.action import described
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene

MOST_SIMULATIONS = 200
"""Simulations that one question carries: more would keep the arm waiting."""

FRESH_FITS = 40
"""Observations up to which hyperparameters are looked for afresh: it is quick, and the last ones may be a bad start."""

STEPS = 4
"""Steps by which they follow the data in every question above that."""

LOST_IN_A_ROW = 20
"""Simulations that may come to nothing one after the other before no more are tried beside a pour."""


class FreeHybrid(Hybrid):
    """D3 whose simulations are chosen, and ended, by what they are worth: Dyna with prices.

    Every simulation is made where one more of them would lower the least expected real cost most (the acquisition
    'knowledge'). Before the first pour that is set against the value of a pour, each by the seconds it costs; the pour
    comes as soon as it is worth more per second, after `prior_simulations` at the latest. Beside a pour, simulations
    cost the arm no time: they go on until as many as fit beside it are worth next to nothing, that is when only pours
    can tell what is still in doubt. Then the pool rests until something new is known.

    Nobody waits. The next simulations are chosen ahead, so that a slot that falls free has one at once. Questions
    carry the hyperparameters of the last answer and a limited number of simulations; with each, the fit follows the
    data by a few steps. The picture of the surrogate, and what simulations alone say of the pour that is under way,
    are asked for beside it.

    Limitations: in completion order the clock decides what is asked for; only the journal repeats a run. A front is
    looked for without prices, with fits afresh.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._prices = Prices(self._settings.prices or PricesSettings(), self._costing.worst)
        self._out: set[str] = set()
        self._awaited: int | None = None
        self._rested_at: int | None = None
        self._told_of_rest = -1
        self._map_due = False
        self._fitted: dict[tuple[str, bool], tuple[tuple[float, ...], ...]] = {}
        self._around: Point | None = None
        self._foreseen: tuple[tuple[Point, ...], Suggestion | None] = ((), None)

    # -- listening -------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As D3, and learn what a simulation costs."""
        super().tell(request, outcome)
        if isinstance(request, Simulate) and isinstance(outcome, Simulated):
            self._prices.learn(outcome.outcome.cpu_s)
        if isinstance(request, Pour):
            self._rested_at = None
            self._judge()

    def _judge(self) -> None:
        """Compare the pours with the simulations, if what those say of them is known already."""
        if self._check is None or self._pouring is not None:
            return
        places, said = self._foreseen
        pours = self._check.due(self._pours)
        if pours and said is not None and places == tuple(pour.point for pour in pours):
            self._check.compare(pours, said)
            self._unasked = self._check.question
            self._heard(self._check)
            if self._followed == "D2":
                self._trials.withdraw()
                self._rest("its simulations are forgotten", 0.0, 0.0)

    # -- what to ask next ------------------------------------------------------------------------------------------

    @property
    def _may_think(self) -> bool:
        return True  # several questions may be out; each kind is asked once

    def _next(self, free_simulations: int) -> None:
        if self._pouring is None:
            if self._check is not None and self._check.due(self._pours):
                self._foresee()
                return
            if not self._pours_left:
                self._wind_up()
                return
            if self._may_pour and "pour" not in self._out:
                self._next_pour()
        if self._followed != "D2":
            self._look_ahead()

    @property
    def _may_pour(self) -> bool:
        """It was decided to pour, and what was simulated for it has been answered."""
        if self._pours:
            return True
        return self._awaited is not None and all(trial.closed for trial in self._trials.all[: self._awaited])

    def _wind_up(self) -> None:
        self._trials.withdraw()
        if self._trials.idle and not self._out:
            self._put(self._hybrid(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._concluded)

    def _look_ahead(self) -> None:
        """Choose simulations before there is a slot for them."""
        if self._out & {"start", "prior", "refine", "trust"}:
            return
        if self._awaited is None and not self._pours:
            self._next_prior()
        elif self._pouring is not None and self._foresee():
            pass
        elif self._trials.waiting < self._trials.width and self._rested_at != self._trials.answered:
            self._refine(self._trials.width)

    def _next_prior(self) -> None:
        settings, trials = self._settings, self._trials
        if len(trials) == 0 and settings.prior_simulations > 0:
            count = min(max(settings.initial, trials.width), settings.prior_simulations)
            question = self._problem(Data(), acquisition="sobol", count=count)
            self._put(question, "start", lambda suggestion: self._simulate(suggestion, "prior"))
        elif len(trials) >= settings.prior_simulations:
            self._decide_to_pour("all prior simulations are asked for")
        elif trials.answered >= min(2, len(trials)) and trials.waiting < trials.width:

            def weighed(suggestion: Suggestion) -> None:
                if suggestion.values and suggestion.pour_value is not None and not self._compromise.exploring:
                    one, pour = suggestion.values[0], suggestion.pour_value
                    if self._prices.prefers_pour(one, pour, trials.width):
                        self._decide_to_pour(self._comparison(one, pour), one, pour)
                        return
                self._simulate(suggestion, "prior")

            self._ask_knowledge(min(trials.width, settings.prior_simulations - len(trials)), "prior", weighed)

    def _decide_to_pour(self, why: str, one: float = 0.0, pour: float = 0.0) -> None:
        self._awaited = len(self._trials)
        text = f"pour now, after {self._awaited} simulations: {why}"
        self.decisions.append(Decision(text, {"simulation_value": one, "pour_value": pour}))

    def _refine(self, count: int) -> None:
        """More simulations beside the pour, as long as they promise anything."""

        def weighed(suggestion: Suggestion) -> None:
            if not self._pours_left and self._pouring is None:
                return  # the last pour has come in meanwhile
            if suggestion.surrogate is not None:
                self._latest_map = suggestion
            one, pour = (suggestion.values or (0.0,))[0], suggestion.pour_value or 0.0
            exhausted = bool(suggestion.values) and self._prices.is_idle(one, self._trials.width)
            if exhausted and not self._compromise.exploring:
                self._rest(f"what is left to learn, only pours tell: {self._comparison(one, pour)}", one, pour)
            elif self._trials.lost_in_a_row >= LOST_IN_A_ROW:
                self._rest(f"the last {LOST_IN_A_ROW} simulations came to nothing", one, pour)
            elif self._followed != "D2":
                self._simulate(suggestion, "refine")

        mapped, self._map_due = self._map_due, False
        self._ask_knowledge(count, "refine", weighed, map_resolution=MAP_RESOLUTION if mapped else 0)

    def _rest(self, why: str, one: float, pour: float) -> None:
        self._rested_at = self._trials.answered
        asked = len(self._trials) - self._trials.waiting
        if asked != self._told_of_rest:  # once, unless something was simulated since
            values = {"pool_rests": 1.0, "simulation_value": one, "pour_value": pour}
            self.decisions.append(Decision(f"the pool rests: {why}", values))
        self._told_of_rest = asked

    def _next_pour(self) -> None:
        """The next pour alone: what runs beside it is asked for once the arm is under way."""

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._rested_at, self._map_due = None, True

        acquisition = self._acquisition
        if self._followed == "D2":
            self._put(self._hybrid(count=1, acquisition=acquisition, map_resolution=MAP_RESOLUTION), "pour", pour)
        else:
            self._ask_quickly("pour", lambda answer: self._judged(answer, pour), count=1, acquisition=acquisition)

    def _foresee(self) -> bool:
        """Ask what the simulations alone say of the pours to be compared next; whether that was necessary."""
        if self._check is None or "trust" in self._out:
            return False
        self._compromise.weigh(exploring=False)
        places = tuple(pour.point for pour in self._check.foreseen(self._pours))
        if not places or places == self._foreseen[0]:
            return False

        def answered(suggestion: Suggestion) -> None:
            self._foreseen = (places, suggestion)
            self._judge()

        self._foreseen = (places, None)
        self._put(self._problem(self._simulated(), count=0, predict_at=places), "trust", answered)
        return True

    # -- questions -------------------------------------------------------------------------------------------------

    def _ask_knowledge(self, count: int, purpose: str, then: Callable[[Suggestion], None], **changes: object) -> None:
        trials = self._trials
        pouring = tuple(pour.point for pour in self._pours[-1:] if pour.status == "pouring")
        changes |= {"count": count, "pending": trials.pending(everything=True), "pouring": pouring}
        self._ask_quickly(purpose, then, acquisition="knowledge", **changes)

    def _ask_quickly(self, purpose: str, then: Callable[[Suggestion], None], **changes: object) -> None:
        """Put a question that starts from the last fit."""
        problem = self._hybrid(**changes)
        key = (problem.mean, len(problem.simulated) >= 2)
        effort = Effort()
        if len(problem.data) + len(problem.simulated) > FRESH_FITS and not self._compromise.wanted:
            # noise that varies with the cost is fitted afresh: what it depends on is found in two steps
            effort = Effort(self._fitted.get(key, ()) if problem.noise == "constant" else (), STEPS)

        def answered(suggestion: Suggestion) -> None:
            if suggestion.fitted:
                self._fitted[key] = suggestion.fitted
            self._around = suggestion.best_point or self._around
            then(suggestion)

        self._put(replace(problem, effort=effort), purpose, answered)

    def _put(self, problem: SuggestProblem, purpose: str, then: Callable[[Suggestion], None]) -> None:
        def answered(suggestion: Suggestion) -> None:
            self._out.discard(purpose)
            then(suggestion)

        self._out.add(purpose)
        self._questions.put(problem, purpose, answered)

    def _simulated(self, *, everything: bool = False) -> Data:
        """All that are in: beside a pour there is no order to keep."""
        around = [pour.point for pour in self._pours[-2:]] + ([self._around] if self._around is not None else [])
        return thinned(super()._simulated(everything=True), around, MOST_SIMULATIONS)

    # -- results ---------------------------------------------------------------------------------------------------

    def _comparison(self, one: float, pour: float) -> str:
        seconds = self._prices.simulation(self._trials.width)
        return f"a simulation promises {one:.2g} for {seconds:.2g} s, a pour {pour:.2g} for {self._prices.pour:g} s"

    def _decide(self, what: str, values: dict[str, float], suggestion: Suggestion, index: int) -> None:
        if not suggestion.values or suggestion.pour_value is None:
            super()._decide(what, values, suggestion, index)
            return
        one, pour = suggestion.values[index], suggestion.pour_value
        text = f"{what}  {described(values)}  {self._comparison(one, pour)}"
        self.decisions.append(Decision(text, {"simulation_value": one, "pour_value": pour}))

    def progress(self) -> Progress:
        """As D3; simulations that were not worth their time count as made."""
        simulations = self._settings.prior_simulations
        begun = self._awaited is not None or bool(self._pours)
        done = simulations if begun else min(self._trials.answered, simulations)
        return Progress(done, simulations, min(self._counted, self._plan.pours), self._plan.pours)
