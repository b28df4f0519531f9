"""Scalarization of several objectives, and the Pareto front.

- `scalarised` and `undominated` are pure functions on vectors of objectives.
- `Scalarization` keeps the objectives of the simulations, provides the data of each query and determines the front.

The objectives are defined in `objectives`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from actors.optimizer.questions import Data, Point, PourQuery, RegressionQuery, Suggestion
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.deployment_result import ParetoAction
from orchestrator.learning.deployment.objectives import Vector
from orchestrator.learning.requests import Simulate
from orchestrator.learning.stage_result import displayed_action
from orchestrator.learning.trials import OptimizerQueries, Trial
from sim_engine.search_space import Space

AUGMENTATION = 0.05
"""Fraction of the weighted sum in a scalarization; without it, weakly dominated points would be rated as equal."""


def random_weights(count: int, rng: np.random.Generator) -> Vector:
    """Draw weights evenly from the simplex: positive, with sum 1."""
    drawn = rng.exponential(size=count)
    return tuple(float(w) for w in drawn / drawn.sum())


def scalarised(
    vectors: Sequence[Vector], weights: Vector, worst: Vector, among: Sequence[Vector] | None = None
) -> list[float]:
    """The augmented Chebyshev function of each vector: max_j λ_j z_j + ρ Σ_j λ_j z_j.

    z_j is objective j, normalised to the range of its observations (`among`; by default the vectors themselves). Pours
    that delivered too little (beyond `worst`) do not extend the range, and have values above 1. Every point of the
    front minimises the function for some weights, also on concave parts, which a weighted sum cannot reach.

    Source: Knowles, ParEGO: a hybrid algorithm with on-line landscape approximation for expensive multiobjective
    optimization problems, IEEE Transactions on Evolutionary Computation 10, 2006.
    """
    if not vectors:
        return []
    values, limit = np.array(vectors, dtype=np.float64), np.array(worst, dtype=np.float64)
    known = values if among is None else np.array(among, dtype=np.float64)
    usual = known[np.all(known <= limit + 1e-12, axis=1)]
    lower = usual.min(axis=0) if len(usual) else np.zeros_like(limit)
    upper = usual.max(axis=0) if len(usual) else limit
    span = np.where(upper - lower > 1e-9, upper - lower, np.maximum(limit, 1e-9))
    weighted = np.array(weights) * (values - lower) / span
    return [float(v) for v in weighted.max(axis=1) + AUGMENTATION * weighted.sum(axis=1)]


def undominated(vectors: Sequence[Vector]) -> list[int]:
    """Indices of the vectors that no other vector dominates: as good in all objectives and better in one."""
    values = np.array(vectors, dtype=np.float64)
    kept = []
    for i, own in enumerate(values):
        beaten = np.all(values <= own, axis=1) & np.any(values < own, axis=1)
        if not beaten.any():
            kept.append(i)
    return kept


Observed = Sequence[tuple[Point, Vector]]
"""Points with their observed objectives."""


class Scalarization:
    """Keeps the objectives of simulations, and weighs them again for every query.

    Unless a front is searched, the minimised quantity is always the number of `Costing.total`.
    """

    def __init__(self, costing: Costing, rng: np.random.Generator) -> None:
        self._costing = costing
        self._rng = rng
        self._vectors: dict[Simulate, Vector] = {}
        self._weights: Vector | None = None
        self.front: list[ParetoAction] | None = None

    @property
    def wanted(self) -> bool:
        """Whether a front is searched."""
        return self._costing.objectives is not None and self._costing.objectives[0].pareto

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objectives; empty with a plain loss."""
        return () if self._costing.objectives is None else self._costing.objectives[0].names

    @property
    def exploring(self) -> bool:
        """Whether the query minimises a random scalarization; its numbers are not losses then."""
        return self._weights is not None

    def weigh(self, *, exploring: bool) -> None:
        """Set the weights of the next query: random to explore the front, otherwise those of the campaign."""
        self._weights = random_weights(len(self.names), self._rng) if self.wanted and exploring else None

    def note(self, request: Simulate, vector: Vector | None) -> float | None:
        """Record the objectives of a simulation and return its cost."""
        if vector is None:
            return None
        self._vectors[request] = vector
        return self._costing.total(vector)

    def of(self, trials: Sequence[Trial]) -> list[tuple[Point, Vector]]:
        """Mean objectives of the trials that have any."""
        found = []
        for trial in trials:
            known = [self._vectors[request] for request in trial.requests if request in self._vectors]
            if known:
                found.append((trial.point, tuple(float(v) for v in np.mean(known, axis=0))))
        return found

    def data(self, observed: Observed, among: Observed) -> Data:
        """Observations of the quantity that the next query minimises.

        Args:
            observed: observations to convert.
            among: all known observations; their range scales the objectives.
        """
        points, vectors = tuple(point for point, _ in observed), [vector for _, vector in observed]
        if self._weights is None:
            return Data(points, tuple(self._costing.total(vector) for vector in vectors))
        known = [vector for _, vector in among]
        return Data(points, tuple(scalarised(vectors, self._weights, self._costing.limits, known)))

    def look_for_front(
        self,
        simulated: Observed,
        poured: Observed,
        actions: Space,
        query: Callable[[Data, Data], RegressionQuery | PourQuery],
        questions: OptimizerQueries,
        then: Callable[[], None],
    ) -> None:
        """Put a query for each objective at the tried actions; the answers define the front.

        Args:
            query: builds the query of one objective from its simulated and its poured data, without a proposal.
            then: called when the front is known.
        """
        candidates = self._candidates([*simulated, *poured])
        answers: dict[int, Suggestion] = {}

        def answered(j: int, suggestion: Suggestion) -> None:
            answers[j] = suggestion
            if len(answers) == len(self.names):
                self._settle(candidates, [answers[k] for k in sorted(answers)], actions)
                then()

        for j in range(len(self.names)):
            about_one = replace(query(_one(simulated, j), _one(poured, j)), predict_at=tuple(candidates))
            questions.put(about_one, "front", partial(answered, j))

    def _candidates(self, observed: Observed) -> list[Point]:
        """Tried actions that can belong to the front: those that delivered enough."""
        limits = np.array(self._costing.limits) + 1e-9
        return list(dict.fromkeys(point for point, vector in observed if np.all(np.array(vector) <= limits)))

    def _settle(self, candidates: Sequence[Point], answers: Sequence[Suggestion], actions: Space) -> None:
        """Set the front of the candidates, by each objective's posterior mean."""
        if any(len(answer.predictions) != len(candidates) for answer in answers):
            self.front = []  # too few observations for a surrogate
            return
        means = [tuple(max(answer.predictions[i], 0.0) for answer in answers) for i in range(len(candidates))]
        kept = sorted(undominated(means), key=lambda i: means[i])
        self.front = []
        for i in kept:
            values = actions.decode(candidates[i])
            deviations = [answer.prediction_deviations[i] for answer in answers]
            self.front.append(
                ParetoAction(
                    action=displayed_action(values),
                    action_si=values,
                    objectives=dict(zip(self.names, means[i], strict=True)),
                    deviations=dict(zip(self.names, deviations, strict=True)),
                )
            )


def _one(observed: Observed, index: int) -> Data:
    """Data of a single objective."""
    return Data(tuple(point for point, _ in observed), tuple(vector[index] for _, vector in observed))
