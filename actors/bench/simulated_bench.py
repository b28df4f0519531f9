"""The simulated bench: arm and balance are simulated in the driver, and the ground truth is poured before the arm
moves.

The same seed and action give the same measurement bit for bit, independent of earlier pours and of the clock: bench
time passes only on the balance. `SimulatedBench` holds the ground truth, and `SimulatedOperator` answers all questions.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Any, TypeVar

from actors.arm.arm_device import DeviceArm
from actors.arm.arm_interface import Executed
from actors.arm.simulated_arm import Grip
from actors.balance.balance_device import DeviceBalance
from actors.balance.scale_model import Load
from actors.balance.simulated_balance import SimulatedBalanceSettings
from actors.bench.bench_operators import OperatorQuestions
from actors.bench.ground_truth import (
    GroundTruth,
    GroundTruthTask,
    Spill,
    TouchingError,
    draw_pose_error,
    liquid_seed,
    stream,
    true_spill,
)
from actors.dosing.particle_liquid import check_particles, dose_task
from actors.dosing.simulated_dose import simulated_dose
from actors.dosing_settings import DosingSettings
from actors.interfaces import (
    DoseTarget,
    LaboratoryError,
    OperatorQuestion,
    OperatorSettings,
    PourFailedError,
    PourProgress,
    ProgressCallback,
    SimulatorPool,
)
from actors.laboratory_settings import BenchSettings
from actors.simulators.live_worker import LivePourProcess
from sim_engine.live_pour import LivePours
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import PourTask, Scene

CARRYING_TIME = 2.0
"""Bench time to put an object on the balance or to remove it [s]."""

T = TypeVar("T")

_NOTHING = Load((0.0,), (0.0,))


def simulated_balance(spec: BenchSettings) -> SimulatedBalanceSettings:
    """Balance settings of a simulated bench: the dry pourer is tared, and no load is out of tolerance."""
    return SimulatedBalanceSettings(tared=True, time_scale=spec.time_scale).with_values(
        **spec.balance.model_dump(), load_tolerance=float("inf")
    )


class SimulatedBench(GroundTruth):
    """The ground truth of a simulated bench.

    Args:
        spec: ground truth, errors, time scale.
        simulators: a separate pool for the ground truth.
        arm: the simulated arm.
        balance: the simulated balance; bench time passes on it.
    """

    def __init__(self, spec: BenchSettings, simulators: SimulatorPool, arm: DeviceArm, balance: DeviceBalance) -> None:
        super().__init__(spec.time_scale)
        self._spec, self._simulators, self._arm, self._balance = spec, simulators, arm, balance
        self._pour: GroundTruthTask | None = None
        self._liquid: asyncio.Task[Spill] | None = None
        self._live = LivePourProcess()

    async def simulated_dose(
        self, scene: Scene, dose: DoseTarget, seed: int, dosing: DosingSettings, progress: ProgressCallback | None
    ) -> PourMeasurement | None:
        """See `GroundTruth.simulated_dose`; the placement is as wrong as in the pour of the same seed."""
        loop, error = asyncio.get_running_loop(), draw_pose_error(self._spec, seed)

        def show(state: PourProgress) -> None:
            if progress is not None:
                loop.call_soon_threadsafe(progress, state)

        def particles(content: float) -> tuple[PourTask, LivePours]:
            return dose_task(scene, scene.action({}), content, self._spec.theta, error, liquid_seed(seed)), self._live

        poured = particles if self._spec.doses == "particles" else None
        if poured is not None:
            check_particles(scene, dose.amount, self._spec.theta)
        return await asyncio.to_thread(
            simulated_dose, scene, dose, seed, dosing, held_tilt=error.tilt, progress=show, particles=poured
        )

    async def close(self) -> None:
        """See `GroundTruth.close`."""
        await asyncio.to_thread(self._live.close)

    async def prepare(self, pour: GroundTruthTask) -> None:
        """See `GroundTruth.prepare`; starts the simulation of the liquid."""
        self._pour = pour
        self._liquid = asyncio.create_task(
            true_spill(self._spec, self._simulators, pour.scene, pour.action, pour.seed, pour.frame_rate)
        )
        await self._balance.prepare(stream(pour.seed, "balance"))
        error = draw_pose_error(self._spec, pour.seed)
        await self._arm.device.call("grip", Grip(error.speed_factor, stream(pour.seed, "arm")), deadline=30.0)

    async def tilts(self) -> None:
        """See `GroundTruth.tilts`; puts the spilled mass over time on the balance before the arm moves.

        Raises:
            PourFailedError: at their true poses the vessels would touch.
        """
        try:
            spill = await self._spill()
        except TouchingError as error:
            raise PourFailedError(str(error)) from error
        assert self._pour is not None
        self._pour.shown(spill.frames)
        await self._balance.put(Load(spill.times, spill.spilled_curve))

    async def lands(self, executed: Executed | None, broken: Exception | None) -> None:
        """See `GroundTruth.lands`; raises for an aborted motion, because the simulated liquid does not apply to it."""
        if broken is not None or executed is None or not executed.completed:
            raise LaboratoryError(f"{broken or 'the arm did not complete the pour'}")

    async def lasting(self, doing: Awaitable[T], seconds: float) -> T:
        """See `GroundTruth.lasting`; bench time passes on the balance meanwhile."""
        return (await _together(doing, self._balance.pass_time(seconds)))[0]

    async def wait(self, seconds: float) -> None:
        """See `GroundTruth.wait`."""
        await self._balance.pass_time(seconds)

    async def settle(self, seconds: float) -> None:
        """See `GroundTruth.settle`; waits for the last drop, which may fall after the arm has stopped, and for the
        balance to settle.
        """
        assert self._pour is not None
        last = (await self._spill()).times[-1]
        await self.wait(max(last - self._pour.path.pour_time, 0.0) + self._spec.balance.settling_time)

    async def end(self) -> None:
        """See `GroundTruth.end`."""
        if self._liquid is not None:
            await _end(self._liquid)

    async def content(self, about: str) -> Load | None:
        """Load on the balance after a question was answered, net of the dry mass; None if it is unchanged."""
        assert self._pour is not None
        match about:
            case "pourer_full":
                return Load((0.0,), (self._pour.scene.liquid.mass,))
            case "pourer_after":
                return Load((0.0,), ((await self._spill()).retained,))
            case "dry_pourer" | "set_up" | "dry_pourer_after":
                return _NOTHING
        return None

    async def _spill(self) -> Spill:
        assert self._liquid is not None
        return await asyncio.shield(self._liquid)


class SimulatedOperator(OperatorQuestions):
    """The operator of a simulated bench: refills, wipes, moves vessels to the balance, and confirms every question.

    It writes no log: its answers take no time and are the same in every pour.

    Args:
        bench: the ground truth, which supplies the loads.
        balance: receives the loads.
        preparation_time: for refilling, placing and wiping [s of bench time].
    """

    def __init__(self, bench: SimulatedBench, balance: DeviceBalance, preparation_time: float) -> None:
        super().__init__(self, OperatorSettings(answers="virtual"), lambda notice: None)
        self._bench, self._balance, self._time = bench, balance, preparation_time

    async def ask(self, question: OperatorQuestion) -> str:
        """See `Operator.ask`."""
        if question.options:
            return question.options[0]
        load = await self._bench.content(question.about)
        if load is not None and not question.problem:
            if question.about == "dry_pourer":
                await self._balance.pass_time(self._time)
            await self._balance.put(load)
            await self._balance.pass_time(CARRYING_TIME)
        if question.problem and question.wants == "done":
            raise LaboratoryError(question.problem)  # a simulation has no problem that an operator could fix
        return "done" if question.wants == "done" else "no" if question.about in ("balance", "unsafe") else "yes"

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`."""


async def _together(first: Awaitable[T], second: Awaitable[Any]) -> tuple[T, Any]:
    """Await both; if one fails, cancel the other and raise the error."""
    tasks: list[asyncio.Future[Any]] = [asyncio.ensure_future(first), asyncio.ensure_future(second)]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            await _end(task)
    return tasks[0].result(), tasks[1].result()


async def _end(task: asyncio.Future[Any]) -> None:
    """Cancel a task unless it is done, wait for it, and retrieve its exception."""
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.exception()
