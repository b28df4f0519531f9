"""`request_executor`: a bench that says more than 'failed': nothing was poured, or nobody knows what was."""

from __future__ import annotations

from pathlib import Path

import pytest

from actors.interfaces import NotPouredError, UnknownPourError
from orchestrator.learning.requests import Poured
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.runs.request_executor import PourNotMadeError, PourUnknownError
from orchestrator.runs.resume import OperatorNeededError
from tests.support.scripted_strategy import Script, one_stage, pour, run, states
from tests.support.toy_campaign import ToyBench, ToyLaboratory, toy_plan

NOT_POURED = NotPouredError("the operator did not let the arm move. Nothing was poured")
UNKNOWN = UnknownPourError("protective stop during tilt. All weighings: pourer_full 512.1 g")


def kinds(directory: Path) -> list[str]:
    wanted = [Kind.POUR_STARTED, Kind.POUR_WITHDRAWN, Kind.POUR_FINISHED]
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return [entry.kind for entry in journal.entries(kinds=wanted)]


def failing_once(error: Exception) -> ToyLaboratory:
    left = [error]
    return ToyLaboratory(bench=ToyBench(fails=lambda seed: left.pop() if left else None))


def test_a_pour_that_did_not_begin_stops_the_run_and_is_made_on_resume_without_a_question(tmp_path):
    laboratory = failing_once(NOT_POURED)
    with pytest.raises(PourNotMadeError, match=r"did not let the arm move.*see to it, then resume") as error:
        run(tmp_path, laboratory, stages=one_stage(Script(pour(1), pour(2))))
    assert error.value.exit_code == 3
    assert states(tmp_path)[-1] == "failed"
    assert kinds(tmp_path) == [Kind.POUR_STARTED, Kind.POUR_WITHDRAWN]

    script = Script(pour(1), pour(2))
    plan = toy_plan(tmp_path, on_unknown="ask")
    run(tmp_path, laboratory, resume=True, plan=plan, stages=one_stage(script), ask_operator=None)
    assert [type(outcome) for _, outcome in script.told] == [Poured, Poured]
    assert laboratory.bench is not None
    assert laboratory.bench.poured == [101, 102]
    assert kinds(tmp_path)[2:] == [Kind.POUR_STARTED, Kind.POUR_FINISHED] * 2


def test_a_pour_that_broke_off_is_nobody_s_guess(tmp_path):
    laboratory, script = failing_once(UNKNOWN), Script(pour(1), pour(2))
    with pytest.raises(PourUnknownError, match=r"pourer_full 512.1 g; resuming asks for its outcome") as error:
        run(tmp_path, laboratory, stages=one_stage(script))
    assert error.value.exit_code == 3
    assert states(tmp_path)[-1] == "unknown"
    assert kinds(tmp_path) == [Kind.POUR_STARTED]
    assert script.told == []

    plan = toy_plan(tmp_path, on_unknown="ask")
    with pytest.raises(OperatorNeededError):
        run(tmp_path, laboratory, resume=True, plan=plan, stages=one_stage(Script(pour(1), pour(2))))
    assert laboratory.bench is not None
    assert laboratory.bench.poured == [], "software never pours anew"
    script = Script(pour(1), pour(2))
    run(
        tmp_path,
        laboratory,
        resume=True,
        plan=plan,
        stages=one_stage(script),
        ask_operator=lambda question, options, facts: "weighed 3.1 80.2",
    )
    (_, first), (_, second) = script.told
    assert isinstance(first, Poured)
    assert first.measurement.spilled == pytest.approx(0.0031)
    assert isinstance(second, Poured)
    assert laboratory.bench.poured == [102]
