"""A run that was killed anywhere goes on as if nothing had happened: same requests, same outcomes, nothing twice."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.spec import LaboratorySpec
from orchestrator.codec import decode_outcome, encode_outcome
from orchestrator.errors import RunError
from orchestrator.events import Event, RequestFinished, StageClosed
from orchestrator.journal import JOURNAL_NAME, Journal, JournalError, JournalLockedError, JournalReader, Kind
from orchestrator.replay import ReplayError
from orchestrator.requests import Failed, Poured
from orchestrator.runs import RunNotFoundError, create_run, find_run
from orchestrator.stages import StageDefinition
from orchestrator.unknown import LOST, REPEAT, WEIGHED, OperatorNeededError, parse_answer
from tests.orchestrator import toy
from tests.orchestrator.toy import ToyLaboratory, ToyStrategy, answering, logical_record, run_toy, toy_plan, toy_stages

SMALL = toy_stages(simulations=3, pours=2, beside=2)


def run(directory: Path, laboratory: ToyLaboratory | None = None, **arguments: Any) -> Any:
    arguments.setdefault("stages", SMALL)
    arguments.setdefault("plan", toy_plan(directory, on_unknown="repeat"))
    return asyncio.run(run_toy(directory, laboratory, **arguments))


def killed_at(point: int, *, after_commit: bool, directory: Path, resume: bool = False) -> bool:
    """Run in a child process that SIGKILLs itself at its `point`-th write; True if it got that far.

    The child is forked, because starting a hundred interpreters would take minutes.
    """
    child = os.fork()
    if child == 0:
        try:
            _die_at(point, after_commit)
            run(directory, resume=resume)
            os._exit(0)
        except BaseException:
            import traceback

            traceback.print_exc()
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the child failed in another way than planned"
    return os.WIFSIGNALED(status)


def _die_at(point: int, after_commit: bool) -> None:
    write, count = Journal.append_all, 0

    def dying(self: Journal, drafts: Any) -> None:
        nonlocal count
        count += 1
        if count == point and not after_commit:
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, drafts)
        if count == point:
            os.kill(os.getpid(), signal.SIGKILL)

    Journal.append_all = dying  # type: ignore[method-assign]


def killed_when_last(kind: Kind, parent: Path, earliest: int = 10) -> Path:
    """Directory of a run that died right after an entry of that kind was written."""
    for point in range(earliest, 100):
        directory = parent / f"point-{point}"
        assert killed_at(point, after_commit=True, directory=directory)
        with JournalReader(directory / JOURNAL_NAME) as journal:
            *_, last = journal.entries()
        simulated = kind is not Kind.FINISHED or last.body.get("outcome", {}).get("type") == "Simulated"
        if last.kind == kind and simulated:
            return directory
    raise AssertionError(f"no run ended in {kind}")


def finished_times(directory: Path) -> Counter[int]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        kinds = [Kind.FINISHED, Kind.POUR_FINISHED]
        return Counter(entry.body["id"] for entry in journal.entries(kinds=kinds))


@pytest.mark.parametrize("after_commit", [False, True], ids=["before the write", "after the write"])
def test_killed_at_any_point_it_makes_the_requests_it_would_have_made(tmp_path: Path, after_commit: bool) -> None:
    run(tmp_path / "undisturbed")
    expected = logical_record(tmp_path / "undisturbed")
    point = 0
    while True:
        point += 1
        directory = tmp_path / str(point)
        if not killed_at(point, after_commit=after_commit, directory=directory):
            break
        assert run(directory, resume=True).state == "finished"
        assert logical_record(directory) == expected, f"killed at write {point}"
        assert set(finished_times(directory).values()) == {1}, f"killed at write {point}, something was done twice"
    assert point > 60


def test_killed_again_and_again_it_still_gets_there(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    rng, directory = random.Random(5), tmp_path / "run"
    lives, alive = 1, killed_at(9, after_commit=True, directory=directory)
    while alive:
        lives += 1
        alive = killed_at(rng.randint(4, 14), after_commit=bool(rng.getrandbits(1)), directory=directory, resume=True)
    assert lives > 8
    assert logical_record(directory) == logical_record(tmp_path / "undisturbed")
    assert set(finished_times(directory).values()) == {1}


def process(directory: Path, *arguments: str) -> subprocess.Popen[str]:
    # Beside the file stands no package that its imports could find, so the root is named.
    root = Path(__file__).parents[2]
    return subprocess.Popen(
        [sys.executable, str(Path(toy.__file__)), str(directory), *arguments],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )


def entries_written(directory: Path) -> int:
    try:
        with JournalReader(directory / JOURNAL_NAME) as journal:
            return sum(1 for _ in journal.entries())
    except JournalError:
        return 0


def killed_hanging(simulations: int, directory: Path) -> None:
    """Run the toy in a process of its own; when all its simulators hang after so many simulations, kill it."""
    child = process(directory, "--slow", "0.005", "--hang-after", str(simulations))
    before, now = -1, 0
    while now < 10 or now != before:
        assert child.poll() is None, child.stderr.read() if child.stderr else ""
        time.sleep(0.15)
        before, now = now, entries_written(directory)
    child.send_signal(signal.SIGKILL)
    child.communicate()


def test_killed_from_outside_with_everything_under_way_it_goes_on_in_another_process(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed", stages=toy_stages())
    for simulations in (2, 20):
        directory = tmp_path / str(simulations)
        killed_hanging(simulations, directory)
        before = entries_written(directory)
        resumed = process(directory, "--resume", "--on-unknown", "repeat", "--slow", "0.002")
        _, complaints = resumed.communicate(timeout=100)
        assert resumed.returncode == 0, complaints
        assert entries_written(directory) > before
        assert logical_record(directory) == logical_record(tmp_path / "undisturbed")


def test_two_processes_can_not_run_one_campaign(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    first = process(directory, "--slow", "5")
    try:
        while entries_written(directory) < 4:
            assert first.poll() is None, first.stderr.read() if first.stderr else ""
            time.sleep(0.01)
        before = entries_written(directory)
        second = process(directory, "--resume")
        _, complaints = second.communicate(timeout=60)
        assert second.returncode != 0
        assert f"process {first.pid} is running this campaign" in complaints
        with pytest.raises(JournalLockedError, match=str(first.pid)):
            run(directory, resume=True, stages=toy_stages())
        assert entries_written(directory) >= before
    finally:
        first.kill()
        first.communicate()


@pytest.mark.parametrize("last", [Kind.FINISHED, Kind.POUR_FINISHED])
def test_what_is_finished_is_told_and_not_done_again(tmp_path: Path, last: Kind) -> None:
    directory = killed_when_last(last, tmp_path)
    with JournalReader(directory / JOURNAL_NAME) as journal:
        requests = {e.body["id"]: e.body["request"] for e in journal.entries(kinds=[Kind.REQUESTED])}
    done = {requests[key]["seed"] for key in finished_times(directory) if "seed" in requests[key]}
    laboratory = ToyLaboratory()
    run(directory, laboratory, resume=True)
    assert laboratory.bench is not None
    repeated = {task.seed for task in laboratory.simulators.tasks} | set(laboratory.bench.poured)
    assert done
    assert not repeated & done


def test_a_resumed_run_shows_watchers_what_went_before(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    assert killed_at(60, after_commit=True, directory=directory)
    events: list[Event] = []
    result = run(directory, resume=True, watchers=[events.append])
    replayed = [e for e in events if isinstance(e, RequestFinished) and e.replayed]
    assert replayed
    with JournalReader(directory / JOURNAL_NAME) as journal:
        began = journal.header.created
    assert all(began <= e.time < time.time() for e in replayed)
    assert {e.stage: e.result for e in events if isinstance(e, StageClosed)} == result.results


def test_completion_order_is_replayed_exactly(tmp_path: Path) -> None:
    """Where the clock decides, only the journal knows; what it holds comes back to the letter."""
    free = tuple(replace(stage, order="completion") for stage in toy_stages())
    for entries in (40, 120):
        directory = tmp_path / str(entries)
        laboratory = toy.slow_laboratory(0.01, random.Random(entries))
        written: list[Any] = []

        def stop(event: Event, directory: Path = directory, limit: int = entries, written: Any = written) -> None:
            if entries_written(directory) > limit and not written:
                written.append(True)
                for task in asyncio.all_tasks():
                    if task.get_coro().__name__ == "run_toy":  # type: ignore[union-attr]
                        task.cancel()

        with pytest.raises(asyncio.CancelledError):
            run(directory, laboratory, stages=free, watchers=[stop])
        before = logical_record(directory)
        run(directory, toy.slow_laboratory(0.01), stages=free, resume=True)
        assert logical_record(directory)[: len(before)] == before
        assert set(finished_times(directory).values()) == {1}


# -- what must not be resumed ------------------------------------------------------------------------------------------


class Changed(ToyStrategy):
    """The same strategy after somebody has 'improved' it."""

    def ask(self, slots: Any) -> list[Any]:
        return [replace(r, seed=r.seed + 1) if hasattr(r, "scene") and r.seed else r for r in super().ask(slots)]


def test_a_strategy_that_has_changed_is_found_out_at_its_first_other_request(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    assert killed_at(30, after_commit=True, directory=directory)
    changed = (
        StageDefinition("first", lambda results, seed: Changed(seed, simulations=3, pours=2, beside=2), pours=True),
        SMALL[1],
    )
    with pytest.raises(ReplayError, match=r"stage first: request 2 differs from the journal's at seed: \d+ became \d+"):
        run(directory, resume=True, stages=changed)
    assert run(directory, resume=True).state == "finished"  # nothing was lost by trying


def test_other_settings_can_not_continue_a_run_but_the_machine_may_be_another(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    assert killed_at(30, after_commit=True, directory=directory)
    plan = toy_plan(directory, on_unknown="repeat")
    with pytest.raises(JournalError, match="seed: 7 became 8"):
        run(directory, resume=True, plan=replace(plan, seed=8))
    larger = replace(plan, laboratory=LaboratorySpec("toy", simulators=64), source=tmp_path / "moved.yaml")
    assert run(directory, resume=True, plan=larger).state == "finished"


def test_a_new_run_never_writes_over_an_old_one(tmp_path: Path) -> None:
    run(tmp_path / "run")
    before = logical_record(tmp_path / "run")
    with pytest.raises(JournalError, match="holds a run already"):
        run(tmp_path / "run")
    assert logical_record(tmp_path / "run") == before


# -- unknown pours -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unknown(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Path]:
    """Directories of runs that died while a pour was under way."""

    def make() -> Path:
        return killed_when_last(Kind.POUR_STARTED, tmp_path_factory.mktemp("unknown"))

    return make


def asking(directory: Path, **changes: Any) -> Any:
    return toy_plan(directory, on_unknown="ask", **changes)


def test_an_unknown_pour_is_put_to_the_operator(unknown: Callable[[], Path]) -> None:
    directory = unknown()
    questions: list[tuple[str, tuple[str, ...]]] = []

    def operator(question: str, options: Any) -> str:
        questions.append((question, tuple(options)))
        return ["no idea", "weighed 3.2 g 0.5 g"][len(questions) - 1]

    events: list[Event] = []
    run(directory, resume=True, plan=asking(directory), ask_operator=operator, watchers=[events.append])
    assert "pour 1 of stage first (angular_velocity" in questions[0][0]
    assert "what came of it?" in questions[0][0]
    assert questions[0][1] == (REPEAT, LOST, WEIGHED)
    assert "'no idea' is no answer" in questions[1][0]
    first = next(e.outcome for e in events if isinstance(e, RequestFinished) and hasattr(e.request, "number"))
    assert isinstance(first, Poured)
    assert (first.measurement.loaded, first.measurement.spilled) == (0.2, pytest.approx(0.0032))
    with JournalReader(directory / JOURNAL_NAME) as journal:
        assert [e.body["answer"] for e in journal.entries(kinds=[Kind.OPERATOR_ANSWERED])] == ["weighed 3.2 g 0.5 g"]
        reached = [e.body["after"] for e in journal.entries(kinds=[Kind.CAMPAIGN_STATE])]
    assert reached[2:] == ["unknown", "preparing", "waiting for operator", "preparing", "running", "finished"]


def test_without_an_operator_it_stops_with_exit_code_3_and_says_how_to_answer(unknown: Callable[[], Path]) -> None:
    directory, laboratory = unknown(), ToyLaboratory()
    with pytest.raises(OperatorNeededError, match="Resume with one of these answers: repeat; lost; weighed") as caught:
        run(directory, laboratory, resume=True, plan=asking(directory))
    assert caught.value.exit_code == 3
    assert laboratory.simulators.tasks == []
    assert run(directory, resume=True, plan=asking(directory), ask_operator=answering("lost")).state == "finished"


def test_a_pour_repeated_on_the_virtual_bench_is_the_same_pour(unknown: Callable[[], Path], tmp_path: Path) -> None:
    directory = unknown()
    run(directory, resume=True, plan=asking(directory), ask_operator=answering("repeat"))
    run(tmp_path / "undisturbed")
    assert logical_record(directory) == logical_record(tmp_path / "undisturbed")


def test_matter_is_not_repeated_on_a_real_bench(tmp_path: Path) -> None:
    """Neither by the plan nor by the operator."""
    hardware = {"laboratory": LaboratorySpec("toy", mode="hardware")}

    def laboratory() -> ToyLaboratory:
        return ToyLaboratory(bench=toy.ToyBench(lambda: 60.0, mode="hardware"))

    async def abandon(directory: Path) -> None:
        def watch(event: Event) -> None:
            if type(event).__name__ == "PourProgressed":
                loop.call_soon(task.cancel)
                loop.call_later(0.02, task.cancel)

        loop, plan = asyncio.get_running_loop(), asking(directory, **hardware)
        task = asyncio.create_task(run_toy(directory, laboratory(), plan=plan, stages=SMALL, watchers=[watch]))
        with pytest.raises(asyncio.CancelledError):
            await task

    directory = tmp_path / "run"
    asyncio.run(abandon(directory))
    with pytest.raises(RunError, match="'on_unknown: repeat' is for the virtual bench only"):
        run(directory, resume=True, plan=replace(asking(directory, **hardware), on_unknown="repeat"))
    offered: list[tuple[str, ...]] = []

    def operator(question: str, options: Any) -> str:
        offered.append(tuple(options))
        return "repeat"

    with pytest.raises(OperatorNeededError):
        run(directory, resume=True, plan=asking(directory, **hardware), ask_operator=operator)
    assert set(offered) == {(LOST, WEIGHED)}


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        ("", "is no answer"),
        ("repeat", "is no answer"),
        ("weighed", "two masses"),
        ("weighed 1", "two masses"),
        ("weighed one two", "numbers in grams"),
        ("weighed -1 0", "don't fit a load"),
        ("weighed 150 60", "don't fit a load of 200 g"),
        ("weighed nan 0", "don't fit a load"),
    ],
)
def test_an_answer_that_makes_no_sense_is_explained(answer: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        parse_answer(answer, (LOST, WEIGHED), 0.2)


def test_sensible_answers_are_understood() -> None:
    assert parse_answer(" Lost ", (LOST, WEIGHED), 0.2) == Failed("pour_unknown", "declared lost by the operator")
    assert parse_answer("repeat", (REPEAT, LOST), 0.2) is None
    outcome = parse_answer("weighed 3.5 1.5 180", (LOST, WEIGHED), 0.2)
    assert isinstance(outcome, Poured)
    measurement = outcome.measurement
    assert (measurement.loaded, measurement.spilled, measurement.retained) == pytest.approx((0.18, 0.0035, 0.0015))
    assert decode_outcome(encode_outcome(outcome)) == outcome


# -- run directories ---------------------------------------------------------------------------------------------------


def test_run_directories_count_up_and_the_newest_unfinished_one_is_resumed(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path / "runs", on_unknown="repeat")
    with pytest.raises(RunNotFoundError, match="no unfinished run of campaign 'toy'"):
        find_run(plan)
    finished, older, newer = (create_run(plan) for _ in range(3))
    assert [p.name.rsplit("-", 1)[1] for p in (finished, older, newer)] == ["1", "2", "3"]
    for directory in (older, newer, finished):
        fork = os.fork()
        if fork == 0:
            if directory is not finished:
                _die_at(20, after_commit=True)
            asyncio.run(run_toy(directory, plan=plan, stages=SMALL))
            os._exit(0)
        os.waitpid(fork, 0)
    assert find_run(plan) == newer
    assert find_run(plan, run_id=older.name) == older
    with pytest.raises(RunNotFoundError, match=r"no such run; known: toy-\d+-1, "):
        find_run(plan, run_id="nonsense")
    other = replace(plan, seed=8)
    assert find_run(other) == newer  # so that resuming it can say what differs
    asyncio.run(run_toy(newer, plan=plan, stages=SMALL, resume=True))
    assert find_run(plan) == older


def test_what_reproduces_a_run_is_kept_with_it(tmp_path: Path) -> None:
    import json

    run(tmp_path / "run", plan=toy_plan(tmp_path, resolved={"name": "toy", "seed": 7}))
    assert json.loads((tmp_path / "run" / "resolved.json").read_text()) == {"name": "toy", "seed": 7}
    versions = json.loads((tmp_path / "run" / "versions.json").read_text())
    assert versions["seed"] == 7
    assert versions["python"] == sys.version.split()[0]
    assert {"numpy", "taichi", "ray", "decant"} <= set(versions["packages"])


def test_drafts_of_a_dead_process_leave_no_half_answers(tmp_path: Path) -> None:
    """An ask and the requests it brought are one entry: a replay never meets one without the other."""
    directory = tmp_path / "run"
    run(directory)
    with JournalReader(directory / JOURNAL_NAME) as journal:
        times = {e.body["id"]: e.t for e in journal.entries(kinds=[Kind.REQUESTED])}
        for entry in journal.entries(kinds=[Kind.ASKED]):
            assert all(times[key] == entry.t for key in entry.body["ids"])
