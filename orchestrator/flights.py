"""What is under way in a stage: requests that were asked for and whose outcome was not told yet."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

from orchestrator.requests import Ask, Order, Outcome, Pour, Request, Simulate, Slots, Suggest

_LOGICAL_ORDER: dict[type[Request], int] = {Suggest: 0, Ask: 0, Simulate: 1, Pour: 2}
"""What is told first when several are under way: quick things before slow ones, so that a free slot is never kept
waiting for the strategy's next idea."""


@dataclass
class Flight:
    """One request that is under way.

    Attributes:
        record: whether a simulation keeps its frames.
        attempt: how often a pour has been begun, this time included.
        started: something may have happened because of it.
        finished: place in the order of finishing, from 1; 0 while there is no outcome.
        task: that runs it; None if its outcome was read from the journal.
    """

    id: int
    request: Request
    record: bool = False
    attempt: int = 1
    started: bool = False
    finished: int = 0
    outcome: Outcome | None = None
    task: asyncio.Task[None] | None = None

    @property
    def running(self) -> bool:
        """A task is busy with it."""
        return self.task is not None and not self.task.done()


def is_recorded(number: int, recordings: int) -> bool:
    """Whether the `number`-th simulation of a stage (from 1) keeps its frames: the 1st, 2nd, 4th, 8th, … until
    `recordings` have been kept, so that early and late ones are seen whatever the budget."""
    return number.bit_count() == 1 and number.bit_length() <= recordings


def free_slots(flights: Sequence[Flight], capacity: int) -> Slots:
    """Capacity minus what was asked for and not yet told: the same wherever and however fast it runs."""
    simulations = sum(isinstance(f.request, Simulate) for f in flights)
    pours = sum(isinstance(f.request, Pour) for f in flights)
    return Slots(max(capacity - simulations, 0), max(1 - pours, 0))


def next_to_tell(flights: Sequence[Flight], order: Order) -> Flight | None:
    """The flight whose outcome the strategy is told next, if there is one already; None: wait."""
    if order == "completion":
        return min((f for f in flights if f.outcome is not None), key=lambda f: f.finished, default=None)
    first = min(flights, key=lambda f: (_LOGICAL_ORDER[type(f.request)], f.id), default=None)
    return first if first is not None and first.outcome is not None else None
