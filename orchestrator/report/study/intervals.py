"""Means with 95 % bootstrap intervals. Pure functions of numbers; the same numbers give the same interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 4_000
COVERED = 0.95


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


def estimate(values: Sequence[float]) -> Estimate:
    """Mean of one number a repetition, with the percentile bootstrap's interval; NaN are left out."""
    known = [value for value in values if not math.isnan(value)]
    return statistic([[value] for value in known], lambda rows: rows.mean(axis=(-2, -1)))


def statistic(
    repetitions: Sequence[Sequence[float]], of: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Estimate:
    """Any statistic of repetitions with its interval: whole repetitions are drawn, with replacement.

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
