"""One pour over wires: the operator's steps, consent, the arm's ways, the weighings, and the way back from a stop.

Two rules hold throughout. While somebody is asked to put hands into the cell, no program runs on the controller, which
is read back first. And nothing moves unless somebody has just said that it may, and been told how long they have.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from actors.arm.joint_path import ExecutedPath, PourPath
from actors.arm.path.frames import pourer_motion
from actors.arm.protocol import ArmState
from actors.arm.spec import UrArmSpec
from actors.arm.ur.errors import ArmError, ArmLostError, ArmRefusedError, ArmStoppedError
from actors.arm.ur.facts import ArmFacts
from actors.balance.actor import DeviceBalance
from actors.balance.errors import BalanceError
from actors.balance.placement import Weighed
from actors.balance.spec import BalanceSpec
from actors.balance.weighing import Weighings
from actors.bench.executed import pack
from actors.bench.progress import PourReport
from actors.bench.questions import Questions
from actors.bench.reality import PourAsk, Reality
from actors.bench.wired_arm import WiredArm
from actors.bench.wired_words import (
    grams,
    start_question,
    stopped_question,
    unsafe_question,
    upright_question,
    way_home_question,
)
from actors.device import DeviceLostError
from actors.operator import Question
from actors.protocols import (
    BenchLostError,
    InvalidActionError,
    LaboratoryError,
    Notice,
    NotPouredError,
    ProgressCallback,
    UnknownPourError,
)
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement
from sim_engine.task import Scene

WEIGHING_TIME = 3.0
"""Bench time that a weight usually takes, for the progress bar [s]."""

SETTLING_TIME = 2.0
"""From the arm's return home to the first weighing [s of bench time]: the last drops fall."""

_BROKEN_OFF = (ArmStoppedError, ArmLostError, DeviceLostError)
_STUCK = (ArmError, DeviceLostError)


class RefusedError(LaboratoryError):
    """The operator said no."""


@dataclass(frozen=True)
class Rooms:
    """What all pours on a bench share; see `wired.WiredBench`."""

    mode: str
    spec: UrArmSpec
    balance_spec: BalanceSpec
    operator_time: float
    arm: WiredArm
    balance: DeviceBalance | None
    questions: Questions
    reality: Reality | None
    tell: Callable[[Notice], None]


