"""D3: real pours around what simulation expects, while simulation goes on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from actors.optimizer.core.mismatch import Mismatch
from actors.optimizer.core.problem import AcquisitionName, Data, MeanName, Suggestion, SuggestProblem
from orchestrator.config.yaml.sections import Count, CountOrFree
from orchestrator.plan import DeploymentPlan
from orchestrator.requests import Answered, Ask, Outcome, Request, Slots
from orchestrator.strategies.deployment.base import MAP_RESOLUTION, Deployment
from orchestrator.strategies.deployment.play import play_of
from orchestrator.strategies.deployment.pours import Foretold, PourTrial
from orchestrator.strategies.deployment.prices import PricesSettings
from orchestrator.strategies.deployment.settings import SearchSettings
from orchestrator.strategies.deployment.trust import Compared, TrustCheck, TrustOrAlways, TrustSettings
from orchestrator.strategies.progress import Progress
from orchestrator.strategies.protocol import Strategy
from orchestrator.strategies.settings import Complaints, Premises
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene

if TYPE_CHECKING:
    from orchestrator.flights import Order

MEANS: dict[str, MeanName] = {"residual": "simulated", "pooled": "pooled", "scaled": "scaled"}
"""How the optimiser calls the models."""

WIDENING = 3.0
"""Factor on the noise that simulations are expected to have, once they were found wrong."""


class D3Settings(SearchSettings):
    """D3: real pours with a simulated prior."""

    required: ClassVar[dict[str, str]] = {"strategy": "D3"}

    strategy: Literal["D3"] = "D3"
    """Real pours with a simulated prior."""

    prior_simulations: Count = 37
    """Simulations before the first pour; with 'per_pour: free' at most so many."""

    per_pour: CountOrFree = 2
    """Simulations told between two pours; 'free': for as long as they are worth it."""

    prices: PricesSettings | None = None
    """With 'per_pour: free': what a pour and a simulation cost."""

    model: Literal["adaptive", "residual", "pooled", "scaled"] = "adaptive"
    """How simulations enter the surrogate of pours; 'adaptive' averages over ways in which the simulator may be wrong,
    'residual' is the paper's."""

    trust: TrustOrAlways | None = None
    """For the other models: when the first pours say that the simulator is wrong, and what follows; 'always' believes
    it, as the paper."""

    @property
    def beside(self) -> int | None:
        """Simulations told between two pours; None: for as long as a pour takes."""
        return None if self.per_pour == "free" else int(self.per_pour)

    @property
    def adaptive(self) -> bool:
        """Whether it averages over the ways in which the simulator may be wrong."""
        return self.model == "adaptive"

    @property
    def checked(self) -> TrustSettings | None:
        """When the simulator is called wrong; None if it never is, or if every pour weighs it."""
        if self.adaptive or self.trust == "always":
            return None
        return self.trust if isinstance(self.trust, TrustSettings) else TrustSettings()

    @property
    def plain(self) -> bool:
        """Simulations before the first pour are chosen as in the paper, with a constant κ, and warn of nothing."""
        return self.model == "residual"

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

    def check(self, premises: Premises, complaints: Complaints) -> None:
        """Prices decide only where simulations go on for as long as they are worth it."""
        super().check(premises, complaints)
        if self.prices is not None and self.beside is not None:
            text = f"decides nothing with 'per_pour: {self.per_pour}'; write 'per_pour: free', or remove it"
            complaints.add(text, "prices", key=True)
        if self.trust is not None and self.adaptive:
            complaints.add(
                "decides nothing with 'model: adaptive', which weighs the simulator by every pour", "trust", key=True
            )

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""
        from orchestrator.strategies.deployment.d3_free import FreeHybrid

        return (FreeHybrid if self.beside is None else Hybrid)(plan, scene, parameters, seed)


