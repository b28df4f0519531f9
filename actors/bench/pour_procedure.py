"""One pour: the operator's steps, the consent, the arm's motions and the weighings, in order.

Two rules always hold. While a question invites hands into the cell, no program runs on the controller; this is read
back first. The arm moves only after the operator has confirmed the motion and has been informed of the time until it
starts.

`PourProcedure` runs the steps in the frame of `BenchProcedure`, which doses have, too. `CheckpointProgress` reports the
progress to a callback. Questions are in `actors.bench.consent`, weighings in `actors.balance.weighing`.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Mapping
from typing import Any

from actors.arm.arm_device import STUCK
from actors.arm.arm_interface import (
    FULL_SPEED,
    ArmFacts,
    ArmLostError,
    ArmRefusedError,
    ArmState,
    ArmStoppedError,
    Executed,
    PlannedPour,
)
from actors.arm.pour_feasibility import vessel
from actors.balance.balance_interface import BalanceError, NoConnectionError
from actors.balance.weighing import Weighings
from actors.balance.weighing_plan import Placement, Weighing
from actors.bench.consent import Consent, Setup, grams, start_question
from actors.bench.ground_truth import GroundTruthTask
from actors.dosing.dose_estimator import DoseReading
from actors.interfaces import (
    DoseProgress,
    InvalidActionError,
    LaboratoryError,
    LinkLostError,
    Notice,
    NotPouredError,
    PourFailedError,
    PourProgress,
    ProgressCallback,
    UnknownPourError,
)
from actors.runtime.remote_object import DeviceLostError
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement, RecordedFrames
from sim_engine.scene import SampledMotion, Scene


class CheckpointProgress:
    """Progress of a pour as elapsed bench time over expected bench time; it never decreases.

    Args:
        progress: receives the progress; its exceptions are suppressed.
        parts: expected time of each checkpoint, in order [s].
        motion_time: of tilt, hold and return together [s].
    """

    def __init__(self, progress: ProgressCallback | None, parts: Mapping[str, float], motion_time: float) -> None:
        self._progress, self._parts, self._motion_time = progress, dict(parts), motion_time
        self._checkpoint = "operator"
        self._fraction = 0.0
        self._tilt: float | None = None
        self._balance: float | None = None
        self._stable: bool | None = None
        self._joints: tuple[float, ...] = ()
        self._pourer: tuple[float, ...] = ()
        self._dose: DoseProgress | None = None

    def enter(self, checkpoint: str, done: float = 0.0) -> None:
        """Report that a checkpoint is reached, or that the fraction `done` (0 … 1) of it is."""
        self._checkpoint = checkpoint
        before = 0.0
        for name, duration in self._parts.items():
            if name == checkpoint:
                before += done * duration
                break
            before += duration
        self._fraction = max(self._fraction, before / sum(self._parts.values()))
        self._publish()

    def move(self, phase: str, fraction: float, tilt: float | None, *, moving: bool = True) -> None:
        """Report the arm's progress during the pour itself.

        Args:
            phase: 'tilt', 'hold' or 'return'.
            fraction: of the pour's motion, 0 … 1.
            tilt: of the pourer [rad].
            moving: whether the arm is moving; otherwise only the tilt is stored.
        """
        self._tilt = tilt
        if not moving:
            return
        start = sum(duration for name, duration in self._parts.items() if name in ("operator", "tare", "approach"))
        self._checkpoint = phase if phase in self._parts else self._checkpoint
        self._fraction = max(self._fraction, (start + fraction * self._motion_time) / sum(self._parts.values()))
        self._publish()

    def dose(self, tilt: float, joints: tuple[float, ...], dose: DoseProgress) -> None:
        """Report the progress of a dose.

        Args:
            tilt: of the pourer [rad].
            joints: of the arm [rad].
            dose: amounts and flow.
        """
        self._tilt, self._dose, self._joints = tilt, dose, joints or self._joints
        self.enter("dose", min(max(dose.amount / dose.target, 0.0), 1.0))

    def stand(self, joints: tuple[float, ...], pourer: tuple[float, ...]) -> None:
        """Report the arm's joints and the pourer's pose, as far as available; see `PourProgress`."""
        self._joints, self._pourer = joints or self._joints, pourer or self._pourer
        self._publish()

    def show(self, balance: float, stable: bool | None = None) -> None:
        """Report the balance's display [kg] and its stability flag."""
        self._balance, self._stable = balance, stable
        self._publish()

    @property
    def watched(self) -> bool:
        """Whether a progress callback is set."""
        return self._progress is not None

    def pour(self, liquid: RecordedFrames) -> None:
        """Report the frames of the liquid of a virtual bench."""
        self._publish(liquid)

    def _publish(self, liquid: RecordedFrames | None = None) -> None:
        if self._progress is not None:
            state = PourProgress(
                self._checkpoint,
                self._fraction,
                self._tilt,
                self._balance,
                self._stable,
                self._joints,
                self._pourer,
                liquid,
                self._dose,
            )
            with contextlib.suppress(Exception):
                self._progress(state)


