"""Reading what a program passes."""

from __future__ import annotations

from typing import Any

from actors.ur.models import Joints
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.values import Pose, number, numbers, show

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
    return isinstance(value, Pose)


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
