"""Figures of a study's deployments: 5b and 6 loss against pours, 7 loss against time, and the recommended actions.

`Losses` selects the losses that figures and tables show.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.reports import figure_style as style
from orchestrator.reports.loss_units import deployment_unit, largest_loss
from orchestrator.study.calibration_figures import (
    Drawn,
    SeriesStyle,
    colour,
    d1_iterations,
    is_first,
    legend,
    level_panels,
    level_words,
    log_axis,
    series_style,
)
from orchestrator.study.study_plan import StudyPlan
from orchestrator.study.study_statistics import Estimate, Gathered, Key, at_pour, estimate, mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SECONDS_OF_SIMULATION = (0.1, 1.0, 25.0)
SECONDS_OF_POUR = (5.0, 90.0, 600.0)
CHECKPOINTS = (3, 9, 15)


class Losses:
    """The losses of a study's deployments.

    Args:
        study: plan of the study.
        found: its results.
        final: select the pours of recommended actions, instead of the deployments' own pours.

    Attributes:
        levels, receivers, strategies: those with data, in the order of the study.
        unit: display unit of the loss.
        range: from 0 to the largest loss.
        pours: number of pours of the longest deployment.
    """

    def __init__(self, study: StudyPlan, pooled: Gathered, *, final: bool = False) -> None:
        keys = (pooled.finals if final else pooled.losses).keys()
        names = [scene.receiver.name for compared in study.deployments for scene in compared.plan.scenes]
        self.levels = [level.name for level in study.levels if any(key.level == level.name for key in keys)]
        self.receivers = [name for name in dict.fromkeys(names) if any(key.receiver == name for key in keys)]
        self.strategies = [
            compared.label for compared in study.deployments if any(key.strategy == compared.label for key in keys)
        ]
        self.unit = deployment_unit(study.deployments[0].plan)
        self.range = (0.0, largest_loss(study.deployments[0].plan))
        self.pours = max(compared.plan.pours for compared in study.deployments)
        self._found = pooled

    @property
    def least_shown(self) -> float:
        """Smallest value on logarithmic axes: the last significant decimal place."""
        return 10.0**-self.unit.decimals

    def mean(self, losses: Sequence[float]) -> Estimate:
        """Estimate from one loss per repetition, in display units."""
        return estimate(losses, self.range).scaled(self.unit.factor)

    def checkpoints(self, wanted: tuple[int, ...] = CHECKPOINTS) -> list[int]:
        """The checkpoints that are reached, and the last pour."""
        return sorted({min(pour, self.pours) for pour in wanted})

    def after(self, level: str, receivers: Sequence[str], strategy: str, pour: int) -> dict[int, float]:
        """Smallest loss up to a pour by repetition; mean over receivers, if the repetition has all of them."""
        return _mean_of([self._found.by_repetition(Key(level, receiver, strategy), pour) for receiver in receivers])

    def final(self, level: str, receivers: Sequence[str], strategy: str) -> dict[int, float]:
        """Loss of the recommended action by repetition; mean over receivers, if the repetition has all of them."""
        each = [self._found.finals.get(Key(level, receiver, strategy), {}) for receiver in receivers]
        return _mean_of([{n: mean([pour.loss for pour in pours]) for n, pours in rounds.items()} for rounds in each])


def _mean_of(each: Sequence[dict[int, float]]) -> dict[int, float]:
    shared = set.intersection(*map(set, each)) if each else set()
    return {number: mean([values[number] for values in each]) for number in sorted(shared)}


def draw_deployments(study: StudyPlan, pooled: Gathered) -> list[Drawn]:
    """Draw all figures for which there is data."""
    figures = []
    if pooled.losses:
        losses = Losses(study, pooled)
        figures = [
            _mean_of_pours(study, pooled, losses),
            _best_so_far(pooled, losses),
            _against_time(study, pooled, losses),
        ]
    return [*figures, _finals(study, Losses(study, pooled, final=True))] if pooled.finals else figures


def means(
    axes: Axes, groups: Sequence[str], strategies: Sequence[str], of: Callable[[int, str], Estimate], least: float
) -> list[tuple[int, str, list[float]]]:
    """Draw a group of means for each name, with one mean per strategy and its interval, on a logarithmic axis.

    Args:
        of: returns the estimate for the index of a group and a strategy.
        least: smaller values are drawn at this value.

    Returns:
        Index of the group, strategy, and numbers of each mean.
    """
    width, rows = 0.8 / len(strategies), []
    for i in range(len(groups)):
        for j, strategy in enumerate(strategies):
            estimate = of(i, strategy)
            _mean(axes, i + (j + 0.5) * width - 0.4, estimate, series_style(strategy, strategies), least, strategy)
            rows.append((i, strategy, [estimate.count, estimate.mean, estimate.low, estimate.high]))
        if i:
            axes.axvline(i - 0.5, color=style.PALE, linewidth=0.8, zorder=0)
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xticks(range(len(groups)), groups)
    axes.tick_params(axis="x", length=0)
    log_axis(axes.yaxis)
    return rows


def _mean(axes: Axes, x: float, estimate: Estimate, shown: SeriesStyle, least: float, label: str) -> None:
    """Draw a mean with its interval; an interval that extends below the axis ends in an arrow."""
    if math.isnan(estimate.mean):
        return
    middle, low, high = (max(value, least) for value in (estimate.mean, estimate.low, estimate.high))
    if not math.isnan(estimate.low):
        axes.plot([x, x], [low, high], color=shown.colour, linewidth=1.4, zorder=2)
        if estimate.low < least < estimate.high:
            axes.plot([x], [least], "v", color=shown.colour, markersize=4, zorder=2, clip_on=False)
    axes.plot(
        [x], [middle], shown.marker, color=shown.colour, markerfacecolor=shown.face, markersize=6, label=label,
        zorder=3, clip_on=False,
    )  # fmt: skip


def _level_note(study: StudyPlan, level: str) -> str:
    """Differences of a level's bench from the others: 'particles 600, friction 0.05, receiver -2 mm'."""
    benches = {described.name: described.bench for described in study.levels}
    liquids = {name: bench.theta.model_dump() for name, bench in benches.items()}
    parts = [
        f"{name} {value:g}".replace("_", HARD_SPACE).replace(" ", HARD_SPACE)
        for name, value in liquids[level].items()
        if len({liquid[name] for liquid in liquids.values()}) > 1
    ]
    if len({bench.pose_error.x for bench in benches.values()}) > 1:
        parts.append(f"receiver{HARD_SPACE}{round(1e3 * benches[level].pose_error.x):+d}{HARD_SPACE}mm")
    return ", ".join(parts)


