"""Who may let the arm move, and the way back from a stop: nothing moves unless somebody has just said that it may."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from actors.arm.actor import DeviceArm
from actors.arm.errors import ArmError
from actors.arm.protocol import PlannedPour
from actors.arm.spec import ArmSpec
from actors.balance.actor import DeviceBalance
from actors.balance.spec import BalanceSpec
from actors.bench.questions import Questions
from actors.bench.virtual_bench import Nature
from actors.bench.words import stopped_question, unsafe_question, upright_question, way_home_question
from actors.device import DeviceLostError
from actors.operator import Question
from actors.protocols import BenchLostError, LaboratoryError, Notice

STUCK = (ArmError, DeviceLostError)
"""What leaves an arm where a person has to see to it."""


class RefusedError(LaboratoryError):
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
    questions: Questions
    nature: Nature
    tell: Callable[[Notice], None]


class Consent:
    """Asks people, and moves the arm only as far as they have agreed to.

    Args:
        setup: of the bench.
        path: of the pour.
    """

    def __init__(self, setup: Setup, path: PlannedPour) -> None:
        self._setup, self._path = setup, path

    async def ask(self, question: Question) -> str:
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
                raise RefusedError(f"it can't be seen that the arm keeps still: {problem}")

    async def _agreed(self, question: Question) -> bool:
        return (await self.ask(question)).strip().lower() in ("yes", "y")

    async def given(self, question: Question) -> None:
        """Have somebody say that the arm may move, announce it, and release it.

        Raises:
            RefusedError: they said no.
        """
        if not await self._agreed(question):
            raise RefusedError("the operator did not let the arm move")
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
        raise RefusedError(f"{error}; the operator leaves the arm as it stands")

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