class BalanceReadings:
    """Reads the balance, if there is one, and keeps each reading once.

    Args:
        setup: parts of the bench.
        report: receives the display.
        interval: pause between two readings [s of the clock].
        scale: bench seconds per second of the clock, while readings are used.
    """

    def __init__(self, setup: Setup, report: CheckpointProgress, interval: float, scale: float) -> None:
        self._balance, self._report, self._interval, self._scale = setup.balance, report, interval, scale
        self._clock = setup.ground_truth.clock
        self._kept: list[DoseReading] = []
        self._taken = 0
        self.step = 0.0

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Read while the body runs."""
        task = asyncio.create_task(self._read()) if self._balance is not None else None
        try:
            yield
        finally:
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    def fresh(self) -> list[DoseReading]:
        """Readings since the last call."""
        new, self._taken = self._kept[self._taken :], len(self._kept)
        return new

    @property
    def all(self) -> tuple[DoseReading, ...]:
        """All readings so far; their times are those of the devices' clock in bench time."""
        return tuple(self._kept)

    async def _read(self) -> None:
        assert self._balance is not None
        last = -math.inf
        while True:
            with contextlib.suppress(LaboratoryError):
                weight = await self._balance.read()
                if math.isfinite(weight.mass):
                    self._report.show(weight.mass, weight.stable)
                    if weight.status in ("stable", "unstable") and weight.time > last:
                        last, now = weight.time, self._clock.now
                        # the driver's clock is this one, unless it runs on another machine
                        moment = weight.time if 0.0 <= now - weight.time < 1.0 else now
                        self.step = weight.step or self.step
                        self._kept.append(DoseReading(self._scale * moment, weight.mass, weight.stable))
            await asyncio.sleep(self._interval)


