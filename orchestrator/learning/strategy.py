"""Interface between strategies and the scheduler: ask and tell.

- `Strategy` is the protocol that every strategy implements.
- `Progress` counts pours and simulations separately, because a pour takes about a hundred times as long as a
  simulation.
- `is_sound` rejects outcomes that are NaN or infinite, because one such value would corrupt a surrogate permanently.

This module does not run requests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from orchestrator.learning.requests import Outcome, Request, Slots
from orchestrator.learning.stage_result import StageResult
from sim_engine.outcome import Fractions


def plural(count: int, noun: str) -> str:
    """A count in words: '1 pour', '3 pours'."""
    return f"{count} {noun}{'s' * (count != 1)}"


@dataclass(frozen=True)
class Progress:
    """Number of requests answered and in total.

    Attributes:
        simulations, of_simulations: simulations answered, and in total; the total is at least those answered.
        pours, of_pours: pours made, and in total, likewise.
        limited: whether the totals are limits: the strategy ends as soon as no further request is worth its time.
    """

    simulations: int = 0
    of_simulations: int = 0
    pours: int = 0
    of_pours: int = 0
    limited: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "of_simulations", max(self.of_simulations, self.simulations))
        object.__setattr__(self, "of_pours", max(self.of_pours, self.pours))

    @property
    def simulations_left(self) -> int:
        """Number of simulations without an answer."""
        return max(self.of_simulations - self.simulations, 0)

    @property
    def pours_left(self) -> int:
        """Number of pours that are still to be made."""
        return max(self.of_pours - self.pours, 0)

    @property
    def done(self) -> int:
        """Requests of both kinds that are answered, for progress bars."""
        return self.simulations + self.pours

    @property
    def total(self) -> int:
        """Requests of both kinds in total, for progress bars."""
        return self.of_simulations + self.of_pours

    def __add__(self, other: Progress) -> Progress:
        return Progress(
            self.simulations + other.simulations,
            self.of_simulations + other.of_simulations,
            self.pours + other.pours,
            self.of_pours + other.of_pours,
            self.limited or other.limited,
        )

    def __str__(self) -> str:
        """'3/6 pours · 20/40 simulations', or with limits '3 of ≤6 pours' and at the end '4 pours'; a kind without
        requests is omitted."""
        kinds = ((self.pours, self.of_pours, "pour"), (self.simulations, self.of_simulations, "simulation"))
        return " · ".join(self._count(*kind) for kind in kinds if kind[1])

    def _count(self, made: int, total: int, noun: str) -> str:
        if not self.limited:
            return f"{made}/{plural(total, noun)}"
        return plural(total, noun) if made == total else f"{made} of ≤{plural(total, noun)}"


@runtime_checkable
class Strategy(Protocol):
    """A pure decision maker: no I/O, no clock, no Ray. The same seed, slots and outcomes lead to the same requests.

    The scheduler calls `ask` whenever slots are free, and `tell` once for every request. `ask` may return no requests
    while outcomes are pending. A strategy that is not finished, has no pending request and returns no request is an
    error.
    """

    @property
    def finished(self) -> bool:
        """Whether no request is left to make and none is pending."""
        ...

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next requests: at most `slots.simulations` simulations and `slots.pours` pours.

        Simulations that are returned together with a pour run at the same time as the pour.
        """
        ...

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a request."""
        ...

    def progress(self) -> Progress:
        """Requests done, and their total number."""
        ...

    def result(self) -> StageResult:
        """The result so far. It is shown live; the final result is stored in the journal and reported."""
        ...


def is_sound(fractions: Fractions) -> bool:
    """Whether all fractions are finite. A simulation that diverged or a faulty balance yields NaN or infinity."""
    return all(math.isfinite(value) for value in (fractions.poured, fractions.spilled, fractions.retained))
