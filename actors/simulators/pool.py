"""A pool of simulators in separate processes. It replaces processes that die and repeats their jobs.

- `RaySimulatorPool` assigns jobs to workers.
- `WorkerPool` starts the workers, replaces lost ones and ends them.
- `Member` is one worker: its state, and the jobs that were sent to it (`SentJob`).

The simulation itself runs in `actors.simulators.ray_worker`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from actors.interfaces import InvalidActionError, LaboratoryError, SimulationError
from actors.runtime.cluster_nodes import Versions
from actors.simulators.ray_worker import CONTROL, Greeting, WorkerReply, simulator_actor
from actors.simulators.simulation_task import RETRIES, Account, PoolStatistics, Simulator, pour_simulator
from actors.simulators.task_transfer import Packer
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask


@dataclass(eq=False)
class SimulationJob:
    """A simulation that a caller waits for.

    Attributes:
        task: packed, without paths.
        meshes: Ray's references of its meshes.
        future: receives the result, or the error.
        deaths: number of simulators that died during this job.
    """

    task: PourTask
    meshes: Sequence[Any]
    future: asyncio.Future[SimulatedPour]
    deaths: int = 0

    def fail(self, error: Exception) -> None:
        """Set the error as the outcome."""
        if not self.future.done():
            self.future.set_exception(error)


@dataclass(eq=False)
class SentJob:
    """A job that was sent to a simulator.

    Attributes:
        number: unique number of this transmission.
        recalled: the result is not needed any more, because the job was cancelled or given to another simulator.
    """

    job: SimulationJob
    number: int
    recalled: bool = False


@dataclass(eq=False)
class Member:
    """A simulator actor. A number is used only once, so that a dead worker is never mistaken for a live one.

    Attributes:
        greeted: done when its process is up, or has failed to start.
        sent: jobs in the order in which they run; the first one is running.
        overdue: fires when the first job takes too long.
        begun: start of the first job, by the event loop's clock [s].
    """

    number: int
    actor: Any
    greeted: asyncio.Future[Greeting]
    sent: deque[SentJob] = field(default_factory=deque)
    overdue: asyncio.TimerHandle | None = None
    begun: float = 0.0

    @property
    def greeting(self) -> Greeting | None:
        """None unless its process is up."""
        done = self.greeted.done() and not self.greeted.cancelled() and self.greeted.exception() is None
        return self.greeted.result() if done else None

    @property
    def spare(self) -> SentJob | None:
        """The last job, if it cannot have begun and is still needed."""
        return self.sent[-1] if len(self.sent) > 1 and not self.sent[-1].recalled else None

    def drop_timer(self) -> None:
        """Stop timing the first job."""
        if self.overdue is not None:
            self.overdue.cancel()
            self.overdue = None


def look_away(answer: asyncio.Future[Any]) -> None:
    """Mark a late result as retrieved, so that asyncio does not log it."""
    if not answer.cancelled():
        answer.exception()


RESTART_PAUSE = 20.0
"""Pause after a worker's process failed to start [s], because the cause may last."""

_REPORT_PAUSE = 1.0
"""Losses within this time are reported together [s]: a lost node loses many workers."""


