"""The members of a pool: started, greeted, replaced when they are lost, and ended."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

from actors.cluster.versions import Versions
from actors.simulation.actor import Greeting
from actors.simulation.member import Member, look_away

RESTART_PAUSE = 20.0
"""After a member's process failed to start, another one is tried so much later [s]: the cause may be lasting."""

_TELLING_PAUSE = 1.0
"""Losses within so much time are reported together [s]: a lost node takes many with it."""


class Crew:
    """Keeps a number of simulator actors alive. Those that can't be placed (a node was lost) are waited for.

    Args:
        size: number of members.
        start: starts an actor.
        expected: versions that members must have; None where they can't differ.
        changed: called when a member has come up, or can't.
        tell: told of losses, in words for people.
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
        self._start, self._expected, self._changed, self._tell = start, expected, changed, tell
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
        """Members whose processes have started."""
        return [member for member in self._members.values() if member.greeting is not None]

    @property
    def hopeless(self) -> bool:
        """Whether no member is up or starting."""
        return not self._members

    def __contains__(self, member: Member) -> bool:
        return member.number in self._members

    async def greeted(self) -> list[Greeting]:
        """What the members say of themselves; waits for those that are starting."""
        if self._members:
            await asyncio.wait([member.greeted for member in self._members.values()])
        return [member.greeting for member in self.up if member.greeting is not None]

    def grow(self, size: int) -> None:
        """Have at least so many members."""
        while self.size < size and not self._closed:
            self.size += 1
            self._add()

    def lose(self, member: Member, orphans: int) -> None:
        """A member is gone, or has to go; a new one takes its place.

        Args:
            member: which.
            orphans: how many jobs it leaves to others.
        """
        self._remove(member)
        if not self._losses:
            self._loop.call_later(_TELLING_PAUSE, self._tell_losses)
        self._losses.append(("" if member.greeting is None else member.greeting.host, orphans))
        self._add()

    async def close(self, deadline: float) -> None:
        """Have the members write their compiled kernels, then end their processes.

        Args:
            deadline: longest time for the writing [s].
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
        """A member's process is up, or does not start."""
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
        """A member that would fail again, or deceive; another one is tried later."""
        self._remove(member)
        if problem != self.problem:
            self.problem = problem
            self._tell(problem)
        self._loop.call_later(RESTART_PAUSE, self._add)

    def _remove(self, member: Member) -> None:
        self._members.pop(member.number, None)
        _kill(member)

    def _tell_losses(self) -> None:
        losses, self._losses = self._losses, []
        if self._closed:
            return
        hosts = ", ".join(sorted({host for host, _ in losses if host}))
        self._tell(
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
