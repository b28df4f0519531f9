"""Bayesian model averaging over the ways in which a simulator can be wrong.

Hypothesis j states that the bench at action x behaves like the simulator at a displaced action, nearer to or farther
from the simulator's best action x̂, with a scaled cost, plus a discrepancy δ that is not simulated:

    f(x) = μ_j(x) + δ(x),    μ_j(x) = clip(e^{g_j} f̂_s(z_j(x)), 0, 1),    δ ~ GP(0, v_j(x) v_j(x′) M_{ℓ_j}(x, x′))
    z_j(x) = x̂ + e^{h_j} (A_j x + s_j − x̂),    v_j² = σ_j² + e^{2 g_j} s_s²(z_j(x))
    y = f(x) + ε,    ε ~ N(0, (n_j + m_j μ_j(x))²)

f̂_s and s_s are posterior mean and deviation of a GP of the simulations, with costs in units of the largest one. h
makes the valley wider or narrower than simulated, as deviating walls and lips do. Each hypothesis has a factor on the
deviations of these errors: by some the simulator is nearly right, by others it is far off. n and m, the scatter of
pours of one action and its growth with the cost, belong to the hypothesis, too: a few pours close together determine
them.

Two further groups of hypotheses do not rely on the simulator. In the contrary group it predicts
the opposite, μ_j = clip(e^{g_j} (1 − f̂_s(z_j(x))), 0, 1). In the uninformative group it contains no information about
this bench, and f is a GP around 0.6, more towards corners.

The posterior weights are prior times marginal likelihood of the observations. No hypothesis is removed: the weight of a
failing one decreases. The weight of the two further groups measures how unreliable the simulator is. An observation
counts with a finite resolution, and one of nearly everything lost only as such: otherwise a hypothesis that is certain
of a total loss would gain from each failed pour over one that is less certain.

The prior draws are coarse: with steep walls, a few pours leave a handful of 2,048. The ones that are used for
predictions are therefore moved by Markov chains that keep the posterior.

**After a calibration.** Its weighed pours have simulations c_i and a surrogate f̂_c of these in their own scene.
Hypothesis j predicts them as clip(e^{g_j} (c_i + f̂_c(z_j(x_i)) − f̂_c(x_i)), 0, 1) + δ, with its noise. Its weight is
prior times (1 − ε) L_j / Σ_k w_k L_k + ε, L_j the likelihood of these pours to the power that they have for another
receiver: with the probability ε the calibration misleads, and only the prior is known, as after a change of the bench.
δ then is a shift of the stream (`sim_engine.prediction_band`), which changes small losses little: instead of σ_j, its
standard deviation is σ_j φ(Φ⁻¹(μ_j(x))) / φ(0). In the scene of the observations it is the same δ: pours there are
earlier observations.

**A bench that changes.** Once an observation lies outside its 99 % prediction interval, the hypotheses are weighed
together with the start of the present segment: the observations before it were made on another bench, and say nothing
of this one. Two Cholesky factors of every hypothesis, in both orders, give the marginal likelihoods of all beginnings
and ends. Alternatively the latest observation is an outlier.

**A bench that drifts.** From the tenth observation on, the bench drifts by one hypothesis in five. Offset, h and g as
above are those at present; a observations ago they were

    s_j − a d_j, h_j − a d′_j, g_j − a d″_j,    d_j ~ N(0, r_j² Var s), d′_j ~ N(0, r_j² Var h), d″_j ~ N(0, r_j² Var g)

and δ is forgotten: Cov(δ(x, n), δ(x′, n′)) = v_j(x) v_j(x′) M_{ℓ_j}(x, x′) e^{−κ_j |n − n′|}, κ_j = r_j. The sizes r_j
have a prior, so the observations decide whether, where to and how fast the bench drifts, and how fast they age. A bench
that walks otherwise than evenly is left to δ, and to the starts of a segment.

Source: Bayesian model averaging, Hoeting et al., Statistical Science 1999; discrepancy, Kennedy & O'Hagan 2001;
power prior of earlier data, Ibrahim & Chen 2000, in a robust mixture, Schmidli et al., Biometrics 2014;
changes, Adams & MacKay, Bayesian online changepoint detection, 2007, and binary segmentation, Scott & Knott 1974;
forgetting, Bogunovic, Scarlett & Cevher, Time-varying Gaussian process bandit optimization, AISTATS 2016;
moves after resampling, Gilks & Berzuini 2001.
Limitations: the weights of the groups, and of the starts of a segment, come from the prior draws; predictions use 48
moved draws, and the uninformative group, which does not drift.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from actors.optimizer.gaussian_process import GaussianProcess, constant_mean_process
from actors.optimizer.prediction_intervals import highest_density_intervals
from actors.optimizer.questions import ModelDiscrepancy, SceneEvidence

Array = NDArray[np.float64]
Remake = Callable[[Array], "Hypotheses"]

HYPOTHESES = 2048
KEPT = 48
"""Number of draws from the posterior weights for predictions, evenly by weight."""
GAIN = 0.3
"""Standard deviation of g."""
WIDTH = 0.25
"""Standard deviation of h."""
RESTS = (0.02, 0.3)
"""Smallest and largest σ, in units of the largest cost; log-uniform, like ℓ."""
LENGTHS = (0.15, 0.6)
NEAR, FARTHER = (0.03, 0.4), (0.4, 3.0)
"""Ranges of a hypothesis' factor s on the standard deviations of its offset, and up to 1 of g and h, too; log-uniform.
The far ones are tails for a bench that deviates far."""
NEAR_SHARE = 0.3
"""Fraction of the hypotheses by which the simulator is nearly right. A first pour can thus rely on it; where it is
wrong, that pour refutes them."""
NOISES, NOISE_GROWTHS = (0.002, 0.05), (0.02, 0.2)
"""Smallest and largest standard deviation of one observation at zero cost, and its increase at the largest cost;
log-uniform."""
UNINFORMATIVE_MEAN, UNINFORMATIVE_SIGNAL = 0.6, 0.4
UNINFORMATIVE_EDGE = 0.3
"""Difference of the uninformative group's expected cost between corners and middle: search boxes are drawn around good
actions."""
UNINFORMATIVE_LENGTHS = np.repeat((0.15, 0.3, 0.6), 3)
UNINFORMATIVE_NOISES = np.tile((0.003, 0.01, 0.03), 3)
UNINFORMATIVE_GROWTHS = np.tile((0.03, 0.06, 0.15), 3)
"""ℓ, n and m of the components of the uninformative group. With a fixed scatter, pours that hardly scatter would count
against it."""
CONTRARY, CONTRARY_SHARE, CONTRARY_REST = 128, 0.2, 0.15
"""Number of contrary hypotheses, their fraction of the prior weight of both groups, and their smallest σ. A total loss
where the simulation has none is evidence for them, but a displaced valley explains it, too."""
SURPRISE = 0.99
"""Probability of the prediction intervals; an observation outside makes a change of the bench possible."""
CHANGE, MISHAP, NOTICED = 0.02, 0.001, 0.9
"""Prior probabilities of a change before each observation, and that the latest one is an outlier; posterior probability
of a change from which it is reported, with two observations since then at least."""
ALL_BY_MISHAP = 0.5
"""Probability that everything is lost by an outlier; otherwise any cost is equally likely."""
NEAR_CHANGED = 0.1
"""Factor on the prior weight of the hypotheses by which the simulator is nearly right, after a change of the bench."""
TOTAL, RESOLUTION, LEAST_CHANCE = 0.95, 0.01, 1e-12
"""Cost above which everything is lost, whatever the exact cost: it says nothing about the place of the valley. Other
costs count with this resolution, so that no hypothesis gains by being more certain than it needs to be. And the least
probability of an observation by any hypothesis."""
FORGOTTEN = 1e3
"""Noise of an observation that does not count."""
MISLED = 1.0 / 22.0
"""ε: probability that a calibration says nothing about the bench of the observations, because something was moved or
exchanged since. None of the 20 calibrations in docs/evidence/calibration.md (quickstart) misled; by Laplace's rule of
succession the next one does with (0 + 1) / (20 + 2)."""
DRIFTING, DRIFTS, DRIFTS_FROM = 0.2, (0.002, 0.05), 10
"""Prior probability of a drift; smallest and largest r, log-uniform; and the number of observations from which a drift
is considered: with fewer, it can hardly be told from an offset."""
STEPS, DRIFT_ROUNDS = (0.5, 0.25, 0.12) * 4, 3
"""Sizes of the steps of the Markov chains, relative to the prior's standard deviation; how often they are made where a
drift is considered, whose prior draws are coarser."""
RECENT = 4
"""Number of sets of points whose projections are kept."""
KNOWN_SHARE = 0.75
"""Fraction of the hypotheses around earlier bench offsets, if there are any."""
KNOWN_SPREAD = 0.25
"""Standard deviation that is added to those, relative to the prior's."""


