"""Rivals of the dose controller: open loop, fixed and learned preact, and PID, on the same bench with the same cup.

All rivals know the geometry of the cup, the weighed content of the source, and the zero of the balance. All begin in
the same way: fast to the earliest plausible onset, then slowly until two readings have risen.

- `OpenLoop` pours along the cup's equation and ignores the balance.
- `Preact` ends at target − preact. With `gain` 0 the preact is fixed; otherwise `gain` × the mean error of the last
  four doses is added after every dose, as in A.S.T. A810; outliers are ignored.
- `Pid` turns with Kp·(target − reading) − Kd·flow, and ends when the reading is within its tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.tilt_command import TiltCommand

APPROACH, BACK, PARK = math.radians(50.0), math.radians(60.0), math.radians(18.0)
SEARCH = math.radians(3.5)
ONSET = math.radians(0.8)
EARLY = math.radians(3.0)


@dataclass
class RivalMemory:
    """State that a rival keeps from dose to dose.

    Attributes:
        volume: volume in the source, from weighings [m³].
        preact: preact [kg].
        onset_bias: last observed bias of the onset [rad].
        errors: errors of the last doses [kg].
    """

    volume: float
    preact: float
    onset_bias: float = ONSET
    errors: list[float] = field(default_factory=list)


class Rival:
    """Common part of all rivals: zero, approach, flow control on the cup's equation, return, weighing."""

    first_preact = 4.2e-3
    """Equals 0.7 s of fine flow: the best of four values on development seeds [kg]."""

    def __init__(self, cup: CupFlow, amount: float, memory: RivalMemory, fine_flow: float) -> None:
        self.cup, self.amount, self.memory, self.fine_flow = cup, amount, memory, fine_flow
        self.phase = "check"
        self.weighed: float | None = None
        self._readings: list[DoseReading] = []
        self._zero, self._tilt, self._now, self._speed, self._since = 0.0, 0.0, 0.0, 0.0, 0.0
        self._onset = memory.onset_bias
        self._stop_tilt = 0.0

    @property
    def reading(self) -> float:
        """Return the last reading net of the receiver [kg]."""
        return self._readings[-1].mass - self._zero if self._readings else 0.0

    @property
    def measured_flow(self) -> float:
        """Return the slope of the readings of the last 0.4 s [kg/s]."""
        last = [r for r in self._readings if r.time > self._now - 0.45]
        if len(last) < 2 or last[-1].time <= last[0].time:
            return 0.0
        return (last[-1].mass - last[0].mass) / (last[-1].time - last[0].time)

    def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand:
        """See `actors.dosing.virtual_dosing_bench.Doser`."""
        self._readings = (self._readings + list(readings))[-40:]
        step, self._now, self._tilt = time - self._now, time, tilt
        if time > 45.0 and self.phase in ("approach", "pour"):
            self._turn_back()
        speed = getattr(self, "_" + self.phase)(step)
        self._speed = speed
        return TiltCommand(speed, finished=self.phase == "done")

    def _check(self, step: float) -> float:
        last = [r.mass for r in self._readings[-4:]]
        if len(last) == 4 and max(last) - min(last) < 2.5e-4:
            self._zero = math.fsum(last) / 4.0
            self.phase = "approach"
        return 0.0

    def _approach(self, step: float) -> float:
        early = self._tilt_for(0.0) - EARLY
        last = self._readings[-3:]
        rise = [r.mass - self._zero for r in last]
        if len(rise) == 3 and rise[2] > rise[1] > rise[0] and rise[2] > 2.5e-4:
            self.phase = "pour"
            self._seen()
            return self._pour(step)
        if self._tilt < early:
            left = early + 0.01 - self._tilt - 0.07 * self._speed
            return math.copysign(min(APPROACH, math.sqrt(7.0 * abs(left))), left)
        growth = self.cup.volume_per_tilt(self.memory.volume, 2e-3) * self.cup.density
        search = min(SEARCH, max(1.5 * self.fine_flow / growth, math.radians(0.6)))
        return search if self._tilt < math.radians(120.0) else 0.0

    def _seen(self) -> None:
        """Set the onset; the stream is detected about half a second after it began."""
        self._onset = self._tilt - 0.5 * self._speed - self._equilibrium(self.memory.volume, 0.0)

    def _pour(self, step: float) -> float:
        raise NotImplementedError

    def _follow(self, flow: float, step: float) -> float:
        """Return the tilt speed for a flow: the cup's equation, corrected by the measured flow."""
        self._onset += math.radians(0.06) * step * (flow - self.measured_flow) / 1e-3
        volume = self.memory.volume - self.reading / self.cup.density
        head = float(self.cup.head_for(np.array([flow / self.cup.density]), self._tilt)[0])
        aim = self._equilibrium(volume, head) + self._onset
        feed = flow / self.cup.density / self.cup.volume_per_tilt(volume, head)
        speed = feed + 4.0 * (aim - self._tilt - 0.07 * self._speed)
        return min(max(speed, -math.radians(30.0)), math.radians(15.0))

    def _turn_back(self) -> float:
        self._stop_tilt, self.phase = self._tilt, "return"
        return -BACK

    def _return(self, step: float) -> float:
        if self._tilt <= max(self._stop_tilt - PARK, 0.01):
            self.phase, self._since = "settle", self._now
            return 0.0
        return -BACK

    def _settle(self, step: float) -> float:
        last = [r for r in self._readings if r.time > self._since][-4:]
        masses = [r.mass for r in last]
        if self._now - self._since > 0.8 and len(masses) == 4 and max(masses) - min(masses) < 2.5e-4:
            self.weighed, self.phase = math.fsum(masses) / 4.0 - self._zero, "done"
        elif self._now - self._since > 10.0:
            self.phase = "done"
        return 0.0

    def _done(self, step: float) -> float:
        return 0.0

    def _equilibrium(self, volume: float, head: float) -> float:
        return float(self.cup.tilt_for(np.array([max(volume, 0.0)]), np.array([head]))[0])

    def _tilt_for(self, flow: float) -> float:
        head = float(self.cup.head_for(np.array([flow / self.cup.density]), 1.0)[0]) if flow > 0.0 else 0.0
        return self._equilibrium(self.memory.volume, head) + self.memory.onset_bias

    def learn(self) -> None:
        """Update the memory for the next dose."""
        if self.weighed is not None:
            self.memory.volume = max(self.memory.volume - self.weighed / self.cup.density, 0.0)
            self.memory.onset_bias = self._onset


