"""One dose on a bench with an arm and a balance under the receiver: steps, consent, control loop, and what was weighed.

The controller (`actors.dosing.dose_controller`) decides the tilt about twenty times a second. The arm's program limits
it to the largest tilt of the last command, and turns the cup back by itself without commands for 0.2 s at most: when
this process is killed, pauses, or loses the connection.

1. Fill the source, if requested.
2. Put the empty receiver on the balance. Its readings show the lag of the balance.
3. Consent, approach, dose, way home.
4. Report the amount in the receiver: weighed, or UNKNOWN.

In a laboratory with places the arm carries the vessels in place of the operator (`actors.bench.dose_handling`).

The rules of `actors.bench.pour_procedure` hold here, too. The content of the source is not weighed.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from typing import Any

import numpy as np

from actors.arm.arm_device import STUCK
from actors.arm.arm_interface import NEWS_TIMEOUT, ArmState, PlannedPour
from actors.balance.balance_interface import BalanceError
from actors.balance.weighing_plan import GRIP, Placement
from actors.bench.consent import Setup, grams, start_question
from actors.bench.dose_handling import DoseHandling
from actors.bench.ground_truth import FASTEST_DOSE
from actors.bench.pour_procedure import BenchProcedure, CheckpointProgress, largest_tilt
from actors.dosing.dose_controller import DoseController, DoseOrder, DoseResult, check_display
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import (
    DoseSeries,
    after_dose,
    check_dose,
    lost_by,
    series_of,
    source_of,
    unknown_amount,
)
from actors.dosing_settings import DosingSettings
from actors.interfaces import (
    DoseTarget,
    InvalidActionError,
    LaboratoryError,
    Notice,
    OperatorQuestion,
    ProgressCallback,
    UnknownPourError,
)
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene

TICK = 0.05
"""Time between two decisions [s]."""

LATEST_COMMAND = 0.08
"""Time from one command to the next one [s of the clock], for which the clock of a virtual bench waits."""

LOOK_INTERVAL = 0.01
"""Pause between two readings of the balance [s of the clock]."""

BEFORE_PLACING, AFTER_PLACING = 0.5, 2.0
"""Readings are recorded for so long before and after the receiver is put on the balance [s]."""

READINGS_PLACED, LONGEST_INTERVAL = 4, 5.0
"""Readings that have to come after it was put on; longest time for each of them [s]."""

LIGHTEST_RECEIVER = 5e-3
"""Smallest rise of the reading that counts as a receiver [kg]."""

SOON = 4.0
"""Time within which the process that simulates a liquid starts if its kernels are in the cache [s]."""

CLOSING_TIME = 60.0
"""Time of a dose beyond its limit, for settling, top-ups and the return [s]."""

SIGNALS = 400
"""Largest number of samples of a dose's signals in its record."""


