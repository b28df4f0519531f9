"""Tables of a study: discrepancies of the calibrations, losses of the deployments, effects, pours to the same loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orchestrator.results.loss_units import deployment_unit
from orchestrator.strategies.calibration.calibration_base import Calibrated
from orchestrator.strategies.calibration.calibration_scores import UNCALIBRATED
from orchestrator.study.report.cell_results import RANDOM, Gathered, Key, at_pour, mean
from orchestrator.study.report.deployment_figures import (
    CAPTION,
    checkpoints,
    final_effects,
    final_rows,
    loss_range,
    mean_loss,
    most_pours,
    places,
)
from orchestrator.study.report.figure_panels import is_ours
from orchestrator.study.report.statistics import (
    ALL,
    SHARE,
    Effect,
    Estimate,
    at_pour_of,
    effect,
    estimate,
    statistic,
    tests_of,
)
from orchestrator.study.study_plan import StudyPlan

TABLE_POURS = (1, 3, 15)

_PAIRED = (
    "Mean differences, paired by repetition, level and receiver [95 % t interval of these differences]; below 0 the "
    "first is better. C1 to C4 of a repetition share its weighed pours and the seeds that they are scored with. "
    "Deployments share the bench's systematic errors, and all but D2 the θ* of the repetition; the chance errors of "
    "their pours are drawn for each, but final actions' pours share them one by one. Probability: that chance alone "
    "gives such a difference (sign changes of the repetitions' differences); '—' below five repetitions. Many rows "
    "are tested: one in twenty is below 0.05 by chance."
)
_NEEDED = (
    "The loss that both D2 and D3 reach: the larger of their mean least losses after the last pour. Pours until the "
    "mean of the least loss so far is there, with 95 % intervals: percentile bootstraps over the repetitions, too "
    "narrow with ten or fewer; a resampled mean that never gets there counts as one pour more than there were."
)


@dataclass(frozen=True)
class StudyTable:
    """A table. Its cells are texts, numbers, or estimates (three columns in CSV)."""

    name: str
    title: str
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str | int | float | Estimate]]

    def flat(self) -> tuple[list[str], list[list[object]]]:
        """Header and rows for CSV."""
        header: list[str] = []
        for i, name in enumerate(self.header):
            wide = any(isinstance(row[i], Estimate) for row in self.rows)
            header += [name, f"{name}, low", f"{name}, high"] if wide else [name]
        rows: list[list[object]] = []
        for row in self.rows:
            flat: list[object] = []
            for value in row:
                flat += [value.mean, value.low, value.high] if isinstance(value, Estimate) else [value]
            rows.append(flat)
        return header, rows


def tables(study: StudyPlan, found: Gathered) -> list[StudyTable]:
    """All tables for which there is data."""
    made = []
    if found.calibrated:
        made.append(_calibrations(study, found))
    if rows := [
        *_calibration_effects(study, found),
        *_deployment_effects(study, found),
        *_final_effects(study, found),
    ]:
        made.append(
            StudyTable(
                "table-effects",
                "Who gains how much",
                _PAIRED,
                ("compared", "of", "mismatch", "receiver", "repetitions", "difference", "better in", "probability"),
                rows,
            )
        )
    if found.finals:
        made.append(
            StudyTable("table-final", "The recommended action, poured again", CAPTION, *final_rows(study, found))
        )
    if found.losses:
        made.append(_deployments(study, found))
        if rows := _needed(study, found):
            made.append(
                StudyTable(
                    "table-pours",
                    "Pours to the same loss",
                    _NEEDED,
                    ("mismatch", "receiver", "loss", "D2", "D3"),
                    rows,
                )
            )
    return made


def _calibrations(study: StudyPlan, found: Gathered) -> StudyTable:
    rows: list[list[str | int | float | Estimate]] = []
    for name, one in found.calibrated.items():
        spent = "0" if name in (UNCALIBRATED, RANDOM) else f"{mean([float(n) for n in one.simulations]):.0f}"
        if name == "C1":
            spent += " (scored from one grid)"
        values = [mean(test) for test in one.test]
        trained = [mean(train) for train in one.train]
        rows.append(
            [
                name,
                spent,
                len(one.test),
                estimate(trained, SHARE).scaled(100),
                estimate(values, SHARE).scaled(100),
                _thetas(one.results),
            ]
        )
    return StudyTable(
        "table-calibration",
        "Discrepancy of the calibrated simulators",
        f"Mean |measured − simulated| of the normalised spillage, mean over repetitions [95 % t interval], at "
        f"{study.compared} mismatch. Uncalibrated: searched parameters at their defaults. Repetitions weigh the same "
        f"{study.pour_count} actions anew, and keep {study.holdout} of them for testing: test pours recur between "
        "repetitions. C1's share one simulated grid, too: its interval has the chance of pours, and none of the grid's "
        "simulations.",
        ("strategy", "simulations", "repetitions", "training pours [%]", "test pours [%]", "θ*, mean ± deviation"),
        rows,
    )


PAIRS = (
    ("C4", "C3"),
    ("C4", "C2"),
    ("C4", "C1"),
    ("C4", "C4-paper"),
    ("C4", UNCALIBRATED),
    ("C4", RANDOM),
    ("C4-active", "C4"),
    ("C4-paper", "C3"),
    ("C3", "C2"),
)
"""Pairs of calibrations whose test discrepancies are compared; calibrations of packages are compared with C4."""

ARMS = (("D3", "D2"), ("D3", "D3-paper"), ("D3-paper", "D2"), ("D3-paper", "D2-paper"), ("D2", "D2-paper"))
"""Pairs of deployments whose losses are compared; deployments of packages are compared with D2."""


def _calibration_effects(study: StudyPlan, found: Gathered) -> list[list[str | int | float | Estimate]]:
    rows: list[list[str | int | float | Estimate]] = []
    for first, second in (*PAIRS, *((name, "C4") for name in found.calibrated if not is_ours(name))):
        if first in found.calibrated and second in found.calibrated:
            one = effect(tests_of(found, first), tests_of(found, second), SHARE)
            rows.append(_effect_row(f"{first} − {second}", "test discrepancy [%]", study.compared, "—", one, 100.0))
    return rows


def _deployment_effects(study: StudyPlan, found: Gathered) -> list[list[str | int | float | Estimate]]:
    if not found.losses:
        return []
    levels, receivers, arms = places(study, found)
    unit, rows = deployment_unit(study.deployments[0].plan), list[list[str | int | float | Estimate]]()
    for first, second in (*ARMS, *((arm, "D2") for arm in arms if not is_ours(arm))):
        if first not in arms or second not in arms:
            continue
        for level in levels:
            for pour in checkpoints(study, TABLE_POURS):
                for some in [[name] for name in receivers] + ([receivers] if len(receivers) > 1 else []):
                    values = [at_pour_of(found, level, some, arm, pour) for arm in (first, second)]
                    one = effect(values[0], values[1], loss_range(study))
                    if one.difference.count:
                        of = f"least {unit.label} after {pour}"
                        name = some[0] if len(some) == 1 else ALL
                        rows.append(_effect_row(f"{first} − {second}", of, level, name, one, unit.factor))
    return rows


def _final_effects(study: StudyPlan, found: Gathered) -> list[list[str | int | float | Estimate]]:
    if not found.finals:
        return []
    unit, rows = deployment_unit(study.deployments[0].plan), list[list[str | int | float | Estimate]]()
    for compared, level, receivers, one in final_effects(study, found):
        name = receivers[0] if len(receivers) == 1 else ALL
        rows.append(_effect_row(compared, f"{unit.label} of the final action", level, name, one, unit.factor))
    return rows


def _effect_row(
    compared: str, of: str, level: str, receiver: str, one: Effect, factor: float
) -> list[str | int | float | Estimate]:
    chance = "—" if one.probability is None else f"{one.probability:.3f}"
    count = one.difference.count
    return [compared, of, level, receiver, count, one.difference.scaled(factor), f"{one.better} of {count}", chance]


def _thetas(results: Sequence[Calibrated]) -> str:
    texts, found = [], [one.found for one in results if one.found is not None]
    for name in found[0].searched if found else ():
        values = [getattr(one.theta, name) for one in found]
        texts.append(f"{name} {np.mean(values):.3g} ± {np.std(values):.2g}")
    return ", ".join(texts)


def _deployments(study: StudyPlan, found: Gathered) -> StudyTable:
    levels, receivers, arms = places(study, found)
    unit, pours = deployment_unit(study.deployments[0].plan), checkpoints(study, TABLE_POURS)
    rows: list[list[str | int | float | Estimate]] = []
    for level in levels:
        for receiver in receivers:
            for arm in arms:
                curves = found.best_so_far(Key(level, receiver, arm))
                if curves:
                    values = [mean_loss(study, at_pour(curves, pour)) for pour in pours]
                    rows.append([level, receiver, arm, len(curves), *values])
    return StudyTable(
        "table-deployment",
        f"Least {unit.label} so far",
        "Mean over repetitions [95 % t interval]. D1 pours once: its number stays, while the least of several pours, "
        "each with its chance, is partly luck.",
        ("mismatch", "receiver", "strategy", "repetitions", *(f"after {n} pour{'s' * (n > 1)}" for n in pours)),
        rows,
    )


def _needed(study: StudyPlan, found: Gathered) -> list[list[str | int | float | Estimate]]:
    levels, receivers, _ = places(study, found)
    unit, pours = deployment_unit(study.deployments[0].plan), most_pours(study)
    rows: list[list[str | int | float | Estimate]] = []
    for level in levels:
        for receiver in receivers:
            curves = {
                arm: [
                    [math.inf if math.isnan(v) else v for v in (at_pour([curve], n)[0] for n in range(1, pours + 1))]
                    for curve in found.best_so_far(Key(level, receiver, arm))
                    if curve
                ]
                for arm in ("D2", "D3")
            }
            if all(curves.values()):
                loss = max(float(np.mean([curve[-1] for curve in each])) for each in curves.values())
                needed = [pours_needed(curves[arm], loss) for arm in ("D2", "D3")]
                rows.append([level, receiver, unit.text(loss), *needed])
    return rows


def pours_needed(curves: Sequence[Sequence[float]], loss: float) -> Estimate:
    """Number of pours until the mean of the curves is at most `loss`; one more than available if it is never
    reached."""

    def first(data: NDArray[np.float64]) -> NDArray[np.float64]:
        reached = data.mean(axis=-2) <= loss + 1e-12
        ever = reached.any(axis=-1)
        first_place: NDArray[np.float64] = np.where(ever, 1.0 + reached.argmax(axis=-1), data.shape[-1] + 1.0)
        return first_place

    return statistic(curves, first)
