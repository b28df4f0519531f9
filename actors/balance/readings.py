"""One line of a balance as a value, units of mass, and typed weights.

A line is a `Reading` or an `Acknowledgement`. For any other line, a decoder raises `OtherQuantityError` (a valid line
without the weight, such as a tare or a limit) or another `LineError`. `kilograms` converts units, and `typed_weight`
parses '12.34 g'. The meaning of a reading for a pour belongs to `weighing_plan`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from sim_engine.settings.quantity import LARGEST, split_typed, typed_number

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
grain, `dwt` the pennyweight, `ct` the metric carat. Exact by definition. The tonne is left out, so that a damaged `ct`
cannot become one."""


def kilograms(unit: str) -> float | None:
    """Mass of one unit [kg]; None if it is not a mass (pcs, %), or not a unique one (taels differ between cities).

    Args:
        unit: as a balance prints it, in any case.
    """
    return KILOGRAMS.get(unit.lower().replace("µ", "u"))


OTHER_UNITS = {
    **dict.fromkeys(("pcs", "pc", "stk"), "pieces"),
    **dict.fromkeys(("%", "pct"), "per cent"),
    **dict.fromkeys(("ds", "g/cm3"), "a density"),
    "/lb": "pieces per pound",
    "ml": "a volume",
}
"""Units of numbers that are no mass, in lower case, and what they count. No unit of mass that lost a letter is one of
them."""


IN_TURN = "it sends gross, net and tare in turn: set its print-out to the net weight alone"


def in_turn(masses: Sequence[float]) -> bool:
    """Whether the last nine masses [kg] are gross, net and tare in turn: three, of which one is a sum."""
    last = list(masses)[-9:]
    tare, net, gross = sorted(last[:3]) if len(last) == 9 else (0.0, 0.0, 0.0)
    return tare < gross and last[:3] == last[3:6] == last[6:] and abs(gross - net - tare) <= 2e-3 * abs(gross)


class LineError(ValueError):
    """Bytes that are not a line of the dialect: damaged, incomplete, or from another dialect."""


class OtherQuantityError(LineError):
    """A valid line that does not carry the weight. A driver ignores it.

    Args:
        what: its content, for messages: 'the tare', 'the upper limit of check weighing'.
        remedy: how to get the weight instead, if it is known.
    """

    def __init__(self, problem: str, remedy: str = "") -> None:
        super().__init__(f"{problem}, not a weight")
        self.what, self.remedy = problem, remedy


class ReadingStatus(StrEnum):
    """Status of the weight in a line."""

    STABLE = "stable"
    UNSTABLE = "unstable"
    OVER = "over range"
    UNDER = "under range"
    BUSY = "busy"
    """The balance executes a command, or did not become stable within its own time limit."""

    ERROR = "error"
    """The balance reports an internal fault."""

    SILENT = "silent"
    """No reply came; set by the driver, never by a line."""

    UNREADABLE = "not understood"
    """Lines came, but none with a weight; set by the driver, never by a line."""

    LOST = "lost"
    """No connection; set by the driver, never by a line."""


class WeightMark(StrEnum):
    """Which weight a line carries, if it says so."""

    NET = "net"
    GROSS = "gross"


@dataclass(frozen=True)
class Reading:
    """One weight as a balance sends it.

    Attributes:
        status: as reported by the balance.
        value: number as sent, decimals kept; None if none was sent.
        unit: as sent, '' if none was sent (some dialects leave it out while unstable).
        detail: further content of the line, e.g. an error's number.
        mark: whether the line is marked as net or gross; None if it is not marked.
    """

    status: ReadingStatus
    value: Decimal | None = None
    unit: str = ""
    detail: str = ""
    mark: WeightMark | None = None

    def mass(self, unit: str = "") -> float | None:
        """The weight [kg]; None without a number, or if its unit is not a mass.

        Args:
            unit: used if the line has none.
        """
        factor = kilograms(self.unit or unit)
        return None if self.value is None or factor is None else float(self.value) * factor

    def step(self, unit: str = "") -> float | None:
        """One unit of the last digit sent [kg]; the balance's display may step by 2 or 5 of them.

        Args:
            unit: used if the line has none.
        """
        factor = kilograms(self.unit or unit)
        if self.value is None or factor is None:
            return None
        exponent = self.value.as_tuple().exponent
        return float(Decimal(1).scaleb(int(exponent))) * factor

    def __str__(self) -> str:
        shown = "" if self.value is None else f"{self.value} {self.unit}".strip()
        return ", ".join(text for text in (shown, self.mark or "", str(self.status), self.detail) if text)


class ReadingReply(StrEnum):
    """Result in the reply to a command that is not a query for a weight."""

    DONE = "done"
    BEGUN = "begun"
    """The balance has understood the command; another reply follows."""

    BUSY = "busy"
    OVER = "over range"
    UNDER = "under range"
    REFUSED = "refused"


@dataclass(frozen=True)
class Acknowledgement:
    """Reply to a command.

    Attributes:
        command: the command, as the balance names it ('T', 'Z', '@'); '' if it names none.
        answer: the result.
        text: the rest of the line.
    """

    command: str
    answer: ReadingReply
    text: str = ""


Reply = Reading | Acknowledgement
"""A decoded line."""


@dataclass(frozen=True)
class TypedWeight:
    """A weight as typed.

    Attributes:
        mass: [kg].
        step: one unit of the last digit [kg]: the resolution of the typed number.
    """

    mass: float
    step: float


def typed_weight(text: str) -> TypedWeight:
    """Parse a typed weight; the unit is mandatory, because a wrong guess would be a factor of 1000.

    Args:
        text: a number with a point or a comma, and a unit.

    Raises:
        ValueError: any other text, a number with two meanings, or a weight that no bench has; the message gives a valid
            form.
    """
    digits, unit = split_typed(text)
    if not digits:
        raise ValueError(f"'{text.strip()}' is not a weight; type a number and a unit, for example '203.4 g'")
    if not unit:
        number = typed_number(digits)
        raise ValueError(f"'{text.strip()}' has no unit; type '{number} g' if that is what is meant")
    factor = kilograms(unit)
    if factor is None:
        raise ValueError(f"'{unit}' is not a unit of mass that is known; there are {', '.join(KILOGRAMS)}")
    number = typed_number(digits, unit, largest=LARGEST["kg"] / factor)
    exponent = int(number.as_tuple().exponent)
    return TypedWeight(float(number) * factor, float(Decimal(1).scaleb(exponent)) * factor)
