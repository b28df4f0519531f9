"""Decides the tilt of one dose from the readings of the balance. It has no I/O, no clock and no thread.

`DoseController.step` receives the time, the measured tilt and the readings that arrived, and returns the speed of the
tilt. The phases are:

1. CHECK: the receiver is on the balance, and the balance rests.
2. APPROACH: fast to the earliest plausible onset, then slowly until two readings have risen.
3. POUR: every particle of `actors.dosing.dose_estimator` gives the tilt for the wanted flow; the median is followed.
   The wanted flow falls with the remaining amount.
4. RETURN: ordered when the median of the predicted final amount reaches the target, or when more than target + limit
   is likelier than 1 %.
5. SETTLE: weigh. If more is missing than the smallest dependable amount, continue with 2. A weight beyond the tolerance
   is never `REACHED`.

In doubt the cup is turned back: a tilted cup pours on while it stands still. `DoseResult` has the end of the dose and
the amount in the receiver, if it is known.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from actors.arm.arm_interface import NEWS_TIMEOUT
from actors.balance.display_quality import FLOW_ERROR, dose_tolerance
from actors.dosing.cup_flow import LARGEST_TILT, CupFlow, Floats, median, quantile
from actors.dosing.display_belief import REPEATS, DisplayBelief
from actors.dosing.dose_estimator import DoseBelief, DoseEstimator, DoseReading
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseEnd, DoseProgress, DoseTarget, InvalidActionError


@dataclass(frozen=True)
class DoseOrder(DoseTarget):
    """One wanted dose onto a balance.

    Attributes:
        receiver_mass: expected reading of the balance before the dose; None if it is not known [kg].
    """

    receiver_mass: float | None = None


@dataclass(frozen=True)
class DoseResult:
    """The end of a dose.

    Attributes:
        end: why it ended.
        amount: weighed in the receiver [kg]; None if it is unknown.
        deviation: standard deviation of `amount` [kg].
        estimate: estimated amount past the lip, mean and standard deviation [kg].
        top_ups: number of times that the cup was tilted again.
        belief: for the next dose.
        innovations: mean squared innovation, see `DoseEstimator`.
    """

    end: DoseEnd
    amount: float | None
    deviation: float
    estimate: tuple[float, float]
    top_ups: int
    belief: DoseBelief
    innovations: float


FINE_WEBER = 0.8
"""Weber number of the film at the lip in the fine flow at the end. Below `DRIBBLING_WEBER` a part may dribble, but only
for a second or two; a faster flow would add more to the error than it saves in spilled liquid."""


def fine_flow(
    cup: CupFlow, tilt: float, settings: DosingSettings, limit: float = math.inf, interval: float = 0.0
) -> float:
    """Flow at the end of a dose: slow, but fast enough to leave the lip [kg/s].

    Args:
        cup: the source vessel.
        tilt: at which it pours [rad].
        settings: lower and upper bound.
        limit: tolerance of the dose [kg]; a slow balance needs a slower flow.
        interval: between two readings [s].
    """
    # min(ρ q at We = FINE_WEBER, flow at which `unseen` equals the tolerance), within the settings
    clean = cup.clean_flow(tilt, FINE_WEBER) * cup.density
    seen = limit / unseen(1.0, interval) if interval > 0.0 else math.inf
    return min(max(min(clean, seen), settings.smallest_flow), settings.largest_fine_flow)


def unseen(flow: float, interval: float) -> float:
    """Amount [kg] within which a flow [kg/s] is known between two readings with an interval [s], with 95 %."""
    return 2.0 * FLOW_ERROR * flow * interval / math.sqrt(3.0)


def check_display(display: DisplayBelief, limit: float, settings: DosingSettings) -> None:
    """Check that the readings of a balance follow each other fast enough for a dose.

    Args:
        display: of the balance.
        limit: tolerance of the dose [kg].
        settings: of the dose.

    Raises:
        InvalidActionError: between two readings more flows unseen, with the tolerance that the balance supports.
    """
    interval, slowest = display.new_reading_interval, settings.smallest_flow
    if unseen(slowest, interval) > limit:
        supported = math.ceil(1e4 * dose_tolerance(slowest, 0.0, (interval,), display.step, 0.0)) / 10.0
        raise InvalidActionError(
            f"the balance is too slow for a tolerance of {1e3 * limit:.3g} g: a new reading each {interval:.2g} s; "
            f"doses with it are within {supported:g} g in 95 % of the cases; set a faster output, or ask for a "
            f"tolerance of {supported:g} g"
        )


class DosePhase(StrEnum):
    """Phase of a dose."""

    CHECK = "check"
    APPROACH = "approach"
    POUR = "pour"
    RETURN = "return"
    SETTLE = "settle"
    DONE = "done"


RETURN_RAMP = 0.6
"""Duration in which the return reaches its speed, in periods of the liquid's first wave. An abrupt return raises a wave
at the lip while liquid still flows; a ramp of a whole period leaves none, but cuts the stream later."""

PARK = math.radians(18.0)
"""Tilt by which the cup is turned back from the end of the flow while the balance settles [rad]."""

SEEN = 0.25e-3
"""Smallest rise of the reading that counts as the stream [kg]."""

LONG_PAUSE, FLOWED = 0.3, 0.05e-3
"""Time without a decision after which the cup is turned back and weighed [s], if that much may have flowed [kg]."""

LATE_COMMAND = (1.3, 0.02)
"""Shortest such time that a command may set: intervals between commands, and [s]."""

AHEAD = 3.0
"""Intervals between commands by which the largest tilt of a command lies ahead."""

LATE_READING = (1.6, 1.2, 2.5)
"""Time without a reading after which the largest tilt does not rise, in the manner of `SILENCE`."""

TOGETHER = 0.4
"""Readings that arrive within this part of their usual interval were held up, all but the last one."""

UNREPORTED = 0.3
"""Time after which the cup is turned back if the arm, which should move, reports one and the same tilt [s]."""

SURELY = 3.0
"""Standard deviations within which a dose that gets no further command stays within its tolerance."""

ABRUPT = 0.06
"""Standard deviation of what an arm that turns back by itself adds, as a time of the flow [s]: it accelerates at once,
and raises a wave at the lip."""

LATEST_ONSET = math.radians(1.5)
"""Tilt by which outflow can begin later than expected, even after many doses: the lip may have dried [rad]."""

SEEN_AFTER = 0.5
"""Time until a stream is seen on a balance that repeats no reading [s]."""

LONGEST_DOUBT = (1.2, 2.5)
"""Time with implausible readings after which the cup is turned back: [s], and at least so many readings."""

OTHER_NUMBER, FAR_OFF = 8.0, 0.02
"""A reading that is so many times the expected mass, or its inverse, and so far from it [kg], is a damaged number: a
lost decimal point or digit changes it by a factor of ten."""

EARLIEST_WEIGHING = 2.0
"""Time after which a reading at rest may be completed with the rise that the balance still lags behind [lags]."""

LARGEST_REMAINDER = (1e-3, 0.1e-3)
"""Largest such rise, and its largest standard deviation [kg]."""

RECORDED_HOLD = 1.1
"""Longest time with one and the same reading in recorded pours [s]."""

LONGEST_HOLD = (1.6, 5.0)
"""Time with one and the same reading, while the flow should change it, after which the cup is turned back and weighed:
[s], and at least so many readings."""

IMPROBABLE_HOLD = math.log(0.005)
"""Logarithm of the probability of such a row of equal readings after which this happens earlier."""

STALE = 0.01
"""Largest probability that a reading which counts as weighed is an old one."""

MOST_EQUAL, LONGEST_EQUAL = 12, 3.0
"""Equal readings that count as weighed, however often the display repeats one; the same for so long a time [s]."""

SILENCE = (2.5, 1.3, 4.5)
"""Time without a reading after which the cup is turned back: at least the first and at most the last factor times the
usual interval; in between, the second factor times the longest one so far."""

DECREASE = 1e-3
"""Largest decrease of the reading over such a time; after a larger one the balance was set to zero [kg]."""

RISES, UNEXPECTED = 3, 4.0
"""Readings in a row that rise, and standard deviations between the last one and its prediction, from which the stream
has begun before any particle expected it."""

MOST_PAUSES = 6
"""Largest number of such interruptions of one dose."""

DRIBBLES = 0.3e-3
"""Mass that arrives late in addition, where the last stream is too slow to leave the lip cleanly [kg]: about half of
what runs down the outside. Later doses know it from the ones before."""

RUN_OFF = 2.8
"""Time after the return until liquid has run off the lip, and until filters that get slower at rest have come to their
end [s]; the display's lag comes on top."""

