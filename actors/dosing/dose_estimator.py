"""Estimates a pour from tilt and balance while it runs: particles with an ensemble Kalman update.

Every particle is one hypothesis about cup, flow and balance. `DoseEstimator.advance` moves them with the tilt that the
arm reports; `DoseEstimator.update` corrects them with a time-stamped reading:

    q = c·q_cup(V, θ − b),    V' = −q,    m' = ρq
    load = m(t − t_f) + ρq(t − t_f)·t_f                      (the impact of liquid that falls from rest)
    y = four first-order lags of the load in a row, of ρ_s·T, (1 − ρ_s)T/3, (1 − ρ_s)T/3, (1 − ρ_s)T/3

- `DoseBelief` holds the values that one dose passes on to the next one. `DoseBelief.prior` makes the first one;
  `calibrated_knowledge` is what a calibration adds to it.
- `draw_lags` draws lags of the balance from the step when the empty receiver is put on it
  (`actors.balance.step_response`).
The filter of a balance is rarely documented. Its total lag T decides the error of a dose, its shape ρ_s only the
transients: 1 is a first-order lag, 1/4 four equal poles; a moving average lies near 1/3.

A reading that equals the one before is either repeated or new, and happens to round to the same value. The particles
give the probability L of the second case, the display's probability p of a repeat is known from earlier readings, so

    P(new | equal) = (1 − p) L / (p + (1 − p) L)

is the share of the update that is applied. A new reading is an interval of one display step, not a point: a particle
that predicts a value within this interval stays where it is. Without this, several equal readings in a slow flow would
count as several measurements.

Source of the update: Burgers, van Leeuwen & Evensen, Mon. Weather Rev. 126 (1998): perturbed observations. Particles
are moved instead of weighted, so that a hundred of them do not collapse on a sharp balance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from actors.balance.step_response import FILTERS, LAGS, step_response
from actors.dosing.cup_flow import CupFlow, median
from actors.dosing.display_belief import REPEATS, DisplayBelief, Repeats
from actors.interfaces import DoseKnowledge
from sim_engine.liquids import SimulationParameters

Floats = NDArray[np.float64]

TIME_STEP = 0.025
"""Time step of the particles [s]."""

LAG_RANGE = (0.03, 2.5)
"""Lags that a balance can have [s]."""

SURPRISE = 2.0
"""Innovation, in standard deviations, above which lag and shape learn less from a reading."""

ONSET = (math.radians(0.8), math.radians(1.2))
"""Onset bias before the first dose, mean and standard deviation [rad]: a dry lip holds liquid back, and the grip of the
vessel is known to the tolerance of `SimulationParameters.tilt_zero`."""

FLOW_FACTOR = (1.0, 0.2)
"""Flow factor before the first dose: median, and standard deviation of its logarithm."""

LARGEST_CHANGE = 2.4
"""Change of the flow factor in one dose above which its belief is doubted: four deviations before the first one."""

FIRST_AIM = 0.3e-3
"""`DoseBelief.aim` of the first dose, if its last stream leaves the lip cleanly [kg]."""

SHAPE_RANGE = (0.22, 1.0)
FACTOR_RANGE = (0.05, 2.0)

TRANSPORT_DELAY = (0.06, 0.03)
"""Mean and standard deviation of the delay from the balance's filter to the time stamp of a reading [s]."""

WETTING = 1.5
"""Time in which the liquid wets the lip, and onset and flow change faster [s]."""

LATE = (0.35e-3, 0.4)
"""What drains from lip and film after the flow has ended: standard deviation [kg], and the time that it takes [s]."""

FLOW_NOISE = 0.014
"""Standard deviation of a reading from slosh and impact, as the time that the flow needs for it [s]."""

INDIFFERENT = 0.1e-3
"""A reading that is off by no more is not taken for a repeated one: it does not matter [kg]."""

END_NOISE = 0.05
"""The same where the flow falls: the film is cut later or earlier, and with it ends the impact [s]."""

NOISE_RANGE = (0.25, 30.0)
"""Range of the factor of the variance of readings."""

NOISE_READINGS = 10.0
"""Readings after which the factor follows a further one half as fast as at first."""

