"""Figures of the deployments: 5a, 5b and 6 loss against pours, 7 what pays off at which prices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.report import style
from orchestrator.report.units import LossUnit, deployment_unit, largest_loss
from orchestrator.study.plan import StudyPlan
from orchestrator.study.report.calibrations import error
from orchestrator.study.report.drawing import Drawn, colour, legend, log_axis, look
from orchestrator.study.report.gather import Gathered, Key, at_pour, mean
from orchestrator.study.report.intervals import Estimate, Range, estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rows = list[tuple[int, str, list[float]]]

SECONDS_OF_SIMULATION = (0.1, 1.0, 25.0)
SECONDS_OF_POUR = (5.0, 90.0, 600.0)
CHECKPOINTS = (3, 9, 15)


def draw_deployments(study: StudyPlan, found: Gathered) -> list[Drawn]:
    """The figures that what is there allows."""
    if not found.losses:
        return []
    return [_after_pours(study, found), _mean_of_pours(study, found), _best_so_far(study, found), _prices(study, found)]


def places(study: StudyPlan, found: Gathered) -> tuple[list[str], list[str], list[str]]:
    """Levels, receivers and arms of which there is something, in the study's order."""
    levels = [level.name for level in study.levels if any(key.level == level.name for key in found.losses)]
    names = [scene.receiver.name for arm in study.deployments for scene in arm.plan.scenes]
    receivers = [name for name in dict.fromkeys(names) if any(key.receiver == name for key in found.losses)]
    arms = [arm.label for arm in study.deployments if any(key.arm == arm.label for key in found.losses)]
    return levels, receivers, arms


def loss_range(study: StudyPlan) -> Range:
    """What a loss can be: a share, or anything from 0."""
    return (0.0, largest_loss(study.deployments[0].plan))


def mean_loss(study: StudyPlan, losses: Sequence[float]) -> Estimate:
    """Of one loss a repetition, in the unit that people read."""
    return estimate(losses, loss_range(study)).scaled(deployment_unit(study.deployments[0].plan).factor)


def most_pours(study: StudyPlan) -> int:
    """Pours of the longest deployment."""
    return max(arm.plan.pours for arm in study.deployments)


def checkpoints(study: StudyPlan, wanted: tuple[int, ...] = CHECKPOINTS) -> list[int]:
    """Those that are reached, and the end."""
    return sorted({min(pour, most_pours(study)) for pour in wanted})


def bars(axes: Axes, groups: Sequence[str], arms: Sequence[str], of: Callable[[int, str], Estimate]) -> Rows:
    """A group of bars for each name, in it one for each arm, with their intervals.

    Args:
        of: an estimate by the number of its group and its arm.

    Returns:
        Group's number, arm, and numbers of each bar.
    """
    width, rows = 0.8 / len(arms), []
    for i in range(len(groups)):
        for j, arm in enumerate(arms):
            one, shown = of(i, arm), look(arm, arms)
            axes.bar(
                i + (j + 0.5) * width - 0.4, one.mean, 0.92 * width, color=shown.colour, hatch=shown.hatch,
                edgecolor="white", linewidth=0.0, yerr=error(one), capsize=2, error_kw={"linewidth": 1.2}, label=arm,
            )  # fmt: skip
            rows.append((i, arm, [one.count, one.mean, one.low, one.high]))
    axes.set_xticks(range(len(groups)), groups)
    return rows


def least_shown(unit: LossUnit) -> float:
    """What less is drawn at where axes are logarithmic: the last place that means something."""
    return 10.0**-unit.decimals


