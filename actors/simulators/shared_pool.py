"""One pool of simulators, shared fairly by several laboratories.

`FairPool` gives each `Share` its turn, regardless of the number of its jobs. `WarmSimulators` keeps the pool open
between laboratories, so that processes and compiled kernels are ready before they are needed.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from actors.interfaces import LaboratoryError, Optimizer, SimulatorPool
from actors.laboratory import ClosablePool
from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.optimizer_actor import DeviceOptimizer, Proposer
from actors.runtime.ray_runtime import watch_ray
from actors.runtime.remote_object import Device, LocalDevice, RayDevice
from actors.simulators.local_worker import InProcessSimulatorPool
from actors.simulators.pool import RaySimulatorPool
from actors.simulators.simulation_task import Simulator, give_back, pour_simulator
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

AHEAD = 2
"""Jobs that the pool holds per simulator: one that runs and one that waits, so that no simulator becomes idle."""


class FairPool:
    """Divides a pool into shares. Jobs of one share keep their order; the shares take turns.

    Args:
        pool: the shared pool; closing a share does not close it.
    """

    def __init__(self, pool: SimulatorPool) -> None:
        self._pool = pool
        self._under_way = 0
        self._turns: deque[Share] = deque()

    @property
    def pool(self) -> SimulatorPool:
        """The shared pool."""
        return self._pool

    def share(self) -> Share:
        """Create a share for one more user."""
        return Share(self)

    async def simulate(self, task: PourTask, share: Share) -> SimulatedPour:
        """Run a job in its share's turn. If the awaiting task is cancelled, the job is cancelled."""
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
                else:  # the job was handed out meanwhile
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
        fair: schedules the jobs.
    """

    def __init__(self, fair: FairPool) -> None:
        self._fair = fair
        self.waiting: deque[asyncio.Future[None]] = deque()

    @property
    def size(self) -> int:
        """Size of the whole pool: a share uses all of it while the others are idle."""
        return self._fair.pool.size

    @property
    def separate(self) -> bool:
        """See `SimulatorPool.separate`."""
        return self._fair.pool.separate

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """See `SimulatorPool.simulate`."""
        return await self._fair.simulate(task, self)

    async def close(self) -> None:
        """Do nothing: the pool belongs to `FairPool`'s owner."""


class WarmSimulators:
    """A pool that is opened once and shared fairly by all laboratories of this process.

    Args:
        simulators: size of the pool; 0: one per core.
        in_process: one simulator in this process, without Ray.
        make: creates simulators in their processes.
        tell: called with a message about losses.
    """

    def __init__(
        self,
        simulators: int = 0,
        *,
        in_process: bool = False,
        make: Callable[[], Simulator] = pour_simulator,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._spec = LaboratorySettings(name="warm", simulators=simulators, in_process=in_process)
        self._make, self._report = make, tell
        self._pool: ClosablePool | None = None
        self._fair: FairPool | None = None
        self._proposer: Device | None = None
        self._monitoring: asyncio.Task[None] | None = None
        self._opening = asyncio.Lock()

    @property
    def ready(self) -> bool:
        """Whether the pool is open."""
        return self._fair is not None

    @property
    def size(self) -> int:
        """Number of simulators; 0 before the pool is open."""
        return 0 if self._pool is None else self._pool.size

    async def open(self) -> None:
        """Start the simulators, unless they are already started.

        Raises:
            LaboratoryError: Ray does not start.
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

                self._monitoring = asyncio.create_task(watch_ray(died))
            self._fair = FairPool(self._pool)

    async def _open_ray(self) -> RaySimulatorPool:
        from actors.runtime.ray_runtime import keep_signals, start_ray, stop_ray

        starting = asyncio.ensure_future(asyncio.to_thread(start_ray, self._spec))
        try:
            await asyncio.shield(starting)
        except asyncio.CancelledError:
            # the start cannot be interrupted, and must not continue after its caller has ended
            await asyncio.wait({starting})
            if starting.exception() is None:
                await asyncio.to_thread(stop_ray)
            raise
        keep_signals()
        return RaySimulatorPool(self._spec.simulator_count, make=self._make, tell=self._report)

    def share(self) -> Share:
        """Return a share for one laboratory, for as long as the laboratory is open.

        Raises:
            LaboratoryError: the pool is not open.
        """
        if self._fair is None:
            raise LaboratoryError("the simulators are not up yet")
        return self._fair.share()

    def optimizer(self) -> Optimizer:
        """Return the shared optimiser, which stays open, too. It handles one request after another.

        Raises:
            LaboratoryError: the pool is not open.
        """
        if self._proposer is None:
            raise LaboratoryError("the optimiser is not up yet")
        return DeviceOptimizer(self._proposer)

    @property
    def lost(self) -> str:
        """The lost part of Ray, which makes the simulators unusable; empty while nothing is lost."""
        if self._pool is None or self._spec.in_process:
            return ""
        from actors.runtime.ray_runtime import ray_lost

        return ray_lost()

    async def tidy(self) -> None:
        """Release logs and memory left by laboratories that are closed."""
        await asyncio.to_thread(give_back)
        if self._pool is not None and not self._spec.in_process:
            from actors.runtime.ray_runtime import forget_ray_logs

            await asyncio.to_thread(forget_ray_logs)

    async def close(self) -> None:
        """End the simulators. May be called twice."""
        async with self._opening:
            pool, self._pool, self._fair = self._pool, None, None
            if pool is None:
                return
            if self._monitoring is not None:
                self._monitoring.cancel()
            proposer, self._proposer = self._proposer, None
            if proposer is not None:
                await proposer.close()
            await pool.close()
            if not self._spec.in_process:
                from actors.runtime.ray_runtime import stop_ray

                await asyncio.to_thread(stop_ray)
