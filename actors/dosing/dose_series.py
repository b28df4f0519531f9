"""A series of doses from one source vessel: its content, the estimates that pass from dose to dose, and forecasts.

`DoseSeries` makes the `DoseController` of each dose and receives its result. `DoseSeries.forecast` predicts a dose
before anything moves: it runs the controller against cups that are drawn from the current belief. `check_dose`,
`predict_dose` and `series_of` do the same for a dose of a bench, whose source comes with its target.

Limitations: the forecast knows the model's errors only. On the virtual bench, whose cups differ from the model, the
spread of the amounts is larger.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from actors.dosing.cup_flow import CupFlow, flow_of
from actors.dosing.display_belief import IDEAL_DISPLAY, DisplayBelief
from actors.dosing.dose_controller import (
    DoseController,
    DoseOrder,
    DoseResult,
    check_display,
    fine_flow,
    late_share,
)
from actors.dosing.dose_estimator import DoseBelief, DoseEstimator, DoseReading, draw_lags
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseEnd, DoseKnowledge, DoseSource, DoseTarget, InvalidActionError
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselError
from sim_engine.vessel.vessel import build_vessel, check_holds

TICK = 0.05
"""Time between two decisions in a forecast [s]."""


NINETY_PERCENT = 1.645
"""Half of the interval that contains 90 % of a normal distribution [standard deviations]."""

LOST = (1e-3, 1e-3)
"""Mean and standard deviation of the mass that a dose takes from its source beyond the weighed amount [kg]: dribble and
films. On the virtual bench it is 0.3 g with a spout, and 2.7 g with a round rim."""


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
        # P(M ≥ a) = ½ erfc((a − m) / (s √2)) for a content M ~ N(m, s²)
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
        weighing: half of the interval that contains the true amount with a probability of 90 %, once it is weighed
            [kg].
    """

    amount: float
    interval: tuple[float, float]
    duration: float
    longest: float
    enough: float
    fine_flow: float
    clean_flow: float
    ends: dict[DoseEnd, int]
    weighing: float = 0.0

    @property
    def reachable(self) -> float:
        """Half of the interval around the expected amount that contains nine of ten doses as weighed [kg]."""
        # the scatter of the doses and the error of the weighing are independent: √(h² + w²)
        return math.hypot(0.5 * (self.interval[1] - self.interval[0]), self.weighing)


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
        knowledge: of earlier doses.
        display: of the balance, if it is known otherwise.

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
        knowledge: DoseKnowledge | None = None,
        display: DisplayBelief | None = None,
    ) -> None:
        self._cup, self._settings, self._rng = cup, settings, rng
        self._step, self._fall_time = step, fall_time
        lag = draw_lags(placed, particles, rng, step=step)
        volumes = self._volumes(content)
        belief = (
            DoseBelief.prior(volumes, lag, rng) if knowledge is None else DoseBelief.known(knowledge, volumes, lag, rng)
        )
        shown = DisplayBelief.placed([reading.time for reading in placed], [reading.mass for reading in placed], step)
        self.belief = replace(belief, display=display or belief.display.joined(shown))

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
        share = late_share(order.amount, self._settings)
        amounts, durations, ends = [], [], Counter[DoseEnd]()
        for k, chosen in enumerate(rng.permutation(len(widened.volume))[:count]):
            truth = DoseEstimator(
                self._cup,
                replace(_single(widened, int(chosen)), aim=share * widened.aim),
                fall_time=self._fall_time,
                step=self._step,
                noise=0.0,
                rng=np.random.default_rng((seed, 24, k)),
            )
            draws = widened.display.draws(np.random.default_rng((seed, 25, k)))
            result, duration = self._simulate(
                self._controller(order, widened, seed + k, in_time=True), truth, order, draws
            )
            amounts.append(float(truth.mass[0]))
            durations.append(duration)
            ends[result.end] += 1
        # Quantiles 5 and 95 % of the simulated amounts; the weighing adds its own error, ±1.645 σ, in `reachable`.
        tilt = float(np.median(self._cup.tilt_for(widened.volume, np.zeros_like(widened.volume))))
        fine = fine_flow(self._cup, max(tilt, 0.1), self._settings, order.limit, widened.display.interval, order.amount)
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
            NINETY_PERCENT * self._controller(order, widened, seed).deviation,
        )

    def _simulate(
        self, controller: DoseController, truth: DoseEstimator, order: DoseOrder, repeated: Iterator[bool]
    ) -> tuple[DoseResult, float]:
        """One dose out of a cup of the controller's own model. Returns its result and its duration [s]."""
        base = order.receiver_mass if order.receiver_mass is not None else 0.2
        tilt, speed, readings, ticks = 0.0, 0.0, [DoseReading(0.0, base)], 0
        every, shown = max(round(self.belief.display.interval / TICK), 1), base
        truth.start(0.0, 0.0)
        while controller.result is None:
            time = TICK * ticks
            command = controller.step(time, tilt, readings)
            # a command acts one tick later
            tilt = max(tilt + speed * TICK, 0.0)
            speed = command.speed
            ticks += 1
            truth.advance(TICK * ticks, tilt)
            readings = []
            if ticks % every == 0:
                if not next(repeated):
                    # a display of step d shows d · round(m / d)
                    shown = round((base + float(truth.reading[0])) / self._step) * self._step
                readings = [DoseReading(TICK * ticks, shown)]
        return controller.result, TICK * ticks

    def _controller(self, order: DoseOrder, belief: DoseBelief, seed: int, *, in_time: bool = False) -> DoseController:
        return DoseController(
            self._cup,
            order,
            belief,
            self._settings,
            fall_time=self._fall_time,
            step=self._step,
            seed=seed,
            in_time=in_time,
        )

    def _volumes(self, content: SourceContent) -> tuple[float, float]:
        return content.mass / self._cup.density, content.deviation / self._cup.density


