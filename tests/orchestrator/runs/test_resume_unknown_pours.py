"""`resume`: a pour that had begun when its run died: nobody knows what came of it, and a person is asked."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.requests import Failed, Poured
from orchestrator.learning.run_errors import RunError
from orchestrator.records.codec import decode_outcome, encode_outcome
from orchestrator.records.events import CampaignStateChanged, Event, RequestFinished
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.states import State
from orchestrator.runs.resume import LOST, REPEAT, WEIGHED, OperatorNeededError, parse_answer
from tests.support import toy_campaign
from tests.support.killed_runs import SMALL, killed_when_last, run
from tests.support.toy_campaign import ToyLaboratory, answering, logical_record, run_toy, toy_plan


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

    def operator(question: str, options: Any, facts: Any) -> str:
        questions.append((question, tuple(options)))
        return ["no idea", "weighed 3.2 g 0.5 g"][len(questions) - 1]

    events: list[Event] = []
    run(directory, resume=True, plan=asking(directory), ask_operator=operator, subscribers=[events.append])
    assert "pour 1 of stage first (angular_velocity" in questions[0][0]
    assert "what was its outcome?" in questions[0][0]
    assert questions[0][1] == (REPEAT, LOST, WEIGHED)
    assert "'no idea' is not an answer" in questions[1][0]
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


@pytest.mark.slow
def test_a_pour_repeated_on_the_virtual_bench_is_the_same_pour(unknown: Callable[[], Path], tmp_path: Path) -> None:
    directory = unknown()
    run(directory, resume=True, plan=asking(directory), ask_operator=answering("repeat"))
    run(tmp_path / "undisturbed")
    assert logical_record(directory) == logical_record(tmp_path / "undisturbed")


def test_matter_is_not_repeated_on_a_real_bench(tmp_path: Path) -> None:
    """Neither by the plan nor by the operator."""
    hardware = {"laboratory": LaboratorySettings(name="toy", mode="hardware")}

    def laboratory() -> ToyLaboratory:
        return ToyLaboratory(bench=toy_campaign.ToyBench(lambda: 60.0, mode="hardware"))

    async def abandon(directory: Path) -> None:
        def watch(event: Event) -> None:
            # the second request is made once the first is known: two at once are one
            pausing = isinstance(event, CampaignStateChanged) and event.after == State.PAUSING
            if pausing or type(event).__name__ == "PourProgressed":
                loop.call_soon(task.cancel)

        loop, plan = asyncio.get_running_loop(), asking(directory, **hardware)
        task = asyncio.create_task(run_toy(directory, laboratory(), plan=plan, stages=SMALL, subscribers=[watch]))
        with pytest.raises(asyncio.CancelledError):
            await task

    directory = tmp_path / "run"
    asyncio.run(abandon(directory))
    with pytest.raises(RunError, match="'on_unknown: repeat' is for the virtual bench only"):
        run(directory, resume=True, plan=replace(asking(directory, **hardware), on_unknown="repeat"))
    offered: list[tuple[str, ...]] = []

    def operator(question: str, options: Any, facts: Any) -> str:
        offered.append(tuple(options))
        return "repeat"

    with pytest.raises(OperatorNeededError):
        run(directory, resume=True, plan=asking(directory, **hardware), ask_operator=operator)
    assert set(offered) == {(LOST, WEIGHED)}


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        ("", "is not an answer"),
        ("repeat", "is not an answer"),
        ("weighed", "two masses"),
        ("weighed 1", "two masses"),
        ("weighed one two", "numbers in grams"),
        ("weighed -1 0", "don't fit a load"),
        ("weighed 150 60", "don't fit a load of 200 g"),
        ("weighed nan 0", "numbers in grams"),
        ("weighed 500 0", "don't fit a load of 200 g"),
        ("weighed 500 0 600", "was to have a load of 200 g, and 600 g is more than 20 g away"),
        ("weighed 1 0 nan", "numbers in grams"),
        ("weighed 0,0 200", "'0,0' may be 0.0, or the masses 0 and 0"),
        ("weighed 0,0,200", "'0,0,200' may be the masses 0 and 0 and 200, since a comma may be a decimal sign"),
        ("weighed 12,5 200", "'12,5' may be 12.5, or the masses 12 and 5"),
        ("weighed 12,5 180", "'12,5' may be 12.5, or the masses 12 and 5"),
        ("weighed 3,2", "'3,2' may be 3.2, or the masses 3 and 2"),
        ("weighed 1,234 0", "'1,234' may be 1.234, or 1234, or the masses 1 and 234"),
        ("weighed 3,2 0,4", "'3,2' may be 3.2, or the masses 3 and 2"),
        ("weighed 3,2, 0,4", "type decimal points, e.g. weighed 3.2 0.4, or a semicolon: weighed 3,2; 0,4"),
        ("weighed 12,5 g 200 g", "12.5 g spilled and 200 g retained don't fit a load of 200 g"),
        ("weighed 0.2 kg 0.4", "the unit of each mass"),
        ("weighed 3.2 ml 0.4 ml", "numbers in grams"),
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


@pytest.mark.parametrize(
    ("answer", "spilled", "retained"),
    [
        ("weighed 0.0 200", 0.0, 200.0),
        ("weighed 3.2, 0.4", 3.2, 0.4),
        ("weighed 3.2,0.4", 3.2, 0.4),
        ("weighed 3,2; 0,4", 3.2, 0.4),
        ("weighed 3.2 g 0.4 g", 3.2, 0.4),
        ("weighed 12,5 g 180 g", 12.5, 180.0),
        ("weighed 12,5; 180", 12.5, 180.0),
        ("weighed 0.0032 kg 400 mg", 3.2, 0.4),
        ("weighed 1.234 0.4", 1.234, 0.4),  # 1234 g are more than the load
    ],
)
def test_masses_are_read_as_they_were_typed(answer: str, spilled: float, retained: float) -> None:
    outcome = parse_answer(answer, (LOST, WEIGHED), 0.2)
    assert isinstance(outcome, Poured)
    masses = outcome.measurement.spilled, outcome.measurement.retained
    assert masses == pytest.approx((1e-3 * spilled, 1e-3 * retained))


def test_a_mass_that_may_have_thousands_is_asked_for_again_if_the_load_allows_both() -> None:
    with pytest.raises(ValueError, match=r"may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'"):
        parse_answer("weighed 1.234 0.4", (LOST, WEIGHED), 2.0)
