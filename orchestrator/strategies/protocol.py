"""The seam between deciding and doing: ask and tell."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from orchestrator.requests import Outcome, Request, Slots
from orchestrator.strategies.learnt import Learnt
from orchestrator.strategies.progress import Progress


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

    def result(self) -> Learnt:
        """What was learnt so far: shown live; at the end kept in the journal, and reported."""
        ...
