"""Experimental design for calibration: the pour that reduces the uncertainty of predictions most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.covariance import matern
from actors.optimizer.gaussian_process import GaussianProcess
from actors.optimizer.theta_posterior import DISCREPANCY_LENGTH

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WeighedDesign:
    """Weighed pours.

    Attributes:
        contexts: (n, c).
        offsets: (n,) weighed spillage minus the spillage with which the surrogate's differences were formed.
        noise: standard deviation of a weighed pour around its mean.
    """

    contexts: Array
    offsets: Array
    noise: float


def expected_reductions(
    process: GaussianProcess, thetas: Array, lacks: Array, weighed: WeighedDesign, candidates: Array, targets: Array
) -> tuple[Array, float]:
    """Expected reductions of the variance of predictions by weighing one more pour.

    Given θ, weighed minus simulated spillage at a context is Gaussian: e ~ N(0, S + σ_δ² M), as in the posterior. Its
    mean and variance v(c) near the earlier pours are conditional on them. Over equally likely θ, the expected value at
    c (corrected by this mean) and the simulated value at t have the covariance C(c, t). To second order in these
    moments, weighing c reduces the variance at t, independent of the outcome, by

        C(c, t)² / (C(c, c) + v(c) + n²).

    A pour therefore has a low value if all θ agree on it, if it was already made, if the surrogate is uncertain there,
    or if it is unrelated to the targets. The surrogate's own uncertainty at targets is left out, because targets can be
    simulated.

    Args:
        process: of signed differences (to zero: minus the simulated spillage) over (θ, context).
        thetas: (J, dimension) draws, in the unit cube.
        lacks: (J,) σ_δ of each.
        weighed: the pours made so far.
        candidates: (M, c) contexts at which a pour could be weighed.
        targets: (T, c) contexts that are to be predicted.

    Returns:
        (M,) reductions, averaged over the targets, and the current variance due to θ, averaged over the targets.

    Source: Cohn, Neural network exploration using optimal experiment design, 1996 (expected reduction of variance);
    linear Bayes: Goldstein & Wooff, Bayes Linear Statistics, 2007.
    Limitations: Gaussian to second order; the effect of a pour on a bend of the response enters only through the mean.
    """
    n, m = len(weighed.contexts), len(candidates)
    poured = np.concatenate([weighed.contexts, candidates])
    contexts = np.concatenate([poured, targets])
    unit = np.full((len(poured), thetas.shape[1]), 0.5)
    prior = process.prior_covariance(np.concatenate([unit, poured], axis=1))
    lack = matern(poured, poured, np.full(poured.shape[1], DISCREPANCY_LENGTH))[0]
    scatter = weighed.noise**2 + process.noise**2 + 1e-10
    rows, rest = [], np.zeros(m)
    for theta, deviation in zip(thetas, lacks, strict=True):
        means, V = process.projected(np.concatenate([np.tile(theta, (len(contexts), 1)), contexts], axis=1))
        near = V[:, : n + m]
        R = prior - near.T @ near + deviation**2 * lack
        weights = np.linalg.solve(R[:n, :n] + scatter * np.eye(n), R[:n, n:])  # (n, m)
        corrected = weights.T @ (means[:n] + weighed.offsets) - means[n : n + m]
        rows.append(np.concatenate([corrected, -means[n + m :]]))
        rest += np.maximum(np.diag(R[n:, n:]) - (R[:n, n:] * weights).sum(axis=0), 0.0)
    f = np.array(rows)
    f = f - f.mean(axis=0)
    C = f.T @ f / len(thetas)
    variances = np.diag(C)
    reductions = C[:m, m:] ** 2 / (variances[:m] + rest / len(thetas) + scatter)[:, None]
    return reductions.mean(axis=1), float(variances[m:].mean())
