"""Means over repetitions with 95 % intervals. Pure functions of numbers; the same numbers give the same interval.

Student's t for means and for mean differences: of normal numbers it covers 95 %, however few they are. The percentile
bootstrap covers 83 % of five and 91 % of ten; it is kept for what is not a mean.

What one strategy gains over another: differences of a repetition, at the same level and into the same receiver.

Beside these, a pair shares little. C1 to C4 have the repetition's weighed pours, and are scored with the same seeds.
Deployments have the bench's systematic errors in common, and all but D2 the repetition's θ*; the chance of each pour
comes from the strategy's own seeds. Only pours of final actions share it, one by one (`FinalPour`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orchestrator.study.report.cell_results import Gathered, Key, mean

RESAMPLES = 4_000
COVERED = 0.95

Range = tuple[float, float]
"""Least and largest value that a quantity can have."""

ANYTHING: Range = (-math.inf, math.inf)
SHARE: Range = (0.0, 1.0)


@dataclass(frozen=True)
class Estimate:
    """A mean over repetitions.

    Attributes:
        low, high: of the interval; NaN where there are fewer than two repetitions.
        count: repetitions.
    """

    mean: float
    low: float
    high: float
    count: int

    def scaled(self, factor: float) -> Estimate:
        """In another unit."""
        return Estimate(factor * self.mean, factor * self.low, factor * self.high, self.count)

    def text(self, decimals: int = 2) -> str:
        """'1.23 [0.80, 1.71]'; '—' where nothing is known."""
        if math.isnan(self.mean):
            return "—"
        if math.isnan(self.low):
            return f"{self.mean:.{decimals}f}"
        return f"{self.mean:.{decimals}f} [{self.low:.{decimals}f}, {self.high:.{decimals}f}]"


def estimate(values: Sequence[float], within: Range = ANYTHING) -> Estimate:
    """Mean of one number a repetition, with Student's t interval; NaN are left out.

    Args:
        within: what the quantity can be; the interval ends there, or at a mean that a balance's noise puts beyond.

    Source: Student, The probable error of a mean, Biometrika 6, 1908.
    Limitations: repetitions are taken for independent and their mean for normal. Where nearly all are alike and a few
        far off, as with cups that touch now and then, five repetitions may show none of these, and the interval is too
        narrow.
    """
    from scipy.special import stdtrit

    known = np.array([value for value in values if not math.isnan(value)], dtype=np.float64)
    count = len(known)
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    mean = float(known.mean())
    if count < 2:
        return Estimate(mean, math.nan, math.nan, count)
    half = float(stdtrit(count - 1, (1 + COVERED) / 2) * known.std(ddof=1) / math.sqrt(count))
    least, largest = min(within[0], mean), max(within[1], mean)
    return Estimate(mean, max(mean - half, least), min(mean + half, largest), count)


def difference_of(within: Range) -> Range:
    """What a difference of two such quantities can be."""
    return within[0] - within[1], within[1] - within[0]


def statistic(
    repetitions: Sequence[Sequence[float]], of: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Estimate:
    """What is not a mean, with the percentile bootstrap's interval: whole repetitions are drawn, with replacement.

    Args:
        repetitions: (n, m) numbers.
        of: from (…, n, m) numbers to (…).
    """
    data = np.array(repetitions, dtype=np.float64)
    count = len(data)
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    mean = float(of(data))
    if count < 2:
        return Estimate(mean, math.nan, math.nan, count)
    drawn = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    low, high = np.quantile(of(data[drawn]), [(1 - COVERED) / 2, (1 + COVERED) / 2])
    return Estimate(mean, float(low), float(high), count)


ALL = "all"
"""In place of a receiver: the mean over all of them, repetition by repetition."""

FEWEST = 5
"""Repetitions below which nothing is tested: with four the smallest two-sided probability is 1/8."""

MOST_CHANGES = 1 << 14
"""Sign changes that are tried: all of them up to 14 repetitions, so many random ones beyond."""


@dataclass(frozen=True)
class Effect:
    """A difference of two strategies; below 0 the first is better.

    Attributes:
        difference: mean over the repetitions that both have, with the t interval of paired differences.
        better: repetitions in which the first is better.
        probability: two-sided, of a mean at least as far from 0 if signs were chance (all 2ⁿ sign changes are tried);
            None with fewer than `FEWEST` repetitions.
    """

    difference: Estimate
    better: int
    probability: float | None


def effect(first: Mapping[int, float], second: Mapping[int, float], within: Range = ANYTHING) -> Effect:
    """The difference of values by repetition; repetitions that only one has, or that are NaN, are left out.

    Args:
        within: what a value can be.

    Source: Fisher's randomisation test of paired differences (The Design of Experiments, 1935, section 21).
    """
    both = [first[n] - second[n] for n in sorted(first.keys() & second.keys())]
    known = [difference for difference in both if not math.isnan(difference)]
    return Effect(estimate(known, difference_of(within)), sum(d < 0.0 for d in known), _chance(known))


def _chance(differences: Sequence[float]) -> float | None:
    from scipy.stats import permutation_test

    if len(differences) < FEWEST:
        return None
    values = np.asarray(differences)
    test = permutation_test((values,), np.mean, permutation_type="samples", n_resamples=MOST_CHANGES, rng=0)
    return float(test.pvalue)


def at_pour_of(found: Gathered, level: str, receivers: Sequence[str], arm: str, pour: int) -> dict[int, float]:
    """Least loss up to a pour by repetition: the mean over receivers, of the repetitions that have all of them."""
    each = [found.by_repetition(Key(level, receiver, arm), pour) for receiver in receivers]
    shared = set.intersection(*map(set, each)) if each else set()
    return {number: mean([values[number] for values in each]) for number in sorted(shared)}


def tests_of(found: Gathered, strategy: str) -> dict[int, float]:
    """Test discrepancy by repetition."""
    one = found.calibrated[strategy]
    return dict(zip(one.numbers, map(mean, one.test), strict=True))
