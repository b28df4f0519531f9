"""D3: real pours around what simulation expects, while simulation goes on."""

from __future__ import annotations

from actors.optimizer.core.problem import Data, Suggestion, SuggestProblem
from orchestrator.strategies.deployment import MAP_RESOLUTION, Deployment


class Hybrid(Deployment):
    """D3: as D2, but the surrogate's prior mean is learnt from m2 simulations, and goes on learning between pours.

    First, Bayesian optimisation in simulation chooses m2 actions. Their surrogate becomes the prior of the real
    cost, f_r(a) = f_s(a) + δ(a): its posterior mean is the prior mean, its posterior covariance adds to δ's. The first
    pour is the minimiser of the prior mean; every further one minimises m(a) − κ s(a) given the weighed pours.

    With `per_pour = k`, one question answers with the next pour and k places where a simulation would matter
    most, which are simulated beside the pour and enter the prior: learning from real trials interleaved with planning
    in a model (Dyna). With `per_pour = None`, simulations go on for as long as the pour takes.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3; m2 = 37, 15 pours).
    Limitations: a prior from an untrustworthy simulator is worse than none; see `trust` in the result.
    """

    NAME = "D3"

    def _next(self, free_simulations: int) -> None:
        if len(self._trials) < self._plan.prior_simulations and not self._pours:
            self._next_prior()
        elif self._pouring is not None:
            if self._plan.per_pour is None and free_simulations > 0:
                self._refine(free_simulations)
        elif self._pours_left:
            if self._trials.idle or (self._plan.per_pour is None and self._pours):
                self._next_pour()
        elif self._trials.idle:
            self._questions.put(self._hybrid(count=0, map_resolution=MAP_RESOLUTION), "conclude", self._conclude)

    def _next_prior(self) -> None:
        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "prior")

        if len(self._trials) == 0:
            count = min(max(self._plan.initial, 1), self._plan.prior_simulations)
            self._questions.put(self._problem(Data(), acquisition="sobol", count=count), "start", simulate)
        elif self._trials.ready:
            self._compromise.weigh(exploring=True)
            problem = self._problem(self._simulated(), pending=self._trials.pending())
            self._questions.put(problem, "prior", simulate)

    def _next_pour(self) -> None:
        """The next pour, and with it the simulations that run beside it."""
        problem = self._hybrid(
            count=1 + (self._plan.per_pour or 0),
            acquisition="lcb" if self._pours or self._former else "posterior_minimum",
            map_resolution=MAP_RESOLUTION,
        )

        def pour(suggestion: Suggestion) -> None:
            self._pour_first(suggestion)
            self._simulate(suggestion, "refine", first=1)

        self._questions.put(problem, "pour", pour)

    def _refine(self, count: int) -> None:
        """More simulations while the pour takes its time."""

        def simulate(suggestion: Suggestion) -> None:
            self._simulate(suggestion, "refine")

        problem = self._hybrid(count=count, pending=(*self._trials.pending(everything=True), self._pours[-1].point))
        self._questions.put(problem, "refine", simulate)

    def _hybrid(self, **changes: object) -> SuggestProblem:
        self._compromise.weigh(exploring=changes.get("count") != 0)
        return self._problem(self._real(), mean="simulated", simulated=self._simulated(everything=True), **changes)

    def _front_problem(self, simulated: Data, poured: Data) -> SuggestProblem:
        return self._problem(poured, mean="simulated", simulated=simulated)

    def progress(self) -> tuple[int, int]:
        """Simulations and pours done, and in all (those beside the pours count only where their number is fixed)."""
        beside = self._plan.pours * (self._plan.per_pour or 0)
        simulations = self._plan.prior_simulations + beside
        done = min(self._trials.answered, simulations) if self._plan.per_pour is None else self._trials.answered
        return done + min(self._counted, self._plan.pours), simulations + self._plan.pours
