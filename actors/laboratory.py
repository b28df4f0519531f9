"""A laboratory as a campaign uses it: opened and closed as one, over Ray or inside this process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from actors.arm.virtual_arm import VirtualArm
from actors.balance.virtual_balance import BalanceSettings, VirtualBalance
from actors.bench.bench import VirtualBench
from actors.bench.spec import VirtualBenchSpec
from actors.device import Device, LocalDevice
from actors.optimizer.actor import DeviceOptimizer, Proposer
from actors.protocols import (
    Bench,
    BenchLostError,
    Laboratory,
    LaboratoryError,
    Notice,
    Optimizer,
    SimulatorPool,
)
from actors.simulation.in_process import InProcessSimulatorPool
from actors.simulation.pool import RaySimulatorPool
from actors.simulation.worker import Simulator, pour_simulator
from actors.spec import LaboratorySpec

if TYPE_CHECKING:
    from actors.cluster.site import Site


def check_laboratory(spec: LaboratorySpec, *, need_bench: bool) -> None:
    """Whether what a laboratory needs from outside this machine is there. Starts nothing that stays.

    Args:
        spec: where to run.
        need_bench: whether pours will be asked for.

    Raises:
        LaboratoryError: with what is wrong and what would be right.
    """
    if spec.ray is not None and not spec.in_process:
        from actors.cluster.probe import check_cluster

        check_cluster(spec.ray, need_bench=need_bench)


def open_laboratory(
    spec: LaboratorySpec, *, need_bench: bool, make: Callable[[], Simulator] = pour_simulator
) -> Laboratory:
    """A laboratory, to be entered with `async with`; nothing starts before that.

    Args:
        spec: where to run.
        need_bench: whether pours will be asked for.
        make: makes simulators, where they run.

    Raises:
        LaboratoryError: a bench is needed and there is none, or the mode is not known.
    """
    if spec.mode != "virtual":
        raise LaboratoryError(f"laboratory {spec.name}: mode '{spec.mode}' is not available; 'virtual' is")
    if need_bench and spec.bench is None:
        raise LaboratoryError(f"laboratory {spec.name} has no bench, but the campaign pours: add a 'bench' to it")
    bench = spec.bench if need_bench else None
    if spec.in_process:
        return InProcessLaboratory(bench, make)
    return RayLaboratory(spec, bench, make)


class _ClosablePool(SimulatorPool, Protocol):
    async def close(self) -> None: ...


def _balance_settings(bench: VirtualBenchSpec) -> BalanceSettings:
    return BalanceSettings(
        resolution=bench.balance_resolution,
        noise=bench.balance_noise,
        drift=bench.balance_drift,
        settling_time=bench.settling_time,
        time_scale=bench.time_scale,
    )


class _Rooms:
    """What both kinds of laboratory have in common once they are open."""

    def __init__(self) -> None:
        self._pool: _ClosablePool | None = None
        self._world: _ClosablePool | None = None
        self._devices: list[Device] = []
        self._optimizer: Optimizer | None = None
        self._bench: Bench | None = None
        self._bench_problem: str | None = None
        self._notices: list[Notice] = []
        self._hear: Callable[[Notice], None] = self._notices.append

    def listen(self, hear: Callable[[Notice], None]) -> None:
        """See `Telling.listen`."""
        self._hear = hear
        while self._notices:
            hear(self._notices.pop(0))

    def _tell(self, notice: Notice) -> None:
        self._hear(notice)

    @property
    def simulators(self) -> SimulatorPool:
        """The pool."""
        if self._pool is None:
            raise LaboratoryError("the laboratory is not open: use 'async with'")
        return self._pool

    @property
    def bench(self) -> Bench | None:
        """The bench, if one was needed.

        Raises:
            BenchLostError: its machine is gone.
        """
        if self._bench_problem is not None:
            raise BenchLostError(self._bench_problem)
        return self._bench

    @property
    def optimizer(self) -> Optimizer:
        """The optimiser."""
        if self._optimizer is None:
            raise LaboratoryError("the laboratory is not open: use 'async with'")
        return self._optimizer

    async def _close_rooms(self) -> None:
        pools = [pool for pool in (self._pool, self._world) if pool is not None]
        await asyncio.gather(
            *(pool.close() for pool in pools), *(device.close() for device in self._devices), return_exceptions=True
        )
        self._pool = self._world = self._optimizer = self._bench = None
        self._devices = []


class InProcessLaboratory(_Rooms):
    """Everything in threads of this process: for fast tests and single commands.

    The hidden liquid shares the one simulator with the pool (a process has one Taichi), so that nothing is simulated
    while the bench computes its liquid. Outcomes are those of `RayLaboratory`.

    Args:
        bench: None where no pours are needed.
        make: makes the simulator.
    """

    def __init__(self, bench: VirtualBenchSpec | None, make: Callable[[], Simulator] = pour_simulator) -> None:
        super().__init__()
        self._bench_spec, self._make = bench, make

    async def __aenter__(self) -> InProcessLaboratory:
        self._pool = InProcessSimulatorPool(make=self._make)
        proposer = LocalDevice("optimiser", Proposer)
        self._devices.append(proposer)
        self._optimizer = DeviceOptimizer(proposer)
        if self._bench_spec is not None:
            spec = self._bench_spec
            arm = LocalDevice("arm", lambda: VirtualArm(spec.time_scale))
            balance = LocalDevice("balance", lambda: VirtualBalance(_balance_settings(spec)))
            self._devices += [arm, balance]
            self._bench = VirtualBench(spec, self._pool, arm, balance)
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._close_rooms()


class RayLaboratory(_Rooms):
    """Everything in processes of its own: on this machine, or on the machines of a cluster.

    Args:
        spec: size of the pool, memory, the cluster if there is one.
        bench: None where no pours are needed.
        make: makes simulators, in their processes.
    """

    def __init__(
        self,
        spec: LaboratorySpec,
        bench: VirtualBenchSpec | None,
        make: Callable[[], Simulator] = pour_simulator,
    ) -> None:
        super().__init__()
        self._spec, self._bench_spec, self._make = spec, bench, make
        self._site: Site | None = None
        self._liquid: RaySimulatorPool | None = None

    async def __aenter__(self) -> RayLaboratory:
        from actors.ray_runtime import keep_signals, start_ray

        starting = asyncio.ensure_future(asyncio.to_thread(start_ray, self._spec))
        try:
            await asyncio.shield(starting)
        except asyncio.CancelledError:
            # Starting can't be cut short; but it must not outlive the one who wanted it.
            await asyncio.wait({starting})
            if starting.exception() is None:
                await self._stop_ray()
            raise
        keep_signals()
        try:
            if self._spec.ray is not None:
                from actors.cluster.site import Site

                self._site = Site(self._spec.ray, self._tell, self._lose_bench, self._lose_all)
                await self._site.open(need_bench=self._bench_spec is not None)
            self._open_rooms()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    def _open_rooms(self) -> None:
        from actors.device import RayDevice

        here = None if self._site is None else self._site.here
        self._pool = self._open_pool()
        proposer = RayDevice("optimiser", Proposer, place=here)
        self._devices.append(proposer)
        self._optimizer = DeviceOptimizer(proposer)
        if self._bench_spec is not None:
            spec, place = self._bench_spec, None if self._site is None else self._site.bench
            arm = RayDevice("arm", VirtualArm, spec.time_scale, place=place)
            balance = RayDevice("balance", VirtualBalance, _balance_settings(spec), place=place)
            self._devices += [arm, balance]
            self._world = self._liquid = self._open_world()
            self._bench = VirtualBench(spec, self._liquid, arm, balance)

    def _open_pool(self) -> RaySimulatorPool:
        from actors.cluster.versions import versions
        from actors.ray_private import simulator_count

        def tell(text: str) -> None:
            self._tell(Notice("warning", text))

        if self._site is None:
            return RaySimulatorPool(simulator_count(self._spec), make=self._make, tell=tell)
        pool = RaySimulatorPool(
            self._spec.simulators or self._site.cpus,
            make=self._make,
            placement={"scheduling_strategy": "SPREAD"},
            expected=versions(),
            tell=tell,
        )
        if not self._spec.simulators:
            self._site.grown = pool.grow
        return pool

    def _open_world(self) -> RaySimulatorPool:
        """The hidden liquid's simulator, beside the arm. No core is counted for it: the pool's size is the campaign's
        choice, and a pour must never wait for it."""
        place = None if self._site is None else self._site.bench
        return RaySimulatorPool(1, make=self._make, cpus=0.0, placement=None if place is None else place.options)

    def _lose_bench(self, reason: str) -> None:
        """Its machine is gone: calls to arm and balance find out by themselves, the liquid's simulator would wait."""
        self._bench_problem = reason
        if self._liquid is not None:
            self._liquid.abandon(BenchLostError(reason))

    def _lose_all(self, reason: str) -> None:
        """Ray on this machine is gone: without it nothing can be asked of anybody."""
        self._lose_bench(reason)
        if isinstance(self._pool, RaySimulatorPool):
            self._pool.abandon(LaboratoryError(reason))

    async def __aexit__(self, *exc: object) -> None:
        await self._close_rooms()
        if self._site is not None:
            await self._site.close()
        await self._stop_ray()

    async def _stop_ray(self) -> None:
        from actors.ray_runtime import stop_ray

        await asyncio.to_thread(stop_ray)
