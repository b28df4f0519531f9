"""Predicts mixtures before anything moves: order, sources, errors of the doses and of the composition, and duration.

The smallest and the largest dose of each liquid are predicted as the first dose from a full source, about which nothing
is known yet; the errors of the doses between are interpolated. Later doses are usually better.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from actors.dosing.dose_series import DoseForecast
from actors.interfaces import DoseSource, DoseTarget, InvalidActionError
from actors.laboratory import predicted_dose
from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.campaign_plan import CampaignPlan, DispensePlan, PlannedDose
from orchestrator.learning.dispense import FILL_DEVIATION, WEIGHED_DEVIATION, KnownSource, share_deviation
from orchestrator.learning.mixtures import dose_strategy
from orchestrator.learning.trials import SeedStream

PREDICTED = 8
"""Simulated doses of each prediction."""

LARGEST_ERROR = 0.5
"""Error of a dose, as a share of its amount, from which on it is refused."""


@dataclass
class MixtureForecast:
    """What is expected of mixtures.

    Attributes:
        lines: for people.
        problems: doses that balance or source can't support: cups, liquid, and the reason.
        open_time: expected time from the first dose into a cup to its last one, 95 % [s]; that of the slowest cup.
    """

    lines: list[str] = field(default_factory=list)
    problems: list[tuple[list[str], str, str]] = field(default_factory=list)
    open_time: float = 0.0


def forecast_mixtures(plan: CampaignPlan) -> MixtureForecast:
    """Predict the mixtures of a campaign.

    Args:
        plan: with mixtures.
    """
    series = plan.dispense
    assert series is not None
    assert series.mixtures is not None
    forecast, cups = MixtureForecast(), series.mixtures.cups
    doses = _Doses(plan.laboratory, series, plan.seed)
    fills = _fills(series, plan.seed)
    changes = sum(a.liquid != b.liquid for a, b in zip(series.doses, series.doses[1:], strict=False))
    forecast.lines.append(
        f"{len(cups)} cups, {len(series.doses)} doses, {changes} changes of source; first cup: "
        + ", then ".join(f"{liquid} {1e3 * dose.amount:.4g} g" for liquid, dose in next(iter(cups.values())).items())
    )
    for liquid in dict.fromkeys(dose.liquid or "" for dose in series.doses):
        forecast.lines.append(_of_liquid(series, liquid, doses, fills))
    refused: dict[tuple[str, str], list[str]] = {}
    for cup, row in cups.items():
        for liquid, dose in row.items():
            half, problem = doses.half_interval(dose), doses.problem(dose)
            if problem is None and half > LARGEST_ERROR * dose.amount:
                problem = (
                    f"nine of ten doses of {1e3 * dose.amount:.3g} g are within {1e3 * half:.2g} g; this source and "
                    f"balance support {1e3 * half / LARGEST_ERROR:.2g} g or more"
                )
            if problem is not None:
                refused.setdefault((liquid, problem), []).append(cup)
    forecast.problems = [(several, liquid, problem) for (liquid, problem), several in refused.items()]
    if not forecast.problems:
        forecast.lines += [_composition(cups, doses), *_times(plan.laboratory, series, doses, forecast)]
    return forecast


class _Doses:
    """Predictions of the doses of mixtures, interpolated by their amounts."""

    def __init__(self, laboratory: LaboratorySettings, series: DispensePlan, seed: int) -> None:
        self._by_liquid: dict[str, list[tuple[float, DoseForecast]]] = {}
        self._problems: dict[tuple[str, float], str] = {}
        seeds = SeedStream(seed, "predict mixtures")
        for liquid in dict.fromkeys(dose.liquid or "" for dose in series.doses):
            planned = sorted((d for d in series.doses if d.liquid == liquid), key=lambda dose: dose.amount)
            self._by_liquid[liquid] = []
            for dose in {dose.amount: dose for dose in (planned[0], planned[-1])}.values():
                scene = series.scene(series.sources_of(dose)[0], dose.receiver)
                source = DoseSource(scene.pourer.name, scene.liquid.mass, FILL_DEVIATION, fill=True, constants=0)
                target = DoseTarget(dose.amount, dose.limit, dose.position, source)
                try:
                    predicted = predicted_dose(laboratory, scene, target, seeds.next() % 2**32, PREDICTED)
                except InvalidActionError as error:
                    self._problems[liquid, dose.amount] = str(error)
                else:
                    self._by_liquid[liquid].append((dose.amount, predicted))

    def problem(self, dose: PlannedDose) -> str | None:
        """Why a dose is impossible; None if it is possible or was not predicted."""
        return self._problems.get((dose.liquid or "", dose.amount))

    def predicted(self, liquid: str) -> list[tuple[float, DoseForecast]]:
        """The predicted doses of a liquid by amount [kg]."""
        return self._by_liquid[liquid]

    def half_interval(self, dose: PlannedDose) -> float:
        """Half of the interval around the wanted amount that contains nine of ten doses [kg]."""
        return self._at(dose, [_half(amount, predicted) for amount, predicted in self._by_liquid[dose.liquid or ""]])

    def duration(self, dose: PlannedDose) -> tuple[float, float]:
        """Expected duration, and the one that 95 % of the doses do not exceed [s]."""
        predicted = [forecast for _, forecast in self._by_liquid[dose.liquid or ""]]
        return self._at(dose, [p.duration for p in predicted]), self._at(dose, [p.longest for p in predicted])

    def _at(self, dose: PlannedDose, values: list[float]) -> float:
        amounts = [amount for amount, _ in self._by_liquid[dose.liquid or ""]]
        return float(np.interp(dose.amount, amounts, values)) if amounts else 0.0


def _half(amount: float, predicted: DoseForecast) -> float:
    low, high = predicted.interval
    return math.hypot(max(abs(low - amount), abs(high - amount)), predicted.weighing)


def _fills(series: DispensePlan, seed: int) -> Counter[str]:
    """How often each source is filled, if every dose is as wanted and all sources are filled at the beginning."""
    strategy, fills = dose_strategy(series, seed), Counter[str]()
    for dose in series.doses:
        source = strategy.next_source(dose)
        fills[source.name] += source.fill
        left = KnownSource(
            mass=max(source.mass - dose.amount, 0.0), deviation=math.hypot(source.deviation, WEIGHED_DEVIATION)
        )
        strategy.assume(source.name, left)
    return fills


def _of_liquid(series: DispensePlan, liquid: str, doses: _Doses, fills: Mapping[str, int]) -> str:
    """One liquid: total, sources with their fillings, and its predicted doses."""
    planned = [dose for dose in series.doses if dose.liquid == liquid]
    sources = series.sources_of(planned[0])
    full = 1e3 * series.scene(sources[0], planned[0].receiver).liquid.mass
    filled = ", ".join(f"{name} filled {_times_text(fills[name])}" for name in sources)
    total = 1e3 * sum(dose.amount for dose in planned)
    parts = [f"{liquid}: {total:.4g} g in {len(planned)} doses; {filled}, {full:.4g} g each time"]
    limit = planned[0].limit
    for amount, predicted in doses.predicted(liquid):
        low, high = (1e3 * mass for mass in predicted.interval)
        text = f"{1e3 * amount:.4g} g: {low:.1f} to {high:.1f} g expected (90 %)"
        if _half(amount, predicted) > limit:
            text += f", beyond the tolerance of {1e3 * limit:.3g} g"
        parts.append(text)
    return "; ".join(parts)


def _times_text(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def _composition(cups: Mapping[str, Mapping[str, PlannedDose]], doses: _Doses) -> str:
    """The largest expected error of a share, and the dose that decides it."""
    worst = (0.0, "", "", 0.0)
    for cup, row in cups.items():
        total = sum(dose.amount for dose in row.values())
        errors = {liquid: doses.half_interval(dose) for liquid, dose in row.items()}
        for liquid, dose in row.items():
            share = dose.amount / total
            worst = max(worst, (share_deviation(liquid, share, errors, total), cup, liquid, share))
    half, cup, liquid, share = worst
    return (
        f"composition: shares by mass within ± {100.0 * half:.1f} percentage points (90 %); the least certain is "
        f"{liquid} in {cup}, {100.0 * share:.1f} %"
    )


def _times(laboratory: LaboratorySettings, series: DispensePlan, doses: _Doses, forecast: MixtureForecast) -> list[str]:
    """Duration of all mixtures, and of the slowest cup."""
    assert series.mixtures is not None
    bench, arm = laboratory.bench, laboratory.arm
    handling = laboratory.operator.time + arm.warning_time if arm is not None else bench.operator_time if bench else 0.0

    def total(row: Mapping[str, PlannedDose] | list[PlannedDose]) -> tuple[float, float]:
        """Expected time and half of its interval with a probability of 90 %, errors of the doses independent [s]."""
        times = [doses.duration(dose) for dose in (row.values() if isinstance(row, Mapping) else row)]
        expected = sum(mean for mean, _ in times) + handling * len(times)
        return expected, math.sqrt(sum((longest - mean) ** 2 for mean, longest in times))

    expected, half = total(list(series.doses))
    forecast.open_time = max(sum(total(row)) - handling for row in series.mixtures.cups.values())
    return [
        f"duration: {expected / 60.0:.0f} min, the doses ± {half / 60.0:.1f} min (90 %), with {handling:.0f} s of "
        f"handling for each dose; a cup is open for up to {forecast.open_time / 60.0:.1f} min"
    ]
