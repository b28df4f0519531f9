"""Executes single requests on the laboratory: scenes, deadlines, retries, and the translation of errors into outcomes.

`RequestExecutor` runs pours one at a time, because there is one arm. Queries to the optimiser also run one at a time.
Simulations run in parallel; strategies limit their number to the free slots that they receive. The executor does not
write the journal and does not decide which request comes next.

`SpeculativeExecution` runs simulations before they are requested, while the pool is idle. A simulation is a value: the
same request gives the same outcome at any time, so wrong predictions are discarded and no decision depends on them.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import os
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from actors.arm.arm_settings import ArmSettings
from actors.arm.pour_feasibility import path_of
from actors.interfaces import (
    Answering,
    Bench,
    BenchLostError,
    InvalidActionError,
    Laboratory,
    LaboratoryError,
    LinkLostError,
    NotPouredError,
    OperatorQuestion,
    PourProgress,
    ProgressCallback,
    Restartable,
    SimulationError,
    SimulatorPool,
    UnknownPourError,
)
from orchestrator.learning.requests import (
    Answered,
    Ask,
    Failed,
    Outcome,
    Pour,
    Poured,
    Simulate,
    Simulated,
    Suggest,
    Suggested,
)
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.resume import AskOperator
from sim_engine.action import Action
from sim_engine.errors import reason_of
from sim_engine.outcome import RecordedFrames, SimulatedPour
from sim_engine.scene import PourTask, Scene


class RequestExecutorError(RunError):
    """The laboratory can't serve the campaign any longer, or it received a request that it can't fulfil.

    Attributes:
        problem: the cause, without the advice for a run that can be resumed.
        nothing_poured: it is certain that a restarted virtual bench can make the pour.
        unknown: a pour has begun, and has no outcome.
    """

    def __init__(self, problem: str, way_on: str = "", *, nothing_poured: bool = False, unknown: bool = False) -> None:
        super().__init__(problem + way_on)
        self.problem = problem
        self.nothing_poured, self.unknown = nothing_poured, unknown


class PourNotMadeError(RequestExecutorError):
    """A pour did not begin and the operator must correct the cause. Nothing is lost: resuming requests it again."""

    exit_code = 3


class PourUnknownError(RequestExecutorError):
    """A pour began and was interrupted; the operator must report its outcome."""

    exit_code = 3


RESTARTS = 3
"""Attempts to start a virtual bench again, before a pour is repeated."""

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
        if (answer := self._known.pop(request, None)) is not None:
            self.used += 1
            self._fill()
            return answer
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


FILM_RATE = 25.0
"""Frames of a film [1/s]."""

SUGGESTIONS = 3
"""Attempts per query to the optimiser. A query is idempotent, and its process may have failed by chance."""


@dataclass(frozen=True)
class Deadlines:
    """Time limits for requests [s of wall time].

    Attributes:
        simulate: includes the time in the pool's queue. A pour of 50 000 particles takes minutes on one core; after
            half an hour the pool is dead, not slow.
        suggest: for one answer; a fit to some hundred points takes seconds. It is longer than the optimiser's own
            deadline (`actors.optimizer_actor`), because only that deadline replaces a process that hangs.
        pour: a pour takes 90 s in a laboratory, but the operator may be needed for each of its steps, which have
            deadlines of their own. After this time the outcome is unknown, and the operator must report it.
        pour_grace: how long a pause waits for a pour that has begun.
        cleanup: how long cancelled requests may take to stop.
    """

    simulate: float = 1800.0
    suggest: float = 700.0
    pour: float = 6.0 * 3600.0
    pour_grace: float = 300.0
    cleanup: float = 20.0


class RequestExecutor:
    """Runs requests on a laboratory and converts errors of single requests into outcomes.

    Args:
        laboratory: open.
        scenes: of the plan, by name.
        deadlines: of requests.
        frame_rate: of recorded simulations [1/s].
        ask_operator: answers questions of strategies.
        repeats: a virtual bench repeats pours whose outcome is unknown.
        arm: of the laboratory.
        made_by_arm: names of the scenes whose actions this arm will make. A simulation of an action that it can't make
            is an invalid action, as one in which the vessels touch: a search stays within the arm's limits.
    """

    def __init__(
        self,
        laboratory: Laboratory,
        scenes: Mapping[str, Scene],
        deadlines: Deadlines,
        frame_rate: float,
        ask_operator: AskOperator | None = None,
        *,
        repeats: bool = False,
        arm: ArmSettings | None = None,
        made_by_arm: Collection[str] = (),
        filmed: Callable[[Pour, Scene, RecordedFrames], None] | None = None,
    ) -> None:
        self._laboratory, self._ask_operator, self._filmed = laboratory, ask_operator, filmed
        self._repeats, self._arm, self._made_by_arm = repeats, arm, made_by_arm
        self._refusals: dict[tuple[str, Action], asyncio.Future[str]] = {}
        self._scenes = scenes
        self.deadlines = deadlines
        self._frame_rate = frame_rate
        self._real = asyncio.Lock()
        self._optimiser = asyncio.Lock()
        size = laboratory.simulators.size
        # while the arm pours, a pool of all processors leaves one to the drivers, which keep deadlines
        spare = 1 if 1 < size >= (os.cpu_count() or 1) else 0
        self.speculation = SpeculativeExecution(self._speculate, size - spare)

    async def _speculate(self, request: Simulate) -> Outcome:
        return (await self._simulated(request))[0]

    async def simulate(
        self, request: Simulate, *, record: bool, started: Callable[[], None]
    ) -> tuple[Outcome, RecordedFrames | None]:
        """Run a simulation.

        Args:
            record: whether frames are kept; does not affect the outcome. Speculative simulations have no frames.
            started: called when the simulation is handed to the pool.
        """
        if not record and self.speculation.knows(request):
            started()
            if (speculated := await self.speculation.take(request)) is not None:
                return speculated, None
        else:
            started()
        with self.speculation.asked_for():
            return await self._simulated(request, record=record)

    async def film(self, request: Simulate) -> SimulatedPour | None:
        """A simulation with frames for a picture; None if it fails. No decision depends on it."""
        try:
            played = await self._pooled(request, FILM_RATE)
        except (InvalidActionError, SimulationError, TimeoutError):
            _raise_if_cancelled()
            return None
        return played if played.frames is not None and played.outcome.invalid is None else None

    async def _pooled(self, request: Simulate, rate: float) -> SimulatedPour:
        scene = self._scene(request.scene)
        task = PourTask(
            scene.drawn(request.seed) if request.drawn_shapes else scene,
            request.action,
            request.parameters,
            request.seed,
            frame_rate=rate,
            pose_error=request.pose_error,
        )
        async with asyncio.timeout(self.deadlines.simulate):
            return await self._laboratory.simulators.simulate(task)

    async def _simulated(self, request: Simulate, *, record: bool = False) -> tuple[Outcome, RecordedFrames | None]:
        refusal = self._refusal(request)
        try:
            result = await self._pooled(request, self._frame_rate if record else 0.0)
            if refusal is not None and (reason := await asyncio.shield(refusal)):
                return Failed("invalid_action", reason), None
        except InvalidActionError as error:
            return Failed("invalid_action", str(error)), None
        except SimulationError as error:
            _raise_if_cancelled()
            return Failed("simulation", str(error)), None
        except TimeoutError:
            return Failed("simulation", f"no result within {self.deadlines.simulate:g} s"), None
        if result.outcome.invalid is not None:
            return Failed("simulation", result.outcome.invalid), result.frames
        return Simulated(result.outcome), result.frames

    def _refusal(self, request: Simulate) -> asyncio.Future[str] | None:
        """Why the arm can't make the action as planned, once that is worked out next to the simulation; '' if it can.
        None: it will not be asked to."""
        by_arm = request.scene in self._made_by_arm or request.purpose == "design"  # of a calibration's pours
        if self._arm is None or not by_arm or request.pose_error is not None:
            return None
        key = request.scene, request.action
        if key not in self._refusals:
            check = asyncio.to_thread(_refusal, self._scene(request.scene), request.action, self._arm)
            self._refusals[key] = asyncio.ensure_future(check)
        return self._refusals[key]

    async def pour(
        self,
        request: Pour,
        *,
        started: Callable[[], None],
        withdrawn: Callable[[str], None] = lambda reason: None,
        progress: ProgressCallback,
    ) -> Outcome:
        """Pour once. A pour that the arm can't make does not start.

        Args:
            started: called immediately before the arm starts; must have written a durable record of it when it returns.
            withdrawn: called with the reason when the bench reports that nothing was poured; must write a durable
                record too.
            progress: passed to the bench.

        Raises:
            RequestExecutorError: there is no bench, or it was lost during the pour, whose outcome is then unknown.
            PourNotMadeError: nothing was poured.
            PourUnknownError: the poured amount is unknown, for example because the pour was not weighed in time.
            BenchLostError: the bench was lost before the pour.
        """
        bench, scene = self.bench, self._scene(request.scene)
        if self._arm is not None and (reason := await asyncio.to_thread(_refusal, scene, request.action, self._arm)):
            return Failed("invalid_action", reason)
        frames: list[RecordedFrames] = []

        def report(told: PourProgress) -> None:
            if told.liquid is not None:
                frames.append(told.liquid)
            progress(told)

        kept = self._filmed is not None and request.dose is not None
        async with self._real:
            started()
            try:
                async with asyncio.timeout(self.deadlines.pour):
                    measurement = await bench.pour(
                        scene,
                        request.action,
                        seed=request.seed,
                        progress=report if kept else progress,
                        dose=request.dose,
                    )
            except InvalidActionError as error:
                return Failed("invalid_action", str(error))
            except NotPouredError as error:
                withdrawn(str(error))
                _raise_if_cancelled()
                lost = isinstance(error, LinkLostError)
                raise PourNotMadeError(str(error), "; see to it, then resume the run", nothing_poured=lost) from error
            except UnknownPourError as error:
                _raise_if_cancelled()
                raise PourUnknownError(str(error), "; resuming asks for its outcome", unknown=True) from error
            except BenchLostError as error:
                # No outcome: the operator must inspect the bench, and there is nothing left to pour with.
                _raise_if_cancelled()
                raise RequestExecutorError(
                    f"{error}; what was poured is unknown: see to the bench", ", then resume the run"
                ) from error
            except LaboratoryError as error:
                _raise_if_cancelled()
                return Failed("pour_failed", str(error))
            except TimeoutError:
                raise PourUnknownError(
                    f"the pour had begun and was not weighed within {_duration(self.deadlines.pour)}; the bench was "
                    "stopped, and the poured amount is unknown",
                    "; see to the bench. Resuming asks for its outcome",
                ) from None
        if frames and self._filmed is not None:
            self._filmed(request, scene, functools.reduce(RecordedFrames.joined, frames))
        return Poured(measurement)

    async def restart(self, error: RequestExecutorError, failed: Callable[[str], None] = lambda text: None) -> bool:
        """Restart a virtual bench, if a pour can be made again after this error.

        Args:
            error: that ended the pour.
            failed: receives why the bench did not start, each time; on a busy machine the next attempt may succeed.

        Returns:
            Whether it can: nothing was poured, or the plan repeats pours whose outcome is unknown, and the bench has
            started again.
        """
        laboratory = self._laboratory
        repeatable = error.nothing_poured or (error.unknown and self._repeats)
        if not repeatable or not isinstance(laboratory, Restartable):
            return False
        try:
            if self.bench.mode != "virtual":
                return False
            for _ in range(RESTARTS):
                try:
                    async with self._real:
                        await laboratory.restart_bench()
                    return True
                except BenchLostError:
                    raise
                except LaboratoryError as reason:
                    _raise_if_cancelled()
                    failed(f"the virtual bench did not start again: {reason}")
        except BenchLostError:  # the error that led here says what to do
            _raise_if_cancelled()
        return False

    async def ask(self, request: Ask) -> Outcome:
        """Ask the operator at the bench, or for proposals the program or person who started the run.

        Raises:
            RequestExecutorError: the bench has no operator.
            PourNotMadeError: there is no answer.
        """
        if request.proposals is not None:
            if self._ask_operator is None:
                raise PourNotMadeError(request.question, "; nobody is here to be asked, resuming the run asks again")
            answer = self._ask_operator(request.question, request.options, {})
            return Answered(await answer if inspect.isawaitable(answer) else answer)
        if not isinstance(bench := self.bench, Answering):
            raise RequestExecutorError(f"this bench has no operator to ask: {request.question}")
        question = OperatorQuestion(request.question, "option", about="decision", hands=False, options=request.options)
        try:
            return Answered(await bench.ask(question))
        except LaboratoryError as error:
            _raise_if_cancelled()
            raise PourNotMadeError(str(error), "; resuming the run asks again") from error

    async def suggest(
        self,
        request: Suggest,
        *,
        started: Callable[[], None] = lambda: None,
        retrying: Callable[[str], None] = lambda text: None,
    ) -> Outcome:
        """Query the optimiser, up to `SUGGESTIONS` times. No layer below repeats a query.

        Raises:
            RequestExecutorError: every attempt failed, or the optimiser's machine is lost. There is no substitute
                answer.
        """
        async with self._optimiser:
            started()
            for attempt in range(1, SUGGESTIONS + 1):
                try:
                    async with asyncio.timeout(self.deadlines.suggest):
                        return Suggested(await self._laboratory.optimizer.suggest(request.query))
                except Exception as error:
                    reason = reason_of(error)
                    if attempt == SUGGESTIONS or isinstance(error, BenchLostError):
                        times = "once" if attempt == 1 else f"{attempt} times"
                        raise RequestExecutorError(
                            f"the optimiser was asked the same question {times} and failed each time ({reason})",
                            "; nothing is lost: fix the cause and resume the run",
                        ) from error
                    retrying(f"the optimiser failed ({reason}); it is asked again, for the {_ORDINAL[attempt]} time")
        raise AssertionError("unreachable")

    @property
    def simulators(self) -> SimulatorPool:
        """The pool that runs simulations."""
        return self._laboratory.simulators

    @property
    def bench(self) -> Bench:
        """The bench. Raises RequestExecutorError if there is none."""
        if self._laboratory.bench is None:
            raise RequestExecutorError(
                "a pour is asked for, but this laboratory has no bench; add one to the laboratory's file"
            )
        return self._laboratory.bench

    def _scene(self, name: str) -> Scene:
        try:
            return self._scenes[name]
        except KeyError:
            names = ", ".join(sorted(self._scenes)) or "none"
            raise RequestExecutorError(f"a request names the scene '{name}', but the plan has {names}") from None


def _refusal(scene: Scene, action: Action, arm: ArmSettings) -> str:
    try:
        path_of(scene, action, arm)
    except InvalidActionError as error:
        return str(error)
    return ""


_ORDINAL = {1: "second", 2: "third"}


def _duration(seconds: float) -> str:
    return f"{seconds / 3600.0:g} h" if seconds >= 3600.0 else f"{seconds:g} s"


def _raise_if_cancelled() -> None:
    """Raise `CancelledError` if this task is being cancelled.

    An error caused by that cancellation is not an outcome of the request.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
