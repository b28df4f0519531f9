"""An arm's driver for the event loop: its calls are awaited, with their deadlines.

`DeviceArm` wraps a `Device` that holds the driver. It plans nothing and does not retry motions.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from actors.arm.arm_interface import ArmError, ArmFacts, ArmState, Executed, PlannedPour
from actors.arm.arm_settings import ArmSettings
from actors.arm.planned_pour import PlaceWay
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import device_clock
from actors.runtime.remote_object import Device, DeviceLostError

CALL_TIMEOUT = 60.0
"""Longest wait for a call that moves nothing [s], such as a process start or controller queries."""

DRIVE_TIMEOUT = 10.0
"""Longest wait for a command of a dose [s]; without it the arm turns back by itself long before."""

POWER_TIME = 180.0
"""Longest wait for power and brakes after an emergency stop [s of controller time]."""

LOOK_INTERVAL = 0.1
"""Time between two readings of a moving arm's state [s]."""

STUCK = (ArmError, DeviceLostError)
"""Errors after which the operator has to check the arm."""

Follow = Callable[[ArmState], None]


def _ignore(state: ArmState) -> None:
    """Default callback, which ignores the arm's state."""


class DeviceArm:
    """An `actors.arm.arm_interface.Arm` over a `Device`.

    Args:
        device: that holds the driver.
        spec: of the arm.
    """

    def __init__(self, device: Device, spec: ArmSettings) -> None:
        self.device, self._spec = device, spec
        self._patience = device_clock(spec.clock).patience

    async def ready(self) -> ArmFacts:
        """Connect and return the arm's facts; nothing moves."""
        await self.device.revive()
        try:
            facts: ArmFacts = await self.device.call("facts", deadline=self._patience * CALL_TIMEOUT)
        except ArmError:
            facts = await self.device.call("connect", deadline=self._patience * CALL_TIMEOUT)
        return facts

    async def hands_in(self) -> None:
        """Make sure that no program runs on the controller and that the arm stands still, and read both back."""
        await self.device.call("hands_in", deadline=self._patience * CALL_TIMEOUT)

    async def release(self, *, warned: bool = False) -> None:
        """Allow the arm to move, after an operator's consent; `warned`: at once (arms that carry vessels)."""
        await self.device.call(
            "release", *([True] if warned else []), deadline=self._patience * CALL_TIMEOUT, urgent=True
        )

    async def move_to_start(self, path: PlannedPour, follow: Follow = _ignore) -> None:
        """Move from home to the pour's start. `follow` is called periodically with the arm's state."""
        async with self._followed(follow):
            await self.device.call("move_to_start", path, deadline=self._deadline(path.approach_time))

    async def execute(self, path: PlannedPour, follow: Follow) -> Executed:
        """Tilt, hold, return.

        Args:
            path: the pour; the arm stands at its start.
            follow: called periodically with the arm's state.
        """
        async with self._followed(follow):
            deadline = self._deadline(path.pour_time)
            executed: Executed = await self.device.call("execute", path, deadline=deadline)
            return executed

    async def dose(self, path: PlannedPour, longest: float) -> Executed:
        """Tilt as `drive` says; see `actors.arm.arm_interface.DosingArm`."""
        executed: Executed = await self.device.call("dose", path, longest, deadline=self._deadline(longest))
        return executed

    async def drive(self, speed: float, highest: float, patience: float) -> ArmState:
        """Set the motion of a running dose until the next call; see `actors.arm.arm_interface.DosingArm`."""
        deadline = self._patience * DRIVE_TIMEOUT
        state: ArmState = await self.device.call("drive", speed, highest, patience, deadline=deadline, urgent=True)
        return state

    async def retreat(self, path: PlannedPour | PlaceWay, follow: Follow = _ignore) -> None:
        """Move home from any upright pose on the way to or from the pour; `follow` as in `move_to_start`."""
        async with self._followed(follow):
            await self.device.call("retreat", path, deadline=self._deadline(3.0 * path.retreat_time))

    async def carry(self, way: PlaceWay, *, loaded: bool) -> None:
        """Move from home to a place or back; see `actors.arm.arm_interface.CarryingArm`.

        Args:
            way: to the place.
            loaded: whether a vessel is in the gripper, for arms that watch it.
        """
        await self.device.call("carry", way, deadline=self._deadline(way.approach_time))

    async def untilt(self, path: PlannedPour) -> None:
        """Bring the pourer slowly upright again after that pour was stopped."""
        await self.device.call("untilt", path, deadline=self._deadline(self._spec.upright_time))

    async def recover(self) -> str:
        """Reconnect and make the arm ready after a stop whose cause the operator has removed.

        The arm is not released. Returns a description of the actions taken.
        """
        await self.device.revive()
        await self.release()
        done: str = await self.device.call("recover", deadline=self._deadline(POWER_TIME))
        return done

    async def stop(self) -> None:
        """Stop any motion; the arm stays locked."""
        await self.device.call("stop", deadline=self._patience * CALL_TIMEOUT, urgent=True)

    async def state(self) -> ArmState:
        """The arm's present state."""
        state: ArmState = await self.device.call("state", deadline=self._patience * CALL_TIMEOUT, urgent=True)
        return state

    async def pace(self, time_scale: float) -> None:
        """Set the controller seconds per second of the clock; emulated UR arms only."""
        self._spec = self._spec.with_values(time_scale=time_scale)
        await self.device.call("pace", time_scale, deadline=self._patience * CALL_TIMEOUT, urgent=True)

    async def close(self) -> None:
        """Disconnect from the controller."""
        await self.device.call("close", deadline=self._patience * CALL_TIMEOUT)

    def _deadline(self, seconds: float) -> float:
        """The deadline for an action of this duration on the controller [s]: twice as long, to detect a lost arm."""
        return self._patience * (CALL_TIMEOUT + 2.0 * self._spec.on_clock(seconds))

    @contextlib.asynccontextmanager
    async def _followed(self, follow: Follow) -> AsyncIterator[None]:
        """Call `follow` with the arm's state while the body runs."""
        if follow is _ignore:
            yield
            return
        polling = asyncio.create_task(self._poll(follow))
        try:
            yield
        finally:
            polling.cancel()
            await asyncio.gather(polling, return_exceptions=True)

    async def _poll(self, follow: Follow) -> None:
        while True:
            await asyncio.sleep(LOOK_INTERVAL)
            with contextlib.suppress(LaboratoryError):
                follow(await self.state())
