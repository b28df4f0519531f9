"""A virtual bench: emulators of the devices, and a liquid that follows the motion that the arm executed.

- `BenchEmulators` starts and holds the emulators of arm and balance; it blocks. `actors.runtime.remote_object` places
  it on the bench's machine, next to the drivers that connect to it. `DeviceEmulators` offers the same calls to the
  event loop. The emulators themselves are in `actors.emulators`.
- `VirtualBench` takes the motion from the poses that the arm read back, `FollowedBench` from the joint history of the
  arm's emulator. `executed_pour` cuts the pour out of that history.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_device import DeviceArm
from actors.arm.arm_interface import Executed
from actors.arm.arm_settings import ArmEmulator, ArmSettings, History, arm_kind
from actors.arm.planned_pour import slipped
from actors.arm.pour_feasibility import vessel
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceEmulator, BalanceSettings, balance_kind
from actors.balance.scale_model import Load
from actors.bench.bench_operators import Hands
from actors.bench.flowing_liquid import FOLLOWED, FlowEnd, FlowingLiquid, FlowOrder, FormulaLiquid
from actors.bench.ground_truth import (
    FASTEST_DOSE,
    GroundTruth,
    GroundTruthTask,
    draw_pose_error,
    liquid_seed,
    spill_of,
    stream,
    true_pour,
)
from actors.dosing.dose_series import source_of
from actors.dosing.particle_liquid import FRAME_INTERVAL, check_particles, dose_task
from actors.dosing.simulated_dose import true_cup
from actors.grippers.gripper_interface import GripperEmulator, GripperSettings
from actors.interfaces import DoseSource, DoseTarget, LaboratoryError, SimulatorPool
from actors.laboratory_settings import BenchSettings
from actors.runtime.bench_clock import PATIENCE, DeviceClock, device_clock
from actors.runtime.remote_object import Device
from actors.simulators.live_worker import LivePourProcess
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import RecordedFrames
from sim_engine.scene import PoseError, PourTask, SampledMotion, Scene

FloatArray = NDArray[np.float64]

DEADLINE = 30.0 * PATIENCE
"""Longest wait for any reply of the emulators [s]; their process may still be starting."""

AT_START = 0.01
"""Largest joint distance from the pour's first pose at which the arm counts as standing there [rad]."""

AT_REST = 1e-6
"""Joints that change by less between two samples stand still [rad]."""

LONGEST_REST = 6.0
"""Longest simulated rest in the middle of a motion [s]; by then, everything that can run out has run out."""

UPRIGHT = math.radians(0.5)
"""Below this tilt [rad] a pourer is upright; the motions to and from a pour keep it below."""

NOTING_INTERVAL = 40.0
"""Interval between two reads of the arm's history [s of controller time]; a virtual controller keeps ten minutes."""

CREEP, CREEP_INTERVAL = 0.02, 1.0
"""Time that passes for the devices [s of the clock] in each interval of wall time [s] in which the liquid is simulated:
enough for replies of the balance.
"""

FILM = 0.4e-3
"""Liquid that stays in a receiver that was poured back [kg]; a tenth of it is random."""

LONGEST_GAP = 0.1
"""Largest distance between two samples of a history without a gap [s of controller time]; the sampling rate is 125 Hz.
"""


@dataclass(frozen=True)
class EmulatorAddresses:
    """The addresses at which drivers find the emulators.

    Attributes:
        arm: the arm's settings with the address of its emulator.
        balance: the balance's settings with the address of its emulator; None without one.
        true_arm: the arm's settings with the geometry of the emulator, which a driver has to read from it; None without
            an emulator. With one, `history` is available.
        gripper: the gripper's settings with the address of its emulator; None without one.
    """

    arm: ArmSettings
    balance: BalanceSettings | None
    true_arm: ArmSettings | None
    gripper: GripperSettings | None = None


