"""The person at a virtual bench: does what questions ask, takes a person's time for it, and answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence

import numpy as np

from actors.bench.things import Things
from actors.operator import Question

SCATTER = 1e-3
"""Standard deviation of a filling by hand [kg]."""

TYPED_STEP = 1e-4
"""Of the scale that typed weights are read from [kg]."""

SHARES = {
    "pourer_full": 4.0,
    "set_up": 2.0,
    "receiver_empty": 2.0,
    "tray_wiped": 1.0,
    "tray_before": 2.0,
    "start": 1.0,
    "pourer_after": 2.0,
    "cleared_after": 1.0,
    "receiver_gone": 1.0,
    "tray_after": 1.0,
}
"""Of the time for one pour, by what is to be done; answering alone takes `GLANCE`."""

GLANCE = 0.02
"""Share of the time for one pour that an answer without work takes."""

Put = Callable[[float], Awaitable[None]]
"""Puts a mass [kg] on the virtual balance, in place of what was there."""


class VirtualOperator:
    """See `actors.operator.Operator`.

    Args:
        things: that it moves about.
        put: changes what is on the balance; None where there is none.
        time: for all of one pour [s of the clock].
        late: extra time [s of the clock] for the first question about something; inf: never answers.
        answers: given in place of its own, first to last, to questions about something.
    """

    def __init__(
        self,
        things: Things,
        put: Put | None,
        time: float,
        *,
        late: Mapping[str, float] | None = None,
        answers: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._things, self._put, self._time = things, put, time
        self._late = dict(late or {})
        self._answers = {about: list(given) for about, given in (answers or {}).items()}
        self._rng = np.random.default_rng(0)
        self._load = 0.0
        self.heard: list[Question] = []
        self.told: list[str] = []

    def prepare(self, load: float, seed: tuple[int, ...]) -> None:
        """The next pour begins.

        Args:
            load: to refill to [kg].
            seed: of its unsteady hand.
        """
        self._load, self._rng = load, np.random.default_rng(seed)

    async def ask(self, question: Question) -> str:
        """See `Operator.ask`."""
        self.heard.append(question)
        about = question.about
        late = self._late.pop(about, 0.0)
        if late == float("inf"):
            await asyncio.Event().wait()
        share = SHARES.get(about, GLANCE) / sum(SHARES.values()) if about in SHARES else GLANCE
        await asyncio.sleep(share * self._time + late)
        scripted = self._answers.get(about)
        if scripted:
            return scripted.pop(0)
        self._things.do(about, self._load + float(self._rng.normal(0.0, SCATTER)))
        if question.wants == "weight":
            return self._things.typed(about, TYPED_STEP)
        if self._put is not None:
            await self._put(self._things.carried)
        return "done" if question.wants == "done" else "yes"

    async def tell(self, text: str) -> None:
        """See `Operator.tell`."""
        self.told.append(text)