LARGEST_SQUARE = 16.0
"""Largest squared innovation, over its variance, that counts for the factor: a gush is no noise."""


@dataclass(frozen=True)
class DoseReading:
    """One reading of the balance.

    Attributes:
        time: of its arrival, on the clock of the controller [s].
        mass: as displayed [kg].
        stable: whether the balance reports it as stable.
    """

    time: float
    mass: float
    stable: bool = False


@dataclass(frozen=True)
class DoseBelief:
    """The state of knowledge before a dose; arrays (N,), one value for each particle.

    Attributes:
        onset_bias: tilt by which outflow begins later than the equation says [rad].
        flow_factor: true flow over the equation's.
        lag: total lag of the balance [s].
        lag_shape: ρ_s of the balance's filter.
        volume: in the source vessel [m³].
        aim: mass to subtract from the target, because it arrives after the predicted end of the flow [kg].
        doses: number of doses that it was estimated from.
        display: of the balance.
    """

    onset_bias: Floats
    flow_factor: Floats
    lag: Floats
    lag_shape: Floats
    volume: Floats
    aim: float = FIRST_AIM
    doses: int = 0
    display: DisplayBelief = field(default_factory=DisplayBelief)

    @classmethod
    def prior(
        cls,
        volume: tuple[float, float],
        lag: tuple[Floats, Floats],
        rng: np.random.Generator,
    ) -> DoseBelief:
        """A belief before the first dose.

        Args:
            volume: mean and standard deviation of the source's content [m³].
            lag: lags and their shapes (N,) each, see `draw_lags`.
            rng: draws the particles.
        """
        # Independent: b ~ N(ONSET), log c ~ N(log 1, FLOW_FACTOR[1]²), V ~ N(volume), V ≥ 0
        count = len(lag[0])
        draws = np.stack([_even_normal(count, rng) for _ in range(3)])
        return cls(
            ONSET[0] + ONSET[1] * draws[0],
            np.clip(FLOW_FACTOR[0] * np.exp(FLOW_FACTOR[1] * draws[1]), *FACTOR_RANGE),
            np.asarray(lag[0], dtype=float),
            np.asarray(lag[1], dtype=float),
            np.maximum(volume[0] + volume[1] * draws[2], 0.0),
        )

    @classmethod
    def known(
        cls,
        knowledge: DoseKnowledge,
        volume: tuple[float, float],
        lag: tuple[Floats, Floats],
        rng: np.random.Generator,
    ) -> DoseBelief:
        """A belief from what earlier doses have shown; onset and flow keep their correlation.

        Args:
            knowledge: of the earlier doses; if it has a lag, that one counts.
            volume, lag, rng: see `prior`.
        """
        count = len(lag[0])
        lag_mean, shape_mean = np.asarray(lag[0], dtype=float), np.asarray(lag[1], dtype=float)
        if knowledge.lag is not None:
            middle, deviation, shape, spread = knowledge.lag
            lag_mean = np.clip(np.exp(middle + deviation * _even_normal(count, rng)), *LAG_RANGE)
            shape_mean = np.clip(shape + spread * _even_normal(count, rng), *SHAPE_RANGE)
        # (b, log c) = mean + L z, L Lᵀ = covariance, z standard normal
        root = np.linalg.cholesky(np.reshape(knowledge.covariance, (2, 2)) + 1e-12 * np.eye(2))
        draws = root @ np.stack([_even_normal(count, rng) for _ in range(2)])
        return cls(
            knowledge.onset_flow[0] + draws[0],
            np.clip(np.exp(knowledge.onset_flow[1] + draws[1]), *FACTOR_RANGE),
            lag_mean,
            shape_mean,
            np.maximum(volume[0] + volume[1] * _even_normal(count, rng), 0.0),
            knowledge.aim,
            knowledge.doses,
            DisplayBelief.of(knowledge.display) if knowledge.display else DisplayBelief(),
        )

    def knowledge(self) -> DoseKnowledge:
        """The moments of the belief, for `known`."""
        pair = np.stack([self.onset_bias, np.log(self.flow_factor)])
        log_lag = np.log(self.lag)
        values = (log_lag.mean(), log_lag.std(), self.lag_shape.mean(), self.lag_shape.std())
        return DoseKnowledge(
            tuple(map(float, pair.mean(axis=1))),
            tuple(map(float, np.cov(pair).ravel())),
            tuple(map(float, values)),
            self.aim,
            self.doses,
            self.display.numbers,
        )

    def refilled(self, volume: tuple[float, float], rng: np.random.Generator) -> DoseBelief:
        """The belief after the source was filled and weighed.

        Args:
            volume: mean and standard deviation of its content [m³].
            rng: draws the particles.
        """
        return replace(self, volume=volume[0] + volume[1] * _even_normal(len(self.volume), rng))

    def widened(self, rng: np.random.Generator) -> DoseBelief:
        """The belief for the next dose: onset and flow differ a little from pour to pour (wetting, temperature)."""
        # Random walk from dose to dose: 0.2° of b, 5 % of c, 3 % of T, 0.02 of ρ_s (standard deviations)
        count = len(self.volume)
        return replace(
            self,
            onset_bias=self.onset_bias + math.radians(0.2) * _even_normal(count, rng),
            flow_factor=np.clip(self.flow_factor * np.exp(0.05 * _even_normal(count, rng)), *FACTOR_RANGE),
            lag=np.clip(self.lag * np.exp(0.03 * _even_normal(count, rng)), *LAG_RANGE),
            lag_shape=np.clip(self.lag_shape + 0.02 * _even_normal(count, rng), *SHAPE_RANGE),
            display=self.display.aged(),
        )


