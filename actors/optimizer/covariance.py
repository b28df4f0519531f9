"""Prior covariance of observations, with the gradients that a fit needs.

    f ~ GP(0, σ² M_ℓ + k)                   the cost; k: a known covariance, if there is one
    y_i = f + ε_i,  ε_i ~ N(0, n²)

M is the Matérn 5/2 correlation. With a prior for shears, M_ℓ is a function of T x instead of x; T has ones on its
diagonal, and its other elements are fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
Pullback = Callable[[Array], Array]


@dataclass(frozen=True)
class HyperPrior:
    """Priors over the hyperparameters, in units of the cube (lengths) and of the cost's scale (the others).

    Each pair is (median, standard deviation of the logarithm), except for shears (mean, standard deviation). With few
    observations the maximum of the likelihood alone is unreliable: on a plateau the lengthscales grow without bound
    and the model becomes overconfident.

    Attributes:
        length: of each axis' lengthscale.
        shear: of the elements of T beside its diagonal (mean, standard deviation); None: T = 1.
        signal: of the signal's standard deviation.
        noise: of the observations' standard deviation.
    """

    length: tuple[float, float] = (0.35, 0.7)
    shear: tuple[float, float] | None = None
    signal: tuple[float, float] = (1.0, 0.5)
    noise: tuple[float, float] = (0.1, 1.0)


LENGTH_BOUNDS = (0.03, 5.0)
SHEAR_BOUNDS = (-3.0, 3.0)
SIGNAL_BOUNDS = (0.05, 6.0)
NOISE_BOUNDS = (1e-3, 3.0)


class PriorCovariance(Protocol):
    """A known covariance to start from: that of an earlier fit."""

    def covariance(self, first: Array, second: Array) -> Array:
        """Between points (m, d) and (k, d): (m, k), in the cost's unit squared."""
        ...

    def predict(self, points: Array) -> tuple[Array, Array]:
        """Means (m,) and standard deviations (m,) at points (m, d), in the cost's unit."""
        ...


@dataclass(frozen=True)
class _UncertainConstant:
    """Covariance of a constant: see `PriorCovariance`."""

    deviation: float

    def covariance(self, first: Array, second: Array) -> Array:
        return np.full((len(first), len(second)), self.deviation**2)

    def predict(self, points: Array) -> tuple[Array, Array]:
        return np.zeros(len(points)), np.full(len(points), self.deviation)


def matern(first: Array, second: Array, lengths: Array) -> tuple[Array, Array]:
    """Matérn 5/2 correlation (m, k) between points (m, d) and (k, d), and its −∂/∂(r²/2), r in lengthscales.

    The correlation is that of scikit-learn. Its gradients there are arrays (m, k, d), one slice per lengthscale. The
    common factor of all slices makes a fit three times as fast.

    Source: Rasmussen & Williams, Gaussian Processes for Machine Learning, equation 4.17.
    """
    # k(r) = (1 + s + s²/3) e^(−s), s = √5 r; with t = r²/2: −dk/dt = −k'(r) / r = 5/3 (1 + s) e^(−s).
    s, falling = _distances(first, second, lengths)
    return (1.0 + s + s**2 / 3.0) * falling, (5.0 / 3.0) * (1.0 + s) * falling


BLOCK = 256
"""Number of rows of a correlation that are computed at once."""


def matern_correlation(first: Array, second: Array, lengths: Array) -> Array:
    """The correlation of `matern` alone."""
    # (1 + s + s²/3) e^(−s), in the memory of s: arrays of this size cost more to allocate than to compute.
    first, second = first / lengths, second / lengths
    correlation = np.empty((len(first), len(second)))
    for begin in range(0, len(first), BLOCK):  # whose temporaries stay in the processor's cache
        s = cdist(first[begin : begin + BLOCK], second)
        s *= np.sqrt(5.0)
        block = correlation[begin : begin + BLOCK]
        np.add(s, 1.0, out=block)
        block += s**2 / 3.0
        np.negative(s, out=s)
        block *= np.exp(s, out=s)
    return correlation


def _distances(first: Array, second: Array, lengths: Array) -> tuple[Array, Array]:
    """√5 r and exp(−√5 r), r being the distance in lengthscales."""
    s = cdist(first / lengths, second / lengths) * np.sqrt(5.0)
    return s, np.exp(-s)


