"""What commands may touch of a controller. The controller knows its commands; they know only this."""

from __future__ import annotations

from typing import Protocol

from actors.virtual_ur.exchange import Registers, Signals
from actors.virtual_ur.robot import Robot
from actors.virtual_ur.safety import Safety
from actors.virtual_ur.urscript.program import Program
from actors.virtual_ur.watchdogs import Watchdogs


class Machine(Protocol):
    """A controller, as programs see it.

    Attributes:
        dt: duration of a control cycle [s].
        running: the program that is being advanced.
        popup: a message that somebody has to close.
    """

    dt: float
    robot: Robot
    safety: Safety
    registers: Registers
    signals: Signals
    watchdogs: Watchdogs
    running: Program | None
    popup: str | None

    def tell(self, kind: str, text: str, line: int = 0) -> None:
        """Give a message to all who listen."""

    def protective_stop(self, reason: str) -> None:
        """Stop the arm, hold the program; to be unlocked by a person."""
