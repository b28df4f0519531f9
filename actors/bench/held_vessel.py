"""The pourer in a gripper: handed over by the operator, checked, and watched while the arm moves.

- `HeldVessel` closes and opens the gripper in agreement with the operator, and checks each grasp: the width of the
  fingers against that of the vessel, the detected object, and the balance that the vessel stood on.
- `HoldingArm` is an arm that moves only with a held vessel, and stops as soon as the vessel may have been lost.

A vessel that may have been lost is UNKNOWN: the arm stands still, and the operator is asked. The drivers are in
`actors.grippers`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from typing import Any, TypeVar

from actors.arm.arm_device import DeviceArm, Follow, _ignore
from actors.arm.arm_interface import ArmRefusedError, ArmStoppedError, Executed, PlannedPour
from actors.arm.arm_settings import ArmSettings
from actors.arm.planned_pour import PlaceWay
from actors.arm.planning.kinematics import transform_of
from actors.balance.weighing_plan import GRIP
from actors.grippers.gripper_interface import (
    SMALLEST_GAP,
    GripLimits,
    GripperError,
    GripperSettings,
    GripperState,
    VesselLostError,
)
from actors.interfaces import LaboratoryError, Notice, OperatorQuestion
from actors.runtime.remote_object import Device
from sim_engine.vessel.vessel import Vessel

T = TypeVar("T")

CALL_TIMEOUT = 60.0
"""Longest wait for a call of the gripper [s]; its process may still be starting."""

LOOK = 0.2
"""Time between two readings of the gripper while the arm moves [s of the clock]."""

BLIND = 2
"""Number of readings in a row without an answer after which the vessel may have been lost."""

BELOW = 0.8
"""Width to which the fingers close, as a fraction of the vessel's: an object stops them well before."""

TAKES = ("pourer_empty", "pourer_full", "pourer_after", "dose_source", "dose_exchanged")
"""Questions whose step needs the pourer, which the gripper holds."""

GIVES = ("set_up", "receiver_empty", "tray_before", "dose_source", "dose_exchanged", "dose_cleared")
"""Questions after whose step the gripper holds the pourer; their instructions contain `GRIP` or need none."""

Ask = Callable[[OperatorQuestion], Awaitable[str]]


def grip_height(spec: GripperSettings, arm: ArmSettings) -> float:
    """Height above a pourer's underside at which the fingers grip it [m].

    It is that of the tool centre point in the pourer's frame, unless the gripper's settings state it.
    """
    if spec.height is not None:
        return spec.height
    grip = getattr(arm, "grip", None)
    if grip is None:
        raise LaboratoryError("the arm does not state where it holds the pourer; add 'height' to the gripper")
    return float(transform_of(grip).inverse.position[2])


def grip_limits(vessel: Vessel, spec: GripperSettings, arm: ArmSettings) -> GripLimits:
    """Widths of the fingers that are a grasp of a vessel.

    Raises:
        LaboratoryError: the vessel cannot be gripped by this gripper, at this height; the text states why.
    """
    name, height = vessel.name, grip_height(spec, arm)
    if not 0.0 <= height <= vessel.rim_height:
        raise LaboratoryError(
            f"the fingers are {1e3 * height:.0f} mm above the underside of '{name}', which is "
            f"{1e3 * vessel.rim_height:.0f} mm high: see 'grip' of the arm, or 'height' of the gripper"
        )
    limits = vessel.spec.grip
    width = vessel.width_at(height) if limits is None or limits.width is None else limits.width
    if width + SMALLEST_GAP > spec.widest:
        raise LaboratoryError(
            f"'{name}' is {1e3 * width:.1f} mm wide where it is gripped, {1e3 * height:.0f} mm above its underside; "
            f"the gripper opens to {1e3 * spec.widest:.1f} mm"
        )
    return GripLimits(name, width, (2e-3 if limits is None else limits.tolerance) + spec.accuracy)


