"""The simulator judged by pours: its deviation from the bench, in words, and the rules that follow from it.

- `SimulatorMonitor` records the optimiser's conclusions after every pour and decides whether the next pour is made.
- `offset_priors` and `displacement` describe how a bench may deviate from its simulator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from actors.optimizer.questions import BenchOffset, DiscrepancyFound, Limit, OffsetPrior, Suggestion
from orchestrator.learning.deployment.real_pours import DeploymentTrial
from orchestrator.learning.requests import Decision
from orchestrator.learning.stage_result import ResultPart
from sim_engine.action import ACTION_DIMENSIONS, DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity

Fallback = Literal["go on", "stop"]

GO_ON: Final = "go on"

ALARM = 0.9
"""Probability of an uninformative simulator from which an alarm is raised."""

SAME_CHANGE = 10
"""Number of pours after an announced change of the bench in which a later date of it is not announced again."""

DOUBT = 0.3
"""Probability of an uninformative simulator from which it is in doubt."""

WORDS = (
    (0.05, "agrees with the pours"),
    (DOUBT, "agrees with the pours so far"),
    (0.7, "is uncertain"),
    (0.95, "is probably wrong here"),
)
"""Description of the simulator below each probability of being uninformative; above all, it is wrong here."""


class RiskLimitSettings(Settings):
    """D3 with `model: adaptive`: what no pour may lose; for the first one if a calibration or prior supports it."""

    loss: Annotated[float, Quantity("1", "10 %", 1e-3, 1.0)] = 0.1
    """As a share of what spilling the whole load would cost."""

    probability: Annotated[float, Quantity("1", "5 %", 1e-3, 0.5)] = 0.05
    """With which a pour may lose more."""

    fallback: Fallback = GO_ON
    """Where no action keeps it, which is logged before the pour. go on: the least risky one is poured; stop: the
    deployment ends."""


class StopSettings(Settings):
    """D3 with `model: adaptive`: when no further pour is worth it."""

    min_gain: Annotated[float, Quantity("1", "0.2 %", 1e-5, 1.0)] = 0.002
    """Share of what spilling the whole load would cost: ends when no further pour is expected to save as much."""


class Belief(ResultPart):
    """Conclusions about the simulator after a pour."""

    pour: int
    """Number of the pour; 0: before the first one."""

    ignorance: float
    """Probability that the simulator contains no information about this bench."""

    gain: float | None
    """Expected saving of one more pour, in the unit of the loss."""


class Displaced(ResultPart):
    """Difference between the simulated and the commanded value of a dimension."""

    mean: float
    """Mean in the middle of the searched range [SI]."""

    deviation: float
    """Standard deviation [SI]."""


class Believed(ResultPart):
    """Conclusions about the simulator, pour by pour."""

    after: tuple[Belief, ...]
    """State after each pour that changed it."""

    displaced: dict[str, Displaced]
    """Differences by dimension."""

    factor: float
    """Ratio of real to simulated loss."""

    alarm: bool
    """Whether the simulator seems not to describe this bench: a probability of 90 % or more."""

    changed_since: int | None = None
    """Number of the first pour since which the bench has behaved differently; None if it has not."""

    text: str
    """The last state as a sentence."""


class BenchFound(ResultPart):
    """Draws of the deviation of the bench from the simulator, for the next receiver."""

    axes: tuple[str, ...]
    """Searched dimensions, in order."""

    scales: tuple[tuple[float, ...], ...]
    """The factor of each draw in each dimension."""

    shifts: tuple[tuple[float, ...], ...]
    """The shift of each draw in each dimension, on the unit interval."""

    def displacements(self) -> tuple[BenchOffset, ...]:
        """The draws as bench offsets of a query."""
        return tuple(BenchOffset(*pair) for pair in zip(self.scales, self.shifts, strict=True))


@dataclass(frozen=True)
class Rules:
    """Rules from the settings; losses in their own unit."""

    limit: Limit | None
    fallback: Fallback
    min_gain: float | None
    good_enough: float | None


class SimulatorMonitor:
    """Records the conclusions about the simulator in `decisions`, and decides whether a proposed pour is made."""

    def __init__(self, rules: Rules, actions: Space, worst: float, decisions: list[Decision]) -> None:
        self._rules, self._actions, self._worst = rules, actions, worst
        self._after: list[Belief] = []
        self._latest: DiscrepancyFound | None = None
        self._changed: int | None = None
        self._announced = -SAME_CHANGE
        self._alarmed = self._accepted = self._drifted = False
        self.decisions = decisions

    # -- what is logged --------------------------------------------------------------------------------------------

    def record(self, latest: DiscrepancyFound, pours: Sequence[DeploymentTrial]) -> None:
        """Record the conclusions of an answer, and log those of the latest pour."""
        weighed = [pour for pour in pours if pour.cost is not None]
        number = weighed[-1].number if weighed else 0
        self._latest, since = latest, latest.since_change
        self._changed = weighed[-since].number if since and since <= len(weighed) else None
        if self._changed is not None and not self._drifted and self._changed > self._announced + SAME_CHANGE:
            self._announced = self._changed
            text = f"since pour {self._changed} the bench behaves differently: what was poured before no longer counts"
            self.decisions.append(Decision(text, {"changed_since": float(self._changed)}, urgent=True))
        if latest.drifts is not None and not self._drifted:
            self._drifted = True
            text = "the bench drifts"
            pairs = zip(self._actions.axes, latest.drifts, strict=True)
            if paces := [_difference(axis, _in_si(axis, drift, 0.0)) for axis, drift in pairs if drift]:
                text += f": with every pour, it is as if {' and '.join(paces)} than before"
            self.decisions.append(Decision(f"{text}; older pours count less", urgent=True))
        if self._after and self._after[-1].pour == number:
            return
        self._after.append(Belief(pour=number, ignorance=latest.uninformative, gain=latest.gain))
        if number:
            values = {"ignorance": latest.uninformative} | ({} if latest.gain is None else {"gain": latest.gain})
            self.decisions.append(Decision(f"after pour {number} {self.text}", values, urgent=True))

    @property
    def text(self) -> str:
        """'the simulator agrees with the pours: probability 2 % that it does not describe this bench; …'."""
        if self._latest is None:
            return ""
        share = self._latest.uninformative
        word = next((word for limit, word in WORDS if share < limit), "is wrong here")
        text = f"the simulator {word}: probability {_percent(share)} that it does not describe this bench"
        if self._changed is not None:
            text += f"; since pour {self._changed} the bench behaves differently"
        if share >= WORDS[-2][0]:
            return text
        pairs = zip(self._actions.axes, self._shifts(), strict=True)
        if moved := [_difference(axis, offset) for axis, offset in pairs if abs(offset.mean) > offset.deviation]:
            text += f"; the pours look as if {' and '.join(moved)} than commanded"
        if abs(math.log(self._latest.factor)) > 0.2:
            text += f"; {self._latest.factor:.2g} times the predicted loss"
        return text

    def _shifts(self) -> list[Displaced]:
        assert self._latest is not None
        pairs = zip(self._actions.axes, self._latest.shifts, self._latest.deviations, strict=True)
        return [_in_si(axis, shift, deviation) for axis, shift, deviation in pairs]

    # -- decisions ----------------------------------------------------------------------------------------------

    def judge(self, suggestion: Suggestion, pours: Sequence[DeploymentTrial], left: int) -> str:
        """Decide whether the proposed pour is made: the reason why no pour follows, or an empty text.

        Args:
            suggestion: the answer that proposes it.
            pours: pours made so far.
            left: number of pours left in the budget.
        """
        discrepancy, rules = suggestion.discrepancy, self._rules
        if discrepancy is None:
            return ""
        weighed = [pour.cost for pour in pours if pour.status == "weighed" and pour.cost is not None]
        if weighed and suggestion.best_mean is not None:
            best = max(suggestion.best_mean, 0.0)
            if rules.good_enough is not None and best <= rules.good_enough:
                return self._saved(left, f"good enough: the best action is expected to lose {self._share(best)}")
            if rules.min_gain is not None and discrepancy.gain is not None and discrepancy.gain < rules.min_gain:
                why = f"no further pour is worthwhile: the next one is expected to save {self._share(discrepancy.gain)}"
                return self._saved(left, f"{why}, the best action to lose {self._share(best)}")
        if discrepancy.uninformative >= ALARM and not self._alarmed and weighed:
            self._alarmed = True
            self.decisions.append(Decision(f"{self.text}; the simulator is weighted accordingly", urgent=True))
            return ""
        limit = rules.limit
        if limit is None or not discrepancy.exceedances:
            if limit is not None and not pours:
                text = "no calibration or prior supports the risk limit: it applies after the first pour that keeps it"
                self.decisions.append(Decision(text, urgent=True))
            return ""
        risk = discrepancy.exceedances[0]
        if risk <= limit.probability * (1.0 + 1e-9):
            return ""
        why = (
            f"no action is known to keep the limit: the least risky one loses more than {self._share(limit.loss)} "
            f"with {_percent(risk)}, allowed are {_percent(limit.probability)}"
        )
        if self._accepted:
            self.decisions.append(Decision(f"{why}; it is poured", {"risk": risk}, urgent=True))
            return ""
        self._accepted = rules.fallback == GO_ON
        then = "the least risky action is poured" if self._accepted else "this deployment ends with what is known"
        self.decisions.append(Decision(f"{why}; {then}", urgent=True))
        return "" if self._accepted else why

    def _saved(self, left: int, why: str) -> str:
        end = f"{why}; {left} pour{'s' * (left != 1)} saved"
        self.decisions.append(Decision(f"stopped: {end}", {"saved": float(left)}, urgent=True))
        return end

    def _share(self, loss: float) -> str:
        return _percent(loss / self._worst)

    # -- results ---------------------------------------------------------------------------------------------------

    def result(self) -> Believed:
        """All conclusions so far."""
        share = self._after[-1].ignorance if self._after else 0.0
        displaced = {} if self._latest is None else dict(zip(self._actions.names, self._shifts(), strict=True))
        return Believed(
            after=tuple(self._after),
            displaced=displaced,
            factor=1.0 if self._latest is None else self._latest.factor,
            alarm=share >= ALARM,
            changed_since=self._changed,
            text=self.text,
        )

    def bench(self) -> BenchFound | None:
        """Deviation of the bench for the next receiver; None if no query requested it."""
        if self._latest is None or not self._latest.drawn:
            return None
        draws = self._latest.drawn
        return BenchFound(
            axes=self._actions.names,
            scales=tuple(draw.scales for draw in draws),
            shifts=tuple(draw.shifts for draw in draws),
        )


def _in_si(axis: Axis, shift: float, deviation: float) -> Displaced:
    """A shift on the unit interval in the unit of the axis, at the middle of its range."""
    if axis.scale == "log":
        middle, width = axis.decode(0.5), math.log(axis.upper / axis.lower)
        return Displaced(mean=middle * math.expm1(shift * width), deviation=middle * deviation * width)
    width = axis.upper - axis.lower
    return Displaced(mean=shift * width, deviation=deviation * width)


def _difference(axis: Axis, offset: Displaced) -> str:
    """'x_offset were 6 ± 2 mm more'; without a deviation 'x_offset were about 6 mm more'."""
    dimension = ACTION_DIMENSIONS.get(axis.name)
    factor, unit = (1.0, "") if dimension is None else (dimension.factor, f" {dimension.display_unit}")
    size, deviation = abs(offset.mean) / factor, offset.deviation / factor
    shown = f"{size:.2g} ± {deviation:.1g}" if deviation else f"about {size:.1g}"
    return f"{axis.name} were {shown}{unit} {'more' if offset.mean > 0.0 else 'less'}"


def _percent(share: float) -> str:
    """'3 %', '0.4 %'."""
    percent = 100.0 * share
    if percent < 0.05:
        return "less than 0.1 %"
    return f"{percent:.1f} %" if percent < 9.95 else f"{percent:.0f} %"


LENGTH = 0.010
"""Standard deviation of a position [m]; receivers are placed by hand."""

ANGLE = 2.0 * DEG
"""Standard deviation of a tilt [rad]."""

CLOCK = 0.05
"""Relative standard deviation of a speed, an acceleration or a time."""

UNKNOWN = 0.1
"""Standard deviation of a dimension with any other unit, as a fraction of the searched range."""


def offset_priors(actions: Space) -> tuple[OffsetPrior, ...]:
    """Assumed deviation of each searched dimension."""
    return tuple(_offset_prior(axis) for axis in actions.axes)


def displacement(believed: SimulationParameters, bench: SimulationParameters, actions: Space) -> BenchOffset:
    """Offset at which a simulator with one set of nuisances behaves like a bench with another set.

    Nuisances of dimensions that are not searched are left to the rest of the model.

    Args:
        believed: parameters of the simulator.
        bench: possible parameters of the bench.
    """
    scales, shifts = [], []
    moved = {
        "x_offset": bench.receiver_x - believed.receiver_x,
        "y_offset": believed.receiver_y - bench.receiver_y,  # the receiver moves, which shifts the pourer the other way
        "height": believed.receiver_z - bench.receiver_z,
        "max_angle": bench.tilt_zero - believed.tilt_zero,
    }
    for axis in actions.axes:
        factor = bench.speed_factor / believed.speed_factor if axis.name == "angular_velocity" else 1.0
        if axis.scale == "log":
            middle = axis.decode(0.5)
            factor *= max(1.0 + moved.get(axis.name, 0.0) / middle, 0.1)
            scales.append(1.0)
            shifts.append(math.log(factor) / math.log(axis.upper / axis.lower))
        else:
            width = axis.upper - axis.lower
            scales.append(factor)
            shifts.append(((factor - 1.0) * axis.lower + moved.get(axis.name, 0.0)) / width)
    return BenchOffset(tuple(scales), tuple(shifts))


def _offset_prior(axis: Axis) -> OffsetPrior:
    dimension = ACTION_DIMENSIONS.get(axis.name)
    unit = "" if dimension is None else dimension.unit
    if axis.scale == "log":  # a factor is a shift on a logarithmic axis
        return OffsetPrior(shift=CLOCK / math.log(axis.upper / axis.lower) if unit not in ("m", "rad", "") else UNKNOWN)
    width = axis.upper - axis.lower
    match unit:
        case "m":
            return OffsetPrior(shift=LENGTH / width)
        case "rad":
            return OffsetPrior(shift=ANGLE / width)
        case "":
            return OffsetPrior(shift=UNKNOWN)
        case _:
            return OffsetPrior(factor=CLOCK, origin=axis.lower / width)
