"""Risk measures for actions with execution errors: mean or CVaR of a surrogate over disturbances.

`RiskProcess` is a surrogate of the measure; `tail_weights` are those of equally likely losses in their CVaR.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.gaussian_process import GaussianProcess
from actors.optimizer.questions import Disturbance, Risk, RiskAnswer

Array = NDArray[np.float64]

_AT_ONCE = 2**16
"""Number of predictions per batch: the memory for them stays below 100 MB."""


def tail_weights(losses: Array, level: float) -> Array:
    """Weights of equally likely losses in their CVaR: 1 / ((1 − β) J) for the worst (1 − β) J of them.

    CVaR_β is the mean of the worst fraction 1 − β. If (1 − β) J is not an integer, the last loss counts partially, so
    that the result is the minimum over c of c + mean(max(loss − c, 0)) / (1 − β).

    Args:
        losses: (m, J).
        level: β, 0 ≤ β < 1; 0 weights all equally.

    Returns:
        (m, J), each row's sum is 1.

    Source: Rockafellar & Uryasev, Optimization of conditional value-at-risk, Journal of Risk 2000; for scenarios with
    atoms: the same, Conditional value-at-risk for general loss distributions, 2002.
    """
    count = losses.shape[1]
    # Rockafellar & Uryasev 2002: losses in descending order have the weights 1/mass, …, then the fraction that is left.
    mass = max((1.0 - level) * count, 1e-12)
    by_rank = np.clip(mass - np.arange(count), 0.0, 1.0) / mass
    by_rank /= by_rank.sum()  # below the fraction of one loss, only the worst counts
    weights = np.empty_like(losses)
    np.put_along_axis(weights, np.argsort(-losses, axis=1, kind="stable"), by_rank[None, :], axis=1)
    return weights


@dataclass(frozen=True)
class RiskProcess:
    """A surrogate of a measure over disturbances: M(x) = mean or CVaR over j of f(D_j(x), z_j).

    f is a GP over executed requests: coordinates of the disturbed action, then those of errors that no action has. The
    same disturbances are used for every x (common random numbers), so that differences between actions contain no
    sampling noise of them. The mean is the measure of the posterior means, the deviation that of Σ w_j f_j with the
    weights of the tail there.

    Attributes:
        process: of single observations, (n, dimension + c).
        disturbances: J of them, equally likely.
        level: β of CVaR; 0: the mean.

    Source: Cakmak, Astudillo, Frazier & Zhou, Bayesian optimization of risk measures, NeurIPS 2020; for the mean:
    Toscano-Palmerin & Frazier, Bayesian optimization with expensive integrands, 2018.
    Limitations: CVaR of a mean function is below the mean of CVaR where the surrogate is uncertain, and scatter between
    seeds is averaged out. The prior covariance between disturbances is computed in the cube's middle: exact for shifts,
    a few per cent off for the scaling of an axis.
    """

    process: GaussianProcess
    disturbances: tuple[Disturbance, ...]
    level: float

    @classmethod
    def of(cls, process: GaussianProcess, risk: Risk) -> RiskProcess:
        """Create it from a question's risk."""
        return cls(process, risk.disturbances, risk.level)

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`; of the measure at points (m, dimension)."""
        pieces = [self._moments(piece) for piece in self._pieces(points)]
        if not pieces:
            return np.empty(0), np.empty(0)
        mean, deviation = zip(*pieces, strict=True)
        return np.concatenate(mean), np.concatenate(deviation)

    def answer(self, points: Array) -> RiskAnswer:
        """Mean and standard deviation over the disturbances at points (m, dimension)."""
        losses = [self._losses(piece)[0] for piece in self._pieces(points)]
        every = np.concatenate(losses) if losses else np.empty((0, len(self.disturbances)))
        return RiskAnswer(tuple(map(float, every.mean(axis=1))), tuple(map(float, every.std(axis=1))))

    def _moments(self, points: Array) -> tuple[Array, Array]:
        losses, cross = self._losses(points)
        weights = tail_weights(losses, self.level)
        # M = Σ_j w_j f_j: E M = Σ w_j m_j, Var M = wᵀ K w − |L⁻¹ Σ_j w_j k_j|² (K: prior, k_j: with the observations)
        mean = (weights * losses).sum(axis=1)
        # The weights are applied before solving: one right-hand side per point instead of J.
        known = self.process.explained(np.einsum("mj,mjn->mn", weights, cross))
        prior = np.einsum("mj,mj->m", weights @ self._prior, weights)
        variance = prior - (known**2).sum(axis=0)
        return mean, np.sqrt(np.maximum(variance, 1e-12 * self.process.scale**2))

    def _losses(self, points: Array) -> tuple[Array, Array]:
        """Posterior means (m, J), and prior covariances with the observations (m, J, n)."""
        m, J = len(points), len(self.disturbances)
        executed = self._executed(points)
        cross = self.process.cross(executed)
        return self.process.expected(executed, cross).reshape(m, J), cross.reshape(m, J, -1)

    def _executed(self, points: Array) -> Array:
        """Points (m, dimension) as executed under every disturbance: (m · J, dimension + c)."""
        scales, shifts, context = self._maps
        moved = points[:, None, :] * scales + shifts
        beside = np.broadcast_to(context, (len(points), *context.shape))
        return np.concatenate([moved, beside], axis=2).reshape(-1, scales.shape[1] + context.shape[1])

    @cached_property
    def _maps(self) -> tuple[Any, Any, Any]:
        rows = self.disturbances
        return (
            np.array([row.scales for row in rows]),
            np.array([row.shifts for row in rows]),
            np.array([row.context for row in rows]).reshape(len(rows), -1),
        )

    @cached_property
    def _prior(self) -> Array:
        middle = np.full((1, len(self.disturbances[0].scales)), 0.5)
        return self.process.prior_covariance(self._executed(middle))

    def _pieces(self, points: Array) -> list[Array]:
        if len(points) == 0:
            return []
        size = max(_AT_ONCE // (len(self.disturbances) * max(len(self.process.points) // 32, 1)), 1)
        return [points[i : i + size] for i in range(0, len(points), size)]