@dataclass(frozen=True)
class Seen:
    """A reading compared with the one before.

    Attributes:
        new: probability that it is a new one.
        likelihood: of the reading for each particle (N,), if it equals the one before.
    """

    new: float
    likelihood: Floats | None


class DoseEstimator:
    """The particles of one dose.

    Args:
        cup: flow of the source vessel.
        belief: before the dose.
        fall_time: of the stream from the lip to the receiver [s].
        step: of the balance's display [kg].
        noise: standard deviation of a reading besides the display's step [kg].
        rng: draws all randomness.

    Attributes:
        time: of the particles [s].
        mass: past the lip (N,) [kg].
        flow: now (N,) [m³/s].
        zero: reading of the balance for an empty receiver, minus the true one (N,) [kg]: the display's step hides it.
        repeats: of the display.
        noise: factor of the variance of a reading.
        innovations: mean of the squared innovations of new readings over their predicted variance; about 1 if the
            estimate is as uncertain as it states.
    """

    def __init__(
        self,
        cup: CupFlow,
        belief: DoseBelief,
        *,
        fall_time: float,
        step: float,
        noise: float,
        rng: np.random.Generator,
    ) -> None:
        self.cup, self._rng = cup, rng
        self._fall, self._sigma, self._half = fall_time, noise, 0.5 * step
        count = len(belief.volume)
        self.zero = step * rng.permutation((np.arange(count) + 0.5) / count - 0.5)
        self.repeats = Repeats(belief.display.repeats)
        self.noise, self._jitter = belief.display.noise, belief.display.jitter
        self._age = belief.display.interval / math.sqrt(12.0)  # deviation of a uniform age within one interval [s]
        self._last: float | None = None
        self._log_weight = np.zeros(count)
        self._squares = [0.0, 0.0]
        self.onset_bias, self.flow_factor = belief.onset_bias.copy(), belief.flow_factor.copy()
        self.lag, self.lag_shape = belief.lag.copy(), belief.lag_shape.copy()
        self.volume = belief.volume.copy()
        self._belief = belief
        self.mass, self.flow = np.zeros(count), np.zeros(count)
        self._flowed = np.zeros(count)  # duration of the flow [s]
        self._ended = np.full(count, math.inf)  # time since the end of the flow [s]
        self._middle_flow = self._recent_flow = 0.0  # median now, and its decaying maximum [kg/s]
        self._lags = np.zeros((4, count))
        places = max(math.ceil(fall_time / TIME_STEP) + 2, 3)
        self._mass_history, self._flow_history = np.zeros((places, count)), np.zeros((places, count))
        self._before = np.zeros(count)  # predicted reading one step ago
        self.time, self._tilt = 0.0, 0.0
        self._steps = 0
        self._noise = np.zeros((0, 3, count))

    @property
    def reading(self) -> Floats:
        """Predicted reading now (N,) [kg]."""
        last: Floats = self._lags[3]
        return last

    def start(self, time: float, tilt: float) -> None:
        """Set the time [s] and the tilt [rad] from which `advance` continues."""
        self.time, self._tilt = time, tilt

    def advance(self, time: float, tilt: float) -> None:
        """Move the particles up to a time, in whole steps; the tilt changes linearly until then.

        Args:
            time: [s].
            tilt: measured at that time [rad].
        """
        left = time - self.time
        while left >= TIME_STEP - 1e-9:
            self._tilt += (tilt - self._tilt) * min(TIME_STEP / left, 1.0)
            self._step(self._tilt)
            self.time += TIME_STEP
            left = time - self.time

    def _step(self, tilt: float) -> None:
        cup = self.cup
        if self._steps % 64 == 0:
            self._noise = self._rng.standard_normal((64, 3, len(self.mass))) * math.sqrt(TIME_STEP)
        noise = self._noise[self._steps % 64]
        # Euler step of V' = −q, m' = ρq with q = c q_cup(h, θ), h = head(V, θ − b), q ≤ V / dt
        head = cup.head(self.volume, tilt - self.onset_bias)
        if head.max() > 0.0:
            flow = self.flow_factor * cup.flow(head, tilt)
            flow = np.where(head > 0.0, np.minimum(flow, self.volume / TIME_STEP), 0.0)
            flows = flow > 0.0
            self.volume -= flow * TIME_STEP
            gained = cup.density * flow * TIME_STEP
            self.mass += gained + 0.02 * cup.density * flow * noise[0]
            # Flow and onset wander, because wetting and film are not constant: Brownian motion of log c (0.03/√s) and b
            # (0.1°/√s), three times as fast while the lip gets wet.
            self._flowed = np.where(flows, self._flowed + TIME_STEP, self._flowed)
            wetting = np.where(self._flowed < WETTING, 3.0, 1.0) * flows
            self.flow_factor *= np.exp(0.03 * wetting * noise[1])
            self.onset_bias += math.radians(0.1) * wetting * noise[2]
            self.flow = flow
            self._ended = np.where(flows, 0.0, self._ended + TIME_STEP)
        elif not self.mass.any():  # nothing has flowed yet, and everything below stays zero
            self._steps += 1
            return
        else:
            self.flow = np.zeros_like(self.mass)
            self._ended += TIME_STEP
        self._middle_flow = cup.density * median(self.flow)
        # Peak of the flow with exponential decay over the time that the display still shows it: 0.3 s and its lag
        memory = 0.3 + float(self.lag[0])
        self._recent_flow = max(self._middle_flow, self._recent_flow * (1.0 - TIME_STEP / memory))
        if self._ended.min() < 4.0 * LATE[1]:
            # Late liquid: m' = e^(−t/τ) / τ · aim, τ = LATE[1], whose integral over t ≥ 0 is `aim`; LATE[0] of scatter
            late = np.where(self._ended > 0.0, np.exp(-self._ended / LATE[1]), 0.0) / LATE[1]
            self.mass += late * (self._belief.aim * TIME_STEP + LATE[0] * math.sqrt(LATE[1]) * noise[0])
        self._steps += 1
        slot = self._steps % len(self._mass_history)
        self._mass_history[slot], self._flow_history[slot] = self.mass, self.flow
        # load = m(t − t_f) + ρ q(t − t_f) t_f [kg], linear between steps: impact of a stream that falls from rest,
        # ρ q v with v = g t_f [N], over g
        back = self._fall / TIME_STEP
        steps, fraction = int(back), back - int(back)
        first, second = (slot - steps) % len(self._mass_history), (slot - steps - 1) % len(self._mass_history)
        landed = (1.0 - fraction) * self._mass_history[first] + fraction * self._mass_history[second]
        impact = (1.0 - fraction) * self._flow_history[first] + fraction * self._flow_history[second]
        load = landed + cup.density * self._fall * impact
        self._before = self._lags[3].copy()
        slow, fast = self.lag_shape * self.lag, (1.0 - self.lag_shape) * self.lag / 3.0
        # First-order lags τ y' = u − y, implicit Euler: y += dt/(τ + dt) (u − y), whose mean delay is exactly τ
        gain_slow, gain_fast = TIME_STEP / (slow + TIME_STEP), TIME_STEP / (fast + TIME_STEP)
        lags = self._lags
        lags[0] += gain_slow * (load - lags[0])
        for k in (1, 2, 3):
            lags[k] += gain_fast * (lags[k - 1] - lags[k])

    def predicted(self, time: float) -> Floats:
        """Predicted reading at a time within the last step or after it (N,) [kg]."""
        share = min(max((self.time - time) / TIME_STEP, 0.0), 1.0)
        predicted: Floats = (1.0 - share) * self._lags[3] + share * self._before
        return predicted

    @property
    def innovations(self) -> float:
        """See the class."""
        total, count = self._squares
        return total / count if count else 1.0

    def deviation(self) -> float:
        """Standard deviation of a new reading at the current flow: display, slosh and impact [kg]."""
        return math.hypot(self._half / math.sqrt(3.0), self._scatter())

    def _scatter(self) -> float:
        """The same before the display rounds [kg]."""
        # σ² = noise · (σ_0² + (σ_t q)² + (END_NOISE (q_peak − q))²) [kg²]: an error of time counts as flow times time,
        # σ_t² = slosh² + jitter² + age² [s²]
        falls = max(self._recent_flow - self._middle_flow, 0.0)
        # a display that repeats most readings converts at times of its own
        age = self._age * float(self.repeats.weights(0) @ REPEATS)
        return math.sqrt(self.noise) * math.hypot(
            self._sigma, math.hypot(FLOW_NOISE, self._jitter, age) * self._middle_flow, END_NOISE * falls
        )

    def seen(self, reading: DoseReading) -> Seen:
        """Compare a reading with the one before, and learn from it how often the display repeats one.

        Args:
            reading: see `update`.
        """
        equal = self._last is not None and abs(reading.mass - self._last) < 1e-9
        self._last = reading.mass
        if not equal:
            self.repeats.see(False, 0.0)
            return Seen(1.0, None)
        off = self.predicted(reading.time) + self.zero - reading.mass
        # particles are a coarse sample of the prediction: each stands for its neighbourhood
        width = math.hypot(self._scatter(), 0.3 * float(off.std()), INDIFFERENT, 0.5 * self._half)
        # L_i = P(display shows the same | particle i) = Φ((half − off_i) / w) − Φ((−half − off_i) / w); the likelihood
        # of an equal reading, repeated or new, is p + (1 − p) L_i
        chance = _normal((self._half - off) / width) - _normal((-self._half - off) / width)
        repeated = self.repeats.next
        new = self.repeats.see(True, float(chance.mean()))
        return Seen(new, repeated + (1.0 - repeated) * chance)

    def update(self, reading: DoseReading, sigma: float | None = None, *, seen: Seen | None = None) -> float:
        """Correct the particles with a reading net of the receiver.

        Args:
            reading: its time lies within the last step, or shortly after it.
            sigma: standard deviation of the reading [kg], if it is not one line of the display.
            seen: of this reading, if the caller has it already.

        Returns:
            Innovation: reading minus the mean prediction [kg].
        """
        if sigma is None:
            seen = self.seen(reading) if seen is None else seen
            if seen.likelihood is not None:
                return self._weigh(reading, seen)
        # Ensemble Kalman update with perturbed observations (Burgers, van Leeuwen & Evensen 1998): for a
        # state x_i with the prediction y_i,
        #     x_i += cov(x, y) / (var(y) + σ²) · (reading_i − y_i),
        # reading_i − y_i is measured from y_i + ε_i to the nearest value in reading ± half, ε ~ N(0, σ²)
        self._resample(0.999)
        predicted = self.predicted(reading.time) + self.zero
        scatter, half = (self._scatter(), self._half) if sigma is None else (sigma, 0.0)
        innovation = reading.mass - float(predicted.mean())
        centred = predicted - predicted.mean()
        variance = float(centred @ centred) / (len(predicted) - 1)
        deviation = math.sqrt(scatter**2 + half**2 / 3.0)  # half² / 3: variance of a uniform rounding error
        if sigma is None:
            self._note(innovation**2 / max(variance + deviation**2, 1e-16))
        scattered = predicted + scatter * _even_normal(len(predicted), self._rng)
        perturbed = np.clip(scattered, reading.mass - half, reading.mass + half) - scattered
        shift = perturbed / max(variance + scatter**2, 1e-16) / (len(predicted) - 1)

        # cov(x, y) = Σ (x_i − x̄)(y_i − ȳ) / (N − 1)
        def gained(values: Floats) -> Floats:
            return float((values - values.mean()) @ centred) * shift

        # a gush that the model lacks must not count as lag
        calm = min(1.0, SURPRISE * math.sqrt(variance + deviation**2) / max(abs(innovation), 1e-9))
        log_factor, log_lag = np.log(self.flow_factor), np.log(self.lag)
        changes = [gained(v) for v in (self.onset_bias, log_factor, log_lag, self.lag_shape, self.volume, self.mass)]
        zero = gained(self.zero)
        self._lags += np.stack([gained(lag) for lag in self._lags])
        self.zero += zero
        self.onset_bias += changes[0]
        self.flow_factor = np.clip(np.exp(log_factor + changes[1]), *FACTOR_RANGE)
        self.lag = np.clip(np.exp(log_lag + calm * changes[2]), *LAG_RANGE)
        self.lag_shape = np.clip(self.lag_shape + calm * changes[3], *SHAPE_RANGE)
        self.volume = np.clip(self.volume + changes[4], 0.0, self.cup.capacity)
        self.mass += changes[5]
        self._mass_history += changes[5]
        return innovation

    def _weigh(self, reading: DoseReading, seen: Seen) -> float:
        """Weight the particles with an equal reading, which may be a repeated one."""
        assert seen.likelihood is not None
        innovation = reading.mass - float((self.predicted(reading.time) + self.zero).mean())
        self._log_weight += np.log(seen.likelihood)
        self._resample(0.5)
        return innovation

    def _resample(self, share: float) -> None:
        """Draw the particles according to their weights, if fewer than a share of them have an effect."""
        # Effective number 1 / Σ w² (Kong, Liu & Wong 1994); systematic resampling at (k + u) / N (Kitagawa 1996)
        weight = np.exp(self._log_weight - self._log_weight.max())
        weight /= weight.sum()
        count = len(weight)
        if 1.0 / float(weight @ weight) > share * count:
            return
        places = (np.arange(count) + self._rng.random()) / count
        chosen = np.minimum(np.searchsorted(np.cumsum(weight), places), count - 1)
        self._log_weight = np.zeros(count)
        for name in (
            "onset_bias",
            "flow_factor",
            "lag",
            "lag_shape",
            "volume",
            "mass",
            "flow",
            "zero",
            "_ended",
            "_flowed",
        ):
            setattr(self, name, getattr(self, name)[chosen])
        for name in ("_lags", "_mass_history", "_flow_history"):
            setattr(self, name, getattr(self, name)[:, chosen])
        self._before = self._before[chosen]
        # Copies of one particle must not stay the same: they are spread by a fifth of the ensemble's deviation.
        self.onset_bias = self.onset_bias + 0.2 * float(self.onset_bias.std()) * _even_normal(count, self._rng)
        spread = 0.2 * float(np.log(self.flow_factor).std())
        self.flow_factor = np.clip(self.flow_factor * np.exp(spread * _even_normal(count, self._rng)), *FACTOR_RANGE)
        spread = 0.2 * float(np.log(self.lag).std())
        self.lag = np.clip(self.lag * np.exp(spread * _even_normal(count, self._rng)), *LAG_RANGE)

    def _note(self, square: float) -> None:
        """Note a squared innovation over its predicted variance; the noise of readings follows their mean."""
        self._squares[0] += square
        self._squares[1] += 1.0
        # Robbins & Monro 1951: log noise += (ε² − 1) / (NOISE_READINGS + n), at rest where the mean of ε² is 1
        pull = (min(square, LARGEST_SQUARE) - 1.0) / (NOISE_READINGS + self._squares[1])
        self.noise = min(max(self.noise * math.exp(pull), NOISE_RANGE[0]), NOISE_RANGE[1])

    def loosen(self) -> None:
        """Allow more for onset and flow, because the readings did not follow them."""
        count = len(self.volume)
        self.onset_bias = self.onset_bias + math.radians(0.6) * _even_normal(count, self._rng)
        self.flow_factor = np.clip(self.flow_factor * np.exp(0.1 * _even_normal(count, self._rng)), *FACTOR_RANGE)

    def flows_unexpectedly(self, reading: DoseReading, rate: float) -> None:
        """Let the particles pour a stream that arrived before any of them expected it.

        An ensemble that does not flow has no covariance with a reading that rises, and would not follow it. The
        particles get flows spread evenly between none and twice the observed one; `update` chooses among them.

        Args:
            reading: net of the receiver, which none of them predicts.
            rate: at which the readings rise [kg/s].
        """
        # A stream with the constant flow ρq_i: a stage of the balance that lags by T_k shows m − ρq_i (t_f + T_k);
        # onset b_i = θ − tilt(V, head(q_i / c_i))
        share = self._rng.permutation((np.arange(len(self.mass)) + 0.5) / len(self.mass)) * 2.0
        density, tilt = self.cup.density, self._tilt
        flow = share * rate / density
        head = self.cup.head_for(flow / self.flow_factor, tilt)
        self.onset_bias = np.minimum(self.onset_bias, tilt - self.cup.tilt_for(self.volume, head))
        shown = share * reading.mass
        self.mass = shown + density * flow * (self._fall + self.lag)
        self.flow = flow
        slow, fast = self.lag_shape * self.lag, (1.0 - self.lag_shape) * self.lag / 3.0
        for k in range(4):
            late = self._fall + slow + k * fast
            self._lags[k] = np.maximum(self.mass - density * flow * late, 0.0)
        places = len(self._mass_history)
        for age in range(places):
            slot = (self._steps - age) % places
            self._mass_history[slot] = np.maximum(self.mass - density * flow * age * TIME_STEP, 0.0)
            self._flow_history[slot] = flow
        self._before = np.maximum(self._lags[3] - density * flow * TIME_STEP, 0.0)

    def final_mass(
        self,
        tilt: float,
        speed: float,
        *,
        latency: float,
        back: float,
        acceleration: float,
        highest: float = math.inf,
    ) -> Floats:
        """Mass past the lip after a return that is ordered now (N,) [kg].

        Args:
            tilt: now [rad].
            speed: of the tilt now [rad/s].
            latency: until the arm begins to follow the order [s].
            back: speed of the return, positive [rad/s].
            acceleration: of the return [rad/s²].
            highest: tilt at which the arm stops until then [rad].
        """
        # The same V' = −q, m' = ρq without noise, while the tilt's speed falls with the acceleration to −back
        volume, total = self.volume.copy(), self.mass.copy()
        dt, elapsed = 0.02, 0.0
        while elapsed < latency + 0.6:
            if elapsed >= latency:
                speed = max(speed - acceleration * dt, -back)
            tilt = max(min(tilt + speed * dt, highest), tilt + min(speed, 0.0) * dt)
            head = self.cup.head(volume, tilt - self.onset_bias)
            if head.max() <= 0.0 and elapsed >= latency:
                break
            flow = np.where(head > 0.0, self.flow_factor * self.cup.flow(head, tilt), 0.0)
            volume -= flow * dt
            total += self.cup.density * flow * dt
            elapsed += dt
        return total

    def belief(self, *, weighed: float | None, aim: float, missing: float = 0.0) -> DoseBelief:
        """The belief after this dose.

        No cup's flow changes by `LARGEST_CHANGE` from one dose to the next: then half of the particles are as they were
        before this one, which may have misled the others. A stream that missed the receiver says nothing of the cup.

        Args:
            weighed: amount in the receiver after the dose [kg]; None if it is unknown.
            aim: see `DoseBelief.aim`.
            missing: left the cup besides, with a standard deviation of its half [kg].
        """
        volume = self.volume
        if weighed is not None:  # the content of the receiver has left the source
            volume = np.maximum(self._belief.volume - weighed / self.cup.density, 0.0)
        if missing > 0.0:
            gone = missing * (1.0 + 0.5 * _even_normal(len(volume), self._rng)) / self.cup.density
            return replace(self._belief, volume=np.maximum(volume - gone, 0.0), aim=aim)
        onset_bias, flow_factor = self.onset_bias.copy(), self.flow_factor.copy()
        if abs(float(np.log(flow_factor).mean() - np.log(self._belief.flow_factor).mean())) > math.log(LARGEST_CHANGE):
            onset_bias[::2], flow_factor[::2] = self._belief.onset_bias[::2], self._belief.flow_factor[::2]
        display = replace(self._belief.display, repeats=self.repeats.beta(), noise=self.noise)
        return DoseBelief(
            onset_bias, flow_factor, self.lag, self.lag_shape, volume, aim, self._belief.doses + 1, display
        )


