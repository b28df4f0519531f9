"""Predicts mixtures before anything moves: order, sources, errors of the doses and of the composition, and duration.

The smallest and the largest dose of each liquid are predicted as the first dose from a full source, about which nothing
is known yet; the errors of the doses between are interpolated. Later doses are usually better.
"""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from actors.dosing.display_belief import DisplayBelief
from actors.dosing.dose_series import DoseForecast, predict_dose
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseSource, DoseTarget
from actors.laboratory import expected_display
from orchestrator.campaigns.dose_flows import dose_digest
from orchestrator.learning.campaign_plan import CampaignPlan, PlannedDose
from orchestrator.learning.dispense import FILL_DEVIATION, WEIGHED_DEVIATION, KnownSource, share_deviation
from orchestrator.learning.mixtures import dose_strategy
from orchestrator.learning.trials import SeedStream
from orchestrator.records.codec import from_json, to_json
from sim_engine.resources import load_arrays, store_arrays
from sim_engine.scene import Scene

PREDICTED = 8
"""Simulated doses of each prediction."""

LARGEST_ERROR = 0.5
"""Error of a dose, as a share of its amount, from which on it is refused."""


CARRIED_DOSE, CARRIED_CUP = 23.0, 57.0
"""Time in which an arm takes and returns the source of a dose and weighs the cup, and carries a cup to the balance and
back [s], as measured with `configs/laboratories/rack.yaml` without a person."""


