"""Conversion of the results of a study's cells to the numbers of its figures and tables.

`gather` collects the finished cells in a `Gathered`; an unfinished study is allowed. Intervals and tests are calculated
in `statistics`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from orchestrator.journal.codec import result_of
from orchestrator.runs.stages import CALIBRATION, EVALUATION
from orchestrator.strategies.calibration.calibration_base import Calibrated
from orchestrator.strategies.calibration.calibration_scores import CALIBRATED, UNCALIBRATED, Scores
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.study.study_folder import CellResult
from orchestrator.study.study_plan import FINAL, StudyPlan, cells_of
from orchestrator.study.study_strategies import FinalPoured

RANDOM = "random θ"
"""Label of the random θ of a study, which count as one strategy."""

LEVEL = 100_000
"""Offset between the repetition numbers of different benches, if calibrations are compared on all of them."""


@dataclass
class Found:
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
    arm: str


@dataclass(frozen=True)
class Final:
    """A pour of a recommended action. A pour that was not made has the worst loss and counts as all spilled."""

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

    calibrated: dict[str, Found] = field(default_factory=dict)
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
    found = Gathered(cells=len(cells))
    levels = [level.name for level in study.levels]
    order = [UNCALIBRATED, RANDOM, *(arm.label for arm in study.calibrations)]
    receivers = {scene.name: scene.receiver.name for arm in study.deployments for scene in arm.plan.scenes}
    for cell in cells:
        if cell.id not in results:
            continue
        data = results[cell.id]
        found.finished += 1
        found.simulations += data.simulations
        found.pours += data.pours
        found.cpu_s += data.cpu_s
        found.seconds += data.seconds
        if cell.kind in ("calibration", "uncalibrated") and study.compares(cell.level):
            # repetitions on different benches count separately: each has its own number
            number = cell.repetition + LEVEL * levels.index(cell.level)
            _note_random(found.calibrated.setdefault(RANDOM, Found()), number, data)
            _note_calibration(found.calibrated.setdefault(cell.arm or UNCALIBRATED, Found()), number, data)
        elif cell.kind == "deployment":
            key = Key(cell.level, receivers[cell.receiver], cell.arm)
            found.losses.setdefault(key, []).append(_losses(data))
            found.numbers.setdefault(key, []).append(cell.repetition)
        elif cell.kind == "final":
            key = Key(cell.level, receivers[cell.receiver], cell.arm)
            one = result_of(data.results, FINAL, FinalPoured)
            pour = Final(one.loss, one.spillage, one.made)
            found.finals.setdefault(key, {}).setdefault(cell.repetition, []).append(pour)
    found.calibrated = {
        name: found.calibrated[name]
        for name in order
        if name in found.calibrated and (name != RANDOM or found.calibrated[name].test)
    }
    return found


def _note_random(noted: Found, number: int, data: CellResult) -> None:
    """Record the random θ as one arm: all their differences together, if a cell scored them."""
    pairs = [
        (pair.split, abs(pair.measured - pair.simulated))
        for pair in result_of(data.results, EVALUATION, Scores).pairs
        if pair.theta.startswith("random ") and pair.measured is not None and pair.simulated is not None
    ]
    if not pairs:
        return
    noted.test.append([difference for split, difference in pairs if split == "test"])
    noted.train.append([])
    noted.numbers.append(number)
    noted.simulations.append(0)


def _note_calibration(noted: Found, number: int, data: CellResult) -> None:
    pairs = [
        (pair.split, abs(pair.measured - pair.simulated))
        for pair in result_of(data.results, EVALUATION, Scores).pairs
        if pair.theta == CALIBRATED and pair.measured is not None and pair.simulated is not None
    ]
    noted.test.append([difference for split, difference in pairs if split == "test"])
    noted.train.append([difference for split, difference in pairs if split == "train"])
    noted.numbers.append(number)
    result = result_of(data.results, CALIBRATION, Calibrated) if CALIBRATION in data.results else None
    noted.simulations.append(0 if result is None else result.simulations)
    if result is not None:
        noted.results.append(result)
        noted.expected.append(data.expected)


def _losses(data: CellResult) -> list[float]:
    (deployed,) = (one for one in data.results.values() if isinstance(one, Deployed))
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
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def at_pour(curves: Sequence[Sequence[float]], pour: int) -> list[float]:
    """Value of each repetition at a pour, from 1; its last value if it has fewer pours (D1 repeats its only action)."""
    return [curve[min(pour, len(curve)) - 1] for curve in curves if curve]
