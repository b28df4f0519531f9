"""What was last seen on a balance's display: its weight, its unit where lines leave it out, its step."""

from __future__ import annotations

import math
import time

from actors.balance.protocol import Weight
from actors.balance.reading import Reading, Status
from actors.balance.units import kilograms


class Display:
    """Remembers readings.

    Args:
        step: of the display [kg], where it is not one of the last digit sent.
    """

    def __init__(self, step: float | None = None) -> None:
        self._given = step
        self._unit = ""
        self.step = step or 0.0
        """Step of the display [kg]; 0 while it is not known."""
        self.last = Weight(math.nan, False, 0.0, str(Status.LOST))
        """Last reading."""

    def note(self, reading: Reading, moment: float) -> None:
        """Take note of a reading.

        Args:
            reading: as the balance sent it.
            moment: when it came [s].
        """
        if kilograms(reading.unit) is not None:
            self._unit = reading.unit
        step = reading.step(self._unit)
        if self._given is None and step is not None:
            self.step = step
        mass = reading.mass(self._unit)
        shown = "" if reading.value is None else f"{reading.value} {reading.unit or self._unit}".strip()
        self.last = Weight(
            math.nan if mass is None else mass,
            reading.status is Status.STABLE and mass is not None,
            moment,
            str(reading.status),
            self.step,
            shown or (self.last.shown if reading.status is Status.SILENT else str(reading)),
        )

    def lose(self) -> None:
        """The connection is gone; what was last shown is kept for messages."""
        self.last = Weight(math.nan, False, time.monotonic(), str(Status.LOST), self.step, self.last.shown)

    def in_grams(self, mass: float) -> str:
        """A mass with the display's digits.

        Args:
            mass: [kg].
        """
        digits = max(0, -math.floor(math.log10(1e3 * self.step) + 1e-9)) if self.step > 0.0 else 3
        return f"{1e3 * mass:.{digits}f} g"
