"""Speculative execution of simulations: they run before they are requested, while the pool is idle.

A simulation is a value: the same request gives the same outcome at any time. Simulations that a later stage will
request can therefore run while the arm pours. No decision depends on speculation: wrong predictions are discarded, and
the journal contains only what strategies requested. `SpeculativeExecution` holds the outcomes;
`orchestrator.runs.speculative_requests` predicts the requests.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial

from orchestrator.requests import Failed, Outcome, Simulate, Simulated

KEPT = 2000
"""Maximum number of queued requests and unused outcomes; beyond it, nothing more is queued."""


class SpeculativeExecution:
    """Outcomes of simulations that no strategy has requested yet, and speculative simulations in progress.

    Requested simulations have priority. A speculative simulation is cancelled if its simulator is needed, and queued
    again for later.

    Args:
        simulate: runs one simulation; cancelling abandons it.
        width: maximum number of simulations at a time, including requested ones.

    Attributes:
        changed: called with the number of running simulations and the number of unused outcomes.
    """

    def __init__(self, simulate: Callable[[Simulate], Awaitable[Outcome]], width: int) -> None:
        self._simulate = simulate
        self._width = width
        self._waiting: deque[Simulate] = deque()
        self._running: dict[Simulate, asyncio.Task[Outcome]] = {}
        self._known: dict[Simulate, Outcome] = {}
        self._promised: dict[Simulate, asyncio.Future[Outcome | None]] = {}
        self._asked_for = 0
        self._reported = (0, 0)
        self.changed: Callable[[int, int], None] = lambda running, waiting: None
        self.made = 0
        self.used = 0

    def foresee(self, request: Simulate) -> None:
        """Queue a simulation that runs as soon as a simulator is idle."""
        if request in self._known or request in self._running or request in self._waiting:
            return
        if len(self._known) + len(self._waiting) < KEPT:
            self._waiting.append(request)
            self._fill()

    async def outcome(self, request: Simulate) -> Outcome | None:
        """Outcome of a speculative simulation, once it is finished; it stays stored. None: it has no outcome."""
        self.foresee(request)
        if request in self._known:
            return self._known[request]
        if request not in self._running and request not in self._waiting:
            return None
        promise = self._promised.setdefault(request, asyncio.get_running_loop().create_future())
        return await asyncio.shield(promise)

    def knows(self, request: Simulate) -> bool:
        """Whether this request is finished or running speculatively."""
        return request in self._known or request in self._running

    async def take(self, request: Simulate) -> Outcome | None:
        """Outcome of a simulation that is requested now, if it ran speculatively; None: it must be run."""
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
            except Exception:  # the regular simulation reports the cause
                return None
        self.used += 1
        self._keep_promise(request, outcome)
        return outcome if _lasts(outcome) else None

    @contextmanager
    def asked_for(self) -> Iterator[None]:
        """Reserve a simulator for a requested simulation; speculative simulations in excess are cancelled."""
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
        """Cancel all speculative simulations."""
        self._waiting.clear()
        tasks = [*self._running.values()]
        self._running.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for promise in self._promised.values():
            promise.cancel()

    def pause(self) -> None:
        """Start no more simulations; running ones continue until their simulator is needed."""
        for request in self._waiting:
            self._keep_promise(request, None)
        self._waiting.clear()

    def _fill(self) -> None:
        while self._waiting and self._asked_for + len(self._running) < self._width:
            request = self._waiting.popleft()
            task = asyncio.ensure_future(self._simulate(request))
            self._running[request] = task
            task.add_done_callback(partial(self._done, request))
        if (now := (len(self._running), len(self._known))) != self._reported:
            self._reported = now
            self.changed(*now)

    def _done(self, request: Simulate, task: asyncio.Future[Outcome]) -> None:
        ours = self._running.get(request) is task
        if ours:
            del self._running[request]
        if task.cancelled():
            self._fill()
            return
        # read the exception, so that asyncio does not report it as never retrieved
        failed = task.exception() is not None
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
    """Whether a repetition would give the same outcome; false for failures by chance."""
    return isinstance(outcome, Simulated) or (isinstance(outcome, Failed) and outcome.kind == "invalid_action")
