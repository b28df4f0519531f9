"""What a balance can be asked. Values and a protocol; no driver."""

from __future__ import annotations

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


class BalanceDriver(Protocol):
    """What talks to one balance: plain and blocking; it is put into a process (or thread) of its own.

    `actors.contracts.balance` has the tests that every driver has to pass.
    """

    def connect(self) -> str:
        """Find out what is there.

        Returns:
            What was found, for people.

        Raises:
            LaboratoryError: nobody understandable is there.
        """
        ...

    def tare(self) -> None:
        """Wait until the balance is at rest and count what is on it as zero.

        Raises:
            LaboratoryError: not at rest in time, or lost.
        """
        ...

    def weigh(self) -> Weight:
        """Wait for a stable weight. After a lost connection it refuses until `keep_reference` or another tare.

        Raises:
            ReferenceLostError: the balance may have been off since the last tare, and begun at a new zero.
            LaboratoryError: no stable weight in time, or lost; the text is for the person beside it.
        """
        ...

    def read(self) -> Weight:
        """What the display shows now, stable or not; never fails, and doesn't wait for a call that is under way."""
        ...

    def keep_reference(self) -> None:
        """After a lost connection: a person has seen that the tare still holds."""
        ...

    def interrupt(self) -> None:
        """End the wait that is under way with a LaboratoryError, and later ones at once, until `resume`."""
        ...

    def resume(self) -> None:
        """Let waits last again."""
        ...

    def close(self) -> None:
        """Let go of it; never fails, and may be called again."""
        ...
