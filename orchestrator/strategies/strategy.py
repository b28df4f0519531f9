"""The seam between deciding and doing: ask and tell.

How far a strategy is: pours and simulations apart, for one takes a hundred times as long as the other.

Whether the numbers of an outcome are numbers: what enters a surrogate once stays in all it says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from orchestrator.requests import Outcome, Request, Slots
from orchestrator.strategies.stage_result import StageResult
from sim_engine.outcome import Fractions


@dataclass(frozen=True)
class Progress:
    """Requests that count.

    Attributes:
        simulations, of_simulations: answered, and in all.
        pours, of_pours: made, and in all.
    """

    simulations: int = 0
    of_simulations: int = 0
    pours: int = 0
    of_pours: int = 0

    @property
    def simulations_left(self) -> int:
        """Simulations that are still to be answered."""
        return max(self.of_simulations - self.simulations, 0)

    @property
    def pours_left(self) -> int:
        """Pours that are still to be made."""
        return max(self.of_pours - self.pours, 0)

    @property
    def done(self) -> int:
        """Requests answered, of either kind, for bars."""
        return self.simulations + self.pours

    @property
    def total(self) -> int:
        """Requests in all, of either kind, for bars."""
        return self.of_simulations + self.of_pours

    def __add__(self, other: Progress) -> Progress:
        return Progress(
            self.simulations + other.simulations,
            self.of_simulations + other.of_simulations,
            self.pours + other.pours,
            self.of_pours + other.of_pours,
        )

    def __str__(self) -> str:
        """'3/6 pours · 20/40 simulations', without what there is none of."""
        parts = []
        if self.of_pours:
            parts.append(f"{self.pours}/{self.of_pours} pours")
        if self.of_simulations:
            parts.append(f"{self.simulations}/{self.of_simulations} simulations")
        return " · ".join(parts)


@runtime_checkable
class Strategy(Protocol):
    """A pure decision maker: no I/O, no clock, no Ray. Same seed, same slots and outcomes in → same requests out.

    The scheduler calls `ask` whenever slots are free and `tell` once for every request that was asked for. `ask`
    may answer with nothing while it waits for outcomes; a strategy that is neither finished nor waiting for an
    outcome and asks for nothing is an error.
    """

    @property
    def finished(self) -> bool:
        """Nothing more to ask, nothing more to wait for."""
        ...

    def ask(self, slots: Slots) -> list[Request]:
        """The next requests; at most `slots.simulations` simulations and `slots.pours` pours.

        While a pour is asked for together with simulations, these run beside it.
        """
        ...

    def tell(self, request: Request, outcome: Outcome) -> None:
        """What came of a request."""
        ...

    def progress(self) -> Progress:
        """What is done and what there is to do in all."""
        ...

    def result(self) -> StageResult:
        """What was learnt so far: shown live; at the end kept in the journal, and reported."""
        ...


def is_sound(fractions: Fractions) -> bool:
    """No fraction is NaN or infinite, as those of a simulation that diverged or of a balance that lost its mind."""
    return all(math.isfinite(value) for value in (fractions.poured, fractions.spilled, fractions.retained))
