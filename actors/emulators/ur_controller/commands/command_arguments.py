"""Reading what a program passes.

What commands may touch of a controller. The controller knows its commands; they know only this.
"""

from __future__ import annotations

from typing import Any, Protocol

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.registers import Registers, Signals, Watchdogs
from actors.emulators.ur_controller.robot import Robot
from actors.emulators.ur_controller.safety_system import Safety
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Program
from actors.emulators.ur_controller.urscript.script_values import UrPose, number, numbers, show

SLOWEST, FASTEST = 1e-6, 1e4
"""Rates are taken as at least and at most this [rad/s], [m/s²] …: neither ever matters to an arm."""

LONGEST = 1e7
"""Times are taken as at most this [s]."""


def six(value: Any) -> Joints:
    """Six numbers, of a list or a pose."""
    a, b, c, d, e, f = numbers(value, 6)
    return a, b, c, d, e, f


def is_pose(value: Any) -> bool:
    """Whether it is p[…]."""
    return isinstance(value, UrPose)


def positive(value: Any, name: str) -> float:
    """A number above zero.

    Raises:
        ScriptError: it isn't.
    """
    result = number(value)
    if result <= 0.0:
        raise ScriptError(f"{name} must be positive, not {show(value)}")
    return result


def rate(value: Any, name: str) -> float:
    """A speed, an acceleration or a deceleration: positive, and within what can be computed with."""
    return min(max(positive(value, name), SLOWEST), FASTEST)


def whole(value: Any, low: int, high: int, name: str) -> int:
    """A whole number within limits, both included.

    Raises:
        ScriptError: it isn't.
    """
    result = number(value)
    if result != int(result) or not low <= result <= high:
        raise ScriptError(f"{name} must be {low} … {high}, not {show(value)}")
    return int(result)


class ControllerAccess(Protocol):
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
