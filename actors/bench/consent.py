"""Who may let the arm move, and the way back from a stop: nothing moves unless somebody has just said that it may.

What a person beside the arm is asked before it moves, and after it has stopped. Words only.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

from actors.arm.arm_device import DeviceArm
from actors.arm.arm_interface import ArmError, PlannedPour
from actors.arm.arm_settings import ArmSpec
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSpec
from actors.bench.operator_questions import OperatorQuestions
from actors.bench.virtual_bench import GroundTruth
from actors.interfaces import BenchLostError, LaboratoryError, Notice, OperatorQuestion
from actors.runtime.remote_object import DeviceLostError


def grams(mass: float) -> str:
    """'12.34 g'."""
    return f"{1e3 * mass:.2f} g"


def start_question(spec: ArmSpec, path: PlannedPour) -> OperatorQuestion:
    """Whether a whole pour may begin."""
    report = path.report
    return OperatorQuestion(
        f"Hands out of the cell. The arm will pour: {report.duration:.1f} s, tilting the pourer to "
        f"{math.degrees(report.tilt):.0f}° at up to {math.degrees(report.tilt_speed):.0f}°/s, no point of it faster "
        f"than {1e3 * report.tool_speed:.0f} mm/s. It moves {spec.announcement:g} s after you say so. May it?",
        "yes or no",
        about="start",
        hands=False,
        details={
            "duration_s": report.duration,
            "tilt_deg": math.degrees(report.tilt),
            "tilt_speed_deg_s": math.degrees(report.tilt_speed),
            "tool_speed_mm_s": 1e3 * report.tool_speed,
            "clearance_mm": 1e3 * report.clearance,
        },
    )


def stopped_question(error: Exception, problem: str, *, begun: bool) -> OperatorQuestion:
    """Whether the cause of a stop was seen to.

    Args:
        error: that told of the stop.
        problem: why it is asked, or asked again.
        begun: whether anything may have been poured.
    """
    details: dict[str, float | str] = {}
    tilt, phase = getattr(error, "tilt", None), getattr(error, "phase", None)
    if phase is not None:
        details["phase"] = phase
    if tilt is not None:
        details["tilt_deg"] = math.degrees(tilt)
    stands = f" The pourer stands at {math.degrees(tilt):.0f}°." if tilt is not None else ""
    poured = "" if begun else " Nothing was poured."
    return OperatorQuestion(
        f"The arm was stopped, and holds still.{stands}{poured} Find out why, and mend it. Shall the robot be made "
        "ready again? It doesn't move yet; 'no' leaves everything as it is.",
        "yes or no",
        problem,
        about="recover",
        hands=False,
        details=details,
    )


def unsafe_question(problem: str) -> OperatorQuestion:
    """Whether to look again if the arm keeps still."""
    return OperatorQuestion(
        "Keep hands out of the cell, or press the emergency stop first: it can't be seen that the arm keeps still. "
        "Mend that. Shall it be looked at again?",
        "yes or no",
        problem,
        about="unsafe",
        hands=False,
    )


def upright_question(spec: ArmSpec) -> OperatorQuestion:
    """Whether a stopped arm may bring the pourer upright."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will bring the pourer upright at {math.degrees(spec.untilt_speed):.0f}°/s, "
        f"wait, and go home. It moves {spec.announcement:g} s after you say so. May it?",
        "yes or no",
        about="untilt",
        hands=False,
    )


