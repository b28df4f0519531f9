"""What a pool knows of one of its simulators: whether it is up, and the jobs that were sent to it."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from actors.simulation.actor import Greeting
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask


@dataclass(eq=False)
class Job:
    """A simulation that somebody waits for.

    Attributes:
        task: packed, without paths.
        meshes: Ray's references of its meshes.
        future: gets the result, or the reason why there is none.
        deaths: simulators that died over it.
    """

    task: PourTask
    meshes: Sequence[Any]
    future: asyncio.Future[SimulatedPour]
    deaths: int = 0

    def fail(self, error: Exception) -> None:
        """Say why there is no result."""
        if not self.future.done():
            self.future.set_exception(error)


@dataclass(eq=False)
class Sent:
    """A job at a simulator.

    Attributes:
        number: of this sending; no two have the same.
        recalled: nobody wants this answer any more: cancelled, or given to another simulator.
    """

    job: Job
    number: int
    recalled: bool = False


@dataclass(eq=False)
class Member:
    """A simulator actor. A number is used once, so that the dead are not taken for the living.

    Attributes:
        greeted: done when its process is up, or will not be.
        sent: jobs in the order in which it does them; the first one is under way.
        overdue: fires when the first job takes too long.
        begun: when the first job began, by the event loop's clock [s].
    """

    number: int
    actor: Any
    greeted: asyncio.Future[Greeting]
    sent: deque[Sent] = field(default_factory=deque)
    overdue: asyncio.TimerHandle | None = None
    begun: float = 0.0

    @property
    def greeting(self) -> Greeting | None:
        """None unless its process is up."""
        done = self.greeted.done() and not self.greeted.cancelled() and self.greeted.exception() is None
        return self.greeted.result() if done else None

    @property
    def spare(self) -> Sent | None:
        """The last job, if it can't have begun and is still wanted."""
        return self.sent[-1] if len(self.sent) > 1 and not self.sent[-1].recalled else None

    def drop_timer(self) -> None:
        """The first job is no longer timed."""
        if self.overdue is not None:
            self.overdue.cancel()
            self.overdue = None


def look_away(answer: asyncio.Future[Any]) -> None:
    """Take note of a late answer, so that asyncio does not complain that nobody did."""
    if not answer.cancelled():
        answer.exception()
