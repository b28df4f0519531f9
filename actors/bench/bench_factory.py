"""Opens the bench of a laboratory: the drivers of arm and balance, the operator, and the emulators of a virtual bench.

`open_bench` starts the devices and returns an `OpenBench`. Its `PouringBench` runs one pour at a time, on hardware,
with emulated devices or with simulated ones. The steps of a pour are in `actors.bench.pour_procedure`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from actors.arm.arm_device import DeviceArm
from actors.arm.arm_interface import ArmFacts, PlannedPour
from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.pour_feasibility import path_of
from actors.arm.simulated_arm import SimulatedArmSettings
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSettings, balance_kind
from actors.balance.weighing_plan import Placement, Weighing
from actors.bench.bench_operators import BenchContents, Hands, OperatorQuestions, PlayedOperator, VirtualOperator
from actors.bench.cell_liquids import CellLiquids
from actors.bench.consent import Setup
from actors.bench.dose_handling import DoseHandling
from actors.bench.dose_procedure import DoseProcedure
from actors.bench.ground_truth import GroundTruth
from actors.bench.held_vessel import HeldVessel, HoldingArm
from actors.bench.liquid_supply import LiquidSupply, PumpDevice, SpillWatch
from actors.bench.night_consent import NightConsent
from actors.bench.pour_procedure import BenchProcedure, PourProcedure, is_of_host
from actors.bench.simulated_bench import SimulatedBench, SimulatedOperator, simulated_balance
from actors.bench.vessel_carrying import VesselCarrier
from actors.bench.vessel_handling import VesselHandling
from actors.bench.virtual_bench import BenchEmulators, DeviceEmulators, FollowedBench, VirtualBench
from actors.dosing_settings import DosingSettings
from actors.grippers.gripper_interface import GripperSettings
from actors.interfaces import (
    DoseTarget,
    InvalidActionError,
    LaboratoryError,
    LinkLostError,
    Notice,
    NotPouredError,
    Operator,
    OperatorQuestion,
    ProgressCallback,
    SimulatorPool,
)
from actors.laboratory_settings import BenchSettings, LaboratorySettings
from actors.liquid_devices import SourceSettings, SpillSensorSettings
from actors.places import Layout, PlaceRecord, all_places
from actors.runtime.bench_clock import device_clock
from actors.runtime.remote_object import Device
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene


class PouringBench:
    """The `Bench` interface for every kind of bench. The arm moves only after all checks, weighings and confirmations.

    Args:
        setup: arm, balance, operator and ground truth of the bench.
        dosing: how wanted amounts are poured.
    """

    def __init__(self, setup: Setup, dosing: DosingSettings) -> None:
        self._setup, self._arm_spec, self._dosing = setup, setup.spec, dosing
        self.arm, self.balance, self.ground_truth = setup.arm, setup.balance, setup.ground_truth
        self._watch = setup.watch
        self._known: dict[str, dict[str, Weighing]] = {}
        self._one_at_a_time = asyncio.Lock()

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'."""
        return self._setup.mode

    async def pour(
        self,
        scene: Scene,
        action: Any,
        *,
        seed: int,
        progress: ProgressCallback | None = None,
        dose: DoseTarget | None = None,
    ) -> PourMeasurement:
        """See `Bench.pour`. Cancelling stops the arm.

        Raises:
            InvalidActionError: the pour was rejected before any motion and before any question.
            NotPouredError: the pour did not begin; `LinkLostError` if a virtual bench may make it again.
            UnknownPourError: the pour began, but did not run as planned.
        """
        async with self._one_at_a_time:
            if dose is not None:
                simulated = await self.ground_truth.simulated_dose(scene, dose, seed, self._dosing, progress)
                if simulated is not None:
                    return simulated
            self._arm_spec = self._arm_spec.fitted_to(await self._connected())
            path = await asyncio.to_thread(self._checked, scene, action)
            if self._setup.doses is not None and dose is not None:
                await asyncio.to_thread(self._setup.doses.fit, self._arm_spec, scene, dose, path)
            elif self._setup.handling is not None:
                await asyncio.to_thread(self._setup.handling.fit, self._arm_spec, scene, path)

            async def run() -> PourMeasurement:
                return await self._run(scene, action, path, seed, progress, dose)

            return await (run() if self._watch is None else self._watch.watched(run, self.arm.hands_in))

    async def _connected(self) -> ArmFacts:
        """Connect the arm: a path planned without the robot's calibration is refused by the arm.

        A lost connection may return at once, so there are two attempts.

        Raises:
            NotPouredError: the arm cannot be connected; `LinkLostError` if a virtual bench may make the pour again.
        """
        with contextlib.suppress(LaboratoryError):
            return await self.arm.ready()
        try:
            return await self.arm.ready()
        except LaboratoryError as error:
            if self._setup.night is not None:
                self._setup.night.end(str(error))
            lost = self.mode == "virtual" and is_of_host(error)
            raise (LinkLostError if lost else NotPouredError)(f"{error}. Nothing was poured") from error

    async def _run(
        self,
        scene: Scene,
        action: Action,
        path: PlannedPour,
        seed: int,
        progress: ProgressCallback | None,
        dose: DoseTarget | None,
    ) -> PourMeasurement:
        procedure: BenchProcedure
        if dose is not None:
            procedure = self._dose(scene, dose, path, seed, progress)
        else:
            procedure = PourProcedure(
                self._setup, scene, action, path, seed=seed, known=self._known.get(scene.pourer.name), progress=progress
            )
        try:
            return await procedure.run()
        except BaseException as error:
            for handling in (self._setup.handling, self._setup.doses):
                if handling is not None:
                    handling.forget()
            if self._setup.night is not None:
                self._setup.night.end(str(error) or f"the {procedure.name} was given up")
            raise
        finally:
            if isinstance(procedure, PourProcedure):
                self._known[scene.pourer.name] = procedure.lasting

    async def ask(self, question: OperatorQuestion) -> str:
        """See `Answering.ask`."""
        if self._setup.night is not None:
            self._setup.night.agrees(question)
        return await self._setup.questions.ask(question)

    async def stop(self) -> None:
        """Stop any motion, and the refill pump; the arm stays locked."""
        await self.arm.stop()
        if self._setup.supply is not None:
            await self._setup.supply.interrupt()

    async def close(self) -> None:
        """Close the arm, and release balance, supply and spill sensor."""
        with contextlib.suppress(LaboratoryError):
            await self.arm.close()
        if self.balance is not None:
            with contextlib.suppress(LaboratoryError):
                await self.balance.release()
        await self.ground_truth.close()
        if self._setup.supply is not None:
            await self._setup.supply.close()
        if self._setup.held is not None:
            await self._setup.held.close()
        if self._watch is not None:
            await self._watch.close()

    def _dose(
        self, scene: Scene, dose: DoseTarget, path: PlannedPour, seed: int, progress: ProgressCallback | None
    ) -> DoseProcedure:
        if not arm_kind(self._arm_spec).doses:
            raise InvalidActionError(f"an arm of the kind '{self._arm_spec.kind}' can't pour wanted amounts")
        return DoseProcedure(self._setup, scene, dose, path, seed=seed, settings=self._dosing, progress=progress)

    def _checked(self, scene: Scene, action: Action) -> PlannedPour:
        path = path_of(scene, action, self._arm_spec)
        assert path is not None
        return path


