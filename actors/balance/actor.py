"""The balance behind its protocol: a blocking driver in a process (or thread) of its own, reached from the loop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from actors.balance.protocol import Weight
from actors.balance.virtual_balance import PATIENCE, Load
from actors.device import Device

ANSWER_DEADLINE = 30.0
"""Wall time an idle balance may take to answer [s]; its process may still be starting."""


class DeviceBalance:
    """`actors.balance.protocol.Balance` over a `Device` that holds a driver such as `VirtualBalance`.

    Args:
        device: of the driver.
        time_scale: bench seconds per wall second, for deadlines; 0 waits for nothing.
    """

    def __init__(self, device: Device, time_scale: float) -> None:
        self.device = device
        self._scale = time_scale

    def _deadline(self, bench_time: float) -> float:
        return ANSWER_DEADLINE + (2.0 * bench_time / self._scale if self._scale > 0.0 else 0.0)

    async def tare(self) -> None:
        """See `Balance.tare`."""
        await self.device.call("tare", deadline=self._deadline(PATIENCE))

    async def weigh(self) -> Weight:
        """See `Balance.weigh`."""
        weight: Weight = await self.device.call("weigh", deadline=self._deadline(PATIENCE))
        return weight

    async def read(self) -> Weight:
        """See `Balance.read`."""
        weight: Weight = await self.device.call("read", deadline=ANSWER_DEADLINE, urgent=True)
        return weight

    async def stream(self, interval: float = 0.1) -> AsyncIterator[Weight]:
        """See `Balance.stream`."""
        while True:
            yield await self.read()
            await asyncio.sleep(interval)

    async def prepare(self, seed: tuple[int, ...]) -> None:
        """Virtual balances only: empty tray, bench time 0, noise of a new pour."""
        await self.device.call("prepare", seed, deadline=ANSWER_DEADLINE)

    async def put(self, load: Load) -> None:
        """Virtual balances only: what comes onto the tray from now on."""
        await self.device.call("put", load, deadline=ANSWER_DEADLINE)

    async def pass_time(self, seconds: float) -> None:
        """Virtual balances only: bench time passes [s]."""
        await self.device.call("pass_time", seconds, deadline=self._deadline(seconds))

    async def interrupt(self) -> None:
        """Virtual balances only: end the wait that is under way."""
        await self.device.call("interrupt", deadline=ANSWER_DEADLINE, urgent=True)
