"""C3: Bayesian optimisation of O1, every iteration on all training pours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from actors.optimizer.core.problem import Data, Suggestion, SuggestProblem
from orchestrator.config.yaml.sections import Complaints, PositiveSimulationCount
from orchestrator.plan import CalibrationPlan, MeasuredPour
from orchestrator.strategies.calibration.base import MAP_RESOLUTION
from orchestrator.strategies.calibration.o1 import DiscrepancyOverPours
from orchestrator.strategies.calibration.settings import DesignSettings, Kappa, check_initial
from orchestrator.strategies.protocol import Strategy


class C3Settings(DesignSettings):
    """C3: Bayesian optimisation, each θ on all training pours."""

    required: ClassVar[dict[str, str]] = {"strategy": "C3"}
    examples: ClassVar[dict[str, str]] = {"iterations": "59"}

    strategy: Literal["C3"] = "C3"
    """Bayesian optimisation, each θ on all training pours."""

    iterations: PositiveSimulationCount | None = None
    """θ in all, each simulated on all training pours."""

    initial: PositiveSimulationCount = 8
    """Random parameters before the surrogate takes over."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    @property
    def thetas(self) -> int:
        """One for each iteration."""
        return self.iterations or 0

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """As many iterations as are given, or as the simulations allow."""
        iterations = self._counted(self.iterations, train, complaints)
        if iterations is None:
            return None
        key = "simulations" if self.iterations is None else "iterations"
        check_initial(self, self.initial, iterations, key, "θ", complaints)
        return self.model_copy(update={"iterations": iterations})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """The strategy itself."""
        return BayesianCalibration(plan, pours, seed)


class BayesianCalibration(DiscrepancyOverPours[C3Settings]):
    """C3: minimise O1(θ) = 1/n Σ_i |r_i − c_s(a_i, θ)| by Bayesian optimisation; one iteration costs n simulations.

    Started at Sobol points; every further θ minimises the lower confidence bound of a Gaussian process of O1. θ*
    minimises the posterior mean over the whole box.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C3: 59 iterations, 1652 simulations).
    """

    def _next(self) -> None:
        tried = len(self._trials)
        if tried == 0:
            count = min(max(self._settings.initial, 1), self._settings.thetas)
            problem = SuggestProblem(self._plan.parameters, Data(), acquisition="sobol", count=count)
            self._questions.put(problem, "start", self._queue)
        elif tried < self._settings.thetas:
            if self._trials.ready:
                problem = SuggestProblem(
                    self._plan.parameters, self._observed(), pending=self._trials.pending(), kappa=self._settings.kappa
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
