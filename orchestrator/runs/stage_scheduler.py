"""Runs one stage: asks a strategy, runs what it asks for, writes everything down, tells it what came of it.

The strategy is asked once at the start and once after every tell. Two orders of delivery:

* *logical*: suggestions first, then simulations, then the pour, each in the order in which they were asked for. The
  sequence of asks and tells then depends on plan and outcomes only, not on how fast anything was, and neither the
  optimiser nor the pool stands still while the arm pours. A strategy that wants k simulations beside each pour asks
  for k and no more until it is told.
* *completion*: told as they come. The clock takes part in the decisions; only the journal can replay them.

In both, the slots that a strategy is shown are capacity minus what was asked for and not yet told.

What is under way in a stage: requests that were asked for and whose outcome was not told yet.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from actors.interfaces import PourProgress
from orchestrator.journal.codec import decode_outcome, encode_outcome, encode_request, to_json
from orchestrator.journal.journal import Draft, Journal, Kind
from orchestrator.journal.journal_file import JournalError
from orchestrator.journal.stage_results import encode_result
from orchestrator.requests import Ask, Decision, Order, Outcome, Pour, Poured, Request, Simulate, Slots, Suggest
from orchestrator.run_errors import RunError
from orchestrator.runs.events import (
    DecisionMade,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StrategyProgressed,
    Watchers,
)
from orchestrator.runs.replay import StageHistory, replay, replayed_events
from orchestrator.runs.request_executor import RequestExecutor
from orchestrator.runs.unknown_pours import needs_answer, weighed_by_hand
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Strategy
from sim_engine.outcome import RecordedFrames

_LOGICAL_ORDER: dict[type[Request], int] = {Suggest: 0, Ask: 0, Simulate: 1, Pour: 2}
"""What is told first when several are under way: quick things before slow ones, so that a free slot is never kept
waiting for the strategy's next idea."""


@dataclass
class PendingRequest:
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


def free_slots(flights: Sequence[PendingRequest], capacity: int) -> Slots:
    """Capacity minus what was asked for and not yet told: the same wherever and however fast it runs."""
    simulations = sum(isinstance(f.request, Simulate) for f in flights)
    pours = sum(isinstance(f.request, Pour) for f in flights)
    return Slots(max(capacity - simulations, 0), max(1 - pours, 0))


def next_to_tell(flights: Sequence[PendingRequest], order: Order) -> PendingRequest | None:
    """The flight whose outcome the strategy is told next, if there is one already; None: wait."""
    if order == "completion":
        return min((f for f in flights if f.outcome is not None), key=lambda f: f.finished, default=None)
    first = min(flights, key=lambda f: (_LOGICAL_ORDER[type(f.request)], f.id), default=None)
    return first if first is not None and first.outcome is not None else None


_REPORT_INTERVAL = 0.3
"""Least time between two reports of a strategy's progress to watchers, unless one matters [s]."""


class StrategyError(RunError):
    """A strategy breaks the rules of ask and tell: a defect in the program, not in the laboratory."""


