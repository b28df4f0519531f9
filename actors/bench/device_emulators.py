"""What a virtual bench has in place of hardware: what stands in for its arm, a balance on a pseudo-terminal.

Plain and blocking; `actors.runtime.remote_object` puts it on the machine that the bench is on, beside the drivers
that talk to it.

The stand-ins of a virtual bench from the event loop: the same calls, awaited.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Protocol, cast

from actors.arm.arm_settings import ArmSpec
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceDevice, BalanceEmulator
from actors.balance.simulated_balance import Load
from actors.interfaces import LaboratoryError
from actors.runtime.remote_object import Device


@dataclass(frozen=True)
class Found:
    """Where drivers find what was started.

    Attributes:
        arm: the arm's settings, with the address of what stands in for it.
        balance: the balance's settings likewise; None where weights are typed.
        follows: whether `history` can be asked for.
    """

    arm: ArmSpec
    balance: BalanceDevice | None
    follows: bool


@dataclass(frozen=True)
class History:
    """What the controller's joints did.

    Attributes:
        times: of the controller [s], increasing.
        joints: six at each of these [rad].
        now: when it was asked [s].
    """

    times: tuple[float, ...]
    joints: tuple[tuple[float, ...], ...]
    now: float


class ArmEmulator(Protocol):
    """What an arm's driver talks to on a virtual bench; made of an `ArmSpec`, named by its `stand_in`."""

    @property
    def arm(self) -> ArmSpec:
        """The settings, with its address filled in."""
        ...

    def install(self) -> None:
        """Set what a person would have set on a real one, once and for all."""
        ...

    def history(self, since: float) -> History:
        """What the joints did since a time of its own [s]."""
        ...

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Have something go wrong, or ask what it knows of itself."""
        ...

    def close(self) -> None:
        """End it. May be called again."""
        ...


def emulator_of(arm: ArmSpec) -> ArmEmulator | None:
    """Start what stands in for an arm; None where its driver moves nothing but numbers itself."""
    if not arm.stand_in:
        return None
    module, _, name = arm.stand_in.partition(":")
    return cast(ArmEmulator, getattr(importlib.import_module(module), name)(arm))


class BenchEmulators:
    """For arm and balance, in processes of their own, which end with this one.

    Args:
        arm: which arm.
        balance: which balance; None for weights that are typed.
    """

    def __init__(self, arm: ArmSpec, balance: BalanceDevice | None) -> None:
        self._spec = arm
        self._arm = emulator_of(arm)
        self._weighs = balance
        self._balance: BalanceEmulator | None = None
        try:
            self._balance = None if balance is None else balance.stand_in()
        except BaseException:
            self.close()
            raise

    def found(self) -> Found:
        """Where they are."""
        arm = self._spec if self._arm is None else self._arm.arm
        return Found(arm, self._weighs if self._balance is None else self._balance.device, self._arm is not None)

    def install(self) -> None:
        """See `ArmEmulator.install`."""
        if self._arm is not None:
            self._arm.install()

    def prepare(self, seed: tuple[int, ...]) -> None:
        """A new pour: the balance's chance begins anew, and it is empty."""
        if self._balance is not None:
            self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """What stands on the balance from now on [kg]."""
        if self._balance is not None:
            self._balance.put(mass)

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`."""
        return self._of_the_arm.history(since)

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`."""
        return self._of_the_arm.fault(name, arguments)

    @property
    def _of_the_arm(self) -> ArmEmulator:
        if self._arm is None:
            raise LaboratoryError("nothing stands in for the arm here")
        return self._arm

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """Have something done to the balance: 'unplug', 'plug', 'faults' …, see what stands in for it."""
        if self._balance is None:
            raise LaboratoryError("there is no virtual balance here")
        return self._balance.order(what, values)

    def close(self) -> None:
        """End both. May be called again."""
        if self._arm is not None:
            self._arm.close()
        if self._balance is not None:
            self._balance.close()


DEADLINE = 30.0
"""Longest wait for any answer [s]; its process may still be starting."""


class DeviceEmulators:
    """`actors.bench.device_emulators.StandIns` over a `Device`.

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