class BenchProcedure(ABC):
    """The frame of a pour and of a dose: the first steps, and what is reported after an error.

    Args:
        setup: parts of the bench.
        scene: pourer, receiver and liquid.
        path: checked path of the arm.
        seed: of a virtual bench's randomness.
        report: receives the progress.
        interval: pause between two readings of the balance [s of the clock].
        fastest: largest time scale while its times are recorded.
    """

    name = "pour"

    def __init__(
        self,
        setup: Setup,
        scene: Scene,
        path: PlannedPour,
        seed: int,
        report: CheckpointProgress,
        interval: float,
        fastest: float = math.inf,
    ) -> None:
        self._setup, self._scene, self._path, self._seed, self._report = setup, scene, path, seed, report
        self._consent = Consent(setup, path)
        self._scale = min(setup.spec.time_scale, fastest)
        self._readings = BalanceReadings(setup, report, interval, self._scale)
        self._begun = self._moves = False
        self._executed: Executed | None = None
        self._facts: ArmFacts | None = None
        self._tilts: list[tuple[float, float]] = []

    async def run(self) -> PourMeasurement:
        """Run it, from the first question to the last weight.

        Raises:
            NotPouredError: nothing was poured.
            LinkLostError: likewise, since a virtual bench lost a connection, or its host was too busy.
            UnknownPourError: some liquid may have been poured.
        """
        setup = self._setup
        setup.questions.take_log()
        try:
            return await self._steps()
        except asyncio.CancelledError as error:
            await self._consent.leave_safe()
            if self._begun:
                text = f"the {self.name} was given up after it had begun; {await self._remaining()}"
                setup.tell(Notice("warning", text))
                raise
            raise NotPouredError(f"the {self.name} was given up before it began; nothing was poured") from error
        except (InvalidActionError, PourFailedError):
            await self._consent.leave_safe()
            raise
        except LaboratoryError as error:
            self._begun = self._begun or (self._moves and setup.lost)
            text = f"{error}. {await self._unknown(error) if self._begun else 'Nothing was poured'}"
            untouched = not self._begun or await setup.ground_truth.untouched()
            await self._consent.leave_safe()
            if setup.mode == "virtual" and untouched and is_of_host(error):
                self._withdraw()
                raise LinkLostError(text) from error
            raise (UnknownPourError if self._begun else NotPouredError)(text) from error
        finally:
            await setup.ground_truth.end()

    @abstractmethod
    async def _steps(self) -> PourMeasurement:
        """All steps in order."""

    @abstractmethod
    async def _remaining(self) -> str:
        """What is known of the liquid, as text."""

    @abstractmethod
    def _withdraw(self) -> None:
        """Nothing was poured: remove what the account says since the tilt was about to begin."""

    @abstractmethod
    async def _unknown(self, error: LaboratoryError) -> str:
        """What is known of the liquid after an error, as text."""

    async def _ready(self) -> None:
        """Connect arm, gripper and balance; no program runs."""
        setup = self._setup
        self._report.enter("operator")
        self._facts = await setup.arm.ready()
        await self._consent.make_safe()
        if setup.held is not None:
            await setup.held.ready(vessel(self._scene.pourer))
        if setup.balance is not None:
            await setup.balance.device.revive()
            await setup.balance.resume()

    def _seen(self, state: ArmState) -> None:
        self._report.stand(state.joints, state.pourer)


WEIGHING_TIME = 3.0
"""Typical bench time until a weight is stable, for the progress bar [s]."""

SETTLING_TIME = 2.0
"""From the arm's return home to the first weighing [s of bench time]: the last drops fall."""

LOOK_INTERVAL = 0.1
"""Time between two readings of the balance's display [s of the clock]."""

BEFORE_TILT = 1.0
"""Readings are recorded from so long before the first tilt on [s]."""


def is_of_host(error: BaseException | None) -> bool:
    """Whether an error or its cause is a lost connection or a heartbeat that paused: a virtual bench's host is slow."""
    while error is not None:
        if isinstance(error, ArmLostError | DeviceLostError | NoConnectionError):
            return True
        if isinstance(error, ArmStoppedError) and error.kind == "watchdog":
            return True
        error = error.__cause__
    return False


_BROKEN_OFF = (ArmStoppedError, ArmLostError, DeviceLostError)


