"""A pool of simulators in processes of their own that survives its members' deaths."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from actors.protocols import Frames, InvalidActionError, SimulationError, SimulationResult
from actors.simulation.actor import simulator_actor
from actors.simulation.statistics import Account, PoolStatistics
from actors.simulation.worker import Simulator, pour_simulator
from sim_engine.task import PourTask

RETRIES = 2
"""How often a job is given to another member after one died over it."""

DEADLINE = 1800.0
"""Longest time for one job on one member [s]: half an hour means dead, not slow."""

START_DEADLINE = 120.0
"""Longest time for a member's process to start [s]."""

DRAIN_DEADLINE = 10.0
"""Time a cancelled job has to stop [s]; then its member is replaced."""

CLOSE_DEADLINE = 10.0
"""Time a member has to write its kernels at the end [s]."""


@dataclasses.dataclass(eq=False)
class _Member:
    """A simulator actor. A number is used once, so that the dead are not taken for the living."""

    number: int
    actor: Any
    up: asyncio.Future[Any]


class RaySimulatorPool:
    """`SimulatorPool` over Ray actors. Jobs wait for the next idle member in the order in which they came.

    Simulations are idempotent, so a job whose member died is done again by another one. Needs a running Ray
    (`actors.ray_runtime`), and is made inside an event loop.

    Args:
        size: number of members.
        make: makes a member's simulator, inside its process.
        retries: how often a job is tried again after a death.
        deadline: longest time for one job [s].
        cpus: cores that Ray counts for a member.
    """

    def __init__(
        self,
        size: int,
        *,
        make: Callable[[], Simulator] = pour_simulator,
        retries: int = RETRIES,
        deadline: float = DEADLINE,
        cpus: float = 1.0,
    ) -> None:
        self._make, self._retries, self._deadline, self._cpus = make, retries, deadline, cpus
        self._idle: asyncio.Queue[_Member] = asyncio.Queue()
        self._members: dict[int, _Member] = {}
        self._numbers = 0
        self._draining: set[asyncio.Task[None]] = set()
        self._account = Account(size)
        self._closed = False
        for _ in range(size):
            self._add()

    @property
    def size(self) -> int:
        """Number of members."""
        return self._account.size

    def statistics(self) -> PoolStatistics:
        """What the pool has done so far."""
        return self._account.statistics()

    async def pids(self) -> list[int]:
        """Process ids of the members; waits for those that are starting or working."""
        refs = [member.actor.pid.remote() for member in self._members.values()]
        return list(await asyncio.gather(*(asyncio.wrap_future(ref.future()) for ref in refs)))

    async def simulate(self, task: PourTask) -> SimulationResult:
        """See `SimulatorPool.simulate`."""
        for _ in range(1 + self._retries):
            if self._closed:
                raise SimulationError("the pool of simulators is closed")
            member = await self._idle.get()
            self._account.begin(member.number)
            result = await self._run(member, task)
            if result is not None:
                return result
        raise SimulationError(
            f"{1 + self._retries} simulators died over this job; they may lack memory (particles: "
            f"{task.parameters.particles})"
        )

    async def _run(self, member: _Member, task: PourTask) -> SimulationResult | None:
        """One attempt; None if the member died."""
        import ray

        ref = member.actor.simulate.remote(task)
        answer = asyncio.wrap_future(ref.future())
        try:
            waiting = {answer, member.up}
            await asyncio.wait(waiting, timeout=START_DEADLINE, return_when=asyncio.FIRST_COMPLETED)
            done, _ = await asyncio.wait({answer}, timeout=self._deadline if member.up.done() else 0.0)
        except asyncio.CancelledError:
            # The member is idle again when it has noticed, not before: the next job must not wait behind a dead one.
            self._account.cancelled += 1
            ray.cancel(ref)
            self._drain(member, answer)
            raise
        if not done:
            self._replace(member)
            answer.add_done_callback(_look_away)
            if not member.up.done():
                raise SimulationError(f"a simulator's process did not start within {START_DEADLINE:g} s")
            raise SimulationError(f"no result within {self._deadline:g} s; its simulator was replaced")
        try:
            result: SimulationResult = answer.result()
        except ray.exceptions.RayActorError as error:
            self._replace(member)
            if "error raised in its creation task" in str(error):
                raise SimulationError(f"a simulator's process does not start: {_last_line(error)}") from error
            return None
        except ray.exceptions.RayTaskError as error:
            self._release(member)
            if isinstance(error.cause, InvalidActionError | SimulationError):
                raise error.cause from None
            raise SimulationError(f"the simulator failed: {error.cause!r}") from error
        except Exception as error:
            self._release(member)
            raise SimulationError(f"the simulator's answer was lost: {error}") from error
        self._release(member)
        return _own(result)

    def _add(self) -> None:
        self._numbers += 1
        actor = simulator_actor(self._make, cpus=self._cpus)
        up = asyncio.wrap_future(actor.pid.remote().future())
        up.add_done_callback(_look_away)
        member = _Member(self._numbers, actor, up)
        self._members[member.number] = member
        self._idle.put_nowait(member)

    def _release(self, member: _Member) -> None:
        self._account.jobs += 1
        self._account.end(member.number)
        self._idle.put_nowait(member)

    def _replace(self, member: _Member) -> None:
        """End a member for good; a new one takes its place."""
        import ray

        self._account.deaths += 1
        self._account.end(member.number)
        del self._members[member.number]
        with contextlib.suppress(Exception):
            ray.kill(member.actor)
        if not self._closed:
            self._add()

    def _drain(self, member: _Member, answer: asyncio.Future[Any]) -> None:
        task = asyncio.get_running_loop().create_task(self._drained(member, answer))
        self._draining.add(task)
        task.add_done_callback(self._draining.discard)

    async def _drained(self, member: _Member, answer: asyncio.Future[Any]) -> None:
        import ray

        done, _ = await asyncio.wait({answer}, timeout=DRAIN_DEADLINE)
        if not done:
            answer.add_done_callback(_look_away)
        if not done or isinstance(answer.exception(), ray.exceptions.RayActorError):
            self._replace(member)
        else:
            self._account.end(member.number)
            self._idle.put_nowait(member)

    async def close(self) -> None:
        """Let cancelled jobs end, write the members' compiled kernels, and end their processes."""
        import ray

        self._closed = True
        if self._draining:
            await asyncio.wait(set(self._draining), timeout=DRAIN_DEADLINE + 1.0)
        members, self._members = list(self._members.values()), {}
        closing = {asyncio.ensure_future(asyncio.wrap_future(m.actor.close.remote().future())) for m in members}
        if closing:
            done, late = await asyncio.wait(closing, timeout=CLOSE_DEADLINE)
            for answer in done:
                _look_away(answer)
            for answer in late:
                answer.add_done_callback(_look_away)
        for member in members:
            with contextlib.suppress(Exception):
                ray.kill(member.actor)


def _look_away(answer: asyncio.Future[Any]) -> None:
    """Take note of a late answer, so that asyncio does not complain that nobody did."""
    if not answer.cancelled():
        answer.exception()


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else repr(error)


def _own(result: SimulationResult) -> SimulationResult:
    """Copies of the frames: those that came through Ray's object store would hold its memory as long as they live."""
    if result.frames is None:
        return result
    frames = result.frames
    copied = Frames(
        times=np.array(frames.times),
        positions=[np.array(p) for p in frames.positions],
        states=[np.array(s) for s in frames.states],
        pourer_poses=np.array(frames.pourer_poses),
    )
    return dataclasses.replace(result, frames=copied)