class MixtureForecast:
    """What is expected of mixtures.

    Args:
        plan: of a campaign with mixtures.
        doing: called with a description of each prediction before it begins; a prediction takes seconds.

    Attributes:
        fills: how often each source is filled, if every dose is as wanted and all are filled at the beginning.
        open_time: time from the first dose into the slowest cup to its last one, exceeded with 5 % [s].

    Raises:
        InvalidActionError: a dose is impossible.
    """

    def __init__(self, plan: CampaignPlan, doing: Callable[[str], None] = lambda text: None) -> None:
        series = plan.dispense
        assert series is not None
        assert series.mixtures is not None
        self._series, self._cups, self._laboratory = series, series.mixtures.cups, plan.laboratory
        self._predicted: dict[str, list[tuple[float, DoseForecast]]] = {}
        planned: dict[str, dict[float, PlannedDose]] = {}
        for dose in series.doses:
            planned.setdefault(dose.liquid or "", {})[dose.amount] = dose
        chosen = [(liquid, amount) for liquid, doses in planned.items() for amount in sorted({min(doses), max(doses)})]
        # neither the campaign's seed nor other liquids decide what is supported
        seeds = {liquid: SeedStream(0, "predict mixtures") for liquid in planned}
        for number, (liquid, amount) in enumerate(chosen, 1):
            doing(f"predicting the doses of the mixtures, {number} of {len(chosen)}: {1e3 * amount:.3g} g of {liquid}")
            predicted = self._prediction(planned[liquid][amount], seeds[liquid].next() % 2**32)
            self._predicted.setdefault(liquid, []).append((amount, predicted))
        self.fills = self._fillings(plan.seed)
        bench, arm = plan.laboratory.bench, plan.laboratory.arm
        attended = plan.laboratory.operator.time + arm.warning_time if arm is not None else None
        self._handling = attended if attended is not None else bench.operator_time if bench is not None else 0.0
        self._cup_time = 0.0
        if plan.laboratory.places:
            self._handling, self._cup_time = CARRIED_DOSE, CARRIED_CUP
        self.open_time = max(sum(self._duration(row.values())) - self._handling for row in self._cups.values())

    def _prediction(self, dose: PlannedDose, seed: int) -> DoseForecast:
        scene = self._series.scene(self._series.sources_of(dose)[0], dose.receiver)
        source = DoseSource(scene.pourer.name, scene.liquid.mass, FILL_DEVIATION, fill=True, constants=0)
        target = DoseTarget(dose.amount, dose.limit, dose.position, source)
        display = expected_display(self._laboratory.balance)
        return _predicted(scene, target, seed, self._laboratory.dosing, display)

    def _fillings(self, seed: int) -> Counter[str]:
        strategy, fills = dose_strategy(self._series, seed), Counter[str]()
        for dose in self._series.doses:
            source = strategy.next_source(dose)
            fills[source.name] += source.fill
            mass, deviation = source.mass - dose.amount, math.hypot(source.deviation, WEIGHED_DEVIATION)
            strategy.assume(source.name, KnownSource(mass=max(mass, 0.0), deviation=deviation))
        return fills

    def _at(self, dose: PlannedDose, values: Iterable[float]) -> float:
        """A value at the amount of a dose, from those of the predicted amounts."""
        return float(np.interp(dose.amount, [amount for amount, _ in self._predicted[dose.liquid or ""]], [*values]))

    def _half(self, dose: PlannedDose) -> float:
        """Half of the interval around the wanted amount that contains nine of ten doses [kg]."""
        return self._at(dose, (_half(amount, predicted) for amount, predicted in self._predicted[dose.liquid or ""]))

    def _duration(self, doses: Iterable[PlannedDose]) -> tuple[float, float]:
        """Expected time of doses with their handling, and how much longer it takes with 5 % [s]."""
        expected = variance = 0.0
        for dose in doses:
            predicted = [forecast for _, forecast in self._predicted[dose.liquid or ""]]
            mean = self._at(dose, (forecast.duration for forecast in predicted))
            expected += mean + self._handling
            variance += (self._at(dose, (forecast.longest for forecast in predicted)) - mean) ** 2
        return expected, math.sqrt(variance)

    def refused(self) -> list[tuple[list[str], str, str]]:
        """Doses that source and balance can't support: cups, liquid, and the reason."""
        refused: dict[tuple[str, str], list[str]] = {}
        for cup, row in self._cups.items():
            for liquid, dose in row.items():
                half = self._half(dose)
                if half > LARGEST_ERROR * dose.amount:
                    text = (
                        f"nine of ten doses of {1e3 * dose.amount:.3g} g are within {1e3 * half:.2g} g; this source "
                        f"and balance support {1e3 * half / LARGEST_ERROR:.2g} g or more"
                    )
                    refused.setdefault((liquid, text), []).append(cup)
        return [(cups, liquid, text) for (liquid, text), cups in refused.items()]

    def lines(self) -> list[str]:
        """The forecast for people."""
        doses, first = self._series.doses, next(iter(self._cups.values()))
        changes = sum(a.liquid != b.liquid for a, b in itertools.pairwise(doses))
        expected, longer = self._duration(doses)
        expected += self._cup_time * len(self._cups)
        carried = f" and {self._cup_time:.0f} s a cup" if self._cup_time else ""
        return [
            f"{len(self._cups)} cups, {len(doses)} doses, {changes} changes of source; first cup: "
            + ", then ".join(f"{liquid} {1e3 * dose.amount:.4g} g" for liquid, dose in first.items()),
            *map(self._of_liquid, self._predicted),
            self._composition(),
            f"duration: {expected / 60.0:.0f} min, the doses ± {longer / 60.0:.1f} min (90 %), with "
            f"{self._handling:.0f} s of handling a dose{carried}; "
            f"a cup is open for up to {self.open_time / 60.0:.1f} min",
        ]

    def _of_liquid(self, liquid: str) -> str:
        """One liquid: total, sources with their fillings, and its predicted doses."""
        planned = [dose for dose in self._series.doses if dose.liquid == liquid]
        sources, limit = self._series.sources_of(planned[0]), planned[0].limit
        full = 1e3 * self._series.scene(sources[0], planned[0].receiver).liquid.mass
        times = {0: "not needed", 1: "filled once", 2: "filled twice"}
        filled = [f"{name} {times.get(count := self.fills[name], f'filled {count} times')}" for name in sources]
        total = 1e3 * sum(dose.amount for dose in planned)
        texts = [f"{liquid}: {total:.4g} g in {len(planned)} doses; {', '.join(filled)}, {full:.4g} g each time"]
        for amount, predicted in self._predicted[liquid]:
            low, high = (1e3 * mass for mass in predicted.interval)
            beyond = f", beyond the tolerance of {1e3 * limit:.3g} g" if _half(amount, predicted) > limit else ""
            texts.append(f"{1e3 * amount:.4g} g: {low:.1f} to {high:.1f} g expected (90 %){beyond}")
        return "; ".join(texts)

    def _composition(self) -> str:
        """The largest expected error of a share, and the dose that decides it."""
        errors = []
        for cup, row in self._cups.items():
            total = sum(dose.amount for dose in row.values())
            halves = {liquid: self._half(dose) for liquid, dose in row.items()}
            for liquid, dose in row.items():
                share = dose.amount / total
                errors.append((share_deviation(liquid, share, halves, total), liquid, cup, share))
        half, liquid, cup, share = max(errors)
        return (
            f"composition: shares by mass within ± {100.0 * half:.1f} percentage points (90 %); the least certain is "
            f"{liquid} in {cup}, {100.0 * share:.1f} %"
        )


def _predicted(
    scene: Scene, target: DoseTarget, seed: int, settings: DosingSettings, display: DisplayBelief | None
) -> DoseForecast:
    """A prediction, kept in the cache directory: a campaign is checked by `validate`, and again when it begins."""
    name = f"forecast-{dose_digest(scene, target, seed, settings, PREDICTED, display)}"
    stored = load_arrays(name)
    if stored is not None:
        found: DoseForecast = from_json(json.loads(str(stored["forecast"])), DoseForecast)
        return found
    predicted = predict_dose(scene, target, seed, settings, PREDICTED, display)
    store_arrays(name, {"forecast": np.array(json.dumps(to_json(predicted, DoseForecast)))})
    return predicted


def _half(amount: float, predicted: DoseForecast) -> float:
    low, high = predicted.interval
    return math.hypot(max(abs(low - amount), abs(high - amount)), predicted.weighing)