class WiredPour:
    """One pour, from the first question to the last weight.

    Args:
        rooms: of the bench.
        scene, action: what to pour.
        path: checked.
        seed: of a virtual bench's chance.
        known: weighings of this pourer that still hold.
        progress: told where it stands.
    """

    def __init__(
        self,
        rooms: Rooms,
        scene: Scene,
        action: Action,
        path: PourPath,
        *,
        seed: int,
        known: Mapping[str, Weighed] | None,
        progress: ProgressCallback | None,
    ) -> None:
        self._rooms, self._scene, self._action, self._path, self._seed = rooms, scene, action, path, seed
        self._weighings = Weighings(
            rooms.balance_spec, rooms.balance, self._ask, known, self._note_weight, nominal=scene.liquid.mass
        )
        self._report = PourReport(progress, _expected(rooms, path), path.pour.duration)
        self._begun = False
        self._broken: Exception | None = None
        self._executed: ExecutedPath | None = None
        self._facts: ArmFacts | None = None

    @property
    def lasting(self) -> dict[str, Weighed]:
        """Weighings that hold for later pours with this pourer."""
        return self._weighings.lasting

    async def run(self) -> PourMeasurement:
        """All of it.

        Raises:
            NotPouredError: nothing was poured.
            UnknownPourError: something may have been.
        """
        self._rooms.questions.take_log()
        watching = asyncio.create_task(self._watch())
        try:
            await self._before()
            await self._move()
            return await self._after()
        except asyncio.CancelledError as error:
            await self._leave_safe()
            if self._begun:
                raise
            raise NotPouredError("the pour was given up before it began; nothing was poured") from error
        except InvalidActionError:
            raise
        except LaboratoryError as error:
            if self._begun and not isinstance(error, BalanceError):
                await self._keep_what_shows()
            await self._leave_safe()
            raise self._said(error) from error
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    # ---- in order

    async def _before(self) -> None:
        rooms = self._rooms
        self._report.enter("operator")
        self._facts = await rooms.arm.ready()
        await self._make_safe()
        if rooms.reality is not None:
            await rooms.reality.prepare(PourAsk(self._scene, self._action, self._path, self._seed))
        if rooms.balance is not None:
            await rooms.balance.device.revive()
            await rooms.balance.resume()
        await self._weighings.before()

    async def _move(self) -> None:
        """Out, pour, home: all of it after one consent, unless something stops it."""
        rooms, path = self._rooms, self._path
        await self._consent(start_question(rooms.spec, path))
        async with self._followed():
            await self._out_and_home()

    async def _out_and_home(self) -> None:
        rooms, path = self._rooms, self._path
        self._report.enter("approach")
        try:
            await rooms.arm.move_to_start(path)
        except _STUCK as error:
            await self._bring_home(error)
            raise
        await self._note()
        self._report.enter("tilt")
        self._begun = True
        try:
            self._executed = await rooms.arm.execute(path, self._follow)
        except ArmRefusedError as error:  # before anything moved
            self._begun = False
            await self._bring_home(error)
            raise
        except _BROKEN_OFF as error:
            self._broken, self._executed = error, getattr(error, "executed", None)
            await self._bring_upright(error)
        await self._note()
        try:
            if self._broken is not None:
                await rooms.arm.release()  # agreed to with the un-tilting
            await rooms.arm.retreat(path)
        except _STUCK as error:
            await self._bring_home(error)
        await self._let_it_land()

    async def _after(self) -> PourMeasurement:
        await self._make_safe()
        self._report.enter("settle")
        await self._pass(SETTLING_TIME)
        self._report.enter("weigh")
        await self._weighings.after()
        measured = self._weighings.measurement(self._scene.liquid.mass)
        self._report.enter("record", 1.0)
        if self._broken is not None:
            raise self._broken
        return PourMeasurement(measured.loaded, measured.spilled, measured.retained, self._notes(measured))

    # ---- the operator

    async def _ask(self, question: Question) -> str:
        """Put a question; one that invites hands into the cell only while nothing can move."""
        if question.hands:
            await self._make_safe()
        return await self._rooms.questions.ask(question)

    async def _make_safe(self) -> None:
        """See that nothing moves and nothing can; where that can't be seen, nobody is invited into the cell.

        Raises:
            RefusedError: it can't, and the operator leaves it at that.
        """
        problem = ""
        while True:
            try:
                if problem:
                    await self._rooms.arm.ready()
                await self._rooms.arm.hands_in()
                return
            except BenchLostError:
                raise
            except _STUCK as error:
                if not problem:
                    problem = str(error)  # the connection may be made anew without anybody's help
                    continue
                problem = str(error)
            if not await self._agreed(unsafe_question(problem)):
                raise RefusedError(f"it can't be seen that the arm keeps still: {problem}")

    async def _agreed(self, question: Question) -> bool:
        return (await self._ask(question)).strip().lower() in ("yes", "y")

    async def _consent(self, question: Question) -> None:
        """Have somebody say that the arm may move, announce it, and release it.

        Raises:
            RefusedError: they said no.
        """
        if not await self._agreed(question):
            raise RefusedError("the operator did not let the arm move")
        await self._rooms.questions.say(f"The arm moves in {self._rooms.spec.announcement:g} s. Keep out of its way.")
        # The driver waits for as long from the release to the first movement.
        await self._rooms.arm.release()

    # ---- the way back from a stop

    async def _bring_upright(self, error: Exception) -> None:
        """After a stop with the pourer tilted: nothing moves before somebody has looked at it and said so, twice."""
        while True:
            await self._recover(error)
            await self._consent(upright_question(self._rooms.spec))
            try:
                await self._rooms.arm.untilt(self._path)
                return
            except _STUCK as again:
                error = again

    async def _bring_home(self, error: Exception) -> None:
        """After a stop on the way to the pour or from it."""
        while True:
            await self._recover(error)
            await self._consent(way_home_question(self._rooms.spec))
            try:
                await self._rooms.arm.retreat(self._path)
                return
            except _STUCK as again:
                error = again

    async def _recover(self, error: Exception) -> None:
        """Make the robot ready again, once somebody has seen to the cause; nothing moves yet.

        Raises:
            RefusedError: they would rather leave it as it is.
        """
        if isinstance(error, BenchLostError):
            raise error  # nobody can mend it from here
        problem = str(error)
        while await self._agreed(stopped_question(error, problem, begun=self._begun)):
            try:
                done = await self._rooms.arm.recover()
            except BenchLostError:
                raise
            except _STUCK as again:
                problem = str(again)
                continue
            self._rooms.tell(Notice("info", f"the arm is ready again: {done or 'nothing had to be done'}"))
            return
        raise RefusedError(f"{error}; the operator leaves the arm as it stands")

    async def _leave_safe(self) -> None:
        """Stop what moves, whatever has failed: also when this task itself is being cancelled."""
        rooms = self._rooms

        async def stop() -> None:
            with contextlib.suppress(LaboratoryError):
                await rooms.arm.stop()
            if rooms.balance is not None:
                with contextlib.suppress(LaboratoryError):
                    await rooms.balance.interrupt()

        stopping = asyncio.ensure_future(stop())
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.shield(stopping)

    # ---- the liquid

    @contextlib.asynccontextmanager
    async def _followed(self) -> AsyncIterator[None]:
        """On a virtual bench, take down what the arm does for as long as this, however long anybody needs."""
        reality = self._rooms.reality
        if reality is None:
            yield
            return
        await reality.begin()
        following = asyncio.create_task(reality.follow())
        try:
            yield
        finally:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)

    async def _note(self) -> None:
        """What the virtual bench's arm did so far."""
        if self._rooms.reality is not None:
            await self._rooms.reality.note()

    async def _let_it_land(self) -> None:
        """What was executed is over: the virtual bench's liquid does what it does, and lies on the balance."""
        if self._rooms.reality is not None:
            await self._rooms.reality.note()
            await self._rooms.reality.settle()

    async def _keep_what_shows(self) -> None:
        """Of a pour that was broken off, whatever can be weighed without touching anything."""
        with contextlib.suppress(LaboratoryError):
            await self._let_it_land()
            await self._pass(SETTLING_TIME)
            await self._weighings.at_once()

    # ---- what is kept

    def _note_weight(self, key: str, weighed: Weighed) -> None:
        """Into the journal at once: no weight is lost, whatever happens next."""
        self._rooms.tell(Notice("note", f"weighed, {key}: {grams(weighed.mass)} ± {1e3 * weighed.uncertainty:.2f} g"))

    def _said(self, error: Exception) -> LaboratoryError:
        """The error for those above, with what is known of the liquid."""
        if not self._begun:
            return NotPouredError(f"{error}. Nothing was poured")
        text = f"{error}. What was poured is unknown"
        weighed = ", ".join(f"{key} {grams(w.mass)}" for key, w in self._weighings.weighed.items())
        with contextlib.suppress(LaboratoryError):
            m = self._weighings.measurement()
            text = (
                f"{error}. It was not the pour that was asked for; weighed were {grams(m.loaded)} loaded, "
                f"{grams(m.spilled)} spilled, {grams(m.retained)} retained"
            )
        return UnknownPourError(f"{text}. All weighings: {weighed or 'none'}")

    def _notes(self, measured: PourMeasurement) -> dict[str, Any]:
        executed = self._executed
        assert executed is not None
        return {
            "mode": self._rooms.mode,
            **measured.notes,
            "arm": _who(self._facts),
            "executed_s": float(executed.times[-1]),
            "largest_tilt_deg": math.degrees(self._largest_tilt(executed)),
            "executed": pack(executed),
            "operator": self._rooms.questions.take_log(),
        }

    def _largest_tilt(self, executed: ExecutedPath) -> float:
        """As read back [rad]."""
        if len(executed.times) < 2:
            return 0.0
        return float(pourer_motion(executed.joints, executed.times, self._rooms.spec).tilt(executed.times).max())

    # ---- time and screens

    async def _pass(self, seconds: float) -> None:
        """Bench time [s]."""
        await asyncio.sleep(seconds / self._rooms.spec.time_scale)

    def _follow(self, state: ArmState) -> None:
        self._report.move(state.phase, state.fraction, state.tilt, moving=state.moving)

    async def _watch(self) -> None:
        """Give the balance's display to those who watch; it can't hold the pour up."""
        balance = self._rooms.balance
        if balance is None:
            return
        while True:
            with contextlib.suppress(LaboratoryError):
                weight = await balance.read()
                if math.isfinite(weight.mass):
                    self._report.show(weight.mass)
            await asyncio.sleep(0.2)


def _expected(rooms: Rooms, path: PourPath) -> dict[str, float]:
    """Time of each checkpoint [s of bench time]."""
    return {
        "operator": rooms.operator_time + 4.0 * WEIGHING_TIME,
        "approach": rooms.spec.announcement + path.approach.duration,
        **{name: end - start for name, start, end in path.phases},
        "settle": path.retreat.duration + SETTLING_TIME,
        "weigh": WEIGHING_TIME,
        "record": 2.0 * WEIGHING_TIME,
    }


def _who(facts: ArmFacts | None) -> dict[str, Any]:
    """Of the robot, what a later reader will ask for."""
    if facts is None:
        return {}
    return {name: getattr(facts, name) for name in ("model", "serial", "version", "checksum")}
