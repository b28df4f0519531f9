"""What can go wrong with the arm, for the person who stands beside it."""

from __future__ import annotations

from typing import Any

from actors.arm.protocol import Executed
from actors.protocols import LaboratoryError


class ArmError(LaboratoryError):
    """The arm can't do what was asked."""


class ArmRefusedError(ArmError):
    """Refused before anything moved."""


class ArmNotReleasedError(ArmRefusedError):
    """Nobody has said since the last stop, start or recovery that the arm may move."""


class NotAcceptedError(LaboratoryError):
    """The arm's safety settings aren't those that people have accepted; it moves nothing."""


class ArmLostError(ArmError):
    """The controller, the line to it or the driver's worker is gone; the arm stops by its watchdog.

    Args:
        text: what happened.
        executed: what is known of the motion that was under way.
    """

    def __init__(self, text: str, executed: Executed | None = None) -> None:
        super().__init__(text)
        self.text, self.executed = text, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.executed)


class ArmStoppedError(ArmError):
    """A motion was broken off; the arm stands where it was stopped and is locked.

    Args:
        text: what happened, and what to do.
        kind: 'operator', 'protective stop', 'emergency stop', 'safeguard', 'safety', 'watchdog', 'program ended'.
        phase: of the motion: 'announced', 'approach', 'tilt', 'hold', 'return', 'retreat', 'untilt', 'jog'.
        time: since the motion's begin [s of controller time].
        tilt: that the pourer is left with [rad].
        executed: what was done until then; None if nothing was.
    """

    def __init__(
        self, text: str, kind: str, phase: str, time: float, tilt: float, executed: Executed | None = None
    ) -> None:
        super().__init__(text)
        self.text, self.kind, self.phase = text, kind, phase
        self.time, self.tilt, self.executed = time, tilt, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.kind, self.phase, self.time, self.tilt, self.executed)
