"""D3 with costs: simulations where and while they pay, an arm that waits for nobody, a journal that repeats it."""

from __future__ import annotations

import asyncio
import math
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Data
from orchestrator.learning.deployment.costing import Costs, CostSettings
from orchestrator.learning.deployment.d3 import MOST_SIMULATIONS, FreeHybrid
from orchestrator.learning.deployment.model_monitoring import DiscrepancyPolicySettings, subsampled
from orchestrator.learning.requests import Answered, Ask, Outcome, Pour, Request, Simulate, Slots, Suggest
from orchestrator.records.journal import Kind
from orchestrator.records.run_record import POOL_RESTS, Occupancy, read_record
from orchestrator.runs.strategy_harness import SCENE, THETA, StrategyHarness
from tests.orchestrator.test_stages import campaign, laboratory
from tests.support.killed_runs import die_at, finished_times
from tests.support.plans import deployment_plan
from tests.support.toy_campaign import SCENE as TOY_SCENE
from tests.support.toy_campaign import logical_record, run_toy
from tests.support.toy_spillage import narrow_cup, narrow_cup_biased


def free(seed: int = 0, costs: CostSettings | None = None, **changes: Any) -> FreeHybrid:
    changes = {"pours": 3, "prior_simulations": 20, **changes}
    plan = deployment_plan(simulations_per_pour="free", costs=costs or CostSettings(), **changes)
    return FreeHybrid(plan, SCENE, THETA, seed)


class Log:
    """A strategy, and all that it was asked and told."""

    def __init__(self, strategy: FreeHybrid) -> None:
        self.strategy = strategy
        self.steps: list[tuple[Slots, list[Request]] | tuple[Request, Outcome]] = []

    def ask(self, slots: Slots) -> list[Request]:
        requests = self.strategy.ask(slots)
        self.steps.append((slots, requests))
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        self.steps.append((request, outcome))
        self.strategy.tell(request, outcome)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.strategy, name)


def played(
    strategy: FreeHybrid, simulated: Any = narrow_cup, real: Any = None, **arguments: Any
) -> tuple[StrategyHarness, Log]:
    log = Log(strategy)
    return StrategyHarness(simulated, real, **{"beside": 40, **arguments}).run(log), log


# -- what is worth it ------------------------------------------------------------------------------------------------


def test_the_first_pour_comes_when_it_is_worth_more_per_second_than_a_simulation() -> None:
    def before_first(seconds: float) -> int:
        play, _ = played(free(costs=CostSettings(pour=seconds), pours=1))
        return next(i for i, r in enumerate(r for r in play.asked if not isinstance(r, Suggest)) if isinstance(r, Pour))

    assert before_first(0.02) < 10  # a pour costs less than a simulation
    assert 20 <= before_first(86400.0) <= 24  # as many as it may make, and those that fill the slots meanwhile
    strategy = free(costs=CostSettings(pour=0.02), pours=1)
    played(strategy)
    texts = [decision.text for decision in strategy.decisions]
    assert any(text.startswith("pour now, after") and "a simulation promises" in text for text in texts)


def test_the_pool_rests_when_simulations_promise_nothing_and_goes_on_when_something_is_new() -> None:
    tireless = free(costs=CostSettings(worth=0.0), pours=2, prior_simulations=10)
    lazy = free(costs=CostSettings(worth=1.0), pours=2, prior_simulations=10)
    many, few = played(tireless)[0], played(lazy)[0]
    assert len(many.simulations) > 45
    assert len(few.simulations) < 25
    assert not any(POOL_RESTS in decision.values for decision in tireless.decisions)
    rests = [decision for decision in lazy.decisions if POOL_RESTS in decision.values]
    assert rests
    assert "only pours tell: a simulation promises" in rests[0].text
    assert len(few.pours) == len(many.pours) == 2


