"""The commissioning check of a balance: rest, repeated readings, lag, tolerance of a dose, linearity, and vibration.

`check_balance` reads a balance through its driver while loads are put on and taken off, and yields one `DeviceCheck`
per finding. A `CheckOperator` has the hands: a person at the terminal, or the emulator of a virtual balance. Nothing is
changed in the balance except its tare.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actors.balance.balance_interface import BalanceDriver, Weight
from actors.balance.display_quality import arrivals, dose_tolerance, repeated_readings, smallest_change
from actors.balance.scale_model import Load
from actors.balance.step_response import StepResponse, step_response
from actors.dosing_settings import DosingSettings
from actors.interfaces import DeviceCheck, LaboratoryError, State

REST_TIME = 20.0
"""Observation of the empty balance, and of the balance while the arm moves [s]."""

LEAD_TIME = 1.0
"""Observation before the load is put on for the lag, by the emulator [s]."""

STEP_TIME = 15.0
"""Observation of one step of the load [s]."""

RISE_TIME = 10.0
"""Duration of the slow rise of the load, for repeated readings [s]."""

FEWEST, LONGEST_INTERVAL = 3, 5.0
"""Fewest readings of an observation, for which it takes longer; longest time that each of them may take [s]."""

RISE_STEPS = 1.5
"""Rise per reading of that load, in display steps."""

FLOW, SLOWEST_FLOW = DosingSettings().largest_fine_flow, DosingSettings().smallest_flow
"""Flows at the end of a dose for which its tolerance is stated [kg/s]."""

SLOW = 1.0
"""Lag beyond which a dose is stopped late [s]."""

REPEATED = 0.05
"""Share of repeated readings beyond which doses become less exact."""

DOSE = 2e-3
"""Tolerance of a dose that a balance should support [kg]."""

SPARSE = 4.0
"""Readings per second below which a flow is hardly seen."""

DOCS = "docs/laboratory/connect-a-balance.md#check-it"


class CheckOperator(Protocol):
    """The hands of the check. Each method returns when it is done."""

    def empty(self) -> None:
        """Take everything off, except what the pour has on the balance."""
        ...

    def announce(self) -> None:
        """Prepare to put on the empty receiver in one movement."""
        ...

    def put(self) -> None:
        """Called while the display is observed: an emulator puts the load on now, a person already does."""
        ...

    def rise(self, mass: float, seconds: float) -> bool:
        """Begin to add at least a mass [kg] steadily over a time [s], with the receiver on; False if it can't."""
        ...

    def reference(self) -> float | None:
        """Put on the next reference weight, alone; return its mass [kg], None if there is no more."""
        ...

    def move(self) -> bool:
        """Let the arm move with the empty pourer, near the balance; False if it can't."""
        ...


@dataclass(frozen=True)
class _Series:
    """Readings of the display: times [s of bench time], masses [kg], and whether each was stable."""

    times: NDArray[np.float64]
    masses: NDArray[np.float64]
    stable: NDArray[np.bool_]

    @property
    def rate(self) -> float:
        """Readings per second."""
        return (len(self.times) - 1) / float(self.times[-1] - self.times[0])

    @property
    def gaps(self) -> NDArray[np.float64]:
        """Times between readings [s]."""
        return np.diff(self.times)

    def trend(self, step: float) -> tuple[float, float, float]:
        """Slope, its standard error [kg/s], and the scatter around it [kg]; `step` is the display's [kg]."""
        t = self.times - self.times.mean()
        slope = float(t @ self.masses / (t @ t))
        scatter = float(np.sqrt(np.sum((self.masses - self.masses.mean() - slope * t) ** 2) / max(len(t) - 2, 1)))
        return slope, math.hypot(scatter / math.sqrt(t @ t), step / math.sqrt(12.0) / float(np.ptp(t))), scatter


