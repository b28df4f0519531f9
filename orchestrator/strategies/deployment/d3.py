"""D3: real pours around what simulation expects, while simulation goes on.

The settings of D3.

D3 with a pool that never waits for the arm, nor the arm for the optimiser: simulations where they pay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from actors.optimizer.questions import (
    AcquisitionName,
    Data,
    Limit,
    ModelDiscrepancy,
    Point,
    SearchEffort,
    Suggestion,
    SuggestProblem,
)
from orchestrator.requests import Answered, Ask, Decision, Outcome, Pour, Request, Simulate, Simulated, Slots
from orchestrator.strategies.campaign_plan import DeploymentPlan, Premises
from orchestrator.strategies.deployment.bench_offset import play_of, thinned
from orchestrator.strategies.deployment.costing import Prices, PricesSettings
from orchestrator.strategies.deployment.deployment_base import MAP_RESOLUTION, Deployment, SearchSettings
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.strategies.deployment.model_monitoring import (
    Believed,
    DiscrepancyPolicySettings,
    RiskLimitSettings,
    Rules,
    StopSettings,
    Trust,
)
from orchestrator.strategies.deployment.real_pours import Foretold, PourTrial
from orchestrator.strategies.strategy import Progress, Strategy
from sim_engine.action import described
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import CountOrFree, Problems, SimulationCount
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from orchestrator.requests import Order


class D3Settings(SearchSettings):
    """D3: real pours with a simulated prior."""

    removed: ClassVar[dict[str, str]] = {
        "trust": (
            "was retired; remove it: 'model: adaptive' weighs the simulator by every pour ('ignorance' says what "
            "follows), 'model: residual' always believes it"
        ),
        "model: pooled": "was retired; write 'adaptive', or 'residual' for the paper's",
        "model: scaled": "was retired; write 'adaptive', or 'residual' for the paper's",
    }

    strategy: Literal["D3"] = "D3"
    """Real pours with a simulated prior."""

    prior_simulations: SimulationCount = 37
    """Simulations before the first pour; with 'per_pour: free' at most so many."""

    per_pour: CountOrFree = 2
    """Simulations told between two pours; 'free': for as long as they are worth it."""

    prices: PricesSettings | None = None
    """With 'per_pour: free': what a pour and a simulation cost."""

    model: Literal["adaptive", "residual"] = "adaptive"
    """How simulations enter the surrogate of pours; 'adaptive' averages over ways in which the simulator may be wrong,
    'residual' is the paper's, which always believes it."""

    ignorance: DiscrepancyPolicySettings | None = None
    """With 'model: adaptive': what follows when the simulator seems to say nothing of this bench."""

    risk_limit: RiskLimitSettings | None = None
    """With 'model: adaptive': what no pour may lose, once one has kept it."""

    stop: StopSettings | None = None
    """With 'model: adaptive': ends before all pours are made when no further one is worth it."""

    good_enough: Annotated[float, Quantity("1", "1 %", 1e-4, 1.0)] | None = None
    """With 'model: adaptive': ends as soon as the best action is expected to lose no more than this share of a load."""

    @property
    def beside(self) -> int | None:
        """Simulations told between two pours; None: for as long as a pour takes."""
        return None if self.per_pour == "free" else int(self.per_pour)

    @property
    def adaptive(self) -> bool:
        """Whether it averages over the ways in which the simulator may be wrong."""
        return self.model == "adaptive"

    @property
    def order(self) -> Order:
        """Only where simulations go on for as long as a pour takes does the clock decide what is asked for."""
        return "completion" if self.beside is None else "logical"

    @property
    def simulations(self) -> int:
        """Those before the first pour and beside all."""
        return self.prior_simulations + (self.pours or 0) * self.simulations_beside

    @property
    def simulations_before(self) -> int:
        """Those of the prior."""
        return self.prior_simulations

    @property
    def simulations_beside(self) -> int:
        """Those told between two pours."""
        return self.beside or 0

    @property
    def spending(self) -> str:
        """What it spends into one receiver, in words."""
        return f"{self.prior_simulations} simulations, then {self.pours} pours with {self.per_pour} beside each"

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Prices decide only where simulations go on for as long as they are worth it."""
        super().check(premises, complaints)
        if self.prices is not None and self.beside is not None:
            text = f"decides nothing with 'per_pour: {self.per_pour}'; write 'per_pour: free', or remove it"
            complaints.add(text, "prices", key=True)
        for key in () if self.adaptive else ("ignorance", "risk_limit", "stop", "good_enough"):
            if getattr(self, key) is not None:
                complaints.add(f"needs 'model: adaptive', not '{self.model}'", key, key=True)

    @property
    def learns_of_benches(self) -> bool:
        """What is known of the bench beforehand enters its hypotheses."""
        return self.adaptive

    def rules(self, worst: float) -> Rules:
        """What follows on what the pours say of the simulator, in units of a loss whose largest value is given."""
        limit = None if self.risk_limit is None else Limit(worst * self.risk_limit.loss, self.risk_limit.probability)
        return Rules(
            ignorance=self.ignorance or DiscrepancyPolicySettings(),
            limit=limit,
            otherwise="go on" if self.risk_limit is None else self.risk_limit.otherwise,
            gain_below=None if self.stop is None else worst * self.stop.gain_below,
            good_enough=None if self.good_enough is None else worst * self.good_enough,
        )

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""

        return (FreeHybrid if self.beside is None else Hybrid)(plan, scene, parameters, seed)


class Hybrid(Deployment[D3Settings]):
    """D3: as D2, but the surrogate's prior mean is learnt from m2 simulations, and goes on learning between pours.

    First, Bayesian optimisation in simulation chooses m2 actions. Their surrogate becomes the prior of the real
    cost, f_r(a) = f_s(a) + δ(a): its posterior mean is the prior mean, its posterior covariance adds to δ's. The first
    pour is the minimiser of the prior mean; every further one minimises m(a) − κ s(a) given the weighed pours.

    With `per_pour = k`, one question answers with the next pour and k places where a simulation would matter
    most, which are simulated beside the pour and enter the prior: learning from real trials interleaved with planning
    in a model (Dyna). With `per_pour = 'free'`, simulations go on for as long as the pour takes.

    `model` says how simulations enter the surrogate. The above is 'residual', the paper's, which always believes the
    simulator; 'adaptive' averages over the ways in which it may be wrong, and weighs them by every pour.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3; m2 = 37, 15 pours).
    Limitations: with 'residual' a prior from an untrustworthy simulator is worse than none.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        self._rules = self._settings.rules(self._costing.worst)
        self._trust = Trust(self._rules, plan.actions, self._costing.worst) if self._settings.adaptive else None
        self._then: Callable[[str], None] | None = None
        self._ended: str | None = None
        self._unasked: Ask | None = None
        self._asked: Ask | None = None

    # -- asking and listening --------------------------------------------------------------------------------------

    def ask(self, slots: Slots) -> list[Request]:
        """As every deployment; nothing new while a person has to decide."""
        if self._unasked is not None:
            self._asked, self._unasked = self._unasked, None
            return [self._asked]
        return [] if self._asked is not None else super().ask(slots)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As every deployment, or how to go on with a simulator that is wrong."""
        if not isinstance(request, Ask):
            super().tell(request, outcome)
            return
        if request != self._asked or not isinstance(outcome, Answered):
            raise ValueError(f"this was not asked, or not answered: {request.question}")
        self._asked, then = None, self._then
        assert then is not None
        then(outcome.answer)

    def _next(self, free_simulations: int) -> None:
        if self._spent < self._settings.prior_simulations and not self._pours:
            self._next_prior()
        elif self._pouring is not None or not self._trials.idle:
            return
        elif self._pours_left:
            self._next_pour()
        else:
            self._questions.put(self._hybrid(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._concluded)

    def _next_prior(self) -> None:
        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "prior")

        if len(self._trials) == 0:
            count = min(max(self._settings.initial, 1), self._settings.prior_simulations)
            self._questions.put(self._problem(Data(), acquisition="sobol", count=count), "start", simulate)
        elif self._trials.ready:
            self._compromise.weigh(exploring=True)
            # in the paper κ is constant, and no simulation only fills space
            known, pending, plain = self._simulated(), self._trials.pending(), not self._settings.adaptive
            problem = self._problem(known, everything=False, pending=pending, plain=plain)
            self._questions.put(problem, "prior", simulate)

    def _next_pour(self) -> None:
        """The next pour, and with it the simulations that run beside it."""
        problem = self._hybrid(
            count=1 + self._settings.simulations_beside,
            acquisition=self._acquisition,
            map_resolution=MAP_RESOLUTION,
        )

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._simulate(suggestion, "refine", first=1)

        self._questions.put(problem, "pour", lambda suggestion: self._judged(suggestion, pour))

    def _judged(self, suggestion: Suggestion, pour: Callable[[Suggestion], None]) -> None:
        """Say what the latest pour has told of the simulator; then the next one is made, or it is not."""
        if self._trust is None or suggestion.mismatch is None:
            pour(suggestion)
            return
        self._trust.hear(suggestion.mismatch, self._pours)
        verdict = self._trust.judge(suggestion, self._pours, self._plan.pours - self._counted)
        self._said()
        if verdict.ask is not None:

            def answered(answer: str) -> None:
                assert self._trust is not None
                end = self._trust.answer(answer, limit=verdict.limit)
                self._said()
                if end:
                    self._end(end)
                else:
                    self._judged(suggestion, pour)

            self._unasked, self._then = verdict.ask, answered
        elif verdict.end:
            self._end(verdict.end)
        else:
            pour(suggestion)

    def _said(self) -> None:
        assert self._trust is not None
        self.decisions += self._trust.decisions
        self._trust.decisions.clear()

    def _end(self, why: str) -> None:
        """No further pour: conclude with what is known."""
        self._ended = why

    def _concluded(self, suggestion: Suggestion) -> None:
        if self._trust is not None and suggestion.mismatch is not None:
            self._trust.hear(suggestion.mismatch, self._pours)
            self._said()
        self._conclude(suggestion)

    @property
    def _pours_left(self) -> bool:
        return super()._pours_left and self._ended is None

    @property
    def _acquisition(self) -> AcquisitionName:
        """What chooses the next pour."""
        if self._settings.adaptive and not self._compromise.exploring:
            return "least_loss"
        return "lcb" if self._pours or self._former else "posterior_minimum"

    def _hybrid(self, **changes: Any) -> SuggestProblem:
        self._compromise.weigh(exploring=changes.get("count") != 0)
        return self._informed(self._real(), self._simulated(everything=True), **changes)

    def _informed(self, poured: Data, simulated: Data, **changes: Any) -> SuggestProblem:
        """A question about the real cost, with what the simulations say of it."""
        if not self._settings.adaptive:
            changes["mean"] = "simulated"
        elif changes.get("acquisition") == "knowledge":  # what one more simulation is worth beside a pour
            changes["mean"] = "scaled"
        else:
            changes |= {"mean": "adaptive", "mismatch": self._mismatch}
        return self._problem(poured, simulated=simulated, **changes)

    @property
    def _mismatch(self) -> ModelDiscrepancy:
        """How the simulator may be wrong."""
        left = max(self._plan.pours - self._counted - 1, 0)
        limit = self._rules.limit
        if limit is not None and not any(p.cost is not None and p.cost <= limit.loss for p in self._pours):
            limit = None  # nothing good is in hand that could be poured again
        return ModelDiscrepancy(
            play_of(self._plan.actions),
            self._plan.bench,
            worst=self._costing.worst,
            left=left,
            limit=limit,
            # a first pour for what it tells may end in a corner, and a limit keeps those that follow there
            looks_ahead=self._rules.limit is None or limit is not None,
        )

    def _front_problem(self, simulated: Data, poured: Data) -> SuggestProblem:
        return self._informed(poured, simulated)

    @property
    def _warned(self) -> bool:
        return self._settings.adaptive

    # -- results ---------------------------------------------------------------------------------------------------

    def _trusted(self, weighed: Sequence[PourTrial]) -> Foretold | Believed:
        return super()._trusted(weighed) if self._trust is None else self._trust.result()

    def result(self) -> Deployed:
        """What was learnt so far, of the bench too."""
        bench = None if self._trust is None else self._trust.bench()
        return super().result().model_copy(update={"ended": self._ended, "bench": bench})

    def progress(self) -> Progress:
        """Simulations and pours done, and in all (those beside the pours count only where their number is fixed)."""
        simulations = self._settings.prior_simulations + self._plan.pours * self._settings.simulations_beside
        answered = self._trials.answered - self._unspent
        done = min(answered, simulations) if self._settings.beside is None else answered
        if self._ended is not None:  # those that will not be made any more
            simulations = done
        pours = self._counted if self._ended is not None else self._plan.pours
        return Progress(done, simulations, min(self._counted, pours), pours)


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
    data by a few steps. The picture of the surrogate is asked for beside a pour.

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

    # -- listening -------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As D3, and learn what a simulation costs."""
        super().tell(request, outcome)
        if isinstance(request, Simulate) and isinstance(outcome, Simulated):
            self._prices.learn(outcome.outcome.cpu_s)
        if isinstance(request, Pour):
            self._rested_at = None

    # -- what to ask next ------------------------------------------------------------------------------------------

    @property
    def _may_think(self) -> bool:
        return True  # several questions may be out; each kind is asked once

    def _next(self, free_simulations: int) -> None:
        if self._pouring is None:
            if not self._pours_left:
                self._wind_up()
                return
            if self._may_pour and "pour" not in self._out:
                self._next_pour()
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
        if self._out & {"start", "prior", "refine"}:
            return
        if self._awaited is None and not self._pours:
            self._next_prior()
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
            else:
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
        self._ask_quickly("pour", lambda answer: self._judged(answer, pour), count=1, acquisition=acquisition)

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
        effort = SearchEffort()
        if len(problem.data) + len(problem.simulated) > FRESH_FITS and not self._compromise.wanted:
            # noise that varies with the cost is fitted afresh: what it depends on is found in two steps
            effort = SearchEffort(self._fitted.get(key, ()) if problem.noise == "constant" else (), STEPS)

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
