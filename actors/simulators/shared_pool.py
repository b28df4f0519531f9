"""One pool of simulators for several who know nothing of each other: each gets its turn, whoever asks for most.

Simulators that stay warm between laboratories: processes and compiled kernels are there before they are needed.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from actors.interfaces import LaboratoryError, Optimizer, SimulatorPool
from actors.laboratory import ClosablePool
from actors.laboratory_settings import LaboratorySpec, simulator_count
from actors.optimizer.optimizer_actor import DeviceOptimizer, Proposer
from actors.runtime.ray_runtime import watch_ray
from actors.runtime.remote_object import Device, LocalDevice, RayDevice
from actors.simulators.local_worker import InProcessSimulatorPool
from actors.simulators.pool import RaySimulatorPool
from actors.simulators.simulation_task import Simulator, give_back, pour_simulator
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


class WarmSimulators:
    """A pool that is opened once and shared, fairly, by all laboratories of this process.

    Args:
        simulators: size of the pool; 0: one per core.
        in_process: one simulator in this process, without Ray.
        make: makes simulators, where they run.
        tell: told of losses, in words for people.
    """

    def __init__(
        self,
        simulators: int = 0,
        *,
        in_process: bool = False,
        make: Callable[[], Simulator] = pour_simulator,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._spec = LaboratorySpec("warm", simulators=simulators, in_process=in_process)
        self._make, self._tell = make, tell
        self._pool: ClosablePool | None = None
        self._fair: FairPool | None = None
        self._proposer: Device | None = None
        self._watching: asyncio.Task[None] | None = None
        self._opening = asyncio.Lock()

    @property
    def ready(self) -> bool:
        """Whether it is open."""
        return self._fair is not None

    @property
    def size(self) -> int:
        """Simulators; 0 before it is open."""
        return 0 if self._pool is None else self._pool.size

    async def open(self) -> None:
        """Start them, unless that was done.

        Raises:
            LaboratoryError: Ray doesn't start.
        """
        async with self._opening:
            if self._fair is not None:
                return
            if self._spec.in_process:
                self._pool = InProcessSimulatorPool(make=self._make)
                self._proposer = LocalDevice("optimiser", Proposer)
            else:
                self._pool = pool = await self._open_ray()
                self._proposer = proposer = RayDevice("optimiser", Proposer, looked_after=True)

                def died(reason: str) -> None:
                    pool.abandon(LaboratoryError(reason))
                    proposer.abandon(reason)

                self._watching = asyncio.create_task(watch_ray(died))
            self._fair = FairPool(self._pool)

    async def _open_ray(self) -> RaySimulatorPool:
        from actors.runtime.ray_runtime import keep_signals, start_ray, stop_ray

        starting = asyncio.ensure_future(asyncio.to_thread(start_ray, self._spec))
        try:
            await asyncio.shield(starting)
        except asyncio.CancelledError:
            await asyncio.wait({starting})  # it can't be cut short, and must not outlive the one who wanted it
            if starting.exception() is None:
                await asyncio.to_thread(stop_ray)
            raise
        keep_signals()
        return RaySimulatorPool(simulator_count(self._spec), make=self._make, tell=self._tell)

    def share(self) -> Share:
        """For one laboratory, for as long as it is open.

        Raises:
            LaboratoryError: it is not open.
        """
        if self._fair is None:
            raise LaboratoryError("the simulators are not up yet")
        return self._fair.share()

    def optimizer(self) -> Optimizer:
        """Warm as well, and shared: one question after the other.

        Raises:
            LaboratoryError: it is not open.
        """
        if self._proposer is None:
            raise LaboratoryError("the optimiser is not up yet")
        return DeviceOptimizer(self._proposer)

    @property
    def lost(self) -> str:
        """Why they can't be used any more: what Ray has lost; empty while all is well."""
        if self._pool is None or self._spec.in_process:
            return ""
        from actors.runtime.ray_runtime import ray_lost

        return ray_lost()

    async def tidy(self) -> None:
        """Forget what laboratories that are closed have left behind, and give its memory back."""
        await asyncio.to_thread(give_back)
        if self._pool is not None and not self._spec.in_process:
            from actors.runtime.ray_runtime import forget_ray_logs

            await asyncio.to_thread(forget_ray_logs)

    async def close(self) -> None:
        """End them. May be called twice."""
        async with self._opening:
            pool, self._pool, self._fair = self._pool, None, None
            if pool is None:
                return
            if self._watching is not None:
                self._watching.cancel()
            proposer, self._proposer = self._proposer, None
            if proposer is not None:
                await proposer.close()
            await pool.close()
            if not self._spec.in_process:
                from actors.runtime.ray_runtime import stop_ray

                await asyncio.to_thread(stop_ray)