def calibrated_knowledge(tilt_zeros: Sequence[float]) -> DoseKnowledge:
    """What is known before the first dose after a calibration that searched the grip of the vessel.

    Outflow begins earlier by the tilt that the vessel is held in addition. The posterior of this tilt replaces its
    tolerance in `ONSET`. What a dry lip holds back, and the flow factor, remain as they are: no parameter of the
    simulator stands for them.

    Args:
        tilt_zeros: equally likely draws of `SimulationParameters.tilt_zero` [rad].
    """
    draws = np.asarray(tilt_zeros, dtype=float)
    tolerance = SimulationParameters.info()["tilt_zero"].tolerance
    # Var b: the tolerance's part of ONSET is replaced by the posterior's, Var = σ² − tolerance² + Var(tilt_zero)
    variance = ONSET[1] ** 2 - tolerance**2 + float(draws.var())
    pair = (ONSET[0] - float(draws.mean()), math.log(FLOW_FACTOR[0]))
    return DoseKnowledge(pair, (variance, 0.0, 0.0, FLOW_FACTOR[1] ** 2), None, FIRST_AIM, 0)


def _normal(values: Floats) -> Floats:
    """Standard normal distribution function."""
    from scipy.special import ndtr  # slow import, not needed to check files

    return np.asarray(ndtr(values), dtype=float)


