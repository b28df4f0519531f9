"""`bench_operators`: parts of the wired bench by themselves: what is cut out of a history, kept in a journal,
asked, and carried.
"""

from __future__ import annotations

import asyncio
import re

import numpy as np
import pytest

from actors.arm.planned_pour import ExecutedPath, pack, unpack
from actors.balance.weighing_plan import Placement, weighings
from actors.bench.bench_operators import DRY, BenchContents, Hands, OperatorQuestions, PlayedOperator, VirtualOperator
from actors.bench.virtual_bench import LONGEST_REST, executed_pour
from actors.interfaces import LaboratoryError, Notice, OperatorQuestion, OperatorSettings

POURER, RECEIVER, TRAY = DRY["pourer"], DRY["receiver"], DRY["tray"]

STEP = 0.008


def history(*parts: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Joint 1 over time: (seconds, where it goes) one after the other, from 1 rad."""
    places, at = [np.array([1.0])], 1.0
    for seconds, to in parts:
        count = round(seconds / STEP)
        places.append(at + (to - at) * np.arange(1, count + 1) / count)
        at = to
    first = np.concatenate(places)
    joints = np.zeros((len(first), 6))
    joints[:, 0] = first
    return np.arange(len(first)) * STEP, joints


START = np.zeros(6)


def test_the_pour_begins_with_the_first_movement_away_from_its_first_pose():
    approach, waiting, pour = (1.0, 0.0), (0.5, 0.0), (1.0, 0.8)
    times, joints = history(approach, waiting, pour, (0.4, 0.8), (1.0, 0.0))
    cut = executed_pour(times, joints, START)
    assert cut is not None
    assert cut[0][0] == 0.0
    assert cut[0][-1] == pytest.approx(2.4, abs=2 * STEP)
    assert abs(cut[1][0, 0]) < 2e-3
    assert cut[1].max() == pytest.approx(0.8)


def test_the_clock_plays_no_part_in_where_the_pour_begins():
    quick = executed_pour(*history((1.0, 0.0), (0.1, 0.0), (1.0, 0.8), (1.0, 0.0)), START)
    slow = executed_pour(*history((3.0, 0.0), (30.0, 0.0), (1.0, 0.8), (1.0, 0.0)), START)
    assert quick is not None
    assert slow is not None
    np.testing.assert_allclose(quick[0], slow[0], atol=1e-9)
    np.testing.assert_allclose(quick[1], slow[1], atol=1e-9)


def test_a_long_stop_in_the_middle_counts_for_as_long_as_liquid_flows():
    cut = executed_pour(*history((1.0, 0.0), (0.2, 0.0), (1.0, 0.8), (60.0, 0.8), (1.0, 0.0)), START)
    assert cut is not None
    assert cut[0][-1] == pytest.approx(2.0 + LONGEST_REST, abs=3 * STEP)
    assert np.all(np.diff(cut[0]) > 0.0)


def test_an_arm_that_never_left_or_never_came_has_poured_nothing():
    assert executed_pour(*history((1.0, 0.0), (2.0, 0.0)), START) is None
    assert executed_pour(*history((1.0, 0.4), (2.0, 0.4)), START) is None


def test_what_was_executed_comes_back_from_the_journal_as_exactly_as_an_arm_repeats():
    rng = np.random.default_rng(1)
    times = np.cumsum(np.full(1250, 0.008))
    joints = np.cumsum(rng.normal(0.0, 2e-3, (1250, 6)), axis=0) + 100.0 * np.arange(6)
    path = ExecutedPath(times, joints, False, {"lag": 0.03})
    packed = pack(path)
    again = unpack(packed)
    np.testing.assert_allclose(again.times, times, atol=1e-5)
    np.testing.assert_allclose(again.joints, joints, atol=1e-6)
    assert (again.completed, again.tracking) == (False, {"lag": 0.03})
    assert len(packed["packed"]) < 30_000
    with pytest.raises(ValueError, match="not an executed path"):
        unpack({"packed": "nothing of the kind"})


class Person:
    """Answers after some time, or never."""

    def __init__(self, after: float) -> None:
        self.after = after

    async def ask(self, question: OperatorQuestion) -> str:
        await asyncio.sleep(self.after)  # how long this operator takes
        return "done"

    async def announce(self, text: str, seconds: float) -> None:
        pass


def ask(after: float, **spec: float) -> tuple[object, OperatorQuestions, list[Notice]]:
    notices: list[Notice] = []
    questions = OperatorQuestions(Person(after), OperatorSettings(**spec), notices.append)

    async def play() -> object:
        try:
            return await questions.ask(OperatorQuestion("Wipe the tray.", "done", about="tray_wiped"))
        except LaboratoryError as error:
            return error

    return asyncio.run(play()), questions, notices


def test_questions_and_answers_are_written_down_with_their_times():
    answer, questions, notices = ask(0.1, reminder=5.0, deadline=10.0)
    assert answer == "done"
    (said,) = notices
    assert said.level == "note"
    assert re.search(r"Wipe the tray. → 'done' after \d+\.\d s", said.text)
    (kept,) = questions.take_log()
    assert kept == {"about": "tray_wiped", "answer": "done", "after": pytest.approx(0.1, abs=0.09)}
    assert questions.take_log() == []


def test_a_virtual_operator_begins_a_series_with_new_cups_and_goes_on_with_those_that_are_there() -> None:
    operator = VirtualOperator(Hands(BenchContents(Placement.RECEIVER), None), 0.0)
    for begins, answer in ((1.0, "no"), (0.0, "yes")):
        question = OperatorQuestion("Are they these?", "yes or no", about="cups_kept", details={"begins": begins})
        assert asyncio.run(operator.ask(question)) == answer


def test_a_virtual_operator_that_gives_up_says_what_a_person_would_have_to_do() -> None:
    operator = VirtualOperator(Hands(BenchContents(Placement.RECEIVER), None), 0.0)
    question = OperatorQuestion("Weigh 'cup' and enter its content.", "done", "the account has no content for it yet")

    async def ask() -> None:
        while True:
            await operator.ask(question)

    with pytest.raises(LaboratoryError, match=r"has no content for it yet\. The question was: Weigh 'cup'"):
        asyncio.run(ask())


def test_an_empty_cup_that_is_laid_out_is_dry_and_a_source_is_filled_as_well_as_a_person_can() -> None:
    contents = BenchContents(Placement.RECEIVER)
    hands = Hands(contents, None)
    hands.prepare(0.3, (1,))
    details: dict[str, float | str] = {"rack/A1": "rack/A1", "rack/A1 filled_g": 0.0}
    details |= {"source/oil": "source/oil", "source/oil filled_g": 300.0}
    asyncio.run(hands.do(OperatorQuestion("Lay out.", "done", about="vessels_laid_out", details=details)))
    assert contents.liquids["rack/A1"] == 0.0
    assert 0.0 < abs(contents.liquids["source/oil"] - 0.3) < 2e-3


def test_a_question_that_nobody_answers_is_repeated_and_then_given_up():
    answer, questions, notices = ask(60.0, reminder=0.2, deadline=0.5)
    assert isinstance(answer, LaboratoryError)
    assert "Wipe the tray." in str(answer)
    assert sum("still waiting" in notice.text for notice in notices) == 2
    assert "no answer" in notices[-1].text
    assert questions.take_log()[0]["about"] == "tray_wiped"


async def test_a_person_can_play_on_a_virtual_bench_and_reads_weights_off_the_question():
    put: list[float] = []

    async def onto(mass: float) -> None:
        put.append(mass)

    class Reader(Person):
        async def ask(self, question: OperatorQuestion) -> str:
            await super().ask(question)
            return question.text.split("shows ")[1].rstrip(".)") if question.wants == "weight" else "done"

    contents = BenchContents(Placement.TRAY)
    hands = Hands(contents, onto)
    hands.prepare(0.2, (1,))
    played = PlayedOperator(Reader(0.0), hands)
    await played.ask(OperatorQuestion("Wipe the tray.", "done", about="tray_wiped"))
    await played.ask(OperatorQuestion("Fill the pourer.", "done", about="pourer_full"))
    typed = await played.ask(OperatorQuestion("Weigh the tray.", "weight", about="tray_before"))
    assert put == [pytest.approx(TRAY), pytest.approx(TRAY + POURER + 0.2, abs=5e-3)]
    assert typed == f"{1e3 * TRAY:.1f} g"
    assert contents.in_pourer == pytest.approx(0.2, abs=5e-3)


@pytest.mark.parametrize("placement", Placement)
def test_every_step_of_a_pour_puts_on_the_balance_what_it_says(placement):
    contents, carried = BenchContents(placement), {}
    for step in weighings(placement):
        if step.do == "pour":
            contents.receive(spilled=0.004, retained=0.016)
            continue
        contents.do(step.key or step.about, fill=0.2)
        carried[step.key or step.about] = contents.carried
    assert contents.in_receiver == pytest.approx(0.18)
    match placement:
        case Placement.TRAY:
            assert carried["pourer_full"] - carried["tray_wiped"] == pytest.approx(POURER + 0.2)
            assert carried["spilled"] - carried["set_up"] == pytest.approx(0.004)
            assert carried["pourer_after"] - carried["spill_left"] == pytest.approx(POURER + 0.016)
        case Placement.RECEIVER:
            assert carried["set_up"] == pytest.approx(RECEIVER)
            assert carried["received"] - carried["set_up"] == pytest.approx(0.18)
            assert carried["cleared_after"] == 0.0
        case Placement.EVERYTHING:
            assert carried["set_up"] == pytest.approx(TRAY + RECEIVER)
            assert carried["poured"] - carried["set_up"] == pytest.approx(0.184)
            assert carried["receiver_gone"] - carried["set_up"] == pytest.approx(0.004 - RECEIVER)
        case Placement.MANUAL:
            assert contents.typed("tray_after", 1e-4) == f"{1e3 * (TRAY + 0.004):.1f} g"