class Hybrid(Deployment[D3Settings]):
    """D3: as D2, but the surrogate's prior mean is learnt from m2 simulations, and goes on learning between pours.

    First, Bayesian optimisation in simulation chooses m2 actions. Their surrogate becomes the prior of the real
    cost, f_r(a) = f_s(a) + δ(a): its posterior mean is the prior mean, its posterior covariance adds to δ's. The first
    pour is the minimiser of the prior mean; every further one minimises m(a) − κ s(a) given the weighed pours.

    With `per_pour = k`, one question answers with the next pour and k places where a simulation would matter
    most, which are simulated beside the pour and enter the prior: learning from real trials interleaved with planning
    in a model (Dyna). With `per_pour = 'free'`, simulations go on for as long as the pour takes.

    Unless `trust` is 'always', the first pours are compared with the simulations (`TrustCheck`). One that is wrong is
    then forgotten, believed less, or put to a person. `model` says how simulations enter the surrogate; the above is
    'residual', the paper's.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3; m2 = 37, 15 pours).
    Limitations: a prior from an untrustworthy simulator is worse than none; pours made before that is known are lost.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        checked = self._settings.checked
        self._check = None if checked is None else TrustCheck(checked, self._costing.worst)
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
        if request != self._asked or self._check is None or not isinstance(outcome, Answered):
            raise ValueError(f"this was not asked, or not answered: {request.question}")
        self._asked = None
        self._settle(self._check, outcome.answer)

    def _next(self, free_simulations: int) -> None:
        if self._check is not None and self._pouring is None and (pours := self._check.due(self._pours)):
            self._compare(self._check, pours)
        elif self._spent < self._settings.prior_simulations and not self._pours:
            self._next_prior()
        elif self._pouring is not None:
            if self._settings.beside is None and free_simulations > 0 and self._followed != "D2":
                self._refine(free_simulations)
        elif self._pours_left:
            if self._trials.idle or (self._settings.beside is None and self._pours):
                self._next_pour()
        elif self._trials.idle:
            self._questions.put(self._hybrid(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._conclude)

    def _compare(self, check: TrustCheck, pours: list[PourTrial]) -> None:
        """Ask what the simulations alone say of the actions poured, and go by it."""
        self._compromise.weigh(exploring=False)

        def answered(suggestion: Suggestion) -> None:
            check.compare(pours, suggestion)
            self._unasked = check.question
            self._heard(check)

        simulated = self._trials.data(everything=True)
        places = tuple(pour.point for pour in pours)
        self._questions.put(self._problem(simulated, count=0, predict_at=places), "trust", answered)

    def _settle(self, check: TrustCheck, answer: str) -> None:
        check.settle(answer)
        self._heard(check)

    def _heard(self, check: TrustCheck) -> None:
        self.decisions += check.decisions
        check.decisions.clear()

    @property
    def _followed(self) -> str | None:
        """What followed on an alarm."""
        return None if self._check is None else self._check.policy

    def _next_prior(self) -> None:
        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "prior")

        if len(self._trials) == 0:
            count = min(max(self._settings.initial, 1), self._settings.prior_simulations)
            self._questions.put(self._problem(Data(), acquisition="sobol", count=count), "start", simulate)
        elif self._trials.ready:
            self._compromise.weigh(exploring=True)
            known, pending, plain = self._simulated(), self._trials.pending(), self._settings.plain
            problem = self._problem(known, everything=False, pending=pending, plain=plain)
            self._questions.put(problem, "prior", simulate)

    def _next_pour(self) -> None:
        """The next pour, and with it the simulations that run beside it."""
        problem = self._hybrid(
            count=1 + (0 if self._followed == "D2" else self._settings.simulations_beside),
            acquisition=self._acquisition,
            map_resolution=MAP_RESOLUTION,
        )

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._simulate(suggestion, "refine", first=1)

        self._questions.put(problem, "pour", pour)

    @property
    def _acquisition(self) -> AcquisitionName:
        """Of the next pour."""
        if self._settings.adaptive and not self._compromise.exploring:
            return "least_loss"
        return "lcb" if self._pours or self._former else "posterior_minimum"

    def _refine(self, count: int) -> None:
        """More simulations while the pour takes its time."""

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "refine")

        problem = self._hybrid(count=count, pending=(*self._trials.pending(everything=True), self._pours[-1].point))
        self._questions.put(problem, "refine", simulate)

    def _hybrid(self, **changes: Any) -> SuggestProblem:
        self._compromise.weigh(exploring=changes.get("count") != 0)
        return self._informed(self._real(), self._simulated(everything=True), **changes)

    def _informed(self, poured: Data, simulated: Data, **changes: Any) -> SuggestProblem:
        """A question about the real cost, with what the simulations are still good for."""
        match self._followed:
            case "D2":
                return self._problem(poured, **changes)
            case "widen":
                return self._problem(poured, mean="pooled", widening=WIDENING, simulated=simulated, **changes)
            case _ if not self._settings.adaptive:
                return self._problem(poured, mean=MEANS[self._settings.model], simulated=simulated, **changes)
            case _ if changes.get("acquisition") == "knowledge":  # what one more simulation is worth beside a pour
                return self._problem(poured, mean="scaled", simulated=simulated, **changes)
            case _:
                changes |= {"mean": "adaptive", "mismatch": self._mismatch}
                return self._problem(poured, simulated=simulated, **changes)

    @property
    def _mismatch(self) -> Mismatch:
        """How the simulator may be wrong."""
        left = max(self._plan.pours - self._counted - 1, 0)
        return Mismatch(play_of(self._plan.actions), worst=self._costing.worst, left=left)

    def _front_problem(self, simulated: Data, poured: Data) -> SuggestProblem:
        return self._informed(poured, simulated)

    @property
    def _warned(self) -> bool:
        return not self._settings.plain

    # -- results ---------------------------------------------------------------------------------------------------

    def _trusted(self, weighed: Sequence[PourTrial]) -> Compared | Foretold:
        return super()._trusted(weighed) if self._check is None else self._check.result()

    def progress(self) -> Progress:
        """Simulations and pours done, and in all (those beside the pours count only where their number is fixed)."""
        simulations = self._settings.prior_simulations + self._plan.pours * self._settings.simulations_beside
        answered = self._trials.answered - self._unspent
        done = min(answered, simulations) if self._settings.beside is None else answered
        if self._followed == "D2":  # those that will not be made any more
            simulations = done
        return Progress(done, simulations, min(self._counted, self._plan.pours), self._plan.pours)
