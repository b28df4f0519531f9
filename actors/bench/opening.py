"""Opens a bench: drivers of arm and balance, and on a virtual bench what is at their other ends."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from actors.arm.actor import DeviceArm
from actors.arm.numbers import NumbersSpec
from actors.arm.spec import ArmSpec, UrArmSpec
from actors.balance.actor import DeviceBalance
from actors.balance.spec import BalanceDevice, BalanceSpec
from actors.bench.consent import Setup
from actors.bench.device_stand_ins import DeviceStandIns
from actors.bench.numbers_bench import NumbersBench, NumbersOperator, numbers_balance
from actors.bench.pouring_bench import PouringBench
from actors.bench.questions import Questions
from actors.bench.spec import VirtualBenchSpec
from actors.bench.stand_ins import StandIns
from actors.bench.things import Things
from actors.bench.virtual_bench import FollowedBench, Nature, VirtualBench
from actors.bench.virtual_operator import Hands, PlayedOperator, VirtualOperator
from actors.device import Device
from actors.operator import Operator
from actors.protocols import LaboratoryError, Notice, SimulatorPool
from actors.spec import LaboratorySpec

MakeDevice = Callable[..., Device]
"""Makes a device of a name, a class and its arguments, where the bench is."""


@dataclass
class OpenBench:
    """What was opened.

    Attributes:
        bench: pours.
        devices: to be closed after `close`.
        stand_ins: of a virtual bench with wires.
        operator: who answers.
    """

    bench: PouringBench
    devices: list[Device]
    stand_ins: DeviceStandIns | None = None
    operator: Operator | None = None

    async def close(self) -> None:
        """Let go of arm and balance; end what was started in their place."""
        with contextlib.suppress(LaboratoryError):
            await self.bench.arm.close()
        if self.bench.balance is not None:
            with contextlib.suppress(LaboratoryError):
                await self.bench.balance.release()
        if self.stand_ins is not None:
            with contextlib.suppress(LaboratoryError):
                await self.stand_ins.close()


@dataclass
class _Opening:
    """Devices so far, for what fails half-way."""

    make: MakeDevice
    devices: list[Device] = field(default_factory=list)

    def __call__(self, name: str, cls: type[Any], *args: Any) -> Device:
        self.devices.append(self.make(name, cls, *args))
        return self.devices[-1]

    def arm(self, spec: ArmSpec, accepted: str | None = None) -> DeviceArm:
        cls, args = spec.driver(accepted)
        return DeviceArm(self("arm", cls, *args), spec)

    def balance(self, spec: BalanceDevice, name: str) -> DeviceBalance:
        cls, args = spec.driver(name)
        return DeviceBalance(self("balance", cls, *args), spec.time_scale, longest_call=spec.longest_call)


def needs_person(spec: LaboratorySpec) -> bool:
    """Whether somebody has to be there to answer."""
    return spec.arm is not None and spec.operator.answers == "person"


async def open_bench(
    spec: LaboratorySpec,
    make: MakeDevice,
    liquid: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
) -> OpenBench:
    """The bench of a laboratory that pours.

    Args:
        spec: of the laboratory.
        make: makes devices where the bench is.
        liquid: simulates the hidden liquid of a virtual bench.
        operator: a person, where one answers.
        tell: takes notices.

    Raises:
        LaboratoryError: something does not start, or nobody is there to answer.
    """
    opening = _Opening(make)
    try:
        if spec.arm is None:
            assert spec.bench is not None
            assert liquid is not None
            return _numbers(spec.bench, opening, liquid)
        if spec.balance is None:
            raise LaboratoryError(f"laboratory {spec.name}: an arm that pours needs a balance; add a 'balance' to it")
        if operator is None and needs_person(spec):
            raise LaboratoryError(
                f"laboratory {spec.name} needs a person beside it who answers questions, and nobody is here to be asked"
            )
        return await _wired(spec, spec.arm, spec.balance, opening, liquid, operator, tell)
    except BaseException:
        for device in reversed(opening.devices):
            with contextlib.suppress(LaboratoryError):
                await device.close()
        raise


def _numbers(spec: VirtualBenchSpec, opening: _Opening, liquid: SimulatorPool) -> OpenBench:
    arm_spec, balance_spec = NumbersSpec(spec.time_scale), numbers_balance(spec)
    arm = opening.arm(arm_spec)
    assert balance_spec.device is not None
    balance = opening.balance(balance_spec.device, "virtual")
    nature = NumbersBench(spec, liquid, arm, balance)
    operator = NumbersOperator(nature, balance, spec.operator_time)
    setup = Setup("virtual", arm_spec, balance_spec, spec.operator_time, arm, balance, operator, nature, _nobody)
    return OpenBench(PouringBench(setup), opening.devices, operator=operator)


def _nobody(notice: Notice) -> None:
    """Whoever would get every weighing on a bench of numbers."""


async def _wired(
    spec: LaboratorySpec,
    arm_spec: ArmSpec,
    balance_spec: BalanceSpec,
    opening: _Opening,
    liquid: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
) -> OpenBench:
    stand_ins: DeviceStandIns | None = None
    follows = False
    if spec.mode == "virtual":
        stand_ins = DeviceStandIns(opening("stand-ins", StandIns, arm_spec, balance_spec.device))
        found = await stand_ins.found()
        arm_spec, follows = found.arm, found.follows
        balance_spec = replace(balance_spec, device=found.balance)
    arm = opening.arm(arm_spec, None if spec.mode == "virtual" else spec.accepted_checksum)
    balance = None if balance_spec.device is None else opening.balance(balance_spec.device, spec.name)
    if stand_ins is not None and balance_spec.device is not None and balance_spec.device.told:
        stand_ins.told = balance
    nature = Nature(arm_spec.time_scale)
    if stand_ins is not None and spec.bench is not None and liquid is not None:
        hands = Hands(Things(balance_spec.placement), None if balance is None else stand_ins.put)
        if follows and isinstance(arm_spec, UrArmSpec):
            nature = FollowedBench(spec.bench, arm_spec, stand_ins, hands, liquid)
        else:
            nature = VirtualBench(spec.bench, arm_spec.time_scale, stand_ins, hands, liquid)
        if spec.operator.answers == "virtual":
            operator = operator or VirtualOperator(hands, spec.operator.time / arm_spec.time_scale)
        elif operator is not None:
            operator = PlayedOperator(operator, hands)
    assert operator is not None
    questions = Questions(operator, spec.operator, tell, arm_spec.time_scale)
    setup = Setup(spec.mode, arm_spec, balance_spec, spec.operator.time, arm, balance, questions, nature, tell)
    return OpenBench(PouringBench(setup), opening.devices, stand_ins, operator)
