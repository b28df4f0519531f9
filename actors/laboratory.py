"""A laboratory as a campaign uses it: opened and closed as one, over Ray or inside this process.

`open_laboratory` returns a `RayLaboratory` or an `InProcessLaboratory`; `check_laboratory` checks beforehand that it
can be opened. The bench itself is made by `actors.bench`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from actors.balance.balance_settings import SerialBalanceSettings
from actors.bench.bench_factory import MakeDevice, OpenBench, open_bench
from actors.bench.device_emulators import BenchEmulators
from actors.interfaces import (
    Bench,
    BenchLostError,
    Laboratory,
    LaboratoryError,
    Notice,
    Operator,
    Optimizer,
    SimulatorPool,
)
from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.optimizer_actor import DeviceOptimizer, Proposer
from actors.runtime.ray_runtime import watch_ray
from actors.runtime.remote_object import Device, LocalDevice, RayDevice
from actors.simulators.local_worker import InProcessSimulatorPool
from actors.simulators.pool import RaySimulatorPool
from actors.simulators.process_worker import ProcessSimulatorPool
from actors.simulators.simulation_task import Simulator, pour_simulator
from sim_engine.resources import EXTRAS, PACKAGES, installed

if TYPE_CHECKING:
    from actors.runtime.ray_cluster import JoinedCluster


def check_laboratory(spec: LaboratorySettings, *, need_bench: bool, brief: bool = False) -> None:
    """Check that everything a laboratory needs on this machine and others is available. Leaves nothing running.

    Args:
        spec: of the laboratory.
        need_bench: whether pours will be requested.
        brief: see `open_laboratory`.

    Raises:
        LaboratoryError: with the problem and its remedy.
    """
    if spec.arm is not None and need_bench and (missing := spec.arm.missing()) is not None:
        raise LaboratoryError(
            f"laboratory {spec.name}: {missing}. Use Python 3.11 or 3.12, or a simulated bench "
            "(--laboratory configs/laboratories/twin.yaml)"
        )
    if need_bench:
        check_bench_packages(spec)
    if not _without_ray(spec, need_bench=need_bench, brief=brief) and not installed("ray"):
        raise LaboratoryError(
            f"laboratory {spec.name}: simulators side by side need Ray, which is not installed: pip install "
            "'decant[lab]', or run with --in-process, one simulation after the other"
        )
    if spec.ray is not None and not spec.in_process:
        from actors.runtime.cluster_check import check_cluster

        check_cluster(spec.ray, need_bench=need_bench)


def check_bench_packages(spec: LaboratorySettings) -> None:
    """Check that the packages are installed that control, or emulate, the arm and the balance of a laboratory.

    Raises:
        LaboratoryError: some are not; the text names them and their extra.
    """
    if spec.arm is None or (spec.arm.emulator == "" and spec.arm.missing() is None and spec.balance is None):
        return
    needed = ["psutil"] if spec.mode == "virtual" and spec.arm.emulator else []
    if spec.balance is not None and isinstance(spec.balance, SerialBalanceSettings) and not spec.balance.typed:
        needed.append("serial")
    missing = [module for module in needed if not installed(module)]
    if missing:
        names = " and ".join(f"'{PACKAGES.get(module, module)}'" for module in missing)
        raise LaboratoryError(
            f"laboratory {spec.name}: arm and balance need {names}, not installed here: pip install "
            f"'decant[{EXTRAS[missing[0]]}]'"
        )


@contextlib.contextmanager
def reached(spec: LaboratorySettings) -> Iterator[LaboratorySettings]:
    """A laboratory with its addresses: on hardware its own, else those of what is started for as long as this.

    Raises:
        LaboratoryError: a package that it needs is not installed, or what is started does not start.
    """
    check_bench_packages(spec)
    if spec.mode == "hardware":
        yield spec
        return
    assert spec.arm is not None
    stand_ins = BenchEmulators(spec.arm, spec.balance)
    try:
        where = stand_ins.found()
        stand_ins.install()
        yield spec.with_values(arm=where.arm, balance=where.balance)
    finally:
        stand_ins.close()


def _without_ray(spec: LaboratorySettings, *, need_bench: bool, brief: bool) -> bool:
    return spec.in_process or (brief and spec.ray is None and not need_bench)


def open_laboratory(
    spec: LaboratorySettings,
    *,
    need_bench: bool,
    brief: bool = False,
    make: Callable[[], Simulator] = pour_simulator,
    operator: Operator | None = None,
    kept: ClosablePool | None = None,
    optimizer: Optimizer | None = None,
) -> Laboratory:
    """Create a laboratory, to be entered with `async with`; nothing starts before that.

    Args:
        spec: of the laboratory.
        need_bench: whether pours will be requested.
        brief: for interactive work of a few seconds: simulators run in plain processes, which start sooner than a
            private Ray. Ignored if a bench is needed or a cluster is named.
        make: creates simulators in their processes.
        operator: answers questions, if a person does.
        kept: simulators to use instead of its own (`actors.simulators.shared_pool`); they stay open. Not on a
        cluster, whose nodes change.
        optimizer: an optimiser to use instead of its own; it is stateless.

    Raises:
        LaboratoryError: a bench is needed and there is none, or it has no operator.
    """
    if need_bench and not spec.pours:
        raise LaboratoryError(f"laboratory {spec.name} has no bench, but the campaign pours: add a 'bench' to it")
    if need_bench and operator is None and spec.needs_person:
        raise LaboratoryError(
            f"laboratory {spec.name} needs a person beside it who answers questions; run the campaign in a terminal"
        )
    kind: Callable[..., InProcessLaboratory | RayLaboratory]
    if _without_ray(spec, need_bench=need_bench, brief=brief):
        kind = partial(InProcessLaboratory, processes=0 if spec.in_process else spec.simulator_count)
    else:
        kind = RayLaboratory
        if spec.ray is not None:
            kept = optimizer = None
    return kind(spec, make, need_bench=need_bench, operator=operator, kept=kept, optimizer=optimizer)


class ClosablePool(SimulatorPool, Protocol):
    """A pool that can be closed."""

    async def close(self) -> None:
        """End its simulators."""
        ...


class _OpenLaboratory:
    """Common part of both kinds of laboratory.

    Args:
        spec: see the subclasses.
        make: creates simulators in their processes.
        operator: a person who answers questions, if there is one.
        kept: simulators to use instead of its own; they stay open.
        optimizer: to use instead of its own; it stays open.
    """

    def __init__(
        self,
        spec: LaboratorySettings,
        make: Callable[[], Simulator] = pour_simulator,
        *,
        need_bench: bool = False,
        operator: Operator | None = None,
        kept: ClosablePool | None = None,
        optimizer: Optimizer | None = None,
    ) -> None:
        self._spec, self._make, self._operator, self._kept = spec, make, operator, kept
        self._kept_optimizer = optimizer
        self._needs_bench = need_bench and spec.pours
        self._pool: ClosablePool | None = None
        self._apart: ClosablePool | None = None
        self._devices: list[Device] = []
        self._opened: OpenBench | None = None
        self._optimizer: Optimizer | None = None
        self._bench: Bench | None = None
        self._bench_problem: str | None = None
        self._notices: list[Notice] = []
        self._subscriber: Callable[[Notice], None] = self._notices.append

    def listen(self, hear: Callable[[Notice], None]) -> None:
        """See `Telling.listen`."""
        self._subscriber = hear
        while self._notices:
            hear(self._notices.pop(0))

    def _report(self, notice: Notice) -> None:
        self._subscriber(notice)

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
            BenchLostError: its machine is lost.
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

    async def stop_arm(self) -> bool:
        """Stop any motion without waiting for other calls to the arm; it stays locked. Returns whether there is an arm.

        Raises:
            LaboratoryError: the arm cannot be reached; only its own emergency stop can stop it.
        """
        if self._opened is None:
            return False
        await self._opened.bench.arm.stop()
        return True

    @property
    def opened(self) -> OpenBench | None:
        """The parts of the open bench; None if there is no bench."""
        return self._opened

    def _own_optimizer(self, proposer: Device) -> Optimizer:
        self._devices.append(proposer)
        return DeviceOptimizer(proposer)

    async def _open_bench(self, make: MakeDevice, liquid: SimulatorPool | None) -> None:
        self._opened = await open_bench(self._spec, make, liquid, self._operator, self._report)
        self._devices += self._opened.devices
        self._bench = self._opened.bench

    async def _close_all(self) -> None:
        opened, self._opened = self._opened, None
        if opened is not None:
            await opened.close()
        pools = [pool for pool in (self._pool, self._apart) if pool is not None and pool is not self._kept]
        await asyncio.gather(
            *(pool.close() for pool in pools), *(device.close() for device in self._devices), return_exceptions=True
        )
        self._pool = self._apart = self._optimizer = self._bench = None
        self._devices = []


def _local(name: str, cls: type[Any], *args: Any) -> Device:
    return LocalDevice(name, lambda: cls(*args))


class InProcessLaboratory(_OpenLaboratory):
    """Runs everything in threads of this process, or with simulators in plain processes.

    For fast tests and single commands.

    Without separate processes the hidden liquid uses the pool's only simulator, since a process has one Taichi: no
    other simulation runs while the bench computes its liquid. Outcomes equal those of `RayLaboratory`.
    """

    def __init__(self, *args: Any, processes: int = 0, **options: Any) -> None:
        super().__init__(*args, **options)
        self._processes = processes

    async def __aenter__(self) -> InProcessLaboratory:
        if self._kept is None and self._processes:
            self._pool = ProcessSimulatorPool(self._processes, make=self._make)
        else:
            self._pool = self._kept or InProcessSimulatorPool(make=self._make)
        self._optimizer = self._kept_optimizer or self._own_optimizer(LocalDevice("optimiser", Proposer))
        try:
            if self._needs_bench:
                await self._open_bench(_local, self._pool)
        except BaseException:
            await self._close_all()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._close_all()


class RayLaboratory(_OpenLaboratory):
    """Runs everything in separate processes: on this machine, or on the machines of a cluster.

    `spec` gives the size of the pool, the memory, and the cluster to join, if any.
    """

    _cluster: JoinedCluster | None = None
    _liquid: RaySimulatorPool | None = None
    _monitoring: asyncio.Task[None] | None = None

    async def __aenter__(self) -> RayLaboratory:
        from actors.runtime.ray_runtime import keep_signals, start_ray

        starting = asyncio.ensure_future(asyncio.to_thread(start_ray, self._spec))
        try:
            await asyncio.shield(starting)
        except asyncio.CancelledError:
            # The start cannot be interrupted, and must not continue after its caller has ended.
            await asyncio.wait({starting})
            if starting.exception() is None:
                await self._stop_ray()
            raise
        keep_signals()
        try:
            if self._spec.ray is not None:
                from actors.runtime.ray_cluster import JoinedCluster

                self._cluster = JoinedCluster(self._spec.ray, self._report, self._lose_bench, self._lose_all)
                await self._cluster.open(need_bench=self._needs_bench)
            else:
                self._monitoring = asyncio.create_task(watch_ray(self._ray_died))
            await self._open_all()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def _open_all(self) -> None:
        here = None if self._cluster is None else self._cluster.here
        self._pool = self._kept or self._open_pool()
        self._optimizer = self._kept_optimizer or self._own_optimizer(
            RayDevice("optimiser", Proposer, node=here, looked_after=True)
        )
        if not self._needs_bench:
            return
        node = None if self._cluster is None else self._cluster.bench
        if self._spec.bench is not None:
            self._apart = self._liquid = self._open_liquid()

        await self._open_bench(partial(RayDevice, node=node), self._liquid)

    def _open_pool(self) -> RaySimulatorPool:
        from actors.runtime.cluster_nodes import versions

        def tell(text: str) -> None:
            self._report(Notice("warning", text))

        if self._cluster is None:
            return RaySimulatorPool(self._spec.simulator_count, make=self._make, tell=tell)
        pool = RaySimulatorPool(
            self._spec.simulators or self._cluster.cpus,
            make=self._make,
            placement={"scheduling_strategy": "SPREAD"},
            expected=versions(),
            tell=tell,
        )
        if not self._spec.simulators:
            self._cluster.grown = pool.grow
        return pool

    def _open_liquid(self) -> RaySimulatorPool:
        """The hidden liquid's simulator, on the arm's machine.

        It reserves no core: the pool's size is the campaign's choice, and a pour must never wait for it."""
        node = None if self._cluster is None else self._cluster.bench
        return RaySimulatorPool(1, make=self._make, cpus=0.0, placement=None if node is None else node.options)

    def _lose_bench(self, reason: str) -> None:
        """Handle the loss of the bench's machine.

        Calls to arm and balance detect it; the liquid's simulator would wait.
        """
        self._bench_problem = reason
        if self._liquid is not None:
            self._liquid.abandon(BenchLostError(reason))

    def _lose_all(self, reason: str) -> None:
        """Handle the loss of Ray on this machine, which ends all of its actors."""
        self._lose_bench(reason)
        if isinstance(self._pool, RaySimulatorPool):
            self._pool.abandon(LaboratoryError(reason))
        for device in self._devices:
            if isinstance(device, RayDevice):
                device.abandon(reason)

    def _ray_died(self, reason: str) -> None:
        self._report(Notice("error", reason))
        self._lose_all(reason)

    async def __aexit__(self, *exc: object) -> None:
        try:
            if self._monitoring is not None:
                self._monitoring.cancel()
            await self._close_all()
            if self._cluster is not None:
                await self._cluster.close()
        finally:  # also if closing was interrupted, since Ray counts its users
            await self._stop_ray()

    async def _stop_ray(self) -> None:
        from actors.runtime.ray_runtime import stop_ray

        await asyncio.to_thread(stop_ray)
