"""Predictions of spillage without a simulator, to compare a calibrated one with. Pure functions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from orchestrator.plan import MeasuredPour
from orchestrator.strategies.calibration.contexts import Contexts


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

    scikit-learn's, and not ours: what the simulator is compared with should owe nothing to it. Matérn 5/2 with a
    lengthscale for each dimension, and fitted noise. Hard to beat inside the scene it was fitted in, and no answer at
    all for another vessel. None where there are fewer than two training pours, or no test pours.
    """
    usable = [pour for pour in train if pour.spillage is not None]
    wanted = [pour for pour in test if pour.spillage is not None and contexts.knows(pour)]
    if len(usable) < 2 or not wanted:
        return None
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    points = [contexts.point(pour) for pour in usable]
    lengths = Matern(length_scale=[0.5] * len(points[0]), length_scale_bounds=(0.03, 10.0), nu=2.5)
    kernel = ConstantKernel(1.0, (0.05, 50.0)) * lengths + WhiteKernel(0.01, (1e-6, 1.0))
    model = GaussianProcessRegressor(kernel, normalize_y=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a dimension that hardly matters has a length at its bound
        model.fit(points, _spillages(usable))
    predictions = model.predict([contexts.point(pour) for pour in wanted])
    errors = [abs(r - min(max(float(p), 0.0), 1.0)) for r, p in zip(_spillages(wanted), predictions, strict=True)]
    return sum(errors) / len(errors)


def _spillages(pours: Sequence[MeasuredPour]) -> list[float]:
    return [pour.spillage for pour in pours if pour.spillage is not None]