AT_REST = 0.8
"""Time for which a reading has to stay the same until it counts as weighed [s]. The filters of some balances get slower
as soon as the load hardly moves."""

LATE_TIME = 0.9
"""Time in which late liquid arrives, and in which filters that get slower at rest come to their end [s]."""

REST_BAND = (0.1e-3, 0.3)
"""Standard deviation of what a reading still rises: [kg], and display steps."""

LARGEST_RISE = (0.03e-3, 0.2)
"""Largest such rise of a weighed reading: [kg], or display steps."""

UNKNOWN_RISE = 1.75
"""Standard deviation of what a reading still rises because the time of the rise is unknown, as a part of the rise."""

LATE_DROPS = (0.05e-3, 1.0, 3.0)
"""Drops that fall from the lip after the return: mass of one [kg], mean number, and the time in which they fall [s]."""

TRACKED = (4.0, 0.25, 0.144)
"""A display that shows zero may be corrected to zero while the load rises slowly: within so many steps, mean and
standard deviation of the rate [steps per second]. OIML R 76-1, 4.5.7 allows 0.5; all rates below are equally likely."""

TARED = 0.25
"""Largest error of a zero that was set, in display steps (OIML R 76-1, 4.5.2)."""

LONGEST_SETTLING = (10.0, 15.0)
"""Time without rest of the balance after which the amount is unknown: [s], and at least so many readings."""

LONGEST_CHECK = (4.0, 8.0)
"""The same before the dose."""


@dataclass(frozen=True)
class TiltCommand:
    """A controller's decision.

    Attributes:
        speed: of the tilt, positive towards the receiver [rad/s].
        highest: tilt at which the arm stops by itself until the next command; a tilt above it does not grow [rad].
        patience: time without a further command after which the arm turns back by itself [s].
        finished: the dose is over; the arm returns upright.
    """

    speed: float
    highest: float = math.inf
    patience: float = NEWS_TIMEOUT
    finished: bool = False


