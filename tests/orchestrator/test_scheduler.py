"""What runs when, in which order strategies hear of it, and what becomes of a run that is paused or fails."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.protocols import Frames, InvalidActionError, LaboratoryError, SimulationError
from orchestrator.errors import RunError
from orchestrator.events import (
    CampaignClosed,
    DecisionMade,
    Event,
    LogLine,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StageClosed,
)
from orchestrator.flights import is_recorded
from orchestrator.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.lanes import Deadlines, LaneError
from orchestrator.requests import Failed, Outcome, Pour, Poured, Request, Simulate, Simulated, Slots
from orchestrator.scheduler import StrategyError
from orchestrator.stages import StageDefinition, stage_seed
from orchestrator.states import RESTING, TRANSITIONS, State, TransitionError, check_transition
from sim_engine.task import PourTask
from tests.orchestrator.toy import (
    SCENE,
    SPACE,
    THETA,
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
    toy_stages,
)


def run(directory: Path, laboratory: ToyLaboratory | None = None, **arguments: Any) -> Any:
    return asyncio.run(run_toy(directory, laboratory, **arguments))


def states(directory: Path) -> list[str]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        entries = [entry.body for entry in journal.entries(kinds=[Kind.CAMPAIGN_STATE])]
    for body in entries:
        check_transition(State(body["before"]), State(body["after"]))
    return [body["after"] for body in entries]


def one_stage(strategy: Any, order: Any = "logical") -> tuple[StageDefinition, ...]:
    return (StageDefinition("only", lambda results, seed: strategy, order=order, pours=True),)


class Script:
    """Asks for fixed requests as far as slots allow and remembers what it was told."""

    def __init__(self, *requests: Request) -> None:
        self.requests = list(requests)
        self.told: list[tuple[Request, Outcome]] = []
        self.count = len(requests)
        self.decisions: list[Any] = []

    @property
    def finished(self) -> bool:
        return len(self.told) == self.count

    def ask(self, slots: Slots) -> list[Request]:
        left = {Simulate: slots.simulations, Pour: slots.pours}
        asked = []
        while self.requests and left.get(type(self.requests[0]), 1) > 0:
            request = self.requests.pop(0)
            left[type(request)] = left.get(type(request), 1) - 1
            asked.append(request)
        return asked

    def tell(self, request: Request, outcome: Outcome) -> None:
        self.told.append((request, outcome))

    def progress(self) -> tuple[int, int]:
        return len(self.told), self.count

    def result(self) -> dict[str, object]:
        return {"told": [type(outcome).__name__ for _, outcome in self.told]}


def simulate(seed: int) -> Simulate:
    return Simulate("cup", SCENE.action(SPACE.decode([0.5, 0.5])), THETA, seed)


def pour(number: int = 1, scene: str = "cup") -> Pour:
    return Pour(scene, SCENE.action(SPACE.decode([0.5, 0.5])), number, seed=100 + number)


# -- order -------------------------------------------------------------------------------------------------------------


def test_how_fast_anything_is_changes_nothing_in_logical_order(tmp_path: Path) -> None:
    run(tmp_path / "instant")
    undisturbed = logical_record(tmp_path / "instant")
    for shuffle in range(6):
        directory = tmp_path / str(shuffle)
        run(directory, slow_laboratory(0.006, random.Random(shuffle)))
        assert logical_record(directory) == undisturbed


def test_simulations_go_on_while_the_arm_pours(tmp_path: Path) -> None:
    events: list[Event] = []
    laboratory = ToyLaboratory(ToySimulators(lambda: 0.001), ToyBench(lambda: 0.1))
    strategy = Script(pour(), *(simulate(seed) for seed in range(5)))
    run(tmp_path / "run", laboratory, stages=one_stage(strategy), watchers=[events.append])
    finished = [type(e.request) for e in events if isinstance(e, RequestFinished)]
    assert finished == [Simulate] * 5 + [Pour]  # more simulations than slots, all beside one pour
    assert [type(request) for request, _ in strategy.told] == [Simulate] * 5 + [Pour]


def test_never_more_runs_than_there_are_slots(tmp_path: Path) -> None:
    laboratory = slow_laboratory(0.004, random.Random(1))
    run(tmp_path / "run", laboratory, plan=toy_plan(tmp_path, parallel_simulations=3))
    assert laboratory.simulators.most_running == 3


def test_completion_order_tells_what_comes_first(tmp_path: Path) -> None:
    waits = {0: 0.08, 1: 0.01}
    laboratory = ToyLaboratory(ToySimulators())

    async def paced(task: PourTask) -> Any:
        await asyncio.sleep(waits[task.seed])
        return await ToySimulators().simulate(task)

    laboratory.simulators.simulate = paced  # type: ignore[method-assign]
    for order, expected in (("completion", [1, 0]), ("logical", [0, 1])):
        strategy = Script(simulate(0), simulate(1))
        run(tmp_path / order, laboratory, stages=one_stage(strategy, order))
        assert [request.seed for request, _ in strategy.told if isinstance(request, Simulate)] == expected


def test_strategies_are_told_what_the_journal_holds(tmp_path: Path) -> None:
    """Lists stay lists in a replay, so a live run must not be told tuples."""
    laboratory = ToyLaboratory()

    async def noted(scene: Any, action: Any, *, seed: int, progress: Any = None) -> Any:
        measurement = await ToyBench().pour(scene, action, seed=seed)
        return replace(measurement, notes={"readings": (1.0, 2.0)})

    laboratory.bench.pour = noted  # type: ignore[union-attr, method-assign]
    strategy = Script(pour())
    run(tmp_path / "run", laboratory, stages=one_stage(strategy))
    outcome = strategy.told[0][1]
    assert isinstance(outcome, Poured)
    assert outcome.measurement.notes == {"readings": [1.0, 2.0]}


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
    run(tmp_path / "run", laboratory, stages=one_stage(strategy), deadlines=deadlines)
    assert [outcome for _, outcome in strategy.told] == [
        Failed("simulation", "no result within 0.05 s"),
        Failed("pour_failed", "not weighed within 0.1 s"),
    ]
    assert laboratory.simulators.cancelled == 1


def failing(times: int) -> Callable[[], Exception | None]:
    errors = [ConnectionError("actor died")] * times
    return lambda: errors.pop() if errors else None


def test_the_optimiser_may_die_once(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    events: list[Event] = []
    run(tmp_path / "run", ToyLaboratory(optimizer=ToyOptimizer(fails=failing(1))), watchers=[events.append])
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")
    assert any(isinstance(e, LogLine) and "asked once more" in e.text for e in events)


def test_an_optimiser_that_dies_twice_fails_the_run_which_can_be_resumed(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    with pytest.raises(LaneError, match=r"twice on the same question \(ConnectionError: actor died\)"):
        run(tmp_path / "run", ToyLaboratory(optimizer=ToyOptimizer(fails=failing(2))))
    assert states(tmp_path / "run")[-1] == "failed"
    run(tmp_path / "run", resume=True)
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")


def test_a_defect_in_the_laboratory_fails_the_run_but_first_the_pour_is_finished(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(ToySimulators(fails=lambda task: ZeroDivisionError("a bug")), ToyBench(lambda: 0.05))
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
    with pytest.raises(StrategyError, match="strategy stalled in stage only"):
        run(tmp_path / "run", stages=one_stage(Lazy(simulate(1))))
    assert states(tmp_path / "run")[-1] == "failed"


@pytest.mark.parametrize("requests", [[simulate(1), simulate(2), simulate(3)], [pour(1), pour(2)]])
def test_a_strategy_that_asks_for_more_than_there_is_gets_nothing_started(
    tmp_path: Path, requests: list[Request]
) -> None:
    laboratory = ToyLaboratory()
    with pytest.raises(StrategyError, match="slot"):
        run(tmp_path / "run", laboratory, stages=one_stage(Greedy(*requests)))
    assert laboratory.simulators.tasks == []
    assert laboratory.bench is not None
    assert laboratory.bench.poured == []


def test_an_unknown_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(LaneError, match="scene 'mug', but the plan has cup"):
        run(tmp_path / "run", stages=one_stage(Script(pour(scene="mug"))))


def test_a_campaign_that_pours_needs_a_bench_and_the_one_it_was_planned_for(tmp_path: Path) -> None:
    with pytest.raises(LaneError, match="has no bench"):
        run(tmp_path / "none", ToyLaboratory(bench=None))
    with pytest.raises(LaneError, match="plan is for a virtual bench, but the laboratory's is hardware"):
        run(tmp_path / "other", ToyLaboratory(bench=ToyBench(mode="hardware")))


# -- pausing -----------------------------------------------------------------------------------------------------------


async def interrupt(directory: Path, laboratory: ToyLaboratory, strategy: Script, cancels: int) -> None:
    """Cancel a run once its pour has begun, `cancels` times."""
    begun = asyncio.Event()

    def watch(event: Event) -> None:
        if isinstance(event, PourProgressed):
            begun.set()

    task = asyncio.create_task(run_toy(directory, laboratory, stages=one_stage(strategy), watchers=[watch]))
    await begun.wait()
    for _ in range(cancels):
        await asyncio.sleep(0.01)
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert task.cancelled()
    assert laboratory.opened == 0


def script() -> Script:
    return Script(pour(), simulate(1), simulate(2))


def test_pausing_finishes_the_pour_and_drops_simulations(tmp_path: Path) -> None:
    laboratory = ToyLaboratory(ToySimulators(lambda: 60.0), ToyBench(lambda: 0.2))
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

    async def sulk(scene: Any, action: Any, *, seed: int, progress: Any = None) -> Any:
        progress(None)
        try:
            await asyncio.sleep(60)
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


# -- watchers ----------------------------------------------------------------------------------------------------------


def test_a_watcher_that_raises_is_reported_once_and_changes_nothing(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    events: list[Event] = []
    calls: list[Event] = []

    def broken(event: Event) -> None:
        calls.append(event)
        raise OSError("disk full")

    run(tmp_path / "run", watchers=[broken, events.append])
    assert len(calls) == 1
    complaints = [e for e in events if isinstance(e, LogLine) and "broken can't watch any longer: OSError" in e.text]
    assert len(complaints) == 1
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")


def test_watchers_see_the_whole_run(tmp_path: Path) -> None:
    events: list[Event] = []
    result = run(tmp_path / "run", watchers=[events.append])
    started = {e.id: e.request for e in events if isinstance(e, RequestStarted)}
    finished = {e.id: e.request for e in events if isinstance(e, RequestFinished)}
    assert started == finished
    assert len([r for r in finished.values() if isinstance(r, Pour)]) == result.pours == 6
    assert len([r for r in finished.values() if isinstance(r, Simulate)]) == result.simulations
    assert {e.stage: e.result for e in events if isinstance(e, StageClosed)} == result.results
    assert any(isinstance(e, DecisionMade) for e in events)
    assert isinstance(events[-1], CampaignClosed)
    assert events[-1].state == "finished"


def test_recorded_simulations_bring_frames_and_the_same_outcomes(tmp_path: Path) -> None:
    def recording(laboratory: ToyLaboratory) -> ToyLaboratory:
        plain = laboratory.simulators.simulate

        async def with_frames(task: PourTask) -> Any:
            result = await plain(task)
            return replace(result, frames=Frames([0.0], [], [], []) if task.record_rate > 0 else None)

        laboratory.simulators.simulate = with_frames  # type: ignore[method-assign]
        return laboratory

    events: list[Event] = []
    run(tmp_path / "run", recording(ToyLaboratory()), watchers=[events.append])
    for stage in ("first", "second"):
        done = [e for e in events if isinstance(e, RequestFinished) and e.stage == stage]
        simulated = sorted((e.id, e.frames is not None) for e in done if isinstance(e.request, Simulate))
        assert [number for number, (_, framed) in enumerate(simulated, start=1) if framed] == [1, 2]
    plan = toy_plan(tmp_path)
    silent = replace(plan, outputs=replace(plan.outputs, record_rate=0.0))
    laboratory = ToyLaboratory()
    run(tmp_path / "silent", laboratory, plan=silent)
    assert all(task.record_rate == 0.0 for task in laboratory.simulators.tasks)
    assert logical_record(tmp_path / "silent") == logical_record(tmp_path / "run")


def test_recordings_spread_over_a_stage() -> None:
    assert [n for n in range(1, 200) if is_recorded(n, 6)] == [1, 2, 4, 8, 16, 32]
    assert not any(is_recorded(n, 0) for n in range(200))


# -- states and seeds --------------------------------------------------------------------------------------------------


def test_an_undisturbed_run_goes_the_straight_way(tmp_path: Path) -> None:
    run(tmp_path / "run")
    assert states(tmp_path / "run") == ["preparing", "running", "finished"]


def test_the_state_table_has_no_dead_ends_but_the_end() -> None:
    assert set(TRANSITIONS) == set(State)
    assert {state for state, ways in TRANSITIONS.items() if not ways} == {State.FINISHED}
    for state in RESTING - {State.FINISHED}:
        assert TRANSITIONS[state] == {State.PREPARING}
    with pytest.raises(TransitionError, match="can't go from finished to running"):
        check_transition(State.FINISHED, State.RUNNING)


def test_a_finished_run_is_not_run_again(tmp_path: Path) -> None:
    first = run(tmp_path / "run")
    laboratory = ToyLaboratory()
    again = run(tmp_path / "run", laboratory, resume=True)
    assert again.results == first.results
    assert laboratory.simulators.tasks == []


def test_stage_seeds_are_the_same_on_every_machine_and_differ_between_stages() -> None:
    assert stage_seed(7, "calibration") == 38555389313445059
    assert len({stage_seed(seed, name) for seed in range(20) for name in ("pours", "calibration", "evaluation")}) == 60


def test_two_stages_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="stages with different names"):
        run(tmp_path / "run", stages=[toy_stages()[0]] * 2)


def test_a_strategy_free_of_the_clock_is_shown_the_same_slots(tmp_path: Path) -> None:
    seen: list[list[Slots]] = []
    for shuffle in (1, 2, 3):
        strategy = ToyStrategy(3)
        run(tmp_path / str(shuffle), slow_laboratory(0.005, random.Random(shuffle)), stages=one_stage(strategy))
        seen.append(strategy.asks)
    assert seen[0] == seen[1] == seen[2]
