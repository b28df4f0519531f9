"""Figures of the deployments, and the figure, table and effects of the recommended actions.

- `draw_deployments`: figures 5a, 5b and 6, loss against pours, and figure 7, loss against total time at assumed costs.
- `draw_finals`, `final_rows` and `final_effects`: repeated pours of the actions that deployments recommend.
- `means` and `level_title` are shared by these figures.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from orchestrator.results import figure_style as style
from orchestrator.results.loss_units import LossUnit, deployment_unit, largest_loss
from orchestrator.study.report.cell_results import Gathered, Key, at_pour, mean
from orchestrator.study.report.figure_panels import (
    Drawn,
    SeriesStyle,
    colour,
    is_first,
    is_ours,
    legend,
    level_panels,
    level_words,
    log_axis,
    look,
)
from orchestrator.study.report.statistics import SHARE, Effect, Estimate, Range, effect, estimate
from orchestrator.study.study_plan import StudyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Rows = list[tuple[int, str, list[float]]]

SECONDS_OF_SIMULATION = (0.1, 1.0, 25.0)
SECONDS_OF_POUR = (5.0, 90.0, 600.0)
CHECKPOINTS = (3, 9, 15)


def draw_deployments(study: StudyPlan, found: Gathered) -> list[Drawn]:
    """Draw all figures for which there is data."""
    if not found.losses:
        return []
    return [_after_pours(study, found), _mean_of_pours(study, found), _best_so_far(study, found), _prices(study, found)]


def places(study: StudyPlan, found: Gathered) -> tuple[list[str], list[str], list[str]]:
    """Levels, receivers and arms with data, in the order of the study."""
    levels = [level.name for level in study.levels if any(key.level == level.name for key in found.losses)]
    names = [scene.receiver.name for arm in study.deployments for scene in arm.plan.scenes]
    receivers = [name for name in dict.fromkeys(names) if any(key.receiver == name for key in found.losses)]
    arms = [arm.label for arm in study.deployments if any(key.arm == arm.label for key in found.losses)]
    return levels, receivers, arms


def loss_range(study: StudyPlan) -> Range:
    """Range of a loss: from 0 to its largest value."""
    return (0.0, largest_loss(study.deployments[0].plan))


def mean_loss(study: StudyPlan, losses: Sequence[float]) -> Estimate:
    """Estimate from one loss per repetition, in display units."""
    return estimate(losses, loss_range(study)).scaled(deployment_unit(study.deployments[0].plan).factor)


def most_pours(study: StudyPlan) -> int:
    """Number of pours of the longest deployment."""
    return max(arm.plan.pours for arm in study.deployments)


def checkpoints(study: StudyPlan, wanted: tuple[int, ...] = CHECKPOINTS) -> list[int]:
    """The checkpoints that are reached, and the last pour."""
    return sorted({min(pour, most_pours(study)) for pour in wanted})


def means(
    axes: Axes, groups: Sequence[str], arms: Sequence[str], of: Callable[[int, str], Estimate], least: float
) -> Rows:
    """Draw a group of means for each name, with one mean per arm and its interval, on a logarithmic axis.

    Args:
        of: returns the estimate for the index of a group and an arm.
        least: smaller values are drawn at this value.

    Returns:
        Index of the group, arm, and numbers of each mean.
    """
    width, rows = 0.8 / len(arms), []
    for i in range(len(groups)):
        for j, arm in enumerate(arms):
            one = of(i, arm)
            _mean(axes, i + (j + 0.5) * width - 0.4, one, look(arm, arms), least, arm)
            rows.append((i, arm, [one.count, one.mean, one.low, one.high]))
        if i:
            axes.axvline(i - 0.5, color=style.PALE, linewidth=0.8, zorder=0)
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xticks(range(len(groups)), groups)
    axes.tick_params(axis="x", length=0)
    log_axis(axes.yaxis)
    return rows


def _mean(axes: Axes, x: float, one: Estimate, shown: SeriesStyle, least: float, label: str) -> None:
    """Draw a mean with its interval; an interval that extends below the axis ends in an arrow."""
    if math.isnan(one.mean):
        return
    middle, low, high = (max(value, least) for value in (one.mean, one.low, one.high))
    if not math.isnan(one.low):
        axes.plot([x, x], [low, high], color=shown.colour, linewidth=1.4, zorder=2)
        if one.low < least < one.high:
            axes.plot([x], [least], "v", color=shown.colour, markersize=4, zorder=2, clip_on=False)
    axes.plot(
        [x], [middle], shown.marker, color=shown.colour, markerfacecolor=shown.face, markersize=6, label=label,
        zorder=3, clip_on=False,
    )  # fmt: skip


def level_note(study: StudyPlan, level: str) -> str:
    """Differences of a level's bench from the others: 'particles 600, friction 0.05, receiver -2 mm'."""
    benches = {one.name: one.bench for one in study.levels}
    liquids = {name: bench.theta.model_dump() for name, bench in benches.items()}
    parts = [
        f"{name} {value:g}".replace("_", HARD_SPACE).replace(" ", HARD_SPACE)
        for name, value in liquids[level].items()
        if len({liquid[name] for liquid in liquids.values()}) > 1
    ]
    if len({bench.pose_error.x for bench in benches.values()}) > 1:
        parts.append(f"receiver{HARD_SPACE}{round(1e3 * benches[level].pose_error.x):+d}{HARD_SPACE}mm")
    return ", ".join(parts)


