"""D3: real pours around what simulation expects, while simulation goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from actors.optimizer.core.mismatch import Mismatch
from actors.optimizer.core.problem import AcquisitionName, Data, MeanName, Suggestion, SuggestProblem
from orchestrator.plan import DeploymentPlan
from orchestrator.requests import Answered, Ask, Outcome, Request, Slots
from orchestrator.strategies.deployment.adaptive import (
    Believed,
    Trust,
)
from orchestrator.strategies.deployment.base import MAP_RESOLUTION, Deployment
from orchestrator.strategies.deployment.d3_settings import D3Settings
from orchestrator.strategies.deployment.learnt import Deployed
from orchestrator.strategies.deployment.play import play_of
from orchestrator.strategies.deployment.pours import Foretold, PourTrial
from orchestrator.strategies.deployment.trust import Compared, TrustCheck
from orchestrator.strategies.progress import Progress
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene

MEANS: dict[str, MeanName] = {"residual": "simulated", "pooled": "pooled", "scaled": "scaled"}
"""How the optimiser calls the models."""

WIDENING = 3.0
"""Factor on the noise that simulations are expected to have, once they were found wrong."""


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
        self._asked, then, self._then = None, self._then, None
        if then is not None:
            then(outcome.answer)
        elif self._check is not None:
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
            self._questions.put(self._hybrid(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._concluded)

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
        limit = self._rules.limit
        if limit is not None and not any(p.cost is not None and p.cost <= limit.loss for p in self._pours):
            limit = None  # nothing good is in hand that could be poured again
        return Mismatch(
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
        return not self._settings.plain

    # -- results ---------------------------------------------------------------------------------------------------

    def _trusted(self, weighed: Sequence[PourTrial]) -> Compared | Foretold | Believed:
        if self._trust is not None:
            return self._trust.result()
        return super()._trusted(weighed) if self._check is None else self._check.result()

    def result(self) -> Deployed:
        """What was learnt so far, of the bench too."""
        bench = None if self._trust is None else self._trust.bench()
        return super().result().model_copy(update={"ended": self._ended, "bench": bench})

    def progress(self) -> Progress:
        """Simulations and pours done, and in all (those beside the pours count only where their number is fixed)."""
        simulations = self._settings.prior_simulations + self._plan.pours * self._settings.simulations_beside
        answered = self._trials.answered - self._unspent
        done = min(answered, simulations) if self._settings.beside is None else answered
        if self._followed == "D2" or self._ended is not None:  # those that will not be made any more
            simulations = done
        pours = self._counted if self._ended is not None else self._plan.pours
        return Progress(done, simulations, min(self._counted, pours), pours)
