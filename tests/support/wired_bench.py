"""A wired bench in this process: real wires, a cheap liquid that follows what the arm executed, a scripted operator."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from actors.balance.balance_settings import SerialBalanceSettings
from actors.balance.weighing_plan import Placement
from actors.bench.bench_factory import PouringBench
from actors.bench.bench_operators import BenchContents, VirtualOperator
from actors.bench.virtual_bench import DeviceEmulators, FollowedBench, VirtualBench
from actors.interfaces import Notice, OperatorQuestion, OperatorSettings
from actors.laboratory import InProcessLaboratory
from actors.laboratory_settings import LaboratorySettings
from actors.places import PlaceRecord
from orchestrator.campaigns.file_loading import load_laboratory
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.vessel.shapes import cylinder

LABORATORIES = Path(__file__).parents[2] / "configs" / "laboratories"

PACE = 30.0
"""Bench seconds per second in these tests, unless they say otherwise."""

FULL_TILT = 100 * DEG


class Trickle:
    """A liquid of one rule: a pourer tilted to `FULL_TILT` is empty, one less tilted keeps what it can; a twentieth of
    what leaves it misses the receiver."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        assert task.motion is not None, "the wired bench simulates what was executed"
        tilt = float(np.max(task.motion.tilt(task.motion.times)))
        poured = min(max((tilt - 30 * DEG) / (FULL_TILT - 30 * DEG), 0.0), 1.0)
        outcome = PourOutcome(
            received=0.95 * poured,
            spilled=0.05 * poured,
            retained=1.0 - poured,
            in_flight=0.0,
            escaped=0.0,
            particles=100,
            spacing=4e-3,
            density_error=0.01,
            simulated_time=task.motion.duration,
            steps=100,
            cpu_s=0.1,
            seed=task.seed,
            curve_times=(0.0, 1.0),
            curve_poured=(0.0, poured),
            curve_spilled=(0.0, 0.05 * poured),
        )
        return SimulatedPour(outcome)

    def close(self) -> None:
        pass


SCENE = Scene(
    name="tumbler",
    pourer=cylinder("beaker", inner_radius=0.035, inner_height=0.1),
    receiver=cylinder("tumbler", inner_radius=0.04, inner_height=0.1),
    liquid=Liquid(mass=0.2),
)

ACTION = Action(
    angular_velocity=60 * DEG,
    x_offset=0.1,
    height=0.1,
    max_angle=90 * DEG,
    hold_time=0.8,
    return_velocity=60 * DEG,
    angular_acceleration=600 * DEG,
)


