"""O1: what C1, C2 and C3 minimise, every θ simulated on every training pour."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import TypeVar

from actors.optimizer.core.problem import Data, Point, Suggestion, SuggestProblem
from orchestrator.plan import CalibrationPlan, MeasuredPour
from orchestrator.requests import Decision, Simulate
from orchestrator.strategies.calibration.base import MAP_RESOLUTION, Calibration, TriedOnPours, described
from orchestrator.strategies.calibration.settings import DesignSettings
from orchestrator.strategies.trials import Trial

LEAST_DEFINED = 0.5
"""Share of the training pours on which a θ must have a discrepancy, to be compared with others at all."""

MOST_MAPPED = 1_000
"""θ from which a map is drawn: a Gaussian process of more takes minutes."""


S = TypeVar("S", bound=DesignSettings)
"""Settings of a strategy that tries so many θ on all pours."""


class DiscrepancyOverPours(Calibration[S]):
    """Base of C1, C2 and C3: O1(θ) = 1/n Σ_i |r_i − c_s(a_i, θ)| over the n training pours.

    A pour has the same seed under every θ, so that two θ don't differ by their initial positions. A θ that failed, or
    poured too little, on more than half of the pours is never θ*: the mean of the few others may be luck.

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
        return self._settings.thetas * len(self._usable)

    def _trials_at_once(self, slots: int) -> int:
        return math.ceil(slots / len(self._usable))

    def _try(self, point: Point, predicted: tuple[float, float] | None = None) -> None:
        """Queue a θ on all training pours."""
        theta = self.parameters_at(point)
        requests = tuple(
            Simulate(pour.scene or self._plan.scene.name, pour.action, theta, seed, "calibrate")
            for pour, seed in zip(self._usable, self._seed_of_pour, strict=True)
        )
        self._trials.add(Trial(point, requests))
        if predicted is not None:
            text = f"θ {described(self._values(point))}: expected |Δ| {max(predicted[0], 0.0):.3f}"
            self.decisions.append(Decision(text, {"mean": predicted[0], "sd": predicted[1]}))

    def _discrepancy(self, request: Simulate, simulated: float) -> float:
        """|r_i − c_s(a_i, θ)|."""
        return abs(self._measured[request.seed] - simulated)

    def _observed(self, *, everything: bool = False) -> Data:
        """O1 of the θ that count; a θ that can't be compared has the worst of them, so that the search leaves it."""
        trials = self._trials.counting(everything=everything)
        scores = [(trial.point, _score(trial)) for trial in trials]
        known = [score for _, score in scores if score is not None]
        if not known:
            return Data()
        costs = tuple(max(known) if score is None else score for _, score in scores)
        return Data(tuple(point for point, _ in scores), costs)

    def _row(self, number: int, trial: Trial) -> TriedOnPours:
        known = [cost for cost in trial.costs.values() if cost is not None]
        return TriedOnPours(
            theta=self._values(trial.point),
            discrepancy=_score(trial),
            defined=len(known),
            largest=max(known, default=None),
        )


class BestOfDesign(DiscrepancyOverPours[S]):
    """Base of C1 and C2: all θ are chosen beforehand, and θ* is the one with the least O1.

    An optimiser is asked only for the map. `predicted_deviation` is the standard error of θ*'s mean over the pours.

    Limitations: the least of many noisy means is somewhat lucky; θ* lies on the design, never between.
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
        scored = [(score, trial) for trial in self._trials.all if (score := _score(trial)) is not None]
        if not scored:
            raise self._nothing_learnt()
        mean, best = min(scored, key=lambda pair: pair[0])
        known = [cost for cost in best.costs.values() if cost is not None]
        variance = sum((cost - mean) ** 2 for cost in known) / max(len(known) - 1, 1)
        self._settle(best.point, mean, math.sqrt(variance / len(known)))
        if 2 <= len(scored) <= MOST_MAPPED:
            data = Data(tuple(trial.point for _, trial in scored), tuple(score for score, _ in scored))
            problem = SuggestProblem(self._plan.parameters, data, count=0, map_resolution=MAP_RESOLUTION)
            self._questions.put(problem, "map", self._mapped)

    def _mapped(self, suggestion: Suggestion) -> None:
        self._final = suggestion


def _score(trial: Trial) -> float | None:
    """O1 of a θ; None where it is defined on too few pours."""
    known = sum(cost is not None for cost in trial.costs.values())
    return trial.cost if known >= LEAST_DEFINED * len(trial.requests) else None
