"""The virtual bench: arm, balance, operator and the hidden liquid between them, through one whole pour."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from actors.arm.actor import DeviceArm
from actors.arm.protocol import ArmState, ExecutedMotion
from actors.arm.virtual_arm import APPROACH_TIME, Grip
from actors.balance.actor import DeviceBalance
from actors.balance.virtual_balance import Load
from actors.bench.planning import plan_pour
from actors.bench.progress import PourReport
from actors.bench.spec import VirtualBenchSpec
from actors.bench.twin_operator import CARRYING_TIME, TwinOperator
from actors.bench.world import Spill, World, draw_pose_error, stream
from actors.device import Device
from actors.protocols import InvalidActionError, LaboratoryError, ProgressCallback, SimulatorPool
from sim_engine.action import Action
from sim_engine.motion import PourMotion
from sim_engine.outcome import PourMeasurement
from sim_engine.task import Scene

WEIGHING_TIME = 1.5
"""Bench time that a stable weight usually takes, for the progress bar [s]."""

PROGRESS_INTERVAL = 0.1
"""Wall time between two reports [s]."""

T = TypeVar("T")


class VirtualBench:
    """`Bench` without hardware. Same seed and action → same measurement, bit for bit, whatever happened before.

    A pour takes its three masses from the balance, like a person would: the load and what is left from two weighings
    of the pourer, the spill from the tray under the receiver.

    Args:
        spec: hidden liquid, errors, pace.
        simulators: a pool of its own for the hidden liquid.
        arm: device that holds a `VirtualArm`.
        balance: device that holds a `VirtualBalance`.
        plan: checks a pour and plans its motion.
    """

    def __init__(
        self,
        spec: VirtualBenchSpec,
        simulators: SimulatorPool,
        arm: Device,
        balance: Device,
        *,
        plan: Callable[[Scene, Action], PourMotion] = plan_pour,
    ) -> None:
        self._spec = spec
        self._world = World(spec, simulators)
        self._plan = plan
        self.arm = DeviceArm(arm, spec.time_scale)
        self.balance = DeviceBalance(balance, spec.time_scale)
        self._operator = TwinOperator(self.balance, spec.operator_time)
        self._one_pour = asyncio.Lock()

    @property
    def mode(self) -> str:
        """'virtual'."""
        return "virtual"

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None
    ) -> PourMeasurement:
        """See `Bench.pour`. Cancelling stops the arm; what was poured by then is unknown.

        Raises:
            InvalidActionError: refused before anything moved.
            LaboratoryError: it failed on the way.
        """
        async with self._one_pour:
            motion = await asyncio.to_thread(self._plan, scene, action)
            await self.arm.device.revive()
            await self.balance.device.revive()
            report = _Report(progress, self._spec, motion)
            liquid = asyncio.create_task(self._world.pour(scene, action, seed))
            watcher = asyncio.create_task(self._watch(report))
            try:
                return await self._cycle(scene, motion, seed, liquid, report)
            except BaseException:
                await self._leave_safe()
                raise
            finally:
                await _end(liquid)
                await _end(watcher)

    async def _cycle(
        self, scene: Scene, motion: PourMotion, seed: int, liquid: asyncio.Task[Spill], report: _Report
    ) -> PourMeasurement:
        balance, arm, load = self.balance, self.arm, scene.liquid.mass
        error = draw_pose_error(self._spec, seed)

        report.enter("operator")
        await balance.prepare(stream(seed, "balance"))
        await self._operator.prepare()
        await arm.release()
        await arm.grip(Grip(error.speed_factor, stream(seed, "arm")))
        loaded = await self._operator.weigh_pourer(load)

        report.enter("tare")
        await balance.tare()

        report.enter("approach")
        await _together(arm.move_to_start(motion), balance.pass_time(APPROACH_TIME))
        spill = await self._reality(liquid)

        report.enter("tilt")
        await balance.put(Load(spill.times, spill.spilled_curve))
        executed, _ = await _together(arm.execute(motion, report.follow), balance.pass_time(motion.duration))
        if not executed.completed:
            raise LaboratoryError(
                f"the arm was stopped {executed.times[-1]:.1f} s into the pour, at {executed.times[-1]:.1f} of "
                f"{motion.duration:.1f} s: what was poured is unknown"
            )

        report.enter("settle")
        # Drops may fall for longer than the arm moves; a settled tray carries all of them.
        await balance.pass_time(max(spill.times[-1] - motion.duration, 0.0) + self._spec.settling_time)

        report.enter("weigh")
        spilled = (await balance.weigh()).mass

        report.enter("record")
        retained = await self._operator.weigh_pourer(spill.retained)
        report.enter("record", 1.0)
        return _measurement(loaded, spilled, retained, executed)

    async def _reality(self, liquid: asyncio.Task[Spill]) -> Spill:
        """The hidden liquid's fate, before the first tilt: the tray must know what falls on it while the arm moves."""
        try:
            return await liquid
        except InvalidActionError as error:
            raise LaboratoryError(f"the vessels as they truly stand: {error}") from error

    async def _watch(self, report: _Report) -> None:
        """Give the balance's display to those who watch; it can't hold the pour up."""
        async for weight in self.balance.stream(PROGRESS_INTERVAL):
            report.show(weight.mass)

    async def _leave_safe(self) -> None:
        """Stop what moves, whatever has failed: also when this task itself is being cancelled."""

        async def stop() -> None:
            for halt in (self.arm.stop, self.balance.interrupt):
                with contextlib.suppress(LaboratoryError):
                    await halt()

        stopping = asyncio.ensure_future(stop())
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.shield(stopping)


