"""Gaussian-process surrogates of a noisy cost on the unit cube: fitted by MAP, bounded, always finite.

`GaussianProcess` is the fitted model. `maximum_a_posteriori` fits its hyperparameters: likelihood, log-priors, their
gradient, and a bounded search. The functions `..._process` build the surrogates for the different prior means.
Kernels are in `covariance`, intervals of single observations in `prediction_intervals`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular
from scipy.optimize import minimize

from actors.optimizer.covariance import Covariance, HyperPrior

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


def maximum_a_posteriori(covariance: Covariance, residuals: Array, starts: Sequence[Array]) -> Fitted:
    """Fit the hyperparameters.

    Args:
        covariance: of the observations.
        residuals: (n,), costs less their prior mean, in units of the scale.
        starts: of the search, (p,) each, at least one.

    Raises:
        ValueError: no start gave a covariance that can be factorised.

    Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, chapter 5.
    """
    bounds: Any = covariance.bounds

    # −log p(θ | y) = −log p(y | θ) + ½ |z|² + const, z = (θ − centre) / deviation: normal priors of the logarithms.
    def loss(theta: Array) -> tuple[float, Array]:
        z = (theta - covariance.centre) / covariance.deviation
        value, gradient = negative_log_likelihood(covariance, residuals, theta)
        return value + 0.5 * float(z @ z), gradient + z / covariance.deviation

    best, lowest = np.clip(covariance.centre, bounds[:, 0], bounds[:, 1]), math.inf
    for start in starts:
        minimum: Any = minimize(
            loss,
            np.clip(start, bounds[:, 0], bounds[:, 1]),
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": ITERATIONS, "ftol": 1e-6, "gtol": 1e-3},
        )
        if math.isfinite(minimum.fun) and minimum.fun < lowest:
            best, lowest = minimum.x, float(minimum.fun)
    K, _ = covariance.observed(best)
    L, trouble = lapack.dpotrf(K, lower=1)
    if trouble:
        raise ValueError(f"{len(residuals)} observations give no covariance that can be factorised")
    alpha = lapack.dpotrs(L, residuals, lower=1)[0].ravel()
    return Fitted(best, L, alpha, -_value(L, alpha, residuals))


def negative_log_likelihood(covariance: Covariance, residuals: Array, theta: Array) -> tuple[float, Array]:
    """−log p of residuals (n,) at hyperparameters θ (p,), and its gradient (p,)."""
    # K = L Lᵀ, α = K⁻¹ r (Rasmussen & Williams, algorithm 2.1), and by their equation 5.9
    #     −∂ log p/∂θ = ½ tr((K⁻¹ − α αᵀ) ∂K/∂θ), the pullback of ½ (K⁻¹ − α αᵀ)
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
    # −log p = ½ rᵀ K⁻¹ r + ½ log |K| + n/2 log 2π (Rasmussen & Williams, equation 2.30), ½ log |K| = Σ log L_ii
    return 0.5 * float(residuals @ alpha) + float(np.log(np.diagonal(L)).sum()) + 0.5 * len(L) * math.log(2 * math.pi)


Mean = Callable[[Array], Array]


class Surrogate(Protocol):
    """The interface of a cost model that acquisition functions use."""

    def predict(self, points: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation of the noise-free cost.

        Args:
            points: (m, dimension), in the unit cube.

        Returns:
            Means (m,) and deviations (m,), in the cost's unit.
        """
        ...


CONSTANT_PRIOR = HyperPrior()
OBLIQUE_PRIOR = HyperPrior(length=(0.25, 0.5), shear=(0.0, 0.5))
"""For a simulated valley, which is oblique to the axes: a faster pour reaches farther. With lengthscales along the axes
alone, the valley would be known only next to the simulations in it."""

RESIDUAL_PRIOR = HyperPrior(signal=(0.4, 0.7), noise=(0.07, 1.0))
"""Prior of the difference between reality and simulation: smaller than the cost itself, but free to be as large."""