class BenchEmulators:
    """The emulators of arm, balance and gripper, in child processes and threads that end with this process.

    Args:
        arm: settings of the arm.
        balance: settings of the balance; None without one.
        gripper: settings of the gripper; None without one.
    """

    def __init__(
        self, arm: ArmSettings, balance: BalanceSettings | None, gripper: GripperSettings | None = None
    ) -> None:
        self._spec = arm
        self._arm = arm_kind(arm).start_emulator()
        self._weighs = balance
        self._balance: BalanceEmulator | None = None
        self._flow: FlowingLiquid | None = None
        self._pours = LivePourProcess()
        self._gripper: GripperEmulator | None = None
        try:
            if gripper is not None:
                self._gripper = gripper.beside(arm if self._arm is None else self._arm.arm).start_emulator()
            if balance is not None and self._arm is not None:
                balance = self._weighs = balance.with_values(clock=self._arm.arm.clock)
            self._balance = None if balance is None or balance.typed else balance_kind(balance).start_emulator()
        except BaseException:
            self.close()
            raise

    def found(self) -> EmulatorAddresses:
        """Return the addresses of the emulators."""
        balance = self._weighs if self._balance is None else self._balance.balance
        gripper = None if self._gripper is None else self._gripper.gripper
        if self._arm is None:
            return EmulatorAddresses(self._spec, balance, None, gripper)
        return EmulatorAddresses(self._arm.arm, balance, self._arm.true_arm, gripper)

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

    def hold(self, width: float | None) -> None:
        """See `GripperEmulator.put`."""
        if self._gripper is not None:
            self._gripper.put(width)

    def gripper_fault(self, name: str, value: float) -> None:
        """See `GripperEmulator.fault`."""
        if self._gripper is None:
            raise LaboratoryError("there is no virtual gripper here")
        self._gripper.fault(name, value)

    def history(self, since: float) -> History:
        """See `ArmEmulator.history`."""
        return self._arm_emulator.history(since)

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `ArmEmulator.fault`."""
        return self._arm_emulator.fault(name, arguments)

    def pace(self, scale: float) -> None:
        """Set the bench seconds per second of the clock of arm and balance."""
        self._arm_emulator.fault("pace", {"scale": scale})
        self.order("pace", {"scale": scale})

    def ready(self, task: PourTask) -> None:
        """Start the process that simulates the particles of doses, if it does not run; nothing flows."""
        self._pours.ready(task)

    def flow(self, order: FlowOrder) -> None:
        """Let liquid follow the arm from now on; the load on the balance follows it.

        Raises:
            LaboratoryError: arm and balance have no emulators that can do this.
        """
        self.flowed()
        arm = None if self._arm is None else self._arm.true_arm
        if arm is None or self._balance is None:
            raise LaboratoryError("the virtual bench pours wanted amounts with an emulated arm and balance only")
        self._flow = FlowingLiquid(order, arm, self.history, self._load, self._pours)

    def frames(self) -> RecordedFrames | None:
        """Frames of the flowing particles since the last call; see `FlowOrder.watched`."""
        flow = self._flow
        return None if flow is None else flow.frames()

    def flowed(self) -> FlowEnd | None:
        """End the flow. Returns what flowed; None if nothing did."""
        flow, self._flow = self._flow, None
        return None if flow is None else flow.end()

    def _load(self, mass: float) -> None:
        if self._balance is not None:
            self._balance.order("load", {"mass": mass})

    @property
    def _arm_emulator(self) -> ArmEmulator:
        if self._arm is None:
            raise LaboratoryError("nothing stands in for the arm here")
        return self._arm

    def order(self, kind: str, values: dict[str, Any]) -> dict[str, Any]:
        """Send a command to the balance emulator: 'unplug', 'plug', 'faults' …; see its `order`."""
        if self._balance is None:
            raise LaboratoryError("there is no virtual balance here")
        return self._balance.order(kind, values)

    def close(self) -> None:
        """End both emulators. May be called again."""
        with contextlib.suppress(LaboratoryError):
            self.flowed()
        self._pours.close()
        if self._arm is not None:
            self._arm.close()
        if self._balance is not None:
            self._balance.close()
        if self._gripper is not None:
            self._gripper.close()


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

    async def found(self) -> EmulatorAddresses:
        """Return the addresses of the emulators."""
        found: EmulatorAddresses = await self.device.call("found", deadline=4.0 * DEADLINE)
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

    async def hold(self, width: float | None) -> None:
        """Hold a vessel of this width between the gripper's fingers [m], or take it away with None."""
        await self.device.call("hold", width, deadline=DEADLINE)

    async def gripper_fault(self, name: str, value: float = 1.0) -> None:
        """Request a fault from the gripper's emulator."""
        await self.device.call("gripper_fault", name, value, deadline=DEADLINE, urgent=True)

    async def history(self, since: float) -> History:
        """Joint motion since a controller time [s]; empty for a time in the future."""
        history: History = await self.device.call("history", min(since, 1e12), deadline=DEADLINE)
        return history

    async def fault(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Request a fault from the controller's emulator."""
        answer: dict[str, Any] = await self.device.call("fault", name, arguments, deadline=DEADLINE, urgent=True)
        return answer

    async def order(self, kind: str, **values: Any) -> dict[str, Any]:
        """Send a command to the balance emulator."""
        answer: dict[str, Any] = await self.device.call("order", kind, values, deadline=DEADLINE, urgent=True)
        return answer

    async def pace(self, time_scale: float) -> None:
        """Set the bench seconds per second of the clock of arm and balance."""
        await self.device.call("pace", time_scale, deadline=DEADLINE, urgent=True)

    async def ready(self, task: PourTask) -> None:
        """See `BenchEmulators.ready`; takes minutes where kernels are compiled."""
        await self.device.call("ready", task, deadline=10.0 * DEADLINE)

    async def flow(self, order: FlowOrder) -> None:
        """Let liquid follow the arm."""
        await self.device.call("flow", order, deadline=DEADLINE)

    async def frames(self) -> RecordedFrames | None:
        """Frames of the flowing particles since the last call."""
        frames: RecordedFrames | None = await self.device.call("frames", deadline=DEADLINE, urgent=True)
        return frames

    async def flowed(self) -> FlowEnd:
        """End the flow. Returns what flowed."""
        end: FlowEnd = await self.device.call("flowed", deadline=10.0 * DEADLINE)  # thick liquid takes minutes
        return end

    async def close(self) -> None:
        """End both emulators."""
        await self.device.call("close", deadline=DEADLINE)


@contextlib.asynccontextmanager
async def standing(clock: DeviceClock) -> AsyncIterator[None]:
    """Let the devices' clock almost stand while the liquid is simulated, so that a slow host adds no drift to it."""

    async def hold() -> None:
        while True:
            clock.promise("liquid", CREEP)
            await asyncio.sleep(CREEP_INTERVAL)

    holding = asyncio.create_task(hold())
    await asyncio.sleep(0)
    try:
        yield
    finally:
        holding.cancel()
        await asyncio.gather(holding, return_exceptions=True)
        clock.withdraw("liquid")


def _film(seed: int) -> float:
    """Liquid that stays in an emptied vessel [kg]."""
    return FILM * (1.0 + 0.1 * float(np.random.default_rng((seed, 71)).standard_normal()))


def executed_pour(times: FloatArray, joints: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the part of a history that is the pour: from the first movement away from its first pose to the last
    movement.

    Start and end do not depend on the clock, and long rests are shortened. The same motion is therefore cut in the same
    way, independent of the operator's response times.

    Args:
        times: shape (T,), increasing [s].
        joints: shape (T, n) [rad].
        start: the pour's first joints, shape (n,) [rad].

    Returns:
        Times from 0, and joints; None if the arm did not move after standing at the start.
    """
    away = np.max(np.abs(joints - start), axis=1) >= AT_START
    moves = np.max(np.abs(np.diff(joints, axis=0)), axis=1) > AT_REST
    rests = np.flatnonzero(~away[:-1] & ~moves)
    if len(rests) == 0:
        return None
    first = int(rests[0])
    left = np.flatnonzero(away[first:])
    if len(left) == 0:
        return None
    begin = first + int(left[0])
    while begin > first and moves[begin - 1]:
        begin -= 1
    end = begin + int(np.flatnonzero(moves[begin:])[-1]) + 1
    return _without_long_rests(np.diff(times[begin : end + 1]), moves[begin:end], joints[begin : end + 1])


def _without_long_rests(
    gaps: FloatArray, moved: NDArray[np.bool_], joints: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return times from 0 and joints; only the first `LONGEST_REST` seconds of each rest are kept."""
    steps, now, still = [(0.0, 0)], 0.0, 0.0
    for i, (gap, moves) in enumerate(zip(gaps, moved, strict=True), start=1):
        allowed = float(gap) if moves else min(float(gap), LONGEST_REST - still)
        still = 0.0 if moves else still + allowed
        if allowed > 0.0:
            now += allowed
            steps.append((now, i))
    return np.array([t for t, _ in steps]), joints[[i for _, i in steps]]


class VirtualBench(GroundTruth):
    """A bench without hardware whose liquid follows the poses that the arm read back.

    Args:
        spec: the ground truth and errors.
        time_scale: bench seconds per second of the clock.
        emulators: the emulators of arm and balance.
        hands: fill the pourer and hold the bench contents.
        simulators: a separate pool for the ground truth.
    """

    def __init__(
        self,
        spec: BenchSettings,
        time_scale: float,
        emulators: DeviceEmulators,
        hands: Hands,
        simulators: SimulatorPool,
    ) -> None:
        super().__init__(time_scale)
        self._spec, self._simulators = spec, simulators
        self.emulators, self.contents, self._hands = emulators, hands.contents, hands
        self._pour: GroundTruthTask | None = None
        self._landed = False
        self._left: bool | None = None  # whether liquid may have left the pourer; None before it is known

    async def prepare(self, pour: GroundTruthTask) -> None:
        """See `GroundTruth.prepare`."""
        self._pour = pour
        self.contents.pourer, self.contents.receiver = "pourer", "receiver"
        self._hands.prepare(pour.scene.liquid.mass, stream(pour.seed, "arm"))
        await self.emulators.prepare(stream(pour.seed, "balance"))
        await self.emulators.put(self.contents.carried)

    async def between(self, vessel: str, place: str, width: float) -> None:
        """See `GroundTruth.between`: the vessel is there only if it was put there."""
        await self.emulators.hold(width if self.contents.stands.get(vessel) == place else None)

    async def lifted(self, vessel: str) -> None:
        """See `GroundTruth.lifted`."""
        self.contents.move(vessel, "", on_balance=False)
        await self.emulators.put(self.contents.carried)

    async def placed(self, vessel: str, place: str, *, on_balance: bool) -> None:
        """See `GroundTruth.placed`."""
        self.contents.move(vessel, place, on_balance=on_balance)
        await self.emulators.hold(None)
        await self.emulators.put(self.contents.carried)

    async def poured_back(self, seed: int) -> None:
        """See `GroundTruth.poured_back`: all but a film arrives."""
        self.contents.pour_back(_film(seed))
        await self.emulators.put(self.contents.carried)

    async def emptied(self, vessel: str, seed: int) -> None:
        """See `GroundTruth.emptied`: all but a film leaves it."""
        self.contents.liquids[vessel] = min(self.contents.liquids.get(vessel, 0.0), _film(seed))

    @contextlib.asynccontextmanager
    async def followed(self) -> AsyncIterator[None]:
        """See `GroundTruth.followed`."""
        self._landed = False
        yield

    async def lands(self, executed: Executed | None, broken: Exception | None) -> None:
        """See `GroundTruth.lands`; simulates the liquid once and puts the resulting mass on the balance.

        Raises:
            LaboratoryError: with the placement errors of this pour the vessels would touch, the liquid could not be
                simulated, or part of the motion is unknown.
        """
        assert self._pour is not None
        if self._landed:
            return
        error = draw_pose_error(self._spec, self._pour.seed)
        motion = self._motion(executed, error.tilt)
        self._landed, self._left = True, motion is not None
        if motion is not None:
            spilled, retained = await self._simulate(self._pour, motion, error)
            self.contents.receive(spilled, retained)
        await self.emulators.put(self.contents.carried)

    def _motion(self, executed: Executed | None, grip_tilt: float) -> SampledMotion | None:
        """The true motion of the pourer; None if nothing left it."""
        if executed is None or not executed.completed or len(executed.times) < 2:
            raise LaboratoryError(
                "the virtual bench can't tell what became of the liquid: its arm only tells of pours that it completed"
            )
        return slipped(SampledMotion(executed.times, executed.poses), grip_tilt)

    async def _simulate(self, pour: GroundTruthTask, motion: SampledMotion, error: PoseError) -> tuple[float, float]:
        """Masses spilled and retained [kg]; the same motion and seed give the same masses."""
        mass = self.contents.in_pourer
        scene = replace(pour.scene, liquid=pour.scene.liquid.model_copy(update={"mass": mass}))
        shift = PoseError(x=error.x, y=error.y, z=error.z)
        task = PourTask(scene, pour.action, SimulationParameters(), 0, pose_error=shift, motion=motion)
        task = replace(task, frame_rate=pour.frame_rate)
        simulated = await true_pour(self._spec, self._simulators, task, pour.seed)
        pour.shown(simulated.frames)
        spill = spill_of(simulated.outcome, mass)
        return spill.spilled, spill.retained


class FollowedBench(VirtualBench):
    """A virtual bench that uses the joint history of the arm's emulator, also after an aborted motion.

    Args:
        spec, emulators, hands, simulators: as for `VirtualBench`.
        arm: the cell as configured, which may differ from the ground truth, with the true geometry of the arm.
        drivers: of arm and balance, whose waits follow the bench's clock.
    """

    def __init__(
        self,
        spec: BenchSettings,
        arm: ArmSettings,
        emulators: DeviceEmulators,
        hands: Hands,
        simulators: SimulatorPool,
        drivers: Sequence[DeviceArm | DeviceBalance],
    ) -> None:
        super().__init__(spec, arm.time_scale, emulators, hands, simulators)
        self._arm, self._paced = arm, (emulators, *drivers)
        self.clock = device_clock(arm.clock)
        self._noting = asyncio.Lock()
        self._times: list[float] = []
        self._joints: list[tuple[float, ...]] = []
        self._since = self._earlier = 0.0
        self._gap = ""
        self._dose: tuple[Scene, DoseSource, int] | None = None  # with the seed
        self._flowing = False
        self._showing: asyncio.Task[None] | None = None

    @contextlib.asynccontextmanager
    async def followed(self) -> AsyncIterator[None]:
        """See `GroundTruth.followed`; reads the arm's history at regular intervals, however long the operator takes."""
        self._times, self._joints, self._landed, self._left, self._gap = [], [], False, None, ""
        self._earlier, self._since = 0.0, (await self.emulators.history(math.inf)).now
        following = asyncio.create_task(self._follow())
        try:
            yield
        finally:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)

    async def _follow(self) -> None:
        while True:
            await asyncio.sleep(NOTING_INTERVAL / self._arm.time_scale)
            with contextlib.suppress(LaboratoryError):  # the history is read once more at the end
                await self.note()

    async def prepare_dose(self, scene: Scene, dose: DoseTarget, seed: int, carried: tuple[str, str] | None) -> None:
        """See `GroundTruth.prepare_dose`."""
        source, contents, self._pour = source_of(scene, dose), self.contents, None
        contents.pourer, contents.receiver = carried or (source.vessel or "pourer", dose.cup or "receiver")
        if carried is None and dose.cup:
            cup_content = contents.liquids.get(dose.cup, dose.held or 0.0)
            contents.in_receiver = 0.0 if dose.held is None else cup_content
        for name, spec, usual in (
            (contents.pourer, scene.pourer, "pourer"),
            (contents.receiver, scene.receiver, "receiver"),
        ):
            mass = None if spec.grip is None else spec.grip.mass
            contents.dry.setdefault(name, contents.dry[usual] if mass is None else mass)
        if self._spec.doses == "particles":
            check_particles(scene, dose.amount, self._spec.theta)
            await self.emulators.ready(self._particles(scene, source.mass, seed))
        volume = vessel(scene.pourer).capacity if self._spec.doses == "particles" else true_cup(scene).capacity
        held = source.mass + source.deviation * float(np.random.default_rng((seed, 51)).standard_normal())
        if carried is None and (source.fill or self.contents.in_pourer <= 0.0):
            self.contents.in_pourer = min(max(held, 1e-3), 0.99 * volume * scene.liquid.density)
        self._dose = scene, source, seed
        self._hands.prepare(source.mass if carried else contents.in_pourer, stream(seed, "arm"))
        await self.emulators.prepare(stream(seed, "balance"))
        await self.emulators.put(self.contents.carried)

    @contextlib.asynccontextmanager
    async def slowed(self) -> AsyncIterator[None]:
        """See `GroundTruth.slowed`."""
        if self._time_scale <= FASTEST_DOSE:
            yield
            return
        try:
            for device in self._paced:
                await device.pace(FASTEST_DOSE)
            yield
        finally:
            for device in self._paced:
                with contextlib.suppress(LaboratoryError):  # a driver that was lost starts with the bench's own clock
                    await device.pace(self._time_scale)

    async def untouched(self) -> bool:
        """See `GroundTruth.untouched`; of a dose, that nothing has left the pourer."""
        with contextlib.suppress(LaboratoryError):
            await self.flowed()
            if self._left is None and self._pour is None:  # a dose that did not come to its tilt
                return True
            if self._left is None:
                await self.note()
                self._left = self._motion(None, 0.0) is not None
            return not self._left
        return False

    async def flows(self, show: Callable[[RecordedFrames], None] | None = None) -> None:
        """See `GroundTruth.flows`."""
        assert self._dose is not None
        scene, source, seed = self._dose
        error, content = draw_pose_error(self._spec, seed), self.contents.in_pourer
        liquid: FormulaLiquid | PourTask
        if self._spec.doses == "particles":
            liquid = self._particles(scene, content, seed)
        else:
            wetness = 0.0 if source.unused else 0.2 if source.fill else 0.7
            filled = scene.liquid.model_copy(update={"mass": content})
            liquid = FormulaLiquid(true_cup(scene), filled, source.constants, seed, wetness)
        on_tray = "tray" in self.contents.on_balance
        watched = show is not None and isinstance(liquid, PourTask)
        await self.emulators.flow(FlowOrder(liquid, self.contents.carried, error.tilt, on_tray, watched))
        self._flowing = True
        if show is not None and watched:
            self._showing = asyncio.create_task(self._show(show))

    def _particles(self, scene: Scene, content: float, seed: int) -> PourTask:
        error = draw_pose_error(self._spec, seed)
        return dose_task(scene, FOLLOWED, content, self._spec.theta, error, liquid_seed(seed))

    async def _show(self, show: Callable[[RecordedFrames], None]) -> None:
        while True:
            await asyncio.sleep(FRAME_INTERVAL)
            with contextlib.suppress(LaboratoryError):
                if (frames := await self.emulators.frames()) is not None:
                    show(frames)

    async def flowed(self) -> dict[str, Any]:
        """See `GroundTruth.flowed`."""
        if not self._flowing:
            return {}
        self._flowing = False
        if self._showing is not None:
            self._showing.cancel()
            await asyncio.gather(self._showing, return_exceptions=True)
        self._left = True  # unless the emulators report otherwise
        end = await self.emulators.flowed()
        self._left = end.received + end.spilled > 0.0
        self.contents.receive(end.spilled, end.left)
        return {"true": end.received, "true_spilled": end.spilled, "upright": end.upright}

    async def note(self) -> None:
        """Read the arm's motion since the last call.

        The controller keeps ten minutes of its time. If a delayed process reads later, part of the motion is lost. The
        gap is recorded, and the masses of the pour are then unknown.
        """
        async with self._noting:
            history = await self.emulators.history(self._since)
            if history.now < self._since:  # the controller was switched off; its clock restarts at 0
                self._gap = self._gap or "the controller was switched off, and forgot what its arm had done before"
                self._earlier += self._since
                self._since = 0.0
                history = await self.emulators.history(0.0)
            if (missed := _missed(history, self._since)) > LONGEST_GAP:
                self._gap = self._gap or f"{missed:.0f} s of its arm's motion are forgotten by the controller"
            self._take(history)

    def _take(self, history: History) -> None:
        last = self._times[-1] if self._times else -math.inf
        for t, q in zip(history.times, history.joints, strict=True):
            if t <= history.now and t + self._earlier > last:
                self._times.append(t + self._earlier)
                self._joints.append(q)
                self._since = t

    async def lands(self, executed: Executed | None, broken: Exception | None) -> None:
        """See `VirtualBench.lands`."""
        if not self._landed:
            await self.note()
        async with standing(self.clock):
            await super().lands(executed, broken)
        self._times, self._joints = [], []

    def _motion(self, executed: Executed | None, grip_tilt: float) -> SampledMotion | None:
        """The true motion of the pourer from the pour's first pose on; None if the pourer never left it."""
        if self._gap:
            raise LaboratoryError(
                f"the virtual bench can't tell what became of the liquid: {self._gap}, because a process of the bench "
                "was stopped or starved meanwhile"
            )
        assert self._pour is not None
        if len(self._times) < 2:
            return None
        start = self._pour.path.pour.joints[0]  # type: ignore[attr-defined]
        cut = executed_pour(np.array(self._times), np.array(self._joints), start)
        if cut is None:
            return None
        times, joints = cut
        kind = arm_kind(self._arm)
        tilted = np.flatnonzero(kind.pourer_motion(joints, times).tilt(times) > UPRIGHT)
        if len(tilted) == 0:
            return None
        end = min(int(tilted[-1]) + 2, len(times))  # the rest is the return path
        return kind.pourer_motion(joints[:end], times[:end], grip_tilt=grip_tilt)


def _missed(history: History, since: float) -> float:
    """Length of the missing motion between the requested time and the first sample of the history [s]."""
    return max((history.times[0] if history.times else history.now) - since, 0.0)
