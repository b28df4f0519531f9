"""Predictions of spillage without a simulator, to compare a calibrated one with. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence

from actors.optimizer.core.problem import Data, SuggestProblem
from orchestrator.strategies.calibration.contexts import Contexts
from orchestrator.strategies.calibration.design import MeasuredPour


def mean_predictor_discrepancy(train: Sequence[MeasuredPour], test: Sequence[MeasuredPour]) -> float | None:
    """Mean |r − r̄| over the test pours, r̄ the mean of the training pours; None where either is empty."""
    known, wanted = _spillages(train), _spillages(test)
    if not known or not wanted:
        return None
    mean = sum(known) / len(known)
    return sum(abs(r - mean) for r in wanted) / len(wanted)


def regression_discrepancy(
    contexts: Contexts, train: Sequence[MeasuredPour], test: Sequence[MeasuredPour]
) -> float | None:
    """Mean |r − m(a)| over the test pours, m a GP regression of the training pours, clipped to [0, 1].

    Hard to beat inside the scene it was fitted in, and no answer at all for another vessel. None where there
    are fewer than two training pours, or no test pours.
    """
    from actors.optimizer.core.propose import propose

    usable = [pour for pour in train if pour.spillage is not None]
    wanted = [pour for pour in test if pour.spillage is not None and contexts.knows(pour)]
    if len(usable) < 2 or not wanted:
        return None
    data = Data(tuple(contexts.point(pour) for pour in usable), tuple(_spillages(usable)))
    places = tuple(contexts.point(pour) for pour in wanted)
    predictions = propose(SuggestProblem(contexts.space, data, count=0, predict_at=places)).predictions
    errors = [abs(r - min(max(p, 0.0), 1.0)) for r, p in zip(_spillages(wanted), predictions, strict=True)]
    return sum(errors) / len(errors)


def _spillages(pours: Sequence[MeasuredPour]) -> list[float]:
    return [pour.spillage for pour in pours if pour.spillage is not None]