def level_title(study: StudyPlan, level: str) -> str:
    """Title of a panel: the name of the level, and its bench below."""
    return "\n".join([level_words(level), *textwrap.wrap(level_note(study, level), TITLE_WIDTH)])


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


def least_shown(unit: LossUnit) -> float:
    """Smallest value on logarithmic axes: the last significant decimal place."""
    return 10.0**-unit.decimals


def _after_pours(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    unit, receiver, pours = deployment_unit(study.deployments[0].plan), receivers[0], checkpoints(study)
    figure, panels = level_panels(levels, height=4.2)
    rows: list[list[object]] = []
    for (axes,), level in zip(panels, levels, strict=True):

        def after(i: int, arm: str, level: str = level) -> Estimate:
            return mean_loss(study, at_pour(found.best_so_far(Key(level, receiver, arm)), pours[i]))

        drawn = means(axes, [str(pour) for pour in pours], arms, after, least_shown(unit))
        rows += [[level, receiver, arm, pours[i], *numbers] for i, arm, numbers in drawn]
        y = f"least {unit.label}" if is_first(axes) else ""
        style.dress(axes, title=level_title(study, level), x="pours", y=y)
    legend(figure, arms)
    return Drawn(
        "figure-5a",
        "5a",
        f"Least loss after so many pours into '{receiver}'",
        "Mean over repetitions of the least loss so far, with 95 % t intervals; arrows: the interval goes on below "
        f"{least_shown(unit):g} {unit.unit}. D1 pours once: its number stays. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "pours", "repetitions", f"least_{unit.unit}", "low", "high"),
        rows,
    )


def _mean_of_pours(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    unit = deployment_unit(study.deployments[0].plan)
    figure, panels = level_panels(levels, height=4.0)
    rows: list[list[object]] = []
    for (axes,), level in zip(panels, levels, strict=True):

        def of_all(i: int, arm: str, level: str = level) -> Estimate:
            return mean_loss(study, [mean(pours) for pours in found.losses.get(Key(level, receivers[i], arm), [])])

        drawn = means(axes, receivers, arms, of_all, least_shown(unit))
        rows += [[level, receivers[i], arm, *numbers] for i, arm, numbers in drawn]
        style.dress(axes, title=level_title(study, level), y=f"mean {unit.label}" if is_first(axes) else "")
    legend(figure, arms)
    return Drawn(
        "figure-5b",
        "5b",
        "Mean loss of a pour",
        "Over all pours of a repetition, exploring ones too; mean over repetitions with 95 % t intervals; arrows: the "
        f"interval goes on below {least_shown(unit):g} {unit.unit}. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "repetitions", f"mean_{unit.unit}", "low", "high"),
        rows,
    )


def _best_so_far(study: StudyPlan, found: Gathered) -> Drawn:
    levels, receivers, arms = places(study, found)
    from matplotlib.ticker import MaxNLocator

    unit, numbers = deployment_unit(study.deployments[0].plan), list(range(1, most_pours(study) + 1))
    least = least_shown(unit)
    figure, panels = level_panels(levels, len(receivers), width=3.4, height=2.9)
    rows: list[list[object]] = []
    for i, level in enumerate(levels):
        for j, receiver in enumerate(receivers):
            axes = panels[i][j]
            for arm in arms:
                curves = found.best_so_far(Key(level, receiver, arm))
                if not curves:
                    continue
                points = [mean_loss(study, at_pour(curves, pour)) for pour in numbers]
                rows += [[level, receiver, arm, n, e.count, e.mean, e.low, e.high] for n, e in zip(numbers, points)]  # noqa: B905
                shown = look(arm, arms)
                middle = [max(one.mean, least) for one in points]
                axes.plot(numbers, middle, shown.line, color=shown.colour, label=arm, linewidth=1.7)
                for pour in checkpoints(study):
                    # Bars next to each other instead of bands: bands of several strategies would fill the panel.
                    aside = 0.6 * ((arms.index(arm) + 0.5) / len(arms) - 0.5)
                    _mean(axes, pour + aside, points[pour - 1], shown, least, "")
            x, y = "pours" if i == len(levels) - 1 else "", f"least {unit.label}" if is_first(axes) else ""
            style.dress(axes, title=f"{receiver}, {level_words(level)}", x=x, y=y, grid="both")
            log_axis(axes.yaxis, decades=True)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend(figure, arms)
    return Drawn(
        "figure-6",
        "6",
        "Least loss so far against real pours",
        f"Mean over repetitions; 95 % t intervals after {_listed(checkpoints(study))} pours, side by side. On a "
        f"logarithmic axis: less than {least:g} {unit.unit}, nothing too, is drawn there, and intervals that go on "
        f"below end in an arrow. D1 is planned in simulation alone and poured once. {LEVELS}",
        figure,
        ("level", "receiver", "strategy", "pour", "repetitions", f"least_{unit.unit}", "low", "high"),
        rows,
    )


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
        f"Least loss so far, mean over repetitions and receivers ({level_words(level)}), against the time that it "
        "would have taken at hypothesised prices. D3's simulations beside a pour cost time only where they take longer "
        "than the pour. Calibration is not counted: D1 and D3 share it. "
        f"Less than {least_shown(unit):g} {unit.unit} is drawn there.",
        figure,
        ("level", "seconds_per_simulation", "seconds_per_pour", "strategy", "total_seconds", f"least_{unit.unit}"),
        rows,
    )


def _spent(
    study: StudyPlan, found: Gathered, level: str, receivers: list[str], arm: str, simulation: float, pour: float
) -> tuple[list[float], list[float]]:
    """Total time after each pour, and the smallest loss so far, averaged over receivers."""
    settings = study.deployment(arm).plan.settings
    curves = [curve for name in receivers for curve in found.best_so_far(Key(level, name, arm))]
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


def draw_finals(study: StudyPlan, found: Gathered) -> list[Drawn]:
    """Draw the figure if there are repeated pours."""
    if not found.finals:
        return []
    levels, receivers, arms = final_places(study, found)
    unit = deployment_unit(study.deployments[0].plan)
    figure, panels = level_panels(levels)
    rows: list[list[object]] = []
    for (axes,), level in zip(panels, levels, strict=True):

        def poured_again(i: int, arm: str, level: str = level) -> Estimate:
            return mean_loss(study, list(final_losses(found, level, [receivers[i]], arm).values()))

        drawn = means(axes, receivers, arms, poured_again, least_shown(unit))
        rows += [[level, receivers[i], arm, *numbers] for i, arm, numbers in drawn]
        style.dress(axes, title=level_title(study, level), y=f"{unit.label}" if is_first(axes) else "")
    legend(figure, arms)
    header = ("level", "receiver", "strategy", "repetitions", f"final_{unit.unit}", "low", "high")
    caption = f"{CAPTION} Arrows: the interval goes on below {least_shown(unit):g} {unit.unit}. {LEVELS}"
    return [Drawn("figure-final", "", "Loss of the recommended action", caption, figure, header, rows)]


def final_places(study: StudyPlan, found: Gathered) -> tuple[list[str], list[str], list[str]]:
    """Levels, receivers and arms with repeated pours."""
    levels, receivers, arms = places(study, found)
    return (
        [name for name in levels if any(key.level == name for key in found.finals)],
        [name for name in receivers if any(key.receiver == name for key in found.finals)],
        [name for name in arms if any(key.arm == name for key in found.finals)],
    )


def final_losses(found: Gathered, level: str, receivers: Sequence[str], arm: str) -> dict[int, float]:
    """Mean loss of the recommended actions over receivers, for each repetition that has all receivers."""
    each = [found.finals.get(Key(level, receiver, arm), {}) for receiver in receivers]
    shared = set.intersection(*map(set, each)) if each else set()
    return {n: mean([mean([pour.loss for pour in pours[n]]) for pours in each]) for n in sorted(shared)}


def final_rows(study: StudyPlan, found: Gathered) -> tuple[list[str], list[list[str | int | float | Estimate]]]:
    """Header and rows of the table."""
    levels, receivers, arms = final_places(study, found)
    rows: list[list[str | int | float | Estimate]] = []
    for level in levels:
        for receiver in receivers:
            for arm in arms:
                by_repetition = found.finals.get(Key(level, receiver, arm), {})
                if not by_repetition:
                    continue
                pours = [pour for some in by_repetition.values() for pour in some]
                spilled = estimate([mean([pour.spillage for pour in some]) for some in by_repetition.values()], SHARE)
                losses = list(final_losses(found, level, [receiver], arm).values())
                lost = f"{sum(not pour.made for pour in pours)} of {len(pours)}"
                loss = mean_loss(study, losses)
                rows.append([level, receiver, arm, len(by_repetition), loss, spilled.scaled(100.0), lost])
    label = deployment_unit(study.deployments[0].plan).label
    return ["mismatch", "receiver", "strategy", "repetitions", label, "spilled / poured [%]", "not made"], rows


def final_pairs(arms: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs of strategies whose recommended actions are compared: D3 with D2, with the paper's form and with the
    longest D1; the paper's form with D2; strategies of packages with D2."""
    longest = max((arm for arm in arms if arm.startswith("D1-")), key=lambda arm: int(arm[3:]), default="")
    pairs = [
        ("D3", "D2"),
        ("D3", "D3-paper"),
        ("D3-paper", "D2"),
        ("D3", longest),
        *((arm, "D2") for arm in arms if not is_ours(arm)),
    ]
    return [(first, second) for first, second in pairs if first in arms and second in arms]


def final_effects(study: StudyPlan, found: Gathered) -> list[tuple[str, str, list[str], Effect]]:
    """Differences of the mean losses: names of the pair, level, receivers, effect."""
    effects = []
    levels, receivers, arms = final_places(study, found)
    for first, second in final_pairs(arms):
        for level in levels:
            for some in [[name] for name in receivers] + ([receivers] if len(receivers) > 1 else []):
                values = [final_losses(found, level, some, arm) for arm in (first, second)]
                one = effect(values[0], values[1], loss_range(study))
                if one.difference.count:
                    effects.append((f"{first} − {second}", level, some, one))
    return effects
