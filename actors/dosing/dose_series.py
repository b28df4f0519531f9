"""A series of doses from one source vessel: its content, the estimates that pass from dose to dose, and forecasts.

`DoseSeries` makes the `DoseController` of each dose and receives its result. `DoseSeries.forecast` predicts a dose
before anything moves: it runs the controller against cups that are drawn from the current belief.

Limitations: the forecast knows the model's errors only. On the virtual bench, whose cups differ from the model, the
spread of the amounts is larger.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import (
    DoseController,
    DoseEnd,
    DoseOrder,
    DoseResult,
    DosingSettings,
    fine_flow,
)
from actors.dosing.dose_estimator import DoseBelief, DoseEstimator, DoseReading, identify_lag

TICK = 0.05
"""Time between two decisions in a forecast [s]."""

READING_TICKS = 2
"""Decisions between two readings in a forecast."""


@dataclass(frozen=True)
class SourceContent:
    """Content of a source vessel, as far as it is known.

    Attributes:
        mass: expected [kg].
        deviation: its standard deviation [kg].
    """

    mass: float
    deviation: float = 0.5e-3

    def probability_of(self, amount: float) -> float:
        """Probability that it holds at least an amount [kg]."""
        if self.deviation <= 0.0:
            return float(self.mass >= amount)
        return 0.5 * math.erfc((amount - self.mass) / (self.deviation * math.sqrt(2.0)))


@dataclass(frozen=True)
class DoseForecast:
    """A dose, predicted.

    Attributes:
        amount: expected in the receiver [kg].
        interval: that contains the amount with a probability of 90 % [kg].
        duration: expected until it is weighed [s].
        longest: duration that 95 % of the doses do not exceed [s].
        enough: probability that the source holds the amount.
        fine_flow: at the end of the dose [kg/s].
        clean_flow: smallest flow that leaves the lip cleanly; a slower stream may run down the outside [kg/s].
        ends: number of simulated doses by their end.
    """

    amount: float
    interval: tuple[float, float]
    duration: float
    longest: float
    enough: float
    fine_flow: float
    clean_flow: float
    ends: dict[DoseEnd, int]


class DoseSeries:
    """Doses from one source vessel onto one balance.

    Args:
        cup: flow of the source vessel.
        settings: of all doses.
        content: of the source, as weighed.
        placed: readings of the balance while the empty receiver was put on it; empty if there are none.
        rng: draws all randomness.
        particles: number of hypotheses.
        step: of the balance's display [kg].
        fall_time: of the stream from the lip into the receiver [s].

    Attributes:
        belief: before the next dose.
    """

    def __init__(
        self,
        cup: CupFlow,
        settings: DosingSettings,
        content: SourceContent,
        placed: Sequence[DoseReading],
        rng: np.random.Generator,
        *,
        particles: int = 100,
        step: float = 1e-4,
        fall_time: float = 0.17,
    ) -> None:
        self._cup, self._settings, self._rng = cup, settings, rng
        self._step, self._fall_time = step, fall_time
        lag = identify_lag(placed, particles, rng, step=step)
        self.belief = DoseBelief.prior(self._volumes(content), lag, rng)

    @property
    def content(self) -> SourceContent:
        """Estimated content of the source."""
        masses = self._cup.density * self.belief.volume
        return SourceContent(float(masses.mean()), float(masses.std()))

    def fill(self, content: SourceContent) -> None:
        """The source was filled or weighed."""
        self.belief = self.belief.refilled(self._volumes(content), self._rng)

    def controller(self, order: DoseOrder, *, seed: int) -> DoseController:
        """The controller of the next dose.

        Args:
            order: the dose.
            seed: of the controller.
        """
        return self._controller(order, self.belief.widened(self._rng), seed)

    def finish(self, result: DoseResult) -> None:
        """The dose is over; its estimates are those of the next dose."""
        self.belief = result.belief

    def forecast(self, order: DoseOrder, *, seed: int, count: int = 20) -> DoseForecast:
        """Predict the next dose. Neither the belief nor later doses are affected.

        Args:
            order: the dose.
            seed: of the forecast.
            count: number of simulated doses.
        """
        rng = np.random.default_rng((seed, 23))
        widened = self.belief.widened(rng)
        amounts, durations, ends = [], [], Counter[DoseEnd]()
        for k, drawn in enumerate(rng.permutation(len(widened.volume))[:count]):
            truth = DoseEstimator(
                self._cup,
                _single(widened, int(drawn)),
                fall_time=self._fall_time,
                step=self._step,
                noise=0.0,
                rng=np.random.default_rng((seed, 24, k)),
            )
            result, duration = self._simulate(self._controller(order, widened, seed + k), truth, order)
            amounts.append(float(truth.mass[0]))
            durations.append(duration)
            ends[result.end] += 1
        tilt = float(np.median(self._cup.tilt_for(widened.volume, np.zeros_like(widened.volume))))
        fine = fine_flow(self._cup, max(tilt, 0.1), self._settings)
        low, high = (float(np.quantile(amounts, q)) for q in (0.05, 0.95))
        return DoseForecast(
            float(np.mean(amounts)),
            (low, high),
            float(np.mean(durations)),
            float(np.quantile(durations, 0.95)),
            self.content.probability_of(order.amount),
            fine,
            self._cup.density * self._cup.clean_flow(max(tilt, 0.1)),
            dict(ends),
        )

    def _simulate(self, controller: DoseController, truth: DoseEstimator, order: DoseOrder) -> tuple[DoseResult, float]:
        """One dose out of a cup of the controller's own model. Returns its result and its duration [s]."""
        base = order.receiver_mass if order.receiver_mass is not None else 0.2
        tilt, speed, readings, ticks = 0.0, 0.0, [DoseReading(0.0, base)], 0
        truth.start(0.0, 0.0)
        while controller.result is None:
            time = TICK * ticks
            command = controller.step(time, tilt, readings)
            # a command acts one tick later
            tilt = max(tilt + speed * TICK, 0.0)
            speed = command.speed
            ticks += 1
            truth.advance(TICK * ticks, tilt)
            shown = round((base + float(truth.reading[0])) / self._step) * self._step
            readings = [DoseReading(TICK * ticks, shown)] if ticks % READING_TICKS == 0 else []
        return controller.result, TICK * ticks

    def _controller(self, order: DoseOrder, belief: DoseBelief, seed: int) -> DoseController:
        return DoseController(
            self._cup, order, belief, self._settings, fall_time=self._fall_time, step=self._step, seed=seed
        )

    def _volumes(self, content: SourceContent) -> tuple[float, float]:
        return content.mass / self._cup.density, content.deviation / self._cup.density


def _single(belief: DoseBelief, particle: int) -> DoseBelief:
    """The belief with one of its particles only."""
    one = slice(particle, particle + 1)
    return DoseBelief(
        belief.onset_bias[one],
        belief.flow_factor[one],
        belief.lag[one],
        belief.lag_shape[one],
        belief.volume[one],
        belief.aim,
        belief.doses,
    )
