"""The mean absolute value of a signed surrogate over places that nobody chooses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer.core.surrogate import GaussianProcess

Array = NDArray[np.float64]


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
