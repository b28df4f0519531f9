"""What a balance says in one line, before anybody asks what it means for a pour."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from actors.balance.units import kilograms


class LineError(ValueError):
    """Bytes that are not a line of the dialect: damaged, half a line, or another dialect's."""


class Status(StrEnum):
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

    status: Status
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


class Answer(StrEnum):
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
    answer: Answer
    text: str = ""


Reply = Reading | Acknowledgement
"""A line that was understood."""
