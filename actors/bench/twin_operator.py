"""The person at the bench of numbers: refills, wipes, and carries the pourer to the balance. Asked nothing."""

from __future__ import annotations

from actors.balance.actor import DeviceBalance
from actors.balance.virtual_balance import Load

CARRYING_TIME = 2.0
"""Bench time to put something on the balance or take it off [s]."""


class TwinOperator:
    """Works in bench time.

    Args:
        balance: whose bench time passes while the operator works.
        preparation_time: refilling, placing, wiping [s].
    """

    def __init__(self, balance: DeviceBalance, preparation_time: float) -> None:
        self._balance = balance
        self._preparation_time = preparation_time

    async def prepare(self) -> None:
        """Wipe, refill, place the vessels."""
        await self._balance.pass_time(self._preparation_time)

    async def weigh_pourer(self, content: float) -> float:
        """Weigh the pourer on the emptied balance, the dry pourer's known mass taken off.

        The zero is set just before, so that drift since the last tare does not count.

        Args:
            content: true mass of the liquid in it [kg].

        Returns:
            Mass of the liquid as weighed [kg].
        """
        await self._balance.put(Load((0.0,), (0.0,)))
        await self._balance.pass_time(CARRYING_TIME)
        await self._balance.tare()
        await self._balance.put(Load((0.0,), (content,)))
        await self._balance.pass_time(CARRYING_TIME)
        weighed = (await self._balance.weigh()).mass
        await self._balance.put(Load((0.0,), (0.0,)))
        await self._balance.pass_time(CARRYING_TIME)
        return weighed
