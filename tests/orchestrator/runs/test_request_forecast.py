"""`request_forecast`: while the arm pours, the pool makes what later stages will ask for; what is decided stays the
same.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import pytest

from orchestrator.learning.requests import Failed, Outcome, Pour, Simulate
from orchestrator.records.events import Event, RequestFinished, StageClosed
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.runs.request_executor import Deadlines, RequestExecutor, SpeculativeExecution
from orchestrator.runs.stages import CALIBRATION, EVALUATION, POURS, StageDefinition
from sim_engine.scene import PourTask
from tests.orchestrator.runs.test_stages import Optimizer, calibration, campaign
from tests.support.scripted_strategy import Script, pour, simulate
from tests.support.toy_campaign import ToyBench, ToyLaboratory, ToySimulators, logical_record, run_toy


def laboratory(*, separate: bool, pour: float = 0.05) -> ToyLaboratory:
    simulators = ToySimulators(lambda: 0.002, separate=separate)
    return ToyLaboratory(simulators, ToyBench(lambda: pour), Optimizer())  # type: ignore[arg-type]


def run(directory: Path, laboratory: ToyLaboratory, **arguments: Any) -> None:
    arguments.setdefault("plan", campaign(directory))
    asyncio.run(run_toy(directory, laboratory, stages=None, **arguments))


@pytest.mark.slow
def test_nothing_that_is_decided_depends_on_what_was_made_beforehand(tmp_path: Path) -> None:
    run(tmp_path / "one after the other", laboratory(separate=False))
    run(tmp_path / "ahead", laboratory(separate=True))
    run(tmp_path / "no time for it", laboratory(separate=True, pour=0.0))
    record = logical_record(tmp_path / "one after the other")
    assert logical_record(tmp_path / "ahead") == record
    assert logical_record(tmp_path / "no time for it") == record


def test_first_simulations_and_rivals_are_there_when_the_calibration_pours_are_made(tmp_path: Path) -> None:
    bench = laboratory(separate=True)
    made: dict[str, int] = {}

    def watch(event: Event) -> None:
        if isinstance(event, StageClosed):
            made[event.stage] = len(bench.simulators.tasks)

    run(tmp_path / "run", bench, subscribers=[watch])
    # 4 places of the initial design; 3 random θ on 1 test pour; the uncalibrated θ on all 5
    assert made[POURS] == 4 + 3 + 5
    # of 5 simulations the last one is left, and the 1st, 2nd and 4th are made anew: they keep their frames
    assert made[CALIBRATION] - made[POURS] == 1 + 3
    # θ* on all pours, those with frames among them; five draws of θ on the test pour; the 8th, of a rival, keeps frames
    assert made[EVALUATION] - made[CALIBRATION] == 5 + 5 + 1
    with JournalReader(tmp_path / "run" / JOURNAL_NAME) as journal:
        notes = [entry.body["text"] for entry in journal.entries(kinds=[Kind.NOTE])]
    assert any("were made while the arm was pouring" in note for note in notes)


def test_the_first_simulations_of_an_automatic_calibration_are_made_while_the_arm_pours(tmp_path: Path) -> None:
    bench = laboratory(separate=True, pour=0.2)
    made: dict[str, int] = {}

    def watch(event: Event) -> None:
        if isinstance(event, StageClosed):
            made[event.stage] = len(bench.simulators.tasks)

    plan = campaign(tmp_path, calibration=calibration(simulations="auto", random_baseline=0), deployment=None)
    run(tmp_path / "run", bench, plan=plan, subscribers=[watch])
    # the uncalibrated θ and 10 others for each of two searched parameters, on the 4 training pours
    assert made[POURS] >= 4 * (1 + 10 * 2)


def test_the_next_receivers_prior_is_made_beside_this_ones_pours(tmp_path: Path) -> None:
    bench = laboratory(separate=True, pour=0.2)
    events: list[Event] = []
    made: list[PourTask] = []

    def watch(event: Event) -> None:
        events.append(event)
        if isinstance(event, StageClosed) and event.stage == "deployment:cup":
            made.extend(bench.simulators.tasks)

    run(tmp_path / "run", bench, plan=campaign(tmp_path, calibration=None), subscribers=[watch])
    first, second = (
        [e for e in events if isinstance(e, RequestFinished) and e.stage == stage]
        for stage in ("deployment:cup", "deployment:narrow")
    )
    assert any(isinstance(event.request, Pour) for event in first)
    prior = [event for event in second if isinstance(event.request, Simulate) and event.request.purpose == "prior"]
    seeds = {event.request.seed for event in prior if isinstance(event.request, Simulate)}
    ahead = [task for task in made if task.scene.name == "narrow" and task.seed in seeds]
    assert len(ahead) >= len(prior) - 2 > 0  # those with frames are made when they are asked for
    again = [task for task in bench.simulators.tasks[len(made) :] if task in ahead]
    assert not again, "what was made ahead is not made twice"


async def test_a_run_stays_alive_while_a_later_stage_is_built(tmp_path: Path) -> None:
    loop, answered = asyncio.get_running_loop(), []

    def build(results: Any, seed: int) -> Script:
        turn = asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop)
        with contextlib.suppress(TimeoutError):
            turn.result(10.0)  # of the run's loop, as a signal or a question has one
        answered.append(turn.done())
        return Script(simulate(1))

    bench = ToyBench(until=lambda: bool(answered))
    toy = ToyLaboratory(ToySimulators(separate=True), bench)
    first = StageDefinition("first", lambda results, seed: Script(pour(1)), pours=True)
    await run_toy(tmp_path, toy, stages=(first, StageDefinition("second", build)))
    assert answered == [True, True], "while the arm pours, and when the stage begins"


async def test_what_was_foreseen_makes_room_for_what_is_asked_for() -> None:
    given_up: list[int] = []
    begun: list[int] = []

    async def work(request: Simulate) -> Outcome:
        begun.append(request.seed)
        try:
            await asyncio.sleep(3600.0)  # it is cancelled here
        except asyncio.CancelledError:
            given_up.append(request.seed)
            raise
        raise AssertionError

    ahead = SpeculativeExecution(work, width=2)
    for seed in (1, 2, 3):
        ahead.predict(simulate(seed))
    await asyncio.sleep(0)
    assert begun == [1, 2]
    with ahead.asked_for():
        await asyncio.sleep(0.01)  # turns of the event loop, for what was started or cancelled
        assert given_up == [2]
        with ahead.asked_for():
            await asyncio.sleep(0.01)  # turns of the event loop, for what was started or cancelled
            assert given_up == [2, 1]
    await asyncio.sleep(0.01)  # turns of the event loop, for what was started or cancelled
    assert begun == [1, 2, 1, 2], "made anew when there is room"
    await ahead.close()
    assert given_up == [2, 1, 1, 2]


@pytest.mark.parametrize(("processors", "at_once"), [(3, 2), (2, 2), (4, 3), (None, 2), (8, 3)])
async def test_a_pool_of_all_processors_leaves_one_to_the_drivers(
    monkeypatch: pytest.MonkeyPatch, processors: int | None, at_once: int
) -> None:
    """Otherwise the arm's driver misses its deadlines on a machine with as many simulators as processors."""
    monkeypatch.setattr("os.cpu_count", lambda: processors)
    seen = [0]
    bench = laboratory(separate=True)
    bench.simulators.size = 3
    ahead = RequestExecutor(bench, {}, Deadlines(), 0.0).speculation
    ahead.changed = lambda running, waiting: seen.append(running)
    for seed in range(5):
        ahead.predict(simulate(seed))
    await ahead.close()
    assert max(seen) == at_once


