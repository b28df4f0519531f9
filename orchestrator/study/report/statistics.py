"""Means over repetitions with 95 % intervals, and paired differences of strategies.

All functions are pure: the same numbers yield the same interval.

- `estimate` calculates a mean with Student's t interval. For normal data it covers 95 % at any sample size.
- `statistic` uses the percentile bootstrap, for quantities other than means. Applied to means, it covers 83 % with five
  repetitions and 91 % with ten.
- `effect` compares two strategies by paired differences, at the same level and into the same receiver.

The pairs share the following random influences:

- C1 to C4 share the weighed pours of the repetition and the seeds of the scores.
- Deployments share the systematic errors of the bench, and all except D2 share the θ* of the repetition.
- The random errors of each pour come from the strategy's own seeds, except for pours of final actions, which share them
  one by one (`FinalPour`).
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
"""Smallest and largest possible value of a quantity."""

ANYTHING: Range = (-math.inf, math.inf)
SHARE: Range = (0.0, 1.0)


@dataclass(frozen=True)
class Estimate:
    """A mean over repetitions.

    Attributes:
        low, high: ends of the interval; NaN for fewer than two repetitions.
        count: number of repetitions.
    """

    mean: float
    low: float
    high: float
    count: int

    def scaled(self, factor: float) -> Estimate:
        """The estimate in another unit."""
        return Estimate(factor * self.mean, factor * self.low, factor * self.high, self.count)

    def text(self, decimals: int = 2) -> str:
        """'1.23 [0.80, 1.71]'; '—' without data."""
        if math.isnan(self.mean):
            return "—"
        if math.isnan(self.low):
            return f"{self.mean:.{decimals}f}"
        return f"{self.mean:.{decimals}f} [{self.low:.{decimals}f}, {self.high:.{decimals}f}]"


def estimate(values: Sequence[float], within: Range = ANYTHING) -> Estimate:
    """Mean of one number per repetition, with Student's t interval; NaN are left out.

    Args:
        within: possible range of the quantity. The interval is limited to it, or to a mean that a balance's noise moves
            outside.

    Source: Student, The probable error of a mean, Biometrika 6, 1908.
    Limitations: repetitions are assumed to be independent and their mean to be normal. Rare large deviations, as from
    cups that touch occasionally, may be absent in five repetitions; the interval is then too narrow.
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
    """Possible range of a difference of two quantities with this range."""
    return within[0] - within[1], within[1] - within[0]


def statistic(
    repetitions: Sequence[Sequence[float]], of: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Estimate:
    """Estimate of a quantity other than a mean, with the percentile bootstrap's interval over whole repetitions.

    Repetitions are drawn with replacement.

    Args:
        repetitions: (n, m) numbers.
        of: maps (…, n, m) numbers to (…).
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
"""Label used instead of a receiver for the mean over all receivers, calculated per repetition."""

FEWEST = 5
"""Minimum number of repetitions for a test: with four, the smallest two-sided probability is 1/8."""

MOST_CHANGES = 1 << 14
"""Maximum number of sign changes: all of them up to 14 repetitions, random ones beyond."""


@dataclass(frozen=True)
class Effect:
    """A difference of two strategies; below 0 the first one is better.

    Attributes:
        difference: mean over the common repetitions, with the t interval of paired differences.
        better: number of repetitions in which the first strategy is better.
        probability: two-sided probability of a mean at least as far from 0 under random signs (all 2ⁿ sign changes are
            tried); None with fewer than `FEWEST` repetitions.
    """

    difference: Estimate
    better: int
    probability: float | None


def effect(first: Mapping[int, float], second: Mapping[int, float], within: Range = ANYTHING) -> Effect:
    """Difference of values by repetition. Repetitions that only one side has, or with NaN, are left out.

    Args:
        within: possible range of a value.

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
    """Mean over receivers of the smallest loss up to a pour, for each repetition that has all receivers."""
    each = [found.by_repetition(Key(level, receiver, arm), pour) for receiver in receivers]
    shared = set.intersection(*map(set, each)) if each else set()
    return {number: mean([values[number] for values in each]) for number in sorted(shared)}


def tests_of(found: Gathered, strategy: str) -> dict[int, float]:
    """Test discrepancy by repetition."""
    one = found.calibrated[strategy]
    return dict(zip(one.numbers, map(mean, one.test), strict=True))