def _level_title(study: StudyPlan, level: str) -> str:
    """Title of a panel: the name of the level, and its bench below."""
    return "\n".join([level_words(level), *textwrap.wrap(_level_note(study, level), TITLE_WIDTH)])


LEVELS = (
    "A level's mismatch says how far its bench is from the simulator, not how hard it is to pour there: each has a "
    "liquid of its own, and most may be lost at the smallest mismatch."
)
"""Note in the captions of figures with one panel per level."""

HARD_SPACE = "\N{NO-BREAK SPACE}"
"""Space without a line break, for titles."""

TITLE_WIDTH = 42
"""Number of characters per line above a panel."""


def _listed(numbers: Sequence[int]) -> str:
    words = list(map(str, numbers))
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _grouped(
    study: StudyPlan, losses: Losses, groups: Sequence[str], of: Callable[[str, int, str], Sequence[float]],
    *, title: str, height: float = 4.2,
) -> tuple[Figure, list[tuple[str, int, str, list[float]]]]:  # fmt: skip
    """Draw a panel for each level, with a group of means for each name.

    Args:
        of: returns one loss per repetition for a level, the index of a group, and a strategy.
        title: label of the vertical axis.

    Returns:
        The figure; level, index of the group, strategy, and numbers of each mean.
    """
    figure, panels = level_panels(losses.levels, height=height)
    rows = []
    for (axes,), level in zip(panels, losses.levels, strict=True):

        def one(i: int, strategy: str, level: str = level) -> Estimate:
            return losses.mean(of(level, i, strategy))

        rows += [(level, *row) for row in means(axes, groups, losses.strategies, one, losses.least_shown)]
        style.dress(axes, title=_level_title(study, level), y=title if is_first(axes) else "")
    legend(figure, losses.strategies)
    return figure, rows


