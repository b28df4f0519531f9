"""D3: real pours with simulations as the prior, and further simulations while the arm pours.

- `D3Settings` holds the settings and selects the strategy.
- `Hybrid` runs a fixed number of simulations between two pours.
- `FreeHybrid` runs simulations as long as they are worth their time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from actors.optimizer.questions import (
    FOUND,
    Data,
    Limit,
    MinimumQuery,
    Point,
    PourQuery,
    SearchEffort,
    SimulationQuery,
    Suggestion,
    SuggestionQuery,
    found_good,
)
from orchestrator.learning.campaign_plan import DeploymentPlan, Premises
from orchestrator.learning.deployment.costing import Costs, CostSettings
from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment
from orchestrator.learning.deployment.deployment_ledger import SearchSettings
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import (
    DiscrepancyPolicySettings,
    RiskLimitSettings,
    Rules,
    StopSettings,
    subsampled,
)
from orchestrator.learning.deployment.pour_choice import PourChoice
from orchestrator.learning.requests import Decision, Outcome, Pour, Request, Simulate, Simulated
from orchestrator.learning.strategy import Progress, Strategy
from sim_engine.action import described
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import CountOrFree, Problems, SimulationCount
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from orchestrator.learning.requests import Order


class D3Settings(SearchSettings):
    """D3: real pours with a simulated prior."""

    strategy: Literal["D3"] = "D3"
    """Real pours with a simulated prior."""

    prior_simulations: SimulationCount = 37
    """Simulations before the first pour; with 'simulations_per_pour: free', the largest number. With 'model: adaptive'
    and a fixed number between pours: up to eight times as many while none of them is good."""

    simulations_per_pour: CountOrFree = 2
    """Simulations told between two pours; 'free': for as long as they are worth it."""

    costs: CostSettings | None = None
    """With 'simulations_per_pour: free': what a pour and a simulation cost."""

    model: Literal["adaptive", "residual"] = "adaptive"
    """How simulations enter the surrogate of pours; 'adaptive' averages over ways in which the simulator may be wrong,
    'residual' is the paper's, which always believes it."""

    discrepancy_policy: DiscrepancyPolicySettings | None = None
    """With 'model: adaptive': what follows when the simulator seems not to describe this bench."""

    risk_limit: RiskLimitSettings | None = None
    """With 'model: adaptive': what no pour may lose, once one has kept it."""

    stop: StopSettings | None = None
    """With 'model: adaptive': ends before all pours are made when no further one is worth it."""

    good_enough: Annotated[float, Quantity("1", "1 %", 1e-4, 1.0)] | None = None
    """With 'model: adaptive': ends as soon as the best action is expected to lose no more than this share of a load."""

    @property
    def beside(self) -> int | None:
        """Number of simulations between two pours; None: as many as fit into the duration of a pour."""
        return None if self.simulations_per_pour == "free" else int(self.simulations_per_pour)

    @property
    def adaptive(self) -> bool:
        """Whether the surrogate averages over the ways in which the simulator may be wrong."""
        return self.model == "adaptive"

    @property
    def order(self) -> Order:
        """Order of outcomes: completion order only if simulations run for the duration of a pour."""
        return "completion" if self.beside is None else "logical"

    @property
    def simulations(self) -> int:
        """Number of simulations before the first pour and during all pours."""
        return self.prior_simulations + (self.pours or 0) * self.simulations_beside

    @property
    def simulations_before(self) -> int:
        """Number of simulations for the prior."""
        return self.prior_simulations

    @property
    def simulations_beside(self) -> int:
        """Number of simulations between two pours; 0 if it is not fixed."""
        return self.beside or 0

    @property
    def spending(self) -> str:
        """The budget per receiver, as text."""
        beside, more = self.simulations_per_pour, ""
        if self.adaptive and self.beside is not None:
            more = f" (up to {MOST_PRIOR * self.prior_simulations} while none is good)"
        return f"{self.prior_simulations} simulations{more}, then {self.pours} pours with {beside} beside each"

    def check(self, premises: Premises, complaints: Problems) -> None:
        """Check that each key belongs to the selected model and number of simulations."""
        super().check(premises, complaints)
        if self.costs is not None and self.beside is not None:
            given = f"'simulations_per_pour: {self.simulations_per_pour}'"
            text = f"decides nothing with {given}; write 'simulations_per_pour: free', or remove it"
            complaints.add(text, "costs", key=True)
        for key in () if self.adaptive else ("discrepancy_policy", "risk_limit", "stop", "good_enough"):
            if getattr(self, key) is not None:
                complaints.add(f"needs 'model: adaptive', not '{self.model}'", key, key=True)

    @property
    def learns_offsets(self) -> bool:
        """Whether earlier knowledge of the bench enters the hypotheses."""
        return self.adaptive

    def rules(self, worst: float) -> Rules | None:
        """Rules for the consequences of pours, in units of a loss with the given largest value; None with the paper's
        model."""
        if not self.adaptive:
            return None
        limit = None if self.risk_limit is None else Limit(worst * self.risk_limit.loss, self.risk_limit.probability)
        return Rules(
            discrepancy_policy=self.discrepancy_policy or DiscrepancyPolicySettings(),
            limit=limit,
            fallback="go on" if self.risk_limit is None else self.risk_limit.fallback,
            min_gain=None if self.stop is None else worst * self.stop.min_gain,
            good_enough=None if self.good_enough is None else worst * self.good_enough,
        )

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""

        return (FreeHybrid if self.beside is None else Hybrid)(plan, scene, parameters, seed)


