"""`progress_state`: what is told of the time that is left comes true."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import pytest

from actors.laboratory_settings import BenchSettings, LaboratorySettings
from orchestrator.learning.requests import Failed, Pour, Simulate, Simulated
from orchestrator.learning.strategy import Progress
from orchestrator.records.events import (
    CampaignOpened,
    Event,
    RequestFinished,
    RequestStarted,
    StageClosed,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import RunState
from orchestrator.reports.progress_state import PRICE, Forecast, WorkEstimate, pour_time, work_of
from sim_engine.liquids import SimulationParameters
from tests.support import example_run
from tests.support.toy_campaign import SCENE, SPACE, toy_plan

THETA = SimulationParameters(particles=1000)
ACTION = SCENE.action(SPACE.decode([0.5, 0.5]))

# The quickstart's shape, with the times [s] of a run on two cores: each pour, and from each simulation's answer to the
# next one's; the first of either also starts simulators.
POURS = (34.3, 9.2, 4.2, 3.8, 7.7, 6.9, 8.4, 9.9, 5.1, 12.2)
CALIBRATION = (9.2, *(0.8 for _ in range(23)))
EVALUATION = tuple(0.68 for _ in range(25))
PRIOR = tuple(0.74 for _ in range(16))
CYCLES = (5.7, 6.6, 6.9, 5.2, 6.8, 5.7)
WORK = {
    "pours": WorkEstimate(pours=10, pour_time=8.5),
    "calibration": WorkEstimate(24),
    "evaluation": WorkEstimate(25),
    "deployment": WorkEstimate(40, 6, beside=4, pour_time=8.5),
}


@dataclass
class Timeline:
    """A campaign's events with made-up times."""

    now: float = 1000.0
    ids: int = 0

    def _answered(self, stage: str, request: Simulate | Pour, seconds: float) -> Iterator[Event]:
        self.ids += 1
        yield RequestStarted(time=self.now, stage=stage, id=self.ids, request=request)
        self.now += seconds
        outcome = (
            Simulated(example_run.outcome()) if isinstance(request, Simulate) else Failed("pour_failed", "slipped")
        )
        yield RequestFinished(
            time=self.now, stage=stage, id=self.ids, request=request, outcome=outcome, seconds=seconds
        )

    def stage(
        self, name: str, simulations: tuple[float, ...] = (), pours: tuple[float, ...] = (), beside: int = 0
    ) -> Iterator[Event]:
        """Simulations, then pours with some simulations beside each."""
        yield StageOpened(time=self.now, stage=name, index=1, count=1)
        done = Progress(0, len(simulations) + beside * len(pours), 0, len(pours))
        for seconds in simulations:
            yield from self._answered(name, Simulate("cup", ACTION, THETA, 1), seconds)
            done = replace(done, simulations=done.simulations + 1)
            yield StrategyProgressed(time=self.now, stage=name, progress=done, result=example_run.LEARNT)
        for number, seconds in enumerate(pours, start=1):
            yield from self._answered(name, Pour("cup", ACTION, number, 1), seconds)
            done = replace(done, simulations=done.simulations + beside, pours=number)
            yield StrategyProgressed(time=self.now, stage=name, progress=done, result=example_run.LEARNT)
        yield StageClosed(time=self.now, stage=name, result=example_run.LEARNT)

    def campaign(self) -> Iterator[Event]:
        """All four stages."""
        yield from self.stage("pours", pours=POURS)
        yield from self.stage("calibration", CALIBRATION)
        yield from self.stage("evaluation", EVALUATION)
        yield from self.stage("deployment", PRIOR, CYCLES, beside=4)


class Followed(Forecast):
    """A forecast whose run takes the events, too."""

    def __init__(self, slots: int, particles: float, works: dict[str, WorkEstimate]) -> None:
        super().__init__(RunState(Header("", {}), slots), particles)
        self._run.take(
            CampaignOpened(
                name="", run_directory=Path(), stages=tuple(works), mode="virtual", simulators=slots, time=0.0
            )
        )
        self.begin(works)

    def __call__(self, event: Event) -> None:
        self._run.take(event)
        super().__call__(event)