@dataclass
class Stage:
    """A laboratory that is open, and everything that was said in it."""

    laboratory: InProcessLaboratory
    bench: PouringBench = field(init=False)
    site: DeviceEmulators = field(init=False)
    operator: VirtualOperator = field(init=False)
    contents: BenchContents = field(init=False)
    notices: list[Notice] = field(default_factory=list)
    before: dict[str, Callable[[], Awaitable[None]]] = field(default_factory=dict)
    """Done before the next question about something is answered."""
    answered_at: dict[str, float] = field(default_factory=dict)
    """Controller time at which the last question about something was answered [s]."""
    answers: dict[str, list[str]] = field(default_factory=dict)
    """In place of the operator's own answers to questions about something, first to last; no step is carried out."""
    late: dict[str, float] = field(default_factory=dict)
    """Extra time for the next question about something [s]; with inf it is never answered."""
    unsafe: list[str] = field(default_factory=list)
    """Questions that invited hands in while a program ran or a joint moved."""

    clock: float = 0.0
    earlier: float = 0.0

    def attend(self) -> None:
        """Stand beside the operator, and look at the controller whenever it is asked something."""
        opened = self.laboratory.opened
        assert opened is not None
        assert opened.emulators is not None
        assert isinstance(opened.bench.ground_truth, VirtualBench)
        assert isinstance(opened.operator, VirtualOperator)
        self.bench, self.site, self.operator = opened.bench, opened.emulators, opened.operator
        self.contents = opened.bench.ground_truth.contents
        ask = self.operator.ask

        async def attended(question: OperatorQuestion) -> str:
            state = await self._seen()
            if question.hands and (state["runtime_state"] != "STOPPED" or max(map(abs, state["speeds"])) > 1e-3):
                self.unsafe.append(question.about)
            if (hook := self.before.pop(question.about, None)) is not None:
                await hook()
            if math.isinf(late := self.late.pop(question.about, 0.0)):
                self.operator.heard.append(question)
                await asyncio.Event().wait()
            await asyncio.sleep(late)  # how long this operator takes
            if self.answers.get(question.about):
                self.operator.heard.append(question)
                answer = self.answers[question.about].pop(0)
            else:
                answer = await ask(question)
            self.answered_at[question.about] = await self.now()
            return answer

        self.operator.ask = attended  # type: ignore[method-assign]

    async def _seen(self) -> dict[str, Any]:
        """What the controller knows of itself; an arm without one never runs a program."""
        if not isinstance(self.bench.ground_truth, FollowedBench):
            return {"runtime_state": "STOPPED", "speeds": [0.0], "time": 0.0}
        return await self.site.fault("state")

    @property
    def heard(self) -> list[str]:
        """What the operator was asked about, in order."""
        return [question.about for question in self.operator.heard]

    def said(self, level: str) -> str:
        return "\n".join(notice.text for notice in self.notices if notice.level == level)

    async def pour(self, action: Action = ACTION, **changes: Any) -> Any:
        return await self.bench.pour(SCENE, action, seed=5, **changes)

    async def moved(self, since: float) -> float:
        """How far any joint has moved since a controller time [rad]."""
        history = await self.site.history(since)
        joints = np.array(history.joints)
        return 0.0 if len(joints) < 2 else float(np.max(np.ptp(joints, axis=0)))

    async def now(self) -> float:
        """The controller's time [s]; it goes on counting when the controller's clock begins anew."""
        return self.unwrapped(float((await self._seen())["time"]))

    def unwrapped(self, clock: float) -> float:
        if clock < self.clock:
            self.earlier += self.clock
        self.clock = clock
        return clock + self.earlier


def wired_spec(
    placement: Placement = Placement.TRAY,
    pace: float = PACE,
    operator: OperatorSettings | None = None,
    *,
    hurried: bool = False,
    laboratory: str = "virtual.yaml",
) -> LaboratorySettings:
    """A shipped virtual laboratory with an exact balance; `hurried` saves time where that changes nothing."""
    spec = load_laboratory(LABORATORIES / laboratory)
    assert spec.arm is not None
    assert spec.balance is not None
    device = spec.balance
    assert isinstance(device, SerialBalanceSettings)
    assert device.virtual is not None
    assert spec.bench is not None
    rule = device.settling.with_values(deadline=10.0)
    arm = spec.arm.with_values(time_scale=pace)
    if hurried:
        rule = rule.with_values(readings=2, span=0.2)
        arm = arm.with_values(warning_time=1.0, upright_speed=60 * DEG, approach_speed=90 * DEG)
    virtual = device.virtual.with_values(noise=0.0, drift=0.0, settling_time=0.5)
    quick = {"time_scale": pace, "answer_time": 0.3, "reconnect_time": 1.0}
    return spec.with_values(
        in_process=True,
        arm=arm,
        balance=device.with_values(placement=placement.value, settling=rule, virtual=virtual, **quick),
        bench=spec.bench.with_values(time_scale=pace),
        operator=operator or OperatorSettings(answers="virtual", time=2.0, reminder=60.0, deadline=300.0),
    )


OpenStage = Callable[..., contextlib.AbstractAsyncContextManager[Stage]]


@contextlib.asynccontextmanager
async def opened_stage(
    spec: LaboratorySettings | None = None,
    *,
    answers: Mapping[str, Sequence[str]] | None = None,
    late: Mapping[str, float] | None = None,
    record: PlaceRecord | None = None,
    **changes: Any,
) -> AsyncIterator[Stage]:
    """A wired bench around the cheap liquid, with an operator that does as it is told."""
    laboratory = InProcessLaboratory(spec or wired_spec(**changes), Trickle, pours=True, record=record)
    stage = Stage(laboratory)
    laboratory.listen(stage.notices.append)
    async with laboratory:
        stage.attend()
        stage.answers = {about: list(given) for about, given in (answers or {}).items()}
        stage.late = dict(late or {})
        yield stage
