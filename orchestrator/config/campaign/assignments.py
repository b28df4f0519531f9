"""Actions from the command line: `angular_velocity=40`, `x_offset='90 mm'`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from orchestrator.config.motion import dimension_quantity
from orchestrator.config.yaml.errors import did_you_mean
from orchestrator.config.yaml.quantities import QuantityError
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.errors import DecantError
from sim_engine.space import Space


class AssignmentError(DecantError, ValueError):
    """Values of an action can't be used; one line per value that is wrong."""


def set_action(
    assignments: Iterable[str], *, fixed: Mapping[str, float | None] | None = None, space: Space | None = None
) -> dict[str, float | None]:
    """Action values of assignments such as 'angular_velocity=40' or 'x_offset=90 mm', SI.

    A bare number is in the unit that the dimension is shown in (deg, deg/s, deg/s^2, mm, s).

    Args:
        assignments: `name=value` texts.
        fixed: values that need no assignment (a scene's).
        space: searched dimensions: those that are neither fixed nor assigned are missing, and the message says how
            to give them.

    Returns:
        `fixed` with the assignments over it.

    Raises:
        AssignmentError: unknown dimension, no value, wrong unit, out of bounds, given twice, or missing.
    """
    values: dict[str, float | None] = dict(fixed or {})
    problems: list[str] = []
    seen: set[str] = set()
    for text in assignments:
        name, equals, value = (part.strip() for part in text.partition("="))
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
    """The complete action of `set_action`'s values.

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
