"""`terminal_operator`: the person at the bench is asked in the terminal: at a real pseudo-terminal, by typing."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import pty
import re
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from rich.console import Console

from actors.bench.bench_operators import OperatorQuestions
from actors.bench.consent import stopped_question
from actors.interfaces import LaboratoryError, Notice, OperatorQuestion, OperatorSettings
from orchestrator.cli.terminal_operator import TerminalOperator
from orchestrator.records.events import LogLine
from orchestrator.reports.console_progress import ProgressDisplay
from tests.support import example_run
from tests.support.waiting import PATIENCE, wait_async

DONE = OperatorQuestion("Put the full pourer into the gripper.", "done")
WEIGHT = OperatorQuestion("Weigh the pourer on the other balance.", "weight")
PATIENT = OperatorSettings(answers="person", reminder=30.0, deadline=60.0)


class Keyboard:
    """The other end of the operator's terminal."""

    def __init__(self) -> None:
        self.keys, self.terminal = pty.openpty()
        self.screen = io.StringIO()

    def type(self, text: str) -> None:
        os.write(self.keys, text.encode())

    async def shows(self, text: str, times: int = 1) -> None:
        """Wait until the screen shows it, so many times."""
        await wait_async(lambda: self.screen.getvalue().count(text) >= times, f"{text!r} on the screen")

    def operator(self, spec: OperatorSettings = PATIENT) -> TerminalOperator:
        return TerminalOperator(spec, stdin=self.terminal, out=self.screen)


@pytest.fixture
def keyboard() -> Iterator[Keyboard]:
    made = Keyboard()
    yield made
    for end in (made.keys, made.terminal):
        with contextlib.suppress(OSError):
            os.close(end)


def played(scene: Callable[[], Awaitable[None]]) -> None:
    async def within() -> None:
        async with asyncio.timeout(PATIENCE):
            await scene()

    asyncio.run(within())


def test_what_to_do_what_was_wrong_and_what_is_expected_stand_on_the_screen(keyboard: Keyboard) -> None:
    question = OperatorQuestion(
        DONE.text, "done", problem="the balance reads 3 g less than before", details={"load": "200 g", "pour": 3}
    )

    async def scene() -> None:
        asking = asyncio.create_task(keyboard.operator().ask(question))
        await keyboard.shows("> ")
        keyboard.type("done\n")
        assert await asking == "done"

    played(scene)
    shown = keyboard.screen.getvalue()
    for text in (DONE.text, "the balance reads 3 g less", "load: 200 g", "pour: 3", "'done'", "'give up'", "\a"):
        assert text in shown


def test_enter_alone_and_keys_typed_before_the_question_confirm_nothing(keyboard: Keyboard) -> None:
    async def scene() -> None:
        keyboard.type("done\n")  # too early: meant for something else
        await asyncio.sleep(0.1)  # the line is in the terminal before the question
        asking = asyncio.create_task(keyboard.operator().ask(DONE))
        await keyboard.shows("> ")
        await asyncio.sleep(0.2)  # an answer that counts would have ended the question
        assert not asking.done()
        keyboard.type("\n")
        await asyncio.sleep(0.2)  # an answer that counts would have ended the question
        assert not asking.done()
        keyboard.type("what?\n")
        await keyboard.shows("'what?' is not an answer")
        keyboard.type("  Done \n")
        assert await asking == "done"

    played(scene)


def test_a_weight_needs_its_unit_and_is_echoed(keyboard: Keyboard) -> None:
    async def scene() -> None:
        asking = asyncio.create_task(keyboard.operator().ask(WEIGHT))
        await keyboard.shows("> ")
        keyboard.type("203.4\n")
        await keyboard.shows("has no unit")
        assert not asking.done()
        keyboard.type("0,2034 kg\n")
        assert await asking == "0,2034 kg"
        assert "203.4 g" in keyboard.screen.getvalue().splitlines()[-1]

    played(scene)


def test_yes_and_no_are_told_apart_from_anything_else(keyboard: Keyboard) -> None:
    async def scene() -> None:
        operator = keyboard.operator()
        for prompts, typed, answer in ((1, "maybe\nn\n", "no"), (3, "YES\n", "yes")):
            asking = asyncio.create_task(operator.ask(OperatorQuestion("Does it still show this weight?", "yes or no")))
            await keyboard.shows("> ", prompts)
            keyboard.type(typed)
            assert await asking == answer

    played(scene)


def test_a_decision_is_one_of_the_named_options(keyboard: Keyboard) -> None:
    async def scene() -> None:
        question = OperatorQuestion("It missed.", "option", hands=False, options=("accept", "repeat"))
        asking = asyncio.create_task(keyboard.operator().ask(question))
        await keyboard.shows("type 'accept', 'repeat', or 'give up'\n> ")
        keyboard.type("yes\nRepeat\n")
        assert await asking == "repeat"
        assert "'yes' is not an answer; type 'accept', 'repeat', or 'give up'" in keyboard.screen.getvalue()

    played(scene)