def way_home_question(spec: ArmSpec) -> OperatorQuestion:
    """Whether a stopped arm may go home."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will go home, the pourer upright. It moves {spec.announcement:g} s after you "
        "say so. May it?",
        "yes or no",
        about="home",
        hands=False,
    )


STUCK = (ArmError, DeviceLostError)
"""What leaves an arm where a person has to see to it."""


class ConsentRefusedError(LaboratoryError):
    """The operator said no."""


@dataclass(frozen=True)
class Setup:
    """What all pours on a bench share; see `pouring_bench.PouringBench`."""

    mode: str
    spec: ArmSpec
    balance_spec: BalanceSpec
    operator_time: float
    arm: DeviceArm
    balance: DeviceBalance | None
    questions: OperatorQuestions
    nature: GroundTruth
    tell: Callable[[Notice], None]


class Consent:
    """Asks people, and moves the arm only as far as they have agreed to.

    Args:
        setup: of the bench.
        path: of the pour.
    """

    def __init__(self, setup: Setup, path: PlannedPour) -> None:
        self._setup, self._path = setup, path

    async def ask(self, question: OperatorQuestion) -> str:
        """Put a question; one that invites hands into the cell only while nothing can move."""
        if question.hands:
            await self.make_safe()
        return await self._setup.questions.ask(question)

    async def make_safe(self) -> None:
        """See that nothing moves and nothing can; where that can't be seen, nobody is invited into the cell.

        Raises:
            RefusedError: it can't, and the operator leaves it at that.
        """
        problem = ""
        while True:
            try:
                if problem:
                    await self._setup.arm.ready()
                await self._setup.arm.hands_in()
                return
            except BenchLostError:
                raise
            except STUCK as error:
                if not problem:
                    problem = str(error)  # the connection may be made anew without anybody's help
                    continue
                problem = str(error)
            if not await self._agreed(unsafe_question(problem)):
                raise ConsentRefusedError(f"it can't be seen that the arm keeps still: {problem}")

    async def _agreed(self, question: OperatorQuestion) -> bool:
        return (await self.ask(question)).strip().lower() in ("yes", "y")

    async def given(self, question: OperatorQuestion) -> None:
        """Have somebody say that the arm may move, announce it, and release it.

        Raises:
            RefusedError: they said no.
        """
        if not await self._agreed(question):
            raise ConsentRefusedError("the operator did not let the arm move")
        spec = self._setup.spec
        text = f"The arm moves in {spec.announcement:g} s. Keep out of its way."
        # The driver waits for as long from the release to the first movement.
        await self._setup.questions.announce(text, spec.on_clock(spec.announcement))
        await self._setup.arm.release()

    # ---- the way back from a stop

    async def bring_upright(self, error: Exception) -> None:
        """After a stop with the pourer tilted: nothing moves before somebody has looked at it and said so, twice."""
        while True:
            await self._recover(error, begun=True)
            await self.given(upright_question(self._setup.spec))
            try:
                await self._setup.arm.untilt(self._path)
                return
            except STUCK as again:
                error = again

    async def bring_home(self, error: Exception, *, begun: bool) -> None:
        """After a stop on the way to the pour, or from it once the pour has begun."""
        while True:
            await self._recover(error, begun=begun)
            await self.given(way_home_question(self._setup.spec))
            try:
                await self._setup.arm.retreat(self._path)
                return
            except STUCK as again:
                error = again

    async def _recover(self, error: Exception, *, begun: bool) -> None:
        """Make the robot ready again, once somebody has seen to the cause; nothing moves yet.

        Raises:
            RefusedError: they would rather leave it as it is.
        """
        if isinstance(error, BenchLostError):
            raise error  # nobody can mend it from here
        problem = str(error)
        while await self._agreed(stopped_question(error, problem, begun=begun)):
            try:
                done = await self._setup.arm.recover()
            except BenchLostError:
                raise
            except STUCK as again:
                problem = str(again)
                continue
            self._setup.tell(Notice("info", f"the arm is ready again: {done or 'nothing had to be done'}"))
            return
        raise ConsentRefusedError(f"{error}; the operator leaves the arm as it stands")

    async def leave_safe(self) -> None:
        """Stop what moves, whatever has failed: also when this task itself is being cancelled."""
        setup = self._setup

        async def stop() -> None:
            with contextlib.suppress(LaboratoryError):
                await setup.arm.stop()
            if setup.balance is not None:
                with contextlib.suppress(LaboratoryError):
                    await setup.balance.interrupt()

        stopping = asyncio.ensure_future(stop())
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.shield(stopping)