@dataclass(frozen=True)
class Hypotheses:
    """Ways in which the simulator can be wrong.

    Attributes:
        scales, shifts: (J, dimension) of the bench offsets.
        widths: (J,), logarithms of the factors on distances to the centre.
        gains: (J,), logarithms.
        rests: (J,), σ.
        lengths: (J,), ℓ.
        noises: (J,), n.
        growths: (J,), m.
        near: (J,), whether by the hypothesis the simulator is nearly right.
        contrary: (J,), whether the hypothesis reverses the simulator.
        drifts: (J, 2 dimension + 2), changes per observation of the shifts, of the factors' logarithms, of h and of g.
        fading: (J,), κ.
        centre: (dimension,), the simulated best.
        origin: (dimension,), about which a factor stretches, as negative coordinate.
    """

    scales: Array
    shifts: Array
    widths: Array
    gains: Array
    rests: Array
    lengths: Array
    noises: Array
    growths: Array
    near: NDArray[np.bool_]
    contrary: NDArray[np.bool_]
    drifts: Array
    fading: Array
    centre: Array
    origin: Array

    @classmethod
    def of(cls, discrepancy: ModelDiscrepancy, centre: Array, latent: Array, contrary: NDArray[np.bool_]) -> Hypotheses:
        """Return the hypotheses of latent variables (J, `latent_size`), a priori standard normal; with `drift_size`
        further ones the bench may drift.
        """
        dimension = len(discrepancy.offset_priors)
        # Columns: z of shifts and of factors, then h and g (all normal); σ, ℓ, s, the earlier offset, n, m and the
        # drift as uniform numbers Φ(z).
        z_shift, z_factor = latent[:, :dimension], latent[:, dimension : 2 * dimension]
        width, gain = latent[:, 2 * dimension : 2 * dimension + 2].T
        uniform = iter(np.asarray(ndtr(latent[:, 2 * dimension + 2 :])).T)
        residual, length, far, earlier, noise, growth = itertools.islice(uniform, 6)
        near = far < NEAR_SHARE
        beyond = (far - NEAR_SHARE) / (1.0 - NEAR_SHARE)
        spread = np.where(near, _evenly(NEAR, far / NEAR_SHARE), _evenly(FARTHER, beyond))
        less = np.minimum(spread, 1.0)
        scales, shifts = np.ones((len(latent), dimension)), np.zeros((len(latent), dimension))
        if discrepancy.drawn:
            index = np.minimum((earlier / KNOWN_SHARE * len(discrepancy.drawn)).astype(int), len(discrepancy.drawn) - 1)
            around = earlier < KNOWN_SHARE
            spread = np.where(around, KNOWN_SPREAD, spread)
            scales[around] = np.array([offset.scales for offset in discrepancy.drawn])[index[around]]
            shifts[around] = np.array([offset.shifts for offset in discrepancy.drawn])[index[around]]
        shift, factor, origin = (
            np.array([getattr(prior, name) for prior in discrepancy.offset_priors])
            for name in ("shift", "factor", "origin")
        )
        # u ↦ f u + s shift z + (f − 1) origin, f = e^{s factor z}: a factor on the axis' value also moves its origin.
        # After an earlier offset (scales, shifts), the two maps are composed.
        factors = np.exp(spread[:, None] * factor * z_factor)
        moved = spread[:, None] * shift * z_shift + (factors - 1.0) * origin
        drift, pace = np.zeros(len(latent)), np.zeros((len(latent), 2 * dimension + 2))
        if latent.shape[1] > latent_size(dimension):
            level, pace = next(uniform), latent[:, latent_size(dimension) + 1 :]
            drift = np.where(level < DRIFTING, _evenly(DRIFTS, level / DRIFTING), 0.0)
        return cls(
            factors * scales,
            factors * shifts + moved,
            less * WIDTH * width,
            less * GAIN * gain,
            np.where(contrary, _evenly((CONTRARY_REST, RESTS[1]), residual), _evenly(RESTS, residual)),
            _evenly(LENGTHS, length),
            _evenly(NOISES, noise),
            _evenly(NOISE_GROWTHS, growth),
            near & ~contrary,
            contrary,
            drift[:, None] * pace * np.concatenate([shift, factor, (WIDTH, GAIN)]),
            drift,
            centre,
            origin,
        )

    def only(self, indices: NDArray[np.int_]) -> Hypotheses:
        """Return a subset."""
        common = "centre", "origin"
        return replace(self, **{name: value[indices] for name, value in vars(self).items() if name not in common})

    def moved(self, points: Array, ages: Array | None = None) -> Array:
        """(J, m, dimension): the simulator's points that each hypothesis assigns to points (m, dimension).

        Args:
            ages: (m,), numbers of observations since each point's; None: at present.
        """
        positions = self.scales[:, None, :] * points[None, :, :] + self.shifts[:, None, :]
        widths, dimension = self.widths[:, None], points.shape[1]
        if ages is not None and self.fading.any():
            since = self.drifts[:, None, :] * ages[:, None]
            shift, factor, width, _ = np.split(since, np.cumsum([dimension, dimension, 1]), axis=2)
            factors = np.exp(-factor)
            positions = factors * positions - shift + (factors - 1.0) * self.origin
            widths = widths - width[:, :, 0]
        return np.asarray(self.centre + np.exp(widths)[:, :, None] * (positions - self.centre))

    def gains_at(self, ages: Array | None) -> Array:
        """Factors e^g (J, m) on the cost at these ages, or (J, 1) at present."""
        return np.exp(self.gains[:, None] - (0.0 if ages is None else self.drifts[:, -1:] * ages))

    @property
    def kernel(self) -> _Kernel:
        """The kernel of δ."""
        return _Kernel(self.lengths, self.fading)