class HeldVessel:
    """The gripper of a bench, and the pourer in it.

    Args:
        device: holds the driver.
        spec: settings of the gripper.
        arm: settings of the arm.
        tell: receives notices.
        weight: reads the balance that the pourer stood on [kg], if nothing else comes to stand on it; None otherwise.

    Attributes:
        spec: settings of the gripper.
        holds: the grasp of the vessel was checked, and it was not lost or let go since.
        lost: why the vessel may have been lost; '' if it was not.
        role: the vessel in messages, such as 'the pourer'.
    """

    def __init__(
        self,
        device: Device,
        spec: GripperSettings,
        arm: ArmSettings,
        tell: Callable[[Notice], None],
        weight: Callable[[], Awaitable[float]] | None = None,
    ) -> None:
        self._device, self.spec, self._arm, self._tell, self._weight = device, spec, arm, tell, weight
        self._limits: GripLimits | None = None
        self._stood = 0.0
        self._blind = 0
        self.holds, self.lost, self.role = False, "", "the pourer"

    # ---- the driver

    async def _call(self, method: str, *args: Any, urgent: bool = False) -> Any:
        return await self._device.call(method, *args, deadline=CALL_TIMEOUT, urgent=urgent)

    async def state(self) -> GripperState:
        """The gripper's state."""
        state: GripperState = await self._call("state", urgent=True)
        return state

    async def ready(self, vessel: Vessel) -> None:
        """Connect the gripper before a pour with a vessel. Nothing moves.

        Raises:
            GripperError: it does not answer.
            LaboratoryError: it cannot grip this vessel.
        """
        self._limits = grip_limits(vessel, self.spec, self._arm)
        await self._device.revive()
        await self._call("connect")
        state = await self.state()
        self.holds, self.lost = self.holds or (not self.lost and state.detected is True), ""

    def stood(self, mass: float) -> None:
        """The full pourer stood on the balance, with this weight [kg]."""
        self._stood = mass

    async def close(self) -> None:
        """Disconnect; a held vessel stays held."""
        with contextlib.suppress(LaboratoryError):
            await self._call("close")

    # ---- with the operator

    async def around(self, question: OperatorQuestion, ask: Ask) -> str:
        """Ask a question of a pour, and grip or let go of the pourer before or after it.

        Args:
            question: as the weighings ask it.
            ask: asks the operator, after nothing can move.

        Raises:
            LaboratoryError: the gripper does not answer, or the operator gave up.
        """
        if question.about in TAKES and self.holds:
            await self.let_go(ask)
        answer = await ask(replace(question, text=question.text.replace(GRIP, "")))
        if not self.holds and question.about in GIVES:
            await self._take(ask)
        return answer

    # ---- at a place, without hands

    async def open_at(self, vessel: Vessel) -> None:
        """Open the fingers around a vessel that stands between them, or let go of it. It stays where it is.

        Raises:
            GripperError: they do not open.
        """
        limits = grip_limits(vessel, self.spec, self._arm)
        self.holds = False
        await self._call("open", min(limits.width + self.spec.clearance, self.spec.widest))

    async def grip_at(self, vessel: Vessel, role: str) -> None:
        """Close the open fingers on a vessel that stands between them, and check the grasp.

        Raises:
            GripperError: it is no grasp of this vessel, or the gripper cannot tell.
        """
        limits = grip_limits(vessel, self.spec, self._arm)
        state: GripperState = await self._call("grip", BELOW * limits.width, self.spec.applied)
        problem = limits.problem(state)
        if not problem and state.detected is None:
            problem = "the gripper cannot tell whether it holds something"
        if problem:
            raise GripperError(problem)
        self._limits, self.role = limits, role
        self.holds, self.lost, self._blind = True, "", 0

    async def _take(self, ask: Ask) -> None:
        """Close the gripper on the pourer that the operator holds, until the grasp is checked."""
        limits, problem = self._limits, ""
        assert limits is not None
        while True:
            try:
                await self.activated(ask)
                opened = min(limits.width + self.spec.clearance, self.spec.widest)
                await self._agreed(
                    ask,
                    "open_gripper",
                    f"Hands off the gripper. Its fingers open to {1e3 * opened:.0f} mm. May they?",
                    problem,
                )
                await self._call("open", opened)
                await self._agreed(
                    ask,
                    "grasp",
                    f"Hold '{limits.vessel}' upright between the open fingers, your own fingers away from them. The "
                    f"gripper closes with {self.spec.applied:.0f} N at once when you say so. May it?",
                    width_mm=1e3 * limits.width,
                )
                state: GripperState = await self._call("grip", BELOW * limits.width, self.spec.applied)
                problem = limits.problem(state) or await self._still_standing()
                if not problem and state.detected is None:
                    problem = await self._unconfirmed(ask)
            except GripperError as error:
                problem = str(error)
            if not problem:
                break
        self.holds, self.lost, self._blind, self.role = True, "", 0, "the pourer"
        self._tell(Notice("note", f"'{limits.vessel}' is in the gripper: {state}"))

    async def activated(self, ask: Ask) -> None:
        """Make a gripper ready that is not, after a question."""
        if not (await self.state()).problem:
            return
        await self._agreed(
            ask,
            "activate_gripper",
            "The gripper is not ready. To get ready, its fingers may open and close fully: nothing may be between "
            "them, and no hand. May they?",
        )
        await self._call("prepare")

    async def _still_standing(self) -> str:
        """Whether the balance still carries the pourer; the problem if it does."""
        if self._weight is None or self._stood <= 0.0:
            return ""
        mass = await self._weight()
        if mass > 0.5 * self._stood:
            return f"the balance shows {1e3 * mass:.1f} g: does the pourer still stand on it?"
        return ""

    async def _unconfirmed(self, ask: Ask) -> str:
        """Ask the operator whether the vessel is held, for a gripper that cannot tell."""
        question = OperatorQuestion(
            "The gripper cannot tell whether it holds the pourer. Does it, upright and firmly?",
            "yes or no",
            about="held",
        )
        return "" if _yes(await ask(question)) else "the operator says that the pourer is not held"

    async def let_go(self, ask: Ask) -> None:
        """Open the gripper while the operator holds the pourer."""
        limits = self._limits
        assert limits is not None
        await self._agreed(
            ask,
            "let_go",
            f"Hold '{limits.vessel}' in the gripper. Its fingers open at once when you say so. May they?",
        )
        await self._call("open", min(limits.width + self.spec.clearance, self.spec.widest))
        self.holds = False

    async def _agreed(self, ask: Ask, about: str, text: str, problem: str = "", **details: float) -> None:
        """Ask for a motion of the fingers.

        Raises:
            LaboratoryError: the operator refused.
        """
        if not _yes(await ask(OperatorQuestion(text, "yes or no", problem, about=about, details=details))):
            raise LaboratoryError("the operator did not let the gripper move")

    # ---- while the arm moves

    async def loss(self, *, sure: bool = True) -> str:
        """Why the vessel may have been lost since it was gripped; '' if it is held.

        Args:
            sure: repeat a reading that fails; otherwise only several in a row count.
        """
        if not self.holds or self._limits is None:
            return self.lost
        fault = ""
        while True:
            try:
                state = await self.state()
            except LaboratoryError as error:  # a driver that died counts, too
                self._blind += 1
                fault = str(error) if self._blind >= BLIND else ""
                if not fault and sure:
                    continue
            else:
                self._blind, fault = 0, self._limits.problem(state)
            break
        if fault:
            self.lost, self.holds = fault, False
        return self.lost


