"""The numbers of a study: results of its cells, means over repetitions with 95 % intervals, and paired differences.

- `gather` collects the finished cells in a `Gathered`; an unfinished study is allowed.
- `estimate` calculates a mean with Student's t interval. For normal data it covers 95 % at any sample size.
- `effect` compares two strategies by paired differences, at the same level and into the same receiver.

The same numbers yield the same interval. The pairs share the following random influences:

- C1 to C4 share the weighed pours of the repetition and the seeds of the scores.
- Deployments share the systematic errors of the bench, and all except D2 share the θ* of the repetition.
- The random errors of each pour come from the strategy's own seeds, except for pours of final actions, which share them
  one by one (`FinalPour`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import CALIBRATED, UNCALIBRATED, Scores
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.records.codec import result_of
from orchestrator.runs.stages import CALIBRATION, EVALUATION
from orchestrator.study.study_folder import CellResult
from orchestrator.study.study_plan import FINAL, StudyPlan, cells_of
from orchestrator.study.study_strategies import FinalResult

RANDOM = "random θ"
"""Label of the random θ of a study, which count as one strategy."""

LEVEL = 100_000
"""Offset between the repetition numbers of different worlds, if calibrations are compared on all of them."""


@dataclass
class StrategyScores:
    """Results of one strategy in its repetitions at the compared level.

    Attributes:
        test, train: |r − c_s| of every pour, one list per repetition.
        simulations: simulations of each repetition; a grid that all repetitions score counts in full.
        results: results of the calibration stages; empty for the uncalibrated simulator.
        numbers: numbers of the repetitions.
        expected: C4 only: [simulations, expected mean |Δ|] of every chosen θ, one list per repetition.
    """

    test: list[list[float]] = field(default_factory=list)
    train: list[list[float]] = field(default_factory=list)
    simulations: list[int] = field(default_factory=list)
    results: list[Calibrated] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    expected: list[tuple[tuple[int, float], ...]] = field(default_factory=list)


@dataclass(frozen=True)
class Key:
    """Place of pours: level, name of the receiver, label of the deployment."""

    level: str
    receiver: str
    strategy: str


@dataclass(frozen=True)
class Final:
    """A pour of a recommended action. Without a spillage, because nothing or almost nothing was poured, it counts as
    all spilled; a pour that was not made has the worst loss, too."""

    loss: float
    spillage: float
    made: bool


@dataclass
class Gathered:
    """All finished results of a study.

    Attributes:
        calibrated: results by label, `UNCALIBRATED` first if present.
        losses: losses of all pours in order, one list per repetition; NaN for a pour without a loss.
        numbers: numbers of these repetitions.
        finals: pours of the recommended action, by repetition.
        cells, finished: number of cells, and of finished ones.
        simulations, pours: number of simulations and pours made.
        cpu_s, seconds: CPU time and wall time of all cells [s].
    """

    calibrated: dict[str, StrategyScores] = field(default_factory=dict)
    losses: dict[Key, list[list[float]]] = field(default_factory=dict)
    numbers: dict[Key, list[int]] = field(default_factory=dict)
    finals: dict[Key, dict[int, list[Final]]] = field(default_factory=dict)
    cells: int = 0
    finished: int = 0
    simulations: int = 0
    pours: int = 0
    cpu_s: float = 0.0
    seconds: float = 0.0

    def best_so_far(self, key: Key) -> list[list[float]]:
        """Smallest loss up to each pour, one list per repetition; the lists can differ in length (D1 pours once)."""
        return [running_least(losses) for losses in self.losses.get(key, [])]

    def by_repetition(self, key: Key, pour: int) -> dict[int, float]:
        """Smallest loss up to a pour, by number of the repetition."""
        return dict(zip(self.numbers.get(key, []), at_pour(self.best_so_far(key), pour), strict=True))


def gather(study: StudyPlan, results: Mapping[str, CellResult]) -> Gathered:
    """Collect the results of the finished cells.

    Args:
        results: results by cell, as returned by `read_result`.
    """
    cells = cells_of(study)
    pooled = Gathered(cells=len(cells))
    levels = [level.name for level in study.levels]
    order = [UNCALIBRATED, RANDOM, *(compared.label for compared in study.calibrations)]
    receivers = {scene.name: scene.receiver.name for compared in study.deployments for scene in compared.plan.scenes}
    for cell in cells:
        if cell.id not in results:
            continue
        data = results[cell.id]
        pooled.finished += 1
        pooled.simulations += data.simulations
        pooled.pours += data.pours
        pooled.cpu_s += data.cpu_s
        pooled.seconds += data.seconds
        if cell.kind in ("calibration", "uncalibrated") and study.compares(cell.level):
            # repetitions in different worlds count separately: each has its own number
            number = cell.repetition + LEVEL * levels.index(cell.level)
            if _differences(data, "test", random=True):
                _add(pooled.calibrated.setdefault(RANDOM, StrategyScores()), number, data, random=True)
            _add(pooled.calibrated.setdefault(cell.strategy or UNCALIBRATED, StrategyScores()), number, data)
        elif cell.kind == "deployment":
            key = Key(cell.level, receivers[cell.receiver], cell.strategy)
            pooled.losses.setdefault(key, []).append(_losses(data))
            pooled.numbers.setdefault(key, []).append(cell.repetition)
        elif cell.kind == "final":
            key = Key(cell.level, receivers[cell.receiver], cell.strategy)
            final = result_of(data.results, FINAL, FinalResult)
            pour = Final(final.loss, 1.0 if final.spillage is None else final.spillage, final.made)
            pooled.finals.setdefault(key, {}).setdefault(cell.repetition, []).append(pour)
    pooled.calibrated = {name: pooled.calibrated[name] for name in order if name in pooled.calibrated}
    return pooled


def _differences(data: CellResult, split: str, *, random: bool) -> list[float]:
    """|measured − simulated| of the pours of a split: of the calibrated θ, or of all random θ."""
    return [
        abs(pair.measured - pair.simulated)
        for pair in result_of(data.results, EVALUATION, Scores).pairs
        if pair.split == split
        and (pair.theta.startswith("random ") if random else pair.theta == CALIBRATED)
        and pair.measured is not None
        and pair.simulated is not None
    ]


def _add(scores: StrategyScores, number: int, data: CellResult, *, random: bool = False) -> None:
    scores.numbers.append(number)
    scores.test.append(_differences(data, "test", random=random))
    scores.train.append([] if random else _differences(data, "train", random=False))
    result = None if random or CALIBRATION not in data.results else result_of(data.results, CALIBRATION, Calibrated)
    scores.simulations.append(0 if result is None else result.simulations)
    if result is not None:
        scores.results.append(result)
        scores.expected.append(data.expected)


def _losses(data: CellResult) -> list[float]:
    (deployed,) = (stage for stage in data.results.values() if isinstance(stage, Deployed))
    counted = [pour for pour in deployed.pours if pour.status in ("weighed", "failed")]
    return [math.nan if pour.loss is None else pour.loss for pour in counted]


def running_least(values: Sequence[float]) -> list[float]:
    """Smallest value up to each place; NaN before the first number."""
    best, running = math.nan, []
    for value in values:
        if not math.isnan(value):
            best = value if math.isnan(best) else min(best, value)
        running.append(best)
    return running


def mean(values: Sequence[float]) -> float:
    """Mean without NaN; NaN if there is no number."""
    defined = [value for value in values if not math.isnan(value)]
    return sum(defined) / len(defined) if defined else math.nan


def at_pour(curves: Sequence[Sequence[float]], pour: int) -> list[float]:
    """Value of each repetition at a pour, from 1; its last value if it has fewer pours (D1 repeats its only action)."""
    return [curve[min(pour, len(curve)) - 1] for curve in curves if curve]


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

    defined = np.array([value for value in values if not math.isnan(value)], dtype=np.float64)
    count = len(defined)
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    mean = float(defined.mean())
    if count < 2:
        return Estimate(mean, math.nan, math.nan, count)
    half = float(stdtrit(count - 1, (1 + COVERED) / 2) * defined.std(ddof=1) / math.sqrt(count))
    least, largest = min(within[0], mean), max(within[1], mean)
    return Estimate(mean, max(mean - half, least), min(mean + half, largest), count)


def difference_of(within: Range) -> Range:
    """Possible range of a difference of two quantities with this range."""
    return within[0] - within[1], within[1] - within[0]


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
    defined = [difference for difference in both if not math.isnan(difference)]
    return Effect(estimate(defined, difference_of(within)), sum(d < 0.0 for d in defined), _chance(defined))


def _chance(differences: Sequence[float]) -> float | None:
    from scipy.stats import permutation_test

    if len(differences) < FEWEST:
        return None
    values = np.asarray(differences)
    test = permutation_test((values,), np.mean, permutation_type="samples", n_resamples=MOST_CHANGES, rng=0)
    return float(test.pvalue)


def tests_of(pooled: Gathered, strategy: str) -> dict[int, float]:
    """Test discrepancy by repetition."""
    scores = pooled.calibrated[strategy]
    return dict(zip(scores.numbers, map(mean, scores.test), strict=True))
