"""Opens a bench over wires: its drivers, and on a virtual bench what is at their other ends."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from actors.arm.accepted import AcceptedArm
from actors.arm.spec import UrArmSpec
from actors.arm.ur.driver import UrArm
from actors.balance.actor import DeviceBalance
from actors.balance.serial_balance import SerialBalance
from actors.balance.spec import BalanceSpec
from actors.bench.place import Site
from actors.bench.planning import planner
from actors.bench.questions import Questions
from actors.bench.reality import Reality
from actors.bench.site import VirtualSite
from actors.bench.things import Things
from actors.bench.virtual_operator import Hands, PlayedOperator, VirtualOperator
from actors.bench.wired import WiredBench, WiredSpec
from actors.bench.wired_arm import WiredArm
from actors.device import Device
from actors.operator import Operator
from actors.protocols import LaboratoryError, Notice, SimulatorPool
from actors.spec import LaboratorySpec

MakeDevice = Callable[..., Device]
"""Makes a device of a name, a class and its arguments, where the bench is."""


@dataclass
class WiredRooms:
    """What was opened.

    Attributes:
        bench: pours.
        devices: to be closed after `close`.
        site: of a virtual bench.
    """

    bench: WiredBench
    devices: list[Device]
    site: Site | None = None
    operator: Operator | None = None

    async def close(self) -> None:
        """Let go of arm and balance; end what was started in their place."""
        with contextlib.suppress(LaboratoryError):
            await self.bench.arm.close()
        if self.bench.balance is not None:
            with contextlib.suppress(LaboratoryError):
                await self.bench.balance.release()
        if self.site is not None:
            with contextlib.suppress(LaboratoryError):
                await self.site.close()


@dataclass
class _Opening:
    """Devices so far, for what fails half-way."""

    make: MakeDevice
    devices: list[Device] = field(default_factory=list)

    def __call__(self, name: str, cls: type[Any], *args: Any) -> Device:
        self.devices.append(self.make(name, cls, *args))
        return self.devices[-1]


def needs_person(spec: LaboratorySpec) -> bool:
    """Whether somebody has to be there to answer."""
    return spec.arm is not None and spec.operator.answers == "person"


async def open_wired(
    spec: LaboratorySpec,
    make: MakeDevice,
    world: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
) -> WiredRooms:
    """The bench of a laboratory with an arm.

    Args:
        spec: of the laboratory.
        make: makes devices where the bench is.
        world: simulates the hidden liquid of a virtual bench.
        operator: a person, where one answers.
        tell: takes notices.

    Raises:
        LaboratoryError: something does not start, or nobody is there to answer.
    """
    assert spec.arm is not None
    if spec.balance is None:
        raise LaboratoryError(f"laboratory {spec.name}: an arm that pours needs a balance; add a 'balance' to it")
    if operator is None and needs_person(spec):
        raise LaboratoryError(
            f"laboratory {spec.name} needs a person beside it who answers questions, and nobody is here to be asked"
        )
    opening = _Opening(make)
    try:
        return await _open(spec, spec.arm, spec.balance, opening, world, operator, tell)
    except BaseException:
        for device in reversed(opening.devices):
            with contextlib.suppress(LaboratoryError):
                await device.close()
        raise


async def _open(
    spec: LaboratorySpec,
    arm_spec: UrArmSpec,
    balance_spec: BalanceSpec,
    opening: _Opening,
    world: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
) -> WiredRooms:
    site: Site | None = None
    if spec.mode == "virtual":
        site = Site(opening("site", VirtualSite, arm_spec, balance_spec))
        found = await site.addresses()
        arm_spec = replace(arm_spec, address=found.controller)
        if balance_spec.serial is not None:
            balance_spec = replace(balance_spec, serial=replace(balance_spec.serial, port=found.port))
        driver = opening("arm", UrArm, arm_spec)
    else:
        driver = opening("arm", AcceptedArm, arm_spec, spec.accepted_checksum)
    arm = WiredArm(driver, arm_spec)
    balance: DeviceBalance | None = None
    if balance_spec.serial is not None:
        device = opening("balance", SerialBalance, balance_spec.serial, spec.name)
        balance = DeviceBalance(device, balance_spec.serial.time_scale, longest_call=balance_spec.serial.longest_call)
    reality: Reality | None = None
    if site is not None and spec.bench is not None and world is not None:
        hands = Hands(Things(balance_spec.placement), None if balance is None else site.put)
        reality = Reality(spec.bench, arm_spec, site, hands, world)
        if spec.operator.answers == "virtual":
            operator = operator or VirtualOperator(hands, spec.operator.time / arm_spec.time_scale)
        elif operator is not None:
            operator = PlayedOperator(operator, hands)
    assert operator is not None
    bench = WiredBench(
        WiredSpec(spec.mode, arm_spec, balance_spec, spec.operator.time),
        arm,
        balance,
        Questions(operator, spec.operator, tell, arm_spec.time_scale),
        plan=planner(arm_spec),
        reality=reality,
        tell=tell,
    )
    return WiredRooms(bench, opening.devices, site, operator)