class _Check:
    """One check; see `check_balance`."""

    def __init__(
        self, driver: BalanceDriver, operator: CheckOperator, repeatability: float, scale: float, step: float | None
    ) -> None:
        self._driver, self._operator = driver, operator
        self._repeatability, self._scale, self._step = repeatability, scale, step or 0.0
        self._noise, self._read_at = 0.0, -np.inf
        self._gaps: Sequence[float] | NDArray[np.float64] = ()
        self._interval, self._repeats = 0.1, 0.0

    def run(self) -> Iterator[DeviceCheck]:
        yield DeviceCheck("balance", "ok", self._driver.connect())
        self._operator.empty()
        self._driver.tare()
        self._step = self._step or self._driver.weigh().step
        yield from self._rest()
        self._operator.announce()
        lead = self._observe(LEAD_TIME)
        self._operator.put()
        placed = self._observe(STEP_TIME)
        yield self._risen(lead, placed)
        yield from self._lag(lead, placed)
        self._operator.empty()
        yield self._zero("after the load")
        weighed = 0
        while (mass := self._operator.reference()) is not None:
            weighed += 1
            yield self._reference(mass)
        if weighed:
            self._operator.empty()
            yield self._zero("after the reference weights")
        else:
            yield DeviceCheck("linearity", "warn", "not checked: no reference weight", "put on weights of known mass")
        yield self._vibration()

    @property
    def _tolerance(self) -> float:
        """Largest difference of two weights of the same load [kg]."""
        return max(2.0 * self._step, 3.0 * self._repeatability)

    def _rest(self) -> Iterator[DeviceCheck]:
        seen = self._observe(REST_TIME)
        slope, error, scatter = seen.trend(self._step)
        self._noise = scatter
        share, rate = float(seen.stable.mean()), seen.rate
        gaps = arrivals(seen.times)
        self._gaps, self._interval = seen.gaps, gaps.interval
        sparse = "set a faster output, or a shorter 'interval'; a flow needs several readings a second"
        yield DeviceCheck(
            "readings",
            *_state(
                rate >= SPARSE,
                f"{rate:.1f} in a second, {gaps.interval:.3f} s apart (median; standard deviation {gaps.jitter:.3f} s, "
                f"at most {gaps.longest:.2f} s); right: {SPARSE:g} or more",
                sparse,
            ),
        )
        text = f"{_g(scatter)} (standard deviation), {100 * share:.0f} % stable; right: {_g(self._tolerance)} or less"
        draught = "shield it from draught, put it on a firm table away from the arm's, or set a slower filter"
        yield DeviceCheck("noise", *_state(scatter <= self._tolerance and share > 0.9, text, draught))
        minute = 60.0 * slope
        drifting = abs(slope) > 3.0 * error and abs(minute) > self._tolerance
        text = f"{1e3 * minute:+.2f} ± {60e3 * error:.2f} g in a minute; right: at most {_g(self._tolerance)}"
        warm = "let it warm up for an hour, keep the sun and draught off, level it, adjust it; then check again"
        yield DeviceCheck("drift", *_state(not drifting, text, warm))

    def _risen(self, lead: _Series, placed: _Series) -> DeviceCheck:
        """The resolution, and the share of repeated readings while the load rises slowly."""
        wanted = max(0.1, RISE_STEPS * self._step * RISE_TIME / self._interval)
        if not self._operator.rise(wanted, RISE_TIME):
            return DeviceCheck("repeats", "warn", "not measured: nothing was poured", "repeat it, and pour water")
        seen = self._observe(RISE_TIME + 2.0)
        changed = smallest_change([*lead.masses, *placed.masses, *seen.masses])
        step = max(self._step, changed)
        repeats = repeated_readings(seen.times, seen.masses, step)
        if repeats is None:
            advice = f"repeat it, and pour at least {_g(wanted)} in {RISE_TIME:g} s, without a pause"
            return DeviceCheck(
                "repeats", "warn", f"not measured: the load rose too slowly for steps of {_g(step)}", advice
            )
        self._repeats, self._gaps = repeats.share, repeats.gaps or self._gaps
        text = (
            f"{100 * repeats.share:.0f} % of {repeats.count} readings repeat the one before while the load rises "
            f"(95 %: {100 * repeats.low:.0f} to {100 * repeats.high:.0f} %), for at most {repeats.longest:.1f} s, "
            f"in steps of {_g(step)}; right: {100 * REPEATED:.0f} % or less"
        )
        return DeviceCheck("repeats", *_state(repeats.share <= REPEATED, text, "set a faster output or display rate"))

    def _lag(self, lead: _Series, risen: _Series) -> Iterator[DeviceCheck]:
        times, masses = [*lead.times, *risen.times], [*lead.masses, *risen.masses]
        try:
            repeats = self._repeats if self._repeats > REPEATED else None
            step = step_response(times, masses, resolution=self._step, repeats=repeats)
        except ValueError as error:
            yield DeviceCheck("lag", "warn", f"not measured: {error}", "repeat the check")
            return
        text = (
            f"{step.lag:.2f} ± {max(step.error, 0.01):.2f} s behind a load of {_g(step.step)} ({step.form}); "
            f"right: {SLOW:g} s or less"
        )
        yield DeviceCheck("lag", *_state(step.lag <= SLOW, text, "set a faster filter in its menu, then check again"))
        yield self._dose(step)

    def _dose(self, step: StepResponse) -> DeviceCheck:
        tolerance = dose_tolerance(FLOW, step.error, self._gaps, self._step, self._noise)
        slowest = dose_tolerance(SLOWEST_FLOW, step.error, self._gaps, self._step, self._noise)
        text = (
            f"±{_g(tolerance)} (95 %) can be met at {1e3 * FLOW:g} g/s at the end, ±{_g(slowest)} at "
            f"{1e3 * SLOWEST_FLOW:g} g/s; right: {_g(DOSE)} or less"
        )
        advice = "weigh doses on a finer or faster balance, or ask for a wider tolerance"
        return DeviceCheck("dose", *_state(tolerance <= DOSE, text, advice))

    def _reference(self, mass: float) -> DeviceCheck:
        weight = self._driver.weigh().mass
        deviation = weight - mass
        text = f"{_g(mass)} weigh {_g(weight)}: {1e3 * deviation:+.3g} g; right: within {_g(self._tolerance)}"
        wrong = abs(deviation) > 0.1 * mass
        advice = "was another mass typed, or its unit?" if wrong else "level it and adjust it with its own weight"
        return DeviceCheck("linearity", *_state(abs(deviation) <= self._tolerance, text, advice, bad="fail"))

    def _zero(self, when: str) -> DeviceCheck:
        weight = self._driver.weigh().mass
        text = f"{1e3 * weight:+.3g} g {when}; right: within {_g(self._tolerance)}"
        return DeviceCheck(
            "return to zero", *_state(abs(weight) <= self._tolerance, text, "does something touch the tray?")
        )

    def _vibration(self) -> DeviceCheck:
        if not self._operator.move():
            return DeviceCheck("vibration", "warn", "not checked: the arm did not move", "repeat it with the arm")
        seen = self._observe(REST_TIME)
        _, _, scatter = seen.trend(self._step)
        limit = max(self._tolerance, 3.0 * self._noise)
        text = (
            f"{_g(scatter)} while the arm moves, {_g(self._noise)} at rest, {100 * float(seen.stable.mean()):.0f} % "
            f"stable; right: {_g(limit)} or less"
        )
        return DeviceCheck(
            "vibration",
            *_state(scatter <= limit, text, "separate its table from the arm's, or put it on a stone plate"),
        )

    def _observe(self, seconds: float) -> _Series:
        """Read the display for a time [s of bench time].

        Raises:
            LaboratoryError: it sends no weights.
        """
        seen: list[Weight] = []
        begin = time.monotonic()
        end, latest = (begin + length / self._scale for length in (seconds, seconds + FEWEST * LONGEST_INTERVAL))
        while (now := time.monotonic()) < end or (len(seen) < FEWEST and now < latest):
            weight = self._driver.read()
            if np.isfinite(weight.mass) and weight.time > self._read_at:
                self._read_at = weight.time
                seen.append(weight)
            time.sleep(0.005)
        if len(seen) < FEWEST:
            raise LaboratoryError(
                f"only {len(seen)} weights came in {seconds:g} s (last: {self._driver.read().status})"
            )
        times = np.array([weight.time for weight in seen]) * self._scale
        return _Series(times, np.array([weight.mass for weight in seen]), np.array([weight.stable for weight in seen]))


