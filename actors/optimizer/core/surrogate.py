"""Gaussian-process surrogates of a noisy cost on the unit cube: fitted by MAP, bounded, always finite.

The kernels and the marginal likelihood are scikit-learn's; the priors over hyperparameters, the prior means and the
noise-free predictions are ours.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import ndtr
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Kernel, Matern, WhiteKernel

Array = NDArray[np.float64]


class Surrogate(Protocol):
    """What an acquisition needs to know of a model of the cost."""

    def predict(self, points: Array) -> tuple[Array, Array]:
        """Posterior mean and standard deviation of the noise-free cost.

        Args:
            points: (m, dimension), in the unit cube.

        Returns:
            Means (m,) and deviations (m,), in the cost's unit.
        """
        ...


@dataclass(frozen=True)
class HyperPrior:
    """Log-normal priors over the hyperparameters, in units of the cube (lengths) and of the cost's scale (the others).

    Each pair is (median, standard deviation of the logarithm). With few observations the maximum of the likelihood
    alone is unreliable: on a plateau its lengthscales grow without bound and the model claims to know everything.

    Attributes:
        length: of each axis' lengthscale.
        signal: of the signal's standard deviation.
        noise: of the observations' standard deviation.
    """

    length: tuple[float, float] = (0.35, 0.7)
    signal: tuple[float, float] = (1.0, 0.5)
    noise: tuple[float, float] = (0.1, 1.0)


LENGTH_BOUNDS = (0.03, 5.0)
SIGNAL_BOUNDS = (0.05, 6.0)
NOISE_BOUNDS = (1e-3, 3.0)

CONSTANT_PRIOR = HyperPrior()
RESIDUAL_PRIOR = HyperPrior(signal=(0.4, 0.7), noise=(0.07, 1.0))
"""Of what reality adds to the simulation: smaller than the cost itself, but free to be as large."""


class SimulatedCovariance(Kernel):  # type: ignore[misc]
    """Posterior covariance of a fitted surrogate, as a prior covariance without free hyperparameters.

    In units of `scale`². It says how little the simulated surrogate itself knows where few simulations were run.
    """

    def __init__(self, process: GaussianProcess, scale: float) -> None:
        self.process = process
        self.scale = scale
        self._last: tuple[Array, Array] | None = None

    def __call__(self, X: Array, Y: Array | None = None, eval_gradient: bool = False) -> Any:
        """Covariances (m, k) between points (m, dimension) and (k, dimension); as scikit-learn wants it."""
        if Y is None and self._last is not None and self._last[0] is X:
            K = self._last[1]  # a fit asks for the same matrix again and again
        else:
            K = self.process.covariance(X, X if Y is None else Y) / self.scale**2
            if Y is None:
                self._last = (X, K)
        return (K, np.empty((len(X), len(X), 0))) if eval_gradient else K

    def diag(self, X: Array) -> Array:
        """Posterior variances (m,)."""
        deviation = self.process.predict(np.asarray(X))[1]
        return (deviation / self.scale) ** 2

    def is_stationary(self) -> bool:
        """It depends on where the simulations were run."""
        return False


class GaussianProcess:
    """GP regression with Matérn 5/2 ARD kernel, fitted noise and a given prior mean; hyperparameters by MAP.

    Attributes:
        points: (n, dimension) of the observations.
        lengths: (dimension,) fitted lengthscales.
        signal: fitted standard deviation of the signal, in the cost's unit.
        noise: fitted standard deviation of the observations, in the cost's unit.

    Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, chapters 2 and 5.
    """

    def __init__(
        self,
        points: Array,
        costs: Array,
        *,
        mean: Callable[[Array], Array],
        scale: float,
        prior: HyperPrior = CONSTANT_PRIOR,
        covariance: Kernel | None = None,
    ) -> None:
        """Fit.

        Args:
            points: (n, dimension), n ≥ 1.
            costs: (n,), finite.
            mean: prior mean of the cost at points (m, dimension) → (m,).
            scale: unit in which the priors are meant, in the cost's unit.
            prior: over hyperparameters.
            covariance: further prior covariance, in units of scale².
        """
        self.points = points
        self.mean = mean
        self.scale = scale
        dimension = points.shape[1]
        signal = ConstantKernel(prior.signal[0] ** 2, tuple(b**2 for b in SIGNAL_BOUNDS)) * Matern(
            np.full(dimension, prior.length[0]), LENGTH_BOUNDS, nu=2.5
        )
        noise = WhiteKernel(prior.noise[0] ** 2, tuple(b**2 for b in NOISE_BOUNDS))
        regressor = GaussianProcessRegressor(
            signal + noise if covariance is None else covariance + signal + noise,
            alpha=1e-8,
            optimizer=_maximum_a_posteriori(prior, dimension),
            copy_X_train=False,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # an optimum at a bound is what the bounds are for
            regressor.fit(points, (costs - mean(points)) / scale)
        summed = regressor.kernel_
        self._kernel = summed.k1
        matern = self._kernel if covariance is None else self._kernel.k2
        self.lengths: Array = np.atleast_1d(matern.k2.length_scale)
        self.signal = math.sqrt(matern.k1.constant_value) * scale
        self.noise = math.sqrt(summed.k2.noise_level) * scale
        self._L: Array = regressor.L_
        self._alpha: Array = regressor.alpha_.ravel()

    def __deepcopy__(self, memo: dict[int, Any]) -> GaussianProcess:
        return self  # never changed after the fit; scikit-learn copies what kernels hold

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`. The deviation leaves the observations' noise out."""
        K = self._kernel(points, self.points)
        V = solve_triangular(self._L, K.T, lower=True, check_finite=False)
        variance = self._kernel.diag(points) - np.einsum("ij,ij->j", V, V)
        return self.mean(points) + self.scale * (K @ self._alpha), self.scale * np.sqrt(np.maximum(variance, 1e-12))

    def covariance(self, first: Array, second: Array) -> Array:
        """Posterior covariance of the noise-free cost between points (m, d) and (k, d): (m, k), in its unit squared."""
        V = solve_triangular(self._L, self._kernel(first, self.points).T, lower=True, check_finite=False)
        W = V if second is first else solve_triangular(self._L, self._kernel(second, self.points).T, lower=True)
        return np.asarray(self.scale**2 * (self._kernel(first, second) - V.T @ W))


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