def _after_pours(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    unit, receiver, pours = deployment_unit(study.deployments[0].plan), receivers[0], checkpoints(study)
    figure, grid = style.new_figure(1, len(levels), size=(1.2 + 3.6 * len(levels), 4.0), squeeze=False, sharey=True)
    rows: list[list[object]] = []
    for axes, level in zip(grid[0], levels, strict=True):

        def after(i: int, arm: str, level: str = level) -> Estimate:
            return mean_loss(study, at_pour(found.best_so_far(Key(level, receiver, arm)), pours[i]))

        drawn = bars(axes, [str(pour) for pour in pours], arms, after)
        rows += [[level, receiver, arm, pours[i], *numbers] for i, arm, numbers in drawn]
        style.dress(axes, title=f"{level} mismatch", x="pours", y=f"least {unit.label}" if level == levels[0] else "")
    legend(figure, arms)
    return Drawn(
        "figure-5a",
        "5a",
        f"Least loss after so many pours into '{receiver}'",
        "Mean over repetitions of the least loss so far, with 95 % t intervals. D1 pours once: its number stays.",
        figure,
        ("level", "receiver", "strategy", "pours", "repetitions", f"least_{unit.unit}", "low", "high"),
        rows,
    )


def _mean_of_pours(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    unit = deployment_unit(study.deployments[0].plan)
    figure, grid = style.new_figure(1, len(levels), size=(1.2 + 3.6 * len(levels), 4.0), squeeze=False, sharey=True)
    rows: list[list[object]] = []
    for axes, level in zip(grid[0], levels, strict=True):

        def of_all(i: int, arm: str, level: str = level) -> Estimate:
            return mean_loss(study, [mean(pours) for pours in found.losses.get(Key(level, receivers[i], arm), [])])

        rows += [[level, receivers[i], arm, *numbers] for i, arm, numbers in bars(axes, receivers, arms, of_all)]
        style.dress(axes, title=f"{level} mismatch", y=f"mean {unit.label}" if level == levels[0] else "")
    legend(figure, arms)
    return Drawn(
        "figure-5b",
        "5b",
        "Mean loss of a pour",
        "Over all pours of a repetition, exploring ones too; mean over repetitions with 95 % t intervals.",
        figure,
        ("level", "receiver", "strategy", "repetitions", f"mean_{unit.unit}", "low", "high"),
        rows,
    )


def _best_so_far(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    from matplotlib.ticker import MaxNLocator

    unit, numbers = deployment_unit(study.deployments[0].plan), list(range(1, most_pours(study) + 1))
    least = least_shown(unit)
    size = (1.2 + 3.4 * len(receivers), 0.8 + 2.8 * len(levels))
    figure, grid = style.new_figure(len(levels), len(receivers), size=size, squeeze=False, sharex=True, sharey=True)
    rows: list[list[object]] = []
    for i, level in enumerate(levels):
        for j, receiver in enumerate(receivers):
            axes = grid[i][j]
            for arm in arms:
                curves = found.best_so_far(Key(level, receiver, arm))
                if not curves:
                    continue
                points = [mean_loss(study, at_pour(curves, pour)) for pour in numbers]
                rows += [[level, receiver, arm, n, e.count, e.mean, e.low, e.high] for n, e in zip(numbers, points)]  # noqa: B905
                shown = look(arm, arms)
                middle, low, high = ([max(v, least) for v in values] for values in zip(*map(_ends, points)))  # noqa: B905
                axes.plot(numbers, middle, shown.line, color=shown.colour, label=arm)
                axes.fill_between(numbers, low, high, color=shown.colour, alpha=0.15, linewidth=0)
            x, y = "pours" if i == len(levels) - 1 else "", f"least {unit.label}" if j == 0 else ""
            style.dress(axes, title=f"{receiver}, {level} mismatch", x=x, y=y, grid="both")
            log_axis(axes.yaxis)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend(figure, arms)
    return Drawn(
        "figure-6",
        "6",
        "Least loss so far against real pours",
        "Mean over repetitions with 95 % t intervals, on a logarithmic axis: less than "
        f"{least:g} {unit.unit}, nothing too, is drawn there. D1 is planned in simulation alone and poured once.",
        figure,
        ("level", "receiver", "strategy", "pour", "repetitions", f"least_{unit.unit}", "low", "high"),
        rows,
    )


def _ends(one: Estimate) -> tuple[float, float, float]:
    return one.mean, one.low, one.high


def _prices(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    level = study.compared if study.compared in levels else levels[0]
    unit = deployment_unit(study.deployments[0].plan)
    shape = (len(SECONDS_OF_SIMULATION), len(SECONDS_OF_POUR))
    figure, grid = style.new_figure(*shape, size=(11.0, 8.6), squeeze=False, sharey=True)
    rows: list[list[object]] = []
    for i, simulation in enumerate(SECONDS_OF_SIMULATION):
        for j, pour in enumerate(SECONDS_OF_POUR):
            axes, planned = grid[i][j], []
            for arm in arms:
                times, values = _spent(study, found, level, receivers, arm, simulation, pour)
                if not times:
                    continue
                rows += [[level, simulation, pour, arm, t, unit.factor * v] for t, v in zip(times, values)]  # noqa: B905
                shown = [max(unit.factor * value, least_shown(unit)) for value in values]
                if arm.startswith("D1"):
                    planned += list(zip(times, shown))  # noqa: B905
                else:
                    style_of = look(arm, arms)
                    axes.plot(times, shown, style_of.line, marker=".", color=style_of.colour, label=arm, markersize=4)
            if planned:
                planned.sort()
                axes.plot(*np.transpose(planned), "s--", color=colour("D1"), label="D1", markersize=5)
            for axis in (axes.xaxis, axes.yaxis):
                log_axis(axis)
            x, y = "total time [s]" if i == shape[0] - 1 else "", f"least {unit.label}" if j == 0 else ""
            style.dress(axes, title=f"{simulation:g} s a simulation, {pour:g} s a pour", x=x, y=y, grid="both")
    legend(figure, ["D1", *arms])
    return Drawn(
        "figure-7",
        "7",
        "What pays off at which prices",
        f"Least loss so far, mean over repetitions and receivers ({level} mismatch), against the time that it would "
        "have taken at hypothesised prices. D3's simulations beside a pour cost time only where they take longer than "
        "the pour. Calibration is not counted: D1 and D3 share it. "
        f"Less than {least_shown(unit):g} {unit.unit} is drawn there.",
        figure,
        ("level", "seconds_per_simulation", "seconds_per_pour", "strategy", "total_seconds", f"least_{unit.unit}"),
        rows,
    )


def _spent(
    study: StudyPlan, found: Gathered, level: str, receivers: list[str], arm: str, simulation: float, pour: float
) -> tuple[list[float], list[float]]:
    """Total time after each pour, and the least loss so far, averaged over receivers."""
    settings = study.deployment(arm).plan.settings
    curves = [curve for name in receivers for curve in found.best_so_far(Key(level, name, arm))]
    length = max((len(curve) for curve in curves), default=0)
    before, each = settings.simulations_before * simulation, max(pour, settings.simulations_beside * simulation)
    numbers = range(1, length + 1)
    return [before + n * each for n in numbers], [mean(at_pour(curves, n)) for n in numbers]
