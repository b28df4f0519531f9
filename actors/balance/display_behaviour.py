"""How real balances show a load: repeated and late readings, zero tracking, filters that switch, creep.

`DisplayBehaviour` are the settings, all off by default; a virtual laboratory sets them for its balance. `DisplayModel`
applies them to the filtered load. The emulated serial balance, the simulated balance and the virtual bench of doses use
the same model. Its random numbers have streams of their own, and a behaviour that is off changes no other number.

Sources of the behaviours:

- Kennedy et al. 2019, precision pouring (University of Pennsylvania): in ten recorded pours by a robot onto a USB
  balance (5 Hz, steps of 2 g), 42 % of the readings during the flow repeat the one before, for up to 1.1 s.
- Recordings of small Bluetooth balances at 10 Hz, github.com/miharekar/visualizer: the gaps between readings have
  medians of 0.09 to 0.12 s, standard deviations of 0.02 to 0.05 s, and reach 0.46 s.
- Western Scale M1, technical manual: the display is updated every 0.25 s or a multiple of it; averaging is suspended
  while the weight changes by more than 2 to 18 steps. Norac M2000: updates up to 3 s apart, "faststep" filter. Rice
  Lake 482: adaptive filter, reset to the new weight beyond a threshold, else effective over 30 to 180 conversions.
- OIML R 76-1:2006, 4.5.7: zero tracking only at zero and at rest, by at most 0.5 steps per second. Flintec DAD 141:
  within 0.5 steps, at 0.4 steps per second, or within up to 127 steps. Radwag PS: autozero also corrects a load that is
  poured on slowly.
- OIML R 60-1:2017, 5.5.1: the creep of a load cell within 30 minutes is at most 0.7 of its error limit, for class C3 at
  most 0.025 % of its capacity. OIML R 76-1, 3.9.4.1: at most 0.5 steps within 30 minutes, 0.2 of them in the last 15.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, TypeVar

import numpy as np
from pydantic import Field

from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity

Shown = TypeVar("Shown")

SHORTEST_GAP = 1e-3
"""Shortest time between the arrivals of two readings [s]; the recordings of Bluetooth balances have 1 to 45 ms."""

_STREAMS = 90
"""Last part of the seed of the first random stream."""


class DisplayBehaviour(Settings):
    """How the display of a virtual balance departs from an ideal one; all of it is off by default."""

    repeat_probability: Annotated[float, Quantity("1", "0.42", 0.0, 0.95)] = 0.0
    """Probability that a reading repeats the one before instead of showing the load."""

    longest_repeat: Annotated[int, Field(strict=True, ge=1, le=100)] = 5
    """Largest number of repeated readings in a row."""

    conversion_interval: Annotated[float, Quantity("s", "0.5 s", 0.0, 10.0)] = 0.0
    """Time between two updates of the display; readings in between are equal. 0: every reading is new."""

    jitter: Annotated[float, Quantity("s", "0.03 s", 0.0, 2.0)] = 0.0
    """Mean and standard deviation of an additional, exponentially distributed delay of each reading."""

    lost: Annotated[float, Quantity("1", "0.02", 0.0, 0.9)] = 0.0
    """Probability that a reading never arrives."""

    zero_tracking: Annotated[float, Quantity("1/s", "0.5 1/s", 0.0, 100.0)] = 0.0
    """Rate at which a display near zero is corrected to zero, in display steps per second; it hides a slow flow."""

    zero_band: Annotated[float, Quantity("1", "0.5", 0.0, 1000.0)] = 0.5
    """Largest displayed load that is corrected to zero, in display steps."""

    rest_lag: Annotated[float, Quantity("s", "1 s", 0.0, 60.0)] = 0.0
    """Time constant of a further filter that acts only while the load hardly moves."""

    rest_band: Annotated[float, Quantity("1", "4", 0.0, 1000.0)] = 4.0
    """Distance from the load beyond which that filter starts again at the load, in display steps."""

    creep: Annotated[float, Quantity("1", "0.0002", -0.01, 0.01)] = 0.0
    """Part of a load by which the display still changes while the load rests."""

    creep_time: Annotated[float, Quantity("s", "300 s", 0.0, 36_000.0, positive=True)] = 300.0
    """Time constant of the creep."""

    stable_display: bool = False
    """Whether the balance reports 'stable' as soon as its display shows no change, although its cell still moves."""

    @property
    def acts(self) -> bool:
        """Whether the shown value differs from the filtered load."""
        return any((self.conversion_interval, self.zero_tracking, self.rest_lag, self.creep))


IDEAL = DisplayBehaviour()
"""An ideal display."""


class DisplayModel:
    """From the filtered load to readings that arrive.

    Args:
        behaviour: what it does.
        step: of the display [kg].
        seed: of its random numbers.
        load: at rest on the balance since long [kg].

    Attributes:
        value: that the display shows, before noise and rounding [kg].
    """

    def __init__(self, behaviour: DisplayBehaviour, step: float, seed: tuple[int, ...], load: float = 0.0) -> None:
        self.behaviour, self.value = behaviour, load
        self._step, self._start = step, load
        self._acts, self._time = behaviour.acts, 0.0
        self._rested, self._distance = load, 0.0
        self._crept = self._tracked = 0.0
        self._conversion, self._converted = -1, True
        self._last: list[object] = []
        self._repeats = 0
        self._arrived = -math.inf
        streams = [np.random.default_rng((*seed, _STREAMS + k)) for k in range(3)]
        self._repeat_rng, self._delay_rng, self._loss_rng = streams

    def advance(self, value: float, seconds: float, zero: float = 0.0) -> float:
        """Let time pass.

        Args:
            value: of the balance's filter at the end of it [kg].
            seconds: [s]
            zero: value that the display shows as zero, without the tracking of zero [kg].

        Returns:
            The value that the display shows [kg].
        """
        if not self._acts:
            self.value = value
            return value
        behaviour = self.behaviour
        self._time += seconds
        if behaviour.creep:
            wanted = behaviour.creep * (value - self._start)
            self._crept += (wanted - self._crept) * -math.expm1(-seconds / behaviour.creep_time)
            value += self._crept
        if behaviour.rest_lag > 0.0:
            distance = value - self._rested
            moves = abs(distance) > behaviour.rest_band * self._step
            self._rested += distance * (1.0 if moves else -math.expm1(-seconds / behaviour.rest_lag))
            self._distance, value = value - self._rested, self._rested
        if behaviour.zero_tracking > 0.0:
            shown, most = value - self._tracked - zero, behaviour.zero_tracking * self._step * seconds
            if abs(shown) <= behaviour.zero_band * self._step:
                self._tracked += min(max(shown, -most), most)
            value -= self._tracked
        if behaviour.conversion_interval > 0.0:
            conversion = int(self._time / behaviour.conversion_interval + 1e-6)
            if conversion == self._conversion:
                return self.value
            self._conversion, self._converted = conversion, True
        self.value = value
        return value

    @property
    def settled(self) -> bool:
        """Whether the display has come to the load, except for creep and the tracking of zero."""
        return abs(self._distance) < self._step / 8.0

    def show(self, measure: Callable[[], Shown]) -> Shown:
        """The next reading.

        Args:
            measure: makes a new reading of `value`; not called if the last one is shown again.
        """
        behaviour = self.behaviour
        if self._last:
            if behaviour.conversion_interval > 0.0 and not self._converted:
                return self._last[0]  # type: ignore[return-value]
            self._converted = False
            if (
                behaviour.repeat_probability > 0.0
                and self._repeats < behaviour.longest_repeat
                and self._repeat_rng.random() < behaviour.repeat_probability
            ):
                self._repeats += 1
                return self._last[0]  # type: ignore[return-value]
        self._repeats, self._converted = 0, False
        reading = measure()
        self._last = [reading]
        return reading

    def arrival(self, due: float, time_scale: float = 1.0) -> float:
        """Time at which a reading arrives, after those before it.

        Args:
            due: time without jitter [s of the clock].
            time_scale: bench seconds per second of the clock.
        """
        if self.behaviour.jitter == 0.0:
            return due
        late = due + float(self._delay_rng.exponential(self.behaviour.jitter)) / time_scale
        self._arrived = max(late, self._arrived + SHORTEST_GAP / time_scale)
        return self._arrived

    def loses(self) -> bool:
        """Whether the next reading never arrives."""
        return self.behaviour.lost > 0.0 and float(self._loss_rng.random()) < self.behaviour.lost
