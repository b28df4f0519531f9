"""C1, C2 and C3: calibrations that minimise O1, for which every θ is simulated on every training pour.

- C1 (`UniformGrid`): a dense uniform grid.
- C2 (`StratifiedSampling`): a stratified sample.
- C3 (`BayesianCalibration`): Bayesian optimisation, every iteration on all training pours.

`DiscrepancyOverPours` is their base and that of `automatic_calibration`, `BestOfDesign` that of C1 and C2. C4, which
minimises O2, is in `continuous_calibration`.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Literal, Self, TypeVar

from actors.optimizer.questions import Data, MinimumQuery, Point, RegressionQuery, SpaceFillingQuery, Suggestion
from orchestrator.learning.calibration.calibration_base import (
    THETA_MAP_RESOLUTION,
    Calibration,
    DesignSettings,
    Kappa,
    TriedOnAll,
    check_initial,
    described,
)
from orchestrator.learning.calibration.pour_design import stratified
from orchestrator.learning.campaign_plan import CalibrationPlan, CalibrationSettings, MeasuredPour
from orchestrator.learning.requests import Decision, Simulate
from orchestrator.learning.strategy import Strategy
from orchestrator.learning.trials import Trial
from sim_engine.settings.model import PositiveSimulationCount, Problems, Text

LEAST_DEFINED = 0.5
"""Fraction of the training pours on which a θ must have a discrepancy to be compared with others."""

MOST_MAPPED = 1_000
"""Maximum number of θ for which a map is made: a Gaussian process of more observations takes minutes."""


S = TypeVar("S", bound=CalibrationSettings)
"""Settings of a strategy that tries θ on all pours."""

D = TypeVar("D", bound=DesignSettings)
"""Settings of a strategy that tries a given number of θ."""


class DiscrepancyOverPours(Calibration[S]):
    """Base of strategies that simulate θ on all n training pours: O1(θ) = 1/n Σ_i |r_i − c_s(a_i, θ)|.

    A pour has the same seed under every θ, so that two θ do not differ by initial positions. A θ that failed, or poured
    too little, on more than half of the pours is never θ*, because the mean over the few others is unreliable.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (O1).
    """

    def __init__(self, plan: CalibrationPlan, measured: Sequence[MeasuredPour], seed: int) -> None:
        super().__init__(plan, measured, seed)
        self._seed_of_pour = [self._seeds.next() for _ in self._usable]
        self._measured = {
            seed: float(pour.spillage)
            for seed, pour in zip(self._seed_of_pour, self._usable, strict=True)
            if pour.spillage is not None
        }

    @property
    def _budget(self) -> int:
        return self._settings.simulations_on(len(self._usable))

    def _trials_at_once(self, slots: int) -> int:
        return math.ceil(slots / len(self._usable))

    def _try(
        self, point: Point, predicted: tuple[float, float] | None = None, only: Sequence[int] | None = None
    ) -> None:
        """Queue a θ on all training pours, or on those with the given indices."""
        theta = self.parameters_at(point)
        requests = tuple(
            Simulate(pour.scene or self._plan.scene.name, pour.action, theta, seed, "calibrate")
            for pour, seed in zip(self._usable, self._seed_of_pour, strict=True)
        )
        if only is not None:
            requests = tuple(requests[i] for i in only)
        self._trials.add(Trial(point, requests))
        if predicted is not None:
            text = f"θ {described(self._values(point))}: expected |Δ| {max(predicted[0], 0.0):.3f}"
            self.decisions.append(Decision(text, {"mean": predicted[0], "sd": predicted[1]}))

    def _discrepancy(self, request: Simulate, simulated: float) -> float:
        """|r_i − c_s(a_i, θ)|."""
        return abs(self._measured[request.seed] - simulated)

    def _observed(self, *, everything: bool = False) -> Data:
        """O1 of the θ that count. A θ without a valid O1 gets the worst value, so that the search leaves its
        neighbourhood."""
        trials = self._trials.counting(everything=everything)
        scores = [(trial.point, self._score(trial)) for trial in trials]
        defined = [score for _, score in scores if score is not None]
        if not defined:
            return Data()
        costs = tuple(max(defined) if score is None else score for _, score in scores)
        return Data(tuple(point for point, _ in scores), costs)

    def _score(self, trial: Trial) -> float | None:
        """O1 of a θ; None if it is defined on too few pours."""
        differences = discrepancies(trial)
        return (
            sum(differences) / len(differences)
            if differences and len(differences) >= LEAST_DEFINED * len(self._usable)
            else None
        )

    def _settle_at_lowest(self) -> None:
        """Set θ* to the simulated θ with the lowest O1, with the standard error of this mean over the pours."""
        scored = [(score, trial) for trial in self._compared() if (score := self._score(trial)) is not None]
        if not scored:
            raise self._no_discrepancies()
        mean, best = min(scored, key=lambda pair: self._merit(pair[1], pair[0]))
        differences = discrepancies(best)
        variance = sum((cost - mean) ** 2 for cost in differences) / max(len(differences) - 1, 1)
        self._settle(best.point, mean, math.sqrt(variance / len(differences)))

    def _merit(self, trial: Trial, score: float) -> float:
        """The quantity that θ* minimises over the trials."""
        return score

    def _compared(self) -> Sequence[Trial]:
        """The trials that θ* is chosen from."""
        return self._trials.all

    def _mapped(self, suggestion: Suggestion) -> None:
        self._final = suggestion

    def _row(self, number: int, trial: Trial) -> TriedOnAll:
        differences = discrepancies(trial)
        costs = {trial.requests[i].seed: cost for i, cost in trial.costs.items()}
        by_pour = [costs.get(seed) for seed in self._seed_of_pour]
        return TriedOnAll(
            theta=self._values(trial.point),
            discrepancy=self._score(trial),
            defined=len(differences),
            largest=max(differences, default=None),
            differences=tuple(None if cost is None else abs(cost) for cost in by_pour),
        )


class BestOfDesign(DiscrepancyOverPours[D]):
    """Base of C1 and C2: all θ are chosen in advance, and θ* is the one with the smallest O1.

    The optimiser is queried only for the map. `predicted_deviation` is the standard error of θ*'s mean over the pours.

    Limitations: the minimum of many noisy means is biased low; θ* is always a point of the design.
    """

    @abstractmethod
    def _design(self) -> Sequence[Point]:
        """The θ to be tried, in the unit cube."""

    def _next(self) -> None:
        if not self._trials.all:
            for point in self._design():
                self._try(point)
            text = f"{self._plan.strategy}: {self._settings.thetas} θ on {len(self._usable)} pours"
            text += f", {self._budget} simulations"
            self.decisions.append(Decision(text))
        elif self._trials.idle:
            self._conclude()

    def _conclude(self) -> None:
        self._settle_at_lowest()
        scored = [(score, trial) for trial in self._trials.all if (score := self._score(trial)) is not None]
        if 2 <= len(scored) <= MOST_MAPPED:
            data = Data(tuple(trial.point for _, trial in scored), tuple(score for score, _ in scored))
            query = RegressionQuery(self._plan.parameters, data, map_resolution=THETA_MAP_RESOLUTION)
            self._questions.put(query, "map", self._mapped)


def discrepancies(trial: Trial) -> list[float]:
    """|r_i − c_s(a_i, θ)| of the pours that have one."""
    return [abs(cost) for _, cost in sorted(trial.costs.items()) if cost is not None]


class C1Settings(DesignSettings):
    """C1: a uniform grid, each θ on all training pours."""

    examples: ClassVar[dict[str, str]] = {"grid": "{particles: 5, cohesion: 6}", "points_per_axis": "10"}

    strategy: Literal["C1"] = "C1"
    """A uniform grid."""

    grid: dict[Text, PositiveSimulationCount] | None = None
    """Number of values of every searched parameter: {particles: 5, cohesion: 6}."""

    points_per_axis: PositiveSimulationCount | None = None
    """Number of values of each searched parameter, instead of 'grid'."""

    @property
    def cells(self) -> dict[str, int]:
        """Number of values of every searched θ, once the settings are settled."""
        assert self.grid is not None, "settled settings have a grid"
        return self.grid

    @property
    def thetas(self) -> int:
        """Number of points of the grid."""
        return math.prod(self.cells.values())

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """The grid as it is given, or the finest grid with equal numbers on all axes that the simulations allow."""
        if self.grid is not None:
            for name in self.grid:
                if name not in searched:
                    complaints.add(f"is not searched; searched are {', '.join(searched)}", "grid", name, key=True)
            for name in searched:
                if name not in self.grid:
                    complaints.add(f"has no number of values for {name}, which is searched", "grid", key=True)
            grid = {name: self.grid.get(name, 0) for name in searched}
        elif self.points_per_axis is not None:
            grid = dict.fromkeys(searched, self.points_per_axis)
        else:
            points_per_axis = 1
            while train * (points_per_axis + 1) ** len(searched) <= (self.simulations or 0):
                points_per_axis += 1
            if points_per_axis < 2:
                least = train * 2 ** len(searched)
                text = f"allows no grid: 2 values of each searched parameter on {train} training pours take {least}"
                complaints.add(text, "simulations")
            grid = dict.fromkeys(searched, points_per_axis)
        return None if complaints.any else self.model_copy(update={"grid": grid, "points_per_axis": None})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """Build the strategy."""
        return UniformGrid(plan, pours, seed)


class UniformGrid(BestOfDesign[C1Settings]):
    """C1: θ* = argmin O1(θ) over a uniform grid, each θ simulated on all training pours.

    Every axis of θ's box is divided into equal cells (log-equal for a logarithmic scale), and θ is tried at their
    centres. Every point of the box is then within half a cell of the grid.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C1: 10 × 10 over two θ, 2800 simulations).
    Limitations: the cost grows exponentially with the dimension.
    """

    def _design(self) -> Sequence[Point]:
        cells = [self._settings.cells[name] for name in self._plan.parameters.names]
        middles = [[(i + 0.5) / count for i in range(count)] for count in cells]
        return list(itertools.product(*middles))


class C2Settings(DesignSettings):
    """C2: stratified sampling, each θ on all training pours."""

    examples: ClassVar[dict[str, str]] = {"samples": "18"}

    strategy: Literal["C2"] = "C2"
    """Stratified sampling."""

    samples: PositiveSimulationCount | None = None
    """Number of θ: in equal strata if the number allows it, otherwise a Latin hypercube."""

    @property
    def thetas(self) -> int:
        """Number of samples."""
        return self.samples or 0

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Fill in the number of samples that is given or that the simulations allow."""
        samples = self._counted(self.samples, train, complaints)
        return None if samples is None else self.model_copy(update={"samples": samples})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """Build the strategy."""
        return StratifiedSampling(plan, pours, seed)


