"""Commands that only compute."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command
from actors.emulators.ur_controller.urscript.script_values import LONGEST_STRING, number, show


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


def str_cat(a: Any, b: Any) -> str:
    """Concatenate two strings."""
    joined = show(a) + show(b)
    if len(joined) > LONGEST_STRING:
        raise ScriptError(f"a string of more than {LONGEST_STRING} characters")
    return joined


def make_list(count: Any, value: Any, capacity: Any = 0) -> list[Any]:
    """Return a list of equal entries."""
    entries = int(number(count))
    if not 0 <= entries <= 10_000:
        raise ScriptError("a list has 0 … 10000 entries")
    return [value] * entries


def _unary(function: Callable[[float], float]) -> Callable[[Any], Any]:
    return lambda f: function(number(f))


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: _unary(getattr(math, name)) for name in ("sin", "cos", "tan", "sqrt", "floor", "ceil")},
    "abs": lambda f: abs(number(f)),
    "pow": lambda base, exponent: math.pow(number(base), number(exponent)),
    "norm": norm,
    "length": length,
    "make_list": make_list,
    "str_cat": str_cat,
    "to_str": show,
}

COMMANDS = {name: Command(function) for name, function in _FUNCTIONS.items()}
"""Commands by name; they are the same for every controller."""
