"""A surrogate cut through every two of its axes, for pictures of spaces with more than two."""

from __future__ import annotations

import itertools

import numpy as np
from threadpoolctl import threadpool_limits

from actors.optimizer.core.asked import Asked
from actors.optimizer.core.describe import mapped
from actors.optimizer.core.models import fit
from actors.optimizer.core.problem import Suggestion, SuggestProblem, SurrogateMap

MOST_AXES = 4


def slices(problem: SuggestProblem, suggestion: Suggestion, resolution: int = 15) -> tuple[SurrogateMap, ...]:
    """The surrogate over every two of its axes, the others held where `suggestion.surrogate` holds them.

    Of more than `MOST_AXES` axes those with the shortest lengthscales are taken.

    Args:
        problem: that was put to the optimiser.
        suggestion: its answer, with a surrogate.
        resolution: places along an axis.

    Returns:
        Pairs in the space's order: (0, 1), (0, 2) … ; empty for a space of two axes.

    Limitations: answers carry one map only, since they are journalled; here the surrogate is fitted once more, which
    costs what it cost the first time, and gives the same but for the last bits on another machine.
    """
    if suggestion.surrogate is None or problem.space.dimension <= 2:
        return ()
    with threadpool_limits(1):
        asked = Asked.of(problem)
        model = fit(problem, asked)
        if model is None:
            return ()
        axes = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:MOST_AXES])
        at = np.array(suggestion.surrogate.at)
        return tuple(
            mapped(problem, asked.region, model, at, pair, resolution) for pair in itertools.combinations(axes, 2)
        )
