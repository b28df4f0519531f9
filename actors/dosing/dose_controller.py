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

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from actors.arm.arm_interface import NEWS_TIMEOUT
from actors.balance.display_quality import FLOW_ERROR, dose_tolerance
from actors.dosing.cup_flow import LARGEST_TILT, CupFlow, Floats, median, quantile
from actors.dosing.display_belief import DisplayBelief
from actors.dosing.dose_estimator import LARGEST_CHANGE, DoseBelief, DoseEstimator, DoseReading
from actors.dosing.dose_readings import RISES, DoseReadings
from actors.dosing.tilt_command import CommandedArm, TiltCommand
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
        missing: left the cup and did not arrive, if the stream missed the receiver [kg].
    """

    end: DoseEnd
    amount: float | None
    deviation: float
    estimate: tuple[float, float]
    top_ups: int
    belief: DoseBelief
    innovations: float
    missing: float = 0.0


FINE_WEBER = 0.8
"""Weber number of the film at the lip in the fine flow at the end. Below `DRIBBLING_WEBER` a part may dribble, but only
for a second or two; a faster flow would add more to the error than it saves in spilled liquid."""

FINE_TIME = 2.5
"""Shortest time in which the fine flow pours a whole dose [s]: a small one ends before a faster flow is known."""


def fine_flow(
    cup: CupFlow,
    tilt: float,
    settings: DosingSettings,
    limit: float = math.inf,
    interval: float = 0.0,
    amount: float = math.inf,
) -> float:
    """Flow at the end of a dose: slow, but fast enough to leave the lip [kg/s].

    Args:
        cup: the source vessel.
        tilt: at which it pours [rad].
        settings: lower and upper bound.
        limit: tolerance of the dose [kg]; a slow balance needs a slower flow.
        interval: between two readings [s].
        amount: of the dose [kg].
    """
    # min(ρ q at We = FINE_WEBER, flow at which `unseen` equals the tolerance, amount / FINE_TIME), within the settings
    clean = cup.clean_flow(tilt, FINE_WEBER) * cup.density
    seen = limit / unseen(1.0, interval) if interval > 0.0 else math.inf
    return min(max(min(clean, seen, amount / FINE_TIME), settings.smallest_flow), settings.largest_fine_flow)


def late_share(amount: float, settings: DosingSettings) -> float:
    """Share of `DoseBelief.aim` that a dose expects: a film of its last flow, which is slower in a small dose.

    Args:
        amount: of the dose [kg].
        settings: of the dose.
    """
    last = min(max(amount / FINE_TIME, settings.smallest_flow), settings.largest_fine_flow)
    return last / settings.largest_fine_flow


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

SURELY = 3.0
"""Standard deviations within which a dose that gets no further command stays within its tolerance."""

ABRUPT = 0.06
"""Standard deviation of what an arm that turns back by itself adds, as a time of the flow [s]: it accelerates at once,
and raises a wave at the lip."""

LATEST_ONSET = math.radians(1.5)
"""Tilt by which outflow can begin later than expected [rad]."""

SEEN_AFTER = 0.5
"""Time until a stream is seen on a balance that repeats no reading [s]."""

LONGEST_DOUBT = (1.2, 2.5)
"""Time with implausible readings after which the cup is turned back: [s], and at least so many readings."""

OTHER_NUMBER, FAR_OFF = 8.0, 0.02
"""A reading that is so many times the expected mass, or its inverse, and so far from it [kg], is a damaged number: a
lost decimal point or digit changes it by a factor of ten."""

LARGEST_REMAINDER = (1e-3, 0.1e-3)
"""Largest rise that a reading at rest still lags behind, and its largest standard deviation [kg]."""

LONGEST_HOLD = (1.6, 5.0)
"""Time with one and the same reading, while the flow should change it, after which the cup is turned back and weighed:
[s], and at least so many readings."""

IMPROBABLE_HOLD = math.log(0.005)
"""Logarithm of the probability of such a row of equal readings after which this happens earlier."""

UNLIKELY = 0.01
"""Share of a first dose's belief in the flow factor that a smaller flow contradicts; a simulated dose may widen it."""

DECREASE = 1e-3
"""Largest decrease of the reading while the balance is silent; after a larger one it was set to zero [kg]."""

