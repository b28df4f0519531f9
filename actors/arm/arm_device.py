"""An arm's driver from the event loop: its calls, awaited, with their deadlines."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from actors.arm.arm_interface import ArmError, ArmFacts, ArmState, Executed, PlannedPour
from actors.arm.arm_settings import ArmSpec
from actors.interfaces import LaboratoryError
from actors.runtime.remote_object import Device

PATIENCE = 60.0
"""Longest wait for what moves nothing [s]: a process starts, a controller is asked some questions."""

POWER_TIME = 180.0
"""Longest wait for power and brakes after an emergency stop [s of controller time]."""

LOOK_INTERVAL = 0.1
"""Between two looks at a moving arm [s]."""

Follow = Callable[[ArmState], None]


def _nobody(state: ArmState) -> None:
    """Whoever gets the place of an arm that nobody follows."""


class DeviceArm:
    """An `actors.arm.arm_interface.Arm` over a `Device`.

    Args:
        device: that holds the driver.
        spec: of the arm.
    """

    def __init__(self, device: Device, spec: ArmSpec) -> None:
        self.device, self._spec = device, spec

    async def ready(self) -> ArmFacts:
        """Connected, and who is there; nothing moves."""
        await self.device.revive()
        try:
            facts: ArmFacts = await self.device.call("facts", deadline=PATIENCE)
        except ArmError:
            facts = await self.device.call("connect", deadline=PATIENCE)
        return facts

    async def hands_in(self) -> None:
        """See to it that no program runs on the controller and the arm stands, and read both back."""
        await self.device.call("hands_in", deadline=PATIENCE)

    async def release(self) -> None:
        """A person has said that it may move."""
        await self.device.call("release", deadline=PATIENCE, urgent=True)

    async def move_to_start(self, path: PlannedPour, follow: Follow = _nobody) -> None:
        """From home to the pour's start; `follow` is called now and then with its place."""
        async with self._followed(follow):
            await self.device.call("move_to_start", path, deadline=self._deadline(path.approach_time))

    async def execute(self, path: PlannedPour, follow: Follow) -> Executed:
        """Tilt, hold, return.

        Args:
            path: whose start it stands at.
            follow: told now and then where it is.
        """
        async with self._followed(follow):
            deadline = self._deadline(path.pour_time)
            executed: Executed = await self.device.call("execute", path, deadline=deadline)
            return executed

    async def retreat(self, path: PlannedPour, follow: Follow = _nobody) -> None:
        """Home, from wherever on the ways to and from the pour it stands upright; `follow` as in `move_to_start`."""
        async with self._followed(follow):
            await self.device.call("retreat", path, deadline=self._deadline(3.0 * path.retreat_time))

    async def untilt(self, path: PlannedPour) -> None:
        """Slowly upright again, after that pour was stopped."""
        await self.device.call("untilt", path, deadline=self._deadline(self._spec.untilt_time))

    async def recover(self) -> str:
        """After a stop whose cause a person has seen to: connected and ready, not released; says what was done."""
        await self.device.revive()
        await self.release()
        done: str = await self.device.call("recover", deadline=self._deadline(POWER_TIME))
        return done

    async def stop(self) -> None:
        """Stop what moves; it stays locked."""
        await self.device.call("stop", deadline=PATIENCE, urgent=True)

    async def state(self) -> ArmState:
        """Where it is."""
        state: ArmState = await self.device.call("state", deadline=PATIENCE, urgent=True)
        return state

    async def close(self) -> None:
        """Let go of the controller."""
        await self.device.call("close", deadline=PATIENCE)

    def _deadline(self, seconds: float) -> float:
        """For something that takes so long on the controller [s]: twice that, for a lost arm must be noticed."""
        return PATIENCE + 2.0 * self._spec.on_clock(seconds)

    @contextlib.asynccontextmanager
    async def _followed(self, follow: Follow) -> AsyncIterator[None]:
        """Somebody gets the arm's place, meanwhile."""
        if follow is _nobody:
            yield
            return
        watching = asyncio.create_task(self._watch(follow))
        try:
            yield
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    async def _watch(self, follow: Follow) -> None:
        while True:
            await asyncio.sleep(LOOK_INTERVAL)
            with contextlib.suppress(LaboratoryError):
                follow(await self.state())
