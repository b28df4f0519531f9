"""A pool of simulators in processes of their own that survives its members' deaths."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from actors.cluster.versions import Versions
from actors.protocols import InvalidActionError, LaboratoryError, SimulationError
from actors.simulation.actor import CONTROL, Answer, simulator_actor
from actors.simulation.crew import Crew
from actors.simulation.job_runner import RETRIES, Simulator, pour_simulator
from actors.simulation.member import Job, Member, Sent
from actors.simulation.parcel import Packer
from actors.simulation.statistics import Account, PoolStatistics
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask

DEADLINE = 1800.0
"""Longest time for one job on one member [s]: half an hour means dead, not slow."""

START_DEADLINE = 120.0
"""Longest time that jobs wait while no member is up [s]."""

DRAIN_DEADLINE = 10.0
"""Time a cancelled job has to stop [s]; then its member is replaced."""

CLOSE_DEADLINE = 10.0
"""Time a member has to write its kernels at the end [s]."""

AHEAD = 1
"""Jobs that wait at a busy member, so that it begins the next one without asking."""


class RaySimulatorPool:
    """`SimulatorPool` over Ray actors. Jobs begin in the order in which they came, as far as members' deaths allow.

    Each busy member has the next job with it already. Where a member runs out of work while another one still has a
    job waiting, the job is taken back and given to the idle one. Simulations are idempotent, so a job whose member
    died is done again by another one. Needs a running Ray (`actors.ray_runtime`), and is made inside an event loop.

    Args:
        size: number of members.
        make: makes a member's simulator, inside its process.
        retries: how often a job is tried again after a death.
        deadline: longest time for one job [s].
        cpus: cores that Ray counts for a member.
        placement: Ray's options that say where members run.
        expected: versions that members must have; None where they can't differ.
        tell: told of losses, in words for people.
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
        self._waiting: deque[Job] = deque()
        self._sendings = 0
        self._packer = Packer()
        self._meshes: dict[Path, Any] = {}
        self._account = Account(size)
        self._hopeless: asyncio.TimerHandle | None = None
        self._abandoned: LaboratoryError | None = None
        self._closed = False
        start = partial(simulator_actor, make, cpus=cpus, placement=placement or {})
        self._crew = Crew(size, start, expected=expected, changed=self._dispatch, tell=tell)

    @property
    def size(self) -> int:
        """Number of members, those included that are waited for."""
        return self._crew.size

    @property
    def separate(self) -> bool:
        """In processes of their own."""
        return True

    def statistics(self) -> PoolStatistics:
        """What the pool has done so far."""
        return self._account.statistics()

    def grow(self, size: int) -> None:
        """Have at least so many members from now on."""
        self._crew.grow(size)
        self._account.resize(self._crew.size)

    async def pids(self) -> list[int]:
        """Process ids of the members; waits for those that are starting."""
        return [greeting.pid for greeting in await self._crew.greeted()]

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`.

        Raises:
            LaboratoryError: no simulator is up, and none comes up; or whatever the pool was abandoned with.
        """
        if self._closed:
            raise SimulationError("the pool of simulators is closed")
        if self._abandoned is not None:
            raise self._abandoned
        packed, parcels = self._packer.pack(task)
        for parcel in parcels:
            if parcel.key not in self._meshes:
                import ray

                self._meshes[parcel.key] = ray.put(parcel)
        job = Job(packed, [self._meshes[parcel.key] for parcel in parcels], self._loop.create_future())
        self._waiting.append(job)
        self._dispatch()
        try:
            return await job.future
        except asyncio.CancelledError:
            self._give_up(job)
            raise

    def _dispatch(self) -> None:
        """Give waiting jobs to members; where there are none, share out those that wait at busy members."""
        while self._waiting and (member := self._next_member()) is not None:
            self._send(self._waiting.popleft(), member)
        if not self._waiting:
            self._level()
        self._keep_hope()

    def _next_member(self) -> Member | None:
        """The one that will come to another job first, as far as anybody knows."""
        free = [member for member in self._crew.up if len(member.sent) <= AHEAD]
        return min(free, key=lambda member: (len(member.sent), member.begun), default=None)

    def _level(self) -> None:
        members = self._crew.up
        for idle in [member for member in members if not member.sent]:
            busy = next((member for member in members if member.spare is not None), None)
            if busy is None or (spare := busy.spare) is None:
                return
            _recall(busy, spare)
            self._send(spare.job, idle)

    def _send(self, job: Job, member: Member) -> None:
        self._sendings += 1
        sent = Sent(job, self._sendings)
        ref = member.actor.simulate.remote(sent.number, job.task, *job.meshes)
        member.sent.append(sent)
        if len(member.sent) == 1:
            self._begin(member)
        answer = asyncio.wrap_future(ref.future())
        answer.add_done_callback(partial(self._answered, member, sent))

    def _begin(self, member: Member) -> None:
        """A member's first job is under way."""
        self._account.begin(member.number)
        member.begun = self._loop.time()
        member.overdue = self._loop.call_later(self._deadline, self._overdue, member)

    def _end(self, member: Member, worked: float | None = None) -> None:
        member.drop_timer()
        self._account.end(member.number, worked)

    def _answered(self, member: Member, sent: Sent, answer: asyncio.Future[Answer]) -> None:
        import ray

        error = answer.exception()
        if member not in self._crew:
            return  # its jobs are with others
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

    def _give_up(self, job: Job) -> None:
        """Nobody waits for it any more."""
        self._account.cancelled += 1
        if job in self._waiting:
            self._waiting.remove(job)
            return
        for member in self._crew.up:
            for sent in member.sent:
                if sent.job is job and not sent.recalled:
                    _recall(member, sent)
                    self._loop.call_later(DRAIN_DEADLINE, self._still_draining, member, sent)

    def _still_draining(self, member: Member, sent: Sent) -> None:
        if member in self._crew and member.sent and member.sent[0] is sent:
            self._lose(member)

    def _lose(self, member: Member) -> None:
        """A member is gone, or has to go: its jobs are for others. The one it was at has cost a life."""
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
        self._crew.lose(member, len(orphans))
        self._dispatch()

    def _keep_hope(self) -> None:
        """Jobs that wait while no member is up don't wait for ever, and not at all if none is even starting."""
        if not self._waiting or self._crew.up:
            if self._hopeless is not None:
                self._hopeless.cancel()
                self._hopeless = None
        elif self._crew.hopeless:
            self._fail_waiting()
        elif self._hopeless is None:
            self._hopeless = self._loop.call_later(START_DEADLINE, self._fail_waiting)

    def _fail_waiting(self) -> None:
        """This is the laboratory's fault, and says nothing about any simulation."""
        self._hopeless = None
        reason = self._crew.problem or (
            f"no simulator was up for {START_DEADLINE:g} s; is there a free core, and memory, for one?"
        )
        while self._waiting:
            self._waiting.popleft().fail(LaboratoryError(reason))

    def abandon(self, error: LaboratoryError) -> None:
        """All jobs fail, now and from now on: their simulators can't come back.

        Args:
            error: why.
        """
        self._abandoned = error
        for member in self._crew.up:
            self._waiting.extend(sent.job for sent in member.sent if not sent.recalled)
            for sent in member.sent:
                sent.recalled = True
        while self._waiting:
            self._waiting.popleft().fail(error)

    async def close(self) -> None:
        """Write the members' compiled kernels, and end their processes; jobs that are left have no result."""
        if self._closed:
            return
        self._closed = True
        if self._hopeless is not None:
            self._hopeless.cancel()
        busy = [member for member in self._crew.up if member.sent]
        for member in busy:
            member.drop_timer()
            for sent in [sent for sent in member.sent if not sent.recalled]:
                _recall(member, sent)
                self._waiting.append(sent.job)
        while self._waiting:
            self._waiting.popleft().fail(SimulationError("the pool of simulators is closed"))
        patience = CLOSE_DEADLINE + (DRAIN_DEADLINE if busy else 0.0)
        await self._crew.close(0.0 if self._abandoned is not None else patience)


def _recall(member: Member, sent: Sent) -> None:
    """A job that has not begun never will; one that has begun notices between its steps."""
    sent.recalled = True
    with contextlib.suppress(Exception):
        member.actor.recall.options(concurrency_group=CONTROL).remote(sent.number)


def _settle(job: Job, answer: asyncio.Future[Answer]) -> None:
    """Give a job its result, or the reason why there is none."""
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