def test_giving_up_ends_the_pour_with_the_question_that_it_was_given_up_at(keyboard: Keyboard) -> None:
    async def scene() -> None:
        asking = asyncio.create_task(keyboard.operator().ask(DONE))
        await keyboard.shows("> ")
        keyboard.type("Give  up\n")
        with pytest.raises(LaboratoryError, match="abandoned by the operator at: Put the full pourer"):
            await asking

    played(scene)


def test_nobody_answers_reminders_then_the_question_is_given_up(keyboard: Keyboard) -> None:
    async def scene() -> None:
        with pytest.raises(LaboratoryError, match="no answer within 1 s"):
            await keyboard.operator(OperatorSettings(reminder=0.3, deadline=1.0)).ask(DONE)

    played(scene)
    shown = keyboard.screen.getvalue()
    assert 1 <= shown.count("still waiting") <= 3
    assert shown.count("\a") == 1 + shown.count("still waiting")


def test_announced_movement_is_counted_down_whatever_the_words(keyboard: Keyboard) -> None:
    async def scene() -> None:
        await keyboard.operator().announce("Hände weg, gleich fährt er los.", 3.0)
        assert "…" not in keyboard.screen.getvalue()
        await keyboard.shows("now")

    played(scene)
    assert re.findall(r"(\d) …|now", keyboard.screen.getvalue()) == ["2", "1", ""]


def test_numbers_that_belong_to_a_question_are_short(keyboard: Keyboard) -> None:
    async def scene() -> None:
        asking = asyncio.create_task(
            keyboard.operator().ask(OperatorQuestion("May it?", "yes or no", details={"s": 8.0277592}))
        )
        await keyboard.shows("s: 8.028\n")
        asking.cancel()

    played(scene)


def test_ctrl_d_once_is_a_slip_and_a_closed_terminal_ends_the_question(keyboard: Keyboard) -> None:
    async def scene() -> None:
        operator = keyboard.operator()
        asking = asyncio.create_task(operator.ask(DONE))
        await keyboard.shows("> ")
        keyboard.type("\x04")
        await keyboard.shows("still open")
        keyboard.type("done\n")
        assert await asking == "done"
        prompts = keyboard.screen.getvalue().count("> ")
        asking = asyncio.create_task(operator.ask(DONE))
        await keyboard.shows("> ", prompts + 1)
        os.close(keyboard.keys)
        with pytest.raises(LaboratoryError, match="terminal was closed"):
            await asking

    played(scene)


def test_the_program_goes_on_while_nobody_types_and_a_question_can_be_cancelled(keyboard: Keyboard) -> None:
    async def scene() -> None:
        operator = keyboard.operator()
        asking = asyncio.create_task(operator.ask(DONE))
        await keyboard.shows("> ")
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        asking = asyncio.create_task(operator.ask(DONE))  # the terminal was let go of
        await keyboard.shows("> ", 2)
        keyboard.type("d\n")
        assert await asking == "done"

    played(scene)


def test_without_a_terminal_nobody_is_asked(tmp_path: Path) -> None:
    answers = tmp_path / "answers"
    answers.write_text("done\ndone\n")
    with answers.open() as piped:

        async def scene() -> None:
            with pytest.raises(LaboratoryError, match="no terminal"):
                await TerminalOperator(PATIENT, stdin=piped.fileno(), out=io.StringIO()).ask(DONE)

        played(scene)


def test_why_the_arm_was_stopped_stands_on_the_screen_once_and_in_the_recording(keyboard: Keyboard) -> None:
    why = "protective stop, joint 3"
    display = ProgressDisplay(example_run.campaign(), console=Console(file=keyboard.screen, width=150))
    shown: list[LogLine] = []

    def hear(notice: Notice) -> None:
        if notice.level != "note":
            line = LogLine(level=notice.level, text=notice.text, asked=notice.asked)
            shown.append(line)
            display(line)

    async def scene() -> None:
        questions = OperatorQuestions(keyboard.operator(), PATIENT, hear)
        stopped = stopped_question(LaboratoryError(why), why, begun=False)
        asking = asyncio.create_task(questions.ask(stopped))
        await keyboard.shows("> ")
        keyboard.type("yes\n")
        assert await asking == "yes"

    played(scene)
    assert keyboard.screen.getvalue().count(why) == 1
    assert [(line.level, line.text) for line in shown] == [("warning", why)], "the other watchers are told"


def test_progress_makes_room_for_a_question_and_goes_on_after_it() -> None:
    plan = example_run.campaign()
    console = Console(file=io.StringIO(), force_terminal=True, width=150, highlight=False)

    def written() -> str:
        return str(console.file.getvalue())  # type: ignore[attr-defined]

    with ProgressDisplay(plan, console=console) as display:
        with display.paused():
            before = len(written())
            display(LogLine(level="info", text="a simulator has joined"))
            display(LogLine(level="error", text="the balance is gone"))
            asked = written()[before:]
            assert "the balance is gone" in asked
            assert "joined" not in asked
        after = written()[before:]
        assert "a simulator has joined" in after
        assert "0 simulations" in after  # the bars are back