def _mean_of_pours(study: StudyPlan, pooled: Gathered, losses: Losses) -> Drawn:
    unit, receivers = losses.unit, losses.receivers
    figure, rows = _grouped(
        study,
        losses,
        receivers,
        lambda level, i, strategy: [mean(pours) for pours in pooled.losses.get(Key(level, receivers[i], strategy), [])],
        title=f"mean {unit.label}",
        height=4.0,
    )
    return Drawn(
        "figure-5b",
        "5b",
        "Mean loss of a pour",
        "Over all pours of a repetition, exploring ones too; mean over repetitions with 95 % t intervals; arrows: the "
        f"interval goes on below {losses.least_shown:g} {unit.unit}. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "repetitions", f"mean_{unit.unit}", "low", "high"),
        [[level, receivers[i], strategy, *numbers] for level, i, strategy, numbers in rows],
    )


def _best_so_far(pooled: Gathered, losses: Losses) -> Drawn:
    from matplotlib.ticker import MaxNLocator

    levels, receivers, strategies = losses.levels, losses.receivers, losses.strategies
    unit, numbers, least = losses.unit, list(range(1, losses.pours + 1)), losses.least_shown
    figure, panels = level_panels(levels, len(receivers), width=3.4, height=2.9)
    rows: list[list[object]] = []
    for i, level in enumerate(levels):
        for j, receiver in enumerate(receivers):
            axes = panels[i][j]
            for strategy in strategies:
                curves = pooled.best_so_far(Key(level, receiver, strategy))
                if not curves:
                    continue
                points = [losses.mean(at_pour(curves, pour)) for pour in numbers]
                place = [level, receiver, strategy]
                rows += [[*place, n, e.count, e.mean, e.low, e.high] for n, e in zip(numbers, points, strict=True)]
                shown = series_style(strategy, strategies)
                middle = [max(point.mean, least) for point in points]
                axes.plot(numbers, middle, shown.line, color=shown.colour, label=strategy, linewidth=1.7)
                for pour in losses.checkpoints():
                    # Bars next to each other instead of bands: bands of several strategies would fill the panel.
                    aside = 0.6 * ((strategies.index(strategy) + 0.5) / len(strategies) - 0.5)
                    _mean(axes, pour + aside, points[pour - 1], shown, least, "")
            x, y = "pours" if i == len(levels) - 1 else "", f"least {unit.label}" if is_first(axes) else ""
            style.dress(axes, title=f"{receiver}, {level_words(level)}", x=x, y=y, grid="both")
            log_axis(axes.yaxis, decades=True)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend(figure, strategies)
    return Drawn(
        "figure-6",
        "6",
        "Least loss so far against real pours",
        f"Mean over repetitions; 95 % t intervals after {_listed(losses.checkpoints())} pours, side by side. On a "
        f"logarithmic axis: less than {least:g} {unit.unit}, nothing too, is drawn there, and intervals that go on "
        f"below end in an arrow. D1 is planned in simulation alone and poured once. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "pour", "repetitions", f"least_{unit.unit}", "low", "high"),
        rows,
    )


