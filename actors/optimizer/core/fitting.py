"""Hyperparameters by maximum a posteriori: likelihood, log-priors, their gradient, and a bounded search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.optimize import minimize

from actors.optimizer.core.covariance import Covariance

Array = NDArray[np.float64]

_IMPOSSIBLE = 1e12
ITERATIONS = 40


@dataclass(frozen=True)
class Fitted:
    """The best hyperparameters that were found.

    Attributes:
        theta: (p,).
        L: (n, n), lower Cholesky factor of the observations' covariance.
        alpha: (n,), its inverse times the residuals.
        log_likelihood: of the residuals, without the priors.
    """

    theta: Array
    L: Array
    alpha: Array
    log_likelihood: float


def maximum_a_posteriori(
    covariance: Covariance, residuals: Array, starts: Sequence[Array], iterations: int = ITERATIONS
) -> Fitted:
    """Fit.

    Args:
        covariance: of the observations.
        residuals: (n,), costs less their prior mean, in units of the scale.
        starts: of the search, (p,) each, at least one.
        iterations: of the search from each; 0 takes the first start as it is.

    Raises:
        ValueError: no start gave a covariance that can be factorised.

    Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, chapter 5.
    """
    bounds: Any = covariance.bounds

    def loss(theta: Array) -> tuple[float, Array]:
        z = (theta - covariance.centre) / covariance.deviation
        value, gradient = negative_log_likelihood(covariance, residuals, theta)
        return value + 0.5 * float(z @ z), gradient + z / covariance.deviation

    best, lowest = np.clip(starts[0] if iterations == 0 else covariance.centre, bounds[:, 0], bounds[:, 1]), math.inf
    for start in starts if iterations else ():
        found: Any = minimize(
            loss,
            np.clip(start, bounds[:, 0], bounds[:, 1]),
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": iterations, "ftol": 1e-6, "gtol": 1e-3},
        )
        if math.isfinite(found.fun) and found.fun < lowest:
            best, lowest = found.x, float(found.fun)
    K, _ = covariance.observed(best)
    L, trouble = lapack.dpotrf(K, lower=1)
    if trouble:
        raise ValueError(f"{len(residuals)} observations give no covariance that can be factorised")
    alpha = lapack.dpotrs(L, residuals, lower=1)[0].ravel()
    return Fitted(best, L, alpha, -_value(L, alpha, residuals))


def negative_log_likelihood(covariance: Covariance, residuals: Array, theta: Array) -> tuple[float, Array]:
    """−log p of residuals (n,) at hyperparameters θ (p,), and its gradient (p,)."""
    K, pullback = covariance.observed(theta)
    L, trouble = lapack.dpotrf(K, lower=1)
    if trouble:
        return _IMPOSSIBLE, np.zeros(len(theta))  # not positive definite: back towards the prior
    alpha = lapack.dpotrs(L, residuals, lower=1)[0].ravel()
    inverse = lapack.dpotri(L, lower=1)[0]
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    value, gradient = _value(L, alpha, residuals), 0.5 * pullback(inverse - np.outer(alpha, alpha))
    if not (math.isfinite(value) and np.all(np.isfinite(gradient))):
        return _IMPOSSIBLE, np.zeros(len(theta))
    return value, gradient


def _value(L: Array, alpha: Array, residuals: Array) -> float:
    return 0.5 * float(residuals @ alpha) + float(np.log(np.diagonal(L)).sum()) + 0.5 * len(L) * math.log(2 * math.pi)
