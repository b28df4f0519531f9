"""A pour that a virtual bench makes again in the same run, because a connection was lost or its outcome is unknown."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from actors.interfaces import BenchLostError, LaboratoryError, LinkLostError, UnknownPourError
from orchestrator.learning.requests import Poured
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.run_record import read_record
from orchestrator.reports.console_progress import ProgressDisplay
from orchestrator.reports.wording import cost
from orchestrator.runs.request_executor import (
    Deadlines,
    PourNotMadeError,
    PourUnknownError,
    RequestExecutor,
    RequestExecutorError,
)
from orchestrator.runs.stage_scheduler import REPEATS
from tests.support.scripted_strategy import Script, one_stage, pour, run
from tests.support.toy_campaign import ToyBench, ToyLaboratory, toy_plan

LOST = LinkLostError("the connection to the controller was lost. Nothing was poured")
UNKNOWN = UnknownPourError("the connection to the controller was lost during tilt. All weighings: nothing")


@dataclass
class RestartableLaboratory(ToyLaboratory):
    restarts: int = 0

    async def restart_bench(self) -> None:
        self.restarts += 1


def failing(error: Exception, times: int = 1, mode: str = "virtual") -> RestartableLaboratory:
    left = [error] * times
    return RestartableLaboratory(bench=ToyBench(fails=lambda seed: left.pop() if left else None, mode=mode))


def notes(directory: Path) -> list[str]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        texts = [str(entry.body.get("text", "")) for entry in journal.entries(kinds=[Kind.NOTE])]
    return [text for text in texts if "repeated" in text]


@pytest.mark.parametrize("on_unknown", ["ask", "repeat"])
def test_a_pour_is_made_again_with_one_line_if_the_link_was_lost_before_anything_flowed(
    tmp_path: Path, on_unknown: str
) -> None:
    laboratory, script, printed = failing(LOST), Script(pour(1), pour(2)), StringIO()
    plan = toy_plan(tmp_path, on_unknown=on_unknown)
    with ProgressDisplay(plan, console=Console(file=printed, width=400)) as display:
        run(tmp_path, laboratory, plan=plan, stages=one_stage(script), subscribers=[display])
    assert [type(outcome) for _, outcome in script.told] == [Poured, Poured]
    assert laboratory.bench is not None
    assert laboratory.bench.received == [101, 101, 102], "with the same seed"
    assert laboratory.restarts == 1
    (line,) = notes(tmp_path)
    assert "connection to the controller was lost" in line
    assert line in printed.getvalue().splitlines()
    with JournalReader(tmp_path / JOURNAL_NAME) as journal:
        kinds = [Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED]
        entries = [(e.kind, e.body.get("attempt")) for e in journal.entries(kinds=kinds)][:3]
    assert entries == [(Kind.POUR_STARTED, 1), (Kind.POUR_WITHDRAWN, None), (Kind.POUR_STARTED, 2)]
    assert cost(read_record(tmp_path), {})["pours"] == "2 begun (1 more than once), 2 weighed"  # in the report


def test_an_unknown_pour_is_repeated_without_ending_the_run_if_the_campaign_says_so(tmp_path: Path) -> None:
    laboratory, script = failing(UNKNOWN), Script(pour(1))
    run(tmp_path, laboratory, plan=toy_plan(tmp_path, on_unknown="repeat"), stages=one_stage(script))
    assert [type(outcome) for _, outcome in script.told] == [Poured]
    assert laboratory.restarts == 1
    assert len(notes(tmp_path)) == 1


def test_a_bench_that_cannot_be_restarted_leaves_the_error_that_says_what_to_do(tmp_path: Path) -> None:
    @dataclass
    class Gone(RestartableLaboratory):
        async def restart_bench(self) -> None:
            raise BenchLostError("the bench's machine is lost")

    laboratory = Gone(bench=failing(LOST).bench)
    with pytest.raises(PourNotMadeError, match="connection to the controller was lost") as ended:
        run(tmp_path, laboratory, plan=toy_plan(tmp_path), stages=one_stage(Script(pour(1))))
    assert ended.value.exit_code == 3


def test_a_bench_that_does_not_start_on_a_busy_machine_is_started_again_and_the_journal_says_why(
    tmp_path: Path,
) -> None:
    @dataclass
    class Late(RestartableLaboratory):
        async def restart_bench(self) -> None:
            opened, self.bench = self.bench or self.closed, None
            self.closed, self.restarts = opened, self.restarts + 1
            if self.restarts < 3:
                raise LaboratoryError("the arm's process did not start within 60 s")
            self.bench = opened

        closed: ToyBench | None = None

    laboratory = Late(bench=failing(LOST).bench)
    script = Script(pour(1))
    run(tmp_path, laboratory, plan=toy_plan(tmp_path), stages=one_stage(script))
    assert [type(outcome) for _, outcome in script.told] == [Poured]
    with JournalReader(tmp_path / JOURNAL_NAME) as journal:
        told = [str(entry.body.get("text", "")) for entry in journal.entries(kinds=[Kind.NOTE])]
    reasons = [text for text in told if "did not start within 60 s" in text]
    assert len(reasons) == 2


def test_an_unknown_pour_is_a_person_s_to_tell_otherwise(tmp_path: Path) -> None:
    laboratory = failing(UNKNOWN)
    with pytest.raises(PourUnknownError):
        run(tmp_path, laboratory, plan=toy_plan(tmp_path, on_unknown="ask"), stages=one_stage(Script(pour(1))))
    assert laboratory.restarts == 0


@pytest.mark.parametrize("error", [LOST, UNKNOWN])
def test_a_person_is_asked_on_hardware(error: Exception) -> None:
    laboratory = failing(error, mode="hardware")
    executor = RequestExecutor(laboratory, {}, Deadlines(), 10.0, repeats=True)
    problem = RequestExecutorError(str(error), nothing_poured=error is LOST, unknown=error is UNKNOWN)
    assert not asyncio.run(executor.restart(problem))
    assert laboratory.restarts == 0


def test_a_link_that_is_lost_again_and_again_ends_the_run(tmp_path: Path) -> None:
    laboratory = failing(LOST, times=REPEATS + 1)
    with pytest.raises(PourNotMadeError, match="see to it, then resume"):
        run(tmp_path, laboratory, stages=one_stage(Script(pour(1))))
    assert laboratory.restarts == REPEATS