@dataclass(frozen=True)
class _Kernel:
    """Correlations of δ by hypotheses (J): Matérn 5/2 in the point, times e^{−κ |Δn|} in the observation's number,
    (1 − ε)^{|Δn| / 2} of Bogunovic et al. (2016).
    """

    lengths: Array
    fading: Array

    def correlation(self, first: Array, second: Array, apart: Array | None = None) -> Array:
        """(J, m, k), between points (m, dimension) and (k, dimension) whose numbers differ by `apart` (m, k)."""
        s = np.sqrt(5.0) * cdist(first, second)[None, :, :] / self.lengths[:, None, None]
        correlation = np.asarray((1.0 + s + s**2 / 3.0) * np.exp(-s))
        if apart is not None and (fades := self.fading > 0.0).any():
            correlation[fades] *= np.exp(-self.fading[fades, None, None] * apart)
        return correlation

    def with_uninformative(self) -> _Kernel:
        """The kernel of these hypotheses and of the uninformative group."""
        lengths = np.concatenate([self.lengths, UNINFORMATIVE_LENGTHS])
        return _Kernel(lengths, np.append(self.fading, np.zeros(len(UNINFORMATIVE_LENGTHS))))


@dataclass(frozen=True)
class _Prior:
    """Prior moments of hypotheses (J) at points (m): means, deviations of δ, noises; (J, m) each."""

    means: Array
    spreads: Array
    noises: Array


def _joined(*parts: _Prior, axis: int = 0) -> _Prior:
    return _Prior(*(np.concatenate([getattr(p, n) for p in parts], axis) for n in ("means", "spreads", "noises")))