MakeDevice = Callable[..., Device]
"""Creates a device on the bench's machine from a name, a class and its arguments."""


@dataclass
class OpenBench:
    """An open bench and everything that has to be closed with it.

    Attributes:
        bench: runs pours.
        devices: the caller closes them after `close`.
        emulators: the emulators of a virtual bench with device drivers; None otherwise.
        operator: answers the questions.
    """

    bench: PouringBench
    devices: list[Device]
    emulators: DeviceEmulators | None = None
    operator: Operator | None = None

    async def close(self) -> None:
        """Close the bench, and end the emulators that were started for it."""
        await self.bench.close()
        if self.emulators is not None:
            with contextlib.suppress(LaboratoryError):
                await self.emulators.close()


@dataclass
class _Opening:
    """The devices created so far; they are closed if opening the bench fails."""

    make: MakeDevice
    devices: list[Device] = field(default_factory=list)

    def __call__(self, name: str, cls: type[Any], *args: Any) -> Device:
        self.devices.append(self.make(name, cls, *args))
        return self.devices[-1]

    def arm(self, spec: ArmSettings, accepted: str | None = None, held: HeldVessel | None = None) -> DeviceArm:
        cls, args = arm_kind(spec).driver(accepted)
        device = self("arm", cls, *args)
        return DeviceArm(device, spec) if held is None else HoldingArm(device, spec, held)

    def balance(self, spec: BalanceSettings, name: str, device: str = "balance") -> DeviceBalance:
        cls, args = balance_kind(spec).driver(name)
        patience = device_clock(spec.clock).patience
        return DeviceBalance(
            self(device, cls, *args), spec.time_scale, longest_call=spec.longest_call, patience=patience
        )

    def held(
        self,
        spec: GripperSettings | None,
        arm: ArmSettings,
        balance: DeviceBalance | None,
        weighing: BalanceSettings,
        tell: Callable[[Notice], None],
    ) -> HeldVessel | None:
        if spec is None:
            return None
        cls, args = spec.driver()
        weight = None
        if balance is not None and weighing.position is Placement.TRAY and weighing.pourer == "here":

            async def weight() -> float:
                return (await balance.weigh()).mass

        return HeldVessel(self("gripper", cls, *args), spec, arm, tell, weight)

    def supply(
        self, spec: SourceSettings | None, contents: BenchContents | None, scale: float, tell: Callable[[Notice], None]
    ) -> LiquidSupply:
        balance = refill = None
        if spec is not None and spec.balance is not None:
            timed = spec.balance.with_values(time_scale=scale)
            spec, balance = spec.with_values(balance=timed), self.balance(timed, "source", "source-balance")
        if spec is not None and spec.refill is not None:
            cls, args = spec.refill.driver()
            refill = PumpDevice(self("refill", cls, *args), spec.refill)
        return LiquidSupply(spec, balance, refill, contents, tell)

    def watch(
        self, spec: SpillSensorSettings | None, questions: OperatorQuestions, tell: Callable[[Notice], None]
    ) -> SpillWatch | None:
        if spec is None:
            return None
        cls, args = spec.driver()
        return SpillWatch(self("spill-sensor", cls, *args), spec, questions, tell)


