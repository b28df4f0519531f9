"""Repeated readings: how often a display shows its last value again although the load has changed.

Balances convert more slowly than they send, or hold their display while the load moves. In ten recorded robot pours
onto a USB balance, 42 % of the readings repeat the one before, for up to 1.1 s (Kennedy et al. 2019, precision pouring,
University of Pennsylvania). `Repeats` infers the probability of a repeat from readings as they come; `DisplayBelief` is
what one dose passes on to the next.

A reading that equals the one before is either a repeated one, or a new one that rounds to the same value. With the
probability p of a repeat, and the probability L that a new reading would be equal,

    P(new | equal) = (1 − p) L / (p + (1 − p) L)

p has two values, after a new reading and after a repeated one: some balances send every conversion two or three times,
and others hold their display now and then for a second.

Limitations: a display that moves by noise while it is held counts as new.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Beta = tuple[float, float]

REPEATS = np.concatenate((np.array([0.002, 0.01, 0.025]), np.arange(0.05, 0.96, 0.05)))
"""Probabilities of a repeated reading that are compared."""

UNKNOWN_REPEATS = (0.3, 1.5)
"""Beta distribution of the probability of a repeat before the first reading: most balances never repeat one, and a few
repeat every second one."""

KNOWN_REPEATS = 10.0
"""Readings that the knowledge about repeats should amount to before a dose is refused because of them."""

LONGEST_MEMORY = 150.0
"""Readings that the knowledge about repeats amounts to at most, so that a balance whose mode was changed is noticed."""

RISING = (0.03, 0.97)
"""Part of a step of the load in which every new reading differs from the one before."""


@dataclass(frozen=True)
class DisplayBelief:
    """What is known about the display of a balance.

    Attributes:
        repeats: Beta distribution of the probability that a reading repeats the one before although the load has
            changed: after a new reading, and after a repeated one (2 × 2 numbers). Two numbers, because some balances
            send each conversion two or three times, and others hold their display now and then for a second.
        noise: factor of the variance of a reading.
        step: of the display [kg].
        interval: mean time between two readings [s].
        jitter: standard deviation of the time at which a reading arrives [s].
        longest: longest time between two readings [s].
    """

    repeats: tuple[Beta, Beta] = (UNKNOWN_REPEATS, UNKNOWN_REPEATS)
    noise: float = 1.0
    step: float = 1e-4
    interval: float = 0.1
    jitter: float = 0.0
    longest: float = 0.0

    @classmethod
    def placed(cls, times: Sequence[float], masses: Sequence[float], step: float) -> DisplayBelief:
        """What the readings show while the receiver is put on.

        During the rise the load changes by many display steps, so that each equal reading is a repeated one.

        Args:
            times: of the readings from before the rise until it has settled, increasing [s].
            masses: the readings [kg].
            step: of the display [kg].
        """
        repeats = Repeats(cls().repeats)
        if len(masses) < 2:
            return cls(step=step)
        low, high = (float(np.median(readings)) for readings in (masses[:3], masses[-3:]))
        for before, after in itertools.pairwise(masses):
            if low + RISING[0] * (high - low) < before < low + RISING[1] * (high - low):
                repeats.see(after == before, 0.0)
        gaps = np.diff(times)
        middle = float(np.median(gaps))
        # the median, because a lost reading leaves a gap of two intervals
        # deviation of a normal = 1.48 · median |x − median|; a gap is the difference of two times, hence √2
        jitter = 1.48 * float(np.median(np.abs(gaps - middle))) / math.sqrt(2.0)
        return cls(repeats.beta(), step=step, interval=middle, jitter=jitter, longest=float(np.max(gaps)))

    @classmethod
    def of(cls, numbers: Sequence[float]) -> DisplayBelief:
        """The belief with these `numbers`."""
        a, b, c, d, *others = numbers
        return cls(((a, b), (c, d)), *others)

    @classmethod
    def expected(cls, step: float, interval: float, repeated: float) -> DisplayBelief:
        """The belief about a display whose data sheet is known.

        Args:
            step: of the display [kg].
            interval: between two readings [s].
            repeated: share of repeated readings.
        """
        # Beta with the mean `repeated` and the weight of 20 readings
        beta = (20.0 * max(repeated, 0.005), 20.0 * (1.0 - max(repeated, 0.005)))
        return cls((beta, beta), step=step, interval=interval)

    @property
    def numbers(self) -> tuple[float, ...]:
        """The belief as numbers, for `of`."""
        times = (self.interval, self.jitter, self.longest)
        return (*self.repeats[0], *self.repeats[1], self.noise, self.step, *times)

    @property
    def new_reading_interval(self) -> float:
        """Mean time between two new readings [s], as far as the share of repeated ones is known."""
        (repeated, new), _ = self.repeats
        return self.interval * ((repeated + new) / new if repeated + new > KNOWN_REPEATS else 1.0)

    def draws(self, rng: np.random.Generator) -> Iterator[bool]:
        """Whether each of the following readings repeats the one before, without end."""
        chances, repeated = [a / (a + b) for a, b in self.repeats], False
        while True:
            repeated = bool(rng.random() < chances[repeated])
            yield repeated

    def aged(self) -> DisplayBelief:
        """The belief with the weight of `LONGEST_MEMORY` readings at most, so that another mode of it is noticed."""
        first, second = (_shortened(pair) for pair in self.repeats)
        return replace(self, repeats=(first, second))

    def joined(self, other: DisplayBelief) -> DisplayBelief:
        """This belief with the evidence of a newer one that knew nothing before."""
        x, y = UNKNOWN_REPEATS
        pairs = zip(self.repeats, other.repeats, strict=True)
        first, second = ((a + max(c - x, 0.0), b + max(d - y, 0.0)) for (a, b), (c, d) in pairs)
        return replace(other, repeats=(first, second), noise=self.noise)


IDEAL_DISPLAY = DisplayBelief.expected(1e-4, 0.1, 0.0)
"""A display of 0.1 g that repeats no reading."""


class Repeats:
    """Probability of a repeated reading, from readings as they come.

    Args:
        beta: see `DisplayBelief.repeats`.
    """

    def __init__(self, beta: tuple[Beta, Beta]) -> None:
        self._log = [_log_beta(*pair) for pair in beta]
        self._state = 0
        self.run = 0.0

    def weights(self, state: int | None = None) -> Floats:
        """Probabilities of `REPEATS`."""
        return _normalised(self._log[self._state if state is None else state])

    @property
    def next(self) -> float:
        """Probability that the next reading repeats the last one."""
        return float(self.weights() @ REPEATS)

    def see(self, equal: bool, chance: float) -> float:
        """Learn from one reading.

        Args:
            equal: it equals the one before.
            chance: probability that a new reading equals the one before.

        Returns:
            Probability that the reading is a new one.
        """
        # Bayes over p in REPEATS: likelihood 1 − p of a different reading, p + (1 − p) L of an equal one, L = chance.
        repeated = self.next
        if not equal:
            self._log[self._state] = self._log[self._state] + np.log1p(-REPEATS)
            self._state, self.run = 0, 0.0
            return 1.0
        self._log[self._state] = self._log[self._state] + np.log(REPEATS + (1.0 - REPEATS) * chance)
        new = (1.0 - repeated) * chance / (repeated + (1.0 - repeated) * chance)
        self._state = int(new < 0.5)
        self.run = self.run + math.log(max(repeated, 1e-3)) if new < 0.5 else 0.0
        return new

    def beta(self) -> tuple[Beta, Beta]:
        """The Beta distributions with the moments of the two probabilities."""
        first, second = (_beta_of(self.weights(state)) for state in (0, 1))
        return first, second

    def in_a_row(self, chance: float) -> int:
        """Number of repeated readings that are followed by a further one with less than a probability."""
        # P(n repeats) ≤ start · on^(n − 1) < chance, hence n = 1 + ⌈log(chance / start) / log on⌉
        start, on = (_upper(self._log[state].tobytes()) for state in (0, 1))
        return 1 + max(math.ceil(math.log(chance / start) / math.log(on)), 0) if start > chance else 0


@functools.lru_cache(maxsize=8)
def _upper(log: bytes) -> float:
    """The probability of a repeat that is exceeded with 20 %: asked many times between two readings."""
    weights = _normalised(np.frombuffer(log))
    return float(REPEATS[min(int(np.searchsorted(np.cumsum(weights), 0.8)), len(REPEATS) - 1)])


def _normalised(log: Floats) -> Floats:
    weights: Floats = np.exp(log - log.max())
    weights /= weights.sum()
    return weights


def _log_beta(a: float, b: float) -> Floats:
    """Logarithm of a Beta distribution at `REPEATS`, up to a constant; each stands for its part of 0 … 1."""
    # (a − 1) log p + (b − 1) log(1 − p), plus the width of the interval around p
    edges = np.concatenate(([0.0], 0.5 * (REPEATS[1:] + REPEATS[:-1]), [1.0]))
    log: Floats = (a - 1.0) * np.log(REPEATS) + (b - 1.0) * np.log1p(-REPEATS) + np.log(np.diff(edges))
    return log


def _shortened(beta: Beta) -> Beta:
    share = min(LONGEST_MEMORY / sum(beta), 1.0)
    return beta[0] * share, beta[1] * share


def _beta_of(weights: Floats) -> Beta:
    """The Beta distribution with the mean and variance of weighted `REPEATS`."""
    # Moments: a = m n, b = (1 − m) n with n = m (1 − m) / v − 1
    mean = float(weights @ REPEATS)
    variance = max(float(weights @ (REPEATS - mean) ** 2), 1e-5)
    count = max(mean * (1.0 - mean) / variance - 1.0, 0.5)
    return mean * count, (1.0 - mean) * count
