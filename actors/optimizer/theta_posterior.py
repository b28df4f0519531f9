"""The posterior of θ given weighed pours, sampled on a surrogate with numpy only, and the design of further pours.

`sample_posterior` draws from the distribution over the unit cube. `expected_reductions` tells which pour would reduce
the uncertainty of predictions most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from actors.optimizer.covariance import matern
from actors.optimizer.gaussian_process import GaussianProcess
from actors.optimizer.questions import RememberedGroup, truncated_quantiles

Array = NDArray[np.float64]

WALKERS = 32
"""Smallest number of walkers; a stretch move needs more than twice the number of dimensions."""
STEPS, BURN_IN = 300, 100
STRETCH = 2.0
STARTS = 256
"""Number of Sobol points; the walkers start at the likeliest of them, and at others drawn by their likelihood."""

DISCREPANCY_PRIOR = (0.02, 1.0)
"""Median and standard deviation of the logarithm of the best θ's remaining discrepancy, in the cost's unit: 2 % of the
poured mass."""
DISCREPANCY_LENGTH = 0.4
"""Lengthscale of the best θ's remaining discrepancy over actions, in the unit cube. Without it, a bias common to all
pours would count as many independent errors, and the posterior of θ would be far too narrow."""


@dataclass(frozen=True)
class Sampled:
    """Equally weighted draws.

    Attributes:
        points: (count, dimension), in the unit cube.
        discrepancies: (count,) sampled standard deviations of the remaining discrepancy, in the cost's unit.
        effective: effective number of independent draws of the chain.
        held: posterior probability of each remembered group.
    """

    points: Array
    discrepancies: Array
    effective: float
    held: tuple[float, ...] = ()


def sample_posterior(
    process: GaussianProcess,
    contexts: Array,
    offsets: Array,
    *,
    noise: float,
    count: int,
    snap: Callable[[Array], Array],
    rng: np.random.Generator,
    prior: Array | None = None,
    memory: Sequence[RememberedGroup] = (),
) -> Sampled:
    """Draw θ from p(θ | pours) ∝ p(θ) N(e(θ); 0, S(θ) + n² I + σ_δ² M), θ in the cube.

    e_i(θ) = m(θ, a_i) + o_i is weighed minus simulated spillage of pour i. S(θ) is the surrogate's posterior covariance
    over the pours. n² contains the variances of a weighing and of simulations around the surrogate, including features
    that it cannot represent (a kink). σ_δ² M is the discrepancy that remains at the best θ, a Matérn 5/2 over actions;
    σ_δ is sampled with θ. The chain is an affine-invariant ensemble, which suits the long narrow ridges along which
    parameters compensate each other.

    Args:
        process: of signed differences c_r − c_s over (θ, a).
        contexts: (n, c) actions of the pours, in their unit cube.
        offsets: (n,) weighed spillage minus the regressed one in the differences.
        noise: standard deviation of a weighed pour.
        count: number of returned draws.
        snap: rounds integer axes of points (m, dimension).
        rng: random number generator.
        prior: p(θ), (dimension, 2) centres and deviations of normals in the cube; uniform along axes with a deviation
            of 0, and along all axes without any row.
        memory: factors on p(θ), each a mixture of normals and a uniform part that is heavier than their tails. Pours
            that contradict the normals thus take their weight.

    Source: Kennedy & O'Hagan, Bayesian calibration of computer models, 2001; Goodman & Weare, Ensemble samplers with
    affine invariance, 2010; robust mixture of a prior from earlier trials: Schmidli et al., Robust
    meta-analytic-predictive priors in clinical trials with historical control information, Biometrics 2014.
    Limitations: the surrogate's hyperparameters and M's lengthscale are taken as known.
    """
    n, dimension = len(contexts), process.points.shape[1] - contexts.shape[1]
    likelihood = _Likelihood(process, contexts, offsets, noise, dimension, snap)
    walkers = max(WALKERS, 4 * (dimension + 1))
    median, width = DISCREPANCY_PRIOR
    centres, deviations = (np.zeros((dimension, 2)) if prior is None or not len(prior) else prior).T
    precision = np.divide(1.0, deviations, out=np.zeros(dimension), where=deviations > 0.0)

    def density(x: Array) -> Array:
        inside = np.all((x[:, :dimension] >= 0.0) & (x[:, :dimension] <= 1.0), axis=1)
        values = np.full(len(x), -np.inf)
        # log p(θ, log σ_δ | pours) + const: likelihood, log-normal prior of σ_δ, normal priors of θ, and the mixtures
        # log(w N(θ) + (1 − w) · 1) of the memory, whose uniform part has the density 1 in the cube.
        if inside.any():
            logs = x[inside, dimension]
            values[inside] = likelihood(x[inside, :dimension], np.exp(logs))
            values[inside] -= 0.5 * ((logs - math.log(median)) / width) ** 2
            values[inside] -= 0.5 * (((x[inside, :dimension] - centres) * precision) ** 2).sum(axis=1)
            for group in memory:
                values[inside] += np.log(group.weight * group.density(x[inside]) + 1.0 - group.weight)
        return values

    assert n > 0
    starts = qmc.Sobol(dimension + 1, rng=rng).random(STARTS)
    starts[:, dimension] = math.log(median) + width * (2.0 * starts[:, dimension] - 1.0)
    for group in memory:  # every second start: a narrow memory would hold few points of an even design
        starts[1::2] = group.moved(starts[1::2])
    at_starts = density(starts)
    weights = np.exp(at_starts - at_starts.max())
    # As many different starts as walkers / 2 span all directions: an ensemble never leaves the subspace in which it
    # starts.
    best = np.argsort(-at_starts, kind="stable")[: walkers // 2]
    more_starts = rng.choice(STARTS, walkers - len(best), p=weights / weights.sum())
    x = starts[np.concatenate([best, more_starts])]
    x = x + 1e-3 * rng.standard_normal(x.shape)
    x[:, :dimension] = np.clip(x[:, :dimension], 1e-6, 1.0 - 1e-6)
    chain = _stretched(x, density, rng)
    samples = chain[BURN_IN:]
    flat = samples.reshape(-1, dimension + 1)
    chosen = flat[np.linspace(0, len(flat) - 1, count).round().astype(int)]
    held = []
    for group in memory:
        # Bayes: P(normals | θ) = w N(θ) / (w N(θ) + 1 − w), averaged over the chain
        share = group.weight * group.density(flat)
        held.append(float(np.mean(share / (share + 1.0 - group.weight))))
    return Sampled(snap(chosen[:, :dimension]), np.exp(chosen[:, dimension]), _effective(samples), tuple(held))


def drawn_beforehand(
    count: int, dimension: int, prior: Array, rng: np.random.Generator, memory: Sequence[RememberedGroup] = ()
) -> Array:
    """Draws (count, dimension) of θ from its prior: uniform in the cube, normal along the axes of `prior`, and from the
    mixtures of a memory."""
    points = qmc.Sobol(dimension, rng=rng).random(2 ** math.ceil(math.log2(max(count, 2))))[:count]
    for i, (centre, deviation) in enumerate(prior):
        if deviation > 0.0:
            points[:, i] = truncated_quantiles(points[:, i], centre, deviation)
    for group in memory:
        chosen = rng.random(len(points)) < group.weight
        points[chosen] = group.moved(points[chosen])
    return np.asarray(points)


class _Likelihood:
    """log N(e(θ); 0, C(θ)) for many θ at once."""

    def __init__(
        self,
        process: GaussianProcess,
        contexts: Array,
        offsets: Array,
        noise: float,
        dimension: int,
        snap: Callable[[Array], Array],
    ) -> None:
        self._process, self._contexts, self._offsets, self._snap = process, contexts, offsets, snap
        n = len(contexts)
        # Within one θ, the prior covariance of a stationary process depends on the actions only.
        at_one = np.concatenate([np.full((n, dimension), 0.5), contexts], axis=1)
        self._prior = process.prior_covariance(at_one)
        self._scatter = (noise**2 + process.noise**2 + 1e-10) * np.eye(n)
        lengths = np.full(contexts.shape[1], DISCREPANCY_LENGTH)
        self._lack = matern(contexts, contexts, lengths)[0]

    def __call__(self, thetas: Array, discrepancies: Array) -> Array:
        """(m, dimension), (m,) → (m,)."""
        m, n = len(thetas), len(self._contexts)
        joint = np.concatenate([np.repeat(self._snap(thetas), n, axis=0), np.tile(self._contexts, (m, 1))], axis=1)
        means, V = self._process.projected(joint)
        errors = means.reshape(m, n) + self._offsets
        V = V.reshape(len(V), m, n).transpose(1, 2, 0)
        # C(θ) = S(θ) + (n² + n_s²) 1 + σ_δ² M, S = prior − Vᵀ V: see `sample_posterior`
        C = self._prior - V @ V.transpose(0, 2, 1) + self._scatter + discrepancies[:, None, None] ** 2 * self._lack
        C = C + 1e-9 * np.trace(self._prior) / n * np.eye(n)
        # log N(e; 0, C) = −½ |L⁻¹ e|² − Σ log L_ii + const, C = L Lᵀ
        L = np.linalg.cholesky(C)
        white = np.linalg.solve(L, errors[:, :, None])[:, :, 0]
        logs = np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(-0.5 * (white**2).sum(axis=1) - logs)


def _stretched(x: Array, density: Callable[[Array], Array], rng: np.random.Generator) -> Array:
    """The chain of an ensemble (walkers, d): (STEPS, walkers, d)."""
    # Stretch move (Goodman & Weare 2010): Y = X_k + z (X_j − X_k), z ~ 1/√z on [1/a, a], a = STRETCH, accepted with
    # min(1, z^{d−1} p(Y) / p(X_j)). The halves of the ensemble move in turn, each around walkers of the other one.
    walkers, d = x.shape
    halves = np.arange(walkers) % 2
    values = density(x)
    chain = np.empty((STEPS, walkers, d))
    for step in range(STEPS):
        for half in (0, 1):
            moving, still = np.flatnonzero(halves == half), np.flatnonzero(halves != half)
            z = ((STRETCH - 1.0) * rng.random(len(moving)) + 1.0) ** 2 / STRETCH
            others = x[rng.choice(still, len(moving))]
            proposed = others + z[:, None] * (x[moving] - others)
            proposed_density = density(proposed)
            accepted = np.log(rng.random(len(moving))) < (d - 1) * np.log(z) + proposed_density - values[moving]
            x[moving[accepted]], values[moving[accepted]] = proposed[accepted], proposed_density[accepted]
        chain[step] = x
    return chain


def _effective(chain: Array) -> float:
    """Effective number of independent draws of a chain (steps, walkers, d), for its slowest coordinate.

    Source: Geyer's initial positive sequence on the walkers' mean autocovariance.
    """
    # τ = 1 + 2 Σ_k ρ_k up to the first ρ_k < 0.05, N_eff = steps · walkers / τ
    steps, walkers, d = chain.shape
    worst = 1.0
    for i in range(d):
        x = chain[:, :, i] - chain[:, :, i].mean()
        covariances = np.array([np.mean(x[: steps - lag] * x[lag:]) for lag in range(steps // 2)])
        if covariances[0] <= 0.0:
            continue
        time = 1.0
        for correlation in covariances[1:] / covariances[0]:
            if correlation < 0.05:
                break
            time += 2.0 * float(correlation)
        worst = max(worst, time)
    return float(steps * walkers / worst)


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
    correlation = matern(poured, poured, np.full(poured.shape[1], DISCREPANCY_LENGTH))[0]
    scatter = weighed.noise**2 + process.noise**2 + 1e-10
    rows, unexplained = [], np.zeros(m)
    for theta, deviation in zip(thetas, lacks, strict=True):
        means, V = process.projected(np.concatenate([np.tile(theta, (len(contexts), 1)), contexts], axis=1))
        # R: prior covariance of e between poured places and candidates, given the simulations and θ. Conditioned on the
        # weighed pours (Rasmussen & Williams, equations 2.25 and 2.26), with e = weighed − simulated:
        #     mean weightsᵀ e,  variance v(c) = R_cc − R_cn weights,    weights = (R_nn + n² 1)⁻¹ R_nc
        near = V[:, : n + m]
        R = prior - near.T @ near + deviation**2 * correlation
        weights = np.linalg.solve(R[:n, :n] + scatter * np.eye(n), R[:n, n:])  # (n, m)
        corrected = weights.T @ (means[:n] + weighed.offsets) - means[n : n + m]
        rows.append(np.concatenate([corrected, -means[n + m :]]))
        unexplained += np.maximum(np.diag(R[n:, n:]) - (R[:n, n:] * weights).sum(axis=0), 0.0)
    # C: covariance over the draws of θ; reductions = C(c, t)² / (C(c, c) + v(c) + n²)
    f = np.array(rows)
    f = f - f.mean(axis=0)
    C = f.T @ f / len(thetas)
    variances = np.diag(C)
    reductions = C[:m, m:] ** 2 / (variances[:m] + unexplained / len(thetas) + scatter)[:, None]
    return reductions.mean(axis=1), float(variances[m:].mean())
