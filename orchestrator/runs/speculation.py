"""Simulations made before they are asked for, while the pool has nothing else to do.

A simulation is a value: the same request gives the same outcome whenever it is made. So what a later stage will ask for
can be simulated while the arm pours, and is there when it is asked for. Nothing that is decided depends on it: what was
foreseen wrongly is thrown away, and the journal knows only what strategies asked for.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial

from orchestrator.requests import Failed, Outcome, Simulate, Simulated

KEPT = 2000
"""Outcomes that wait to be asked for; beyond that nothing more is made ahead."""


class SpeculativeExecution:
    """Outcomes of simulations that nobody has asked for yet, and those that are being made.

    Whatever is asked for comes first: a simulation that was only foreseen is given up where its simulator is needed,
    and made again when there is room.

    Args:
        simulate: makes one simulation; cancelling gives it up.
        width: simulations that run at a time, those that were asked for included.

    Attributes:
        changed: told how many are being made, and how many are known and wait to be asked for.
    """

    def __init__(self, simulate: Callable[[Simulate], Awaitable[Outcome]], width: int) -> None:
        self._simulate = simulate
        self._width = width
        self._waiting: deque[Simulate] = deque()
        self._running: dict[Simulate, asyncio.Task[Outcome]] = {}
        self._known: dict[Simulate, Outcome] = {}
        self._promised: dict[Simulate, asyncio.Future[Outcome | None]] = {}
        self._asked_for = 0
        self._told = (0, 0)
        self.changed: Callable[[int, int], None] = lambda running, waiting: None
        self.made = 0
        self.used = 0

    def foresee(self, request: Simulate) -> None:
        """Make this simulation as soon as a simulator has nothing else to do."""
        if request in self._known or request in self._running or request in self._waiting:
            return
        if len(self._known) + len(self._waiting) < KEPT:
            self._waiting.append(request)
            self._fill()

    async def outcome(self, request: Simulate) -> Outcome | None:
        """What a foreseen simulation came to, once it has been made; it stays known. None: it came to nothing."""
        self.foresee(request)
        if request in self._known:
            return self._known[request]
        if request not in self._running and request not in self._waiting:
            return None
        promise = self._promised.setdefault(request, asyncio.get_running_loop().create_future())
        return await asyncio.shield(promise)

    def knows(self, request: Simulate) -> bool:
        """Whether this request need not be made anew."""
        return request in self._known or request in self._running

    async def take(self, request: Simulate) -> Outcome | None:
        """The outcome of a simulation that is asked for now, if it was foreseen; None: it has to be made."""
        if (known := self._known.pop(request, None)) is not None:
            self.used += 1
            self._fill()
            return known
        if (task := self._running.pop(request, None)) is None:
            return None
        with self.asked_for():
            try:
                outcome = await task
            except asyncio.CancelledError:
                if (current := asyncio.current_task()) is not None and current.cancelling():
                    task.cancel()
                    raise
                return None
            except Exception:  # whoever makes it for good says why
                return None
        self.used += 1
        self._keep_promise(request, outcome)
        return outcome if _lasts(outcome) else None

    @contextmanager
    def asked_for(self) -> Iterator[None]:
        """A simulation that was asked for needs a simulator: those that were only foreseen make room."""
        self._asked_for += 1
        while self._running and self._asked_for + len(self._running) > self._width:
            request, task = self._running.popitem()
            task.cancel()
            self._waiting.appendleft(request)
        try:
            yield
        finally:
            self._asked_for -= 1
            self._fill()

    async def close(self) -> None:
        """Give up what is being made."""
        self._waiting.clear()
        tasks = [*self._running.values()]
        self._running.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for promise in self._promised.values():
            promise.cancel()

    def pause(self) -> None:
        """Begin nothing more; what is being made goes on until its simulator is needed."""
        for request in self._waiting:
            self._keep_promise(request, None)
        self._waiting.clear()

    def _fill(self) -> None:
        while self._waiting and self._asked_for + len(self._running) < self._width:
            request = self._waiting.popleft()
            task = asyncio.ensure_future(self._simulate(request))
            self._running[request] = task
            task.add_done_callback(partial(self._done, request))
        if (now := (len(self._running), len(self._known))) != self._told:
            self._told = now
            self.changed(*now)

    def _done(self, request: Simulate, task: asyncio.Future[Outcome]) -> None:
        ours = self._running.get(request) is task
        if ours:
            del self._running[request]
        if task.cancelled():
            self._fill()
            return
        failed = task.exception() is not None  # asked for, so that nobody complains that it never was
        if not ours:
            return
        outcome = None if failed else task.result()
        if outcome is not None and _lasts(outcome):
            self._known[request] = outcome
            self.made += 1
        self._keep_promise(request, outcome)
        self._fill()

    def _keep_promise(self, request: Simulate, outcome: Outcome | None) -> None:
        promise = self._promised.pop(request, None)
        if promise is not None and not promise.done():
            promise.set_result(outcome)


def _lasts(outcome: Outcome) -> bool:
    """Whether it would come out the same again: not what died of bad luck."""
    return isinstance(outcome, Simulated) or (isinstance(outcome, Failed) and outcome.kind == "invalid_action")
