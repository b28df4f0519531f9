"""Actions and constraints written as text.

- `set_action` and `assigned_action` parse assignments from the command line: `angular_velocity=40`, `x_offset='90 mm'`.
- `parse_constraint` parses a constraint between searched dimensions from a file: 'x_offset >= 60 mm + 0.5 * height'.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from actors.optimizer.questions import Linear
from orchestrator.campaigns.search_ranges import dimension_quantity
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.errors import DecantError, did_you_mean
from sim_engine.search_space import Space
from sim_engine.settings.quantity import KINDS, QuantityError, parse_quantity


class AssignmentError(DecantError, ValueError):
    """Values of an action are invalid; one line per invalid value."""


def set_action(
    assignments: Iterable[str], *, fixed: Mapping[str, float | None] | None = None, space: Space | None = None
) -> dict[str, float | None]:
    """Action values of assignments such as 'angular_velocity=40' or 'x_offset=90 mm', SI.

    A number without unit is in the display unit of the dimension (deg, deg/s, deg/s^2, mm, s).

    Args:
        assignments: `name=value` texts.
        fixed: values that need no assignment (a scene's).
        space: searched dimensions. Those that are neither fixed nor assigned are missing, and the message explains how
            to give them.

    Returns:
        `fixed`, updated with the assignments.

    Raises:
        AssignmentError: unknown dimension, no value, wrong unit, out of bounds, given twice, or missing.
    """
    values: dict[str, float | None] = dict(fixed or {})
    problems: list[str] = []
    seen: set[str] = set()
    for text in assignments:
        name, equals, value = (word.strip() for word in text.partition("="))
        if not equals or not value:
            problems.append(f"{text!r}: should be name=value, for example x_offset=90")
            continue
        if name not in ACTION_DIMENSIONS:
            guess = did_you_mean(name, ACTION_DIMENSIONS)
            hint = f"did you mean '{guess}'?" if guess else f"known are {', '.join(ACTION_DIMENSIONS)}"
            problems.append(f"{text!r}: unknown dimension '{name}'; {hint}")
            continue
        if name in seen:
            problems.append(f"{text!r}: '{name}' is given twice; keep one")
        seen.add(name)
        try:
            values[name] = _parse(name, value)
        except QuantityError as error:
            problems.append(f"{text!r}: {error}")
    if not problems:
        needed = ("angular_velocity", "x_offset", "height") + (() if space is None else space.names)
        for name in dict.fromkeys(needed):
            if name not in values:
                problems.append(f"{name} has no value; add for example --set {name}={_example(name, space)}")
    if problems:
        raise AssignmentError("\n".join(problems))
    return values


def assigned_action(
    assignments: Iterable[str], *, fixed: Mapping[str, float | None] | None = None, space: Space | None = None
) -> Action:
    """The complete action with the values of `set_action`.

    Raises:
        AssignmentError: as `set_action`.
    """
    values = set_action(assignments, fixed=fixed, space=space)
    return Action.compose(values, {})


def _parse(name: str, value: str) -> float | None:
    dimension = ACTION_DIMENSIONS[name]
    quantity = dimension_quantity(dimension, words=True)
    try:
        float(value)
    except ValueError:
        text = value
    else:
        text = f"{value} {dimension.display_unit}"
    parsed = quantity.parse(text)
    return None if isinstance(parsed, str) and parsed == dimension.switched_off else float(parsed)


def _example(name: str, space: Space | None) -> str:
    dimension = ACTION_DIMENSIONS[name]
    axis = next((axis for axis in (() if space is None else space.axes) if axis.name == name), None)
    middle = (
        axis.decode(0.5) if axis is not None else {"rad/s": 0.698, "m": 0.09}.get(dimension.unit, dimension.upper / 2)
    )
    return f"{middle / dimension.factor:.3g}"


EXAMPLE = "x_offset >= 60 mm + 0.5 * height"

_RELATION = re.compile(r"<=|>=|≤|≥")
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_WORD = r"[^\W\d][\w°]*(?:/\w+(?:\^\d)?)?"
_TERM = re.compile(rf"\s*(?P<sign>[-+−])?\s*(?P<number>{_NUMBER})?\s*(?P<times>\*)?\s*(?P<word>{_WORD})?\s*")


def parse_constraint(text: str, space: Space) -> Linear:
    """A constraint on the values of a space's axes.

    Args:
        text: two sums of terms with '<=' or '>=' between them. A term is a quantity, or a searched dimension with or
            without a factor. All terms are of one kind: lengths, angles, …
        space: the space whose axes may occur.

    Raises:
        QuantityError: the text is not a constraint; the message gives a correct form.
    """
    sides = _RELATION.split(text)
    if len(sides) != 2:
        raise QuantityError(f"{text!r} should have one '<=' or '>=', for example '{EXAMPLE}'")
    greater = _RELATION.findall(text)[0] in (">=", "≥")
    weights: dict[str, float] = {}
    constants: list[tuple[float, str, str]] = []
    for side, outer in zip(sides, (-1.0, 1.0) if greater else (1.0, -1.0), strict=True):
        for sign, number, word in _terms(side, text):
            if word in ACTION_DIMENSIONS:
                weights[word] = weights.get(word, 0.0) + outer * sign * (1.0 if number is None else float(number))
            else:
                constants.append((outer * sign, number or "", word))
    weights = {name: weight for name, weight in weights.items() if weight}
    unit, example = _kind(text, weights, constants, space)
    upper = 0.0
    for sign, number, word in constants:
        if number and float(number) == 0.0 and not word:
            continue
        upper -= sign * parse_quantity(f"{number} {word}".strip(), unit, example)
    return Linear(tuple(weights.items()), upper)


def _terms(side: str, text: str) -> list[tuple[float, str | None, str]]:
    """Sign, number and word (a dimension or a unit) of each term of a sum."""
    terms: list[tuple[float, str | None, str]] = []
    at = 0
    while at < len(side) or not terms:
        match = _TERM.match(side, at)
        number, word = (match["number"], match["word"] or "") if match else (None, "")
        missing = match is None or (number is None and not word) or (terms and match["sign"] is None)
        if match is None or missing or (match["times"] and (number is None or not word)):
            raise QuantityError(f"{text!r} is not understood at {side[at:].strip()!r}; for example '{EXAMPLE}'")
        terms.append((-1.0 if match["sign"] in ("-", "−") else 1.0, number, word))
        at = match.end()
    return terms


def _kind(
    text: str, weights: Mapping[str, float], constants: list[tuple[float, str, str]], space: Space
) -> tuple[str, str]:
    """Unit of all terms, and a right quantity for messages."""
    for _, number, word in constants:
        if not number:  # Unit of all terms, and a valid quantity for messages.
            guess = did_you_mean(word, list(ACTION_DIMENSIONS))
            meant = f"did you mean '{guess}'?" if guess else f"dimensions are {', '.join(ACTION_DIMENSIONS)}"
            raise QuantityError(f"unknown dimension {word!r} in {text!r}; {meant}")
    if not weights:
        raise QuantityError(f"{text!r} says nothing about a dimension, for example '{EXAMPLE}'")
    for name in weights:
        if name not in space.names:
            raise QuantityError(f"{name} is not searched here; constraints can be on {', '.join(space.names)}")
    first = ACTION_DIMENSIONS[next(iter(weights))]
    for name in weights:
        if (unit := ACTION_DIMENSIONS[name].unit) != first.unit:
            kinds = f"{KINDS[unit]} ({name}) to {KINDS[first.unit]} ({first.name})"
            raise QuantityError(f"{text!r} adds {kinds}; all terms should be of one kind")
    return first.unit, f"60 {first.display_unit}"
