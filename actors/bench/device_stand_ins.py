"""The stand-ins of a virtual bench from the event loop: the same calls, awaited."""

from __future__ import annotations

from typing import Any

from actors.balance.actor import DeviceBalance
from actors.balance.virtual_balance import Load
from actors.bench.stand_ins import Found, History
from actors.device import Device

DEADLINE = 30.0
"""Longest wait for any answer [s]; its process may still be starting."""


class DeviceStandIns:
    """`actors.bench.stand_ins.StandIns` over a `Device`.

    Args:
        device: that holds it.

    Attributes:
        told: a balance whose driver is itself told what stands on it; None where something stands in for it.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.told: DeviceBalance | None = None

    async def found(self) -> Found:
        """Where they are."""
        found: Found = await self.device.call("found", deadline=4.0 * DEADLINE)
        return found

    async def prepare(self, seed: tuple[int, ...]) -> None:
        """A new pour."""
        await self.device.call("prepare", seed, deadline=DEADLINE)
        if self.told is not None:
            await self.told.prepare(seed)

    async def put(self, mass: float) -> None:
        """What stands on the balance from now on [kg]."""
        if self.told is not None:
            await self.told.put(Load((0.0,), (mass,)))
        else:
            await self.device.call("put", mass, deadline=DEADLINE)

    async def history(self, since: float) -> History:
        """What the joints did since a controller time [s]; nothing, for a time to come."""
        history: History = await self.device.call("history", min(since, 1e12), deadline=DEADLINE)
        return history

    async def fault(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Ask the controller for a fault."""
        answer: dict[str, Any] = await self.device.call("fault", name, arguments, deadline=DEADLINE, urgent=True)
        return answer

    async def order(self, what: str, **values: Any) -> dict[str, Any]:
        """Have something done to the balance."""
        answer: dict[str, Any] = await self.device.call("order", what, values, deadline=DEADLINE, urgent=True)
        return answer

    async def close(self) -> None:
        """End controller and balance."""
        await self.device.call("close", deadline=DEADLINE)
