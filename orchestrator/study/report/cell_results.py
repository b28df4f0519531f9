"""From the results of a study's cells to the numbers that figures and tables are made of. Works with what is there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from orchestrator.journal.stage_results import result_of
from orchestrator.runs.stages import CALIBRATION, EVALUATION
from orchestrator.strategies.calibration.calibration_base import Calibrated
from orchestrator.strategies.calibration.calibration_scores import CALIBRATED, UNCALIBRATED, Scores
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.study.study_folder import CellResult
from orchestrator.study.study_plan import FINAL, StudyPlan, cells_of
from orchestrator.study.study_strategies import FinalPoured

RANDOM = "random θ"
"""Label of the θ that a study draws at random, all together."""

LEVEL = 100_000
"""Apart lie the numbers of repetitions on different benches, where calibrations are compared on all of them."""


@dataclass
class Found:
    """What one strategy found in its repetitions at the compared level.

    Attributes:
        test, train: |r − c_s| of every pour, one list a repetition.
        simulations: spent by each repetition; a grid that all of them score counts whole.
        results: of the calibration stages; none of the uncalibrated simulator.
        numbers: of the repetitions.
        expected: C4: [simulations, expected mean |Δ|] of every θ that was chosen, one list a repetition.
    """

    test: list[list[float]] = field(default_factory=list)
    train: list[list[float]] = field(default_factory=list)
    simulations: list[int] = field(default_factory=list)
    results: list[Calibrated] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    expected: list[tuple[tuple[int, float], ...]] = field(default_factory=list)


@dataclass(frozen=True)
class Key:
    """Where pours were made: level, receiver's name, label of the deployment."""

    level: str
    receiver: str
    arm: str


@dataclass(frozen=True)
class Final:
    """A pour of a recommended action. What could not be made has the worst loss, and counts as all spilled."""

    loss: float
    spillage: float
    made: bool


@dataclass
class Gathered:
    """Everything of a study that is finished.

    Attributes:
        calibrated: by label, `UNCALIBRATED` first where it is there.
        losses: loss of every pour in order, one list a repetition; NaN where a pour gave none.
        numbers: of these repetitions.
        finals: pours of the recommended action, by repetition.
        cells, finished: how many.
        simulations, pours: that were made.
        cpu_s, seconds: of all cells.
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
        """Least loss up to each pour, one list a repetition; all as long as the longest (D1 pours once)."""
        return [running_least(losses) for losses in self.losses.get(key, [])]

    def by_repetition(self, key: Key, pour: int) -> dict[int, float]:
        """Least loss up to a pour, by the repetition's number."""
        return dict(zip(self.numbers.get(key, []), at_pour(self.best_so_far(key), pour), strict=True))


def gather(study: StudyPlan, results: Mapping[str, CellResult]) -> Gathered:
    """Sort what the finished cells came to.

    Args:
        results: by cell, as `read_result` has them.
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
            # a repetition's number counts once: on each of several benches it has a number of its own
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
    """Random θ as if they were one arm: their differences together, where a cell scored them."""
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
    """Least value up to each place; NaN before the first that is a number."""
    best, running = math.nan, []
    for value in values:
        if not math.isnan(value):
            best = value if math.isnan(best) else min(best, value)
        running.append(best)
    return running


def mean(values: Sequence[float]) -> float:
    """NaN of nothing."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def at_pour(curves: Sequence[Sequence[float]], pour: int) -> list[float]:
    """Each repetition's value at a pour, from 1; its last one where it has fewer (D1 goes on with its one action)."""
    return [curve[min(pour, len(curve)) - 1] for curve in curves if curve]
