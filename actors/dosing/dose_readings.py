"""The readings of the balance in one dose: their rhythm, the zero, and the weight of the filled receiver at rest.

`DoseReadings` keeps the last readings. From them follow how long the balance may be silent until something is wrong,
how fast the reading rises, and what it comes to rest at. It decides nothing.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from actors.dosing.display_belief import REPEATS, DisplayBelief, Repeats
from actors.dosing.dose_estimator import DoseReading

KEPT = 40
"""Largest number of readings that are kept."""

TOGETHER = 0.4
"""Readings that arrive within this part of their usual interval were held up, all but the last one."""

LATE_READING = (1.6, 1.2, 2.5)
"""Time without a reading after which the largest tilt does not rise, in the manner of `SILENCE`."""

SILENCE = (2.5, 1.3, 4.5)
"""Time without a reading after which the cup is turned back: at least the first and at most the last factor times the
usual interval; in between, the second factor times the longest one so far."""

RISES = 3
"""Readings in a row that rise, from which the stream may have begun before any particle expected it."""

EARLIEST_WEIGHING = 2.0
"""Time after which a reading at rest may be completed with the rise that the balance still lags behind [lags]."""

RECORDED_HOLD = 1.1
"""Longest time with one and the same reading in recorded pours [s]."""

STALE = 0.01
"""Largest probability that a reading which counts as weighed is an old one."""

MOST_EQUAL, LONGEST_EQUAL = 12, 3.0
"""Equal readings that count as weighed, however often the display repeats one; the same for so long a time [s]."""

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


def _late_drops(waited: float) -> float:
    """Mean mass of the drops that fall later than a time after the return [s] [kg]."""
    drop, count, time = LATE_DROPS
    return drop * count * math.exp(-waited / time)


class DoseReadings:
    """The readings of one dose.

    Args:
        display: what is known of the balance's display.
        repeats: how often it repeats a reading, as the estimator learns it during the dose.
        step: of the display [kg].
        noise: standard deviation of a reading besides the step [kg].

    Attributes:
        step: of the display [kg].
        interval: usual time between two readings [s].
        zero: reading of the empty receiver [kg]; None before it was weighed.
    """

    def __init__(self, display: DisplayBelief, repeats: Repeats, *, step: float, noise: float) -> None:
        self.step, self._noise, self._repeats = step, noise, repeats
        self.interval, self._longest_gap = display.interval, display.longest
        self.zero: float | None = None
        self._last: list[DoseReading] = []
        self._tared, self._tracked = False, 0.0
        self._remainder, self._late_drops = step / math.sqrt(12.0), _late_drops(RUN_OFF)

    def __bool__(self) -> bool:
        return bool(self._last)

    # ---- as they arrive

    def in_time(self, readings: Sequence[DoseReading]) -> list[DoseReading]:
        """New readings without those that were held up and arrived together with a later one."""
        least = TOGETHER * self.interval
        return [
            reading
            for reading, after in itertools.zip_longest(readings, readings[1:])
            if after is None or after.time - reading.time >= least
        ]

    def keep(self, readings: Iterable[DoseReading]) -> None:
        """Keep readings that arrived in a pause of the program: their intervals tell nothing."""
        self._last = [*self._last, *readings][-KEPT:]

    def add(self, reading: DoseReading) -> None:
        """Keep a reading, and learn from its interval."""
        self.keep([reading])
        if len(self._last) > 1:
            gap = reading.time - self._last[-2].time
            self.interval += 0.1 * (min(gap, max(1.0, 3.0 * self.interval)) - self.interval)
            self._longest_gap = max(self._longest_gap, gap)

    def discard(self) -> None:
        """Discard the last reading, which is implausible."""
        del self._last[-1]

    # ---- their rhythm

    def patience(self, limit: tuple[float, float]) -> float:
        """The larger one of a time [s] and of a number of readings [s]."""
        return max(limit[0], limit[1] * self.interval)

    def overdue(self, now: float) -> float:
        """Time by which the last reading is older than is usual [s]; negative if it is not."""
        age = now - self._last[-1].time if self._last else 0.0
        return age - self._usual(*LATE_READING)

    def silent(self, now: float, timeout: float) -> bool:
        """Whether no reading has come for longer than is usual, and than a time limit [s]."""
        return not self._last or now - self._last[-1].time > max(self._usual(*SILENCE), timeout)

    def _usual(self, least: float, longer: float, most: float) -> float:
        """A time between two readings from the usual and from the longest one, see `SILENCE` [s]."""
        gaps = [after.time - before.time for before, after in itertools.pairwise(self._last[-6:])]
        usual = max(self.interval, statistics.median(gaps)) if gaps else self.interval
        return min(max(least * usual, longer * self._longest_gap), most * usual)

    @property
    def blind(self) -> float:
        """Time for which the display may repeat one reading, which hardly one in ten repeats exceeds [s]."""
        return self.interval * self._repeats.in_a_row(0.1)

    # ---- the stream

    @property
    def net(self) -> float:
        """The last reading without the receiver [kg]."""
        return self._last[-1].mass - (self.zero or 0.0)

    @property
    def net_before(self) -> float:
        """The reading before the last one without the receiver [kg]; 0 if there is none."""
        return self._last[-2].mass - (self.zero or 0.0) if len(self._last) > 1 else 0.0

    def rate(self, readings: int = 7) -> float:
        """Slope of so many last readings [kg/s]."""
        first, last = self._last[max(len(self._last) - readings, 0)], self._last[-1]
        return (last.mass - first.mass) / (last.time - first.time) if last.time > first.time else math.inf

    @property
    def rise(self) -> bool:
        """Whether each of the last `RISES` readings is above the one before."""
        last = [reading.mass for reading in self._last[-RISES:]]
        return len(last) == RISES and all(b > a + 0.5 * self.step for a, b in itertools.pairwise(last))

    # ---- at rest

    def take_zero(self) -> bool:
        """Take the last four readings as the zero if they are alike."""
        last = self._last[-4:]
        if len(last) < 4 or _spread(last) > max(3.0 * self.step, 1e-4):
            return False
        self.zero = math.fsum(r.mass for r in last) / 4.0
        self._tared = abs(self.zero) <= self.step
        return True

    def track_zero(self, seconds: float) -> None:
        """Let the zero of a display that shows zero follow the load that flows onto it for a time [s]."""
        band, mean, deviation = (value * self.step for value in TRACKED)
        if self.zero is not None and self._tared and self._last[-1].mass <= band:
            self.zero -= mean * seconds
            self._tracked += deviation * seconds

    def weigh(self, since: float, now: float, lag: float, complete: Callable[[float], bool]) -> float | None:
        """The weight of the liquid in the receiver, with the drops that still fall [kg]; None before it rests.

        Args:
            since: begin of the rest [s].
            now: [s].
            lag: of the balance [s].
            complete: whether a reading at this time [s] lags behind the load by nearly nothing.
        """
        assert self.zero is not None
        waited = now - since
        longest = math.ceil(LONGEST_EQUAL / self.interval) + 1
        old = min(self._repeats.in_a_row(STALE) + 1, MOST_EQUAL, longest)
        needed = max(old, math.ceil(AT_REST / self.interval) + 1, 4)
        last = [r for r in self._last if r.time > since][-needed:]
        if len(last) < needed or waited <= RUN_OFF + EARLIEST_WEIGHING * lag:
            return None
        begin = since + 0.4 * RUN_OFF + EARLIEST_WEIGHING * lag
        final, deviation, rise = self._approached([r for r in self._last if r.time > begin] or last, lag)
        if abs(rise) > max(LARGEST_RISE[0], LARGEST_RISE[1] * self.step):
            return None
        half = needed // 2
        early, late = (math.fsum(r.mass for r in readings) / half for readings in (last[:half], last[-half:]))
        flat = _spread(last) <= max(2.0 * self.step, 1.5e-4) and abs(late - early) <= max(0.6 * self.step, 5e-5)
        late_enough = waited > 3.0 * lag and (flat or all(r.stable for r in last))
        if not late_enough and not (flat and complete(last[-1].time)):
            return None
        self._remainder, self._late_drops = deviation, _late_drops(waited)
        return final + self._late_drops - self.zero

    def _approached(self, readings: Sequence[DoseReading], lag: float) -> tuple[float, float, float]:
        """The reading that these ones approach, its standard deviation, and how far it is from the last one [kg]."""
        times, masses = (np.array(values) for values in zip(*((r.time, r.mass) for r in readings), strict=True))
        # a filter's lag, and a filter that gets slower at rest or liquid that runs off late, one after the other
        shape = np.exp((times[-1] - times) / math.hypot(LATE_TIME, lag))
        # Regression m(t) = final − rise e^{(t_last − t)/τ}, with a normal prior of `rise` of the deviation REST_BAND:
        # rise = −Σ (e − ē) m / (Σ (e − ē)² + σ²/σ_rise²), final = m̄ + ē rise
        shape_mean, centred = float(shape.mean()), shape - shape.mean()
        rounded = self.step**2 / 12.0
        variance = (rounded + self._noise**2) / self._new
        stiffness = float(centred @ centred) + variance / (REST_BAND[0] ** 2 + (REST_BAND[1] * self.step) ** 2)
        rise = -float(centred @ masses) / stiffness
        alike = self._alike
        scatter = variance * (1.0 / len(readings) + shape_mean**2 / stiffness)
        # a rise beyond its own scatter ends later or earlier than e^{-t/τ} does
        scatter += UNKNOWN_RISE**2 * max(rise**2 - variance / stiffness, 0.0)
        deviation = math.sqrt(alike * rounded + (1.0 - alike) * scatter)
        approached = float(masses.mean()) + shape_mean * rise
        return alike * float(masses[len(masses) // 2 :].mean()) + (1.0 - alike) * approached, deviation, rise

    @property
    def deviation(self) -> float:
        """Standard deviation of a weighed amount: zero, last readings, late drops and tracking of the zero [kg]."""
        # zero: a mean of four readings, n of them new: σ² = a d²/12 + ((1 − a) d²/12 + σ_0²) / n, a rounded alike, or
        # (d/4)²/3 after a tare; drops: their number has a Poisson distribution, σ² = drop · mean mass
        rounded, alike = self.step**2 / 12.0, self._alike
        zero = rounded * (4.0 * TARED**2 if self._tared else alike)
        zero += ((1.0 - alike) * rounded + self._noise**2) / (1.0 + 3.0 * self._new)
        return math.sqrt(zero + self._remainder**2 + LATE_DROPS[0] * self._late_drops + self._tracked**2)

    @property
    def _alike(self) -> float:
        """Share of the rounding error's variance that all readings at rest have in common."""
        # exp(−4π² σ²/d²) for a noise σ and steps d: first harmonic of the mean rounding error (Widrow 1961, dither)
        return math.exp(-((2.0 * math.pi * self._noise / self.step) ** 2))

    @property
    def _new(self) -> float:
        """Share of new readings at rest."""
        repeated = float(self._repeats.weights(1) @ REPEATS)
        return max(1.0 - repeated, self.interval / (self.interval + RECORDED_HOLD))


def _spread(readings: Sequence[DoseReading]) -> float:
    return max(r.mass for r in readings) - min(r.mass for r in readings)