def draw_lags(
    placed: Sequence[DoseReading], count: int, rng: np.random.Generator, *, step: float = 1e-4
) -> tuple[Floats, Floats]:
    """Draw lags and shapes that explain the rise of a balance when the receiver was put on it.

    The moment of the placing is unknown, so a pure delay cannot be seen in the rise: `TRANSPORT_DELAY` is added.

    Args:
        placed: readings from before the step until it has settled; if they do not follow one step, the prior is drawn:
            0.33 s, times or divided by 1.65.
        count: number of particles.
        rng: draws them.
        step: of the display [kg].

    Returns:
        Total lags [s] and shapes, (count,) each.
    """
    delay = np.clip(TRANSPORT_DELAY[0] + TRANSPORT_DELAY[1] * _even_normal(count, rng), 0.0, None)
    try:
        response = step_response([r.time for r in placed], [r.mass for r in placed], resolution=step)
    except ValueError:
        lag = np.exp(math.log(0.33) + math.log(1.65) * _even_normal(count, rng))
        return np.clip(lag + delay, *LAG_RANGE), rng.permutation(np.linspace(0.25, 1.0, count))
    cells = rng.choice(response.probability.size, size=count, p=response.probability.ravel())
    shapes = np.array([shape for shape, _ in FILTERS.values()])
    jitter = 1.0 + 0.05 * _even_normal(count, rng)
    return (
        np.clip(LAGS[cells % len(LAGS)] * jitter + delay, *LAG_RANGE),
        np.clip(shapes[cells // len(LAGS)] + 0.03 * _even_normal(count, rng), *SHAPE_RANGE),
    )


_QUANTILES: dict[int, Floats] = {}


def _even_normal(count: int, rng: np.random.Generator) -> Floats:
    """Standard normal numbers (count,) that cover the distribution evenly, in random order; mean 0, deviation 1."""
    if count not in _QUANTILES:
        from statistics import NormalDist

        even = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
        _QUANTILES[count] = even / even.std()
    return rng.permutation(_QUANTILES[count])
