"""What a balance says in one line, before anybody asks what it means for a pour.

Units that balances print, in kilograms.

Weights that people type: '12.34 g' → kilograms.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

KILOGRAMS = {
    "kg": 1.0,
    "g": 1e-3,
    "mg": 1e-6,
    "ug": 1e-9,
    "ct": 2e-4,
    "lb": 0.45359237,
    "oz": 0.028349523125,
    "ozt": 0.0311034768,
    "dwt": 0.00155517384,
    "gn": 6.479891e-5,
}
"""Mass of one unit [kg], by its name in lower case: pounds and ounces avoirdupois, `ozt` the troy ounce, `gn` the
grain, `dwt` the pennyweight, `ct` the metric carat. Exact by definition. No tonne: a
damaged `ct` must not become one."""


def kilograms(unit: str) -> float | None:
    """Mass of one unit [kg]; None where it is not a mass (pcs, %), or no single one (taels differ between cities).

    Args:
        unit: as a balance prints it, in any case.
    """
    return KILOGRAMS.get(unit.lower().replace("µ", "u"))


class LineError(ValueError):
    """Bytes that are not a line of the dialect: damaged, half a line, or another dialect's."""


class ReadingStatus(StrEnum):
    """What a line says about the weight in it."""

    STABLE = "stable"
    UNSTABLE = "unstable"
    OVER = "over range"
    UNDER = "under range"
    BUSY = "busy"
    """Carrying out a command, or not at rest in the time that it allows itself."""

    ERROR = "error"
    """The balance reports a fault of its own."""

    SILENT = "silent"
    """No answer came; only the driver says this, no line does."""

    LOST = "lost"
    """No connection; only the driver says this."""


@dataclass(frozen=True)
class Reading:
    """One weight as a balance sends it.

    Attributes:
        status: what the balance says about it.
        value: number as sent, decimals kept; None where none was sent.
        unit: as sent, '' where none was sent (some dialects leave it out while unstable).
        detail: what else stood in the line, e.g. an error's number.
    """

    status: ReadingStatus
    value: Decimal | None = None
    unit: str = ""
    detail: str = ""

    def mass(self, unit: str = "") -> float | None:
        """The weight [kg]; None without a number, or where its unit is not a mass.

        Args:
            unit: taken where the line has none.
        """
        factor = kilograms(self.unit or unit)
        return None if self.value is None or factor is None else float(self.value) * factor

    def step(self, unit: str = "") -> float | None:
        """One of the last digit sent [kg]; the balance's display may step by 2 or 5 of them.

        Args:
            unit: taken where the line has none.
        """
        factor = kilograms(self.unit or unit)
        if self.value is None or factor is None:
            return None
        exponent = self.value.as_tuple().exponent
        return float(Decimal(1).scaleb(int(exponent))) * factor

    def __str__(self) -> str:
        shown = "" if self.value is None else f"{self.value} {self.unit}".strip()
        return ", ".join(part for part in (shown, str(self.status), self.detail) if part)


class ReadingReply(StrEnum):
    """How a balance answers a command that is not a question for a weight."""

    DONE = "done"
    BUSY = "busy"
    OVER = "over range"
    UNDER = "under range"
    REFUSED = "refused"


@dataclass(frozen=True)
class Acknowledgement:
    """Answer to a command.

    Attributes:
        command: that is answered, as the balance names it ('T', 'Z', '@'); '' where it names none.
        answer: what became of it.
        text: what it said beside.
    """

    command: str
    answer: ReadingReply
    text: str = ""


Reply = Reading | Acknowledgement
"""A line that was understood."""


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
