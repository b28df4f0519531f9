"""One pool of simulators for several who know nothing of each other: each gets its turn, whoever asks for most."""

from __future__ import annotations

import asyncio
from collections import deque

from actors.interfaces import SimulatorPool
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

AHEAD = 2
"""Jobs that the pool holds per simulator: one that runs and one that waits there, so that none stands idle."""


class FairPool:
    """Hands out shares of a pool. Jobs of one share keep their order; the shares take turns.

    Args:
        pool: is not closed by any share.
    """

    def __init__(self, pool: SimulatorPool) -> None:
        self._pool = pool
        self._under_way = 0
        self._turns: deque[Share] = deque()

    @property
    def pool(self) -> SimulatorPool:
        """What is shared."""
        return self._pool

    def share(self) -> Share:
        """One more user of it."""
        return Share(self)

    async def simulate(self, task: PourTask, share: Share) -> SimulatedPour:
        """Run a job in its share's turn. Cancelling the awaiting task cancels it."""
        if self._turns or self._under_way >= AHEAD * self._pool.size:
            turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            share.waiting.append(turn)
            if share not in self._turns:
                self._turns.append(share)
            try:
                await turn
            except asyncio.CancelledError:
                if turn.cancelled():
                    share.waiting.remove(turn)
                    if not share.waiting and share in self._turns:
                        self._turns.remove(share)
                else:  # its turn had come
                    self._under_way -= 1
                    self._next()
                raise
        else:
            self._under_way += 1
        try:
            return await self._pool.simulate(task)
        finally:
            self._under_way -= 1
            self._next()

    def _next(self) -> None:
        while self._turns and self._under_way < AHEAD * self._pool.size:
            share = self._turns.popleft()
            turn = share.waiting.popleft()
            if share.waiting:
                self._turns.append(share)
            if not turn.done():
                self._under_way += 1
                turn.set_result(None)


class Share:
    """`SimulatorPool` for one of several users.

    Args:
        fair: that gives turns.
    """

    def __init__(self, fair: FairPool) -> None:
        self._fair = fair
        self.waiting: deque[asyncio.Future[None]] = deque()

    @property
    def size(self) -> int:
        """Members of the whole pool: where nobody else wants it, all of it."""
        return self._fair.pool.size

    @property
    def separate(self) -> bool:
        """As the pool's are."""
        return self._fair.pool.separate

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`."""
        return await self._fair.simulate(task, self)

    async def close(self) -> None:
        """The pool is somebody else's."""
