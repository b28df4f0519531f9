"""The operator's consent: the arm moves only after the operator has confirmed it.

`Consent` requests permission before each motion, makes the bench safe before hands enter the cell, and leads the
recovery after a stop. The functions `..._question` build the questions. `Setup` holds what all pours on a bench share.
The order of a pour's steps is in `actors.bench.pour_procedure`.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

from actors.arm.arm_device import STUCK, DeviceArm
from actors.arm.arm_interface import PlannedPour
from actors.arm.arm_settings import ArmSettings
from actors.arm.planned_pour import PlaceWay
from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import BalanceSettings
from actors.bench.bench_operators import OperatorQuestions
from actors.bench.dose_handling import DoseHandling
from actors.bench.ground_truth import GroundTruth
from actors.bench.held_vessel import HeldVessel
from actors.bench.liquid_supply import LiquidSupply, SpillWatch
from actors.bench.night_consent import MOTIONS, NightConsent
from actors.bench.vessel_handling import VesselHandling
from actors.grippers.gripper_interface import VesselLostError
from actors.interfaces import BenchLostError, LaboratoryError, Notice, OperatorQuestion


def grams(mass: float) -> str:
    """Format a mass [kg] as '12.34 g'."""
    return f"{1e3 * mass:.2f} g"


def start_question(spec: ArmSettings, path: PlannedPour) -> OperatorQuestion:
    """Ask whether the whole pour may begin."""
    report = path.report
    return OperatorQuestion(
        f"Hands out of the cell. The arm will pour: {report.duration:.1f} s, tilting the pourer to "
        f"{math.degrees(report.tilt):.0f}° at up to {math.degrees(report.tilt_speed):.0f}°/s, no point of it faster "
        f"than {1e3 * report.tool_speed:.0f} mm/s. It moves {spec.warning_time:g} s after you say so. May it?",
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
    """Ask whether the cause of a stop has been fixed.

    Args:
        error: the error that reported the stop.
        problem: reason of the question, or of its repetition.
        begun: whether liquid may have been poured.
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
        f"The arm was stopped, and holds still.{stands}{poured} Find out why, and fix it. Shall the robot be made "
        "ready again? It doesn't move yet; 'no' leaves everything as it is.",
        "yes or no",
        problem,
        about="recover",
        hands=False,
        details=details,
    )


def unsafe_question(problem: str) -> OperatorQuestion:
    """Ask whether to check again that the arm stands still."""
    return OperatorQuestion(
        "Keep hands out of the cell, or press the emergency stop first: it can't be seen that the arm keeps still. "
        "Mend that. Shall it be looked at again?",
        "yes or no",
        problem,
        about="unsafe",
        hands=False,
    )


