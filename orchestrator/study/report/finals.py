"""What was learnt, poured again: figure, table and effects of the actions that deployments recommend."""

from __future__ import annotations

from collections.abc import Sequence

from orchestrator.report import style
from orchestrator.report.units import deployment_unit
from orchestrator.study.plan import StudyPlan
from orchestrator.study.report.deployments import (
    LEVELS,
    least_shown,
    level_title,
    loss_range,
    mean_loss,
    means,
    places,
)
from orchestrator.study.report.drawing import Drawn, is_first, is_ours, legend, level_panels
from orchestrator.study.report.effects import Effect, effect
from orchestrator.study.report.gather import Gathered, Key, mean
from orchestrator.study.report.intervals import SHARE, Estimate, estimate

CAPTION = (
    "What each deployment recommends at its end, by posterior mean, poured again with chance errors that took no part "
    "in the choice. In a repetition the first such pours of all strategies have the same chance errors, so have the "
    "second, and so on. Mean over repetitions, of the mean of each one's pours [95 % t interval]. An action that was "
    "refused or failed, or none, has the worst loss and counts as all spilled."
)


def draw_finals(study: StudyPlan, found: Gathered) -> list[Drawn]:
    """The figure, where anything was poured again."""
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
    """Levels, receivers and arms of which something was poured again."""
    levels, receivers, arms = places(study, found)
    return (
        [name for name in levels if any(key.level == name for key in found.finals)],
        [name for name in receivers if any(key.receiver == name for key in found.finals)],
        [name for name in arms if any(key.arm == name for key in found.finals)],
    )


def final_losses(found: Gathered, level: str, receivers: Sequence[str], arm: str) -> dict[int, float]:
    """Mean loss of the recommended actions by repetition: over receivers, of the repetitions that have all of them."""
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
    """Which strategies' recommended actions are compared: D3 with D2, the paper's form and the longest D1; the paper's
    form with D2; those of packages with D2."""
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
    """Differences of the mean losses: which two, level, receivers, effect."""
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