SMALLEST_SCALE = 1e-60
"""Smallest unit of costs; fourth powers of a smaller one (products of covariances) leave the range of floats."""


class GaussianProcess:
    """GP regression with Matérn 5/2 ARD kernel, fitted noise and a given prior mean; hyperparameters by MAP.

    Attributes:
        points: (n, dimension) of the observations.
        lengths: (dimension,) fitted lengthscales.
        signal: fitted standard deviation of the signal, in the cost's unit.
        noise: fitted standard deviation of the observations, in the cost's unit.
        evidence: difference of the log-likelihood to that of pure noise around the prior mean.
        residuals: (n,) costs less their prior mean, in units of `scale`.
        covariance_terms: prior covariance, as a function of the hyperparameters.
        estimated_mean: whether the prior mean is an estimate from the same costs.

    Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, chapters 2 and 5.
    """

    def __init__(
        self, costs: Array, covariance: Covariance, *, mean: Mean, scale: float, estimated_mean: bool = False
    ) -> None:
        """Fit.

        Args:
            costs: (n,), finite, n ≥ 1.
            covariance: of the observations, in units of scale².
            mean: prior mean of the cost at points (m, dimension) → (m,).
            scale: unit of the priors, in the cost's unit.
            estimated_mean: see the attribute.
        """
        self.points, self.mean, self.scale = covariance.points, mean, scale
        noisy = covariance.centre.copy()  # longer lengthscales and more noise
        noisy[[i for i, name in enumerate(covariance.names) if name in ("length", "noise")]] += 0.5
        noisy[covariance.names.index("noise")] += 1.0
        residuals = (costs - mean(self.points)) / scale
        self.residuals, self.estimated_mean = residuals, estimated_mean
        fitted = maximum_a_posteriori(covariance, residuals, [covariance.centre, noisy])
        self.covariance_terms, self._fitted = covariance, fitted
        theta = fitted.theta
        self.lengths: Array = covariance.lengths(theta)
        self.signal = covariance.value(theta, "signal") * scale
        self.noise = covariance.value(theta, "noise") * scale
        self.log_likelihood = fitted.log_likelihood
        self.evidence = fitted.log_likelihood - _of_noise_alone(residuals)
        self.theta = theta

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`. The deviation excludes the observations' noise."""
        # m(x) = m₀(x) + k(x)ᵀ K⁻¹ r and s²(x) = k(x, x) − |V|², V = L⁻¹ k(x): Rasmussen & Williams, equations 2.38
        # and 2.26; r and k are in units of `scale` and its square.
        K = self.covariance_terms.cross(self._fitted.theta, points)
        V = solve_triangular(self._fitted.L, K.T, lower=True, check_finite=False)
        prior = self.covariance_terms.variance(self._fitted.theta, points)
        variance = prior - np.einsum("ij,ij->j", V, V)
        mean = self.mean(points) + self.scale * (K @ self._fitted.alpha)
        return mean, self.scale * np.sqrt(np.maximum(variance, 1e-12))

    def projected(self, points: Array) -> tuple[Array, Array]:
        """Parts of the posterior moments at points (m, d): means (m,), and V (n, m). The posterior covariance is
        `prior_covariance` − Vᵀ V, in the cost's unit (squared).
        """
        K = self.cross(points)
        return self.expected(points, K), self.explained(K)

    def cross(self, points: Array) -> Array:
        """Prior covariances of the cost at points (m, d) with the observations: (m, n), in units of `scale`²."""
        return self.covariance_terms.cross(self._fitted.theta, points)

    def expected(self, points: Array, cross: Array) -> Array:
        """Posterior means (m,) at points (m, d) from their `cross` (m, n)."""
        return np.asarray(self.mean(points) + self.scale * (cross @ self._fitted.alpha))

    def explained(self, cross: Array) -> Array:
        """V (n, m) of rows of `cross`, or of weighted sums of them (m, n): VᵀV is the covariance that the observations
        explain, in the cost's unit squared.
        """
        return np.asarray(self.scale * solve_triangular(self._fitted.L, cross.T, lower=True, check_finite=False))

    def prior_covariance(self, points: Array) -> Array:
        """Covariance of the noise-free cost between points (m, d): (m, m), in its unit squared."""
        return np.asarray(self.scale**2 * self.covariance_terms.between(self._fitted.theta, points, points))

    def noise_at(self, points: Array) -> Array:
        """Standard deviations of single real observations at points (m, dimension): (m,), in the cost's unit."""
        return np.full(len(points), self.noise)

    def covariance(self, first: Array, second: Array) -> Array:
        """Posterior covariance of the noise-free cost between points (m, d) and (k, d): (m, k), in its unit squared."""
        # cov(f, f′) = k(x, x′) − k(x)ᵀ K⁻¹ k(x′) = k − Vᵀ W (Rasmussen & Williams, equation 2.24)
        theta, L = self._fitted.theta, self._fitted.L
        V = solve_triangular(L, self.covariance_terms.cross(theta, first).T, lower=True, check_finite=False)
        W = V
        if second is not first:
            W = solve_triangular(L, self.covariance_terms.cross(theta, second).T, lower=True, check_finite=False)
        return np.asarray(self.scale**2 * (self.covariance_terms.between(theta, first, second) - V.T @ W))


def constant_mean_process(points: Array, costs: Array, *, prior: HyperPrior = CONSTANT_PRIOR) -> GaussianProcess:
    """GP whose prior mean is the mean of the data: (n, dimension), (n,)."""
    centre = float(costs.mean())
    mean, scale = _constant(centre), _scale(costs - centre, costs)
    return GaussianProcess(costs, Covariance(points, prior), mean=mean, scale=scale, estimated_mean=True)


def zero_mean_process(points: Array, costs: Array) -> GaussianProcess:
    """GP with prior mean zero, as in the paper: unexplored regions are expected to spill nothing.

    Limitations: for a cost in [0, 1] that is minimised by a lower confidence bound, it explores corners indefinitely
    and is worse than random search. For replication.
    """
    return GaussianProcess(costs, Covariance(points, CONSTANT_PRIOR), mean=_constant(0.0), scale=_scale(costs, costs))


def simulated_mean_process(simulated: GaussianProcess, points: Array, costs: Array) -> GaussianProcess:
    """GP of the real cost around a surrogate of the simulated one: f_r = f_s + δ, f_s ~ `simulated`'s posterior.

    The prior mean is the simulated surrogate's posterior mean. The prior covariance is its posterior covariance plus
    that of δ, so that a pour also corrects the surrogate where too few simulations were run.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3); Kennedy & O'Hagan 2000 with ρ = 1.
    """
    scale = max(simulated.scale, 1e-9)
    covariance = Covariance(points, RESIDUAL_PRIOR, known=simulated, unit=scale)
    return GaussianProcess(costs, covariance, mean=lambda x: simulated.predict(x)[0], scale=scale)


def _of_noise_alone(residuals: Array) -> float:
    """Log-likelihood of residuals (n,) as independent normal noise with the best-fitting deviation."""
    # max over v of Σ log N(r_i; 0, v) = −n/2 (log 2πv + 1) at v = mean r²
    variance = max(float(np.mean(residuals**2)), 1e-12)
    return -0.5 * len(residuals) * (math.log(2 * math.pi * variance) + 1.0)


def _constant(value: float) -> Mean:
    return lambda points: np.full(len(points), value)


def _scale(residuals: Array, costs: Array) -> float:
    """Unit of the priors: the residuals' root mean square, but at least a tenth of the largest cost, so that
    uncertainty remains on a plateau.

    Costs below `SMALLEST_SCALE` count as zero, and zero costs have the unit 1.
    """
    size = float(np.sqrt(np.mean(residuals**2)))
    floor = 0.1 * float(np.max(np.abs(costs)))
    scale = max(size, floor)
    return scale if scale >= SMALLEST_SCALE else 1.0