def _late_drops(waited: float) -> float:
    """Mean mass of the drops that fall later than a time after the return [s] [kg]."""
    drop, count, time = LATE_DROPS
    return drop * count * math.exp(-waited / time)


# More than 25 methods: one method for each phase of a dose and each reason to stop.
class DoseController:
    """The controller of one dose.

    Args:
        cup: flow of the source vessel.
        order: the dose.
        belief: from the doses before it.
        settings: limits.
        fall_time: of the stream from the lip into the receiver [s].
        step: of the balance's display [kg].
        noise: standard deviation of a reading besides the display's step [kg].
        seed: of all randomness; the same inputs and seed give the same decisions.

    Attributes:
        phase: now.
        result: None until the dose is over.
    """

    def __init__(
        self,
        cup: CupFlow,
        order: DoseOrder,
        belief: DoseBelief,
        settings: DosingSettings,
        *,
        fall_time: float = 0.17,
        step: float = 1e-4,
        noise: float = 3e-5,
        seed: int = 0,
    ) -> None:
        self._cup, self._order, self._settings = cup, order, settings
        self._estimator = DoseEstimator(
            cup, belief, fall_time=fall_time, step=step, noise=noise, rng=np.random.default_rng((seed, 5))
        )
        self._belief = belief
        self._step_size, self._noise = step, noise
        self.phase = DosePhase.CHECK
        self.result: DoseResult | None = None
        self._begin: float | None = None
        self._zero: float | None = None
        self._recent: list[DoseReading] = []
        self._implausible: float | None = None  # net mass of the last reading, if it was implausible [kg]
        self._now, self._tilt, self._command = 0.0, 0.0, TiltCommand(0.0, 0.0)
        self._rising = 0
        self._innovations: list[float] = []
        self._tick = 0.05
        self._doubt_since: float | None = None
        self._since = 0.0
        self._stop_tilt = 0.0
        self._ramp_begin, self._ramp_speed, self._ramp = 0.0, 0.0, settings.acceleration
        self._expected: float | None = None
        self._end: DoseEnd | None = None
        self._top_ups = self._pauses = 0
        self._suspected: DoseEnd | None = None
        self._paused = self._doubted = False
        self._remainder = step / math.sqrt(12.0)
        self._interval, self._longest_gap = belief.display.interval, belief.display.longest
        self._before_silence: float | None = None
        self._unchanged_since, self._onset = 0.0, 0.0
        self._reported = self._reported_at = -math.inf
        self._tared, self._tracked, self._late_drops = False, 0.0, _late_drops(RUN_OFF)
        self._factor_before = median(belief.flow_factor)
        self._idle_since: float | None = None
        self._late_volume = float(belief.volume.mean() - 2.0 * belief.volume.std())
        self._late_onset = float(belief.onset_bias.mean() + max(2.0 * belief.onset_bias.std(), LATEST_ONSET))
        self._late_factor = 0.7 * self._factor_before
        self._late_mass, self._late_flow = 0.0, 0.0
        self.fine_flow = settings.smallest_flow

    # ---- for displays

    @property
    def amount(self) -> tuple[float, float]:
        """Estimated amount past the lip, mean and standard deviation [kg]."""
        return float(self._estimator.mass.mean()), float(self._estimator.mass.std())

    @property
    def flow(self) -> float:
        """Estimated flow [kg/s]."""
        return self._cup.density * median(self._estimator.flow)

    def progress(self, reading: float | None) -> DoseProgress:
        """What is shown of the dose now.

        Args:
            reading: last one of the balance, without the receiver [kg]; None before the first one.
        """
        return DoseProgress(str(self.phase), self._order.amount, *self.amount, self.flow, reading)

    # ---- decisions

    def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand:
        """Decide the speed of the tilt until the next call.

        Args:
            time: now, on the clock of the readings [s].
            tilt: measured now [rad].
            readings: that arrived since the last call, in order of time.
        """
        if self._begin is None:
            self._begin = self._now = time
            self._estimator.start(time, tilt)
        tilt = self._followed(time, tilt)
        readings = self._in_time(readings)
        pours = self.phase in (DosePhase.APPROACH, DosePhase.POUR)
        turned = pours and time - self._now > self._command.patience + self._settings.latency
        paused = turned and time - self._now > LONG_PAUSE
        if turned:
            self._pass_over(time, tilt)
            self._recent = [*self._recent, *readings][-40:]
        else:
            for reading in readings:
                self._take(reading, tilt, time)
        if self.phase is DosePhase.CHECK:
            self._estimator.start(time, tilt)
        else:
            self._estimator.advance(time, tilt)
        self._note_late_stream(time - self._now, tilt)
        self._note_tracking(time - self._now)
        self._tick += 0.2 * (min(time - self._now, 0.2) - self._tick)
        self._now, self._tilt = time, tilt
        if paused and tilt > 0.0 and self.amount[0] > FLOWED:
            self._turn_back()  # the arm has turned back by itself
            self._paused, self._doubted = True, False
        self._watch()
        decide = {
            DosePhase.CHECK: self._check,
            DosePhase.APPROACH: self._approach,
            DosePhase.POUR: self._pour,
            DosePhase.RETURN: self._return,
            DosePhase.SETTLE: self._settle,
        }.get(self.phase)
        self._command = self._bounded(0.0 if decide is None else decide())
        return self._command

    def _bounded(self, speed: float) -> TiltCommand:
        """The command of a speed [rad/s], with what the arm may do if no further one follows."""
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR, DosePhase.RETURN):
            return TiltCommand(speed, 0.0, finished=self.phase is DosePhase.DONE)
        ahead = self._ahead
        highest = ahead + max(speed, 0.0) * AHEAD * self._tick
        if self.phase is DosePhase.APPROACH and ahead < self._onset:
            highest = self._onset
        if self.phase is DosePhase.RETURN or self._overdue() > 0.0:
            highest = min(highest, self._command.highest)
        return TiltCommand(speed, highest, self._patience_of(speed, highest))

    def _followed(self, time: float, reported: float) -> float:
        """The tilt now [rad]; if the report is an old one, as the last command moves the arm."""
        speed, before = self._command.speed, self._reported
        if reported != before or speed == 0.0:
            self._reported, self._reported_at = reported, time
            return reported
        if reported <= 0.0 or self.phase not in (DosePhase.APPROACH, DosePhase.POUR, DosePhase.RETURN):
            return reported
        moved = self._tilt + speed * min(time - self._now, self._command.patience)
        return max(min(moved, max(self._command.highest, self._tilt)), 0.0)

    def _in_time(self, readings: Sequence[DoseReading]) -> list[DoseReading]:
        """The readings without those that were held up and arrived together with a later one."""
        least = TOGETHER * self._interval
        return [
            reading
            for reading, after in itertools.zip_longest(readings, readings[1:])
            if after is None or after.time - reading.time >= least
        ]

    @property
    def _ahead(self) -> float:
        """Tilt when the arm begins to follow the next command [rad]."""
        speed, highest = self._command.speed, self._command.highest
        ahead = self._tilt + speed * self._settings.latency
        return max(min(ahead, highest), self._tilt) if speed > 0.0 else ahead

    def _patience_of(self, speed: float, highest: float) -> float:
        """The longest time without a command after which the dose still stays within its tolerance [s]."""
        e, s = self._estimator, self._settings
        factor, more = LATE_COMMAND
        least = min(factor * self._tick + more, NEWS_TIMEOUT)
        if self._order.amount - float(e.mass.max()) > 2.5 * self._cup.density * float(e.flow.max()) + 3e-3:
            return NEWS_TIMEOUT
        for patience in np.linspace(NEWS_TIMEOUT, least, 4)[:-1]:
            final = e.final_mass(
                self._tilt,
                speed,
                latency=s.latency + float(patience),
                back=s.return_speed,
                acceleration=s.acceleration,
                highest=highest,
            )
            surely = median(final) + self._aim() + SURELY * math.hypot(self._spread(final), ABRUPT * self.flow)
            if surely < self._order.amount + self._order.limit:
                return float(patience)
        return least

    def _spread(self, final: Floats) -> float:
        """Standard deviation of final amounts [kg], with what flowed unseen since a reading was due."""
        unseen = FLOW_ERROR * self.flow * self._overdue()
        return math.hypot(float(final.std()), 0.1e-3, unseen)

    def _overdue(self) -> float:
        """Time by which the last reading is older than is usual [s]; 0 if it is not."""
        age = self._now - self._recent[-1].time if self._recent else 0.0
        return max(age - self._usual(*LATE_READING) - self._tick, 0.0)

    def _check(self) -> float:
        """Wait for a balance at rest, and take its reading as the zero."""
        assert self._begin is not None
        last = self._recent[-4:]
        if len(last) == 4:
            spread = max(r.mass for r in last) - min(r.mass for r in last)
            if spread <= max(3.0 * self._step_size, 1e-4):
                self._zero = math.fsum(r.mass for r in last) / 4.0
                self._tared = abs(self._zero) <= self._step_size
                expected = self._order.receiver_mass
                if expected is not None and abs(self._zero - expected) > max(2e-3, 0.03 * expected):
                    self._finish(DoseEnd.RECEIVER_MISSING, known=True)
                else:
                    self._enter(DosePhase.APPROACH)
                return 0.0
        if self._now - self._begin > self._patience(LONGEST_CHECK):
            self._finish(DoseEnd.CONNECTION_LOST if self._silent() else DoseEnd.UNSTABLE, known=True)
        return 0.0

    def _approach(self) -> float:
        e = self._estimator
        early = quantile(self._cup.tilt_for(e.volume, np.zeros_like(e.volume)) + e.onset_bias, 0.03)
        self._onset = early
        ahead = self._ahead
        if self._rising >= 2:
            self._enter(DosePhase.POUR)
            return self._pour()
        self.fine_flow = fine_flow(self._cup, max(early, 0.1), self._settings, self._order.limit, self._interval)
        if self._must_stop():
            return self._return()
        if ahead < early:
            return self._towards(early + 0.01, self._settings.approach_speed, ahead)
        # Growth dm/dθ = ρ (−dV/dθ) [kg/rad] of the flow's rate with the speed of the tilt
        aim = quantile(self._tilts_for(self.fine_flow), 0.35)
        growth = self._cup.volume_per_tilt(median(e.volume), 2e-3) * self._cup.density
        # the flow at the moment when the stream is seen is about growth × speed × delay / lag of the cup; until the
        # return has an effect, which takes as long again, a third of what is missing flows
        delay, left = SEEN_AFTER + self._blind() + median(e.lag), self._order.amount - median(e.mass)
        flow = min(2.0 * self.fine_flow * SEEN_AFTER / (SEEN_AFTER + self._blind()), left / (1.5 * delay))
        calm = flow / growth
        search = min(self._settings.search_speed, max(calm, math.radians(0.8)))
        return min(max(3.0 * (aim - ahead), -0.2), search)

    def _pour(self) -> float:
        if self._must_stop():
            return self._return()
        e = self._estimator
        wanted = self._wanted_flow()
        aim = median(self._tilts_for(wanted))
        volume, head = (
            median(e.volume),
            float(self._cup.head_for(np.array([wanted / self._cup.density]), aim)[0]),
        )
        # Feedforward θ' = q / (−dV/dθ), which keeps the head, plus feedback 4/s · (aim − θ), θ predicted by the latency
        feed = wanted / self._cup.density / self._cup.volume_per_tilt(volume, head)
        ahead = self._ahead
        speed = feed + 4.0 * (aim - ahead)
        highest = 0.0 if self._doubt_since is not None else math.radians(15.0)
        if ahead >= LARGEST_TILT - math.radians(5.0):
            highest = 0.0
        return min(max(speed, -math.radians(30.0)), highest)

    def _return(self) -> float:
        if self._tilt <= max(self._stop_tilt - PARK, 0.0) + 0.01:
            self._enter(DosePhase.SETTLE)
            return 0.0
        speed = self._towards(max(self._stop_tilt - PARK, 0.0), self._settings.return_speed, self._tilt)
        # the mean of the ramp until the next call
        first, last = (max(self._now + wait - self._ramp_begin, 0.0) for wait in (0.0, self._tick))
        return max(speed, self._ramp_speed - self._ramp * (last**2 - first**2) / (2.0 * self._tick))

    def _return_acceleration(self) -> float:
        """Acceleration of a return that raises little of a wave [rad/s²]."""
        # Ramp to the return speed v over RETURN_RAMP wave periods: a = v / (RETURN_RAMP · T)
        s, period = self._settings, self._cup.wave_period(median(self._estimator.volume))
        return min(s.acceleration, s.return_speed / (RETURN_RAMP * period))

    def _settle(self) -> float:
        waited = self._now - self._since
        lag = median(self._estimator.lag)
        longest = math.ceil(LONGEST_EQUAL / self._interval) + 1
        old = min(self._estimator.repeats.in_a_row(STALE) + 1, MOST_EQUAL, longest)
        needed = max(old, math.ceil(AT_REST / self._interval) + 1, 4)
        last = [r for r in self._recent if r.time > self._since][-needed:]
        if len(last) == needed and waited > RUN_OFF + EARLIEST_WEIGHING * lag:
            begin = self._since + 0.4 * RUN_OFF + EARLIEST_WEIGHING * lag
            final, deviation, rise = self._approached([r for r in self._recent if r.time > begin] or last, lag)
            half = needed // 2
            early, late = (math.fsum(r.mass for r in readings) / half for readings in (last[:half], last[-half:]))
            spread = max(r.mass for r in last) - min(r.mass for r in last)
            flat = spread <= max(2.0 * self._step_size, 1.5e-4) and abs(late - early) <= max(
                0.6 * self._step_size, 5e-5
            )
            rests = abs(rise) <= max(LARGEST_RISE[0], LARGEST_RISE[1] * self._step_size)
            early_enough = flat and self._behind(last[-1].time)
            late_enough = waited > 3.0 * lag and (flat or all(r.stable for r in last))
            if rests and (early_enough or late_enough):
                self._remainder = deviation
                self._late_drops = _late_drops(waited)
                self._weighed(final + self._late_drops)
                return 0.0
        if waited > self._patience(LONGEST_SETTLING):
            self._finish(self._end or (DoseEnd.CONNECTION_LOST if self._silent() else DoseEnd.UNSTABLE), known=False)
        return 0.0

    def _approached(self, readings: Sequence[DoseReading], lag: float) -> tuple[float, float, float]:
        """The reading that these ones approach, its standard deviation, and how far it is from the last one [kg]."""
        times, masses = (np.array(values) for values in zip(*((r.time, r.mass) for r in readings), strict=True))
        # a filter's lag, and a filter that gets slower at rest or liquid that runs off late, one after the other
        shape = np.exp((times[-1] - times) / math.hypot(LATE_TIME, lag))
        # Regression m(t) = final − rise e^{(t_last − t)/τ}, with a normal prior of `rise` of the deviation REST_BAND:
        # rise = −Σ (e − ē) m / (Σ (e − ē)² + σ²/σ_rise²), final = m̄ + ē rise
        shape_mean, centred = float(shape.mean()), shape - shape.mean()
        step, rounded = self._step_size, self._step_size**2 / 12.0
        variance = (rounded + self._noise**2) / self._new
        stiffness = float(centred @ centred) + variance / (REST_BAND[0] ** 2 + (REST_BAND[1] * step) ** 2)
        rise = -float(centred @ masses) / stiffness
        alike = self._alike
        scatter = variance * (1.0 / len(readings) + shape_mean**2 / stiffness)
        # a rise beyond its own scatter ends later or earlier than e^{-t/τ} does
        scatter += UNKNOWN_RISE**2 * max(rise**2 - variance / stiffness, 0.0)
        deviation = math.sqrt(alike * rounded + (1.0 - alike) * scatter)
        approached = float(masses.mean()) + shape_mean * rise
        return alike * float(masses[len(masses) // 2 :].mean()) + (1.0 - alike) * approached, deviation, rise

    def _behind(self, time: float) -> bool:
        """Whether the particles agree about the mass that a reading at this time still lags behind."""
        e = self._estimator
        expected = max(3.0 * e.deviation(), 1.5e-4)
        if self._doubt_since is not None or any(abs(innovation) >= expected for innovation in self._innovations):
            return False
        rise = e.mass - e.predicted(time)
        largest, deviation = LARGEST_REMAINDER
        return abs(median(rise)) < largest and float(rise.std()) < deviation

    def _weighed(self, mass: float) -> None:
        assert self._zero is not None
        amount = mass - self._zero
        if self._before_silence is not None and amount < self._before_silence - max(2.0 * self._step_size, DECREASE):
            self._finish(DoseEnd.CONNECTION_LOST, known=False)
            return
        self._before_silence = None
        # within one step of the display, the particles know more than it shows
        likely = min(max(float(self._estimator.mass.mean()), amount - self._step_size), amount + self._step_size)
        if self._suspected is not None and self._late_mass - amount > max(2.5e-3, 0.3 * self._late_mass):
            self._end = self._end or self._suspected
        smallest = max(self._settings.smallest_top_up, 1.5 * self._step_size)
        if self._end is None and self._order.amount - likely > smallest:
            paused = self._pauses if self._paused else self._top_ups
            if paused < (MOST_PAUSES if self._paused else self._settings.most_top_ups):
                self._pauses += self._paused
                self._top_ups += not self._paused
                if self._doubted:
                    self._estimator.loosen()
                self._estimator.update(DoseReading(self._now, amount), sigma=max(0.05e-3, self.deviation))
                self._rising, self._doubt_since, self._suspected, self._paused = 0, None, None, False
                self._doubted = False
                self._unchanged_since, self._estimator.repeats.run = self._now, 0.0
                self._late_mass = amount
                self._enter(DosePhase.APPROACH)
                return
            self._end = DoseEnd.SHORT
        end = DoseEnd.REACHED if self._order.is_met_by(amount) else DoseEnd.MISSED
        self._finish(self._end or end, known=True, amount=amount)

    @property
    def deviation(self) -> float:
        """Standard deviation of a weighed amount: zero, last readings, late drops and tracking of the zero [kg]."""
        # zero: a mean of four readings, n of them new: σ² = a d²/12 + ((1 − a) d²/12 + σ_0²) / n, a rounded alike, or
        # (d/4)²/3 after a tare; drops: their number has a Poisson distribution, σ² = drop · mean mass
        rounded, alike = self._step_size**2 / 12.0, self._alike
        zero = rounded * (4.0 * TARED**2 if self._tared else alike)
        zero += ((1.0 - alike) * rounded + self._noise**2) / (1.0 + 3.0 * self._new)
        return math.sqrt(zero + self._remainder**2 + LATE_DROPS[0] * self._late_drops + self._tracked**2)

    @property
    def _alike(self) -> float:
        """Share of the rounding error's variance that all readings at rest have in common."""
        # exp(−4π² σ²/d²) for a noise σ and steps d: first harmonic of the mean rounding error (Widrow 1961, dither)
        return math.exp(-((2.0 * math.pi * self._noise / self._step_size) ** 2))

    @property
    def _new(self) -> float:
        """Share of new readings at rest."""
        repeated = float(self._estimator.repeats.weights(1) @ REPEATS)
        return max(1.0 - repeated, self._interval / (self._interval + RECORDED_HOLD))

    def _patience(self, limit: tuple[float, float]) -> float:
        """The larger one of a time and of a number of readings [s]."""
        return max(limit[0], limit[1] * self._interval)

    def _silent(self) -> bool:
        """Whether no reading has come for longer than is usual."""
        if not self._recent:
            return True
        longest = max(self._usual(*SILENCE), self._settings.reading_timeout)
        return self._now - self._recent[-1].time > longest

    def _usual(self, least: float, longer: float, most: float) -> float:
        """A time between two readings from the usual and from the longest one, see `SILENCE` [s]."""
        gaps = [after.time - before.time for before, after in itertools.pairwise(self._recent[-6:])]
        usual = max(self._interval, statistics.median(gaps)) if gaps else self._interval
        return min(max(least * usual, longer * self._longest_gap), most * usual)

    def _blind(self) -> float:
        """Time for which the display may repeat one reading, which hardly one in ten repeats exceeds [s]."""
        return self._interval * self._estimator.repeats.in_a_row(0.1)

    def _finish(self, end: DoseEnd, *, known: bool, amount: float = 0.0) -> None:
        self.phase = DosePhase.DONE
        aim = self._aim()
        if self._expected is not None and known and end in (DoseEnd.REACHED, DoseEnd.MISSED):
            # aim += max(1/4, 1/(n + 2)) (late − aim): mean of the doses so far, later an exponential average
            late = min(max(amount - self._expected, -1e-3), 1e-3)
            aim += max(0.25, 1.0 / (self._belief.doses + 2)) * (late - aim)
        weighed = amount if known else None
        self.result = DoseResult(
            end,
            weighed,
            self.deviation,
            self.amount,
            self._top_ups,
            self._estimator.belief(weighed=weighed, aim=aim),
            self._estimator.innovations,
        )

    # ---- flow

    def _wanted_flow(self) -> float:
        """Wanted flow [kg/s]: it falls to the fine flow with the remaining amount."""
        e, order, s = self._estimator, self._order, self._settings
        # flow = fine + max(left − 0.7 s · fine, 0) / horizon: it decays over 0.9 s, the lag and the display's repeats
        after = 0.1 * self.flow
        left = order.amount - median(e.mass) - after
        horizon = 0.9 + 1.0 * median(e.lag) + self._blind()
        bulk = min(max(order.amount / 3.0, self.fine_flow), s.largest_flow)
        return min(self.fine_flow + max(left - 0.7 * self.fine_flow, 0.0) / horizon, bulk)

    def _tilts_for(self, flow: float) -> Floats:
        e = self._estimator
        # θ_i = tilt(V_i, head(q / c_i)) + b_i: the tilt at which particle i has the flow
        head = self._cup.head_for(flow / self._cup.density / e.flow_factor, self._tilt)
        return self._cup.tilt_for(e.volume, head) + e.onset_bias

    def _must_stop(self) -> bool:
        e, order, s = self._estimator, self._order, self._settings
        if order.amount - float(e.mass.max()) > 1.5 * self._cup.density * float(e.flow.max()) + 1e-3:
            return False
        final = e.final_mass(
            self._tilt,
            self._command.speed,
            latency=s.latency,
            back=s.return_speed,
            acceleration=self._return_acceleration(),
        )
        # Return if median ≥ target, or P(final > target + limit) > 1 %: median + 2.33 σ ≥ target + limit
        middle, deviation = median(final) + self._aim(), self._spread(final)
        left, wait = order.amount - middle, 0.0
        if middle + 2.33 * deviation < order.amount + order.limit:
            wait = max(left, 0.0) / max(self.flow, 1e-6)
            if wait >= self._tick:
                return False
        self._expected = median(final) + self.flow * wait
        self._turn_back(wait=wait, gently=True)
        return True

    def _aim(self) -> float:
        """Mass to subtract from the target [kg]."""
        clean = self._cup.density * self._cup.clean_flow(max(self._tilt, 0.1))
        late = DRIBBLES if self._belief.doses == 0 and self.fine_flow < clean else 0.0
        return self._belief.aim + late

    def _towards(self, tilt: float, speed: float, ahead: float) -> float:
        """Speed of a turn that ends at a tilt, with a deceleration of a third of the allowed one."""
        # v = √(2 a/3 · |left|): a constant deceleration a/3 ends at the tilt
        left = tilt - ahead
        return math.copysign(min(speed, math.sqrt(2.0 * self._settings.acceleration / 3.0 * abs(left))), left)

    # ---- readings and doubts

    def _take(self, reading: DoseReading, tilt: float, now: float) -> None:
        self._recent.append(reading)
        del self._recent[:-40]
        if len(self._recent) > 1:
            gap = reading.time - self._recent[-2].time
            self._interval += 0.1 * (min(gap, max(1.0, 3.0 * self._interval)) - self._interval)
            self._longest_gap = max(self._longest_gap, gap)
        if self._zero is None or self.phase is DosePhase.DONE:
            return
        share = 1.0 if now <= self._now else min(max((reading.time - self._now) / (now - self._now), 0.0), 1.0)
        e = self._estimator
        e.advance(reading.time, self._tilt + share * (tilt - self._tilt))
        net = DoseReading(reading.time, reading.mass - self._zero, reading.stable)
        seen = e.seen(net)
        if seen.new < 0.5:
            e.update(net, seen=seen)
            return
        self._unchanged_since = reading.time
        predicted = e.predicted(reading.time)
        deviation = math.hypot(float(predicted.std()), e.deviation())
        gate = max(5.0 * deviation, 1.5e-3 + 0.1 * self.flow)
        expected = float(predicted.mean())
        if net.mass - expected > UNEXPECTED * deviation and tilt >= self._tilt and self._begins_to_rise():
            e.flows_unexpectedly(net, self._rate(RISES))
            expected = net.mass
        if abs(net.mass - expected) > gate:
            self._doubt_since = self._doubt_since if self._doubt_since is not None else reading.time
            most, least = OTHER_NUMBER * expected + FAR_OFF, expected / OTHER_NUMBER - FAR_OFF
            confirmed = self._implausible is not None and abs(net.mass - self._implausible) <= gate
            self._implausible = net.mass
            if self.phase is DosePhase.SETTLE and not confirmed:  # by the one before: a single one is not weighed
                del self._recent[-1]
                return
            if self.phase is not DosePhase.SETTLE or not least < net.mass < most:
                return
        else:
            self._doubt_since = self._implausible = None
        before = self._recent[-2].mass - self._zero if len(self._recent) > 1 else 0.0
        rises = net.mass > before + 0.5 * self._step_size and net.mass > self._threshold
        self._rising = self._rising + 1 if rises else 0
        self._innovations = [*self._innovations[-2:], e.update(net, seen=seen)]

    @property
    def _threshold(self) -> float:
        """Net reading above which liquid has arrived [kg]."""
        return (self._late_mass if self._top_ups else 0.0) + max(SEEN, 2.5 * self._step_size)

    def _begins_to_rise(self) -> bool:
        """Whether the last readings rise, faster than the particles flow and as slowly as a stream can.

        While the arm turns back, they rise because they are late.
        """
        last = [reading.mass for reading in self._recent[-RISES:]]
        rises = all(after > before + 0.5 * self._step_size for before, after in itertools.pairwise(last))
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR) or len(last) < RISES or not rises:
            return False
        if self._tilt < self._onset - LATEST_ONSET:  # turned back meanwhile: the tilt says nothing of the onset
            return False
        plausible = 2.0 * self.flow < self._rate(RISES) < 2.0 * self._settings.largest_flow
        return plausible and last[-1] - (self._zero or 0.0) > self._threshold

    def _pass_over(self, time: float, tilt: float) -> None:
        """Move the particles over a pause of the caller, in which the arm has turned back by itself."""
        last = self._command
        highest = min(self._tilt + last.speed * last.patience, max(last.highest, self._tilt))
        turned = self._now + last.patience
        self._estimator.advance(min(turned, time), highest)
        self._estimator.advance(min(turned + abs(highest - tilt) / self._settings.return_speed, time), tilt)

    def _note_late_stream(self, seconds: float, tilt: float) -> None:
        """Integrate the slowest plausible stream; a reading far behind it misses liquid."""
        if self.phase in (DosePhase.CHECK, DosePhase.DONE) or seconds <= 0.0:
            return
        gone = max(self._late_mass, self.amount[0]) / self._cup.density
        head = self._cup.head(np.array([max(self._late_volume - gone, 0.0)]), np.array([tilt - self._late_onset]))
        flow = self._late_factor * float(self._cup.flow(head, tilt)[0]) if head[0] > 0.0 else 0.0
        self._late_flow = flow * self._cup.density
        self._late_mass += self._late_flow * min(seconds, 0.2)

    def _note_tracking(self, seconds: float) -> None:
        """Let the zero of a display that shows zero follow the load that flows onto it."""
        band, mean, deviation = (value * self._step_size for value in TRACKED)
        pours = self.phase in (DosePhase.APPROACH, DosePhase.POUR) and self.flow > 0.0
        if self._zero is not None and self._tared and pours and self._recent[-1].mass <= band:
            self._zero -= mean * seconds
            self._tracked += deviation * seconds

    def _watch(self) -> None:
        """Turn back where it is not safe to pour on."""
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR) or not self._recent:
            return
        assert self._begin is not None
        e, s = self._estimator, self._settings
        net = self._recent[-1].mass - (self._zero or 0.0)
        if self._silent():
            self._before_silence = net
            self._pause()
        elif self._tilt > 0.0 and self._now - self._reported_at > UNREPORTED:
            self._pause()
        elif self._now - self._begin > s.time_limit:
            self._turn_back(DoseEnd.TIME_LIMIT)
        elif self._doubt_since is not None and self._now - self._doubt_since > self._patience(LONGEST_DOUBT):
            self._pause()
        elif self._holds_too_long():
            self._pause(self._lost_stream())
        elif self._nearly_empty():
            self._turn_back(DoseEnd.SOURCE_EMPTY)
        elif self._rate() < 0.5 * max(self._late_flow, 1e-3) and (
            self._late_mass - net - self._late_flow > max(2.5e-3, 0.3 * self._late_mass)
            or (self.phase is DosePhase.POUR and median(e.flow_factor) < 0.3 * self._factor_before)
        ):
            self._pause(self._lost_stream())

    def _lost_stream(self) -> DoseEnd:
        """Why less arrives than should have left the cup."""
        left = median(self._estimator.volume)
        return DoseEnd.SOURCE_EMPTY if left < 0.12 * self._cup.capacity else DoseEnd.STREAM_MISSED

    def _holds_too_long(self) -> bool:
        """Whether the display shows one reading for longer than displays do, although the load has changed."""
        e, shown = self._estimator, self._recent[-1].mass - (self._zero or 0.0)
        rare = e.repeats.run < IMPROBABLE_HOLD or self._now - self._unchanged_since > self._patience(LONGEST_HOLD)
        if e.repeats.run == 0.0 or not rare:
            return False
        surely = quantile(e.reading, 0.1) - 0.5 * self._step_size
        return surely - shown > max(4.0 * SEEN, self._step_size)

    def _pause(self, suspected: DoseEnd | None = None) -> None:
        """Turn back and weigh, because the readings do not follow the stream; the weight decides whether it missed."""
        self._suspected, self._paused, self._doubted = suspected, True, True
        self._turn_back()

    def _rate(self, readings: int = 7) -> float:
        """Slope of so many last readings [kg/s]."""
        first, last = self._recent[max(len(self._recent) - readings, 0)], self._recent[-1]
        return (last.mass - first.mass) / (last.time - first.time) if last.time > first.time else math.inf

    def _nearly_empty(self) -> bool:
        """Whether hardly anything has flowed for a second although the cup is tilted as far as it goes."""
        empty = self._tilt > LARGEST_TILT - math.radians(12.0) and self.flow < 0.5e-3
        if not empty:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = self._now
        return self._idle_since is not None and self._now - self._idle_since > 1.0

    def _turn_back(self, end: DoseEnd | None = None, *, wait: float = 0.0, gently: bool = False) -> None:
        self._end = self._end or end
        self._stop_tilt = self._tilt
        self._ramp_begin, self._ramp_speed = self._now + wait, self._command.speed
        self._ramp = self._return_acceleration() if gently else self._settings.acceleration
        self._enter(DosePhase.RETURN)

    def _enter(self, phase: DosePhase) -> None:
        self.phase, self._since = phase, self._now