def begun() -> Followed:
    return Followed(2, 900.0, WORK)


def test_the_end_that_is_foretold_comes_true_within_a_fifth_from_the_beginning_on() -> None:
    timeline, forecast = Timeline(), begun()
    begin, ends = timeline.now, []
    for event in timeline.campaign():
        forecast(event)
        left = forecast.left(event.time)
        assert left is not None
        ends.append(event.time - begin + left)
    whole = timeline.now - begin
    assert forecast.left(timeline.now) == 0.0
    off = [abs(end - whole) / whole for end in ends]
    assert max(off) < 0.2
    assert whole == pytest.approx(sum((*POURS, *CALIBRATION, *EVALUATION, *PRIOR, *CYCLES)))


def test_the_time_left_falls_while_a_pour_or_a_simulation_takes_its_time() -> None:
    timeline, forecast = Timeline(), begun()
    events = timeline.campaign()
    for event in events:
        forecast(event)
        if isinstance(event, RequestStarted) and (event.stage, event.id) in {("pours", 5), ("calibration", 20)}:
            lefts = [forecast.left(event.time + 0.5 * k) or 0.0 for k in range(4)]
            assert all(later <= sooner for sooner, later in pairwise(lefts)), event.stage
            assert lefts[0] - lefts[2] == pytest.approx(1.0 if event.stage == "pours" else 0.9 * 0.7, abs=0.1)


def test_a_pour_that_takes_much_longer_than_expected_does_not_end_in_a_second() -> None:
    """A dose of particles on a busy machine: 'about 1 s left' for three minutes."""
    timeline, forecast = Timeline(), begun()
    for event in timeline.campaign():
        forecast(event)
        if isinstance(event, RequestStarted) and (event.stage, event.id) == ("pours", 5):
            break
    lefts = [forecast.left(timeline.now + late) or 0.0 for late in (0.0, 100.0, 200.0)]
    assert lefts[1] > lefts[0] + 50.0
    assert lefts[2] == pytest.approx(lefts[1] + 100.0)


def test_simulations_beside_a_pour_cost_time_only_where_they_outlast_it() -> None:
    one = Followed(1, 1000.0, {"deployment": WorkEstimate(0, 10, beside=0, pour_time=90.0)})
    few = Followed(1, 1000.0, {"deployment": WorkEstimate(200, 10, beside=20, pour_time=90.0)})
    many = Followed(1, 1000.0, {"deployment": WorkEstimate(2000, 10, beside=200, pour_time=90.0)})
    assert few.left(0.0) == one.left(0.0) == pytest.approx(900.0)
    assert (many.left(0.0) or 0.0) > 1.5 * 900.0


def test_what_an_earlier_run_has_done_is_not_left_any_more() -> None:
    timeline, forecast = Timeline(), begun()
    untouched = forecast.left(timeline.now)
    for event in timeline.stage("pours", pours=POURS):
        forecast(replace(event, replayed=True))
    assert forecast.left(timeline.now) == pytest.approx((untouched or 0.0) - 10 * 8.5)


def test_a_person_s_pour_takes_the_time_that_was_set_for_it_and_a_fast_bench_a_part_of_it() -> None:
    plan = toy_plan(example_run.Path("x"))
    assert work_of(plan, ["deployment:cup", "no stage of it"]) == {
        "deployment:cup": WorkEstimate(37 + 2 * 3, 3, 2, pour_time=0.0),
        "no stage of it": WorkEstimate(),
    }
    campaign = example_run.campaign()
    assert campaign.deployment is not None
    bench = BenchSettings(liquid=SimulationParameters(particles=4000))
    scene, actions = campaign.deployment.scenes[0], campaign.deployment.actions
    slow = pour_time(LaboratorySettings(name="slow", bench=bench.with_values(time_scale=1.0)), scene, actions)
    fast = pour_time(LaboratorySettings(name="fast", bench=bench.with_values(time_scale=10.0)), scene, actions)
    liquid = PRICE * bench.theta.particles
    assert bench.operator_time + 15.0 < slow - liquid < bench.operator_time + 45.0
    assert fast - liquid == pytest.approx((slow - liquid) / 10.0)