class Covariance:
    """The covariance of the module docstring. Hyperparameters θ are logarithms, except for shears.

    Attributes:
        points: (n, dimension) of all observations.
        names: of the hyperparameters, (p,).
        centre: (p,), their priors' means.
        deviation: (p,), their priors' standard deviations.
        bounds: (p, 2).
    """

    def __init__(
        self, points: Array, prior: HyperPrior, *, known: PriorCovariance | None = None, unit: float = 1.0
    ) -> None:
        """Select the terms of the model.

        Args:
            points: (n, dimension).
            prior: over the hyperparameters.
            known: further covariance of the cost.
            unit: of the costs here, for `known`.
        """
        self.points = points
        self._known, self._unit = known, unit
        self._constant = None if known is None else known.covariance(points, points) / unit**2
        dimension = points.shape[1]
        rows: list[tuple[str, tuple[float, float], tuple[float, float], bool]] = [
            ("signal", prior.signal, SIGNAL_BOUNDS, True),
            *[("length", prior.length, LENGTH_BOUNDS, True)] * dimension,
            ("noise", prior.noise, NOISE_BOUNDS, True),
        ]
        if prior.shear is not None:
            rows += [("shear", prior.shear, SHEAR_BOUNDS, False)] * (dimension * (dimension - 1))
        self.names = tuple(row[0] for row in rows)
        self._shears = [i for i, name in enumerate(self.names) if name == "shear"]
        self._beside_diagonal = ~np.eye(dimension, dtype=np.bool_)
        self.centre: Array = np.array([np.log(pair[0]) if log else pair[0] for _, pair, _, log in rows])
        self.deviation: Array = np.array([pair[1] for _, pair, _, _ in rows])
        self.bounds: Array = np.array([np.log(limits) if log else limits for _, _, limits, log in rows])

    def with_uncertain_mean(self, deviation: float) -> Covariance:
        """The same without a known covariance, plus a constant of unknown size: its standard deviation in units of the
        scale.
        """
        other = copy(self)
        other._known, other._unit = _UncertainConstant(deviation), 1.0
        other._constant = other._known.covariance(self.points, self.points)
        return other

    def value(self, theta: Array, name: str) -> float:
        """The signal's or the noise's standard deviation as it enters the model (not its logarithm)."""
        return float(np.exp(theta[self.names.index(name)]))

    def lengths(self, theta: Array) -> Array:
        """(dimension,) lengthscales of the signal."""
        return np.exp(theta[1 : 1 + self.points.shape[1]])

    def sheared(self, theta: Array, points: Array) -> Array:
        """T x of points (m, d)."""
        if not self._shears:
            return points
        T = np.eye(points.shape[1])
        T[self._beside_diagonal] = theta[self._shears]
        return np.asarray(points @ T.T)

    def observed(self, theta: Array) -> tuple[Array, Pullback]:
        """Covariance of the observations (n, n), and its pullback: symmetric W (n, n) → Σ W_ij ∂K_ij/∂θ (p,)."""
        # K = σ² M_ℓ(T x, T x′) + k + (n² + 1e-8) 1; the last term keeps K positive definite with repeated points.
        lengths = self.lengths(theta)
        points = self.sheared(theta, self.points)
        correlation, slope = matern(points, points, lengths)
        variance = self.value(theta, "signal") ** 2
        base = variance * correlation
        K = base.copy()
        if self._constant is not None:
            K += self._constant
        noise = self.value(theta, "noise") ** 2
        K[np.diag_indices_from(K)] += noise + 1e-8

        def pullback(W: Array) -> Array:
            # In logarithms: ∂K/∂log σ = 2 σ² M, ∂K/∂log n = 2 n² 1, and with slope = −∂M/∂(r²/2): ∂K_ij/∂log ℓ_a = σ²
            # slope_ij z_ija² / ℓ_a², z = T x. Shears: ∂K_ij/∂T_ab = −σ² slope_ij z_ija x_ijb / ℓ_a².
            diagonal = 2.0 * np.diagonal(W) * noise
            gradient = [2.0 * float(np.vdot(W, base))]
            gradient += list(variance * _by_length(points, W * slope) / lengths**2)
            gradient.append(float(diagonal.sum()))
            if self._shears:
                by_shear = _by_shear(points, self.points, W * slope) / lengths[:, None] ** 2
                gradient += list(-variance * by_shear[self._beside_diagonal])
            return np.array(gradient)

        return K, pullback

    def cross(self, theta: Array, points: Array) -> Array:
        """Covariance of the noise-free cost at points (m, d) with the observations: (m, n)."""
        return self.between(theta, points, self.points)

    def between(self, theta: Array, first: Array, second: Array) -> Array:
        """Covariance of the noise-free cost at points (m, d) and (k, d): (m, k)."""
        K = matern_correlation(self.sheared(theta, first), self.sheared(theta, second), self.lengths(theta))
        K *= self.value(theta, "signal") ** 2
        return K if self._known is None else K + self._known.covariance(first, second) / self._unit**2

    def variance(self, theta: Array, points: Array) -> Array:
        """Variance of the noise-free cost at points (m, d): (m,)."""
        value = self.value(theta, "signal") ** 2
        prior_variance = 0.0 if self._known is None else (self._known.predict(points)[1] / self._unit) ** 2
        return np.full(len(points), value) + prior_variance


def _by_length(points: Array, G: Array) -> Array:
    """Σ_ik G_ik (x_ij − x_kj)² for every axis j, G symmetric: (dimension,)."""
    if len(points) == 0:
        return np.zeros(points.shape[1])
    # Σ_ik G_ik (x_i − x_k)² = 2 Σ_i x_i² Σ_k G_ik − 2 Σ_ik G_ik x_i x_k; centred, because the two terms nearly cancel.
    centred = points - points.mean(axis=0)
    return np.asarray(2.0 * (centred**2).T @ G.sum(axis=1) - 2.0 * np.einsum("ij,ij->j", centred, G @ centred))


def _by_shear(sheared: Array, points: Array, G: Array) -> Array:
    """Σ_ab G_ab (z_ai − z_bi)(x_aj − x_bj) of points x and z = T x (n, dimension), G symmetric."""
    return np.asarray(2.0 * (sheared.T * G.sum(axis=1)) @ points - 2.0 * sheared.T @ G @ points)