async def open_bench(
    spec: LaboratorySettings,
    make: MakeDevice,
    liquid: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
    record: PlaceRecord | None = None,
) -> OpenBench:
    """Open the bench of a laboratory that pours.

    Args:
        spec: settings of the laboratory.
        make: creates devices on the bench's machine.
        liquid: simulates the ground truth of a virtual bench.
        operator: the person who answers, if one does.
        tell: receives notices.
        record: what stands where, for a laboratory with places.

    Raises:
        LaboratoryError: a device does not start, or the laboratory needs an operator and none is available.
    """
    opening = _Opening(make)
    try:
        if operator is None and spec.needs_person:
            raise LaboratoryError(
                f"laboratory {spec.name} needs a person next to it who answers questions, and there is none to ask"
            )
        if spec.arm is None:
            assert spec.bench is not None
            assert liquid is not None
            return _open_simulated(spec.bench, spec.dosing, opening, liquid)
        if spec.balance is None:
            raise LaboratoryError(f"laboratory {spec.name}: an arm that pours needs a balance; add a 'balance' to it")
        return await _open_devices(spec, spec.arm, spec.balance, opening, liquid, operator, tell, record)
    except BaseException:
        for device in reversed(opening.devices):
            with contextlib.suppress(LaboratoryError):
                await device.close()
        raise


def _open_simulated(spec: BenchSettings, dosing: DosingSettings, opening: _Opening, liquid: SimulatorPool) -> OpenBench:
    arm_spec, balance_spec = SimulatedArmSettings(time_scale=spec.time_scale), simulated_balance(spec)
    arm = opening.arm(arm_spec)
    balance = opening.balance(balance_spec, "virtual")
    ground_truth = SimulatedBench(spec, liquid, arm, balance)
    operator = SimulatedOperator(ground_truth, balance, spec.operator_time)
    setup = Setup(
        "virtual", arm_spec, balance_spec, spec.operator_time, arm, balance, operator, ground_truth, _discard_notice
    )
    return OpenBench(PouringBench(setup, dosing), opening.devices, operator=operator)


