"""`flowing_liquid`: liquid that follows an emulated arm: a lost answer is made up for; an emulator that has ended
ends the flow. Particles are simulated while they may move.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.arm.ur_settings import UrArmSettings
from actors.bench import flowing_liquid
from actors.bench.flowing_liquid import FOLLOWED, FlowingLiquid, FlowOrder, FormulaLiquid
from actors.dosing.particle_liquid import CALM, ParticleFlow
from actors.dosing.virtual_dosing_bench import TrueCup
from actors.interfaces import LaboratoryError
from actors.runtime import bench_clock
from actors.runtime.bench_clock import SharedClock
from actors.simulators.live_worker import LivePourProcess
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.live_pour import LiveState
from sim_engine.scene import PoseError, PourTask, SampledMotion, Scene
from sim_engine.vessel.shapes import cylinder
from tests.support.waiting import PATIENCE, wait_for


@dataclass(frozen=True)
class Motion:
    times: tuple[float, ...] = ()
    joints: tuple[tuple[float, ...], ...] = ()
    now: float = 0.0


def following(history: object) -> FlowingLiquid:
    liquid = FormulaLiquid(TrueCup(0.04, 0.1), Liquid(mass=0.3), constants=1, seed=2, wetness=0.0)
    arm, pours = UrArmSettings.model_construct(), LivePourProcess()
    return FlowingLiquid(FlowOrder(liquid, base=0.1), arm, history, lambda mass: None, pours)  # type: ignore[arg-type]


def test_the_flow_ends_when_the_emulator_has_been_silent_for_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flowing_liquid, "SILENCE", 0.0)
    calls = 0

    def history(since: float) -> Motion:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise LaboratoryError("the emulator has ended")
        return Motion()

    liquid = following(history)
    liquid._thread.join(PATIENCE)
    assert not liquid._thread.is_alive()
    assert liquid.end().received == 0.0


def test_the_flow_goes_on_after_a_lost_answer() -> None:
    again, calls = threading.Event(), 0

    def history(since: float) -> Motion:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise LaboratoryError("no answer")
        if calls > 3:
            again.set()
        return Motion()

    liquid = following(history)
    assert again.wait(PATIENCE)
    liquid.end()


BEAKER = cylinder("beaker", inner_radius=0.04, inner_height=0.1)
DOSE = PourTask(Scene("dose", BEAKER, BEAKER, Liquid(mass=0.3)), FOLLOWED, SimulationParameters(), 1)
UPRIGHT = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
TILTED = np.array([0.0, 0.0, 0.2, math.cos(0.5), 0.0, math.sin(0.5), 0.0])


@dataclass
class Drips:
    """Particles of 10 g: while the cup is tilted one leaves it in each step, falls in the next one, and then lies in
    the receiver and on the tray in turns."""

    left: float = 0.3
    falls: float = 0.0
    landed: list[float] = field(default_factory=list)
    moments: list[float] = field(default_factory=list)
    invalid: str | None = None
    hangs: float = 0.0

    def begin(self, task: PourTask, pose: NDArray[np.float64]) -> None:
        self.left = task.scene.liquid.mass

    def advance(self, times: NDArray[np.float64], poses: NDArray[np.float64]) -> LiveState:
        assert (np.diff([*self.moments[-1:], *times]) > 0.0).all()
        self.moments += list(times)
        self.landed += [self.falls] if self.falls else []
        self.falls = 0.01 if poses[-1, 5] > 0.1 else 0.0
        self.left -= self.falls
        received, spilled = sum(self.landed[::2]), sum(self.landed[1::2])
        left, falls = self.left - self.hangs, self.falls + self.hangs
        return LiveState(self.moments[-1], left, falls, received, spilled, self.invalid)

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        return np.zeros((3, 3), np.float32), np.zeros(3, np.uint8)

    def close(self) -> None:
        pass


def particles(drips: Drips) -> ParticleFlow:
    return ParticleFlow(DOSE, drips, UPRIGHT)


def stand(flow: ParticleFlow, begin: float, end: float, pose: NDArray[np.float64]) -> float:
    """Stand in a pose, in steps of 0.1 s. Returns the load on the balance."""
    load = 0.0
    for moment in np.arange(begin + 0.1, end + 0.05, 0.1):
        load = flow.follow(np.array([moment - 0.05, moment]), np.array([pose, pose]))
    return load


def test_what_enters_the_receiver_weighs_as_much_more_as_the_liquid_in_the_air() -> None:
    flow = particles(Drips())
    stand(flow, 0.0, 0.3, TILTED)
    load = stand(flow, 0.3, 0.4, TILTED)  # 10 g arrive in 0.1 s
    lip = 0.2 + 0.1 * math.cos(1.0) - 0.04 * math.sin(1.0)  # of a beaker that is tilted by 1 rad about its underside
    fall = math.sqrt(2.0 * (lip - 0.1) / 9.81)
    assert load - flow.received == pytest.approx(0.1 * fall, rel=0.05)
    assert stand(flow, 0.4, 1.0, UPRIGHT) == pytest.approx(flow.received)


def test_what_misses_the_receiver_is_spilled_and_the_rest_stays_in_the_source() -> None:
    flow = particles(Drips())
    stand(flow, 0.0, 0.5, TILTED)
    assert flow.received == pytest.approx(0.02)
    stand(flow, 0.5, 0.6, UPRIGHT)
    flow.land()
    assert (flow.received, flow.spilled, flow.left) == pytest.approx((0.03, 0.02, 0.25))


def test_a_cup_that_stands_still_is_not_simulated_until_it_moves() -> None:
    drips = Drips()
    flow = particles(drips)
    stand(flow, 0.0, 20.0, UPRIGHT)
    waited = drips.moments[-1]
    assert waited == pytest.approx(CALM, abs=0.11)
    stand(flow, 20.0, 20.5, TILTED)
    stand(flow, 20.5, 40.0, UPRIGHT)
    # a while after the last drop has landed time passes, also without motion
    assert drips.moments[-1] == pytest.approx(waited + 0.5 + CALM, abs=0.25)
    assert flow.received + flow.spilled + flow.left == pytest.approx(0.3)


def test_a_drop_that_hangs_at_a_rim_needs_no_simulation_and_is_left() -> None:
    drips = Drips(hangs=0.01)
    flow = particles(drips)
    stand(flow, 0.0, 20.0, UPRIGHT)
    assert drips.moments[-1] < 3.0 * CALM
    flow.land()
    assert (flow.received, flow.spilled, flow.left) == pytest.approx((0.0, 0.0, 0.3))


def test_a_cup_that_stands_tilted_and_pours_is_simulated() -> None:
    drips = Drips()
    stand(particles(drips), 0.0, 5.0, TILTED)
    assert drips.moments[-1] == pytest.approx(5.0)


def test_frames_for_a_live_view_are_kept_with_the_time_of_the_dose() -> None:
    aside = replace(DOSE, pose_error=PoseError(x=0.05, z=-0.01))
    flow = ParticleFlow(aside, Drips(), UPRIGHT, watched=True)
    stand(flow, 0.0, 3.0, UPRIGHT)
    frames = flow.frames()
    assert frames is not None
    assert frames.receiver_at == (0.05, 0.0, -0.01)
    assert frames.times[-1] == pytest.approx(3.0)
    assert len(frames.times) > 10
    assert flow.frames() is None
    unwatched = particles(Drips())
    stand(unwatched, 0.0, 3.0, UPRIGHT)
    assert unwatched.frames() is None


class Kind:
    """An arm that holds a cup tilted."""

    def figure(self) -> object:
        return self

    def pourer_motion(self, joints: object, times: NDArray[np.float64], grip_tilt: float) -> SampledMotion:
        return SampledMotion(times, np.array([TILTED] * len(times)))


def tilted(
    monkeypatch: pytest.MonkeyPatch, drips: Drips, put: Callable[[float], None], *, on_tray: bool
) -> FlowingLiquid:
    monkeypatch.setattr(flowing_liquid, "arm_kind", lambda spec: Kind())
    clock = itertools.count(1.0, 0.1)

    def history(since: float) -> Motion:
        now = next(clock)
        return Motion((now,), ((0.0,) * 6,), now)

    return FlowingLiquid(FlowOrder(DOSE, 0.1, on_tray=on_tray), UrArmSettings.model_construct(), history, put, drips)


@pytest.mark.parametrize("on_tray", [False, True])
def test_what_is_spilled_loads_the_balance_only_if_the_tray_stands_on_it(
    monkeypatch: pytest.MonkeyPatch, on_tray: bool
) -> None:
    drips, loads, some = Drips(), list[float](), threading.Event()

    def put(load: float) -> None:
        loads.append(load)
        if len(drips.landed) >= 4:
            some.set()

    liquid = tilted(monkeypatch, drips, put, on_tray=on_tray)
    assert some.wait(PATIENCE)
    end = liquid.end()
    assert end.spilled > 0.0
    assert loads[-1] == pytest.approx(0.1 + end.received + (end.spilled if on_tray else 0.0))


def test_a_simulation_that_fails_ends_the_flow_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = Drips(invalid="particles crossed vessel walls")
    liquid = tilted(monkeypatch, broken, lambda mass: None, on_tray=False)
    liquid._thread.join(PATIENCE)
    assert not liquid._thread.is_alive()
    with pytest.raises(LaboratoryError, match="could not be simulated: particles crossed vessel walls"):
        liquid.end()


class SlowDrips(Drips):
    """Its first step ends when another one begins next to it, or when none does for a while."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.next, self.overlapped = threading.Event(), threading.Event(), False

    def advance(self, times: NDArray[np.float64], poses: NDArray[np.float64]) -> LiveState:
        if self.begun.is_set():
            self.next.set()
        else:
            self.begun.set()
            self.overlapped = self.next.wait(0.5)  # a second step would begin at once
        return super().advance(times, poses)


