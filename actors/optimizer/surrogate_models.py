"""The surrogate models of the questions: `fit` returns the fitted `Model` of a question.

`AbsoluteProcess` is the mean absolute value of a signed surrogate over a context that is not searched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer.gaussian_process import (
    AFRESH,
    GaussianProcess,
    HyperparameterSearch,
    Surrogate,
    constant_mean_process,
    joint_process,
    simulated_mean_process,
    zero_mean_process,
)
from actors.optimizer.model_discrepancy import ModelAveragedProcess
from actors.optimizer.question_checks import Asked, array
from actors.optimizer.questions import SuggestProblem
from actors.optimizer.risk_measures import RiskProcess

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AbsoluteProcess:
    """A surrogate of the mean absolute value over a context, of a signed quantity: 1/J Σ_j |f(x, z_j)|.

    |f| of a normal f is folded normal. The deviation is the mean of the contexts' deviations of |f|, as if their errors
    were fully correlated: an upper bound.

    Source: moments of the folded normal distribution (Leone, Nelson & Nottingham, 1961).
    """

    process: GaussianProcess
    context: Array

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`."""
        m, J = len(points), len(self.context)
        joint = np.concatenate([np.repeat(points, J, axis=0), np.tile(self.context, (m, 1))], axis=1)
        mean, deviation = (values.reshape(m, J) for values in self.process.predict(joint))
        ratio = mean / deviation
        folded = deviation * math.sqrt(2 / math.pi) * np.exp(-0.5 * ratio**2) + mean * (2 * ndtr(ratio) - 1)
        spread = np.sqrt(np.maximum(mean**2 + deviation**2 - folded**2, 0.0))
        return folded.mean(axis=1), np.maximum(spread.mean(axis=1), 1e-9 * self.process.scale)


@dataclass(frozen=True)
class Model:
    """A fitted surrogate.

    Attributes:
        surrogate: of the minimised quantity.
        process: with the observations in it; for an average over hypotheses, of the simulations only.
        lengths: (dimension,) lengthscales of the searched axes. Around a simulated mean they are the simulations',
            because a few pours do not determine those of the remainder.
        fitted: all fitted processes, in order.
    """

    surrogate: Surrogate
    process: GaussianProcess
    lengths: Array
    fitted: tuple[GaussianProcess, ...]
    averaged: ModelAveragedProcess | None = None

    def noise_at(self, points: Array) -> Array:
        """Standard deviations (m,) of single real observations at points (m, dimension), in the cost's unit."""
        return (self.averaged or self.process).noise_at(points)


def fit(problem: SuggestProblem, asked: Asked) -> Model | None:
    """Fit the surrogate of the problem; None with too few observations."""
    points, costs = asked.points, asked.costs
    informed = problem.mean in ("simulated", "scaled", "adaptive") and len(asked.simulated) >= 2
    varying = problem.noise == "varying"
    first = _search_for(problem, 0)
    if informed and problem.mean == "simulated":
        simulated = constant_mean_process(asked.simulated, asked.simulated_costs, search=first)
        if not len(points):
            return Model(simulated, simulated, simulated.lengths, (simulated,))
        second = _search_for(problem, 1)
        process = simulated_mean_process(simulated, points, costs, varying=varying, search=second)
        return Model(process, process, simulated.lengths, (simulated, process))
    if informed and problem.mismatch is not None:
        simulated = constant_mean_process(asked.simulated, asked.simulated_costs, search=first)
        averaged = ModelAveragedProcess(simulated, points, costs, problem.mismatch)
        return Model(averaged, simulated, simulated.lengths, (simulated,), averaged)
    if informed:
        process = joint_process(
            asked.simulated,
            asked.simulated_costs,
            points,
            costs,
            varying=varying,
            search=first,
        )
        return Model(process, process, process.lengths, (process,))
    if len(points) < 2:
        return None
    build = zero_mean_process if problem.mean == "zero" else constant_mean_process
    process = build(points, costs, varying=varying, search=first)
    dimension = problem.space.dimension
    if problem.risk is not None:
        return Model(RiskProcess.of(process, problem.risk), process, process.lengths[:dimension], (process,))
    if problem.context:
        context = array(problem.context, points.shape[1] - dimension)
        return Model(AbsoluteProcess(process, context), process, process.lengths[:dimension], (process,))
    return Model(process, process, process.lengths, (process,))


def _search_for(problem: SuggestProblem, number: int) -> HyperparameterSearch:
    """Hyperparameter search of the `number`-th process."""
    effort = problem.effort
    if effort is None or number >= len(effort.start):
        return AFRESH
    return HyperparameterSearch(np.array(effort.start[number], dtype=np.float64), effort.iterations)
