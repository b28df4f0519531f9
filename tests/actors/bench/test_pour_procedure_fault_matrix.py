"""`pour_procedure`: every fault in every phase of a pour: what the arm does, what is recorded, what the operator is
told.

In all of them: nothing moves after a fault until somebody has consented, the pourer is never tilted again, and no
weight is lost. Faults are real ones, of the controller's process, of the driver's worker, and of the balance's line.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import psutil
import pytest

from actors.arm.arm_settings import arm_kind
from actors.arm.planning.kinematics import pourer_motion
from actors.bench.bench_operators import VirtualOperator
from actors.interfaces import LaboratoryError, NotPouredError, OperatorSettings, UnknownPourError
from sim_engine.action import DEG
from sim_engine.outcome import PourMeasurement
from tests.support.waiting import PATIENCE
from tests.support.wired_bench import ACTION, SCENE, Stage, wired_spec

PACE = 15.0
"""Bench seconds per second."""

SPEC = wired_spec(pace=PACE, hurried=True)

SLOWLY = ACTION.with_values(angular_velocity=18 * DEG, return_velocity=18 * DEG, hold_time=5.0)
"""Phases must last long enough to be hit."""

PHASES = ("approach", "tilt", "hold", "return", "weigh")
POURING = PHASES[1:4]

STANDING = 2.0
"""After which an arm that was told to stop must stand [s of the clock]: half a second of missing heartbeats, the rest
for a busy machine."""


LOOK = 0.05
"""Between two looks at the phase [s of the clock], which waits for a busy machine: a fault strikes in its phase."""


@dataclass
class Fault:
    """Something that goes wrong, and how it is put right.

    Attributes:
        strike: does it.
        mend: what the person does who is asked about it; None if nothing needs to be done.
    """

    strike: Callable[[Stage], Awaitable[Any]]
    mend: Callable[[Stage], Awaitable[Any]] | None = None


def controller(name: str, **arguments: Any) -> Callable[[Stage], Awaitable[Any]]:
    return lambda stage: stage.site.fault(name, **arguments)


def balance(what: str, **values: Any) -> Callable[[Stage], Awaitable[Any]]:
    return lambda stage: stage.site.order(what, **values)


async def kill_worker(stage: Stage) -> None:
    workers = [p for p in psutil.Process().children() if "actors.arm.ur.rtde_worker" in p.cmdline()]
    assert len(workers) == 1
    os.kill(workers[0].pid, signal.SIGKILL)


ARM: dict[str, Fault] = {
    "protective stop": Fault(controller("protective_stop")),
    "emergency stop": Fault(controller("emergency_stop"), controller("release_emergency_stop")),
    "safeguard": Fault(controller("safeguard"), controller("safeguard", active=False)),
    "drop": Fault(controller("drop")),
    "stall": Fault(controller("stall"), controller("clear")),
    "refuse": Fault(controller("refuse"), controller("clear")),
    "reboot": Fault(controller("reboot", seconds=1.0)),
    "worker killed": Fault(kill_worker),
    "slider at 0": Fault(controller("slider", fraction=0.0), controller("slider", fraction=1.0)),
}

BALANCE: dict[str, Fault] = {
    "unplugged": Fault(balance("unplug"), balance("plug")),
    "silent": Fault(balance("faults", silent=True), balance("faults", silent=False)),
    "garbage": Fault(balance("faults", garbage=1.0), balance("faults", garbage=0.0)),
}

QUICK = {
    ("protective stop", "tilt"),
    ("unplugged", "weigh"),
}
"""Tried by default: the commonest of each device. The rest takes minutes."""


def cases(faults: dict[str, Fault]) -> list[Any]:
    return [
        pytest.param(fault, phase, id=f"{fault}-{phase}", marks=() if (fault, phase) in QUICK else pytest.mark.slow)
        for fault in faults
        for phase in PHASES
    ]


@dataclass
class Tale:
    """What came of a pour with a fault in it.

    Attributes:
        outcome: the measurement, or the error.
        struck, consented: controller times of the fault and of the first consent after it [s].
        times, joints: of the controller from the fault on.
    """

    stage: Stage
    outcome: PourMeasurement | LaboratoryError
    struck: float
    consented: float
    times: np.ndarray
    joints: np.ndarray

    @property
    def tilts(self) -> np.ndarray:
        return pourer_motion(self.joints, self.times - self.times[0], SPEC.arm).tilt(self.times - self.times[0])


class Recorder:
    """Keeps what the controller's joints do; it forgets after ten minutes of its time."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.times: list[float] = []
        self.joints: list[tuple[float, ...]] = []

    async def run(self) -> None:
        while True:
            await self.take()
            await asyncio.sleep(2.0)

    async def take(self) -> None:
        stage, last = self._stage, self.times[-1] if self.times else -1.0
        await stage.now()
        history = await stage.site.history(max(last - stage.earlier, 0.0))
        for t, q in zip(history.times, history.joints, strict=True):
            if t <= history.now and t + stage.earlier > last:
                self.times.append(t + stage.earlier)
                self.joints.append(q)


