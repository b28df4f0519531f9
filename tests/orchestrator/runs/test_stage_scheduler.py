"""`stage_scheduler`: what runs when, in which order strategies hear of it, and what becomes of a run that is paused
or fails.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors import optimizer_actor as optimizer
from actors.interfaces import InvalidActionError, LaboratoryError, PourProgress, SimulationError
from actors.runtime.remote_object import DeviceLostError
from orchestrator.learning.requests import Failed, Pour, Poured, Request, Simulate, Simulated, Slots
from orchestrator.learning.run_errors import RunError
from orchestrator.records.events import CampaignStateChanged, Event, LogLine, PourProgressed, RequestFinished
from orchestrator.runs.request_executor import Deadlines, PourUnknownError, RequestExecutorError
from tests.support.scripted_strategy import Script, one_stage, pour, run, simulate, states
from tests.support.toy_campaign import (
    ToyBench,
    ToyLaboratory,
    ToyOptimizer,
    ToySimulators,
    ToyStrategy,
    answering,
    logical_record,
    run_toy,
    slow_laboratory,
    toy_plan,
)

# -- order -------------------------------------------------------------------------------------------------------------


def test_how_fast_anything_is_changes_nothing_in_logical_order(tmp_path: Path) -> None:
    run(tmp_path / "instant")
    undisturbed = logical_record(tmp_path / "instant")
    for shuffle in range(6):
        directory = tmp_path / str(shuffle)
        run(directory, slow_laboratory(0.006, random.Random(shuffle)))
        assert logical_record(directory) == undisturbed


def finished(events: list[Event]) -> list[type[Any]]:
    return [type(e.request) for e in events if isinstance(e, RequestFinished)]


def test_simulations_go_on_while_the_arm_pours(tmp_path: Path) -> None:
    events: list[Event] = []
    laboratory = ToyLaboratory(ToySimulators(lambda: 0.001), ToyBench(until=lambda: len(finished(events)) == 5))
    strategy = Script(pour(), *(simulate(seed) for seed in range(5)))
    run(tmp_path / "run", laboratory, stages=one_stage(strategy), subscribers=[events.append])
    assert finished(events) == [Simulate] * 5 + [Pour]  # more simulations than slots, all beside one pour
    assert [type(request) for request, _ in strategy.told] == [Simulate] * 5 + [Pour]


def test_never_more_runs_than_there_are_slots(tmp_path: Path) -> None:
    laboratory = slow_laboratory(0.004, random.Random(1))
    run(tmp_path / "run", laboratory, plan=toy_plan(tmp_path, parallel_simulations=3))
    assert laboratory.simulators.most_running == 3


def test_strategies_are_told_what_the_journal_holds(tmp_path: Path) -> None:
    """Lists stay lists in a replay, so a live run must not be told tuples."""
    laboratory = ToyLaboratory()

    async def noted(scene: Any, action: Any, *, seed: int, progress: Any = None, dose: Any = None) -> Any:
        measurement = await ToyBench().pour(scene, action, seed=seed)
        return replace(measurement, notes={"readings": (1.0, 2.0)})

    laboratory.bench.pour = noted  # type: ignore[union-attr, method-assign]
    strategy = Script(pour())
    run(tmp_path / "run", laboratory, stages=one_stage(strategy))
    outcome = strategy.told[0][1]
    assert isinstance(outcome, Poured)
    assert outcome.measurement.notes == {"readings": [1.0, 2.0]}


def test_a_strategy_free_of_the_clock_is_shown_the_same_slots(tmp_path: Path) -> None:
    seen: list[list[Slots]] = []
    for shuffle in (1, 2, 3):
        strategy = ToyStrategy(3)
        run(tmp_path / str(shuffle), slow_laboratory(0.005, random.Random(shuffle)), stages=one_stage(strategy))
        seen.append(strategy.asks)
    assert seen[0] == seen[1] == seen[2]


# -- bad luck ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (InvalidActionError("cups touch at 37 deg"), Failed("invalid_action", "cups touch at 37 deg")),
        (SimulationError("diverged"), Failed("simulation", "diverged")),
        ("0.4 % escaped", Failed("simulation", "0.4 % escaped")),
    ],
)
def test_a_simulation_that_comes_to_nothing_is_told_so(tmp_path: Path, problem: Any, expected: Failed) -> None:
    strategy = Script(simulate(1), simulate(2))
    laboratory = ToyLaboratory(ToySimulators(fails=lambda task: problem if task.seed == 1 else None))
    run(tmp_path / "run", laboratory, stages=one_stage(strategy))
    assert strategy.told[0][1] == expected
    assert isinstance(strategy.told[1][1], Simulated)


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (InvalidActionError("cups touch"), Failed("invalid_action", "cups touch")),
        (LaboratoryError("arm stopped at 40 deg"), Failed("pour_failed", "arm stopped at 40 deg")),
    ],
)
def test_a_pour_that_comes_to_nothing_is_told_so_and_never_retried(
    tmp_path: Path, problem: Exception, expected: Failed
) -> None:
    calls: list[int] = []

    def fails(seed: int) -> Exception | None:
        calls.append(seed)
        return problem

    strategy = Script(pour())
    run(tmp_path / "run", ToyLaboratory(bench=ToyBench(fails=fails)), stages=one_stage(strategy))
    assert strategy.told[0][1] == expected
    assert len(calls) == 1


def test_what_never_answers_is_given_up_at_its_deadline(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(ToySimulators(lambda: 60.0), ToyBench(lambda: 60.0))
    strategy = Script(simulate(1), pour())
    deadlines = Deadlines(simulate=0.05, pour=0.1)
    with pytest.raises(PourUnknownError, match=r"not weighed within 0.1 s.*unknown.*Resuming asks for its outcome"):
        run(tmp_path / "run", laboratory, stages=one_stage(strategy), deadlines=deadlines)
    # A simulation that never ends says nothing; a pour that had begun may have poured anything: that is not an outcome.
    assert [outcome for _, outcome in strategy.told] == [Failed("simulation", "no result within 0.05 s")]
    assert laboratory.simulators.cancelled == 1
    assert laboratory.bench is not None
    assert laboratory.bench.aborted == [101]
    assert states(tmp_path / "run")[-1] == "unknown"
    weighed = Script(simulate(1), pour())
    run(
        tmp_path / "run",
        resume=True,
        stages=one_stage(weighed),
        ask_operator=lambda question, options, facts: "weighed 3.0 1.0",
    )
    assert [type(outcome) for _, outcome in weighed.told] == [Failed, Poured]


def failing(times: int) -> Callable[[], Exception | None]:
    errors = [ConnectionError("actor died")] * times
    return lambda: errors.pop() if errors else None


def test_the_optimiser_may_die_once(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    events: list[Event] = []
    run(tmp_path / "run", ToyLaboratory(optimizer=ToyOptimizer(fails=failing(1))), subscribers=[events.append])
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")
    assert any(isinstance(e, LogLine) and "asked again, for the second time" in e.text for e in events)


def test_an_optimiser_that_hangs_is_replaced_before_the_run_gives_it_up() -> None:
    assert Deadlines().suggest > optimizer.DEADLINE


class Dying:
    """A device whose process dies over every question."""

    name, calls, revived = "optimiser", 0, 0

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        self.calls += 1
        raise DeviceLostError("its process died")

    async def revive(self) -> bool:
        self.revived += 1
        return True

    async def close(self) -> None:
        pass


def test_one_question_is_asked_as_often_as_the_error_says(tmp_path: Path) -> None:
    # The run asked twice and the optimiser thrice each time: six deaths, told as two.
    device, events = Dying(), list[Event]()
    laboratory = ToyLaboratory(optimizer=optimizer.DeviceOptimizer(device))  # type: ignore[arg-type]
    with pytest.raises(
        RequestExecutorError, match=r"asked the same question 3 times and failed each time \(its process died\)"
    ) as raised:
        run(tmp_path / "run", laboratory, subscribers=[events.append])
    reasons = [event.reason for event in events if isinstance(event, CampaignStateChanged)]
    assert reasons[-1] == str(raised.value)  # what the terminal prints: no name of a class before it
    assert (device.calls, device.revived) == (3, 3)
    told = [event.text for event in events if isinstance(event, LogLine) and "asked again" in event.text]
    assert [text[-15:] for text in told] == ["the second time", " the third time"]


def test_an_optimiser_that_keeps_dying_fails_the_run_which_can_be_resumed(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    with pytest.raises(RequestExecutorError, match=r"3 times and failed each time \(ConnectionError: actor died\)"):
        run(tmp_path / "run", ToyLaboratory(optimizer=ToyOptimizer(fails=failing(3))))
    assert states(tmp_path / "run")[-1] == "failed"
    run(tmp_path / "run", resume=True)
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")


def pausing(directory: Path) -> bool:
    return states(directory)[-1] == "pausing"


def test_a_defect_in_the_laboratory_fails_the_run_but_first_the_pour_is_finished(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(
        ToySimulators(fails=lambda task: ZeroDivisionError("a bug")), ToyBench(until=lambda: pausing(tmp_path / "run"))
    )
    with pytest.raises(ZeroDivisionError):
        run(tmp_path / "run", laboratory, stages=one_stage(Script(pour(), simulate(1))))
    assert laboratory.bench is not None
    assert laboratory.bench.poured == [101]
    assert states(tmp_path / "run")[-2:] == ["pausing", "failed"]
    strategy = Script(pour(), simulate(1))
    again = ToyLaboratory()
    run(tmp_path / "run", again, resume=True, stages=one_stage(strategy))
    assert again.bench is not None
    assert again.bench.poured == []  # it was weighed, and is told, not repeated
    assert [type(outcome) for _, outcome in strategy.told] == [Simulated, Poured]


# -- rules of ask and tell ---------------------------------------------------------------------------------------------


class Lazy(Script):
    def ask(self, slots: Slots) -> list[Request]:
        return []


class Greedy(Script):
    def ask(self, slots: Slots) -> list[Request]:
        asked, self.requests = self.requests, []
        return asked


def test_a_strategy_that_stalls_is_found_out(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="strategy stalled in stage only"):
        run(tmp_path / "run", stages=one_stage(Lazy(simulate(1))))
    assert states(tmp_path / "run")[-1] == "failed"


@pytest.mark.parametrize("requests", [[simulate(1), simulate(2), simulate(3)], [pour(1), pour(2)]])
def test_a_strategy_that_asks_for_more_than_there_is_gets_nothing_started(
    tmp_path: Path, requests: list[Request]
) -> None:
    laboratory = ToyLaboratory()
    with pytest.raises(RunError, match="slot"):
        run(tmp_path / "run", laboratory, stages=one_stage(Greedy(*requests)))
    assert laboratory.simulators.tasks == []
    assert laboratory.bench is not None
    assert laboratory.bench.poured == []


def test_an_unknown_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(RequestExecutorError, match="scene 'mug', but the plan has cup"):
        run(tmp_path / "run", stages=one_stage(Script(pour(scene="mug"))))


def test_a_campaign_that_pours_needs_a_bench_and_the_one_it_was_planned_for(tmp_path: Path) -> None:
    with pytest.raises(RequestExecutorError, match="has no bench"):
        run(tmp_path / "none", ToyLaboratory(bench=None))
    with pytest.raises(RequestExecutorError, match="plan is for a virtual bench, but the laboratory's is hardware"):
        run(tmp_path / "other", ToyLaboratory(bench=ToyBench(mode="hardware")))


# -- pausing -----------------------------------------------------------------------------------------------------------


async def interrupt(directory: Path, laboratory: ToyLaboratory, strategy: Script, cancels: int) -> None:
    """Cancel a run once its pour has begun, `cancels` times."""
    begun = asyncio.Event()

    def watch(event: Event) -> None:
        if isinstance(event, PourProgressed):
            begun.set()

    task = asyncio.create_task(run_toy(directory, laboratory, stages=one_stage(strategy), subscribers=[watch]))
    await begun.wait()
    for _ in range(cancels):
        await asyncio.sleep(0.01)  # several cancellations, and not one
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert task.cancelled()
    assert laboratory.opened == 0


def script() -> Script:
    return Script(pour(), simulate(1), simulate(2))


def test_pausing_finishes_the_pour_and_drops_simulations(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(ToySimulators(lambda: 60.0), ToyBench(until=lambda: pausing(tmp_path / "run")))
    asyncio.run(interrupt(tmp_path / "run", laboratory, script(), cancels=1))
    assert laboratory.bench is not None
    assert laboratory.bench.poured == [101]
    assert laboratory.simulators.cancelled == 2
    assert states(tmp_path / "run")[-2:] == ["pausing", "paused"]
    again = ToyLaboratory()
    strategy = script()
    assert run(tmp_path / "run", again, resume=True, stages=one_stage(strategy)).state == "finished"
    assert again.bench is not None
    assert again.bench.poured == []
    assert [request.seed for request, _ in strategy.told if isinstance(request, Simulate)] == [1, 2]


def test_asked_twice_it_stops_at_once_and_the_pour_is_unknown(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(bench=ToyBench(lambda: 60.0))
    asyncio.run(interrupt(tmp_path / "run", laboratory, script(), cancels=2))
    assert laboratory.bench is not None
    assert laboratory.bench.aborted == [101]
    assert states(tmp_path / "run")[-3:] == ["pausing", "stopping", "unknown"]
    strategy = script()
    run(tmp_path / "run", resume=True, stages=one_stage(strategy), ask_operator=answering("lost"))
    assert strategy.told[-1][1] == Failed("pour_unknown", "declared lost by the operator")


def test_a_bench_that_calls_its_own_abortion_a_failure_does_not_make_it_known(tmp_path: Path) -> None:
    laboratory = ToyLaboratory()

    async def sulk(scene: Any, action: Any, *, seed: int, progress: Any = None, dose: Any = None) -> Any:
        progress(PourProgress("tilt", 0.0))
        try:
            await asyncio.sleep(60)  # it is cancelled here
        except asyncio.CancelledError:
            raise LaboratoryError("arm stopped") from None

    laboratory.bench.pour = sulk  # type: ignore[union-attr, method-assign]
    asyncio.run(interrupt(tmp_path / "run", laboratory, script(), cancels=2))
    assert states(tmp_path / "run")[-1] == "unknown"


def test_a_pour_that_does_not_end_in_its_grace_is_unknown(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(ToySimulators(fails=lambda task: KeyError("bug")), ToyBench(lambda: 60.0))
    with pytest.raises(KeyError):
        run(
            tmp_path / "run",
            laboratory,
            stages=one_stage(Script(pour(), simulate(1))),
            deadlines=Deadlines(pour_grace=0.05),
        )
    assert states(tmp_path / "run")[-1] == "unknown"
