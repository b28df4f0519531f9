"""Intervals that contain a single observation of a surrogate's cost with a given probability.

`observation_intervals` is for a fitted `GaussianProcess`, `highest_density_intervals` for any mixture of normals.

The deviations of `GaussianProcess.predict` belong to one set of hyperparameters, the most likely one. With ten
observations many others explain them as well, some with shorter lengthscales or more noise, and intervals from these
deviations contain too few observations, most of all at corners. Here the prediction is averaged over the posterior of
the hyperparameters, and the constant prior mean is uncertain as well. Decisions use `predict`; the intervals are for
the user.

Source: averaging over hyperparameters: Rasmussen & Williams, Gaussian Processes for Machine Learning, section 5.2, and
BoTorch's fully Bayesian models (Eriksson & Jankowiak, High-dimensional Bayesian optimization with sparse axis-aligned
subspaces, UAI 2021), which draw with a Markov chain. Too narrow plug-in intervals and leave-one-out coverage: Acharki,
Bertoncello & Garnier, Robust prediction interval estimation for Gaussian processes by cross-validation method, 2023.
Uncertain mean: section 2.7 of Rasmussen & Williams. Coverage on recorded transfers: docs/evidence/recordings.md.

Limitations: kernel and priors are those of the surrogate. A cost that is larger at a corner than all observations
suggest stays outside.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular
from scipy.special import gammaincinv, gammaln, ndtr, ndtri
from scipy.stats import qmc

from actors.optimizer.covariance import Covariance
from actors.optimizer.gaussian_process import GaussianProcess, negative_log_likelihood

Array = NDArray[np.float64]

MEAN_DEVIATION = 1.0
"""Standard deviation of an estimated constant prior mean, in units of the costs' scale: the costs' own deviation."""

DRAWS = 128
"""Number of drawn hyperparameters."""

FROM_PRIOR = DRAWS // 4
"""Number of draws from the prior, which reach other modes than the one that was found."""

TAILS = 4.0
"""Degrees of freedom of the t distribution around the most likely hyperparameters."""

NEGLIGIBLE = 1e-4
"""Weight, relative to the largest, below which a draw is left out."""

STEP = 1e-3
"""Step of the finite differences, in prior standard deviations."""

WIDEST = 9.0
"""No probability lies farther from the mean of a normal distribution, in standard deviations."""


def observation_intervals(process: GaussianProcess, points: Array, level: float) -> Array:
    """Shortest intervals (m, 2) of single real observations at points (m, dimension), averaged over hyperparameters.

    Costs are not negative: if 0 is a likely one, the interval begins there.

    Args:
        process: fitted; its hyperparameters are the centre of the draws.
        points: in the unit cube.
        level: probability, between 0 and 1.
    """
    covariance = process.covariance_terms
    if process.estimated_mean:
        covariance = covariance.with_uncertain_mean(MEAN_DEVIATION)
    prior_mean = process.mean(points)
    log_weights, means, deviations = [], [], []
    # p(y | data) ≈ Σ_k w_k N(m_k, s_k² + n_k²), w_k ∝ p(data | θ_k) p(θ_k) / q(θ_k): importance sampling of the
    # integral over θ (Rasmussen & Williams, section 5.2); moments as in `GaussianProcess.predict`.
    for theta, log_ratio in zip(*_proposed(covariance, process.residuals, process.theta), strict=True):
        K, _ = covariance.observed(theta)
        L, trouble = lapack.dpotrf(K, lower=1)
        if trouble:
            continue
        alpha = lapack.dpotrs(L, process.residuals, lower=1)[0].ravel()
        cross = covariance.cross(theta, points)
        V = solve_triangular(L, cross.T, lower=True, check_finite=False)
        variance = np.maximum(covariance.variance(theta, points) - np.einsum("ij,ij->j", V, V), 1e-12)
        likelihood = -0.5 * float(process.residuals @ alpha) - float(np.log(np.diagonal(L)).sum())
        log_weights.append(likelihood + log_ratio)
        means.append(prior_mean + process.scale * (cross @ alpha))
        deviations.append(process.scale * np.sqrt(variance + covariance.value(theta, "noise") ** 2))
    weights = np.exp(np.array(log_weights) - max(log_weights))
    relevant = weights > NEGLIGIBLE
    mixture = weights[relevant] / weights[relevant].sum(), np.array(means)[relevant], np.array(deviations)[relevant]
    return highest_density_intervals(*mixture, level, largest=math.inf)


def _proposed(covariance: Covariance, residuals: Array, best: Array) -> tuple[Array, Array]:
    """Hyperparameters (k, p) within their bounds, and log prior − log proposal (k,): importance sampling.

    Three in four come from a t distribution around the most likely ones, as wide as the curvature of the posterior
    says, the others from the prior. A Sobol sequence makes the same draws for the same question.

    Source: Laplace approximation with heavy tails and a defensive mixture (Owen & Zhou, Safe and effective importance
    sampling, JASA 2000).
    """
    # In prior deviations z; H = axes diag(values) axesᵀ is the posterior's curvature, whose widths are 1/√values.
    p = len(covariance.names)
    z_best = (best - covariance.centre) / covariance.deviation
    values, axes = np.linalg.eigh(_curvature(covariance, residuals, best))
    widths = 1.0 / np.sqrt(np.maximum(values, 1.0))  # never wider than the prior
    rows = qmc.Sobol(p + 1, scramble=True, rng=np.random.default_rng(0)).random(DRAWS)
    rows = np.clip(rows, 1e-6, 1.0 - 1e-6)
    rows[FROM_PRIOR, :p] = 0.5  # the most likely ones themselves, whose covariance can be factorised
    z = ndtri(rows[:, :p])
    # Student t with ν = TAILS: z_best + √(ν/χ²_ν) N(0, H⁻¹), χ²_ν = 2 P⁻¹(ν/2, u)
    chi_squared = 2.0 * gammaincinv(0.5 * TAILS, rows[FROM_PRIOR:, p])
    z[FROM_PRIOR:] = z_best + np.sqrt(TAILS / chi_squared)[:, None] * (z[FROM_PRIOR:] * widths) @ axes.T
    prior = -0.5 * (z**2).sum(axis=1) - 0.5 * p * math.log(2.0 * math.pi)
    # Mixture q = share N(0, 1) + (1 − share) t_ν(z_best, H⁻¹); `prior` and `around` are the logarithms of the two.
    distance = (((z - z_best) @ axes / widths) ** 2).sum(axis=1)
    around = -0.5 * (TAILS + p) * np.log1p(distance / TAILS) - float(np.log(widths).sum())
    around += gammaln(0.5 * (TAILS + p)) - gammaln(0.5 * TAILS) - 0.5 * p * math.log(TAILS * math.pi)
    share = FROM_PRIOR / DRAWS
    proposal = np.logaddexp(math.log(share) + prior, math.log(1.0 - share) + around)
    thetas = covariance.centre + covariance.deviation * z
    low, high = covariance.bounds.T
    inside = np.all((low - 1e-9 <= thetas) & (thetas <= high + 1e-9), axis=1)
    return thetas[inside], (prior - proposal)[inside]


def _curvature(covariance: Covariance, residuals: Array, theta: Array) -> Array:
    """Hessian (p, p) of −log posterior, in prior standard deviations, by differences of the gradient."""
    deviation, p = covariance.deviation, len(theta)
    hessian = np.eye(p)
    # H = 1 (the prior) + ∂g/∂z, g the gradient of −log likelihood by z, by central differences
    for i, step in enumerate(np.diag(STEP * deviation)):
        above, below = (negative_log_likelihood(covariance, residuals, theta + sign * step)[1] for sign in (1.0, -1.0))
        hessian[i] += (above - below) / (2.0 * STEP) * deviation
    return 0.5 * (hessian + hessian.T)


ENDS = 64
"""Number of lower ends that are tried, evenly spaced in the probability below them."""

HALVINGS = 30


def highest_density_intervals(
    weights: Array, means: Array, deviations: Array, level: float, largest: float = 1.0
) -> Array:
    """Shortest intervals (m, 2) of y = clip(z, 0, largest), z of a mixture of normal distributions.

    If y is likely to be 0, the interval begins at 0 and contains no more probability for that. An interval between two
    fixed quantiles would exclude the least likely end only.

    Args:
        weights: (J,), sum 1.
        means, deviations: (J, m).
        level: probability, between 0 and 1.
        largest: possible value; may be infinite.
    """
    # Intervals [F⁻¹(p), F⁻¹(p + level)] for p = 0 … 1 − level: the narrowest one is the highest-density interval of a
    # density with one mode (Box & Tiao 1973, section 2.8; Chen & Shao 1999).
    below = np.linspace(0.0, 1.0 - level, ENDS)
    if math.isinf(largest):
        largest = max(float((means + WIDEST * deviations).max()), 0.0)
    lows = _quantiles(weights, means, deviations, below, largest)
    highs = _quantiles(weights, means, deviations, below + level, largest)
    best = np.argmin(highs - lows, axis=0)
    each = np.arange(means.shape[1])
    return np.stack([lows[best, each], highs[best, each]], axis=1)


def _quantiles(weights: Array, means: Array, deviations: Array, shares: Array, largest: float) -> Array:
    """Quantiles (k, m) for probabilities (k,), by bisection."""
    low, high = np.zeros((len(shares), means.shape[1])), np.full((len(shares), means.shape[1]), largest)
    # Bisection of F(z) = Σ_j w_j Φ((z − m_j) / s_j) = share, to largest / 2^HALVINGS; 0 and `largest` have atoms.
    none = weights @ ndtr(-means / deviations) >= shares[:, None]
    all_of_it = weights @ ndtr((largest - means) / deviations) <= shares[:, None]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        under = np.einsum("j,jkm->km", weights, ndtr((middle - means[:, None, :]) / deviations[:, None, :]))
        low, high = np.where(under < shares[:, None], middle, low), np.where(under < shares[:, None], high, middle)
    return np.where(none, 0.0, np.where(all_of_it, largest, 0.5 * (low + high)))