class StageScheduler:
    """Runs one strategy to its end, or to a safe point."""

    def __init__(
        self,
        stage: str,
        strategy: Strategy,
        *,
        journal: Journal,
        lanes: RequestExecutor,
        watchers: Watchers,
        capacity: int,
        order: Order,
        recordings: int = 0,
        on_pausing: Callable[[str], None] = lambda reason: None,
        on_stopping: Callable[[str], None] = lambda reason: None,
    ) -> None:
        """Prepare a stage.

        Args:
            capacity: logical slots for simulations, ≥ 1.
            recordings: how many simulations keep their frames.
            on_pausing: called when the stage begins to wind down.
            on_stopping: called when it is told to do so at once.
        """
        self._stage = stage
        self._strategy = strategy
        self._journal = journal
        self._lanes = lanes
        self._watchers = watchers
        self._capacity = capacity
        self._order = order
        self._recordings = recordings
        self._on_pausing = on_pausing
        self._on_stopping = on_stopping
        self._flights: dict[int, PendingRequest] = {}
        self._next_id = journal.last_id() + 1
        self._simulations = 0
        self._finished = 0
        self._decisions = 0
        self._ask_is_due = True
        self._reported = 0.0

    @property
    def unknown_pours(self) -> list[int]:
        """Pours that have begun and whose outcome nobody knows."""
        return [f.id for f in self._flights.values() if isinstance(f.request, Pour) and f.started and f.outcome is None]

    def restore(self, history: StageHistory) -> None:
        """Bring the strategy to where the journal ends. Runs nothing.

        Raises:
            ReplayError: it doesn't ask for what the journal says.
        """
        untold = replay(self._strategy, history, self._stage)
        simulations = [key for key, written in history.requests.items() if written["type"] == Simulate.__name__]
        numbers = {key: number for number, key in enumerate(simulations, start=1)}
        order = {key: place for place, key in enumerate(history.outcomes, start=1)}
        self._simulations, self._finished = len(numbers), len(order)
        for key, request in untold.items():
            self._flights[key] = PendingRequest(
                key,
                request,
                record=is_recorded(numbers.get(key, 0), self._recordings),
                attempt=history.pour_attempts.get(key, 0) + 1,
                finished=order.get(key, 0),
                outcome=history.outcomes.get(key),
            )
        self._decisions = history.decisions
        self._ask_is_due = history.ask_is_due
        for event in replayed_events(history, self._stage):
            self._watchers.emit(event)
        if history.steps:
            self._report_progress()

    async def run(self) -> StageResult:
        """Ask, run and tell until the strategy is finished.

        Returns:
            What it has learnt, as it is in the journal.

        Raises:
            StrategyError: it asks for more than it may, or for nothing while there is nothing to wait for.
            LaneError: the laboratory can't go on.
            asyncio.CancelledError: told to pause; what had begun is finished or given up, and written down.
        """
        try:
            for flight in self._flights.values():
                self._launch(flight)
            while True:
                if self._ask_is_due and not self._strategy.finished:
                    self._ask()
                if not self._flights:
                    if self._strategy.finished:
                        break
                    raise StrategyError(
                        f"strategy stalled in stage {self._stage}: it is not finished, waits for nothing and asks for "
                        f"nothing with {self._capacity} free simulation slot(s) and the arm free"
                    )
                self._tell(await self._next())
        except BaseException as error:
            await self._wind_down(error)
            raise
        result = self._strategy.result()
        self._journal.append(Kind.STAGE_CLOSED, {"result": encode_result(result)}, stage=self._stage)
        return result

    def _ask(self) -> None:
        slots = free_slots(list(self._flights.values()), self._capacity)
        requests = self._strategy.ask(slots)
        self._check(requests, slots)
        flights = []
        for request in requests:
            record = False
            if isinstance(request, Simulate):
                self._simulations += 1
                record = is_recorded(self._simulations, self._recordings)
            flights.append(PendingRequest(self._next_id, request, record=record))
            self._next_id += 1
        asked = {"simulations": slots.simulations, "pours": slots.pours, "ids": [f.id for f in flights]}
        drafts = [Draft(Kind.ASKED, asked, self._stage)]
        for f in flights:
            drafts.append(Draft(Kind.REQUESTED, {"id": f.id, "request": encode_request(f.request)}, self._stage))
        self._write_with_decisions(drafts)
        self._ask_is_due = False
        for flight in flights:
            self._flights[flight.id] = flight
            self._launch(flight)

    def _check(self, requests: Sequence[Request], slots: Slots) -> None:
        simulations = sum(isinstance(r, Simulate) for r in requests)
        pours = sum(isinstance(r, Pour) for r in requests)
        if simulations > slots.simulations or pours > slots.pours:
            raise StrategyError(
                f"stage {self._stage}: the strategy asks for {simulations} simulation(s) and {pours} pour(s), but "
                f"{slots.simulations} and {slots.pours} slot(s) are free"
            )

    def _launch(self, flight: PendingRequest) -> None:
        if flight.outcome is None:
            flight.task = asyncio.create_task(self._perform(flight), name=f"{self._stage} request {flight.id}")

    async def _perform(self, flight: PendingRequest) -> None:
        """Run one request and write down its outcome."""
        begin, frames, request = time.monotonic(), None, flight.request

        def started() -> None:
            nonlocal begin
            begin = time.monotonic()
            if isinstance(request, Pour):
                body = {"id": flight.id, "attempt": flight.attempt, "number": request.number}
                self._append(Kind.POUR_STARTED, body)
            else:
                self._append(Kind.STARTED, {"id": flight.id})
            flight.started = True
            self._watchers.emit(RequestStarted(stage=self._stage, id=flight.id, request=request))

        match request:
            case Simulate():
                outcome, frames = await self._lanes.simulate(request, record=flight.record, started=started)
            case Pour():

                def progress(p: PourProgress) -> None:
                    event = PourProgressed(stage=self._stage, id=flight.id, number=request.number, progress=p)
                    self._watchers.emit(event)

                def withdrawn(reason: str) -> None:
                    self._append(Kind.POUR_WITHDRAWN, {"id": flight.id, "reason": reason})
                    flight.started = False

                self._journal.check_space_for_pour()
                outcome = await self._lanes.pour(request, started=started, withdrawn=withdrawn, progress=progress)
            case Suggest():

                def retrying(text: str) -> None:
                    self._append(Kind.NOTE, {"text": text})
                    self._watchers.log("warning", text, self._stage)

                outcome = await self._lanes.suggest(request, started=started, retrying=retrying)
            case Ask():
                # A question is answered on resume: nobody types into a display that is redrawn, and no arm waits.
                raise needs_answer(request)
        self._finish(flight, outcome, time.monotonic() - begin, frames)

    def _finish(self, flight: PendingRequest, outcome: Outcome, seconds: float, frames: RecordedFrames | None) -> None:
        written = encode_outcome(outcome)
        kind = Kind.POUR_FINISHED if isinstance(flight.request, Pour) else Kind.FINISHED
        try:
            self._append(kind, {"id": flight.id, "outcome": written, "seconds": seconds})
        except JournalError as error:
            if isinstance(flight.request, Pour) and isinstance(outcome, Poured):
                raise JournalError(f"{error}. {weighed_by_hand(flight.request, outcome.measurement)}") from error
            raise
        # The strategy is told what the journal holds, so that a replay can't tell it anything else.
        flight.outcome = decode_outcome(written)
        self._finished += 1
        flight.finished = self._finished
        event = RequestFinished(
            stage=self._stage,
            id=flight.id,
            request=flight.request,
            outcome=flight.outcome,
            seconds=seconds,
            frames=frames,
        )
        self._watchers.emit(event)

    async def _next(self) -> PendingRequest:
        """The flight whose outcome is to be told next, once it has one."""
        while True:
            self._raise_failures()
            flight = next_to_tell(list(self._flights.values()), self._order)
            if flight is not None:
                return flight
            running = [f.task for f in self._flights.values() if f.task is not None and f.running]
            await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)

    def _raise_failures(self) -> None:
        for flight in self._flights.values():
            task = flight.task
            if task is not None and task.done():
                if task.cancelled():
                    raise StrategyError(f"request {flight.id} of stage {self._stage} was cancelled from outside")
                if (error := task.exception()) is not None:
                    raise error

    def _tell(self, flight: PendingRequest) -> None:
        assert flight.outcome is not None
        del self._flights[flight.id]
        self._strategy.tell(flight.request, flight.outcome)
        self._write_with_decisions([Draft(Kind.TOLD, {"id": flight.id}, self._stage)])
        self._ask_is_due = True
        self._report_progress(urgent=isinstance(flight.request, Pour) or self._strategy.finished)

    def _write_with_decisions(self, drafts: list[Draft]) -> None:
        """Write entries and the decisions that came with them together, so that a replay knows which are written."""
        decisions: Sequence[Decision] = getattr(self._strategy, "decisions", ())[self._decisions :]
        for decision in decisions:
            drafts.append(Draft(Kind.DECISION, cast("dict[str, Any]", to_json(decision, Decision)), self._stage))
        self._journal.append_all(drafts)
        self._decisions += len(decisions)
        for decision in decisions:
            self._watchers.emit(DecisionMade(stage=self._stage, decision=decision))

    def _report_progress(self, *, urgent: bool = True) -> None:
        """Tell watchers where the strategy stands; often only now and then, as results grow long."""
        if not urgent and time.monotonic() - self._reported < _REPORT_INTERVAL:
            return
        self._reported = time.monotonic()
        result = self._strategy.result()
        self._watchers.emit(StrategyProgressed(stage=self._stage, progress=self._strategy.progress(), result=result))

    def _append(self, kind: Kind, body: dict[str, Any]) -> None:
        self._journal.append(kind, body, stage=self._stage)

    async def _wind_down(self, error: BaseException) -> None:
        """Drop what can be repeated, finish what can't: simulations are cancelled, a pour that has begun is awaited.

        Cancelled again, it gives the pour up as well.
        """
        if isinstance(error, asyncio.CancelledError):
            reason = "asked to pause"
        else:  # the text of an error of ours says all; another one's is a defect, whose kind matters
            reason = str(error) if isinstance(error, RunError) else f"{type(error).__name__}: {error}"
        pours: list[asyncio.Task[None]] = []
        others: list[asyncio.Task[None]] = []
        for flight in self._flights.values():
            if flight.task is not None and flight.running:
                begun = isinstance(flight.request, Pour) and flight.started
                (pours if begun else others).append(flight.task)
        for task in others:
            task.cancel()
        try:
            self._on_pausing(reason)
        except Exception as problem:  # a full disk, say: no reason to leave a pour alone
            self._watchers.log("error", f"can't write that the run is pausing: {problem}", self._stage)
        try:
            if pours:
                grace = self._lanes.deadlines.pour_grace
                self._watchers.log(
                    "info", f"a pour is under way; it is finished first (up to {grace:g} s)", self._stage
                )
                await asyncio.wait(pours, timeout=grace)
            if others:
                await asyncio.wait(others, timeout=self._lanes.deadlines.cleanup)
        except asyncio.CancelledError:
            self._on_stopping("asked again")
        unfinished = [task for task in (*pours, *others) if not task.done()]
        for task in unfinished:
            task.cancel()
        if unfinished:
            await asyncio.wait(unfinished, timeout=self._lanes.deadlines.cleanup)
        for task in (*pours, *others):
            if task.done() and not task.cancelled() and (late := task.exception()) is not None and late is not error:
                self._watchers.log("warning", f"while winding down: {type(late).__name__}: {late}", self._stage)