class PourProcedure(BenchProcedure):
    """One pour, from the first question to the last weight.

    Args:
        setup: parts of the bench.
        scene, action: what to pour.
        path: checked path of the arm.
        seed: of a virtual bench's randomness.
        known: weighings of this pourer that are still valid.
        progress: receives the progress.
    """

    def __init__(
        self,
        setup: Setup,
        scene: Scene,
        action: Action,
        path: PlannedPour,
        *,
        seed: int,
        known: Mapping[str, Weighing] | None,
        progress: ProgressCallback | None,
    ) -> None:
        report = CheckpointProgress(progress, _expected(setup, path), path.pour_time)
        super().__init__(setup, scene, path, seed, report, LOOK_INTERVAL)
        self._action = action
        self._weighings = Weighings(
            setup.balance_spec, setup.balance, self._consent.ask, known, self._note_weight, nominal=scene.liquid.mass
        )
        self._broken: Exception | None = None

    @property
    def lasting(self) -> dict[str, Weighing]:
        """Weighings that remain valid for later pours with this pourer."""
        return self._weighings.lasting

    async def _steps(self) -> PourMeasurement:
        async with self._readings.running():
            await self._before()
            await self._move()
            return await self._after()

    # ---- steps in order

    async def _before(self) -> None:
        setup = self._setup
        await self._ready()
        show = self._report.pour if self._report.watched else None
        await setup.ground_truth.prepare(GroundTruthTask(self._scene, self._action, self._path, self._seed, show))
        source_masses: dict[str, Weighing] = {}
        if setup.handling is not None:
            source_masses = await setup.handling.prepare(
                self._consent, self._weighings.weighed.get("pourer_empty"), self._seed
            )
        await self._weighings.before(source_masses)

    async def _move(self) -> None:
        """Approach, pour and return home after one consent, unless a stop interrupts the motion."""
        setup, path = self._setup, self._path
        await self._consent.given(start_question(setup.spec, path))
        self._moves = True
        async with self._setup.ground_truth.followed():
            await self._out_and_home()

    async def _out_and_home(self) -> None:
        setup, path = self._setup, self._path
        self._report.enter("approach")
        try:
            await setup.ground_truth.lasting(setup.arm.move_to_start(path, self._seen), path.approach_time)
        except STUCK as error:
            await self._consent.bring_home(error, begun=self._begun)
            raise
        await setup.ground_truth.note()
        await setup.ground_truth.tilts()
        self._report.enter("tilt")
        self._begun = True
        try:
            self._executed = await setup.ground_truth.lasting(setup.arm.execute(path, self._follow), path.pour_time)
        except ArmRefusedError as error:  # before any movement
            self._begun = False
            await self._consent.bring_home(error, begun=self._begun)
            raise
        except _BROKEN_OFF as error:
            self._broken, self._executed = error, getattr(error, "executed", None)
            await self._consent.bring_upright(error)
        else:
            self._report_slowing(self._executed)
        await setup.ground_truth.note()
        try:
            if self._broken is not None:
                await setup.arm.release()  # consented to with the return to upright
            await setup.arm.retreat(path, self._seen)
        except STUCK as error:
            await self._consent.bring_home(error, begun=self._begun)
        await self._let_it_land()

    def _report_slowing(self, executed: Executed) -> None:
        """Warn if the arm's controller slowed the pour: it was another one than planned."""
        speed = executed.tracking.get("slider", 1.0)
        if speed < FULL_SPEED:
            self._setup.tell(
                Notice(
                    "warning",
                    f"the controller slowed the pour to {100.0 * speed:.0f} % of its speed: it took "
                    f"{executed.times[-1]:.1f} s instead of {self._path.pour_time:.1f} s. The motion as executed is "
                    "recorded with the weights; set the speed slider to 100 %",
                )
            )

    async def _after(self) -> PourMeasurement:
        await self._consent.make_safe()
        self._report.enter("settle")
        await self._setup.ground_truth.settle(SETTLING_TIME)
        self._report.enter("weigh")
        await self._weighings.after()
        measured = self._weighings.measurement(self._scene.liquid.mass)
        self._report.enter("record", 1.0)
        if self._setup.handling is not None:
            self._setup.handling.poured(self._weighings.weighed)
        if self._broken is not None:
            raise self._broken
        return PourMeasurement(measured.loaded, measured.spilled, measured.retained, self._notes(measured))

    # ---- the liquid

    async def _let_it_land(self) -> None:
        """The motion is over: let the ground truth pour the liquid and load the balance."""
        await self._setup.ground_truth.lands(self._executed, self._broken)

    async def _weigh_remaining(self) -> None:
        """After an aborted pour, weigh whatever can be weighed without touching anything."""
        with contextlib.suppress(LaboratoryError):
            await self._let_it_land()
            await self._setup.ground_truth.settle(SETTLING_TIME)
            await self._weighings.at_once()

    # ---- records

    def _note_weight(self, key: str, weighed: Weighing) -> None:
        """Write a weight to the journal at once, so that no later failure can lose it."""
        if key == "pourer_full" and self._setup.held is not None:
            self._setup.held.stood(weighed.mass)
        self._setup.tell(Notice("note", f"weighed, {key}: {grams(weighed.mass)} ± {1e3 * weighed.uncertainty:.2f} g"))

    async def _remaining(self) -> str:
        return f"weighed until then: {self._weighed()}"

    def _withdraw(self) -> None:
        pass  # a pour is entered once it is weighed

    async def _unknown(self, error: LaboratoryError) -> str:
        if not isinstance(error, BalanceError):
            await self._weigh_remaining()
        text = "What was poured is unknown"
        with contextlib.suppress(LaboratoryError):
            m = self._weighings.measurement()
            text = (
                f"It was not the pour that was asked for; weighed were {grams(m.loaded)} loaded, "
                f"{grams(m.spilled)} spilled, {grams(m.retained)} retained"
            )
        return f"{text}. All weighings: {self._weighed()}"

    def _weighed(self) -> str:
        return ", ".join(f"{key} {grams(w.mass)}" for key, w in self._weighings.weighed.items()) or "nothing"

    def _notes(self, measured: PourMeasurement) -> dict[str, Any]:
        executed = self._executed
        assert executed is not None
        return {
            "mode": self._setup.mode,
            **measured.notes,
            "arm": _arm_identity(self._facts),
            "executed_s": float(executed.times[-1]),
            "largest_tilt_deg": largest_tilt(executed),
            "executed": executed.record(),
            **({} if self._setup.handling is None else {"cycle": self._setup.handling.cycle}),
            **self._signals(),
            "operator": self._setup.questions.take_log(),
        }

    def _signals(self) -> dict[str, Any]:
        """Tilts and readings during the pour, on one clock that starts with the first tilt.

        There are none without a balance below the receiver, and on a virtual bench: its balance is loaded afterwards.
        """
        below = self._setup.balance_spec.position in (Placement.RECEIVER, Placement.EVERYTHING)
        if self._setup.mode != "hardware" or not below or min(len(self._tilts), len(self._readings.all)) < 2:
            return {}
        begin = self._tilts[0][0]
        during = [(r.time - begin, r.mass) for r in self._readings.all if r.time >= begin - BEFORE_TILT]
        signals = {
            "times": [round(t - begin, 3) for t, _ in self._tilts],
            "tilt_deg": [round(math.degrees(tilt), 2) for _, tilt in self._tilts],
            "read_at": [round(t, 3) for t, _ in during],
            "readings_g": [round(1e3 * mass, 3) for _, mass in during],
        }
        return {"signals": signals}

    # ---- progress

    def _follow(self, state: ArmState) -> None:
        if state.tilt is not None and state.moving:
            self._tilts.append((self._setup.ground_truth.clock.now, state.tilt))
        self._report.move(state.phase, state.fraction, state.tilt, moving=state.moving)
        self._seen(state)


def _expected(setup: Setup, path: PlannedPour) -> dict[str, float]:
    """Expected time of each checkpoint [s of bench time]."""
    return {
        "operator": setup.operator_time + 4.0 * WEIGHING_TIME,
        "approach": setup.spec.warning_time + path.approach_time,
        **{name: end - start for name, start, end in path.phases},
        "settle": path.retreat_time + SETTLING_TIME,
        "weigh": WEIGHING_TIME,
        "record": 2.0 * WEIGHING_TIME,
    }


def largest_tilt(executed: Executed) -> float:
    """Largest tilt as read back [deg]."""
    if len(executed.times) < 2:
        return 0.0
    return math.degrees(float(SampledMotion(executed.times, executed.poses).tilt(executed.times).max()))


def _arm_identity(facts: ArmFacts | None) -> dict[str, Any]:
    """Identification of the robot for the record: model, serial number, version, checksums."""
    if facts is None:
        return {}
    values = {name: getattr(facts, name) for name in ("model", "serial", "version", "checksum", "calibration")}
    return {name: text for name, text in values.items() if text}
