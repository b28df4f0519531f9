"""Asynchronous access to a balance: its blocking driver runs in a process or thread, awaited from the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from actors.balance.balance_interface import Weight
from actors.balance.scale_model import Load
from actors.balance.simulated_balance import STABLE_WEIGHT_TIMEOUT
from actors.runtime.remote_object import Device

ANSWER_DEADLINE = 30.0
"""Wall time within which an idle balance must reply [s]; its process may still be starting."""


class DeviceBalance:
    """A `BalanceDriver` behind a `Device`, with awaitable calls.

    Args:
        device: holds the driver.
        time_scale: bench seconds per wall second, for deadlines; 0 disables waiting.
        longest_call: wall time limit of the driver's calls [s], see `BalanceSettings.longest_call`.
        patience: factor of all deadlines, see `DeviceClock`.
    """

    def __init__(
        self, device: Device, time_scale: float = 1.0, *, longest_call: float = 0.0, patience: float = 1.0
    ) -> None:
        self.device = device
        self._scale = time_scale
        self._longest_call, self._patience = longest_call, patience

    def _deadline(self, bench_time: float) -> float:
        passing = 2.0 * bench_time / self._scale if self._scale > 0.0 else 0.0
        return self._patience * (ANSWER_DEADLINE + max(self._longest_call, passing))

    async def tare(self) -> None:
        """See `BalanceDriver.tare`."""
        await self.device.call("tare", deadline=self._deadline(STABLE_WEIGHT_TIMEOUT))

    async def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`."""
        weight: Weight = await self.device.call("weigh", deadline=self._deadline(STABLE_WEIGHT_TIMEOUT))
        return weight

    async def read(self) -> Weight:
        """See `BalanceDriver.read`."""
        weight: Weight = await self.device.call("read", deadline=self._patience * ANSWER_DEADLINE, urgent=True)
        return weight

    async def stream(self, interval: float = 0.1) -> AsyncIterator[Weight]:
        """Yield the display's weight repeatedly.

        Args:
            interval: wall time between two readings [s].
        """
        while True:
            yield await self.read()
            await asyncio.sleep(interval)

    async def connect(self) -> str:
        """See `BalanceDriver.connect`."""
        greeting: str = await self.device.call("connect", deadline=self._deadline(STABLE_WEIGHT_TIMEOUT))
        return greeting

    async def zero(self) -> None:
        """Set the zero of the empty balance; serial balances only."""
        await self.device.call("zero", deadline=self._deadline(STABLE_WEIGHT_TIMEOUT))

    async def keep_reference(self) -> None:
        """See `BalanceDriver.keep_reference`."""
        await self.device.call("keep_reference", deadline=self._patience * ANSWER_DEADLINE, urgent=True)

    async def statistics(self) -> dict[str, int]:
        """Return the counters of the serial line; serial balances only."""
        counts: dict[str, int] = await self.device.call(
            "statistics", deadline=self._patience * ANSWER_DEADLINE, urgent=True
        )
        return counts

    async def pace(self, time_scale: float) -> None:
        """Set the bench seconds per second of the clock; emulated serial balances only."""
        self._scale = time_scale
        await self.device.call("pace", time_scale, deadline=self._patience * ANSWER_DEADLINE, urgent=True)

    async def resume(self) -> None:
        """See `BalanceDriver.resume`."""
        await self.device.call("resume", deadline=self._patience * ANSWER_DEADLINE, urgent=True)

    async def release(self) -> None:
        """Close the driver."""
        await self.device.call("close", deadline=self._patience * ANSWER_DEADLINE)

    async def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty the tray, set bench time to 0 and reseed the noise; simulated balances only."""
        await self.device.call("prepare", seed, deadline=self._patience * ANSWER_DEADLINE)

    async def put(self, load: Load) -> None:
        """Set the load on the tray from now on; simulated balances only."""
        await self.device.call("put", load, deadline=self._patience * ANSWER_DEADLINE)

    async def pass_time(self, seconds: float) -> None:
        """Let bench time pass [s]; simulated balances only."""
        await self.device.call("pass_time", seconds, deadline=self._deadline(seconds))

    async def interrupt(self) -> None:
        """End the current wait."""
        await self.device.call("interrupt", deadline=self._patience * ANSWER_DEADLINE, urgent=True)
