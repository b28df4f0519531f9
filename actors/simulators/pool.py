"""The pool of simulators: a queue, and workers that run its jobs.

    pool = WorkerPool(2, make_worker)
    outcome = await pool.simulate(task)
    …
    await pool.close()

- `WorkerPool` has the queue, turns between users, retries, deadlines and statistics. It implements `SimulatorPool`.
- `Worker` is one simulator. `actors.simulators.local_worker` has a thread and a child process,
  `actors.simulators.ray_worker` a Ray actor.
- `WorkerPool.share` gives one of several users a `SimulatorPool` of its own. Users take turns.

Simulations are idempotent: a job whose worker died is repeated by another worker.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from actors.interfaces import LaboratoryError, SimulationError
from actors.runtime.child_process import START_DEADLINE
from actors.runtime.remote_object import mark_retrieved
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

RETRIES = 2
"""Number of repetitions of a job after workers died during it."""

DEADLINE = 1800.0
"""Longest time for one job on one worker [s]: a worker that needs half an hour counts as dead, not slow."""

DRAIN_DEADLINE = 10.0
"""Time that a cancelled job has to stop [s]; after that its worker is replaced."""

CLOSE_DEADLINE = 10.0
"""Time that a worker has to write its kernels at the end [s]."""

RESTART_PAUSE = 20.0
"""Pause after a worker could not be used [s], because the cause may last."""

_REPORT_PAUSE = 1.0
"""Losses within this time are reported together [s]: a lost node loses many workers."""


class WorkerLostError(Exception):
    """The worker has died or does not respond.

    Args:
        how: it ended, if that is known.
        messages: the last lines of its standard error, as the likely cause.
    """

    def __init__(self, how: str = "", messages: str = "") -> None:
        super().__init__("; ".join(filter(None, (how, messages and f"its last messages: {messages}"))))
        self.messages = messages


class WorkerUnusableError(Exception):
    """The worker does not start, or would return different results than other workers. The text is for the user."""


@dataclass(frozen=True)
class Greeting:
    """A worker's description of itself when it is up.

    Attributes:
        pid: its process id.
        host: the name and address of another machine, for messages; '' on this one.
        died: done once the process has died, also without a job; None if that is noticed by the next job.
    """

    pid: int
    host: str = ""
    died: asyncio.Future[None] | None = None


@dataclass(frozen=True)
class WorkerReply:
    """A result, and the time that the worker spent on it [s]."""

    result: SimulatedPour
    seconds: float


class Worker(Protocol):
    """One simulator. It runs its jobs one after another."""

    async def start(self) -> Greeting:
        """Start it and wait until it is up.

        Raises:
            WorkerLostError: it died during the start.
            WorkerUnusableError: another worker would fail in the same way.
        """
        ...

    async def run(self, number: int, task: PourTask) -> WorkerReply:
        """Run a job after those that were sent before.

        Args:
            number: identifies the job for `cancel`.
            task: the pour to simulate.

        Raises:
            JobCancelledError: the job was cancelled.
            InvalidActionError, SimulationError: it has no result.
            WorkerLostError: the worker died.
        """
        ...

    def cancel(self, number: int) -> None:
        """Cancel a job: it never begins, or it stops between two time steps. Does not wait."""
        ...

    async def close(self, timeout: float) -> None:
        """Let the worker write its compiled kernels, then end it.

        Args:
            timeout: longest time for writing [s]; 0 ends it at once.
        """
        ...


@dataclass(frozen=True)
class PoolStatistics:
    """Statistics of a pool.

    Attributes:
        jobs: finished, including refused ones.
        cancelled: cancelled because the result was not needed any more.
        deaths: workers lost and replaced.
        busy_s: wall-clock time that workers worked, summed [s]; by their own clocks if they report it.
    """

    jobs: int
    cancelled: int
    deaths: int
    busy_s: float


@dataclass(eq=False)
class _Job:
    """A simulation that a caller waits for. `deaths` counts the workers that died during it."""

    task: PourTask
    user: object
    future: asyncio.Future[SimulatedPour]
    deaths: int = 0

    def fail(self, error: Exception) -> None:
        if not self.future.done():
            self.future.set_exception(error)


class _Queue:
    """Waiting jobs. Repeated jobs come first. Then users take turns; jobs of one user keep their order."""

    def __init__(self) -> None:
        self._repeated: deque[_Job] = deque()
        self._turns: dict[object, deque[_Job]] = {}

    def __bool__(self) -> bool:
        return bool(self._repeated or self._turns)

    def add(self, job: _Job) -> None:
        self._turns.setdefault(job.user, deque()).append(job)

    def repeat(self, jobs: Sequence[_Job]) -> None:
        self._repeated.extendleft(reversed(jobs))

    def pop(self) -> _Job:
        if self._repeated:
            return self._repeated.popleft()
        user = next(iter(self._turns))
        jobs = self._turns.pop(user)
        job = jobs.popleft()
        if jobs:
            self._turns[user] = jobs  # behind the other users
        return job

    def discard(self, job: _Job) -> bool:
        """Remove a job. Returns whether it was waiting."""
        jobs = self._repeated if job in self._repeated else self._turns.get(job.user, deque())
        if job not in jobs:
            return False
        jobs.remove(job)
        if job.user in self._turns and not self._turns[job.user]:
            del self._turns[job.user]
        return True


@dataclass(eq=False)
class _SentJob:
    """A job that was sent to a worker. A recalled one was cancelled, or given to another worker."""

    job: _Job
    number: int
    recalled: bool = False


@dataclass(eq=False)
class _Member:
    """A worker of the pool.

    Attributes:
        started: done when the worker is up, or has failed to start.
        greeting: None unless the worker is up. Stored, since a pool of thousands reads it at every decision.
        sent: jobs in the order in which they run; the first one is running.
        overdue: fires when the first job takes too long.
        begun: start of the first job [s of time.monotonic()].
    """

    worker: Worker
    started: asyncio.Task[Greeting]
    greeting: Greeting | None = None
    sent: deque[_SentJob] = field(default_factory=deque)
    overdue: asyncio.TimerHandle | None = None
    begun: float = 0.0

    @property
    def spare(self) -> _SentJob | None:
        """The last job, if it cannot have begun and is still needed."""
        return self.sent[-1] if len(self.sent) > 1 and not self.sent[-1].recalled else None

    def recall(self, sent: _SentJob) -> None:
        """Recall a job: it never begins, or it stops between two time steps."""
        sent.recalled = True
        self.worker.cancel(sent.number)

    def stop_timer(self) -> None:
        if self.overdue is not None:
            self.overdue.cancel()
            self.overdue = None


# More than 25 methods: its queue, waits and losses share one state.
class WorkerPool:
    """A `SimulatorPool` of workers. Jobs begin in their order of arrival, as far as turns and deaths allow.

    Workers that die are replaced. Workers that cannot be placed, because a node of a cluster is lost, are waited for.
    The pool starts with `open` or with the first job.

    Args:
        size: number of workers.
        make_worker: creates one; it is not started yet.
        separate: whether workers are separate processes. Others cannot be killed, so that deadlines do not apply.
        ahead: number of jobs sent to a busy worker, so that it begins the next one without a request. If a worker
            becomes idle while another one still has such a job, the job is given to the idle one.
        retries: how often a job is tried again after a death.
        deadline: longest time for one job [s].
        tell: called with a message about losses.
    """

    def __init__(
        self,
        size: int,
        make_worker: Callable[[], Worker],
        *,
        separate: bool = True,
        ahead: int = 0,
        retries: int = RETRIES,
        deadline: float = DEADLINE,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._size, self._make_worker, self._separate, self._ahead = size, make_worker, separate, ahead
        self._retries, self._deadline, self._report = retries, deadline, tell
        self._members: list[_Member] = []
        self._queue = _Queue()
        self._sendings = self._jobs = self._cancelled = self._deaths = 0
        self._busy_s = 0.0
        self._losses: list[tuple[str, int]] = []
        self._ending: set[asyncio.Task[None]] = set()
        self._wait_timer: asyncio.TimerHandle | None = None
        self._problem = ""
        self._abandoned: LaboratoryError | None = None
        self._is_open = self._closed = False

    @property
    def size(self) -> int:
        """Number of workers, including those that are not up yet."""
        return self._size

    @property
    def separate(self) -> bool:
        """See `SimulatorPool.separate`."""
        return self._separate

    def statistics(self) -> PoolStatistics:
        """Statistics up to now, including running jobs."""
        busy_s = self._busy_s + sum(time.monotonic() - member.begun for member in self._up if member.sent)
        return PoolStatistics(self._jobs, self._cancelled, self._deaths, busy_s)

    def share(self) -> PoolShare:
        """Return a `SimulatorPool` for one of several users."""
        return PoolShare(self)

    def open(self) -> None:
        """Start the workers. Needs a running event loop. May be called again."""
        if not self._is_open:
            self._is_open = True
            for _ in range(self._size):
                self._add()

    def grow(self, size: int) -> None:
        """Increase the number of workers to at least `size`."""
        while self._size < size and not self._closed:
            self._size += 1
            self._add()

    async def pids(self) -> list[int]:
        """Process ids of the workers; waits for those that are starting."""
        self.open()
        if self._members:
            await asyncio.wait([member.started for member in self._members])
        return [member.greeting.pid for member in self._members if member.greeting is not None]

    async def simulate(self, task: PourTask, user: object = None) -> SimulatedPour:
        """See `SimulatorPool.simulate`.

        Args:
            task: the pour to simulate.
            user: users take turns.

        Raises:
            LaboratoryError: no simulator is up and none starts, or the error that the pool was abandoned with.
        """
        if self._closed:
            raise SimulationError("the pool of simulators is closed")
        if self._abandoned is not None:
            raise self._abandoned
        self.open()
        job = _Job(task, user, asyncio.get_running_loop().create_future())
        self._queue.add(job)
        self._dispatch()
        try:
            return await job.future
        except asyncio.CancelledError:
            self._cancel(job)
            raise

    def abandon(self, error: LaboratoryError) -> None:
        """Fail all present and future jobs, because their simulators cannot be restored.

        Args:
            error: the reason.
        """
        self._abandoned = error
        for member in self._up:
            for sent in [sent for sent in member.sent if not sent.recalled]:
                sent.recalled = True
                sent.job.fail(error)
        self._fail_waiting(error)

    async def close(self) -> None:
        """Write the workers' compiled kernels and end them; remaining jobs have no result. May be called again."""
        if self._closed:
            return
        self._closed = True
        self._stop_waiting()
        error = SimulationError("the pool of simulators is closed")
        timeout = CLOSE_DEADLINE
        for member in self._up:
            member.stop_timer()
            if member.sent:
                timeout = CLOSE_DEADLINE + DRAIN_DEADLINE
            for sent in [sent for sent in member.sent if not sent.recalled]:
                member.recall(sent)
                sent.job.fail(error)
        self._fail_waiting(error)
        members, self._members = self._members, []
        if self._abandoned is not None:
            timeout = 0.0
        for member in members:
            self._end(member, 0.0 if member.greeting is None and self._separate else timeout)
        starting = [member.started for member in members if not member.started.done()]
        for started in starting:
            started.cancel()
        await asyncio.gather(*self._ending, *starting, return_exceptions=True)

    # ---- workers

    @property
    def _up(self) -> list[_Member]:
        return [member for member in self._members if member.greeting is not None]

    def _add(self) -> None:
        if self._closed:
            return
        try:
            worker = self._make_worker()
        except Exception as error:  # as while memory is short
            self._postpone(f"a simulator can't be started: {error}")
            return
        member = _Member(worker, asyncio.ensure_future(worker.start()))
        self._members.append(member)
        member.started.add_done_callback(partial(self._started, member))

    def _started(self, member: _Member, started: asyncio.Task[Greeting]) -> None:
        """A worker is up, or does not start."""
        if started.cancelled():  # the event loop ends, or the pool: what would begin now would never run
            return
        error = started.exception()
        if error is None:
            member.greeting = started.result()
            if member.greeting.died is not None:
                member.greeting.died.add_done_callback(partial(self._died, member))
        if member not in self._members:
            return
        if isinstance(error, WorkerLostError):
            if error.messages:
                self._problem = f"a simulator died at its start; {error}"
            self._lose(member, error)
        elif error is not None:
            unusable = isinstance(error, WorkerUnusableError)
            self._refuse(member, str(error) if unusable else f"a simulator can't be started: {error}")
        self._dispatch()

    def _died(self, member: _Member, died: asyncio.Future[None]) -> None:
        """A process has died. If it had jobs, their replies say why."""
        if member in self._members and not member.sent and not died.cancelled() and self._abandoned is None:
            self._lose(member)

    def _refuse(self, member: _Member, problem: str) -> None:
        """Reject a worker that would fail again or return different results; start another one later."""
        self._members.remove(member)
        self._end(member, 0.0)
        self._postpone(problem)

    def _postpone(self, problem: str) -> None:
        """Start a worker later, because one could not be started or used now."""
        if problem != self._problem:
            self._problem = problem
            self._report(problem)
        asyncio.get_running_loop().call_later(RESTART_PAUSE, self._add)

    def _end(self, member: _Member, timeout: float) -> None:
        if member.greeting is not None and member.greeting.died is not None:
            member.greeting.died.cancel()
        task = asyncio.ensure_future(member.worker.close(timeout))
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)
        task.add_done_callback(mark_retrieved)

    def _lose(self, member: _Member, error: WorkerLostError | None = None) -> None:
        """Replace a worker that is lost or has to be ended. Its jobs go to others; its running job counts one death."""
        self._deaths += 1
        self._stop_timing(member)
        orphans = [sent.job for sent in member.sent if not sent.recalled]
        if member.sent and not member.sent[0].recalled:
            first = orphans[0]
            first.deaths += 1
            if first.deaths > self._retries:
                how = f" (the last one: {error})" if error is not None and str(error) else ""
                if error is None or not error.messages:
                    how += f"; they may lack memory (particles: {first.task.parameters.particles})"
                first.fail(SimulationError(f"{first.deaths} simulators died over this job{how}"))
                del orphans[0]
        self._queue.repeat(orphans)
        self._members.remove(member)
        self._end(member, 0.0)
        if not self._losses:
            asyncio.get_running_loop().call_later(_REPORT_PAUSE, self._report_losses)
        self._losses.append(("" if member.greeting is None else member.greeting.host, len(orphans)))
        self._add()
        self._dispatch()

    def _report_losses(self) -> None:
        losses, self._losses = self._losses, []
        if self._closed:
            return
        hosts = ", ".join(sorted({host for host, _ in losses if host}))
        count = sum(count for _, count in losses)
        jobs = f"{count} simulation(s) are repeated by others" if count else "no simulation has to be repeated"
        self._report(
            f"{len(losses)} simulator(s) lost{f' on {hosts}' if hosts else ''}: {jobs}; "
            f"{len(self._up)} of {self._size} are up"
        )

    # ---- jobs

    def _dispatch(self) -> None:
        """Assign waiting jobs to workers. If none waits, move jobs from busy workers to idle ones."""
        while self._queue and (member := self._next_member()) is not None:
            self._send(self._queue.pop(), member)
        if not self._queue:
            self._level()
        self._limit_wait()

    def _next_member(self) -> _Member | None:
        """The worker that is expected to begin another job first."""
        idle = next((member for member in self._members if not member.sent and member.greeting is not None), None)
        if idle is not None:
            return idle
        free = [member for member in self._members if len(member.sent) <= self._ahead and member.greeting is not None]
        return min(free, key=lambda member: (len(member.sent), member.begun), default=None)

    def _level(self) -> None:
        members = self._up
        for idle in [member for member in members if not member.sent]:
            busy = next((member for member in members if member.spare is not None), None)
            if busy is None or (spare := busy.spare) is None:
                return
            busy.recall(spare)
            self._send(spare.job, idle)

    def _send(self, job: _Job, member: _Member) -> None:
        self._sendings += 1
        sent = _SentJob(job, self._sendings)
        member.sent.append(sent)
        if len(member.sent) == 1:
            self._start_timing(member)
        reply = asyncio.ensure_future(member.worker.run(sent.number, job.task))
        reply.add_done_callback(partial(self._replied, member, sent))

    def _start_timing(self, member: _Member) -> None:
        member.begun = time.monotonic()
        if self._separate:
            member.overdue = asyncio.get_running_loop().call_later(self._deadline, self._overdue, member)

    def _stop_timing(self, member: _Member, worked: float | None = None) -> None:
        """Add the time of a worker's first job to the statistics: its own measurement [s], or since it began."""
        member.stop_timer()
        if member.sent:
            self._busy_s += time.monotonic() - member.begun if worked is None else worked

    def _replied(self, member: _Member, sent: _SentJob, reply: asyncio.Task[WorkerReply]) -> None:
        error = asyncio.CancelledError() if reply.cancelled() else reply.exception()
        if member not in self._members:
            return  # its jobs are at other workers
        if isinstance(error, WorkerLostError):
            self._lose(member, error)
            return
        if member.sent[0] is sent:
            self._stop_timing(member, None if error is not None else reply.result().seconds)
            member.sent.popleft()
            if member.sent:
                self._start_timing(member)
        else:
            member.sent.remove(sent)
        if not sent.recalled:
            self._jobs += 1
            if error is None and not sent.job.future.done():
                sent.job.future.set_result(reply.result().result)
            elif isinstance(error, LaboratoryError):
                sent.job.fail(error)
            elif error is not None:
                sent.job.fail(SimulationError(f"the simulator's answer was lost: {error!r}"))
        if not isinstance(error, asyncio.CancelledError):  # else the event loop ends
            self._dispatch()

    def _overdue(self, member: _Member) -> None:
        """The first job has taken too long."""
        sent = member.sent[0]
        if not sent.recalled:
            sent.recalled = True
            sent.job.fail(SimulationError(f"no result within {self._deadline:g} s; its simulator was replaced"))
        self._lose(member)

    def _cancel(self, job: _Job) -> None:
        """Cancel a job whose caller does not wait any more."""
        self._cancelled += 1
        if self._queue.discard(job):
            return
        for member in self._up:
            for sent in member.sent:
                if sent.job is job and not sent.recalled:
                    member.recall(sent)
                    if self._separate:
                        asyncio.get_running_loop().call_later(DRAIN_DEADLINE, self._still_draining, member, sent)

    def _still_draining(self, member: _Member, sent: _SentJob) -> None:
        if member in self._members and member.sent and member.sent[0] is sent:
            self._lose(member)

    def _limit_wait(self) -> None:
        """Limit the wait of jobs while no worker is up. If none is starting, they fail at once."""
        if not self._queue or any(member.greeting is not None for member in self._members):
            self._stop_waiting()
        elif not self._members:
            self._fail_waiting(self._no_worker())
        elif self._wait_timer is None:
            self._wait_timer = asyncio.get_running_loop().call_later(
                START_DEADLINE, lambda: self._fail_waiting(self._no_worker())
            )

    def _stop_waiting(self) -> None:
        if self._wait_timer is not None:
            self._wait_timer.cancel()
            self._wait_timer = None

    def _no_worker(self) -> LaboratoryError:
        """The laboratory's error, not the simulations': no worker is up."""
        reason = f"no simulator was up for {START_DEADLINE:g} s; is there a free core, and memory, for one?"
        return LaboratoryError(self._problem or reason)

    def _fail_waiting(self, error: LaboratoryError) -> None:
        self._stop_waiting()
        while self._queue:
            self._queue.pop().fail(error)


class PoolShare:
    """A `SimulatorPool` for one of several users of a pool.

    Args:
        pool: the pool; closing a share does not close it.
    """

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool

    @property
    def size(self) -> int:
        """Size of the whole pool: a share uses all of it while the others are idle."""
        return self._pool.size

    @property
    def separate(self) -> bool:
        """See `SimulatorPool.separate`."""
        return self._pool.separate

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`."""
        return await self._pool.simulate(task, self)