@dataclass(frozen=True)
class _Segments:
    """Which observations (n) are of the present bench, in S ways, and the posterior weights of these with J hypotheses.

    Attributes:
        counting: (S, n), the observations that count.
        weights: (S, J).
        surprised: whether an observation lies outside its prediction interval.
        since: index of the first observation after the likeliest change; None if none is noticed.
    """

    counting: NDArray[np.bool_]
    weights: Array
    surprised: bool
    since: int | None


@dataclass(frozen=True)
class _CalibratedScene:
    """The weighed pours (n) of a calibration in one scene, with a surrogate of their simulations.

    Attributes:
        corrections: simulated costs less those of the surrogate, in the cost's unit.
        centre: (dimension,), the simulated best there.
        power: exponent of the likelihood.
        misled: ε of this calibration.
    """

    points: Array
    costs: Array
    surrogate: GaussianProcess
    corrections: Array
    centre: Array
    power: float
    misled: float

    @classmethod
    def of(cls, pours: SceneEvidence, worst: float) -> _CalibratedScene:
        """Fit the surrogate."""
        points, simulated = np.array(pours.points), np.array(pours.simulated)
        surrogate = constant_mean_process(points, simulated)
        corrections = simulated - surrogate.predict(points)[0]
        costs = np.clip(np.array(pours.costs) / worst, 0.0, 1.0)
        misled = MISLED if pours.misled is None else pours.misled
        return cls(points, costs, surrogate, corrections, _least(surrogate), pours.power, misled)