class HoldingArm(DeviceArm):
    """An arm with a gripper: each motion needs a held vessel before it, during it and after it.

    After a loss, motions that the operator agrees to are made without: they bring the arm home.

    Args:
        device: that holds the arm's driver.
        spec: of the arm.
        held: the vessel in the gripper.
    """

    def __init__(self, device: Device, spec: ArmSettings, held: HeldVessel) -> None:
        super().__init__(device, spec)
        self._held = held

    async def move_to_start(self, path: PlannedPour, follow: Follow = _ignore) -> None:
        """See `DeviceArm.move_to_start`."""
        if not self._held.holds:
            raise ArmRefusedError("the gripper holds no pourer, as far as it is known; nothing has moved")
        await self._holding(super().move_to_start(path, follow))

    async def execute(self, path: PlannedPour, follow: Follow) -> Executed:
        """See `DeviceArm.execute`."""
        return await self._holding(super().execute(path, follow))

    async def dose(self, path: PlannedPour, longest: float) -> Executed:
        """See `DeviceArm.dose`."""
        return await self._holding(super().dose(path, longest))

    async def carry(self, way: PlaceWay, *, loaded: bool) -> None:
        """See `DeviceArm.carry`: with a vessel in the gripper, it is watched."""
        if loaded and not self._held.holds:
            raise ArmRefusedError("the gripper holds no vessel, as far as it is known; nothing has moved")
        motion = super().carry(way, loaded=loaded)
        await (self._holding(motion) if loaded else motion)

    async def retreat(self, path: PlannedPour | PlaceWay, follow: Follow = _ignore) -> None:
        """See `DeviceArm.retreat`."""
        await self._holding(super().retreat(path, follow))

    async def _holding(self, motion: Coroutine[Any, Any, T]) -> T:
        """Make a motion while the vessel is held.

        Raises:
            VesselLostError: it may have been lost; the arm stands still.
        """
        if self._held.lost:
            return await motion
        if loss := await self._held.loss():
            motion.close()
            raise await self._lost(loss, None)
        moving = asyncio.ensure_future(motion)
        try:
            while not (await asyncio.wait({moving}, timeout=LOOK))[0]:
                if loss := await self._held.loss(sure=False):
                    # The first order lets a dose turn the cup upright, the second one stops the arm where it is.
                    await asyncio.gather(self.stop(), self.stop(), return_exceptions=True)
                    executed: Executed | None = None
                    try:
                        executed = await moving  # type: ignore[assignment]
                    except ArmStoppedError as error:
                        executed = error.executed
                    raise await self._lost(loss, executed)
        finally:
            if not moving.done():
                moving.cancel()
        result = await moving
        if loss := await self._held.loss():
            raise await self._lost(loss, result if hasattr(result, "poses") else None)  # type: ignore[arg-type]
        return result

    async def _lost(self, loss: str, executed: Executed | None) -> VesselLostError:
        role = self._held.role
        text = f"the gripper may have lost {role}: {loss}. The arm was stopped. Look for {role} and the liquid"
        state = await self.state()
        return VesselLostError(text, "vessel lost", state.phase, state.time, state.tilt, executed)


def _yes(answer: str) -> bool:
    return answer.strip().lower() in ("yes", "y")
