"""D3: real pours with simulations as the prior, and further simulations while the arm pours.

- `D3Settings` holds the settings and builds the strategy.
- `Hybrid` is the strategy.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from actors.optimizer.questions import FOUND, Limit, MinimumQuery, Suggestion, found_good
from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment
from orchestrator.learning.deployment.deployment_ledger import SearchSettings
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import RiskLimitSettings, Rules, StopSettings
from orchestrator.learning.deployment.pour_choice import ActionChoice
from orchestrator.learning.requests import Decision
from orchestrator.learning.strategy import Progress, Strategy, plural
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import Problems, SimulationCount
from sim_engine.settings.quantity import Quantity


class D3Settings(SearchSettings):
    """D3: real pours with a simulated prior."""

    strategy: Literal["D3"] = "D3"
    """Real pours with a simulated prior."""

    prior_simulations: SimulationCount = 37
    """Simulations before the first pour. With 'model: adaptive', up to eight times as many while none is good."""

    simulations_per_pour: SimulationCount = 2
    """Simulations between two pours, which run while the arm pours."""

    model: Literal["adaptive", "residual"] = "adaptive"
    """How simulations enter the surrogate of pours; 'adaptive' averages over ways in which the simulator may be wrong,
    'residual' is the paper's, which always believes it."""

    risk_limit: RiskLimitSettings | None = None
    """With 'model: adaptive': what no pour may lose; for the first one if a calibration or prior supports it."""

    stop: StopSettings | None = None
    """With 'model: adaptive': ends before all pours are made when no further one is worth it."""

    good_enough: Annotated[float, Quantity("1", "1 %", 1e-4, 1.0)] | None = None
    """With 'model: adaptive': ends as soon as the best action is expected to lose no more than this share of a load."""

    @property
    def adaptive(self) -> bool:
        """Whether the surrogate averages over the ways in which the simulator may be wrong."""
        return self.model == "adaptive"

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
        """Number of simulations between two pours."""
        return self.simulations_per_pour

    @property
    def spending(self) -> str:
        """The budget per receiver, as text."""
        most = f" (up to {MOST_PRIOR * self.prior_simulations} while none is good)" if self.adaptive else ""
        between = self.simulations_per_pour
        pours = plural(self.pours or 0, "pour")
        return f"{plural(self.prior_simulations, 'simulation')}{most}, then {pours} with {between} beside each"

    def check(self, complaints: Problems) -> None:
        """Check that each key belongs to the selected model."""
        super().check(complaints)
        for key in () if self.adaptive else ("risk_limit", "stop", "good_enough"):
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
            limit=limit,
            fallback="go on" if self.risk_limit is None else self.risk_limit.fallback,
            min_gain=None if self.stop is None else worst * self.stop.min_gain,
            good_enough=None if self.good_enough is None else worst * self.good_enough,
        )

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""
        return Hybrid(plan, scene, parameters, seed)


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
    (Dyna).

    `model` defines how simulations enter the surrogate. The above is 'residual', the paper's, which always trusts the
    simulator; 'adaptive' averages over the ways in which it may be wrong, and weighs them by every pour.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3; m2 = 37, 15 pours).
    Limitations: with 'residual' a prior from an untrustworthy simulator is worse than none.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        simulated = partial(self._ledger.simulated, everything=True)
        rules = self._settings.rules(self._ledger.costing.worst)
        self._choice = ActionChoice(self._requests, simulated, rules)
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
            parts = {"map_resolution": MAP_RESOLUTION, "equality": self._requests.equality}
            self._questions.put(self._choice.query(count=0, **parts), "conclude", self._conclude)

    def _simulations_before(self) -> int:
        """Number of simulations before the first pour, as far as known: with 'adaptive', one third of the usual number
        follows the first good one."""
        fixed, spent = self._settings.prior_simulations, self._ledger.spent
        costs = self._ledger.simulated().costs
        if not self._settings.adaptive or self._plan.objective is not None or not costs:
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
            # in the paper κ is constant, and no simulation only fills space
            simulated, pending, plain = self._ledger.simulated(), self._trials.pending(), not settings.adaptive
            left = self._before - self._ledger.spent
            aimed = choice.acquisition == "least_loss" and left <= settings.prior_simulations // AIMED
            if aimed and found_good(simulated.costs):
                # those for the first pour: where it may be made, and where it tells the hypotheses apart
                real, count = self._ledger.real(), 1 + min(left, TOGETHER)
                about = choice.about(real, simulated, count=count, acquisition="least_loss", pending=pending)
                self._questions.put(about, "prior", lambda answer: self._simulate(answer, "prior", first=1))
                return
            parts = {"pending": pending, "plain": plain, "replicates": plain}
            query = self._requests.query(MinimumQuery, simulated, everything=False, **parts)
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

    # -- results ---------------------------------------------------------------------------------------------------

    def result(self) -> Deployed:
        """The result so far, with the conclusions about the bench."""
        return self._choice.result(self._report)

    def progress(self) -> Progress:
        """Simulations and pours done, and their limits; a refused pour is repeated with further simulations."""
        simulations = self._before + self._plan.pours * self._settings.simulations_beside
        done = self._trials.answered - self._ledger.unspent
        ended = self._choice.ended is not None  # no further ones will be made
        pours = self._ledger.counted if ended else self._plan.pours
        counted = min(self._ledger.counted, pours)
        return Progress(done, done if ended else simulations, counted, pours, limited=True)