class ModelAveragedProcess:
    """The real cost, averaged over hypotheses; see the module docstring. Its `predict` is a `Surrogate`'s.

    Attributes:
        simulated: surrogate of the simulations.
        uninformative: sum of the weights of the uninformative and the contrary hypotheses.
        since: index of the first observation since which the bench behaves differently; None if it does not.
    """

    def __init__(self, simulated: GaussianProcess, points: Array, costs: Array, discrepancy: ModelDiscrepancy) -> None:
        """Compute the posterior weights of the hypotheses.

        Args:
            simulated: of the same cost.
            points: (n, dimension), real observations in the order in which they were made, n ≥ 0.
            costs: (n,).
            discrepancy: of the question.
        """
        self.simulated, self.points, self.worst = simulated, points, discrepancy.worst
        scenes = [_CalibratedScene.of(pours, self.worst) for pours in discrepancy.calibration or ()]
        by_misled = dict.fromkeys(scene.misled for scene in scenes)
        self._calibrations = {misled: [scene for scene in scenes if scene.misled == misled] for misled in by_misled}
        self._same = [scene for scene in scenes if scene.power == 1.0]
        self._points = np.concatenate([*(scene.points for scene in self._same), points])
        self._costs = np.concatenate([*(scene.costs for scene in self._same), np.clip(costs / self.worst, 0.0, 1.0)])
        self._earlier = len(self._points) - len(points)
        dimension, centre = len(discrepancy.offset_priors), _least(simulated)
        size, J, distrust = latent_size(dimension), HYPOTHESES + CONTRARY, discrepancy.uninformative
        rows = np.clip(qmc.Sobol(size, scramble=True, rng=np.random.default_rng(0)).random(HYPOTHESES), 1e-6, 1 - 1e-6)
        if len(points) >= DRIFTS_FROM:
            # Further columns of a longer sequence: all together are a scrambled Sobol sequence, too.
            longer = qmc.Sobol(size + drift_size(dimension), scramble=True, rng=np.random.default_rng(2))
            further = np.clip(longer.random(HYPOTHESES)[:, size:], 1e-6, 1 - 1e-6)
            rows = np.concatenate([rows, further], axis=1)
        latent = ndtri(np.concatenate([rows, rows[:CONTRARY]]))  # the same for the same question, and even
        contrary = np.arange(J) >= HYPOTHESES
        self._ages = np.arange(len(self._points), 0.0, -1.0)
        self._all = Hypotheses.of(discrepancy, centre, latent, contrary)
        numbers = HYPOTHESES, CONTRARY, len(UNINFORMATIVE_LENGTHS)
        shares = 1.0 - distrust, CONTRARY_SHARE * distrust, (1.0 - CONTRARY_SHARE) * distrust
        prior = np.log(np.repeat(np.divide(shares, numbers), numbers))
        calibrated = np.concatenate([self._calibrated(self._all), self._calibrated(None)], axis=1)
        self._calibrated_totals = [_log_sum(prior + logs) for logs in calibrated]
        segments = self._segments(prior, prior + self._reliance(calibrated))
        self.since = None if segments.since is None else segments.since - self._earlier
        weights = segments.weights
        informed, uninformative = weights[:, :J], weights[:, J:]
        self._trusting = np.where(self._all.contrary, 0.0, informed.sum(axis=0))
        self.uninformative = float(informed[:, self._all.contrary].sum() + uninformative.sum())
        sample = _evenly_drawn(informed.ravel(), KEPT)
        counting = segments.counting[sample // J]
        sample = sample % J
        self._kept = self._all.only(sample)
        if len(points):
            make = partial(Hypotheses.of, discrepancy, centre, contrary=contrary[sample])
            self._kept = self._resampled(latent[sample], self._kept, counting, make)
        self.mixture = np.concatenate([np.full(KEPT, informed.sum() / KEPT), uninformative.sum(axis=0)])
        self._kernel = self._kept.kernel.with_uninformative()
        self._least_noises = np.concatenate([self._kept.noises, UNINFORMATIVE_NOISES])
        self._growths = np.concatenate([self._kept.growths, UNINFORMATIVE_GROWTHS])
        at_data = self._prior_at_data(self._kept)
        counting = np.concatenate([counting, segments.counting[uninformative.argmax(axis=0)]])
        self._at_data = replace(at_data, noises=np.where(counting, at_data.noises, FORGOTTEN))
        K = _covariances(self._at_data, self._kernel, self._points, self._ages)
        self._inverses = np.linalg.inv(np.linalg.cholesky(K))
        self._residuals = np.einsum("jik,jk->ji", self._inverses, self._costs - self._at_data.means)
        self._recent: dict[bytes, tuple[_Prior, Array]] = {}

    # -- prior moments ---------------------------------------------------------------------------------------------

    def _informed(
        self, hypotheses: Hypotheses, points: Array, scene: _CalibratedScene | None = None, ages: Array | None = None
    ) -> _Prior:
        """Moments in the scene of the observations, or at the pours of a calibration's scene.

        Args:
            ages: see `Hypotheses.moved`.
        """
        J, m = len(hypotheses.gains), len(points)
        if m == 0:
            return _Prior(*(np.empty((J, 0)) for _ in range(3)))
        if scene is not None:
            hypotheses = replace(hypotheses, centre=scene.centre)
        simulated = self.simulated if scene is None else scene.surrogate
        mean, deviation = (
            moments.reshape(J, m) for moments in simulated.predict(hypotheses.moved(points, ages).reshape(J * m, -1))
        )
        if scene is not None:
            mean = mean + scene.corrections
        # μ_j = clip(e^{g_j} f̂_s(z_j(x)), 0, 1), contrary: 1 − f̂_s; v_j = √(σ_j² + e^{2 g_j} s_s²); noise n_j + m_j μ_j
        gain = hypotheses.gains_at(ages) / self.worst
        means = np.clip(gain * np.where(hypotheses.contrary[:, None], self.worst - mean, mean), 0.0, 1.0)
        rests = hypotheses.rests[:, None] * (_steepness(means) if self._calibrations else 1.0)
        spreads = np.hypot(rests, gain * deviation)
        return _Prior(means, spreads, hypotheses.noises[:, None] + hypotheses.growths[:, None] * means)

    def _uninformative(self, points: Array, seen: Array | float) -> _Prior:
        shape = len(UNINFORMATIVE_LENGTHS), len(points)
        edge = ((2.0 * points - 1.0) ** 2).mean(axis=1)
        means = np.broadcast_to(UNINFORMATIVE_MEAN + UNINFORMATIVE_EDGE * np.clip(edge, 0.0, 1.0), shape)
        # from observed costs, if any
        noises = UNINFORMATIVE_NOISES[:, None] + UNINFORMATIVE_GROWTHS[:, None] * np.broadcast_to(seen, shape)
        return _Prior(means, np.full(shape, UNINFORMATIVE_SIGNAL), noises)

    def _informed_at_data(self, hypotheses: Hypotheses) -> _Prior:
        pours = [self._informed(hypotheses, scene.points, scene) for scene in self._same]
        pours.append(self._informed(hypotheses, self.points, ages=self._ages[self._earlier :]))
        return _joined(*pours, axis=1)

    def _prior_at_data(self, hypotheses: Hypotheses) -> _Prior:
        return _joined(self._informed_at_data(hypotheses), self._uninformative(self._points, self._costs))

    def _prior(self, points: Array) -> _Prior:
        return _joined(self._informed(self._kept, points), self._uninformative(points, UNINFORMATIVE_MEAN))

    # -- posterior weights -----------------------------------------------------------------------------------------

    def _calibrated(self, hypotheses: Hypotheses | None) -> Array:
        """Logarithms (calibrations, J) of L_j, the likelihoods of each calibration's pours to their powers; None: of
        the uninformative group."""
        J = len(UNINFORMATIVE_LENGTHS) if hypotheses is None else len(hypotheses.gains)
        logs = np.zeros((len(self._calibrations), J))
        for i, scenes in enumerate(self._calibrations.values()):
            for scene in scenes:
                if hypotheses is None:
                    prior, lengths = self._uninformative(scene.points, scene.costs), UNINFORMATIVE_LENGTHS
                else:
                    prior, lengths = self._informed(hypotheses, scene.points, scene), hypotheses.lengths
                K = _covariances(prior, _Kernel(lengths, np.zeros(len(lengths))), scene.points)
                logs[i] += scene.power * _sequential(prior.means, K, scene.costs)[0].sum(axis=1)
        return logs

    def _reliance(self, calibrated: Array) -> Array:
        """Logarithms (J,) of the factors on prior weights by the log-likelihoods (calibrations, J) of their pours."""
        # Π_c ((1 − ε_c) L_jc / Σ_k w_k L_kc + ε_c)
        misled = np.log(list(self._calibrations))[:, None]
        relative = calibrated - np.array(self._calibrated_totals)[:, None]
        return np.asarray(np.logaddexp(np.log1p(-np.exp(misled)) + relative, misled).sum(axis=0))

    def _resampled(self, latent: Array, sample: Hypotheses, counting: NDArray[np.bool_], make: Remake) -> Hypotheses:
        """Move drawn hypotheses (k) by Markov chains that keep the posterior: the drawn ones are few, and coarse.

        Args:
            latent: (k, D), their latent variables.
            sample: the hypotheses.
            counting: (k, n), the observations that count for each.
            make: returns hypotheses of latent variables.

        Source: preconditioned Crank–Nicolson, Cotter et al., Statistical Science 2013; moves after resampling, Gilks &
        Berzuini 2001.
        """
        rng = np.random.default_rng(1)
        likelihood = self._likelihood(sample, counting)
        # z′ = √(1 − β²) z + β ξ keeps N(0, 1), so the acceptance is the likelihoods' ratio alone (Cotter et al. 2013).
        for step in STEPS * (DRIFT_ROUNDS if sample.fading.any() else 1):
            proposed = np.sqrt(1.0 - step**2) * latent + step * rng.standard_normal(latent.shape)
            candidates = make(proposed)
            proposed_likelihood = self._likelihood(candidates, counting)
            accepted = np.log(rng.random(len(latent))) < proposed_likelihood - likelihood
            latent = np.where(accepted[:, None], proposed, latent)
            likelihood = np.where(accepted, proposed_likelihood, likelihood)
        return make(latent)

    def _likelihood(self, hypotheses: Hypotheses, counting: NDArray[np.bool_]) -> Array:
        """Log-likelihoods (k,) of the observations that count for each hypothesis, (k, n), and the weights after a
        change.
        """
        at_data = self._informed_at_data(hypotheses)
        at_data = replace(at_data, noises=np.where(counting, at_data.noises, FORGOTTEN))
        K = _covariances(at_data, hypotheses.kernel, self._points, self._ages)
        chances = _sequential(at_data.means, K, self._costs)[0]
        changed = ~counting[:, :1].all(axis=1)
        weights = self._reliance(self._calibrated(hypotheses))
        weights = np.where(changed, np.where(hypotheses.near, np.log(NEAR_CHANGED), 0.0), weights)
        return np.asarray(np.where(counting, chances, 0.0)[:, self._earlier :].sum(axis=1) + weights)

    def _segments(self, prior: Array, calibrated: Array) -> _Segments:
        """Weigh the starts of the present segment together with the hypotheses.

        Args:
            prior: log prior weights (J,) on a bench of which nothing is known, as after a change.
            calibrated: the same with the calibration.

        If the observations after the likeliest change hold another one, they alone are weighed.
        """
        at_data = self._prior_at_data(self._all)
        K = _covariances(at_data, self._all.kernel.with_uninformative(), self._points, self._ages)
        weighted = self._weighed(at_data.means, K, prior, calibrated, 0)
        while weighted.since is not None:
            later = self._weighed(at_data.means, K, prior, calibrated, weighted.since)
            if later.since is None:
                return replace(later, since=weighted.since) if later.surprised else weighted
            weighted = later
        return weighted

    def _weighed(self, means: Array, K: Array, prior: Array, calibrated: Array, begin: int) -> _Segments:
        """Weights of the starts of a segment among the observations from `begin`, with at most one change there: none
        among a calibration's pours."""
        n, skip = len(self._points), max(self._earlier - begin, 0)
        earliest, m = begin + skip, n - begin - skip
        sequence = _sequential(means[:, begin:], K[:, begin:, begin:], self._costs[begin:])
        chances, residuals = (values[:, skip:] for values in sequence)
        changed = prior + np.log(
            np.append(np.where(self._all.near, NEAR_CHANGED, 1.0), np.ones(len(UNINFORMATIVE_LENGTHS)))
        )
        changed -= _log_sum(changed)
        # before[j, t] = log w_j + Σ_{i<t} log p_j(y_i | y_<i): joint with the observations before t (chain rule)
        first = changed if begin else calibrated
        before = first[:, None] + np.concatenate([np.zeros((len(prior), 1)), np.cumsum(chances, axis=1)], axis=1)
        so_far = np.exp(before[:, :-1] - before[:, :-1].max(axis=0, initial=-np.inf))
        # Probability integral transform: P(y_i < observed | y_<i) = Σ_j w_j(t) Φ(residual_j)
        below = (so_far * ndtr(residuals)).sum(axis=0) / so_far.sum(axis=0)  # of each observation, given those before
        surprising = np.abs(below - 0.5) > 0.5 * SURPRISE
        counting, logs = [np.arange(n) >= begin], [before[:, m]]
        starts = range(0 if skip else 1, m)
        if surprising.any():
            last = slice(None, earliest - 1 if earliest else None, -1)
            backwards = _sequential(means[:, last], K[:, last, last], self._costs[last])[0]
            after = np.cumsum(backwards, axis=1)[:, ::-1]
            # Change before `start`: Σ_j of the old bench's evidence, times CHANGE, times w_j p_j(y_start … y_n) of the
            # new (Adams & MacKay 2007, with one change).
            for start in starts:
                counting.append(np.arange(n) >= earliest + start)
                logs.append(changed + after[:, start] + _log_sum(before[:, start]) + np.log(CHANGE))
            if surprising[-1]:
                counting.append(counting[0] & (np.arange(n) < n - 1))
                logs.append(
                    before[:, m - 1] + np.log(MISHAP * (ALL_BY_MISHAP if self._costs[-1] > TOTAL else RESOLUTION))
                )
        weights = np.exp(np.array(logs) - np.max(logs))
        weights /= weights.sum()
        changes = weights[1 : 1 + len(starts)].sum(axis=1)
        since = earliest + starts[int(np.argmax(changes))] if changes.sum() > NOTICED else None
        since = None if since == n - 1 else since  # a single observation may be a mishap
        return _Segments(np.array(counting), weights, bool(surprising.any()), since)

    # -- posterior moments -----------------------------------------------------------------------------------------

    def components(self, points: Array) -> tuple[Array, Array, Array]:
        """Posterior means, deviations and noises (components, m) at points (m, dimension), in units of the worst."""
        # Rasmussen & Williams, equations 2.25 and 2.26, for every hypothesis: μ_j + Vᵀ L⁻¹ (y − μ_j), v_j² − |V|²
        prior, V = self._projected(points)
        means = prior.means + np.einsum("jim,ji->jm", V, self._residuals)
        variances = prior.spreads**2 - np.einsum("jim,jim->jm", V, V)
        return means, np.sqrt(np.maximum(variances, 1e-10)), self._noises(means)

    def _projected(self, points: Array) -> tuple[_Prior, Array]:
        """Prior moments at points (m, dimension), and V (components, n, m): Vᵀ V is the covariance that observations
        explain. The latest results are kept, because one decision needs the same points several times.
        """
        key = points.tobytes()
        if key not in self._recent:
            prior = self._prior(points)
            cross = self._kernel.correlation(self._points, points, self._ages[:, None])
            cross *= self._at_data.spreads[:, :, None] * prior.spreads[:, None, :]
            if len(self._recent) == RECENT:
                self._recent.pop(next(iter(self._recent)))
            self._recent[key] = prior, self._inverses @ cross
        return self._recent[key]

    def _noises(self, means: Array) -> Array:
        return np.asarray(self._least_noises[:, None] + self._growths[:, None] * np.clip(means, 0.0, 1.0))

    def covariances(self, first: Array, second: Array) -> Array:
        """Posterior covariances (components, m, k) of f between points (m, dimension) and others (k, dimension)."""
        (at_first, V), (at_second, W) = self._projected(first), self._projected(second)
        covariance = self._kernel.correlation(first, second)
        covariance *= at_first.spreads[:, :, None] * at_second.spreads[:, None, :]
        return np.asarray(covariance - V.transpose(0, 2, 1) @ W)

    def differences(self, points: Array, place: Array) -> Array:
        """Posterior deviations (components, m) of f(points) − f(place), place (dimension,)."""
        covariance = self.covariances(points, place[None, :])[:, :, 0]
        deviations, at_place = self.components(points)[1], self.components(place[None, :])[1]
        return np.sqrt(np.maximum(deviations**2 + at_place**2 - 2.0 * covariance, 1e-12))

    # -- moments of the cost ---------------------------------------------------------------------------------------

    def predict(self, points: Array) -> tuple[Array, Array]:
        """See `Surrogate.predict`: moments of the cost, which is between 0 and the worst."""
        # Moments of a mixture: E = Σ w_j E_j, Var = Σ w_j E_j[c²] − E²
        means, deviations, _ = self.components(points)
        first, second = clipped_moments(means, deviations)
        mean = self.mixture @ first
        return self.worst * mean, self.worst * np.sqrt(np.maximum(self.mixture @ second - mean**2, 1e-12))

    def noise_at(self, points: Array) -> Array:
        """Standard deviations of single real observations at points (m, dimension): (m,), in the cost's unit."""
        if not len(points):
            return np.empty(0)
        return self.worst * np.sqrt(self.mixture @ self.components(points)[2] ** 2)

    def exceedance(self, points: Array, loss: float) -> Array:
        """Probabilities (m,) that an observation at points (m, dimension) is above a loss."""
        means, deviations, noises = self.components(points)
        return np.asarray(self.mixture @ ndtr((means - loss / self.worst) / np.hypot(deviations, noises)))

    def bands(self, points: Array, level: float) -> Array:
        """Shortest intervals (m, 2), in the cost's unit, that contain single observations at points (m, dimension)."""
        means, deviations, noises = self.components(points)
        return self.worst * highest_density_intervals(self.mixture, means, np.hypot(deviations, noises), level)

    # -- summaries -------------------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> dict[str, float]:
        """Parameters of the hypotheses, by name."""
        noise = self.worst * float(self.mixture @ self._least_noises)
        return {"noise": noise, "simulated_noise": self.simulated.noise, "uninformative": self.uninformative}

    def displaced(self) -> tuple[Array, Array, float]:
        """Shift of the cube's centre (dimension,), its deviation, and the median factor on the cost."""
        weights = self._trusting / max(self._trusting.sum(), 1e-300)
        shifts = 0.5 * (self._all.scales - 1.0) + self._all.shifts
        mean = weights @ shifts
        deviation = np.sqrt(np.maximum(weights @ (shifts - mean) ** 2, 0.0))
        order = np.argsort(self._all.gains, kind="stable")
        median = order[np.searchsorted(np.cumsum(weights[order]), 0.5).clip(max=len(order) - 1)]
        return np.asarray(mean), np.asarray(deviation), float(np.exp(self._all.gains[median]))

    @property
    def drifts(self) -> Array | None:
        """Change per observation of the shift of the cube's centre (dimension,), 0 where its sign is uncertain; None
        unless the bench probably drifts.
        """
        kept, drifting = self._kept, self._kept.fading > 0.0
        if self.mixture[: len(drifting)][drifting].sum() < NOTICED:
            return None
        shift, factor = np.split(kept.drifts[drifting, :-2], 2, axis=1)
        steps = shift + factor * (0.5 + kept.origin)
        mean = steps.mean(axis=0)
        return np.where(np.abs(mean) > steps.std(axis=0), mean, 0.0)

    def drawn(self, count: int) -> tuple[Array, Array]:
        """Scales and shifts (count, dimension) of bench offsets drawn from the posterior, evenly by their weight."""
        chosen = _evenly_drawn(self._trusting, count)
        return self._all.scales[chosen], self._all.shifts[chosen]

    @property
    def heaviest(self) -> tuple[Hypotheses, Array]:
        """The hypotheses used for predictions, and their weights."""
        return self._kept, self.mixture[: len(self._kept.gains)]


def _covariances(prior: _Prior, kernel: _Kernel, points: Array, ages: Array | None = None) -> Array:
    """Covariances (J, n, n) of the observations."""
    n = len(points)
    # K_j = v_j(x) v_j(x′) M_{ℓ_j}(x, x′) e^{−κ_j |Δn|} + n_j(x)² 1
    apart = None if ages is None else np.abs(ages[:, None] - ages)
    K = kernel.correlation(points, points, apart) * prior.spreads[:, :, None] * prior.spreads[:, None, :]
    K[:, np.arange(n), np.arange(n)] += prior.noises**2
    return np.asarray(K)


def _sequential(means: Array, K: Array, costs: Array) -> tuple[Array, Array]:
    """Log probabilities (J, n) of costs (n,), with covariances K, given those before them; standardised residuals."""
    L = np.linalg.cholesky(K)
    # Residuals L⁻¹ (y − μ): the i-th is (y_i − E[y_i | y_<i]) / L_ii, L_ii its conditional deviation. The
    # probability of an interval [low, high] of it is Φ(high) − Φ(low), from the side on which it is not a
    # difference of numbers near 1.
    residuals = np.linalg.solve(L, (costs - means)[:, :, None])[:, :, 0]
    deviations = np.diagonal(L, axis1=1, axis2=2)
    high = np.where(costs > TOTAL, np.inf, residuals + 0.5 * RESOLUTION / deviations)
    low = np.where(costs > TOTAL, residuals - (costs - TOTAL) / deviations, residuals - 0.5 * RESOLUTION / deviations)
    low = np.where(costs < 0.5 * RESOLUTION, -np.inf, low)
    chances = np.where(low > 0.0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    return np.log(np.maximum(chances, LEAST_CHANCE)), np.asarray(residuals)


def _least(simulated: GaussianProcess) -> Array:
    """The simulated place (dimension,) with the least expected cost."""
    return np.asarray(simulated.points[int(np.argmin(simulated.predict(simulated.points)[0]))])


def latent_size(dimension: int) -> int:
    """Number of latent variables of a hypothesis about a still bench."""
    return 2 * dimension + 8


def drift_size(dimension: int) -> int:
    """Number of further latent variables of a drift."""
    return 2 * dimension + 3


def _steepness(costs: Array) -> Array:
    """Change of costs with a shift of the stream, relative to that of half a load: φ(Φ⁻¹(c)) / φ(0)."""
    return np.asarray(np.exp(-0.5 * ndtri(np.clip(costs, 0.5 * RESOLUTION, 1.0 - 0.5 * RESOLUTION)) ** 2))


def clipped_moments(means: Array, deviations: Array) -> tuple[Array, Array]:
    """E clip(f, 0, 1) and E clip(f, 0, 1)² of normal f."""
    # With l = −m/s, u = (1 − m)/s: E c = m (Φ(u) − Φ(l)) + s (φ(l) − φ(u)) + 1 − Φ(u) and
    # E c² = (m² + s²) (Φ(u) − Φ(l)) + s (m φ(l) − (m + 1) φ(u)) + 1 − Φ(u), moments of a censored normal.
    low, high = -means / deviations, (1.0 - means) / deviations
    below, under = ndtr(low), ndtr(high)
    p, q, above = _density(low), _density(high), 1.0 - under
    first = means * (under - below) + deviations * (p - q) + above
    second = (means**2 + deviations**2) * (under - below) + deviations * (means * p - (means + 1.0) * q) + above
    return np.clip(first, 0.0, 1.0), np.clip(second, 0.0, 1.0)


def clipped_mean(means: Array, deviations: Array) -> Array:
    """E clip(f, 0, 1) of normal f."""
    low, high = -means / deviations, (1.0 - means) / deviations
    under = ndtr(high)
    first = means * (under - ndtr(low)) + deviations * (_density(low) - _density(high)) + 1.0 - under
    return np.asarray(np.clip(first, 0.0, 1.0))


def shortfall(level: Array | float, means: Array, deviations: Array) -> Array:
    """E (level − f)⁺ of normal f."""
    # Expected improvement (Jones, Schonlau & Welch 1998, equation 15): (l − m) Φ(u) + s φ(u), u = (l − m) / s
    u = (level - means) / deviations
    return np.asarray((level - means) * ndtr(u) + deviations * _density(u))


def _density(u: Array) -> Array:
    return np.asarray(np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi))


def _evenly_drawn(weights: Array, count: int) -> NDArray[np.int_]:
    """Hypotheses (count,), drawn at even steps of their weights (J,), heaviest first."""
    order = np.argsort(-weights, kind="stable")
    levels = (np.arange(count) + 0.5) / count * weights.sum()
    return np.asarray(order[np.searchsorted(np.cumsum(weights[order]), levels).clip(max=len(order) - 1)])


def _log_sum(logs: Array) -> float:
    return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))


def _evenly(bounds: tuple[float, float], u: Array) -> Array:
    low, high = bounds
    return np.asarray(low * (high / low) ** u)
