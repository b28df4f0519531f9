"""The emulators of a virtual bench: one for the arm, and a balance on a pseudo-terminal.

`BenchEmulators` starts and holds them; it blocks. `actors.runtime.remote_object` places it on the bench's machine, next
to the drivers that connect to it. `DeviceEmulators` offers the same calls to the event loop. The emulators themselves
are in `actors.emulators`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Protocol, cast

from actors.arm.arm_settings import ArmSettings
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceEmulator, BalanceSettings
from actors.balance.scale_model import Load
from actors.interfaces import LaboratoryError
from actors.runtime.remote_object import Device


@dataclass(frozen=True)
class Found:
    """The addresses at which drivers find the emulators.

    Attributes:
        arm: the arm's settings with the address of its emulator.
        balance: the balance's settings with the address of its emulator; None without a balance.
        follows: whether `history` is available.
    """

    arm: ArmSettings
    balance: BalanceSettings | None
    follows: bool


@dataclass(frozen=True)
class History:
    """Recorded joint motion of the controller.

    Attributes:
        times: controller times [s], increasing.
        joints: six joint angles at each time [rad].
        now: controller time of the request [s].
    """

    times: tuple[float, ...]
    joints: tuple[tuple[float, ...], ...]
    now: float


class ArmEmulator(Protocol):
    """The emulator that an arm's driver connects to; created from an `ArmSettings`, which names it in `emulator`."""

    @property
    def arm(self) -> ArmSettings:
        """The settings, with the emulator's address."""
        ...

    def install(self) -> None:
        """Configure the emulator once, as a person would configure a real controller."""
        ...

    def history(self, since: float) -> History:
        """Joint motion since a controller time [s]."""
        ...

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Inject a fault, or read the emulator's internal state."""
        ...

    def close(self) -> None:
        """End the emulator. May be called again."""
        ...


def emulator_of(arm: ArmSettings) -> ArmEmulator | None:
    """Start the emulator of an arm; None if the arm's driver is a simulation itself."""
    if not arm.emulator:
        return None
    module, _, name = arm.emulator.partition(":")
    return cast(ArmEmulator, getattr(importlib.import_module(module), name)(arm))


class BenchEmulators:
    """The emulators of arm and balance, in child processes that end with this process.

    Args:
        arm: settings of the arm.
        balance: settings of the balance; None without one.
    """

    def __init__(self, arm: ArmSettings, balance: BalanceSettings | None) -> None:
        self._spec = arm
        self._arm = emulator_of(arm)
        self._weighs = balance
        self._balance: BalanceEmulator | None = None
        try:
            self._balance = None if balance is None or balance.typed else balance.start_emulator()
        except BaseException:
            self.close()
            raise

    def found(self) -> Found:
        """Return the addresses of the emulators."""
        arm = self._spec if self._arm is None else self._arm.arm
        return Found(arm, self._weighs if self._balance is None else self._balance.balance, self._arm is not None)

    def install(self) -> None:
        """See `ArmEmulator.install`."""
        if self._arm is not None:
            self._arm.install()

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Prepare a new pour: reseed the balance's random numbers and empty the balance."""
        if self._balance is not None:
            self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """Set the mass on the balance from now on [kg]."""
        if self._balance is not None:
            self._balance.put(mass)

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`."""
        return self._arm_emulator.history(since)

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`."""
        return self._arm_emulator.fault(name, arguments)

    @property
    def _arm_emulator(self) -> ArmEmulator:
        if self._arm is None:
            raise LaboratoryError("nothing stands in for the arm here")
        return self._arm

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """Send a command to the balance emulator: 'unplug', 'plug', 'faults' …; see its `order`."""
        if self._balance is None:
            raise LaboratoryError("there is no virtual balance here")
        return self._balance.order(what, values)

    def close(self) -> None:
        """End both emulators. May be called again."""
        if self._arm is not None:
            self._arm.close()
        if self._balance is not None:
            self._balance.close()


DEADLINE = 30.0
"""Longest wait for any reply [s]; the process may still be starting."""


class DeviceEmulators:
    """`BenchEmulators` over a `Device`, for the event loop.

    Args:
        device: holds the `BenchEmulators`.

    Attributes:
        told: a balance whose driver receives the load directly; None if an emulator carries the load.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.told: DeviceBalance | None = None

    async def found(self) -> Found:
        """Return the addresses of the emulators."""
        found: Found = await self.device.call("found", deadline=4.0 * DEADLINE)
        return found

    async def prepare(self, seed: tuple[int, ...]) -> None:
        """Prepare a new pour."""
        await self.device.call("prepare", seed, deadline=DEADLINE)
        if self.told is not None:
            await self.told.prepare(seed)

    async def put(self, mass: float) -> None:
        """Set the mass on the balance from now on [kg]."""
        if self.told is not None:
            await self.told.put(Load((0.0,), (mass,)))
        else:
            await self.device.call("put", mass, deadline=DEADLINE)

    async def history(self, since: float) -> History:
        """Joint motion since a controller time [s]; empty for a time in the future."""
        history: History = await self.device.call("history", min(since, 1e12), deadline=DEADLINE)
        return history

    async def fault(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Request a fault from the controller's emulator."""
        answer: dict[str, Any] = await self.device.call("fault", name, arguments, deadline=DEADLINE, urgent=True)
        return answer

    async def order(self, what: str, **values: Any) -> dict[str, Any]:
        """Send a command to the balance emulator."""
        answer: dict[str, Any] = await self.device.call("order", what, values, deadline=DEADLINE, urgent=True)
        return answer

    async def close(self) -> None:
        """End both emulators."""
        await self.device.call("close", deadline=DEADLINE)