class DoseProcedure(BenchProcedure):
    """One dose, from the first question to the weighed amount.

    Args:
        setup: parts of the bench.
        scene: pourer, receiver and liquid.
        dose: wanted amount, with its source.
        path: checked path of the arm, whose first phase is the range of the tilt.
        seed: of the controller, and of a virtual bench's randomness.
        settings: of the dose.
        progress: receives the progress.

    Raises:
        InvalidActionError: the dose can't be made here.
    """

    name = "dose"

    def __init__(
        self,
        setup: Setup,
        scene: Scene,
        dose: DoseTarget,
        path: PlannedPour,
        *,
        seed: int,
        settings: DosingSettings,
        progress: ProgressCallback | None,
    ) -> None:
        check_bench(setup)
        check_dose(scene, dose)
        self._dose, self._settings = dose, settings
        parts = {
            "operator": setup.operator_time,
            "approach": setup.spec.warning_time + path.approach_time,
            "dose": 10.0,
            "record": path.retreat_time,
        }
        super().__init__(
            setup, scene, path, seed, CheckpointProgress(progress, parts, 10.0), LOOK_INTERVAL, FASTEST_DOSE
        )
        self._series: DoseSeries | None = None
        self._placed: tuple[DoseReading, ...] = ()
        self._zero = self._at = self._duration = 0.0
        self._entered = False  # in the account, as a dose that has begun

    # ---- steps in order

    async def _steps(self) -> PourMeasurement:
        setup = self._setup
        assert setup.balance is not None
        await self._ready()
        await setup.balance.connect()
        names = None if setup.doses is None else setup.doses.names(self._scene, self._dose)
        if setup.doses is None:
            await self._refill()
        await self._prepare_liquid(names)
        carried: dict[str, Any] = {}
        async with self._readings.running():
            if setup.doses is not None:
                await self._carry(setup.doses)
            else:
                async with setup.ground_truth.slowed():
                    await self._prepare()
            await self._consent.given(start_question(setup.spec, self._path))
            self._moves = True
            async with setup.ground_truth.followed():
                result, truth = await self._out_and_home()
            if result.amount is None:
                raise UnknownPourError(unknown_amount(result))
            if setup.doses is not None:
                carried = await self._finish(setup.doses, (result.amount, result.deviation), lost_by(result))
        self._report.enter("record", 1.0)
        return self._measurement(result, {**carried, **truth})

    async def _prepare_liquid(self, names: tuple[str, str] | None) -> None:
        """Let a virtual bench prepare what it pours, and tell if that takes long: the arm does not move meanwhile."""
        setup = self._setup
        preparing = asyncio.create_task(
            setup.ground_truth.prepare_dose(self._scene, self._dose, self._seed, names), name="liquid"
        )
        try:
            if (await asyncio.wait({preparing}, timeout=SOON))[1]:
                text = "preparing the simulation of the liquid; it is compiled the first time, which takes minutes"
                setup.tell(Notice("info", text))
            await preparing
        finally:
            preparing.cancel()

    async def _finish(
        self, handling: DoseHandling, amount: tuple[float, float], lost: tuple[float, float]
    ) -> dict[str, Any]:
        """Have the vessels put back. The dose is weighed: what goes wrong now does not make it unknown."""
        try:
            return (await handling.finish(self._consent, self._scene, self._dose, amount, lost)).record
        except LaboratoryError as error:
            handling.forget()
            if self._setup.night is not None:
                self._setup.night.end(str(error))
            text = (
                f"the dose is weighed, and its vessels are not put back: {error}. They are laid out before the next one"
            )
            self._setup.tell(Notice("warning", text))
            await self._consent.leave_safe()
            return {}

    async def _refill(self) -> None:
        """Let the refill device fill the source, if there is one and the content is known."""
        source = source_of(self._scene, self._dose)
        if self._setup.supply is None or not source.fill:
            return
        await self._setup.supply.connect()
        filled = await self._setup.supply.filled(source, self._scene.liquid.density, self._seed)
        if filled is not None:
            self._dose = replace(self._dose, source=filled)

    async def _prepare(self) -> None:
        """Fill the source, put the receiver on, and measure the lag of the balance."""
        source, dose = source_of(self._scene, self._dose), self._dose
        if source.fill:
            await self._consent.ask(
                OperatorQuestion(
                    f"Fill '{source.name}' with {1e3 * source.mass:.0f} g of {self._scene.liquid.name}, weighed. "
                    f"{GRIP}Take everything off the balance.",
                    wants="done",
                    about="dose_source",
                )
            )
        elif dose.cup:  # the dose before may have been poured from another source
            await self._consent.ask(
                OperatorQuestion(
                    f"Take '{source.name}', which holds {1e3 * source.mass:.0f} g of {self._scene.liquid.name}. "
                    f"{GRIP}Take everything off the balance, and wipe its pan.",
                    wants="done",
                    about="dose_exchanged",
                )
            )
        else:
            await self._consent.ask(
                OperatorQuestion(
                    "Take everything off the balance, and wipe its pan.", wants="done", about="dose_cleared"
                )
            )
        place = f" {dose.position}" if dose.position else ""
        receiver = f"the receiver{place}, emptied and dry," if dose.emptied else f"the empty receiver{place}"
        if dose.held is not None:
            receiver = f"the receiver{place}, which holds {1e3 * dose.held:.0f} g,"
        problem = ""
        while True:
            await self._readings_for(BEFORE_PLACING, 1)
            before = self._readings.all[-3:]
            await self._consent.ask(
                OperatorQuestion(
                    f"Put {receiver} on the balance in one movement, and let go; nothing else may touch its pan.",
                    "done",
                    problem,
                    about="dose_receiver",
                )
            )
            await self._readings_for(AFTER_PLACING, READINGS_PLACED)
            after = self._readings.all[-3:]
            if not before or not after:
                raise BalanceError("the balance sends no weight; look at its cable and its display")
            rise = after[-1].mass - before[-1].mass
            if rise >= LIGHTEST_RECEIVER:
                break
            problem = (
                f"the balance shows {grams(rise)} more than before; a receiver weighs at least "
                f"{grams(LIGHTEST_RECEIVER)}"
            )
        begin = before[0].time - 1.0
        self._placed = tuple(reading for reading in self._readings.all if reading.time >= begin)
        self._begin_series(after[-1].mass)

    async def _carry(self, handling: DoseHandling) -> None:
        """Have the arm put the cup on the balance and take the source; the placing shows the lag of the balance."""
        self._dose = await handling.prepare(self._consent, self._scene, self._dose, self._seed)
        tare = await handling.set_up(self._consent, self._scene, self._dose, lambda: self._readings.all)
        self._placed = handling.placed
        self._begin_series(tare.mass)

    def _begin_series(self, zero: float) -> None:
        """Make the controller's belief from the readings of the placing."""
        dose, begin = self._dose, self._placed[0].time if self._placed else 0.0
        placed = tuple(DoseReading(reading.time - begin, reading.mass, reading.stable) for reading in self._placed)
        rng = np.random.default_rng((self._seed, 41))
        step = self._readings.step or 1e-4
        self._series = series_of(self._scene, dose, self._settings, placed, rng, step=step)
        check_display(self._series.belief.display, dose.limit, self._settings)
        self._zero = zero

    async def _readings_for(self, seconds: float, count: int) -> None:
        """Wait for a time, and longer until so many readings have come; a balance that sends none ends the wait.

        The clock of a virtual bench may be slower than that of the wall; the balance settles by the bench's.
        """
        begin, least = len(self._readings.all), self._now() + seconds
        await self._sleep(seconds)
        while (now := self._now()) < least + LONGEST_INTERVAL * count:
            if now >= least and len(self._readings.all) >= begin + count:
                break
            await self._sleep(TICK)

    async def _out_and_home(self) -> tuple[DoseResult, dict[str, Any]]:
        """Returns the result of the controller, and the true masses of a virtual bench."""
        setup, path = self._setup, self._path
        self._report.enter("approach")
        try:
            await setup.arm.move_to_start(path, self._seen)
        except STUCK as error:
            await self._consent.bring_home(error, begun=self._begun)
            raise
        await setup.ground_truth.flows(self._report.pour if self._report.watched else None)
        if setup.doses is not None:
            setup.doses.begins(self._scene, self._dose)
            self._entered = True
        self._begun = True
        self._report.enter("dose")
        try:
            async with setup.ground_truth.slowed():
                result = await self._controlled()
        except STUCK as error:
            await self._upright(error)
            await self._home()
            raise
        try:
            truth = await setup.ground_truth.flowed()
        except LaboratoryError:  # a virtual bench has lost its liquid; the arm and the cup are well
            await self._home()
            raise
        await self._home()
        return result, truth

    async def _upright(self, error: Exception) -> None:
        """After a stop: the cup may have turned back by itself; if it has not, the operator consents to its return."""
        if getattr(error, "kind", "") == "operator" and abs(getattr(error, "tilt", 1.0)) < math.radians(1.0):
            await self._consent.given(start_question(self._setup.spec, self._path))
            return
        await self._consent.bring_upright(error)
        await self._setup.arm.release()

    async def _home(self) -> None:
        try:
            await self._setup.arm.retreat(self._path, self._seen)
        except STUCK as error:
            await self._consent.bring_home(error, begun=self._begun)

    async def _controlled(self) -> DoseResult:
        """The control loop: ends when the controller has a result, or the motion has been stopped."""
        assert self._series is not None
        arm, dose, clock = self._setup.arm, self._dose, self._setup.ground_truth.clock
        order = DoseOrder(dose.amount, dose.limit, receiver_mass=self._zero)
        controller = self._series.controller(order, seed=self._seed)
        longest = self._settings.time_limit + CLOSING_TIME
        motion = asyncio.create_task(arm.dose(self._path, longest))
        try:
            while (await arm.state()).phase != "dose":  # the program is uploaded first
                if motion.done():
                    await motion
                await asyncio.sleep(0.01)
            self._readings.fresh()
            begin = self._at = self._now()
            state = await arm.drive(0.0, 0.0, NEWS_TIMEOUT)
            upright = state.tilt or 0.0
            while controller.result is None and not motion.done():
                now = self._now()
                tilt = (state.tilt or 0.0) - upright
                self._tilts.append((now - begin, tilt))
                command = controller.step(now, tilt, self._readings.fresh())
                state = await arm.drive(command.speed, upright + command.highest, command.patience)
                clock.promise("dose", LATEST_COMMAND)
                self._show(controller, state, tilt)
                await self._sleep(max(now + TICK - self._now(), 0.0))
                if self._now() - now > 1.5 * TICK:  # this process paused, and the arm moved on
                    state = await arm.state()
            while not motion.done():  # without commands the cup turns back, and the program ends
                state = await arm.state()
                self._tilts.append((self._now() - begin, (state.tilt or 0.0) - upright))
                clock.promise("dose", LATEST_COMMAND)
                await self._sleep(TICK)
            clock.withdraw("dose")
            self._executed = await motion
        finally:
            clock.withdraw("dose")
            if not motion.done():
                with contextlib.suppress(Exception):
                    async with asyncio.timeout(1.0):
                        await motion
        self._duration = self._now() - begin
        self._tilts.append((self._duration, 0.0))
        if controller.result is None:
            raise LaboratoryError("the dose's program ended on the controller before the dose was over")
        self._series.finish(controller.result)
        return controller.result

    def _now(self) -> float:
        """The clock in bench time [s], as it passes in a dose."""
        return self._scale * self._setup.ground_truth.clock.now

    async def _sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds / self._scale)

    # ---- results

    async def _remaining(self) -> str:
        """What is in the receiver after an aborted dose, as text."""
        assert self._setup.balance is not None
        with contextlib.suppress(LaboratoryError):
            await self._setup.ground_truth.flowed()
            await self._setup.balance.resume()
            weight = await self._setup.balance.weigh()
            return f"the balance shows {grams(weight.mass - self._zero)} in the receiver"
        return "the amount in the receiver is UNKNOWN"

    def _withdraw(self) -> None:
        if self._entered and self._setup.doses is not None:
            self._setup.doses.withdraw(self._scene, self._dose)

    async def _unknown(self, error: LaboratoryError) -> str:
        return f"It was not the dose that was asked for: {await self._remaining()}"

    def _measurement(self, result: DoseResult, truth: dict[str, Any]) -> PourMeasurement:
        assert self._series is not None
        assert result.amount is not None
        source = source_of(self._scene, self._dose)
        during = [r for r in self._readings.all if r.time >= self._at]
        tilts = self._tilts[:: max(len(self._tilts) // SIGNALS, 1)]
        about = {
            **after_dose(self._series, result),
            "wanted": self._dose.amount,
            "spilled": None,  # nothing outside the receiver is weighed
            "duration": self._duration,
            "times": [round(t, 3) for t, _ in tilts],
            "tilt_deg": [round(math.degrees(tilt), 2) for _, tilt in tilts],
            "read_at": [round(r.time - self._at, 3) for r in during],
            "readings_g": [round(1e3 * (r.mass - self._zero), 3) for r in during],
            "placed_at": [round(r.time - self._at, 3) for r in self._placed],
            "placed_g": [round(1e3 * (r.mass - self._zero), 3) for r in self._placed],
            "step_g": 1e3 * self._readings.step,
            **truth,
        }
        notes: dict[str, Any] = {"mode": self._setup.mode, "dose": about, "operator": self._setup.questions.take_log()}
        if self._executed is not None and len(self._executed.times) > 1:
            notes["largest_tilt_deg"] = largest_tilt(self._executed)
            notes["executed"] = self._executed.record()
        # neither the source nor the spilled liquid was weighed
        retained = max(source.mass - result.amount, 0.0)
        return PourMeasurement(source.mass, max(source.mass - retained - result.amount, 0.0), retained, notes)

    # ---- progress

    def _show(self, controller: DoseController, state: ArmState, tilt: float) -> None:
        last = self._readings.all[-1:]
        reading = last[0].mass - self._zero if last else None
        self._report.dose(tilt, state.joints, controller.progress(reading))


def check_bench(setup: Setup) -> None:
    """Check that a bench can pour wanted amounts.

    Raises:
        InvalidActionError: the balance is not under the receiver, or is not connected.
    """
    if setup.balance is None or setup.balance_spec.position not in (Placement.RECEIVER, Placement.EVERYTHING):
        raise InvalidActionError(
            f"wanted amounts need a connected balance under the receiver ('placement: receiver'), and this one has "
            f"'placement: {setup.balance_spec.placement}'"
        )
