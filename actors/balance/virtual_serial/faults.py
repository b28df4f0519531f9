"""What may go wrong with a virtual balance, and how it then shows on display and line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from actors.balance.reading import Reading, Status
from actors.balance.virtual_serial.scale import Scale


@dataclass(frozen=True)
class Faults:
    """Faults in force; all off at first.

    Attributes:
        silent: says nothing and hears nothing.
        frozen: the display stands as it was when this began, load and tare notwithstanding.
        restless: never stable.
        powerless: acknowledges tare and zero, and does nothing.
        fault: reports this error instead of weights.
        stranger: understands no question, and says so where its dialect has words for it.
        unit: shown instead of its own, e.g. 'pcs'.
        garbage: share of lines that noise is mixed into.
        halved: share of lines that lose their first half.
        unasked: prints by itself every so many seconds of the clock; 0: never.
        interleaved: unasked lines may cut answers in two.
        delay: answers come so much later [s of the clock].
    """

    silent: bool = False
    frozen: bool = False
    restless: bool = False
    powerless: bool = False
    stranger: bool = False
    fault: str = ""
    unit: str = ""
    garbage: float = 0.0
    halved: float = 0.0
    unasked: float = 0.0
    interleaved: bool = False
    delay: float = 0.0


class FaultyDisplay:
    """A scale's display with faults. See `voice.Display`."""

    def __init__(self, scale: Scale) -> None:
        self.scale = scale
        self.faults = Faults()
        self._frozen: Reading | None = None

    def set(self, changes: dict[str, Any]) -> None:
        """Change faults by name; others stay."""
        self.faults = replace(self.faults, **changes)
        self._frozen = (self._frozen or self.reading()) if self.faults.frozen else None

    def reading(self) -> Reading:
        """What the display shows."""
        if self._frozen is not None:
            return self._frozen
        if self.faults.fault:
            return Reading(Status.ERROR, detail=f"error {self.faults.fault}")
        reading = self.scale.reading()
        if self.faults.restless and reading.status is Status.STABLE:
            reading = replace(reading, status=Status.UNSTABLE)
        return replace(reading, unit=self.faults.unit) if self.faults.unit and reading.unit else reading

    def tare(self) -> Status:
        """See `Scale.tare`."""
        return Status.STABLE if self.faults.powerless else self.scale.tare()

    def zero(self) -> Status:
        """See `Scale.zero`."""
        return Status.STABLE if self.faults.powerless else self.scale.zero()


def spoil(line: bytes, faults: Faults, rng: np.random.Generator) -> bytes:
    """A line as it comes off a bad cable.

    Args:
        line: as said.
        faults: in force.
        rng: of chance.
    """
    if rng.random() < faults.halved:
        line = line[len(line) // 2 :]
    if rng.random() < faults.garbage:
        at = int(rng.integers(0, len(line) + 1))
        line = line[:at] + rng.bytes(int(rng.integers(1, 12))) + line[at:]
    return line
