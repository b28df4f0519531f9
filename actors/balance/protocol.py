"""What a balance can be asked. Values and a protocol; no driver."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Weight:
    """A reading.

    Attributes:
        mass: net of the tare [kg]; nan where the display shows none (`read` only).
        stable: the balance vouches for it; only stable weights count as measurements.
        time: of the reading [s]: bench time of a virtual balance in this process, `time.monotonic` of one on a serial
            line.
        status: 'stable', 'unstable', 'over range', 'under range', 'busy', 'error', 'silent' or 'lost'.
        step: of the display [kg]; 0 where it is not known.
        shown: as the balance sent it, e.g. '12.34 g'.
    """

    mass: float
    stable: bool
    time: float
    status: str = ""
    step: float = 0.0
    shown: str = ""


class Balance(Protocol):
    """A laboratory balance with a tray."""

    async def tare(self) -> None:
        """Wait until the balance is at rest and count what is on it as zero.

        Raises:
            LaboratoryError: not at rest in time, or lost.
        """
        ...

    async def weigh(self) -> Weight:
        """Wait for a stable weight.

        Raises:
            LaboratoryError: no stable weight in time, or lost.
        """
        ...

    async def read(self) -> Weight:
        """What the display shows now, stable or not; answered at once."""
        ...

    def stream(self, interval: float = 0.1) -> AsyncIterator[Weight]:
        """What the display shows, again and again.

        Args:
            interval: wall time between two readings [s].
        """
        ...
