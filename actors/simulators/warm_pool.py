"""Simulators that stay warm between laboratories: processes and compiled kernels are there before they are needed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from actors.interfaces import LaboratoryError, Optimizer
from actors.laboratory import ClosablePool
from actors.laboratory_settings import LaboratorySpec, simulator_count
from actors.optimizer.optimizer_actor import DeviceOptimizer, Proposer
from actors.runtime.ray_runtime import watch_ray
from actors.runtime.remote_object import Device, LocalDevice, RayDevice
from actors.simulators.local_worker import InProcessSimulatorPool
from actors.simulators.pool import RaySimulatorPool
from actors.simulators.shared_pool import FairPool, Share
from actors.simulators.simulation_task import Simulator, give_back, pour_simulator


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