def left_home(joints: tuple[float, ...]) -> bool:
    """Whether the arm has moved: the driver's first state of a motion is that of the motion before."""
    return bool(joints) and float(np.max(np.abs(np.subtract(joints, SPEC.arm.home.angles)))) > 0.05


async def strike_in(stage: Stage, phase: str, fault: Fault, seen: list[Any], pour: asyncio.Task[Any]) -> float:
    """Have a fault happen in the middle of a phase; the controller's time then [s]."""
    spans = {name: (begin, end) for name, begin, end in arm_kind(SPEC.arm).plan(SCENE, SLOWLY).phases}
    end, clock = time.monotonic() + PATIENCE, stage.bench.ground_truth.clock
    try:
        while True:
            assert time.monotonic() < end, f"never came to {phase}"
            assert not pour.done(), f"the pour ended before {phase} was seen: {pour.result()}"
            clock.promise("dose", LOOK)
            state = await stage.bench.arm.state()
            if phase == "weigh" and seen and seen[-1].checkpoint in ("settle", "weigh"):
                break
            if phase == "approach" and state.phase == phase and state.fraction > 0.2 and left_home(state.joints):
                break
            if phase in spans and state.phase == phase:
                begin, until = spans[phase]
                if state.time > begin + 0.2 * (until - begin):
                    break
            await asyncio.sleep(0.005)
        at = await stage.now()
        await fault.strike(stage)
    finally:
        clock.withdraw("dose")
    return at


async def tell_tale(open_stage: Any, phase: str, fault: Fault, *, mend: set[str], **changes: Any) -> Tale:
    seen: list[Any] = []
    async with open_stage(wired_spec(pace=PACE, hurried=True, **changes.pop("spec", {})), **changes) as stage:
        for about in mend:
            if fault.mend is not None:
                stage.before[about] = lambda: fault.mend(stage)
        recorder = Recorder(stage)
        recording = asyncio.create_task(recorder.run())
        pour = asyncio.create_task(stage.pour(SLOWLY, progress=seen.append))
        try:
            struck = await strike_in(stage, phase, fault, seen, pour)
        except BaseException:
            pour.cancel()
            await asyncio.gather(pour, return_exceptions=True)
            raise
        outcome: PourMeasurement | LaboratoryError
        try:
            outcome = await asyncio.wait_for(pour, PATIENCE)
        except LaboratoryError as error:
            outcome = error
        recording.cancel()
        await fault_is_over(stage)
        await recorder.take()
        times, joints = np.array(recorder.times), np.array(recorder.joints)
        consents = [stage.answered_at[about] for about in ("untilt", "home") if about in stage.answered_at]
        consented = min(consents, default=times[-1])
        after = times >= struck
        return Tale(stage, outcome, struck, consented, times[after], joints[after])


async def fault_is_over(stage: Stage) -> None:
    await stage.site.fault("clear")


