"""Speculative execution of simulations: they run before they are requested, while the pool is idle.

A simulation is a value: the same request gives the same outcome at any time. Simulations that a later stage will
request can therefore run while the arm pours. No decision depends on speculation: wrong predictions are discarded, and
the journal contains only what strategies requested.

- `SpeculativeExecution` runs such simulations and holds their outcomes.
- `RequestForecast` predicts the requests. A strategy is a pure object with `ask` and `tell`, so it can be executed
  before its stage begins. Unknown inputs (pours that are not made yet, θ* that is not found yet) are replaced by
  placeholders. With placeholders, only a stage's first simulations are predicted, since these depend on seeds and
  actions alone: initial designs, and rivals of θ* on the weighed pours. The prior of a later receiver needs no unknown
  input, and is executed up to its first pour.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from orchestrator.journal.codec import Results
from orchestrator.requests import Ask, Failed, Outcome, Pour, Poured, Request, Simulate, Simulated, Slots, Suggest
from orchestrator.runs.stages import StageDefinition, calibrated_theta, stage_seed
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Strategy
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement

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

    def predict(self, request: Simulate) -> None:
        """Queue a simulation that runs as soon as a simulator is idle."""
        if request in self._known or request in self._running or request in self._waiting:
            return
        if len(self._known) + len(self._waiting) < KEPT:
            self._waiting.append(request)
            self._fill()

    async def outcome(self, request: Simulate) -> Outcome | None:
        """Outcome of a speculative simulation, once it is finished; it stays stored. None: it has no outcome."""
        self.predict(request)
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


MANY = 1000
"""Simulation slots offered to a stage when only its first requests are of interest."""

POURS_MADE_UP = 500
"""Maximum number of placeholder pours; a stage that needs more is not predicted."""


@dataclass(frozen=True)
class RequestForecast:
    """Executes the stages of a campaign speculatively, from a given stage on.

    Args:
        stages: the running stage, then all later ones.
        results: results of the earlier stages.
        seed: seed of the campaign.
        capacity: logical slots for simulations.
        speculation: runs the predicted simulations.
        suggest: queries the optimiser.
    """

    stages: Sequence[StageDefinition]
    results: Results
    seed: int
    capacity: int
    speculation: SpeculativeExecution
    suggest: Callable[[Suggest], Awaitable[Outcome]]

    async def run(self) -> None:
        """Queue all predicted simulations; returns when nothing more can be predicted."""
        now, *later = self.stages
        results: dict[str, StageResult] = dict(self.results)
        placeholder = self._placeholder_result(now)
        guessed = placeholder is not None
        unknown: list[SimulationParameters] = []
        if placeholder is not None:
            results[now.name] = placeholder
        for stage in later:
            strategy = self._built(stage, results)
            if strategy is None:
                continue
            if guessed or stage.order == "completion":
                await self._first(strategy, unknown)
            else:
                await self._until_a_pour(strategy)
            if stage.stand_in is not None:
                results[stage.name], guessed = stage.stand_in, True
                unknown.append(calibrated_theta(results).theta)

    def _built(self, stage: StageDefinition, results: Results) -> Strategy | None:
        try:
            return stage.build(results, stage_seed(self.seed, stage.name))
        except Exception:  # its input is unknown yet; a real problem is reported when the stage runs
            return None

    def _placeholder_result(self, stage: StageDefinition) -> StageResult | None:
        """Result of a stage that only pours, with placeholder outcomes; None for any other stage."""
        strategy = self._built(stage, self.results)
        if strategy is None:
            return None
        for number in range(POURS_MADE_UP):
            if strategy.finished:
                return strategy.result()
            requests = strategy.ask(Slots(0, 1))
            if not requests or not all(isinstance(request, Pour) for request in requests):
                return None
            for request in requests:
                strategy.tell(request, _placeholder_pour(number))
        return None

    async def _first(self, strategy: Strategy, unknown: Sequence[SimulationParameters]) -> None:
        """Queue all simulations that a strategy requests before its first outcome, except those with an unknown θ."""
        slots = self.capacity  # a strategy may choose its number of parallel simulations from its first slots
        while not strategy.finished:
            requests = strategy.ask(Slots(slots, 0))
            for request in requests:
                if isinstance(request, Simulate) and request.parameters not in unknown:
                    self.speculation.predict(request)
            questions = [request for request in requests if isinstance(request, Suggest)]
            if not questions and slots == MANY:
                return
            slots = MANY
            for question in questions:
                strategy.tell(question, await self.suggest(question))

    async def _until_a_pour(self, strategy: Strategy) -> None:
        """Queue all simulations before the first pour; outcomes are delivered in logical order, as in the stage."""
        open_: list[Request] = []
        while not strategy.finished:
            simulations = sum(isinstance(request, Simulate) for request in open_)
            asked = strategy.ask(Slots(max(self.capacity - simulations, 0), 1))
            if any(isinstance(request, Pour | Ask) for request in asked):
                return
            open_ += asked
            for request in asked:
                if isinstance(request, Simulate):
                    self.speculation.predict(request)
            if not open_:
                return
            request = min(open_, key=lambda request: isinstance(request, Simulate))
            open_.remove(request)
            if isinstance(request, Suggest):
                strategy.tell(request, await self.suggest(request))
            elif isinstance(request, Simulate):
                outcome = await self.speculation.outcome(request)
                if outcome is None:
                    return
                strategy.tell(request, outcome)


def _placeholder_pour(number: int) -> Outcome:
    """An arbitrary outcome that varies with the number, because a regression needs different values."""
    return Poured(PourMeasurement(loaded=0.2, spilled=0.2 * (0.05 + 0.1 * (number % 7)), retained=0.002))