class StratifiedSampling(BestOfDesign[C2Settings]):
    """C2: θ* = argmin O1(θ) over a jittered grid, each θ simulated on all training pours.

    If the number of samples allows it, θ's box is divided into equal strata with two random θ each, or with one each.
    The paper uses 18 = 3 × 3 × 2 for two parameters. Any other number becomes a Latin hypercube.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C2: 3 × 3 strata, 2 samples each, 504 simulations).
    """

    def _design(self) -> Sequence[Point]:
        strata = stratified(self._settings.thetas, self._plan.parameters.dimension, self._seeds.rng)
        return [stratum.draw(self._seeds.rng) for stratum in strata]


class C3Settings(DesignSettings):
    """C3: Bayesian optimisation, each θ on all training pours."""

    examples: ClassVar[dict[str, str]] = {"iterations": "59"}

    strategy: Literal["C3"] = "C3"
    """Bayesian optimisation, each θ on all training pours."""

    iterations: PositiveSimulationCount | None = None
    """Number of θ, each simulated on all training pours."""

    initial_samples: PositiveSimulationCount = 8
    """Random parameters before the surrogate is used."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    @property
    def thetas(self) -> int:
        """Number of iterations, one θ each."""
        return self.iterations or 0

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Fill in the number of iterations that is given or that the simulations allow."""
        iterations = self._counted(self.iterations, train, complaints)
        if iterations is None:
            return None
        key = "simulations" if self.iterations is None else "iterations"
        check_initial(self, self.initial_samples, iterations, key, "θ", complaints)
        return self.model_copy(update={"iterations": iterations})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """Build the strategy."""
        return BayesianCalibration(plan, pours, seed)