def check_balance(
    driver: BalanceDriver,
    operator: CheckOperator,
    *,
    repeatability: float = 0.0,
    step: float | None = None,
    time_scale: float = 1.0,
) -> Iterator[DeviceCheck]:
    """Check a balance. Takes about a minute, without the operator's time.

    Args:
        driver: of the balance; connected here, not closed.
        operator: puts loads on and takes them off.
        repeatability: standard deviation of repeated weighings of the same load, from the data sheet [kg].
        step: of the display, if it is not one unit of the last digit [kg].
        time_scale: bench seconds per second of the clock.

    Returns:
        The findings, each with its right value, as soon as it is known. After an error of the balance they end with it.
    """
    try:
        yield from _Check(driver, operator, repeatability, time_scale, step).run()
    except LaboratoryError as error:
        yield DeviceCheck("balance", "fail", str(error), f"{DOCS} lists causes and remedies")


@dataclass
class EmulatedHands:
    """`CheckOperator` of a virtual balance.

    Attributes:
        put_load: sets the load on the balance from now on.
        receiver: mass of the empty receiver [kg].
        references: masses of the reference weights [kg].
    """

    put_load: Callable[[Load], None]
    receiver: float = 0.15
    references: tuple[float, ...] = (0.05, 0.2, 0.5)

    def __post_init__(self) -> None:
        self._left = iter(self.references)

    def empty(self) -> None:
        """See `CheckOperator.empty`."""
        self.put_load(Load((0.0,), (0.0,)))

    def announce(self) -> None:
        """See `CheckOperator.announce`."""

    def put(self) -> None:
        """See `CheckOperator.put`."""
        self.put_load(Load((0.0,), (self.receiver,)))

    def rise(self, mass: float, seconds: float) -> bool:
        """See `CheckOperator.rise`."""
        self.put_load(Load((0.0, seconds), (self.receiver, self.receiver + mass)))
        return True

    def reference(self) -> float | None:
        """See `CheckOperator.reference`."""
        mass = next(self._left, None)
        if mass is not None:
            self.put_load(Load((0.0,), (mass,)))
        return mass

    def move(self) -> bool:
        """See `CheckOperator.move`."""
        return True


def _state(good: bool, text: str, advice: str, bad: State = "warn") -> tuple[State, str, str]:
    return ("ok", text, "") if good else (bad, text, advice)


def _g(mass: float) -> str:
    return f"{round(1e3 * mass, 4):.5g} g"
