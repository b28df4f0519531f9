"""What one strategy gains over another: differences of a repetition, at the same level and into the same receiver.

Beside these, a pair shares little. C1 to C4 have the repetition's weighed pours, and are scored with the same seeds.
Deployments have the bench's systematic errors in common, and all but D2 the repetition's θ*; the chance of each pour
comes from the strategy's own seeds. Only pours of final actions share it, one by one (`FinalPour`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orchestrator.study.report.gather import Gathered, Key, mean
from orchestrator.study.report.intervals import ANYTHING, Estimate, Range, difference_of, estimate

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