class OpenLoop(Rival):
    """Pours along the cup's equation; the balance only weighs the result."""

    def __init__(self, cup: CupFlow, amount: float, memory: RivalMemory, fine_flow: float) -> None:
        super().__init__(cup, amount, memory, fine_flow)
        self._left, self._mass = memory.volume, 0.0

    def _approach(self, step: float) -> float:
        self._advance(step)
        if self._mass > 0.0:
            self.phase = "pour"
            return self._pour(0.0)
        early = self._tilt_for(0.0)
        left = early + 0.01 - self._tilt - 0.07 * self._speed
        return max(math.copysign(min(APPROACH, math.sqrt(7.0 * abs(left))), left), SEARCH)

    def _advance(self, step: float) -> float:
        head = self.cup.head(np.array([self._left]), np.array([self._tilt - self._onset]))
        flow = float(self.cup.flow(head, self._tilt)[0]) if head[0] > 0.0 else 0.0
        self._left -= flow * step
        self._mass += self.cup.density * flow * step
        return self.cup.density * flow

    def _pour(self, step: float) -> float:
        flow = self._advance(step)
        left = self.amount - self._mass - 0.13 * flow
        if left <= 0.0 or self._left * self.cup.density < 1e-3:
            return self._turn_back()
        wanted = min(self.fine_flow + max(left - self.fine_flow, 0.0), max(self.amount / 3.0, self.fine_flow), 0.03)
        head = float(self.cup.head_for(np.array([wanted / self.cup.density]), self._tilt)[0])
        aim = self._equilibrium(self._left, head) + self._onset
        return min(max(4.0 * (aim - self._tilt - 0.07 * self._speed), -math.radians(30.0)), math.radians(15.0))

    def learn(self) -> None:
        """See `Rival.learn`."""
        if self.weighed is not None:
            self.memory.volume = max(self.memory.volume - self.weighed / self.cup.density, 0.0)


class Preact(Rival):
    """Pours with coarse and fine flow, and a preact."""

    gain = 0.0

    def _pour(self, step: float) -> float:
        left = self.amount - self.reading - self.memory.preact
        if left <= 0.0:
            return self._turn_back()
        wanted = min(
            self.fine_flow + max(left - 2.0 * self.fine_flow, 0.0) / 2.0, max(self.amount / 3.0, self.fine_flow), 0.03
        )
        return self._follow(wanted, step)

    def learn(self) -> None:
        """See `Rival.learn`."""
        super().learn()
        if self.gain > 0.0 and self.weighed is not None:
            error = self.weighed - self.amount
            if abs(error) < 5e-3 or not self.memory.errors:
                self.memory.errors = [*self.memory.errors, error][-4:]
                self.memory.preact += self.gain * math.fsum(self.memory.errors) / len(self.memory.errors)


class LearnedPreact(Preact):
    """Updates the preact after every dose."""

    gain = 0.5


class Pid(Rival):
    """PID on the amount with the tilt's speed as output; its gains have the least error on development seeds."""

    gains = (0.15, 0.3, 0.8e-3)
    """Kp [deg/s per g], Kd [deg/s per g/s], tolerance [kg]."""

    def _pour(self, step: float) -> float:
        kp, kd, tolerance = self.gains
        left = self.amount - self.reading
        if left <= tolerance:
            return self._turn_back()
        speed = math.radians(kp * min(1e3 * left, 20.0) - kd * 1e3 * self.measured_flow)
        return min(max(speed, -math.radians(30.0)), math.radians(15.0))


class FastPid(Pid):
    """PID with the gains of least error among those that weigh 50 g within 12 s."""

    gains = (0.3, 0.3, 1.0e-3)
