"""The band of a single observation: the shortest interval that holds it with a given probability."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

ENDS = 64
"""Lower ends that are tried, evenly by the probability below them."""

HALVINGS = 50


def shortest_bands(weights: Array, means: Array, deviations: Array, level: float) -> Array:
    """Bands (m, 2) of y = clip(z, 0, 1), z of a mixture of normal distributions.

    Where y may well be 0 the band begins there, and holds no more for that: an interval between two quantiles would
    leave out the least likely end only.

    Args:
        weights: (J,), sum 1.
        means, deviations: (J, m).
        level: probability, between 0 and 1.
    """
    below = np.linspace(0.0, 1.0 - level, ENDS)
    lows = _quantiles(weights, means, deviations, below)
    highs = _quantiles(weights, means, deviations, below + level)
    best = np.argmin(highs - lows, axis=0)
    each = np.arange(means.shape[1])
    return np.stack([lows[best, each], highs[best, each]], axis=1)


def _quantiles(weights: Array, means: Array, deviations: Array, shares: Array) -> Array:
    """(k, m) for shares (k,), by bisection."""
    low, high = np.zeros((len(shares), means.shape[1])), np.ones((len(shares), means.shape[1]))
    none = weights @ ndtr(-means / deviations) >= shares[:, None]
    all_of_it = weights @ ndtr((1.0 - means) / deviations) <= shares[:, None]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        under = np.einsum("j,jkm->km", weights, ndtr((middle - means[:, None, :]) / deviations[:, None, :]))
        low, high = np.where(under < shares[:, None], middle, low), np.where(under < shares[:, None], high, middle)
    return np.where(none, 0.0, np.where(all_of_it, 1.0, 0.5 * (low + high)))