def constant_mean_process(points: Array, costs: Array) -> GaussianProcess:
    """GP whose prior mean is the mean of the data: (n, dimension), (n,)."""
    centre = float(costs.mean())
    return GaussianProcess(points, costs, mean=_constant(centre), scale=_scale(costs - centre, costs))


def zero_mean_process(points: Array, costs: Array) -> GaussianProcess:
    """GP with prior mean zero, as in the paper: unexplored means 'spills nothing'.

    Limitations: on a cost in [0, 1] that is minimised by a lower confidence bound, it explores corners for ever and
    loses to random search. For replication.
    """
    return GaussianProcess(points, costs, mean=_constant(0.0), scale=_scale(costs, costs))


def simulated_mean_process(simulated: GaussianProcess, points: Array, costs: Array) -> GaussianProcess:
    """GP of the real cost around a surrogate of the simulated one: f_r = f_s + δ, f_s ~ `simulated`'s posterior.

    The prior mean is the simulated surrogate's posterior mean, the prior covariance its posterior covariance plus that
    of δ, so that a pour also corrects the surrogate where too few simulations were run.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D3); Kennedy & O'Hagan 2000 with ρ = 1.
    """
    scale = max(simulated.scale, 1e-9)
    return GaussianProcess(
        points,
        costs,
        mean=lambda x: simulated.predict(x)[0],
        scale=scale,
        prior=RESIDUAL_PRIOR,
        covariance=SimulatedCovariance(simulated, scale),
    )


def _constant(value: float) -> Callable[[Array], Array]:
    return lambda points: np.full(len(points), value)


def _scale(residuals: Array, costs: Array) -> float:
    """Unit of the priors: the residuals' size, but on a plateau a tenth of the costs', so that doubt remains."""
    size = float(np.sqrt(np.mean(residuals**2)))
    floor = 0.1 * float(np.max(np.abs(costs)))
    return max(size, floor) or 1.0


def _maximum_a_posteriori(prior: HyperPrior, dimension: int) -> Callable[..., tuple[Array, float]]:
    """An `optimizer` for scikit-learn's regressor that adds the log-priors to the log-likelihood.

    scikit-learn's θ is (log σ_f², log ℓ_1 … log ℓ_d, log σ_n²).
    """
    centre = np.log([prior.signal[0] ** 2, *[prior.length[0]] * dimension, prior.noise[0] ** 2])
    deviation = np.array([2 * prior.signal[1], *[prior.length[1]] * dimension, 2 * prior.noise[1]])

    def optimise(objective: Callable[..., tuple[float, Array]], initial: Array, bounds: Any) -> tuple[Array, float]:
        def loss(theta: Array) -> tuple[float, Array]:
            value, gradient = objective(theta, eval_gradient=True)
            z = (theta - centre) / deviation
            if not (math.isfinite(value) and np.all(np.isfinite(gradient))):
                return 1e12 + 0.5 * float(z @ z), z / deviation  # not positive definite: back towards the prior
            return value + 0.5 * float(z @ z), gradient + z / deviation

        noisy = np.clip(centre + np.array([0.0, *[0.5] * dimension, 3.0]), bounds[:, 0], bounds[:, 1])
        best: Any = np.clip(centre, bounds[:, 0], bounds[:, 1])
        lowest = math.inf
        for start in (best, noisy):
            found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 40})
            if math.isfinite(found.fun) and found.fun < lowest:
                best, lowest = found.x, float(found.fun)
        return best, lowest

    return optimise