def check_nothing_moved_without_consent(tale: Tale) -> None:
    still = (tale.times > tale.struck + STANDING * PACE) & (tale.times < tale.consented)
    shown = f"struck {tale.struck:.1f}, consented {tale.consented:.1f}, {tale.times[0]:.1f} … {tale.times[-1]:.1f}"
    assert still.sum() > 5, f"too little time between fault and consent to see anything: {shown}"
    assert np.max(np.ptp(tale.joints[still], axis=0)) < 1e-3


def check_never_tilted_again(tale: Tale) -> None:
    then = tale.tilts[tale.times <= tale.struck + STANDING * PACE].max()
    assert tale.tilts[tale.times > tale.consented].max(initial=0.0) <= then + math.radians(2.0)


LATE = 3.2
"""The operator takes so long to come [s of the clock]: meanwhile the arm is looked at."""


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "phase"), cases(ARM))
def test_a_fault_of_the_arm(open_stage, name, phase):
    fault = ARM[name]
    tale = asyncio.run(
        tell_tale(open_stage, phase, fault, mend={"recover", "unsafe"}, late={"recover": LATE, "unsafe": LATE})
    )
    stage, outcome = tale.stage, tale.outcome
    assert stage.unsafe == []
    check_never_tilted_again(tale)
    if phase == "weigh":
        # The pour was over: what is asked next invites hands in only once it is seen that nothing can move.
        assert isinstance(outcome, PourMeasurement), outcome
        assert outcome.spilled == pytest.approx(stage.contents.on_tray, abs=3e-4)
        assert np.max(np.ptp(tale.joints, axis=0)) < 1e-3
        return
    check_nothing_moved_without_consent(tale)
    recover = next(question for question in stage.operator.heard if question.about == "recover")
    assert recover.problem, "the operator is told what happened"
    told = "\n".join(notice.text for notice in stage.notices)
    asked = sum(recover.problem == question.problem for question in stage.operator.heard)
    assert told.count(recover.problem) == asked, "those who watch are told as often as the operator"
    np.testing.assert_allclose(tale.joints[-1], SPEC.arm.home.angles, atol=0.02)
    if phase == "approach":
        assert isinstance(outcome, NotPouredError), outcome
        assert stage.heard.index("recover") < stage.heard.index("home")
        assert stage.contents.on_tray == 0.0
        assert "Nothing was poured" in str(outcome)
        return
    assert isinstance(outcome, UnknownPourError), outcome
    assert stage.heard.index("recover") < stage.heard.index("untilt")
    if name == "reboot":  # which forgets what the arm did: nobody may make up what became of the liquid
        assert "can't tell what became of the liquid" in str(outcome)
        assert "weighed, spilled:" not in stage.said("note")
        return
    for key in ("pourer_full", "spilled", "pourer_after"):
        assert f"weighed, {key}:" in stage.said("note")
        assert key in str(outcome)
    loaded = stage.contents.in_receiver + stage.contents.on_tray + stage.contents.in_pourer
    assert f"{1e3 * loaded:.1f}"[:4] in str(outcome)


@pytest.mark.realtime
def test_a_pour_that_a_person_slowed_is_weighed_and_the_user_is_told(open_stage):
    fault = Fault(controller("slider", fraction=0.5))
    tale = asyncio.run(tell_tale(open_stage, "tilt", fault, mend=set()))
    assert isinstance(tale.outcome, PourMeasurement), tale.outcome
    planned = arm_kind(SPEC.arm).plan(SCENE, SLOWLY).pour_time
    took = tale.outcome.notes["executed_s"]
    assert 1.2 * planned < took < 2.2 * planned
    assert tale.outcome.notes["executed"]["tracking"]["slider"] == pytest.approx(0.5)
    text = f"the controller slowed the pour to 50 % of its speed: it took {took:.1f} s instead of {planned:.1f} s"
    assert text in tale.stage.said("warning")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(("name", "phase"), cases(BALANCE))