UNEXPECTED = 4.0
"""Standard deviations between the last one of some rising readings and its prediction, from which the stream has begun
before any particle expected it."""

MOST_PAUSES = 6
"""Largest number of such interruptions of one dose."""

DRIBBLES = 0.3e-3
"""Mass that arrives late in addition, where the last stream is too slow to leave the lip cleanly [kg]: about half of
what runs down the outside. Later doses know it from the ones before."""

LONGEST_SETTLING = (10.0, 15.0)
"""Time without rest of the balance after which the amount is unknown: [s], and at least so many readings."""

LONGEST_CHECK = (4.0, 8.0)
"""The same before the dose."""


class PriorStream:
    """The stream of a dose without its readings: the usual one of a cup, or a slower one, of which a reading far behind
    it misses liquid.

    Args:
        cup: flow of the source vessel.
        belief: from the doses before.
        less: standard deviations by which the source holds less than expected.
        slowest: whether onset and flow are the slowest plausible ones.
        least: mass by which a reading is behind at least, to be far behind [kg].

    Attributes:
        mass: past the lip [kg].
        flow: now [kg/s].
    """

    def __init__(
        self, cup: CupFlow, belief: DoseBelief, *, less: float = 0.0, slowest: bool = False, least: float = 2.5e-3
    ) -> None:
        self._cup, self._least = cup, least
        self._volume = float(belief.volume.mean()) - less * float(belief.volume.std())
        self._onset, self._factor = float(belief.onset_bias.mean()), median(belief.flow_factor)
        if slowest:
            self._onset += max(2.0 * float(belief.onset_bias.std()), LATEST_ONSET)
            self._factor *= 0.7
        self.mass = self.flow = self._time = 0.0
        self._past: deque[tuple[float, float]] = deque(maxlen=100)  # times [s] and masses, the newest first

    def restart(self, mass: float) -> None:
        """So much [kg] has arrived, and nothing is on its way."""
        self.mass = mass
        self._past.clear()

    def advance(self, seconds: float, tilt: float, amount: float) -> None:
        """Integrate it over a time [s] at a tilt [rad].

        Args:
            seconds: the time.
            tilt: of the cup.
            amount: estimated amount past the lip [kg].
        """
        gone = max(self.mass, amount) / self._cup.density
        head = self._cup.head(np.array([max(self._volume - gone, 0.0)]), np.array([tilt - self._onset]))
        flow = self._factor * float(self._cup.flow(head, tilt)[0]) if head[0] > 0.0 else 0.0
        self.flow = flow * self._cup.density
        self.mass += self.flow * min(seconds, 0.2)
        self._time += seconds
        self._past.appendleft((self._time, self.mass))

    def lacks(self, arrived: float, delay: float = 0.0, share: float = 0.3) -> bool:
        """Whether an amount in the receiver [kg] is a share behind what has left the cup before a delay [s]."""
        due = next((mass for time, mass in self._past if time <= self._time - delay), 0.0) if delay > 0.0 else self.mass
        return due - arrived > max(self._least, share * due)