async def test_one_that_is_being_made_is_waited_for_and_not_made_twice() -> None:
    begun: list[int] = []

    async def work(request: Simulate) -> Outcome:
        begun.append(request.seed)
        await asyncio.sleep(0.01)  # turns of the event loop, for what was started or cancelled
        return Failed("invalid_action", "cups touch")

    ahead = SpeculativeExecution(work, width=1)
    ahead.predict(simulate(1))
    assert ahead.knows(simulate(1))
    assert await ahead.take(simulate(1)) == Failed("invalid_action", "cups touch")
    assert begun == [1]
    assert not ahead.knows(simulate(1)), "an outcome is handed out once"


@pytest.mark.parametrize("outcome", [Failed("simulation", "its worker died"), RuntimeError("a defect")])
async def test_bad_luck_is_not_kept(outcome: Outcome | Exception) -> None:
    async def work(request: Simulate) -> Outcome:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    ahead = SpeculativeExecution(work, width=1)
    ahead.predict(simulate(1))
    await asyncio.sleep(0.01)  # turns of the event loop, for what was started or cancelled
    assert not ahead.knows(simulate(1))
    ahead.predict(simulate(2))
    assert await ahead.take(simulate(2)) is None


@pytest.mark.slow
def test_a_simulator_that_dies_over_a_foreseen_task_costs_nothing(tmp_path: Path) -> None:
    failing = laboratory(separate=True)

    def dies(task: PourTask) -> Exception | None:
        return RuntimeError("out of memory") if failing.bench is not None and len(failing.bench.poured) < 5 else None

    failing.simulators.fails = dies
    run(tmp_path / "dies", failing)
    run(tmp_path / "plain", laboratory(separate=False))
    assert logical_record(tmp_path / "dies") == logical_record(tmp_path / "plain")
