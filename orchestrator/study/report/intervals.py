"""Means over repetitions with 95 % intervals. Pure functions of numbers; the same numbers give the same interval.

Student's t for means and for mean differences: of normal numbers it covers 95 %, however few they are. The percentile
bootstrap covers 83 % of five and 91 % of ten; it is kept for what is not a mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