def _against_time(study: StudyPlan, pooled: Gathered, losses: Losses) -> Drawn:
    strategies, unit, least = losses.strategies, losses.unit, losses.least_shown
    level = study.compared if study.compared in losses.levels else losses.levels[0]
    shape = (len(SECONDS_OF_SIMULATION), len(SECONDS_OF_POUR))
    figure, grid = style.new_figure(*shape, size=(11.0, 8.6), squeeze=False, sharey=True)
    rows: list[list[object]] = []
    for i, simulation in enumerate(SECONDS_OF_SIMULATION):
        for j, pour in enumerate(SECONDS_OF_POUR):
            axes, planned = grid[i][j], []
            for strategy in strategies:
                times, values = _spent(study, pooled, level, losses.receivers, strategy, simulation, pour)
                if not times:
                    continue
                rows += [[level, simulation, pour, strategy, t, unit.factor * v] for t, v in zip(times, values)]  # noqa: B905
                shown = [max(unit.factor * value, least) for value in values]
                if d1_iterations(strategy) is not None:
                    planned += list(zip(times, shown))  # noqa: B905
                else:
                    style_of = series_style(strategy, strategies)
                    # A single point, of a strategy that pours once, is above the lines.
                    marker, size, order = (".", 4, 2) if len(times) > 1 else (style_of.marker, 7, 4)
                    look = {"marker": marker, "markersize": size, "color": style_of.colour, "zorder": order}
                    axes.plot(times, shown, style_of.line, label=strategy, **look)
            if planned:
                planned.sort()
                axes.plot(*np.transpose(planned), "s--", color=colour("D1"), label="D1", markersize=5)
            for axis in (axes.xaxis, axes.yaxis):
                log_axis(axis)
            x, y = "total time [s]" if i == shape[0] - 1 else "", f"least {unit.label}" if j == 0 else ""
            style.dress(axes, title=f"{simulation:g} s a simulation, {pour:g} s a pour", x=x, y=y, grid="both")
    legend(figure, ["D1", *strategies])
    return Drawn(
        "figure-7",
        "7",
        "What pays off at which costs",
        f"Least loss so far, mean over repetitions and receivers ({level_words(level)}), against the time that it "
        "would have taken at hypothesised costs. D3's simulations during a pour cost time only if they take longer "
        "than the pour. Calibration is not counted: D1 and D3 share it, and D1-uncalibrated has none. "
        f"Less than {least:g} {unit.unit} is drawn there.",
        figure,
        ("level", "seconds_per_simulation", "seconds_per_pour", "strategy", "total_seconds", f"least_{unit.unit}"),
        rows,
    )


def _spent(
    study: StudyPlan, pooled: Gathered, level: str, receivers: list[str], strategy: str, simulation: float, pour: float
) -> tuple[list[float], list[float]]:
    """Total time after each pour, and the smallest loss so far, averaged over receivers."""
    settings = study.deployment(strategy).plan.settings
    curves = [curve for name in receivers for curve in pooled.best_so_far(Key(level, name, strategy))]
    length = max((len(curve) for curve in curves), default=0)
    before, each = settings.simulations_before * simulation, max(pour, settings.simulations_beside * simulation)
    numbers = range(1, length + 1)
    return [before + n * each for n in numbers], [mean(at_pour(curves, n)) for n in numbers]


CAPTION = (
    "What each deployment recommends at its end, by posterior mean, poured again with chance errors that took no part "
    "in the choice. In a repetition the first such pours of all strategies have the same chance errors, so have the "
    "second, and so on. Mean over repetitions, of the mean of each one's pours [95 % t interval]. An action that was "
    "refused or failed, or none, has the worst loss and counts as all spilled."
)


def _finals(study: StudyPlan, losses: Losses) -> Drawn:
    unit, receivers = losses.unit, losses.receivers
    figure, rows = _grouped(
        study,
        losses,
        receivers,
        lambda level, i, strategy: list(losses.final(level, [receivers[i]], strategy).values()),
        title=unit.label,
    )
    return Drawn(
        "figure-final",
        "",
        "Loss of the recommended action",
        f"{CAPTION} Arrows: the interval goes on below {losses.least_shown:g} {unit.unit}. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "repetitions", f"final_{unit.unit}", "low", "high"),
        [[level, receivers[i], strategy, *numbers] for level, i, strategy, numbers in rows],
    )