def test_the_price_of_a_simulation_is_what_outcomes_say() -> None:
    costs = Costs(CostSettings(pour=90.0), worst=1.0)
    assert costs.simulation(2) == 1.0
    for seconds in (10.0, 500.0, 12.0, 0.0):
        costs.record(seconds)
    assert costs.simulation(2) == 6.0  # the median; 0 is not a measurement
    assert costs.prefers_pour(0.001, 0.1, 2)
    assert not costs.prefers_pour(0.01, 0.1, 2)
    assert costs.is_idle(0.005 * 6.0 / 90.0 * 0.99, 2)
    assert not costs.is_idle(0.005 * 6.0 / 90.0 * 1.01, 2)


def test_a_simulator_that_fails_for_ever_is_let_alone() -> None:
    def broken(action: Any, theta: Any, rng: np.random.Generator) -> float:
        return math.nan

    strategy = free(costs=CostSettings(worth=0.0), prior_simulations=4, pours=2)
    play, _ = played(strategy, broken, narrow_cup, beside=200)
    assert len(play.pours) == 2
    assert len(play.simulations) < 80
    assert any("simulations failed" in d.text for d in strategy.decisions if POOL_RESTS in d.values)


@pytest.mark.slow
def test_a_person_who_is_asked_about_the_simulator_is_answered_before_the_next_pour() -> None:
    def wrong(action: Any, theta: Any, rng: np.random.Generator) -> float:
        return 1.0 - 0.8 * narrow_cup(action, theta, rng)

    strategy = free(pours=6, model="adaptive", discrepancy_policy=DiscrepancyPolicySettings(limit=0.7, policy="ask"))
    log = Log(strategy)
    play = StrategyHarness(
        wrong, narrow_cup, beside=10, answer=lambda r: Answered("go on") if isinstance(r, Ask) else None
    )
    play.run(log)
    assert [r.number for r in play.pours] == [1, 2, 3, 4, 5, 6]
    assert sum(isinstance(r, Ask) for r in play.asked) == 1
    assert strategy.result().model_check.followed == "go on"


# -- nobody waits ----------------------------------------------------------------------------------------------------


def test_a_slot_that_falls_free_beside_a_pour_has_its_next_simulation_at_once() -> None:
    _, log = played(free(costs=CostSettings(worth=0.0), pours=2), slots=3)
    pouring, with_room, served = False, 0, 0
    for step in log.steps:
        if isinstance(step[0], Slots):
            pouring |= any(isinstance(r, Pour) for r in step[1])
            if pouring and step[0].simulations > 0:
                with_room += 1
                served += any(isinstance(r, Simulate) for r in step[1])
        elif isinstance(step[0], Pour):
            pouring = False
    assert with_room > 30
    assert served > 0.9 * with_room


@pytest.mark.slow
def test_the_next_pour_is_asked_for_with_one_quick_question() -> None:
    """No fit from scratch, no picture, no thousand points, and nothing else first."""
    _, log = played(free(costs=CostSettings(worth=0.0), pours=4, prior_simulations=36), narrow_cup, beside=25)
    followed = 0
    for i, step in enumerate(log.steps[:-1]):
        if not isinstance(step[0], Pour) or step[0].number == 4:
            continue
        requests = log.steps[i + 1][1]
        assert isinstance(requests, list)
        question = next(r for r in requests if isinstance(r, Suggest))
        assert question.purpose == "pour"
        query = question.query
        assert query.effort is not None
        assert query.effort.start
        assert query.effort.iterations <= 4
        assert query.map_resolution == 0
        assert len(query.simulated) <= MOST_SIMULATIONS
        followed += 1
    assert followed == 3
    assert log.strategy.result().map is not None


def test_thinning_keeps_what_is_near_and_covers_the_rest_whatever_it_cost() -> None:
    points = np.random.default_rng(0).random((500, 2))
    data = Data(tuple(map(tuple, points.tolist())), tuple(map(float, range(500))))
    kept = subsampled(data, [(0.2, 0.2)], 100)
    assert len(kept) == 100
    assert kept.points == tuple(p for p in data.points if p in set(kept.points))
    near = sorted(data.points, key=lambda p: math.dist(p, (0.2, 0.2)))[:50]
    assert set(near) <= set(kept.points)
    gaps = np.linalg.norm(points[:, None] - np.array(kept.points)[None], axis=2).min(axis=1)
    assert gaps.max() < 0.15
    other = replace(data, costs=tuple(-c for c in data.costs))
    assert subsampled(other, [(0.2, 0.2)], 100).points == kept.points
    assert subsampled(data, [], 500) == data