class WorkerPool:
    """Keeps a number of simulator actors alive. If some cannot be placed because a node is lost, it waits for them.

    Args:
        size: number of workers.
        start: starts an actor.
        expected: versions that workers must have; None if they cannot differ.
        changed: called when a worker is up, or cannot start.
        tell: called with a message about losses.
    """

    def __init__(
        self,
        size: int,
        start: Callable[[], Any],
        *,
        expected: Versions | None,
        changed: Callable[[], None],
        tell: Callable[[str], None],
    ) -> None:
        self._start, self._expected, self._changed, self._report = start, expected, changed, tell
        self._loop = asyncio.get_running_loop()
        self._members: dict[int, Member] = {}
        self._numbers = 0
        self._losses: list[tuple[str, int]] = []
        self._closed = False
        self.size = size
        self.problem = ""
        for _ in range(size):
            self._add()

    @property
    def up(self) -> list[Member]:
        """Workers whose processes have started."""
        return [member for member in self._members.values() if member.greeting is not None]

    @property
    def hopeless(self) -> bool:
        """Whether no worker is up or starting."""
        return not self._members

    def __contains__(self, member: Member) -> bool:
        return member.number in self._members

    async def greeted(self) -> list[Greeting]:
        """The greetings of the workers; waits for those that are starting."""
        if self._members:
            await asyncio.wait([member.greeted for member in self._members.values()])
        return [member.greeting for member in self.up if member.greeting is not None]

    def grow(self, size: int) -> None:
        """Increase the number of workers to at least `size`."""
        while self.size < size and not self._closed:
            self.size += 1
            self._add()

    def lose(self, member: Member, orphans: int) -> None:
        """Replace a worker that is lost or has to be ended.

        Args:
            member: the worker.
            orphans: number of its jobs that other workers take over.
        """
        self._remove(member)
        if not self._losses:
            self._loop.call_later(_REPORT_PAUSE, self._report_losses)
        self._losses.append(("" if member.greeting is None else member.greeting.host, orphans))
        self._add()

    async def close(self, deadline: float) -> None:
        """Make the workers write their compiled kernels, then end their processes.

        Args:
            deadline: longest time for writing [s].
        """
        self._closed = True
        members = list(self._members.values())
        up = self.up
        self._members = {}
        closing = {asyncio.wrap_future(member.actor.close.remote().future()) for member in up}
        if closing:
            await asyncio.wait(closing, timeout=deadline)
        for answer in closing:
            answer.add_done_callback(look_away)
        for member in members:
            _kill(member)

    def _add(self) -> None:
        if self._closed:
            return
        self._numbers += 1
        actor = self._start()
        member = Member(self._numbers, actor, asyncio.wrap_future(actor.greet.remote().future()))
        self._members[member.number] = member
        member.greeted.add_done_callback(partial(self._greeted, member))

    def _greeted(self, member: Member, greeted: asyncio.Future[Greeting]) -> None:
        """A worker's process is up, or does not start."""
        error = None if greeted.cancelled() else greeted.exception()
        if member not in self:
            return
        if (greeting := member.greeting) is None:
            if "error raised in its creation task" in str(error):
                self._refuse(member, f"a simulator's process does not start: {_last_line(error)}")
            else:
                self.lose(member, 0)
        elif self._expected is not None and (difference := self._expected.difference(greeting.versions)):
            self._refuse(member, f"the simulator on {greeting.host} is not like this machine's: {difference}")
        self._changed()

    def _refuse(self, member: Member, problem: str) -> None:
        """Reject a worker that would fail again or return different results; start another one later."""
        self._remove(member)
        if problem != self.problem:
            self.problem = problem
            self._report(problem)
        self._loop.call_later(RESTART_PAUSE, self._add)

    def _remove(self, member: Member) -> None:
        self._members.pop(member.number, None)
        _kill(member)

    def _report_losses(self) -> None:
        losses, self._losses = self._losses, []
        if self._closed:
            return
        hosts = ", ".join(sorted({host for host, _ in losses if host}))
        self._report(
            f"{len(losses)} simulator(s) lost{f' on {hosts}' if hosts else ''}: "
            f"{sum(count for _, count in losses)} simulation(s) are repeated by others; "
            f"{len(self.up)} of {self.size} are up"
        )


def _kill(member: Member) -> None:
    import ray

    with contextlib.suppress(Exception):
        ray.kill(member.actor)


def _last_line(error: BaseException | None) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else repr(error)


DEADLINE = 1800.0
"""Longest time for one job on one worker [s]: a worker that needs half an hour counts as dead, not slow."""

START_DEADLINE = 120.0
"""Longest time that jobs wait while no worker is up [s]."""

DRAIN_DEADLINE = 10.0
"""Time that a cancelled job has to stop [s]; after that its worker is replaced."""

CLOSE_DEADLINE = 10.0
"""Time that a worker has to write its kernels at the end [s]."""

AHEAD = 1
"""Number of jobs queued at a busy worker, so that it begins the next one without a request."""


