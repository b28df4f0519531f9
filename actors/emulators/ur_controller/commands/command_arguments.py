"""Checks of the arguments that a program passes to a command, and the view of the controller that commands get.

`ControllerAccess` is the part of a controller that commands may use; the commands depend on nothing else of it.
"""

from __future__ import annotations

from typing import Any, Protocol

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.registers import Registers, Signals, Watchdogs
from actors.emulators.ur_controller.robot import Robot
from actors.emulators.ur_controller.safety_system import Safety
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Program
from actors.emulators.ur_controller.urscript.script_values import number, numbers, show

SLOWEST, FASTEST = 1e-6, 1e4
"""Limits to which rates are clipped [rad/s], [m/s²] …; an arm never reaches either of them."""

LONGEST = 1e7
"""Limit to which times are clipped [s]."""


def six(value: Any) -> Joints:
    """Return the six numbers of a list or a pose."""
    a, b, c, d, e, f = numbers(value, 6)
    return a, b, c, d, e, f


def positive(value: Any, name: str) -> float:
    """Return a number above zero.

    Raises:
        ScriptError: it is not.
    """
    result = number(value)
    if result <= 0.0:
        raise ScriptError(f"{name} must be positive, not {show(value)}")
    return result


def rate(value: Any, name: str) -> float:
    """Return a speed, an acceleration or a deceleration: positive, and clipped to the computable range."""
    return min(max(positive(value, name), SLOWEST), FASTEST)


def whole(value: Any, low: int, high: int, name: str) -> int:
    """Return an integer within limits, both included.

    Raises:
        ScriptError: it is not.
    """
    result = number(value)
    if result != int(result) or not low <= result <= high:
        raise ScriptError(f"{name} must be {low} … {high}, not {show(value)}")
    return int(result)


class ControllerAccess(Protocol):
    """A controller as its programs' commands use it.

    Attributes:
        dt: duration of a control cycle [s].
        running: the program that is being advanced.
        popup: message that the operator has to close.
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
        """Send a message to all listeners."""

    def protective_stop(self, reason: str) -> None:
        """Stop the arm and pause the program; a person has to unlock the stop."""