# -- again from the journal ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["adaptive", "residual"])
def test_told_the_same_in_the_same_order_it_asks_for_the_same(model: Any) -> None:
    _, log = played(free(3, pours=4, model=model), narrow_cup_biased, narrow_cup, beside=25)
    again = free(3, pours=4, model=model)
    for first, second in log.steps:
        if isinstance(first, Slots):
            assert again.ask(first) == second
        else:
            again.tell(first, second)  # type: ignore[arg-type]
    assert again.finished
    assert again.decisions == log.strategy.decisions
    assert again.result() == log.strategy.result()


def _plan(directory: Path, costs: CostSettings | None = None) -> Any:
    plan = campaign(directory, calibration=None)
    assert plan.deployment is not None
    deployment = plan.deployment.with_settings(
        simulations_per_pour="free", costs=costs or CostSettings(), prior_simulations=8, model="residual"
    )
    return replace(plan, deployment=replace(deployment, scenes=(TOY_SCENE,)))


def _run(directory: Path, pour: float, resume: bool = False) -> Any:
    room = laboratory()
    assert room.bench is not None
    room.bench.pauses = lambda: pour
    room.simulators.pauses = lambda: 0.005
    return asyncio.run(
        run_toy(directory, room, plan=_plan(directory, CostSettings(worth=0.0)), stages=None, resume=resume)
    )


@pytest.mark.parametrize("point", [60, 110])
def test_killed_in_the_middle_of_free_simulations_it_goes_on_from_its_journal(tmp_path: Path, point: int) -> None:
    child = os.fork()
    if child == 0:
        die_at(point, after_commit=True)
        _run(tmp_path / "run", 60.0)
        os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    before = logical_record(tmp_path / "run")
    assert any(entry[2].get("request", {}).get("purpose") == "refine" for entry in before if entry[1] == Kind.REQUESTED)
    assert _run(tmp_path / "run", 0.2, resume=True).state == "finished"
    assert logical_record(tmp_path / "run")[: len(before)] == before
    assert set(finished_times(tmp_path / "run").values()) == {1}
    (found,) = read_record(tmp_path / "run", slots=2).occupancies.values()
    assert found.fraction is not None
    assert 0.0 < found.fraction <= 1.0


# -- how busy it was -------------------------------------------------------------------------------------------------


def test_the_pool_counts_as_busy_by_slots_while_there_is_work() -> None:
    found = Occupancy(slots=2)
    found.simulation_started(0.0)
    found.simulation_started(0.0)
    found.simulation_finished(10.0)  # one of two slots is free for 10 s
    found.pour_started(10.0)
    found.simulation_finished(20.0)
    found.rests(20.0)  # until 50 there is nothing to do
    found.simulation_started(50.0)
    found.simulation_started(50.0)
    found.pour_finished(60.0)
    found.pour_started(60.5)
    found.pour_finished(70.5)
    found.simulation_finished(90.0)
    found.finish()  # what came after the last pour was done for none
    assert found.waits == [0.5]
    assert found.useful == pytest.approx(2 * (20.0 + 20.5))
    assert found.busy == pytest.approx(20.0 + 10.0 + 41.0)
    assert found.total == pytest.approx(2 * 70.5)


def test_a_pause_is_no_wait_of_the_arm() -> None:
    found = Occupancy(slots=1)
    found.pour_started(0.0)
    found.pour_finished(90.0)
    found.interrupted()
    found.pour_started(4000.0)
    found.pour_finished(4090.0)
    found.finish()
    assert found.waits == []
    assert found.total == pytest.approx(180.0)