def test_a_fault_of_the_balance(open_stage, name, phase):
    """Whenever the balance fails, the arm finishes; the weights are taken once it is mended."""
    tale = asyncio.run(tell_tale(open_stage, phase, BALANCE[name], mend={"balance", "spilled", "pourer_after"}))
    stage, outcome = tale.stage, tale.outcome
    assert isinstance(outcome, PourMeasurement), outcome
    assert "recover" not in stage.heard
    asked = [q for q in stage.operator.heard if q.problem]
    assert asked, "the operator is told what is wrong with the balance"
    assert outcome.spilled == pytest.approx(stage.contents.on_tray, abs=3e-4)
    assert outcome.retained == pytest.approx(stage.contents.in_pourer, abs=3e-4)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    "phase", ["tilt", *(pytest.param(p, marks=pytest.mark.slow) for p in ("approach", "hold", "return"))]
)
@pytest.mark.parametrize("how", ["no", pytest.param("never", marks=pytest.mark.slow)])
def test_an_operator_who_does_not_want_the_stopped_arm_to_move(open_stage, how, phase):
    """The arm stays where it was stopped, and what can be weighed without hands is weighed."""
    tale = asyncio.run(
        tell_tale(
            open_stage,
            phase,
            ARM["protective stop"],
            mend=set(),
            spec={"operator": OperatorSettings(answers="virtual", time=2.0, reminder=15.0, deadline=45.0)},
            **(
                {"answers": {"recover": ["no"]}, "late": {"recover": 2.0}}
                if how == "no"
                else {"late": {"recover": math.inf}}
            ),
        )
    )
    still = tale.times > tale.struck + STANDING * PACE
    assert np.max(np.ptp(tale.joints[still], axis=0)) < 1e-3
    if phase == "approach":
        assert isinstance(tale.outcome, NotPouredError)
        return
    assert isinstance(tale.outcome, UnknownPourError)
    assert "pourer_full" in str(tale.outcome)
    assert "spilled" in str(tale.outcome)
    assert "What was poured is unknown" in str(tale.outcome)


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.parametrize("how", ["no", "never"])
def test_an_operator_who_leaves_the_balance_as_it_is(open_stage, how):
    """No weight that was taken is lost, and the spill still lies where it can be weighed."""
    fault = replace(BALANCE["unplugged"], mend=None)
    scripted = {"answers": {"balance": ["no"]}} if how == "no" else {"late": {"balance": math.inf}}
    spec = {"operator": OperatorSettings(answers="virtual", time=2.0, reminder=15.0, deadline=45.0)}
    tale = asyncio.run(tell_tale(open_stage, "weigh", fault, mend=set(), spec=spec, **scripted))
    assert isinstance(tale.outcome, UnknownPourError)
    assert "pourer_full" in str(tale.outcome)
    assert "weighed, pourer_full:" in tale.stage.said("note")


@pytest.mark.slow
@pytest.mark.realtime
def test_a_balance_that_was_switched_off_during_the_pour_is_not_believed(open_stage):
    """Its new zero would count the spill as nothing; the operator says that it was off, and the spill is unknown."""

    async def off_and_on(stage: Stage) -> None:
        await stage.site.order("unplug")
        await stage.site.order("power cycle")

    async def plug(stage: Stage) -> None:
        await stage.site.order("plug")

    tale = asyncio.run(
        tell_tale(open_stage, "weigh", Fault(off_and_on, plug), mend={"balance"}, answers={"reference": ["no"]})
    )
    assert "reference" in tale.stage.heard
    assert isinstance(tale.outcome, UnknownPourError)


@pytest.mark.slow
def test_the_bench_pours_again_after_a_fault_was_mended(open_stage):
    async def play():
        seen: list[Any] = []
        async with open_stage(SPEC) as stage:
            pour = asyncio.create_task(stage.pour(SLOWLY, progress=seen.append))
            await strike_in(stage, "tilt", ARM["protective stop"], seen, pour)
            with pytest.raises(UnknownPourError):
                await pour
            assert isinstance(stage.operator, VirtualOperator)
            return await stage.pour()

    assert asyncio.run(play()).loaded == pytest.approx(0.2, abs=5e-3)
