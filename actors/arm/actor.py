"""The arm behind its protocol: a blocking driver in a process (or thread) of its own, reached from the event loop."""

from __future__ import annotations

import asyncio

from actors.arm.protocol import ArmProgress, ArmState, ExecutedMotion
from actors.arm.virtual_arm import APPROACH_TIME, Grip
from actors.device import Device
from sim_engine.motion import PourMotion

ANSWER_DEADLINE = 30.0
"""Wall time an idle arm may take to answer [s]; its process may still be starting."""

PROGRESS_INTERVAL = 0.1
"""Wall time between two looks at a moving arm [s]."""


class DeviceArm:
    """`actors.arm.protocol.Arm` over a `Device` that holds a driver such as `VirtualArm`.

    Args:
        device: of the driver.
        time_scale: bench seconds per wall second, for deadlines; 0 waits for nothing.
    """

    def __init__(self, device: Device, time_scale: float) -> None:
        self.device = device
        self._scale = time_scale

    def _deadline(self, bench_time: float) -> float:
        # Twice the time it should take: a busy machine may lag, a lost arm must be noticed.
        return ANSWER_DEADLINE + (2.0 * bench_time / self._scale if self._scale > 0.0 else 0.0)

    async def grip(self, grip: Grip) -> None:
        """Virtual arms only: errors of the next pour."""
        await self.device.call("grip", grip, deadline=ANSWER_DEADLINE)

    async def move_to_start(self, motion: PourMotion) -> None:
        """See `Arm.move_to_start`."""
        await self.device.call("move_to_start", motion, deadline=self._deadline(APPROACH_TIME))

    async def execute(self, motion: PourMotion, progress: ArmProgress | None = None) -> ExecutedMotion:
        """See `Arm.execute`."""
        watcher = None if progress is None else asyncio.create_task(self._watch(progress))
        try:
            deadline = self._deadline(motion.duration)
            executed: ExecutedMotion = await self.device.call("execute", motion, deadline=deadline)
            return executed
        finally:
            if watcher is not None:
                watcher.cancel()
                # What went wrong with watching is of no consequence for the motion.
                await asyncio.gather(watcher, return_exceptions=True)

    async def _watch(self, progress: ArmProgress) -> None:
        while True:
            await asyncio.sleep(PROGRESS_INTERVAL)
            progress(await self.state())

    async def stop(self) -> None:
        """See `Arm.stop`."""
        await self.device.call("stop", deadline=ANSWER_DEADLINE, urgent=True)

    async def release(self) -> None:
        """See `Arm.release`."""
        await self.device.call("release", deadline=ANSWER_DEADLINE, urgent=True)

    async def state(self) -> ArmState:
        """See `Arm.state`."""
        state: ArmState = await self.device.call("state", deadline=ANSWER_DEADLINE, urgent=True)
        return state
