"""C3: Bayesian optimisation of O1, every iteration on all training pours."""

from __future__ import annotations

from actors.optimizer.core.problem import Data, Suggestion, SuggestProblem
from orchestrator.strategies.calibration.base import MAP_RESOLUTION
from orchestrator.strategies.calibration.o1 import DiscrepancyOverPours


class BayesianCalibration(DiscrepancyOverPours):
    """C3: minimise O1(θ) = 1/n Σ_i |r_i − c_s(a_i, θ)| by Bayesian optimisation; one iteration costs n simulations.

    Started at Sobol points; every further θ minimises the lower confidence bound of a Gaussian process of O1. θ*
    minimises the posterior mean over the whole box.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C3: 59 iterations, 1652 simulations).
    """

    NAME = "C3"

    @property
    def _thetas(self) -> int:
        return self._plan.thetas

    def _next(self) -> None:
        tried = len(self._trials)
        if tried == 0:
            count = min(max(self._plan.initial, 1), self._thetas)
            problem = SuggestProblem(self._plan.parameters, Data(), acquisition="sobol", count=count)
            self._questions.put(problem, "start", self._queue)
        elif tried < self._thetas:
            if self._trials.ready:
                problem = SuggestProblem(
                    self._plan.parameters, self._observed(), pending=self._trials.pending(), kappa=self._plan.kappa
                )
                self._questions.put(problem, "calibrate", self._queue)
        elif self._trials.idle:
            problem = SuggestProblem(
                self._plan.parameters,
                self._observed(everything=True),
                acquisition="posterior_minimum",
                map_resolution=MAP_RESOLUTION,
            )
            self._questions.put(problem, "conclude", self._settle_at_minimum)

    def _queue(self, suggestion: Suggestion) -> None:
        for i, point in enumerate(suggestion.points):
            self._try(point, (suggestion.means[i], suggestion.deviations[i]) if suggestion.means else None)