def _operator(spec: LaboratorySettings, hands: Hands, operator: Operator | None, time_scale: float) -> Operator | None:
    """Who answers at a virtual bench; a person's answers move its things, too."""
    if spec.operator.answers == "virtual":
        return operator or VirtualOperator(hands, spec.operator.time / time_scale if time_scale > 0.0 else 0.0)
    return None if operator is None else PlayedOperator(operator, hands)


def _discard_notice(notice: Notice) -> None:
    """Discards the notices of a simulated bench, for example every weighing."""


async def _open_devices(
    spec: LaboratorySettings,
    arm_spec: ArmSettings,
    balance_spec: BalanceSettings,
    opening: _Opening,
    liquid: SimulatorPool | None,
    operator: Operator | None,
    tell: Callable[[Notice], None],
    record: PlaceRecord | None,
) -> OpenBench:
    emulators: DeviceEmulators | None = None
    true_arm: ArmSettings | None = None
    gripper_spec = None if spec.gripper is None else spec.gripper.beside(arm_spec)
    if spec.mode == "virtual":
        emulators = DeviceEmulators(opening("emulators", BenchEmulators, arm_spec, balance_spec, gripper_spec))
        addresses = await emulators.found()
        arm_spec, true_arm = addresses.arm, addresses.true_arm
        balance_spec, gripper_spec = addresses.balance or balance_spec, addresses.gripper or gripper_spec
    balance = None if balance_spec.typed else opening.balance(balance_spec, spec.name)
    held = opening.held(gripper_spec, arm_spec, balance, balance_spec, tell)
    arm = opening.arm(arm_spec, None if spec.mode == "virtual" else spec.accepted_checksum, held)
    if emulators is not None and balance_spec.receives_load:
        emulators.told = balance
    ground_truth = GroundTruth(arm_spec.time_scale)
    contents: BenchContents | None = None
    if emulators is not None and spec.bench is not None and liquid is not None:
        contents = BenchContents(balance_spec.position)
        hands = Hands(contents, None if balance is None else emulators.put, None if held is None else emulators.hold)
        if true_arm is not None:
            drivers: list[DeviceArm | DeviceBalance] = [arm, *([] if balance is None else [balance])]
            ground_truth = FollowedBench(spec.bench, true_arm, emulators, hands, liquid, drivers)
        else:
            ground_truth = VirtualBench(spec.bench, arm_spec.time_scale, emulators, hands, liquid)
        operator = _operator(spec, hands, operator, arm_spec.time_scale)
    assert operator is not None
    questions = OperatorQuestions(operator, spec.operator, tell, arm_spec.time_scale)
    supply = None if spec.source is None else opening.supply(spec.source, contents, arm_spec.time_scale, tell)
    watch = opening.watch(spec.spill_sensor, questions, tell)
    handling = doses = night = None
    if spec.unattended is not None:
        safeguard, vessels = spec.safeguard, spec.vessels
        night = NightConsent(spec.unattended, safeguard, arm_spec.title, spec.places, tell, vessels=vessels)
    if spec.places:
        assert held is not None
        assert balance is not None
        if record is None:
            raise LaboratoryError(f"laboratory {spec.name} has places, and no account of what stands where was given")
        places = all_places(spec.places)
        pan = Layout.of(places).balance
        carrier = VesselCarrier(pan.name, arm, arm_spec, held, balance, balance_spec, record, ground_truth)
        liquids = CellLiquids(record, carrier, pan.tray)
        handling = VesselHandling(places, carrier, liquids, balance_spec, supply, ground_truth, tell)
        doses = DoseHandling(places, spec.vessels, carrier, liquids, record, supply, ground_truth)
    setup = Setup(
        spec.mode,
        arm_spec,
        balance_spec,
        spec.operator.time,
        arm,
        balance,
        questions,
        ground_truth,
        tell,
        supply,
        watch,
        held,
        handling,
        doses,
        night,
    )
    return OpenBench(PouringBench(setup, spec.dosing), opening.devices, emulators, operator)
