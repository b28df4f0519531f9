"""Constraints between the searched dimensions of an action, as written in files: 'x_offset >= 60 mm + 0.5 * height'."""

from __future__ import annotations

import re
from collections.abc import Mapping

from actors.optimizer.core.problem import Linear
from orchestrator.config.yaml.errors import did_you_mean
from orchestrator.config.yaml.quantities import KINDS, QuantityError, parse_quantity
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.space import Space

EXAMPLE = "x_offset >= 60 mm + 0.5 * height"

_RELATION = re.compile(r"<=|>=|≤|≥")
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_WORD = r"[^\W\d][\w°]*(?:/\w+(?:\^\d)?)?"
_TERM = re.compile(rf"\s*(?P<sign>[-+−])?\s*(?P<number>{_NUMBER})?\s*(?P<times>\*)?\s*(?P<word>{_WORD})?\s*")


def parse_constraint(text: str, space: Space) -> Linear:
    """A constraint on the values of a space's axes.

    Args:
        text: two sums of terms with '<=' or '>=' between them; a term is a quantity, or a dimension that is searched,
            with a factor or without one. All terms are of one kind: lengths, angles, …
        space: whose axes they may name.

    Raises:
        QuantityError: it is none; the message says what would be right.
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
    found: list[tuple[float, str | None, str]] = []
    at = 0
    while at < len(side) or not found:
        match = _TERM.match(side, at)
        number, word = (match["number"], match["word"] or "") if match else (None, "")
        missing = match is None or (number is None and not word) or (found and match["sign"] is None)
        if match is None or missing or (match["times"] and (number is None or not word)):
            raise QuantityError(f"{text!r} is not understood at {side[at:].strip()!r}; for example '{EXAMPLE}'")
        found.append((-1.0 if match["sign"] in ("-", "−") else 1.0, number, word))
        at = match.end()
    return found


def _kind(
    text: str, weights: Mapping[str, float], constants: list[tuple[float, str, str]], space: Space
) -> tuple[str, str]:
    """Unit of all terms, and a right quantity for messages."""
    for _, number, word in constants:
        if not number:  # a word that stands alone should have been a dimension
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