AIMED, TOGETHER = 3, 4
"""One prior simulation in this many is made for the decision about the first pour, once a good action was found; and
how many of them at once."""

MOST_PRIOR = 8
"""Factor on the number of prior simulations up to which they go on while none is good: a pour that is likely to be lost
costs more than simulations."""


class Hybrid(Deployment[D3Settings]):
    """D3: as D2, but the surrogate's prior mean comes from m2 simulations, and from further ones between pours.

    First, Bayesian optimisation in simulation chooses m2 actions; with 'adaptive', the last third are chosen for the
    decision about the first pour, once a good action was simulated; until then they go on. Their surrogate becomes the
    prior of the real cost, f_r(a) = f_s(a) + δ(a): its posterior mean is the prior mean, its posterior covariance adds
    to δ's. The first pour is the minimiser of the prior mean; every further one minimises m(a) − κ s(a) given the
    weighed pours.

    With `simulations_per_pour = k`, one query returns the next pour and the k most informative actions. These are
    simulated during the pour and enter the prior: learning from real trials interleaved with planning in a model
    (Dyna). With `simulations_per_pour = 'free'`, simulations continue as long as the pour takes.

    `model` defines how simulations enter the surrogate. The above is 'residual', the paper's, which always trusts the
    simulator; 'adaptive' averages over the ways in which it may be wrong, and weighs them by every pour.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3; m2 = 37, 15 pours).
    Limitations: with 'residual' a prior from an untrustworthy simulator is worse than none.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        simulated = partial(self._ledger.simulated, everything=True)
        rules = self._settings.rules(self._ledger.costing.worst)
        self._choice = PourChoice(self._requests, simulated, rules, self._ask_operator)
        self._before = self._settings.prior_simulations
        self._found_at: int | None = None

    def _next(self) -> None:
        if not self._ledger.pours:
            self._before = self._simulations_before()
        if self._ledger.spent < self._before and not self._ledger.pours:
            self._next_prior()
        elif self._pouring is not None or not self._trials.idle:
            return
        elif self._choice.left:
            self._next_pour()
        else:
            self._questions.put(self._choice.query(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._conclude)

    def _simulations_before(self) -> int:
        """Number of simulations before the first pour, as far as known: with 'adaptive', one third of the usual number
        follows the first good one."""
        fixed, spent = self._settings.prior_simulations, self._ledger.spent
        costs = self._ledger.simulated().costs
        if not self._settings.adaptive or self._plan.objectives is not None or not costs:
            return fixed
        if self._found_at is None and (found_good(costs) or min(costs) < FOUND * self._ledger.costing.worst):
            self._found_at = spent
        begun = spent if self._found_at is None else self._found_at
        needed = max(fixed, min(begun + fixed // AIMED, MOST_PRIOR * fixed))
        if self._found_at is None and self._before == fixed < needed:
            text = f"no simulation is good so far: they go on, up to {MOST_PRIOR * fixed} instead of {fixed}"
            self._ledger.decisions.append(Decision(text))
        return needed

    def _next_prior(self) -> None:
        settings, choice = self._settings, self._choice

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "prior")

        if len(self._trials) == 0:
            count = min(max(settings.initial_samples, 1), settings.prior_simulations)
            self._questions.put(self._requests.space_filling(count=count), "start", simulate)
        elif self._trials.ready:
            self._scalarization.weigh(exploring=True)
            # in the paper κ is constant, and no simulation only fills space
            known, pending, plain = self._ledger.simulated(), self._trials.pending(), not settings.adaptive
            left = self._before - self._ledger.spent
            aimed = choice.acquisition == "least_loss" and left <= settings.prior_simulations // AIMED
            if aimed and found_good(known.costs):
                # those for the first pour: where it may be made, and where it tells the hypotheses apart
                real, count = self._ledger.real(), 1 + min(left, TOGETHER)
                about = choice.about(real, known, count=count, acquisition="least_loss", pending=pending)
                self._questions.put(about, "prior", lambda answer: self._simulate(answer, "prior", first=1))
                return
            parts = {"pending": pending, "plain": plain, "replicates": plain}
            query = self._requests.query(MinimumQuery, known, everything=False, **parts)
            self._questions.put(query, "prior", simulate)

    def _next_pour(self) -> None:
        """Query the next pour, and the simulations that run during it."""

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._simulate(suggestion, "refine", first=1)

        query = self._choice.query(
            count=1 + self._settings.simulations_beside,
            acquisition=self._choice.acquisition,
            map_resolution=MAP_RESOLUTION,
        )
        self._questions.put(query, "pour", lambda answer: self._choice.judge(answer, pour))

    def _conclude(self, suggestion: Suggestion) -> None:
        self._choice.record(suggestion)
        super()._conclude(suggestion)

    def _front_query(self, simulated: Data, poured: Data) -> PourQuery:
        return self._choice.about(poured, simulated, count=0)

    # -- results ---------------------------------------------------------------------------------------------------

    def result(self) -> Deployed:
        """The result so far, with the conclusions about the bench."""
        return self._choice.result(self._report)

    def progress(self) -> Progress:
        """Simulations and pours done, and their totals."""
        simulations = self._before + self._plan.pours * self._settings.simulations_beside
        done = self._trials.answered - self._ledger.unspent
        ended = self._choice.ended is not None  # no further ones will be made
        pours = self._ledger.counted if ended else self._plan.pours
        return Progress(done, done if ended else simulations, min(self._ledger.counted, pours), pours)


MOST_SIMULATIONS = 200
"""Largest number of simulations in one query; with more, the arm would wait for the answer."""

FRESH_FITS = 40
"""Number of observations up to which hyperparameters are fitted from scratch, which is quick."""

STEPS = 4
"""Number of optimiser steps per fit above that."""

LOST_IN_A_ROW = 20
"""Number of consecutive failed simulations after which no more are requested during a pour."""


class FreeHybrid(Deployment[D3Settings]):
    """D3 that chooses and ends simulations by their value of information: Dyna with costs.

    Every simulation is made where it reduces the least expected real cost most (a `SimulationQuery`). Before the first
    pour, its value per second is compared with that of a pour. The pour is made as soon as it has the higher value per
    second, after `prior_simulations` at the latest. During a pour, simulations take no time of the arm. They continue
    until all that fit into the pour have a negligible value together, because only pours can reduce the remaining
    uncertainty. Then the pool is idle until the next outcome.

    Arm and pool do not wait for the optimiser. The next simulations are chosen in advance, so that a free slot has one
    immediately. Queries contain the hyperparameters of the last answer and a limited number of simulations, and each
    fit takes a few steps only. The map of the surrogate is requested during a pour.

    Limitations: in completion order the requests depend on timing; only the journal repeats a run. A Pareto front is
    searched without costs, with fits from scratch.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        worst = self._ledger.costing.worst
        rules = self._settings.rules(worst)
        self._choice = PourChoice(self._requests, self._simulated, rules, self._ask_operator)
        self._costs = Costs(self._settings.costs or CostSettings(), worst)
        self._out: set[str] = set()
        self._awaited: int | None = None
        self._rested_at: int | None = None
        self._reported_idle_at = -1
        self._map_due = False
        self._fitted: dict[tuple[str, bool], tuple[tuple[float, ...], ...]] = {}
        self._around: Point | None = None

    # -- outcomes -------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in D3; in addition, record the duration of a simulation."""
        super().tell(request, outcome)
        if isinstance(request, Simulate) and isinstance(outcome, Simulated):
            self._costs.record(outcome.outcome.cpu_s)
        if isinstance(request, Pour):
            self._rested_at = None

    # -- the next requests ------------------------------------------------------------------------------------------

    @property
    def _may_think(self) -> bool:
        return True  # several queries may be pending, one of each purpose

    def _next(self) -> None:
        if self._pouring is None:
            if not self._choice.left:
                self._wind_up()
                return
            if self._may_pour and "pour" not in self._out:
                self._next_pour()
        self._look_ahead()

    @property
    def _may_pour(self) -> bool:
        """Whether the pour was decided, and the simulations before it are answered."""
        if self._ledger.pours:
            return True
        return self._awaited is not None and all(trial.closed for trial in self._trials.all[: self._awaited])

    def _wind_up(self) -> None:
        self._trials.withdraw()
        if self._trials.idle and not self._out:
            self._put(self._choice.query(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._conclude)

    def _look_ahead(self) -> None:
        """Choose simulations before a slot is free."""
        if self._out & {"start", "prior", "refine"}:
            return
        if self._awaited is None and not self._ledger.pours:
            self._next_prior()
        elif self._trials.waiting < self._trials.width and self._rested_at != self._trials.answered:
            self._refine(self._trials.width)

    def _next_prior(self) -> None:
        settings, trials = self._settings, self._trials
        if len(trials) == 0 and settings.prior_simulations > 0:
            count = min(max(settings.initial_samples, trials.width), settings.prior_simulations)
            self._put(
                self._requests.space_filling(count=count),
                "start",
                lambda suggestion: self._simulate(suggestion, "prior"),
            )
        elif len(trials) >= settings.prior_simulations:
            self._decide_to_pour("all prior simulations are requested")
        elif trials.answered >= min(2, len(trials)) and trials.waiting < trials.width:

            def weighed(suggestion: Suggestion) -> None:
                if suggestion.values and suggestion.pour_value is not None and not self._scalarization.exploring:
                    one, pour = suggestion.values[0], suggestion.pour_value
                    if self._costs.prefers_pour(one, pour, trials.width):
                        self._decide_to_pour(self._comparison(one, pour), one, pour)
                        return
                self._simulate(suggestion, "prior")

            self._ask_knowledge(min(trials.width, settings.prior_simulations - len(trials)), "prior", weighed)

    def _decide_to_pour(self, why: str, one: float = 0.0, pour: float = 0.0) -> None:
        self._awaited = len(self._trials)
        text = f"pour now, after {self._awaited} simulations: {why}"
        self.decisions.append(Decision(text, {"simulation_value": one, "pour_value": pour}))

    def _refine(self, count: int) -> None:
        """Query more simulations during the pour, as long as they have a value."""

        def weighed(suggestion: Suggestion) -> None:
            if not self._choice.left and self._pouring is None:
                return  # the last pour has finished meanwhile
            if suggestion.surrogate is not None:
                self._report.latest_map = suggestion
            one, pour = (suggestion.values or (0.0,))[0], suggestion.pour_value or 0.0
            exhausted = bool(suggestion.values) and self._costs.is_idle(one, self._trials.width)
            if exhausted and not self._scalarization.exploring:
                self._rest(f"what is left to learn, only pours tell: {self._comparison(one, pour)}", one, pour)
            elif self._trials.lost_in_a_row >= LOST_IN_A_ROW:
                self._rest(f"the last {LOST_IN_A_ROW} simulations failed", one, pour)
            else:
                self._simulate(suggestion, "refine")

        mapped, self._map_due = self._map_due, False
        self._ask_knowledge(count, "refine", weighed, map_resolution=MAP_RESOLUTION if mapped else 0)

    def _rest(self, why: str, one: float, pour: float) -> None:
        self._rested_at = self._trials.answered
        asked = len(self._trials) - self._trials.waiting
        if asked != self._reported_idle_at:  # once, unless there were simulations since
            values = {"pool_rests": 1.0, "simulation_value": one, "pour_value": pour}
            self.decisions.append(Decision(f"the pool rests: {why}", values))
        self._reported_idle_at = asked

    def _next_pour(self) -> None:
        """Query the next pour alone; the simulations during it are queried once the arm moves."""

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._rested_at, self._map_due = None, True

        query = self._choice.query(count=1, acquisition=self._choice.acquisition)
        self._ask_quickly(query, "pour", lambda answer: self._choice.judge(answer, pour))

    def _conclude(self, suggestion: Suggestion) -> None:
        self._choice.record(suggestion)
        super()._conclude(suggestion)

    # -- queries -------------------------------------------------------------------------------------------------

    def _ask_knowledge(
        self, count: int, purpose: str, then: Callable[[Suggestion], None], map_resolution: int = 0
    ) -> None:
        self._scalarization.weigh(exploring=True)
        query = self._requests.query(
            SimulationQuery,
            self._ledger.real(),
            simulated=self._simulated(),
            count=count,
            pending=self._trials.pending(everything=True),
            pouring=tuple(pour.point for pour in self._ledger.pours[-1:] if pour.status == "pouring"),
            coupling="scaled" if self._settings.adaptive else "residual",
            map_resolution=map_resolution,
        )
        self._ask_quickly(query, purpose, then)

    def _ask_quickly(
        self, query: PourQuery | SimulationQuery, purpose: str, then: Callable[[Suggestion], None]
    ) -> None:
        """Put a query whose fit starts from the last one of the same model."""
        adaptive = isinstance(query, PourQuery) and query.discrepancy is not None
        model = query.coupling if isinstance(query, SimulationQuery) else "adaptive" if adaptive else "residual"
        key, effort = (model, len(query.simulated) >= 2), SearchEffort()
        if len(query.data) + len(query.simulated) > FRESH_FITS and not self._scalarization.wanted:
            # noise that varies with the cost is fitted from scratch, because its fit has two stages
            effort = SearchEffort(self._fitted.get(key, ()) if query.noise == "constant" else (), STEPS)

        def answered(suggestion: Suggestion) -> None:
            if suggestion.fitted:
                self._fitted[key] = suggestion.fitted
            self._around = suggestion.best_point or self._around
            then(suggestion)

        self._put(replace(query, effort=effort), purpose, answered)

    def _put(self, query: SuggestionQuery, purpose: str, then: Callable[[Suggestion], None]) -> None:
        def answered(suggestion: Suggestion) -> None:
            self._out.discard(purpose)
            then(suggestion)

        self._out.add(purpose)
        self._questions.put(query, purpose, answered)

    def _simulated(self) -> Data:
        """All answered simulations: during a pour their order does not matter."""
        around = [pour.point for pour in self._ledger.pours[-2:]]
        around += [self._around] if self._around is not None else []
        return subsampled(self._ledger.simulated(everything=True), around, MOST_SIMULATIONS)

    def _front_query(self, simulated: Data, poured: Data) -> PourQuery:
        return self._choice.about(poured, simulated, count=0)

    # -- results ---------------------------------------------------------------------------------------------------

    def _comparison(self, one: float, pour: float) -> str:
        seconds = self._costs.simulation(self._trials.width)
        return f"a simulation promises {one:.2g} for {seconds:.2g} s, a pour {pour:.2g} for {self._costs.pour:g} s"

    def _decide(self, what: str, values: dict[str, float], suggestion: Suggestion, index: int) -> None:
        if not suggestion.values or suggestion.pour_value is None:
            super()._decide(what, values, suggestion, index)
            return
        one, pour = suggestion.values[index], suggestion.pour_value
        text = f"{what}  {described(values)}  {self._comparison(one, pour)}"
        self.decisions.append(Decision(text, {"simulation_value": one, "pour_value": pour}))

    def result(self) -> Deployed:
        """The result so far, with the conclusions about the bench."""
        return self._choice.result(self._report)

    def progress(self) -> Progress:
        """As in D3; simulations that were not needed count as made."""
        simulations = self._settings.prior_simulations
        begun = self._awaited is not None or bool(self._ledger.pours)
        done = simulations if begun else min(self._trials.answered, simulations)
        return Progress(done, simulations, min(self._ledger.counted, self._plan.pours), self._plan.pours)