def source_of(scene: Scene, dose: DoseTarget) -> DoseSource:
    """The source of a dose: as the target names it, or the scene's pourer with the scene's load."""
    if dose.source is not None:
        return dose.source
    return DoseSource(scene.pourer.name, scene.liquid.mass, 0.5e-3, fill=True, constants=0)


def check_dose(scene: Scene, dose: DoseTarget) -> None:
    """Check what is known about a dose before it begins.

    Args:
        scene: pourer, receiver and liquid.
        dose: wanted amount.

    Raises:
        InvalidActionError: the source holds too little, the receiver is too small.
    """
    held, wanted = 1e3 * source_of(scene, dose).mass, 1e3 * dose.amount
    if held <= wanted:
        raise InvalidActionError(f"the pourer holds {held:.4g} g, and {wanted:.4g} g are wanted; fill more")
    try:
        check_holds(build_vessel(scene.receiver), (dose.amount + dose.limit) / scene.liquid.density)
    except VesselError as error:
        raise InvalidActionError(f"the receiver is too small: {error}") from error


def predict_dose(
    scene: Scene,
    dose: DoseTarget,
    seed: int,
    settings: DosingSettings,
    count: int = 20,
    display: DisplayBelief | None = None,
) -> DoseForecast:
    """Predict a dose: the controller pours out of cups of its own model.

    Args:
        scene: pourer, receiver and liquid.
        dose: wanted amount.
        seed: of the prediction.
        settings: of the dose.
        count: number of simulated doses.
        display: of the balance; None: as earlier doses from the source have shown, or an ideal one.

    Raises:
        InvalidActionError: see `check_dose` and `check_display`.
    """
    check_dose(scene, dose)
    knowledge = source_of(scene, dose).knowledge
    if display is None:
        display = DisplayBelief.of(knowledge.display) if knowledge is not None and knowledge.display else IDEAL_DISPLAY
    check_display(display, dose.limit, settings)
    rng = np.random.default_rng((seed, 32))
    series = series_of(scene, dose, settings, (), rng, step=display.step, display=display)
    return series.forecast(DoseOrder(dose.amount, dose.limit, receiver_mass=0.2), seed=seed, count=count)


def series_of(
    scene: Scene,
    dose: DoseTarget,
    settings: DosingSettings,
    placed: Sequence[DoseReading],
    rng: np.random.Generator,
    *,
    step: float = 1e-4,
    display: DisplayBelief | None = None,
) -> DoseSeries:
    """The series that a dose continues: with the content and the knowledge of its source.

    Args:
        scene: pourer and liquid.
        dose: with its source.
        settings: of the dose.
        placed, rng, step, display: see `DoseSeries`.
    """
    source = source_of(scene, dose)
    content = SourceContent(source.mass, source.deviation)
    return DoseSeries(
        flow_of(scene), settings, content, placed, rng, step=step, knowledge=source.knowledge, display=display
    )


def unknown_amount(result: DoseResult) -> str:
    """The text for the end of a dose whose amount is unknown."""
    mean, deviation = (1e3 * value for value in result.estimate)
    return (
        f"the dose ended: {result.end}. The amount in the receiver is unknown; estimated are {mean:.1f} g ± "
        f"{2.0 * deviation:.1f} g"
    )


def lost_by(result: DoseResult) -> tuple[float, float]:
    """Mass that a dose took from its source beyond the weighed amount: mean and standard deviation [kg]."""
    return LOST[0] + result.missing, math.hypot(LOST[1], 0.5 * result.missing)


def after_dose(series: DoseSeries, result: DoseResult) -> dict[str, Any]:
    """What a dose has shown, JSON-ready: its end, the content of its source, and the estimates for the next dose.

    Args:
        series: that the dose belongs to, after it.
        result: of the dose.
    """
    content = series.content
    return {
        "received": result.amount,
        "deviation": result.deviation,
        "end": str(result.end),
        "missing_mass": result.missing,
        "top_ups": result.top_ups,
        "innovations": result.innovations,
        "left": [max(content.mass - LOST[0], 0.0), math.hypot(content.deviation, LOST[1])],  # without what missed
        "knowledge": asdict(series.belief.knowledge()),
    }


def _single(belief: DoseBelief, particle: int) -> DoseBelief:
    """The belief with one of its particles only."""
    only = slice(particle, particle + 1)
    return DoseBelief(
        belief.onset_bias[only],
        belief.flow_factor[only],
        belief.lag[only],
        belief.lag_shape[only],
        belief.volume[only],
        belief.aim,
        belief.doses,
        belief.display,
    )
