"""A laboratory as a campaign uses it: opened and closed as one, over Ray or inside this process.

`open_laboratory` returns a `RayLaboratory` or an `InProcessLaboratory`; `check_laboratory` checks beforehand that it
can be opened. The bench itself is made by `actors.bench`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any

from actors.arm.arm_settings import arm_kind
from actors.balance.balance_settings import BalanceSettings, SerialBalanceSettings
from actors.balance.display_behaviour import IDEAL
from actors.balance.scale_model import ScaleSettings
from actors.bench.bench_factory import MakeDevice, OpenBench, open_bench
from actors.bench.virtual_bench import BenchEmulators
from actors.dosing.display_belief import IDEAL_DISPLAY, DisplayBelief
from actors.dosing.dose_series import DoseForecast, predict_dose
from actors.interfaces import (
    Bench,
    BenchLostError,
    DoseTarget,
    Laboratory,
    LaboratoryError,
    Notice,
    Operator,
    Optimizer,
    RaySettings,
    SimulatorPool,
)
from actors.laboratory_settings import MODE_LABELS, LaboratorySettings
from actors.optimizer_actor import DeviceOptimizer, Proposer
from actors.places import PlaceRecord
from actors.runtime.ray_cluster import JoinedCluster, check_cluster, versions
from actors.runtime.ray_runtime import RayStart, forget_ray_logs, open_ray, ray_lost, stop_ray, watch_ray
from actors.runtime.remote_object import Device, LocalDevice, RayDevice
from actors.simulators.job_runner import Simulator, give_back, pour_simulator
from actors.simulators.local_worker import process_pool, thread_pool
from actors.simulators.pool import PoolShare, WorkerPool
from actors.simulators.ray_worker import NICENESS, ray_pool
from sim_engine.engine_package import engine_name
from sim_engine.errors import EngineError
from sim_engine.resources import EXTRAS, PACKAGES, cache_directory, installed
from sim_engine.scene import Scene


def check_laboratory(spec: LaboratorySettings, *, pours: bool, plain_processes: bool = False) -> None:
    """Check that everything a laboratory needs on this machine and others is available. Leaves nothing running.

    Args:
        spec: of the laboratory.
        pours: whether pours will be requested.
        plain_processes: see `open_laboratory`.

    Raises:
        LaboratoryError: with the problem and its remedy.
    """
    if pours and spec.mode == "external":
        raise LaboratoryError(
            f"laboratory {spec.name} is external: a program makes its pours and asks for them with decant.AskTell; "
            "'decant plan', and 'decant calibrate' on weighed pours, need no pours"
        )
    try:
        engine_name()
        cache_directory()
    except (EngineError, OSError) as error:
        raise LaboratoryError(f"laboratory {spec.name}: simulations are impossible here: {error}") from None
    if spec.arm is not None and pours and (missing := arm_kind(spec.arm).missing()) is not None:
        raise LaboratoryError(
            f"laboratory {spec.name}: {missing}. Or use a simulated bench (--laboratory configs/laboratories/twin.yaml)"
        )
    if pours:
        check_bench_packages(spec)
    if not _without_ray(spec, pours=pours, plain_processes=plain_processes) and not installed("ray"):
        raise LaboratoryError(
            f"laboratory {spec.name}: simulators side by side need Ray, which is not installed: pip install "
            "'decant-pouring[lab]', or run with --in-process, one simulation after the other"
        )
    if spec.ray is not None and not spec.in_process:
        check_cluster(spec.ray, pours=pours)


def check_bench_packages(spec: LaboratorySettings) -> None:
    """Check that the packages are installed that control, or emulate, the arm and the balance of a laboratory.

    Raises:
        LaboratoryError: some are not; the text names them and their extra.
    """
    kind = None if spec.arm is None else arm_kind(spec.arm)
    emulated = kind is not None and kind.emulated
    if kind is None or (not emulated and kind.missing() is None and spec.balance is None):
        return
    needed = ["psutil"] if spec.mode == "virtual" and emulated else []
    if spec.balance is not None and not spec.balance.typed and isinstance(spec.balance, SerialBalanceSettings):
        needed.append("serial")
    missing = [module for module in needed if not installed(module)]
    if missing:
        names = " and ".join(f"'{PACKAGES.get(module, module)}'" for module in missing)
        raise LaboratoryError(
            f"laboratory {spec.name}: arm and balance need {names}, not installed here: pip install "
            f"'decant-pouring[{EXTRAS[missing[0]]}]'"
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
    emulators = BenchEmulators(spec.arm, spec.balance, spec.gripper)
    try:
        where = emulators.found()
        emulators.install()
        yield spec.with_values(arm=where.arm, balance=where.balance, gripper=where.gripper)
    finally:
        emulators.close()


def predicted_dose(
    spec: LaboratorySettings, scene: Scene, dose: DoseTarget, seed: int, count: int = 20
) -> DoseForecast:
    """Predict a dose of a laboratory. Nothing starts.

    Args:
        spec: of the laboratory.
        scene: source, receiver and liquid.
        dose: wanted amount.
        seed: of the prediction.
        count: number of simulated doses.

    Raises:
        InvalidActionError: the dose is impossible.
    """
    return predict_dose(scene, dose, seed, spec.dosing, count, expected_display(spec.balance))


def expected_display(balance: BalanceSettings | None) -> DisplayBelief | None:
    """The display of a balance according to its settings; None if they state nothing about it."""
    match balance:
        case SerialBalanceSettings(virtual=ScaleSettings() as sheet, interval=interval):
            step, behaviour = sheet.resolution, sheet.behaviour
        case SerialBalanceSettings(step=float() as step, interval=interval):
            behaviour = IDEAL
        case SerialBalanceSettings(interval=interval) if "interval" in balance.model_fields_set:
            step, behaviour = IDEAL_DISPLAY.step, IDEAL
        case _:
            return None
    equal = max(1.0 - interval / behaviour.conversion_interval, 0.0) if behaviour.conversion_interval > 0.0 else 0.0
    return DisplayBelief.expected(step, interval, max(behaviour.repeat_probability, equal))


def _without_ray(spec: LaboratorySettings, *, pours: bool, plain_processes: bool) -> bool:
    return spec.in_process or (plain_processes and spec.ray is None and not pours)


def open_laboratory(
    spec: LaboratorySettings,
    *,
    pours: bool,
    plain_processes: bool = False,
    make: Callable[[], Simulator] = pour_simulator,
    operator: Operator | None = None,
    simulators: SimulatorPool | None = None,
    optimizer: Optimizer | None = None,
    record: PlaceRecord | None = None,
) -> Laboratory:
    """Create a laboratory, to be entered with `async with`; nothing starts before that.

    Args:
        spec: of the laboratory.
        pours: whether pours will be requested.
        plain_processes: for interactive work of a few seconds: simulators run in plain processes, which start sooner
            than a private Ray. Ignored if a bench is needed or a cluster is named.
        make: creates simulators in their processes.
        operator: answers questions, if a person does.
        simulators: simulators to use instead of its own (`WarmSimulators.share`); they stay open. If they are on the
            cluster that `spec` names, arm, balance and bench are on this machine.
        optimizer: an optimiser to use instead of its own; it is stateless.
        record: account of what stands where, for a laboratory with places.

    Raises:
        LaboratoryError: a bench is needed and there is none, or it has no operator, or the mode is unknown.
    """
    assert not (pours and spec.mode == "external"), "refused by check_laboratory"
    if spec.mode not in MODE_LABELS:
        raise LaboratoryError(f"laboratory {spec.name}: mode '{spec.mode}' is not one of {', '.join(MODE_LABELS)}")
    if pours and not spec.pours:
        raise LaboratoryError(f"laboratory {spec.name} has no bench, but the campaign pours: add a 'bench' to it")
    if pours and operator is None and spec.needs_person:
        raise LaboratoryError(
            f"laboratory {spec.name} needs a person beside it who answers questions; run the campaign in a terminal"
        )
    kind: Callable[..., InProcessLaboratory | RayLaboratory]
    if _without_ray(spec, pours=pours, plain_processes=plain_processes):
        kind = partial(InProcessLaboratory, processes=0 if spec.in_process else spec.simulator_count)
    else:
        kind = RayLaboratory
    return kind(spec, make, pours=pours, operator=operator, simulators=simulators, optimizer=optimizer, record=record)


class _OpenLaboratory:
    """Common part of both kinds of laboratory.

    Args:
        spec: see the subclasses.
        make: creates simulators in their processes.
        operator: a person who answers questions, if there is one.
        simulators: simulators to use instead of its own; they stay open.
        optimizer: to use instead of its own; it stays open.
        record: account of what stands where.
    """

    def __init__(
        self,
        spec: LaboratorySettings,
        make: Callable[[], Simulator] = pour_simulator,
        *,
        pours: bool = False,
        operator: Operator | None = None,
        simulators: SimulatorPool | None = None,
        optimizer: Optimizer | None = None,
        record: PlaceRecord | None = None,
    ) -> None:
        self._spec, self._make, self._operator, self._record = spec, make, operator, record
        self._pool, self._optimizer = simulators, optimizer
        self._pours = pours and spec.pours
        self._own_pools: list[WorkerPool] = []
        self._devices: list[Device] = []
        self._opened: OpenBench | None = None
        self._bench_problem: str | None = None
        self._open_again: Callable[[], Awaitable[None]] | None = None
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
        return None if self._opened is None else self._opened.bench

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
        await self._opened.bench.stop()
        return True

    @property
    def opened(self) -> OpenBench | None:
        """The parts of the open bench; None if there is no bench."""
        return self._opened

    def _open_pool(self, pool: WorkerPool) -> WorkerPool:
        self._own_pools.append(pool)
        pool.open()
        return pool

    def _open_optimizer(self, proposer: Device) -> Optimizer:
        self._devices.append(proposer)
        return DeviceOptimizer(proposer)

    async def _open_bench(self, make: MakeDevice, liquid: SimulatorPool | None) -> None:
        self._open_again = partial(self._open_bench, make, liquid)
        self._opened = await open_bench(self._spec, make, liquid, self._operator, self._report, self._record)
        self._devices += self._opened.devices

    async def restart_bench(self) -> None:
        """See `Restartable.restart_bench`."""
        opened, self._opened = self._opened, None
        self._spec = self._spec.resumed()
        if opened is not None:
            self._devices = [device for device in self._devices if device not in opened.devices]
            with contextlib.suppress(LaboratoryError):
                await opened.close()
            await asyncio.gather(*(device.close() for device in opened.devices), return_exceptions=True)
        if self._open_again is not None:
            await self._open_again()

    async def _close_all(self) -> None:
        opened, self._opened = self._opened, None
        try:
            if opened is not None:
                await opened.close()
        finally:  # a bench that can't be closed must not leave simulators behind
            open_now: list[WorkerPool | Device] = [*self._own_pools, *self._devices]
            await asyncio.gather(*(each.close() for each in open_now), return_exceptions=True)
            self._pool = self._optimizer = None
            self._own_pools, self._devices = [], []


def _local(name: str, cls: type[Any], *args: Any) -> Device:
    return LocalDevice(name, lambda: cls(*args))


class InProcessLaboratory(_OpenLaboratory):
    """Runs everything in threads of this process, or with simulators in plain processes.

    For fast tests and single commands.

    Without separate processes the ground truth uses the pool's only simulator, since a process has one Taichi: no
    other simulation runs while the bench computes its liquid. Outcomes equal those of `RayLaboratory`.
    """

    def __init__(self, *args: Any, processes: int = 0, **options: Any) -> None:
        super().__init__(*args, **options)
        self._processes = processes

    async def __aenter__(self) -> InProcessLaboratory:
        if self._pool is None:
            processes = self._processes
            self._pool = self._open_pool(process_pool(processes, self._make) if processes else thread_pool(self._make))
        if self._optimizer is None:
            self._optimizer = self._open_optimizer(LocalDevice("optimiser", Proposer))
        try:
            if self._pours:
                await self._open_bench(_local, self._pool)
        except BaseException:
            await self._close_all()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._close_all()


class RayLaboratory(_OpenLaboratory):
    """Runs everything in separate processes: on this machine, or on the machines of a cluster.

    `spec` gives the size of the pool, the memory, and the cluster to join, if any. On a cluster, the bench is on the
    node that offers its resource; with simulators of another laboratory, it is on this machine.

    Attributes:
        lost: why this machine is cut off from the cluster; '' while it is not.
    """

    lost = ""
    _cluster: JoinedCluster | None = None
    _liquid: WorkerPool | None = None
    _monitoring: asyncio.Task[None] | None = None

    async def __aenter__(self) -> RayLaboratory:
        spec = self._spec
        address = None if spec.ray is None else spec.ray.address
        await open_ray(RayStart(address, spec.simulator_count))
        try:
            if self._spec.ray is not None:
                self._cluster = JoinedCluster(self._spec.ray, self._report, self._lose_bench, self._lose_all)
                await self._cluster.open(pours=self._pours and self._pool is None)
            else:
                self._monitoring = asyncio.create_task(watch_ray(self._ray_died))
            await self._open_all()
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def _open_all(self) -> None:
        this_node = None if self._cluster is None else self._cluster.here
        self._pool = self._pool or self._open_pool(self._ray_pool())
        if self._optimizer is None:
            optimizer = RayDevice("optimiser", Proposer, node=this_node, looked_after=True)
            self._optimizer = self._open_optimizer(optimizer)
        if not self._pours:
            return
        node = None if self._cluster is None else self._cluster.bench or this_node
        if self._spec.bench is not None:
            # The ground truth's simulator, on the arm's machine. It reserves no core: the pool's size is the
            # campaign's choice, and a pour must never wait for it.
            placement = None if node is None else node.options
            liquid = ray_pool(1, self._make, cpus=0.0, placement=placement, niceness=0, tell=self._tell_loss)
            self._liquid = self._open_pool(liquid)
        await self._open_bench(partial(RayDevice, node=node), self._liquid)

    def _tell_loss(self, text: str) -> None:
        self._report(Notice("warning", text))

    def _ray_pool(self) -> WorkerPool:
        if self._cluster is None:
            niceness = 0 if self._spec.mode == "virtual" else NICENESS
            return ray_pool(self._spec.simulator_count, self._make, niceness=niceness, tell=self._tell_loss)
        pool = ray_pool(
            self._spec.simulators or self._cluster.cpus,
            self._make,
            placement={"scheduling_strategy": "SPREAD"},
            expected=versions(),
            tell=self._tell_loss,
        )
        if not self._spec.simulators:
            self._cluster.grown = pool.grow
        return pool

    def _lose_bench(self, reason: str) -> None:
        """Handle the loss of the bench's machine.

        Calls to arm and balance detect it; the liquid's simulator would wait.
        """
        self._bench_problem = reason
        if self._liquid is not None:
            self._liquid.abandon(BenchLostError(reason))

    def _lose_all(self, reason: str) -> None:
        """Handle the loss of Ray on this machine, which ends all of its actors."""
        self.lost = reason
        self._lose_bench(reason)
        for pool in self._own_pools:
            if pool is not self._liquid:
                pool.abandon(LaboratoryError(reason))
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
            await asyncio.to_thread(stop_ray)


class WarmSimulators:
    """Simulators and an optimiser that are opened once and shared fairly by all laboratories of this process.

    Processes and compiled kernels are ready before they are needed.

    Args:
        simulators: size of the pool; 0: one per core of this machine or of the cluster.
        in_process: one simulator in this process, without Ray.
        ray: cluster on which the simulators run; None: a private Ray on this machine.
        make: creates simulators in their processes.
        tell: called with a message about losses.
    """

    def __init__(
        self,
        simulators: int = 0,
        *,
        in_process: bool = False,
        ray: RaySettings | None = None,
        make: Callable[[], Simulator] = pour_simulator,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._spec = LaboratorySettings(name="shared", simulators=simulators, in_process=in_process, ray=ray)
        self._make, self._report = make, tell
        self._laboratory: InProcessLaboratory | RayLaboratory | None = None
        self._opening = asyncio.Lock()

    @property
    def ready(self) -> bool:
        """Whether the pool is open."""
        return self._laboratory is not None

    @property
    def size(self) -> int:
        """Number of simulators; 0 before the pool is open."""
        return 0 if self._laboratory is None else self._laboratory.simulators.size

    async def open(self) -> None:
        """Start the simulators, unless they are already started.

        Raises:
            LaboratoryError: Ray does not start.
        """
        async with self._opening:
            if self._laboratory is None:
                kind = InProcessLaboratory if self._spec.in_process else RayLaboratory
                laboratory = kind(self._spec, self._make)
                laboratory.listen(self._hear)
                self._laboratory = await laboratory.__aenter__()

    def _hear(self, notice: Notice) -> None:
        if notice.level == "warning":
            self._report(notice.text)

    def share(self) -> PoolShare:
        """Return a share for one laboratory, for as long as the laboratory is open.

        Raises:
            LaboratoryError: the pool is not open.
        """
        if self._laboratory is None:
            raise LaboratoryError("the simulators are not up yet")
        pool = self._laboratory.simulators
        assert isinstance(pool, WorkerPool)
        return pool.share()

    def optimizer(self) -> Optimizer:
        """Return the shared optimiser, which stays open, too. It handles one request after another.

        Raises:
            LaboratoryError: the pool is not open.
        """
        if self._laboratory is None:
            raise LaboratoryError("the optimiser is not up yet")
        return self._laboratory.optimizer

    @property
    def ray(self) -> RaySettings | None:
        """The cluster on which the simulators run; None without one."""
        return None if self._spec.in_process else self._spec.ray

    @property
    def lost(self) -> str:
        """The lost part of Ray, which makes the simulators unusable; empty while nothing is lost."""
        if not isinstance(self._laboratory, RayLaboratory):
            return ""
        return ray_lost() or ("connection to the cluster" if self._laboratory.lost else "")

    async def tidy(self) -> None:
        """Release logs and memory left by laboratories that are closed."""
        await asyncio.to_thread(give_back)
        if self._laboratory is not None and not self._spec.in_process:
            await asyncio.to_thread(forget_ray_logs)

    async def close(self) -> None:
        """End the simulators. May be called twice."""
        async with self._opening:
            laboratory, self._laboratory = self._laboratory, None
            if laboratory is not None:
                await laboratory.__aexit__()
