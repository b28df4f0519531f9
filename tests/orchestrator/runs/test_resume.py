"""`resume`: a run that was killed anywhere goes on as if nothing had happened: same requests, same outcomes,
nothing twice.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import LaboratoryError, OperatorQuestion
from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.requests import Outcome, Pour, Request
from orchestrator.learning.run_errors import RunError
from orchestrator.records.events import Event, RequestFinished, StageClosed
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.journal_file import JournalError
from orchestrator.records.run_clock import run_time
from orchestrator.records.run_record import CampaignResult, read_record
from orchestrator.reports.progress_state import ProgressState
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.stages import StageDefinition
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from tests.support import mixtures, toy_campaign
from tests.support.hypothesis_examples import THOROUGH
from tests.support.killed_runs import SMALL, finished_times, killed_at, killed_when_last, run
from tests.support.toy_campaign import ToyBench, ToyLaboratory, ToyStrategy, logical_record, toy_plan, toy_stages
from tests.support.waiting import PATIENCE


@pytest.mark.parametrize(
    "after_commit",
    [pytest.param(False, id="before the write", marks=pytest.mark.slow), pytest.param(True, id="after the write")],
)
def test_killed_at_any_point_it_makes_the_requests_it_would_have_made(tmp_path: Path, after_commit: bool) -> None:
    run(tmp_path / "undisturbed")
    expected = logical_record(tmp_path / "undisturbed")
    # in `make slow` every point; else two of sixteen, so that no kind of write is always passed over
    steps = itertools.repeat(1) if THOROUGH else itertools.cycle((5, 11))
    for point in itertools.accumulate(steps):
        directory = tmp_path / str(point)
        if not killed_at(point, after_commit=after_commit, directory=directory):
            break
        assert run(directory, resume=True).state == "finished"
        assert logical_record(directory) == expected, f"killed at write {point}"
        assert set(finished_times(directory).values()) == {1}, f"killed at write {point}, something was done twice"
    assert point > 60


@pytest.mark.parametrize("jump", [86400.0, -86400.0])
def test_a_system_clock_that_is_set_during_a_run_changes_no_duration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump: float
) -> None:
    """Times of a run are its begin's plus what has passed; a resumed run begins with the system's time again."""
    real, set_by, left = time.time, 0.0, []
    monkeypatch.setattr(time, "time", lambda: real() + set_by)
    progress = ProgressState(toy_plan(tmp_path))

    def follow(event: Event) -> None:
        nonlocal set_by
        progress(event)
        if isinstance(event, RequestFinished) and isinstance(event.request, Pour):
            set_by = jump
            left.append(progress.forecast.left(run_time()))

    began = real()
    asyncio.run(toy_campaign.run_toy(tmp_path, subscribers=[follow]))
    took = real() - began
    with JournalReader(tmp_path / JOURNAL_NAME) as journal:
        times = [entry.t for entry in journal.entries()]
    assert set_by == jump
    assert times == sorted(times)
    assert times[-1] - times[0] <= took
    assert read_record(tmp_path).at_work_s <= took
    assert all(seconds is None or seconds < 3600.0 for seconds in left)
    assert run_time() == pytest.approx(real() + jump, abs=5.0)  # no run goes on: the system's time


@pytest.mark.slow
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
    root = Path(__file__).parents[3]
    return subprocess.Popen(
        [sys.executable, str(Path(toy_campaign.__file__)), str(directory), *arguments],
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


@pytest.mark.slow
def test_killed_from_outside_with_everything_under_way_it_goes_on_in_another_process(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed", stages=toy_stages())
    for simulations in (2, 20):
        directory = tmp_path / str(simulations)
        killed_hanging(simulations, directory)
        before = entries_written(directory)
        resumed = process(directory, "--resume", "--on-unknown", "repeat", "--slow", "0.002")
        _, complaints = resumed.communicate(timeout=PATIENCE)
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
        _, complaints = second.communicate(timeout=PATIENCE)
        assert second.returncode != 0
        assert f"process {first.pid} is running this campaign" in complaints
        with pytest.raises(JournalError, match=str(first.pid)):
            run(directory, resume=True, stages=toy_stages())
        assert entries_written(directory) >= before
    finally:
        first.kill()
        first.communicate()


@pytest.mark.slow
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
    result = run(directory, resume=True, subscribers=[events.append])
    replayed = [e for e in events if isinstance(e, RequestFinished) and e.replayed]
    assert replayed
    with JournalReader(directory / JOURNAL_NAME) as journal:
        began = journal.header.created
    assert all(began <= e.time < time.time() for e in replayed)
    assert {e.stage: e.result for e in events if isinstance(e, StageClosed)} == result.results


def test_drafts_of_a_dead_process_leave_no_half_answers(tmp_path: Path) -> None:
    """An ask and the requests it brought are one entry: a replay never meets one without the other."""
    directory = tmp_path / "run"
    run(directory)
    with JournalReader(directory / JOURNAL_NAME) as journal:
        times = {e.body["id"]: e.t for e in journal.entries(kinds=[Kind.REQUESTED])}
        for entry in journal.entries(kinds=[Kind.ASKED]):
            assert all(times[key] == entry.t for key in entry.body["ids"])


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
    with pytest.raises(RunError, match=r"stage first: request 2 differs from the journal's at seed: \d+ became \d+"):
        run(directory, resume=True, stages=changed)
    assert run(directory, resume=True).state == "finished"  # nothing was lost by trying


class Renumbered(ToyStrategy):
    """The same strategy, which counts a refused pour: pours after it have other numbers than in an earlier journal."""

    def ask(self, slots: Any) -> list[Any]:
        return [replace(r, number=r.number + 1) if isinstance(r, Pour) else r for r in super().ask(slots)]

    def tell(self, request: Request, outcome: Outcome) -> None:
        super().tell(replace(request, number=request.number - 1) if isinstance(request, Pour) else request, outcome)


def test_a_journal_that_does_not_number_refused_pours_is_resumed(tmp_path: Path) -> None:
    directory = killed_when_last(Kind.POUR_FINISHED, tmp_path)
    begun = [pour.request.number for pour in read_record(directory).pours]
    renumbered = (
        StageDefinition("first", lambda results, seed: Renumbered(seed, simulations=3, pours=2, beside=2), pours=True),
        SMALL[1],
    )
    assert run(directory, resume=True, stages=renumbered).state == "finished"
    numbers = [pour.request.number for pour in read_record(directory).pours]
    assert begun
    assert numbers[: len(begun)] == begun, "what is written stays"


def test_other_settings_can_not_continue_a_run_but_the_machine_may_be_another(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    assert killed_at(30, after_commit=True, directory=directory)
    plan = toy_plan(directory, on_unknown="repeat")
    with pytest.raises(JournalError, match="seed: 7 became 8"):
        run(directory, resume=True, plan=replace(plan, seed=8))
    larger = replace(plan, laboratory=LaboratorySettings(name="toy", simulators=64), source=tmp_path / "moved.yaml")
    assert run(directory, resume=True, plan=larger).state == "finished"


def test_a_new_run_never_writes_over_an_old_one(tmp_path: Path) -> None:
    run(tmp_path / "run")
    before = logical_record(tmp_path / "run")
    with pytest.raises(JournalError, match="holds a run already"):
        run(tmp_path / "run")
    assert logical_record(tmp_path / "run") == before


class MissingBench(ToyBench):
    """Its first dose gets 2 g too much. The operator leaves questions unanswered, or answers them all alike."""

    def __init__(self, answer: str = "") -> None:
        super().__init__()
        self.answer, self.asked, self.amounts = answer, [], []

    async def pour(self, scene: Scene, action: Any, *, dose: Any = None, **about: Any) -> PourMeasurement:
        self.amounts.append(round(1e3 * dose.amount, 3))
        received = dose.amount + (2e-3 if dose.held is None else 0.0)
        held = dose.source.mass
        about = {"received": received, "left": [held - received, 1e-3], "deviation": 1e-4}
        return PourMeasurement(held, 0.0, held - received, {"dose": about})

    async def ask(self, question: OperatorQuestion) -> str:
        self.asked.append(question)
        if not self.answer:
            raise LaboratoryError("no answer within 1800 s")
        return self.answer


def test_a_question_about_a_missed_dose_waits_for_its_answer_which_counts_after_a_restart(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path, deployment=None, dispense=mixtures.plan({"water": 40.0, "oil": 10.0}, on_miss="ask"))

    def run_with(bench: MissingBench, **about: Any) -> CampaignResult:
        progress = ProgressState(plan)
        result = asyncio.run(run_campaign(plan, ToyLaboratory(bench=bench), tmp_path, subscribers=[progress], **about))
        assert [question.answer for question in progress.run.questions] == [bench.answer] * len(bench.asked)
        return result

    silent = MissingBench()
    with pytest.raises(RunError, match="no answer within 1800 s; resuming the run asks again"):
        run_with(silent)
    assert silent.amounts == [10.0]
    assert [q.answer for q in read_record(tmp_path).questions] == [None]
    present = MissingBench("correct")
    result = run_with(present, resume=True)
    assert present.amounts == [48.0]  # the first dose is not poured again
    assert present.asked[0].text == silent.asked[0].text
    assert present.asked[0].options == ("accept", "correct", "repeat")
    record = read_record(tmp_path)
    assert [(q.text, q.answer) for q in record.questions] == [(silent.asked[0].text, "correct")]
    again = run_with(MissingBench(), resume=True)  # the recorded answer counts
    assert again.results == result.results
