"""Runs one stage: takes requests from a strategy, executes them, writes the journal, and returns the outcomes.

`StageScheduler` calls `ask` once at the start and once after every `tell`. A `PendingRequest` is a request whose
outcome was not delivered yet.

Outcomes are delivered in a fixed order: suggestions first, then simulations, then the pour; within a kind, in the order
of the requests. The sequence of asks and tells then depends on plan and outcomes only, not on speed. Neither the
optimiser nor the pool is idle while the arm pours. A strategy that wants k simulations next to each pour requests k,
and no more until the next `tell`. The slots that a strategy receives are the capacity minus the pending requests.

The scheduler does not know how a request is executed (`orchestrator.runs.request_executor`).
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from actors.interfaces import PourProgress
from orchestrator.learning.requests import Ask, Outcome, Pour, Poured, Request, Simulate, Slots, Suggest
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import decode_outcome, encode_outcome
from orchestrator.records.events import (
    Asked,
    DecisionMade,
    Event,
    PourProgressed,
    PourRead,
    PourWithdrawn,
    Requested,
    RequestFinished,
    RequestStarted,
    StageClosed,
    StrategyProgressed,
    Told,
)
from orchestrator.records.journal import Journal
from orchestrator.records.journal_file import JournalError
from orchestrator.runs.request_executor import RequestExecutor, RequestExecutorError
from orchestrator.runs.resume import StageHistory, replay, weighed_by_hand
from sim_engine.errors import reason_of
from sim_engine.outcome import RecordedFrames

_DELIVERY_ORDER: dict[type[Request], int] = {Suggest: 0, Simulate: 1, Pour: 2, Ask: 3}
"""Order of delivery of pending requests: fast kinds first, so that a free slot does not wait for `ask`."""


@dataclass
class PendingRequest:
    """A request whose outcome was not delivered yet.

    Attributes:
        record: whether a simulation keeps its frames.
        attempt: how often a pour was begun, including this attempt.
        started: whether execution has begun, so that it may have had an effect.
        task: the task that runs it; None if its outcome was read from the journal.
    """

    id: int
    request: Request
    record: bool = False
    attempt: int = 1
    started: bool = False
    outcome: Outcome | None = None
    task: asyncio.Task[None] | None = None

    @property
    def running(self) -> bool:
        """Whether a task is executing it."""
        return self.task is not None and not self.task.done()


def is_recorded(number: int, recordings: int) -> bool:
    """Whether the `number`-th simulation of a stage (from 1) keeps its frames.

    The 1st, 2nd, 4th, 8th, … keep theirs until `recordings` are kept. Early and late simulations are thus recorded for
    any budget.
    """
    return number.bit_count() == 1 and number.bit_length() <= recordings


def free_slots(pending_requests: Sequence[PendingRequest], capacity: int) -> Slots:
    """Capacity minus the pending requests: the same on every machine and at any speed."""
    simulations = sum(isinstance(f.request, Simulate) for f in pending_requests)
    pours = sum(isinstance(f.request, Pour) for f in pending_requests)
    return Slots(max(capacity - simulations, 0), max(1 - pours, 0))


def next_to_tell(pending_requests: Sequence[PendingRequest]) -> PendingRequest | None:
    """The pending request whose outcome is delivered next; None if it has no outcome yet."""
    first = min(pending_requests, key=lambda f: (_DELIVERY_ORDER[type(f.request)], f.id), default=None)
    return first if first is not None and first.outcome is not None else None


READS = 4
"""Parts of a wanted amount after which the reading of the balance is written to the journal."""

REPEATS = 3
"""Largest number of times for which a virtual bench is restarted for one pour."""

_REPORT_INTERVAL = 0.3
"""Minimum time between two progress events of a strategy, unless the event is urgent [s]."""


class StageScheduler:
    """Runs one strategy to its end, or to a safe point."""

    def __init__(
        self,
        stage: str,
        strategy: Strategy,
        *,
        journal: Journal,
        executor: RequestExecutor,
        capacity: int,
        recordings: int = 0,
        on_pausing: Callable[[str], None] = lambda reason: None,
        on_stopping: Callable[[str], None] = lambda reason: None,
    ) -> None:
        """Prepare a stage.

        Args:
            capacity: logical slots for simulations, ≥ 1.
            recordings: number of simulations that keep their frames.
            on_pausing: called when the stage begins to wind down.
            on_stopping: called when winding down is cancelled to stop at once.
        """
        self._stage = stage
        self._strategy = strategy
        self._journal = journal
        self._executor = executor
        self._capacity = capacity
        self._recordings = recordings
        self._on_pausing = on_pausing
        self._on_stopping = on_stopping
        self._pending: dict[int, PendingRequest] = {}
        self._next_id = journal.last_id() + 1
        self._simulations = 0
        self._decisions = 0
        self._ask_is_due = True
        self._reported = 0.0

    @property
    def unknown_pours(self) -> list[int]:
        """Pours that have begun and whose outcome is unknown."""
        return [f.id for f in self._pending.values() if isinstance(f.request, Pour) and f.started and f.outcome is None]

    def restore(self, history: StageHistory) -> None:
        """Bring the strategy to the state at the end of the journal. Executes nothing.

        Raises:
            RunError: the strategy's requests differ from those in the journal.
        """
        undelivered = replay(self._strategy, history, self._stage)
        simulations = [key for key, request in history.requests.items() if isinstance(request, Simulate)]
        numbers = {key: number for number, key in enumerate(simulations, start=1)}
        self._simulations = len(numbers)
        for key, request in undelivered.items():
            self._pending[key] = PendingRequest(
                key,
                request,
                record=is_recorded(numbers.get(key, 0), self._recordings),
                attempt=history.pour_attempts.get(key, 0) + 1,
                outcome=history.outcomes.get(key),
            )
        self._decisions = history.decisions
        self._ask_is_due = history.ask_is_due
        self._journal.publish(*history.finished)
        if history.steps:
            self._report_progress()

    async def run(self) -> StageResult:
        """Ask, execute and tell until the strategy is finished.

        Returns:
            The strategy's result, as in the journal.

        Raises:
            RunError: it requests more than its slots allow, or nothing while no request is pending.
            RequestExecutorError: the laboratory can't continue.
            asyncio.CancelledError: the run is paused; requests that had begun were finished or abandoned, and recorded.
        """
        try:
            for pending in self._pending.values():
                self._launch(pending)
            while True:
                if self._ask_is_due and not self._strategy.finished:
                    self._ask()
                if not self._pending:
                    if self._strategy.finished:
                        break
                    raise RunError(
                        f"strategy stalled in stage {self._stage}: it is not finished, waits for nothing and asks for "
                        f"nothing with {self._capacity} free simulation slot(s) and the arm free"
                    )
                self._tell(await self._next())
        except BaseException as error:
            await self._wind_down(error)
            raise
        result = self._strategy.result()
        self._journal.append(StageClosed(stage=self._stage, result=result))
        return result

    def _ask(self) -> None:
        slots = free_slots(list(self._pending.values()), self._capacity)
        requests = self._strategy.ask(slots)
        self._check(requests, slots)
        pending_requests = []
        for request in requests:
            record = False
            if isinstance(request, Simulate):
                self._simulations += 1
                record = is_recorded(self._simulations, self._recordings)
            pending_requests.append(PendingRequest(self._next_id, request, record=record))
            self._next_id += 1
        ids = tuple(f.id for f in pending_requests)
        self._append_with_decisions(
            Asked(stage=self._stage, simulations=slots.simulations, pours=slots.pours, ids=ids),
            *(Requested(stage=self._stage, id=f.id, request=f.request) for f in pending_requests),
        )
        self._ask_is_due = False
        for pending in pending_requests:
            self._pending[pending.id] = pending
            self._launch(pending)

    def _check(self, requests: Sequence[Request], slots: Slots) -> None:
        simulations = sum(isinstance(r, Simulate) for r in requests)
        pours = sum(isinstance(r, Pour) for r in requests)
        if simulations > slots.simulations or pours > slots.pours:
            raise RunError(
                f"stage {self._stage}: the strategy asks for {simulations} simulation(s) and {pours} pour(s), but "
                f"{slots.simulations} and {slots.pours} slot(s) are free"
            )

    def _launch(self, pending: PendingRequest) -> None:
        if pending.outcome is None:
            pending.task = asyncio.create_task(self._perform(pending), name=f"{self._stage} request {pending.id}")

    async def _perform(self, pending: PendingRequest) -> None:
        """Execute one request and write its outcome to the journal."""
        begin, frames, request, attempt = time.monotonic(), None, pending.request, pending.attempt

        def started() -> None:
            nonlocal begin
            begin = time.monotonic()
            self._journal.append(
                RequestStarted(stage=self._stage, id=pending.id, request=request, attempt=pending.attempt)
            )
            pending.started = True

        match request:
            case Simulate():
                outcome, frames = await self._executor.simulate(request, record=pending.record, started=started)
            case Pour():
                read_at: tuple[str, int] | None = None

                def progress(p: PourProgress) -> None:
                    nonlocal read_at
                    events: list[Event] = [
                        PourProgressed(stage=self._stage, id=pending.id, number=request.number, progress=p)
                    ]
                    if p.dose is not None and p.dose.reading is not None:
                        step = p.dose.phase, math.floor(READS * p.dose.reading / p.dose.target)
                        if step != read_at:
                            read_at, mass = step, p.dose.reading
                            events.append(PourRead(stage=self._stage, id=pending.id, phase=step[0], mass=mass))
                    self._journal.append(*events)

                def withdrawn(reason: str) -> None:
                    self._journal.append(PourWithdrawn(stage=self._stage, id=pending.id, reason=reason))
                    pending.started = False

                def not_restarted(text: str) -> None:
                    self._journal.log("warning", text, stage=self._stage, kept=True)

                while True:
                    self._journal.check_space_for_pour()
                    try:
                        outcome = await self._executor.pour(
                            request, started=started, withdrawn=withdrawn, progress=progress
                        )
                        break
                    except RequestExecutorError as error:
                        repeats = pending.attempt - attempt
                        if repeats >= REPEATS or not await self._executor.restart(error, not_restarted):
                            raise
                        text = (
                            f"{error.problem}. The virtual bench was restarted, and pour {request.number} is repeated"
                        )
                        self._journal.log("info", text, stage=self._stage, kept=True)
                        pending.attempt += 1
            case Suggest():

                def retrying(text: str) -> None:
                    self._journal.log("warning", text, stage=self._stage, kept=True)

                outcome = await self._executor.suggest(request, started=started, retrying=retrying)
            case Ask():
                outcome = await self._executor.ask(request)
        self._finish(pending, outcome, time.monotonic() - begin, frames)

    def _finish(self, pending: PendingRequest, outcome: Outcome, seconds: float, frames: RecordedFrames | None) -> None:
        # The strategy receives the outcome as decoded from the journal, so that a replay delivers the same.
        same = decode_outcome(encode_outcome(outcome))
        event = RequestFinished(
            stage=self._stage, id=pending.id, request=pending.request, outcome=same, seconds=seconds, frames=frames
        )
        try:
            self._journal.append(event)
        except JournalError as error:
            if isinstance(pending.request, Pour) and isinstance(outcome, Poured):
                raise JournalError(f"{error}. {weighed_by_hand(pending.request, outcome.measurement)}") from error
            raise
        pending.outcome = same

    async def _next(self) -> PendingRequest:
        """Wait until the next request to deliver has an outcome, and return it."""
        while True:
            self._raise_failures()
            pending = next_to_tell(list(self._pending.values()))
            if pending is not None:
                return pending
            running = [f.task for f in self._pending.values() if f.task is not None and f.running]
            await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)

    def _raise_failures(self) -> None:
        for pending in self._pending.values():
            task = pending.task
            if task is not None and task.done():
                if task.cancelled():
                    raise RunError(f"request {pending.id} of stage {self._stage} was cancelled from outside")
                if (error := task.exception()) is not None:
                    raise error

    def _tell(self, pending: PendingRequest) -> None:
        assert pending.outcome is not None
        del self._pending[pending.id]
        self._strategy.tell(pending.request, pending.outcome)
        self._append_with_decisions(Told(stage=self._stage, id=pending.id))
        self._ask_is_due = True
        self._report_progress(urgent=isinstance(pending.request, Pour) or self._strategy.finished)

    def _append_with_decisions(self, *events: Event) -> None:
        """Write events together with the decisions that belong to them, so that a replay has the same number of
        decisions."""
        decisions = getattr(self._strategy, "decisions", ())[self._decisions :]
        self._journal.append(*events, *(DecisionMade(stage=self._stage, decision=decision) for decision in decisions))
        self._decisions += len(decisions)

    def _report_progress(self, *, urgent: bool = True) -> None:
        """Emit the strategy's progress; limited in frequency unless urgent, because results grow large."""
        if not urgent and time.monotonic() - self._reported < _REPORT_INTERVAL:
            return
        self._reported = time.monotonic()
        result = self._strategy.result()
        self._journal.append(StrategyProgressed(stage=self._stage, progress=self._strategy.progress(), result=result))

    async def _wind_down(self, error: BaseException) -> None:
        """Cancel simulations and suggestions, which can be repeated, and wait for a pour that has begun.

        A second cancellation abandons the pour as well.
        """
        reason = "asked to pause" if isinstance(error, asyncio.CancelledError) else reason_of(error)
        pours: list[asyncio.Task[None]] = []
        others: list[asyncio.Task[None]] = []
        for pending in self._pending.values():
            if pending.task is not None and pending.running:
                begun = isinstance(pending.request, Pour) and pending.started
                (pours if begun else others).append(pending.task)
        for task in others:
            task.cancel()
        try:
            self._on_pausing(reason)
        except Exception as problem:  # for example a full disk: the pour must be awaited nevertheless
            self._journal.log("error", f"can't write that the run is pausing: {problem}", stage=self._stage)
        try:
            if pours:
                grace = self._executor.deadlines.pour_grace
                text = f"a pour is under way; it is finished first (up to {grace:g} s)"
                self._journal.log("info", text, stage=self._stage)
                await asyncio.wait(pours, timeout=grace)
            if others:
                await asyncio.wait(others, timeout=self._executor.deadlines.cleanup)
        except asyncio.CancelledError:
            self._on_stopping("asked again")
        unfinished = [task for task in (*pours, *others) if not task.done()]
        for task in unfinished:
            task.cancel()
        if unfinished:
            await asyncio.wait(unfinished, timeout=self._executor.deadlines.cleanup)
        for task in (pending.task for pending in self._pending.values() if pending.task is not None):
            if task.done() and not task.cancelled() and (late := task.exception()) is not None and late is not error:
                self._journal.log("warning", f"while winding down: {reason_of(late)}", stage=self._stage)