class BayesianCalibration(DiscrepancyOverPours[C3Settings]):
    """C3: minimise O1(θ) = 1/n Σ_i |r_i − c_s(a_i, θ)| by Bayesian optimisation; one iteration costs n simulations.

    The first θ are Sobol points. Every further θ minimises the lower confidence bound of a Gaussian process of O1. θ*
    minimises the posterior mean over the whole box.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C3: 59 iterations, 1652 simulations).
    """

    def _next(self) -> None:
        tried = len(self._trials)
        if tried == 0:
            count = min(max(self._settings.initial_samples, 1), self._settings.thetas)
            self._questions.put(SpaceFillingQuery(self._plan.parameters, count=count), "start", self._queue)
        elif tried < self._settings.thetas:
            if self._trials.ready:
                query = MinimumQuery(
                    self._plan.parameters, self._observed(), pending=self._trials.pending(), kappa=self._settings.kappa
                )
                self._questions.put(query, "calibrate", self._queue)
        elif self._trials.idle:
            query = MinimumQuery(
                self._plan.parameters,
                self._observed(everything=True),
                acquisition="posterior_minimum",
                map_resolution=THETA_MAP_RESOLUTION,
            )
            self._questions.put(query, "conclude", self._settle_at_minimum)

    def _queue(self, suggestion: Suggestion) -> None:
        for i, point in enumerate(suggestion.points):
            self._try(point, (suggestion.means[i], suggestion.deviations[i]) if suggestion.means else None)
