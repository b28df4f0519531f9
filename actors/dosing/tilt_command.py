"""The commands of a dose to the arm, and the arm that follows the last one: where it is, and where it goes alone."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

from actors.arm.arm_interface import NEWS_TIMEOUT
from actors.dosing.dose_estimator import DoseEstimator
from actors.dosing_settings import DosingSettings

UNREPORTED = 0.3
"""Time after which the cup is turned back if the arm, which should move, reports one and the same tilt [s]."""


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
    _: KW_ONLY
    highest: float = math.inf
    patience: float = NEWS_TIMEOUT
    finished: bool = False


class CommandedArm:
    """The arm that follows the last command.

    Args:
        settings: of the dose.

    Attributes:
        now: time of the last report [s].
        tilt: then [rad].
        tick: usual time between two commands [s].
        command: the last one.
    """

    def __init__(self, settings: DosingSettings) -> None:
        self._settings = settings
        self.now, self.tilt, self.tick, self.command = 0.0, 0.0, 0.05, TiltCommand(0.0, highest=0.0)
        self._reported = self._reported_at = -math.inf

    def report(self, time: float, tilt: float, *, moves: bool) -> float:
        """The tilt now [rad]; if the report is an old one, the tilt to which the last command moves the arm.

        Args:
            time: now [s].
            tilt: as the arm reports it [rad].
            moves: the arm follows commands in this phase.
        """
        speed = self.command.speed
        if tilt != self._reported or speed == 0.0:
            self._reported, self._reported_at = tilt, time
            return tilt
        if tilt <= 0.0 or not moves:
            return tilt
        moved = self.tilt + speed * min(time - self.now, self.command.patience)
        return max(min(moved, max(self.command.highest, self.tilt)), 0.0)

    def arrive(self, time: float, tilt: float) -> None:
        """Note the tilt [rad] at a time [s], and learn from it how often commands follow each other."""
        self.tick += 0.2 * (min(time - self.now, 0.2) - self.tick)
        self.now, self.tilt = time, tilt

    def has_turned_back(self, time: float) -> bool:
        """Whether the arm has turned back by itself before a time [s], for want of a command."""
        return time - self.now > self.command.patience + self._settings.latency

    def is_unreported(self) -> bool:
        """Whether the arm, which should move, has reported the same tilt for too long."""
        return self.tilt > 0.0 and self.now - self._reported_at > UNREPORTED

    def turn_back_in(self, estimator: DoseEstimator, time: float, tilt: float) -> None:
        """Move an estimator's particles until a time [s] and tilt [rad] at which the arm has turned back by itself."""
        last = self.command
        highest = min(self.tilt + last.speed * last.patience, max(last.highest, self.tilt))
        turned = self.now + last.patience
        estimator.advance(min(turned, time), highest)
        estimator.advance(min(turned + abs(highest - tilt) / self._settings.return_speed, time), tilt)

    @property
    def ahead(self) -> float:
        """Tilt when the arm begins to follow the next command [rad]."""
        speed, highest = self.command.speed, self.command.highest
        ahead = self.tilt + speed * self._settings.latency
        return max(min(ahead, highest), self.tilt) if speed > 0.0 else ahead

    def speed_towards(self, tilt: float, speed: float, begin: float) -> float:
        """Speed [rad/s] of a turn from one tilt to another [rad], with a deceleration of a third of the allowed one."""
        # v = √(2 a/3 · |left|): a constant deceleration a/3 ends at the tilt
        left = tilt - begin
        return math.copysign(min(speed, math.sqrt(2.0 * self._settings.acceleration / 3.0 * abs(left))), left)