@dataclass(frozen=True)
class Return:
    """A return of the cup.

    Attributes:
        stop_tilt: at which it was ordered [rad].
        begin: time [s].
        speed: of the tilt at the begin [rad/s].
        acceleration: [rad/s²].
    """

    stop_tilt: float = 0.0
    begin: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0

    def ramp_speed(self, now: float, tick: float) -> float:
        """Mean speed of the tilt from now to a time later [rad/s], if nothing but the acceleration limits it."""
        first, last = (max(now + wait - self.begin, 0.0) for wait in (0.0, tick))
        return self.speed - self.acceleration * (last**2 - first**2) / (2.0 * tick)


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
        in_time: each command follows the one before in time, as in a prediction. None says how long the arm may wait.

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
        in_time: bool = False,
    ) -> None:
        self._cup, self._order, self._settings, self._in_time = cup, order, settings, in_time
        self._share = late_share(order.amount, settings)
        estimated = replace(belief, aim=self._share * belief.aim)
        self._estimator = DoseEstimator(
            cup, estimated, fall_time=fall_time, step=step, noise=noise, rng=np.random.default_rng((seed, 5))
        )
        self._belief = belief
        self._readings = DoseReadings(belief.display, self._estimator.repeats, step=step, noise=noise)
        self._arm = CommandedArm(settings)
        self._usual, self._known = PriorStream(cup, belief), PriorStream(cup, belief, less=2.0, least=4e-3)
        self._slowest = PriorStream(cup, belief, less=2.0, slowest=True)
        self._return_path = Return()
        self.phase = DosePhase.CHECK
        self.result: DoseResult | None = None
        self.fine_flow = settings.smallest_flow
        self._begin: float | None = None
        self._since = 0.0  # begin of the phase
        self._onset = 0.0  # tilt at which it is earliest
        self._rising = 0
        self._innovations: list[float] = []
        self._implausible: float | None = None  # net mass of the last reading, if it was implausible [kg]
        self._doubt_since: float | None = None
        self._idle_since: float | None = None
        self._unchanged_since = 0.0
        self._expected: float | None = None  # amount for which the return was ordered [kg]
        self._before_silence: float | None = None
        self._departed = 0.0  # largest estimated mass past the lip before the weighing [kg]
        self._missing = 0.0  # of it, what has not arrived [kg]
        self._end: DoseEnd | None = None
        self._suspected: DoseEnd | None = None
        self._paused = self._doubted = False
        self._top_ups = self._pauses = 0

    # ---- for displays

    @property
    def amount(self) -> tuple[float, float]:
        """Estimated amount past the lip, mean and standard deviation [kg]."""
        return float(self._estimator.mass.mean()), float(self._estimator.mass.std())

    @property
    def flow(self) -> float:
        """Estimated flow [kg/s]."""
        return self._cup.density * median(self._estimator.flow)

    @property
    def deviation(self) -> float:
        """Standard deviation of the weighed amount [kg]."""
        return self._readings.deviation

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
            self._begin = self._arm.now = time
            self._estimator.start(time, tilt)
        pours = self.phase in (DosePhase.APPROACH, DosePhase.POUR)
        tilt = self._arm.report(time, tilt, moves=pours or self.phase is DosePhase.RETURN)
        readings = self._readings.in_time(readings)
        seconds = time - self._arm.now
        turned = pours and self._arm.has_turned_back(time)
        if turned:
            self._arm.turn_back_in(self._estimator, time, tilt)
            self._readings.keep(readings)
        else:
            for reading in readings:
                self._take(reading, tilt, time)
        if self.phase is DosePhase.CHECK:
            self._estimator.start(time, tilt)
        else:
            self._estimator.advance(time, tilt)
            if self.phase is not DosePhase.DONE and seconds > 0.0:
                amount = float(self._estimator.mass.mean())
                for stream in (self._usual, self._known, self._slowest):
                    stream.advance(seconds, tilt, amount)
                if self.phase is not DosePhase.SETTLE:
                    self._departed = max(self._departed, amount)
        if pours and self.flow > 0.0:
            self._readings.track_zero(seconds)
        self._arm.arrive(time, tilt)
        if turned and seconds > LONG_PAUSE and tilt > 0.0 and self.amount[0] > FLOWED:
            self._turn_back()
            self._paused, self._doubted = True, False
        self._watch()
        decide = {
            DosePhase.CHECK: self._check,
            DosePhase.APPROACH: self._approach,
            DosePhase.POUR: self._pour,
            DosePhase.RETURN: self._return,
            DosePhase.SETTLE: self._settle,
        }.get(self.phase)
        self._arm.command = self._bounded(0.0 if decide is None else decide())
        return self._arm.command

    def _bounded(self, speed: float) -> TiltCommand:
        """The command of a speed [rad/s], with what the arm may do if no further one follows."""
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR, DosePhase.RETURN):
            return TiltCommand(speed, highest=0.0, finished=self.phase is DosePhase.DONE)
        ahead = self._arm.ahead
        highest = ahead + max(speed, 0.0) * AHEAD * self._arm.tick
        if self.phase is DosePhase.APPROACH and ahead < self._onset:
            highest = self._onset
        if self.phase is DosePhase.RETURN or self._overdue() > 0.0:
            highest = min(highest, self._arm.command.highest)
        return TiltCommand(speed, highest=highest, patience=self._patience_of(speed, highest))

    def _patience_of(self, speed: float, highest: float) -> float:
        """The longest time without a command after which the dose still stays within its tolerance [s]."""
        e, s = self._estimator, self._settings
        factor, more = LATE_COMMAND
        least = min(factor * self._arm.tick + more, NEWS_TIMEOUT)
        far = self._order.amount - float(e.mass.max()) > 2.5 * self._cup.density * float(e.flow.max()) + 3e-3
        if far or self._in_time:
            return NEWS_TIMEOUT
        for patience in np.linspace(NEWS_TIMEOUT, least, 4)[:-1]:
            final = e.final_mass(
                self._arm.tilt,
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
        return max(self._readings.overdue(self._arm.now) - self._arm.tick, 0.0)

    def _check(self) -> float:
        """Wait for a balance at rest, and take its reading as the zero."""
        assert self._begin is not None
        if self._readings.take_zero():
            zero, expected = self._readings.zero, self._order.receiver_mass
            assert zero is not None
            if expected is not None and abs(zero - expected) > max(2e-3, 0.03 * expected):
                self._finish(DoseEnd.RECEIVER_MISSING, known=True)
            else:
                self._enter(DosePhase.APPROACH)
            return 0.0
        if self._arm.now - self._begin > self._readings.patience(LONGEST_CHECK):
            self._finish(DoseEnd.CONNECTION_LOST if self._silent() else DoseEnd.UNSTABLE, known=True)
        return 0.0

    def _approach(self) -> float:
        e = self._estimator
        early = quantile(self._cup.tilt_for(e.volume, np.zeros_like(e.volume)) + e.onset_bias, 0.03)
        self._onset = early
        ahead = self._arm.ahead
        if self._rising >= 2:
            self._enter(DosePhase.POUR)
            return self._pour()
        order, interval = self._order, self._readings.interval
        self.fine_flow = fine_flow(self._cup, max(early, 0.1), self._settings, order.limit, interval, order.amount)
        if self._must_stop():
            return self._return()
        if ahead < early:
            return self._arm.speed_towards(early + 0.01, self._settings.approach_speed, ahead)
        # Growth dm/dθ = ρ (−dV/dθ) [kg/rad] of the flow's rate with the speed of the tilt
        aim = quantile(self._tilts_for(self.fine_flow), 0.35)
        growth = self._cup.volume_per_tilt(median(e.volume), 2e-3) * self._cup.density
        # the flow at the moment when the stream is seen is about growth × speed × delay / lag of the cup; until the
        # return has an effect, which takes as long again, a third of what is missing flows
        delay, left = SEEN_AFTER + self._readings.blind + median(e.lag), self._order.amount - median(e.mass)
        flow = min(2.0 * self.fine_flow * SEEN_AFTER / (SEEN_AFTER + self._readings.blind), left / (1.5 * delay))
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
        ahead = self._arm.ahead
        speed = feed + 4.0 * (aim - ahead)
        highest = 0.0 if self._doubt_since is not None else math.radians(15.0)
        if ahead >= LARGEST_TILT - math.radians(5.0):
            highest = 0.0
        return min(max(speed, -math.radians(30.0)), highest)

    def _return(self) -> float:
        arm, path = self._arm, self._return_path
        parked = max(path.stop_tilt - PARK, 0.0)
        if arm.tilt <= parked + 0.01:
            self._enter(DosePhase.SETTLE)
            return 0.0
        speed = arm.speed_towards(parked, self._settings.return_speed, arm.tilt)
        return max(speed, path.ramp_speed(arm.now, arm.tick))

    def _return_acceleration(self) -> float:
        """Acceleration of a return that raises little of a wave [rad/s²]."""
        # Ramp to the return speed v over RETURN_RAMP wave periods: a = v / (RETURN_RAMP · T)
        s, period = self._settings, self._cup.wave_period(median(self._estimator.volume))
        return min(s.acceleration, s.return_speed / (RETURN_RAMP * period))

    def _settle(self) -> float:
        lag = median(self._estimator.lag)
        amount = self._readings.weigh(self._since, self._arm.now, lag, self._behind)
        if amount is not None:
            self._weighed(amount)
        elif self._arm.now - self._since > self._readings.patience(LONGEST_SETTLING):
            self._finish(self._end or (DoseEnd.CONNECTION_LOST if self._silent() else DoseEnd.UNSTABLE), known=False)
        return 0.0

    def _behind(self, time: float) -> bool:
        """Whether the particles agree about the mass that a reading at this time still lags behind."""
        e = self._estimator
        expected = max(3.0 * e.deviation(), 1.5e-4)
        if self._doubt_since is not None or any(abs(innovation) >= expected for innovation in self._innovations):
            return False
        rise = e.mass - e.predicted(time)
        largest, deviation = LARGEST_REMAINDER
        return abs(median(rise)) < largest and float(rise.std()) < deviation

    def _weighed(self, amount: float) -> None:
        step = self._readings.step
        if self._before_silence is not None and amount < self._before_silence - max(2.0 * step, DECREASE):
            self._finish(DoseEnd.CONNECTION_LOST, known=False)
            return
        self._before_silence = None
        # within one step of the display, the particles know more than it shows
        likely = min(max(float(self._estimator.mass.mean()), amount - step), amount + step)
        missing = max(self._departed, self._slowest.mass) - amount
        flows_less = self._flows_less() and self._usual.lacks(amount)  # a film that surged has arrived all the same
        if self._suspected is not None and (
            flows_less or self._slowest.lacks(amount) or self._nearly_all_lacks(amount)
        ):
            self._end = self._end or self._suspected
            self._missing = max(missing, self._usual.mass - amount) if self._end is DoseEnd.STREAM_MISSED else 0.0
        smallest = max(self._settings.smallest_top_up, 1.5 * step)
        if self._end is None and self._order.amount - likely > smallest:
            paused = self._pauses if self._paused else self._top_ups
            if paused < (MOST_PAUSES if self._paused else self._settings.most_top_ups):
                self._pauses += self._paused
                self._top_ups += not self._paused
                if self._doubted:
                    self._estimator.loosen()
                self._estimator.update(DoseReading(self._arm.now, amount), sigma=max(0.05e-3, self.deviation))
                self._rising, self._doubt_since, self._suspected, self._paused = 0, None, None, False
                self._doubted = False
                self._unchanged_since, self._estimator.repeats.run = self._arm.now, 0.0
                for stream in (self._usual, self._known, self._slowest):
                    stream.restart(amount)
                self._departed = amount
                self._enter(DosePhase.APPROACH)
                return
            self._end = DoseEnd.SHORT
        end = DoseEnd.REACHED if self._order.is_met_by(amount) else DoseEnd.MISSED
        self._finish(self._end or end, known=True, amount=amount)

    def _silent(self) -> bool:
        """Whether no reading has come for longer than is usual."""
        return self._readings.silent(self._arm.now, self._settings.reading_timeout)

    def _finish(self, end: DoseEnd, *, known: bool, amount: float = 0.0) -> None:
        self.phase = DosePhase.DONE
        aim = self._aim() / self._share if self._missing == 0.0 else self._belief.aim
        if self._expected is not None and known and end in (DoseEnd.REACHED, DoseEnd.MISSED):
            # aim += max(1/4, 1/(n + 2)) s (late − s aim), s the share: mean of the doses so far, later an exponential
            # average
            late = min(max(amount - self._expected, -1e-3), 1e-3)
            aim += max(0.25, 1.0 / (self._belief.doses + 2)) * self._share * (late - self._aim())
        weighed = amount if known else None
        self.result = DoseResult(
            end,
            weighed,
            self.deviation,
            self.amount,
            self._top_ups,
            self._estimator.belief(weighed=weighed, aim=aim, missing=self._missing),
            self._estimator.innovations,
            self._missing,
        )

    # ---- flow

    def _wanted_flow(self) -> float:
        """Wanted flow [kg/s]: it falls to the fine flow with the remaining amount."""
        e, order, s = self._estimator, self._order, self._settings
        # flow = fine + max(left − 0.7 s · fine, 0) / horizon: it decays over 0.9 s, the lag and the display's repeats
        after = 0.1 * self.flow
        left = order.amount - median(e.mass) - after
        horizon = 0.9 + 1.0 * median(e.lag) + self._readings.blind
        bulk = min(max(order.amount / 3.0, self.fine_flow), s.largest_flow)
        return min(self.fine_flow + max(left - 0.7 * self.fine_flow, 0.0) / horizon, bulk)

    def _tilts_for(self, flow: float) -> Floats:
        e = self._estimator
        # θ_i = tilt(V_i, head(q / c_i)) + b_i: the tilt at which particle i has the flow
        head = self._cup.head_for(flow / self._cup.density / e.flow_factor, self._arm.tilt)
        return self._cup.tilt_for(e.volume, head) + e.onset_bias

    def _must_stop(self) -> bool:
        e, order, s = self._estimator, self._order, self._settings
        if order.amount - float(e.mass.max()) > 1.5 * self._cup.density * float(e.flow.max()) + 1e-3:
            return False
        final = e.final_mass(
            self._arm.tilt,
            self._arm.command.speed,
            latency=s.latency,
            back=s.return_speed,
            acceleration=self._return_acceleration(),
        )
        # Return if median ≥ target, or P(final > target + limit) > 1 %: median + 2.33 σ ≥ target + limit
        middle, deviation = median(final) + self._aim(), self._spread(final)
        left, wait = order.amount - middle, 0.0
        if middle + 2.33 * deviation < order.amount + order.limit:
            wait = max(left, 0.0) / max(self.flow, 1e-6)
            if wait >= self._arm.tick:
                return False
        self._expected = median(final) + self.flow * wait
        self._turn_back(wait=wait, gently=True)
        return True

    def _aim(self) -> float:
        """Mass to subtract from the target [kg]."""
        clean = self._cup.density * self._cup.clean_flow(max(self._arm.tilt, 0.1))
        late = DRIBBLES if self._belief.doses == 0 and self.fine_flow < clean else 0.0
        return self._share * (self._belief.aim + late)

    # ---- readings and doubts

    def _take(self, reading: DoseReading, tilt: float, now: float) -> None:
        readings, arm = self._readings, self._arm
        readings.add(reading)
        if readings.zero is None or self.phase is DosePhase.DONE:
            return
        share = 1.0 if now <= arm.now else min(max((reading.time - arm.now) / (now - arm.now), 0.0), 1.0)
        e = self._estimator
        e.advance(reading.time, arm.tilt + share * (tilt - arm.tilt))
        net = DoseReading(reading.time, readings.net, reading.stable)
        seen = e.seen(net)
        if seen.new < 0.5:
            e.update(net, seen=seen)
            return
        self._unchanged_since = reading.time
        predicted = e.predicted(reading.time)
        deviation = math.hypot(float(predicted.std()), e.deviation())
        gate = max(5.0 * deviation, 1.5e-3 + 0.1 * self.flow)
        expected = float(predicted.mean())
        if net.mass - expected > UNEXPECTED * deviation and tilt >= arm.tilt and self._begins_to_rise():
            e.flows_unexpectedly(net, readings.rate(RISES))
            expected = net.mass
        if abs(net.mass - expected) > gate:
            self._doubt_since = self._doubt_since if self._doubt_since is not None else reading.time
            most, least = OTHER_NUMBER * expected + FAR_OFF, expected / OTHER_NUMBER - FAR_OFF
            confirmed = self._implausible is not None and abs(net.mass - self._implausible) <= gate
            self._implausible = net.mass
            if self.phase is DosePhase.SETTLE and not confirmed:  # by the one before: a single one is not weighed
                readings.discard()
                return
            if self.phase is not DosePhase.SETTLE or not least < net.mass < most:
                return
        else:
            self._doubt_since = self._implausible = None
        rises = net.mass > readings.net_before + 0.5 * readings.step and net.mass > self._threshold
        self._rising = self._rising + 1 if rises else 0
        self._innovations = [*self._innovations[-2:], e.update(net, seen=seen)]

    @property
    def _threshold(self) -> float:
        """Net reading above which liquid has arrived [kg]."""
        return (self._slowest.mass if self._top_ups else 0.0) + max(SEEN, 2.5 * self._readings.step)

    def _begins_to_rise(self) -> bool:
        """Whether the last readings rise, faster than the particles flow and as slowly as a stream can.

        While the arm turns back, they rise because they are late.
        """
        readings = self._readings
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR) or not readings.rise:
            return False
        if self._arm.tilt < self._onset - LATEST_ONSET:  # turned back meanwhile: the tilt says nothing of the onset
            return False
        plausible = 2.0 * self.flow < readings.rate(RISES) < 2.0 * self._settings.largest_flow
        return plausible and readings.net > self._threshold

    def _watch(self) -> None:
        """Turn back where it is not safe to pour on."""
        if self.phase not in (DosePhase.APPROACH, DosePhase.POUR) or not self._readings:
            return
        assert self._begin is not None
        readings, now, net = self._readings, self._arm.now, self._readings.net
        if self._silent():
            self._before_silence = net
            self._pause()
        elif self._arm.is_unreported():
            self._pause()
        elif now - self._begin > self._settings.time_limit:
            self._turn_back(DoseEnd.TIME_LIMIT)
        elif self._doubt_since is not None and now - self._doubt_since > readings.patience(LONGEST_DOUBT):
            self._pause()
        elif self._holds_too_long():
            self._pause(self._lost_stream())
        elif self._nearly_empty():
            self._turn_back(DoseEnd.SOURCE_EMPTY)
        elif self._falls_behind():
            self._pause(self._lost_stream())

    def _falls_behind(self) -> bool:
        """Whether the readings are far behind the slowest plausible stream, or hardly follow the one of a known cup."""
        readings, slowest, net = self._readings, self._slowest, self._readings.net
        if readings.rate() < 0.5 * max(slowest.flow, 1e-3) and (
            slowest.lacks(net + slowest.flow) or (self.phase is DosePhase.POUR and self._flows_less())
        ):
            return True
        delay = SEEN_AFTER + readings.blind + median(self._estimator.lag)
        return readings.rate() < 0.5 * self._known.flow and self._nearly_all_lacks(net, delay)

    def _nearly_all_lacks(self, arrived: float, delay: float = 0.0) -> bool:
        """Whether hardly anything arrived [kg] of the stream that a known cup has, before a delay [s]."""
        return self._belief.doses > 0 and self._known.lacks(arrived, delay, share=0.8)

    def _flows_less(self) -> bool:
        """Whether far less flows than in the doses before, or than a first dose expects at least."""
        before = self._belief.flow_factor
        least = median(before) / LARGEST_CHANGE
        if self._belief.doses == 0:
            least = min(least, quantile(before, UNLIKELY))
        return median(self._estimator.flow_factor) < least

    def _lost_stream(self) -> DoseEnd:
        """Why less arrives than should have left the cup."""
        left = median(self._estimator.volume)
        return DoseEnd.SOURCE_EMPTY if left < 0.12 * self._cup.capacity else DoseEnd.STREAM_MISSED

    def _holds_too_long(self) -> bool:
        """Whether the display shows one reading for longer than displays do, although the load has changed."""
        e, readings = self._estimator, self._readings
        long = self._arm.now - self._unchanged_since > readings.patience(LONGEST_HOLD)
        if e.repeats.run == 0.0 or not (long or e.repeats.run < IMPROBABLE_HOLD):
            return False
        surely = quantile(e.reading, 0.1) - 0.5 * readings.step
        return surely - readings.net > max(4.0 * SEEN, readings.step)

    def _pause(self, suspected: DoseEnd | None = None) -> None:
        """Turn back and weigh, because the readings do not follow the stream; the weight decides whether it missed."""
        self._suspected, self._paused, self._doubted = suspected, True, True
        self._turn_back()

    def _nearly_empty(self) -> bool:
        """Whether hardly anything has flowed for a second although the cup is tilted as far as it goes."""
        empty = self._arm.tilt > LARGEST_TILT - math.radians(12.0) and self.flow < 0.5e-3
        if not empty:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = self._arm.now
        return self._idle_since is not None and self._arm.now - self._idle_since > 1.0

    def _turn_back(self, end: DoseEnd | None = None, *, wait: float = 0.0, gently: bool = False) -> None:
        self._end = self._end or end
        acceleration = self._return_acceleration() if gently else self._settings.acceleration
        self._return_path = Return(self._arm.tilt, self._arm.now + wait, self._arm.command.speed, acceleration)
        self._enter(DosePhase.RETURN)

    def _enter(self, phase: DosePhase) -> None:
        self.phase, self._since = phase, self._arm.now