def upright_question(spec: ArmSettings) -> OperatorQuestion:
    """Ask whether a stopped arm may bring the pourer upright."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will bring the pourer upright at {math.degrees(spec.upright_speed):.0f}°/s, "
        f"wait, and go home. It moves {spec.warning_time:g} s after you say so. May it?",
        "yes or no",
        about="untilt",
        hands=False,
    )


def way_home_question(spec: ArmSettings) -> OperatorQuestion:
    """Ask whether a stopped arm may go home."""
    return OperatorQuestion(
        f"Hands out of the cell. The arm will go home, the pourer upright. It moves {spec.warning_time:g} s after you "
        "say so. May it?",
        "yes or no",
        about="home",
        hands=False,
    )


@dataclass(frozen=True)
class Setup:
    """The parts of a bench that all its pours share; see `actors.bench.bench_factory.PouringBench`."""

    mode: str
    spec: ArmSettings
    balance_spec: BalanceSettings
    operator_time: float
    arm: DeviceArm
    balance: DeviceBalance | None
    questions: OperatorQuestions
    ground_truth: GroundTruth
    tell: Callable[[Notice], None]
    supply: LiquidSupply | None = None
    watch: SpillWatch | None = None
    held: HeldVessel | None = None
    handling: VesselHandling | None = None
    doses: DoseHandling | None = None
    night: NightConsent | None = None

    @property
    def lost(self) -> bool:
        """Whether a gripper may have lost the pourer in this pour: then the liquid is unknown, too."""
        return self.held is not None and bool(self.held.lost)


class Consent:
    """Asks the operator, and moves the arm only as far as the operator has agreed.

    Args:
        setup: parts of the bench.
        path: planned path of the pour.
    """

    def __init__(self, setup: Setup, path: PlannedPour) -> None:
        self._setup, self._path = setup, path

    async def ask(self, question: OperatorQuestion) -> str:
        """Ask a question. If it invites hands into the cell, make sure first that nothing can move.

        With a gripper, the pourer is gripped or let go before or after questions that need it.
        """
        if self._setup.handling is not None:
            return await self._setup.handling.around(question, self)
        held = self._setup.held
        return await (self.asked(question) if held is None else held.around(question, self.asked))

    async def asked(self, question: OperatorQuestion) -> str:
        """Ask the operator, after nothing can move if the question invites hands into the cell.

        A consent for a night answers questions for a motion; it is asked for before the first of them.
        """
        night = self._setup.night
        if night is not None and not night.asked and question.about in MOTIONS:
            night.answered(await self._setup.questions.ask(night.question()))
        if night is not None and night.agrees(question):
            return "yes"
        if question.hands:
            await self.make_safe()
        return await self._setup.questions.ask(question)

    async def make_safe(self) -> None:
        """Make sure that nothing moves and nothing can move. The operator is invited into the cell only after that.

        Raises:
            LaboratoryError: this cannot be verified, and the operator ends the attempts.
        """
        problem = ""
        lost: Exception | None = None
        while True:
            try:
                if problem:
                    await self._setup.arm.ready()
                await self._setup.arm.hands_in()
                return
            except BenchLostError:
                raise
            except STUCK as error:
                lost = error
                if not problem:
                    problem = str(error)  # the connection may recover without the operator
                    continue
                problem = str(error)
            if not await self._agreed(unsafe_question(problem)):
                raise LaboratoryError(f"it can't be seen that the arm keeps still: {problem}") from lost

    async def _agreed(self, question: OperatorQuestion) -> bool:
        return (await self.ask(question)).strip().lower() in ("yes", "y")

    async def given(self, question: OperatorQuestion) -> None:
        """Ask for consent to a motion, announce the motion, and release the arm.

        With a consent for a night, a person has been warned once, when the consent was given.

        Raises:
            LaboratoryError: the operator refused.
        """
        night = self._setup.night
        alone = night is not None and night.in_force
        if not await self._agreed(question):
            raise LaboratoryError("the operator did not let the arm move")
        if alone and night is not None and night.in_force:
            await self._setup.arm.release(warned=True)
            return
        spec = self._setup.spec
        text = f"The arm moves in {spec.warning_time:g} s. Keep out of its way."
        # The driver waits for the same time between the release and the first movement.
        await self._setup.questions.announce(text, spec.on_clock(spec.warning_time))
        await self._setup.arm.release()

    # ---- recovery after a stop

    async def bring_upright(self, error: Exception, path: PlannedPour | None = None) -> None:
        """Bring the pourer upright after a stop in which it was tilted. Two confirmations precede the motion.

        Args:
            error: reported the stop.
            path: that was being poured; that of the pour unless given.
        """
        while True:
            await self._recover(error, begun=True)
            await self.given(upright_question(self._setup.spec))
            try:
                await self._setup.arm.untilt(path or self._path)
                return
            except STUCK as again:
                error = again

    async def bring_home(self, error: Exception, *, begun: bool, path: PlannedPour | PlaceWay | None = None) -> None:
        """Bring the arm home after a stop on the way to the pour, or on the way back from it.

        Args:
            error: reported the stop.
            begun: whether liquid may have been poured.
            path: way between places on which it stands; that of the pour unless given.

        Raises:
            VesselLostError: as given, once the arm is home: the pour is not what it was planned to be.
        """
        first = error
        while True:
            await self._recover(error, begun=begun)
            await self.given(way_home_question(self._setup.spec))
            try:
                await self._setup.arm.retreat(path or self._path)
            except STUCK as again:
                error = again
                continue
            if isinstance(first, VesselLostError):
                raise first
            return

    async def _recover(self, error: Exception, *, begun: bool) -> None:
        """Make the robot ready again after the operator has fixed the cause; nothing moves yet.

        Raises:
            LaboratoryError: the operator leaves the arm as it is.
        """
        if isinstance(error, BenchLostError):
            raise error  # cannot be recovered from here
        problem = str(error)
        begun = begun or self._setup.lost
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
        raise LaboratoryError(f"{error}; the operator leaves the arm as it stands") from error

    async def leave_safe(self) -> None:
        """Stop arm and balance after any failure, also while this task is being cancelled."""
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
