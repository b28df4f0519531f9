"""The values of a program: numbers, strings, lists and poses, with a controller's arithmetic and functions.

Integers have 32 bits, and lists a maximum length. A program can therefore not fill memory with one long list or number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from math import fmod, isfinite
from typing import Any

from actors.emulators.ur_controller.urscript.lexer import ScriptError

LONGEST_SHOWN = 1023
"""Maximum length of a shown text [characters], as on a controller."""

MOST_ENTRIES = 10_000
"""Maximum number of entries of a list, including those of nested lists."""


class UrPose(list[float]):
    """p[x, y, z, rx, ry, rz]: a list that motion commands recognise as a pose."""

    __slots__ = ()


def pose(items: list[Any]) -> UrPose:
    """Return a pose of six numbers."""
    return UrPose(number(item) for item in items)


def number(value: Any) -> float:
    """Return a finite number.

    Raises:
        ScriptError: it is not one.
    """
    if not isinstance(value, int | float) or not isfinite(value):
        raise ScriptError(f"expected a number, found {show(value)}")
    return float(value)


def numbers(value: Any, count: int) -> list[float]:
    """Return a list of finite numbers.

    Raises:
        ScriptError: it is not a list of that length, or not of numbers.
    """
    if not isinstance(value, list) or len(value) != count:
        raise ScriptError(f"expected {count} numbers, found {show(value)}")
    return [number(item) for item in value]


def copy(value: Any) -> Any:
    """Return a copy of a list; lists have value semantics."""
    if isinstance(value, list):
        fresh = [copy(item) if isinstance(item, list) else item for item in value]
        return UrPose(fresh) if isinstance(value, UrPose) else fresh
    return value


def size(value: Any) -> int:
    """Number of entries of a value, including those of nested lists; 0 for anything but a list.

    Raises:
        ScriptError: there are too many.
    """
    count = len(value) + sum(size(item) for item in value if isinstance(item, list)) if isinstance(value, list) else 0
    if count > MOST_ENTRIES:
        raise ScriptError(f"a list of more than {MOST_ENTRIES} entries")
    return count


def index(value: Any) -> int:
    """Return a list's index.

    Raises:
        ScriptError: not an integer, or negative.
    """
    if not isinstance(value, int) or value < 0:
        raise ScriptError(f"{show(value)} is not an index")
    return int(value)


def show(value: Any) -> str:
    """Format a value for a message or log."""
    if isinstance(value, list):
        text = "[" + ", ".join(show(item) for item in value[:50]) + "]"
        return "p" + text if isinstance(value, UrPose) else text
    if isinstance(value, float):
        return f"{value:.7g}"
    return str(value)[:LONGEST_SHOWN]


def _whole(value: Any) -> Any:
    """Wrap an integer to 32 bits; other values are unchanged."""
    if isinstance(value, int) and not -0x80000000 <= value <= 0x7FFFFFFF:
        return (value + 0x80000000) % 0x100000000 - 0x80000000
    return value


def _pair(a: Any, b: Any, operator: str) -> None:
    if not isinstance(a, int | float) or not isinstance(b, int | float):
        raise ScriptError(f"can't compute {show(a)} {operator} {show(b)}")


def add(a: Any, b: Any) -> Any:
    """a + b."""
    _pair(a, b, "+")
    return _whole(a + b)


def subtract(a: Any, b: Any) -> Any:
    """a − b."""
    _pair(a, b, "-")
    return _whole(a - b)


def multiply(a: Any, b: Any) -> Any:
    """a · b."""
    _pair(a, b, "*")
    return _whole(a * b)


def divide(a: Any, b: Any) -> Any:
    """a / b, never rounded."""
    _pair(a, b, "/")
    if b == 0:
        raise ScriptError("division by zero")
    return a / b


def modulo(a: Any, b: Any) -> Any:
    """a % b with the sign of a."""
    _pair(a, b, "%")
    if b == 0:
        raise ScriptError("division by zero")
    if isinstance(a, int) and isinstance(b, int):
        return int(fmod(a, b))
    return fmod(a, b)


def negate(a: Any) -> Any:
    """−a."""
    _pair(a, 0, "-")
    return _whole(-a)


def norm(a: Any) -> float:
    """Return the length of a list, or the absolute value of a number."""
    if isinstance(a, list):
        return math.sqrt(sum(number(x) ** 2 for x in a))
    return abs(number(a))


def length(v: Any) -> int:
    """Return the number of entries of a list."""
    if not isinstance(v, list):
        raise ScriptError(f"{show(v)} is not a list")
    return len(v)


def _unary(function: Callable[[float], float]) -> Callable[[Any], Any]:
    return lambda f: function(number(f))


FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: _unary(getattr(math, name)) for name in ("sin", "cos", "sqrt")},
    "abs": lambda f: abs(number(f)),
    "norm": norm,
    "length": length,
}
"""Commands that only compute, by name; they are the same for every controller."""