def test_the_end_waits_for_a_step_that_takes_long_and_makes_none_next_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flowing_liquid, "SILENCE", 0.0)
    drips = SlowDrips()
    liquid = tilted(monkeypatch, drips, lambda mass: None, on_tray=False)
    assert drips.begun.wait(PATIENCE)
    end = liquid.end()
    liquid._thread.join(PATIENCE)
    assert not drips.overlapped
    assert end.received + end.spilled > 0.0


@dataclass
class LateDrips(Drips):
    """Each step takes some looks of the controller at its clock; the first one more than the clock waits for."""

    looks: Callable[[], int] = lambda: 0

    def advance(self, times: NDArray[np.float64], poses: NDArray[np.float64]) -> LiveState:
        end = self.looks() + (2 * len(times) if self.moments else 45)
        wait_for(lambda: self.looks() >= end, "the controller looks at its clock", poll=1e-3)
        return super().advance(times, poses)


def test_the_clock_of_the_bench_waits_for_a_simulation_that_is_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wall time is counted in looks of 4 ms, so that a busy machine changes nothing."""
    looks, ending = [0], threading.Event()
    monkeypatch.setattr(flowing_liquid, "arm_kind", lambda spec: Kind())
    monkeypatch.setattr(bench_clock, "LONGEST_STAND", 0.1)
    monkeypatch.setattr(bench_clock, "time", SimpleNamespace(monotonic=lambda: 4e-3 * looks[0]))
    SharedClock.create(tmp_path / "clock")
    clock = SharedClock(tmp_path / "clock")

    def control() -> None:
        while not ending.wait(1e-3):
            clock.advance(0.008 if clock.may_pass(0.008) else 0.0)
            looks[0] += 1

    def history(since: float) -> Motion:
        now = clock.now
        times = tuple(float(t) for t in np.arange(max(since, now - 60.0), now, 0.008)[1:])
        return Motion(times, ((0.0,) * 6,) * len(times), now)

    thread = threading.Thread(target=control, daemon=True)
    thread.start()
    drips, arm = LateDrips(looks=lambda: looks[0]), UrArmSettings.model_construct(clock=str(tmp_path / "clock"))
    liquid = FlowingLiquid(FlowOrder(DOSE, 0.1), arm, history, lambda load: None, drips)  # type: ignore[arg-type]
    begun = liquid._begun
    try:
        wait_for(lambda: clock.now - begun > 0.12, "the clock goes on without the first step, which takes too long")
        wait_for(lambda: clock.now - begun - (drips.moments or [0.0])[-1] < 0.1, "the simulation catches up")
        for _ in range(8):
            done = drips.moments[-1]
            wait_for(lambda: drips.moments[-1] > done, "the simulation goes on")  # noqa: B023
            assert clock.now - begun - drips.moments[-1] < 0.2
    finally:
        liquid.end()
        ending.set()
        thread.join()
