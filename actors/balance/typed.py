"""Weights that people type: '12.34 g' → kilograms."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal

from actors.balance.units import KILOGRAMS, kilograms

_TYPED = re.compile(r"\s*(?P<number>[+−-]?\s*[0-9]+(?:[.,][0-9]+)?)\s*(?P<unit>[A-Za-zµ%]*)\s*")


@dataclass(frozen=True)
class TypedWeight:
    """A weight as typed.

    Attributes:
        mass: [kg].
        step: one of the last digit [kg]: as well as the scale was read.
    """

    mass: float
    step: float


def typed_weight(text: str) -> TypedWeight:
    """Understand a weight that somebody typed; the unit must be there, for a kilogram is not a gram.

    Args:
        text: a number with a point or a comma, and a unit.

    Raises:
        ValueError: anything else; says what would be right.
    """
    match = _TYPED.fullmatch(text)
    if match is None:
        raise ValueError(f"'{text.strip()}' is not a weight; type a number and a unit, for example '203.4 g'")
    number = Decimal(match["number"].replace(",", ".").replace("−", "-").replace(" ", ""))
    if not match["unit"]:
        raise ValueError(f"'{text.strip()}' has no unit; type '{number} g' if that is what is meant")
    factor = kilograms(match["unit"])
    if factor is None:
        raise ValueError(f"'{match['unit']}' is not a unit of mass that is known; there are {', '.join(KILOGRAMS)}")
    exponent = int(number.as_tuple().exponent)
    return TypedWeight(float(number) * factor, float(Decimal(1).scaleb(exponent)) * factor)