class RaySimulatorPool:
    """`SimulatorPool` over Ray actors. Jobs begin in their order of arrival, as far as deaths of workers allow.

    - Each busy worker has its next job queued. If a worker becomes idle while another one still has a job waiting, the
      job is taken back and given to the idle one.
    - Simulations are idempotent. A job whose worker died is repeated by another one.
    - The pool needs a running Ray (`actors.runtime.ray_runtime`) and is created inside an event loop.

    Args:
        size: number of workers.
        make: creates a worker's simulator, inside its process.
        retries: how often a job is tried again after a death.
        deadline: longest time for one job [s].
        cpus: cores that Ray counts for a worker.
        placement: Ray's options that place the workers.
        expected: versions that workers must have; None if they cannot differ.
        tell: called with a message about losses.
    """

    def __init__(
        self,
        size: int,
        *,
        make: Callable[[], Simulator] = pour_simulator,
        retries: int = RETRIES,
        deadline: float = DEADLINE,
        cpus: float = 1.0,
        placement: Mapping[str, Any] | None = None,
        expected: Versions | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._retries, self._deadline = retries, deadline
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[SimulationJob] = deque()
        self._sendings = 0
        self._packer = Packer()
        self._meshes: dict[Path, Any] = {}
        self._account = Account(size)
        self._wait_timer: asyncio.TimerHandle | None = None
        self._abandoned: LaboratoryError | None = None
        self._closed = False
        start = partial(simulator_actor, make, cpus=cpus, placement=placement or {})
        self._workers = WorkerPool(size, start, expected=expected, changed=self._dispatch, tell=tell)

    @property
    def size(self) -> int:
        """Number of workers, including those that are not up yet."""
        return self._workers.size

    @property
    def separate(self) -> bool:
        """Whether simulators run in separate processes: always True."""
        return True

    def statistics(self) -> PoolStatistics:
        """Statistics of the pool so far."""
        return self._account.statistics()

    def grow(self, size: int) -> None:
        """Increase the number of workers to at least `size`."""
        self._workers.grow(size)
        self._account.resize(self._workers.size)

    async def pids(self) -> list[int]:
        """Process ids of the workers; waits for those that are starting."""
        return [greeting.pid for greeting in await self._workers.greeted()]

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`.

        Raises:
            LaboratoryError: no simulator is up and none starts, or the error that the pool was abandoned with.
        """
        if self._closed:
            raise SimulationError("the pool of simulators is closed")
        if self._abandoned is not None:
            raise self._abandoned
        packed, serialized = self._packer.pack(task)
        for mesh in serialized:
            if mesh.key not in self._meshes:
                import ray

                self._meshes[mesh.key] = ray.put(mesh)
        job = SimulationJob(packed, [self._meshes[mesh.key] for mesh in serialized], self._loop.create_future())
        self._waiting.append(job)
        self._dispatch()
        try:
            return await job.future
        except asyncio.CancelledError:
            self._give_up(job)
            raise

    def _dispatch(self) -> None:
        """Assign waiting jobs to workers. If none waits, move jobs from busy workers to idle ones."""
        while self._waiting and (member := self._next_member()) is not None:
            self._send(self._waiting.popleft(), member)
        if not self._waiting:
            self._level()
        self._limit_wait()

    def _next_member(self) -> Member | None:
        """The worker that is expected to begin another job first."""
        free = [member for member in self._workers.up if len(member.sent) <= AHEAD]
        return min(free, key=lambda member: (len(member.sent), member.begun), default=None)

    def _level(self) -> None:
        members = self._workers.up
        for idle in [member for member in members if not member.sent]:
            busy = next((member for member in members if member.spare is not None), None)
            if busy is None or (spare := busy.spare) is None:
                return
            _recall(busy, spare)
            self._send(spare.job, idle)

    def _send(self, job: SimulationJob, member: Member) -> None:
        self._sendings += 1
        sent = SentJob(job, self._sendings)
        ref = member.actor.simulate.remote(sent.number, job.task, *job.meshes)
        member.sent.append(sent)
        if len(member.sent) == 1:
            self._begin(member)
        answer = asyncio.wrap_future(ref.future())
        answer.add_done_callback(partial(self._answered, member, sent))

    def _begin(self, member: Member) -> None:
        """Start timing a worker's first job."""
        self._account.begin(member.number)
        member.begun = self._loop.time()
        member.overdue = self._loop.call_later(self._deadline, self._overdue, member)

    def _end(self, member: Member, worked: float | None = None) -> None:
        member.drop_timer()
        self._account.end(member.number, worked)

    def _answered(self, member: Member, sent: SentJob, answer: asyncio.Future[WorkerReply]) -> None:
        import ray

        error = answer.exception()
        if member not in self._workers:
            return  # its jobs are at other workers
        if isinstance(error, ray.exceptions.RayActorError):
            self._lose(member)
            return
        was_first = member.sent[0] is sent
        member.sent.remove(sent)
        if was_first:
            self._end(member, None if error is not None else answer.result().seconds)
            if member.sent:
                self._begin(member)
        if not sent.recalled:
            self._account.jobs += 1
            _settle(sent.job, answer)
        self._dispatch()

    def _overdue(self, member: Member) -> None:
        """The first job has taken too long."""
        sent = member.sent[0]
        if not sent.recalled:
            sent.recalled = True
            sent.job.fail(SimulationError(f"no result within {self._deadline:g} s; its simulator was replaced"))
        self._lose(member)

    def _give_up(self, job: SimulationJob) -> None:
        """Give up a job whose caller does not wait any more."""
        self._account.cancelled += 1
        if job in self._waiting:
            self._waiting.remove(job)
            return
        for member in self._workers.up:
            for sent in member.sent:
                if sent.job is job and not sent.recalled:
                    _recall(member, sent)
                    self._loop.call_later(DRAIN_DEADLINE, self._still_draining, member, sent)

    def _still_draining(self, member: Member, sent: SentJob) -> None:
        if member in self._workers and member.sent and member.sent[0] is sent:
            self._lose(member)

    def _lose(self, member: Member) -> None:
        """Replace a worker that is lost or has to be ended. Its jobs go to others; its running job counts one death."""
        self._account.deaths += 1
        self._end(member)
        orphans = [sent.job for sent in member.sent if not sent.recalled]
        if member.sent and not member.sent[0].recalled:
            first = orphans[0]
            first.deaths += 1
            if first.deaths > self._retries:
                particles = first.task.parameters.particles
                first.fail(
                    SimulationError(
                        f"{first.deaths} simulators died over this job; they may lack memory (particles: {particles})"
                    )
                )
                del orphans[0]
        self._waiting.extendleft(reversed(orphans))
        self._workers.lose(member, len(orphans))
        self._dispatch()

    def _limit_wait(self) -> None:
        """Limit the wait of jobs while no worker is up. If none is starting, they fail at once."""
        if not self._waiting or self._workers.up:
            if self._wait_timer is not None:
                self._wait_timer.cancel()
                self._wait_timer = None
        elif self._workers.hopeless:
            self._fail_waiting()
        elif self._wait_timer is None:
            self._wait_timer = self._loop.call_later(START_DEADLINE, self._fail_waiting)

    def _fail_waiting(self) -> None:
        """Fail waiting jobs with an error of the laboratory, not of their simulations."""
        self._wait_timer = None
        reason = self._workers.problem or (
            f"no simulator was up for {START_DEADLINE:g} s; is there a free core, and memory, for one?"
        )
        while self._waiting:
            self._waiting.popleft().fail(LaboratoryError(reason))

    def abandon(self, error: LaboratoryError) -> None:
        """Fail all present and future jobs, because their simulators cannot be restored.

        Args:
            error: the reason.
        """
        self._abandoned = error
        for member in self._workers.up:
            self._waiting.extend(sent.job for sent in member.sent if not sent.recalled)
            for sent in member.sent:
                sent.recalled = True
        while self._waiting:
            self._waiting.popleft().fail(error)

    async def close(self) -> None:
        """Write the workers' compiled kernels and end their processes; remaining jobs have no result."""
        if self._closed:
            return
        self._closed = True
        if self._wait_timer is not None:
            self._wait_timer.cancel()
        busy = [member for member in self._workers.up if member.sent]
        for member in busy:
            member.drop_timer()
            for sent in [sent for sent in member.sent if not sent.recalled]:
                _recall(member, sent)
                self._waiting.append(sent.job)
        while self._waiting:
            self._waiting.popleft().fail(SimulationError("the pool of simulators is closed"))
        patience = CLOSE_DEADLINE + (DRAIN_DEADLINE if busy else 0.0)
        await self._workers.close(0.0 if self._abandoned is not None else patience)


def _recall(member: Member, sent: SentJob) -> None:
    """Recall a job. If it has not begun, it never begins; if it has, it stops between two steps."""
    sent.recalled = True
    with contextlib.suppress(Exception):
        member.actor.recall.options(concurrency_group=CONTROL).remote(sent.number)


def _settle(job: SimulationJob, answer: asyncio.Future[WorkerReply]) -> None:
    """Set a job's result, or the reason why there is none."""
    import ray

    error = answer.exception()
    if error is None:
        if not job.future.done():
            job.future.set_result(answer.result().result.copied())
    elif isinstance(error, ray.exceptions.RayTaskError):
        known = isinstance(error.cause, InvalidActionError | SimulationError)
        job.fail(error.cause if known else SimulationError(f"the simulator failed: {error.cause!r}"))
    else:
        job.fail(SimulationError(f"the simulator's answer was lost: {error}"))