class _Report(PourReport):
    """What is expected of a pour on this bench."""

    def __init__(self, progress: ProgressCallback | None, spec: VirtualBenchSpec, motion: PourMotion) -> None:
        weighing = 3 * CARRYING_TIME + 2 * WEIGHING_TIME
        parts = {
            "operator": spec.operator_time + weighing,
            "tare": WEIGHING_TIME,
            "approach": APPROACH_TIME,
            **{phase.name: phase.end - phase.start for phase in motion.phases},
            "settle": spec.settling_time,
            "weigh": WEIGHING_TIME,
            "record": weighing,
        }
        super().__init__(progress, parts, motion.duration)

    def follow(self, state: ArmState) -> None:
        """Where the arm is during the motion."""
        self.move(state.phase, state.fraction, state.tilt, moving=state.moving)


async def _together(first: Awaitable[T], second: Awaitable[Any]) -> tuple[T, Any]:
    """Both; if one fails, the other is awaited no longer and the error is raised."""
    tasks = [asyncio.ensure_future(first), asyncio.ensure_future(second)]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            await _end(task)
    return tasks[0].result(), tasks[1].result()


async def _end(task: asyncio.Future[Any]) -> None:
    """Cancel a task unless it is done, wait for it, and take note of its error."""
    task.cancel()
    await asyncio.wait({task})
    if not task.cancelled():
        task.exception()


def _measurement(loaded: float, spilled: float, retained: float, executed: ExecutedMotion) -> PourMeasurement:
    """What goes into the record.

    A balance may read a little less than nothing; a spill of less than nothing would count as a gain, so it is zero.
    The raw readings are kept in the notes.
    """
    return PourMeasurement(
        loaded=loaded,
        spilled=max(spilled, 0.0),
        retained=min(max(retained, 0.0), loaded),
        notes={
            "mode": "virtual",
            "readings_g": {"loaded": 1e3 * loaded, "spilled": 1e3 * spilled, "retained": 1e3 * retained},
            "executed_s": float(executed.times[-1]),
            "largest_tilt_deg": math.degrees(max(executed.motion.tilt(executed.times))),
        },
    )
