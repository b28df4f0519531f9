"""The people around a daemon: a question is written down before it is asked, an answer before it counts.

Whoever is closest answers: on the page, with `decant answer`, from another machine. A question outlives neither its run
nor the daemon; asked again after a crash, it says what had been answered.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from actors.balance.readings import typed_weight
from actors.interfaces import LaboratoryError
from actors.interfaces import OperatorQuestion as BenchQuestion
from orchestrator.daemon.daemon_store import Store, StoredQuestion
from orchestrator.runs.unknown_pours import parse_answer

GIVE_UP = "give up"

LOAD = "load_g"
"""Detail of a question about an unknown pour: the load that the campaign asks for [g]."""

_WORDS = {"done": {"done": "done", "d": "done"}, "yes or no": {"yes": "yes", "y": "yes", "no": "no", "n": "no"}}

_WANTED = {
    "done": f"'done' when it is done, or '{GIVE_UP}'",
    "yes or no": f"'yes' or 'no', or '{GIVE_UP}'",
    "weight": f"the weight with its unit, such as '203.4 g', or '{GIVE_UP}'",
}


class AnswerError(ValueError):
    """An answer that does not answer its question; the text says what would."""


class Asking:
    """Puts questions, and hands on the answers.

    Args:
        store: that they are written into.
        tell: takes news: a word for what happened, and its data.
    """

    def __init__(self, store: Store, tell: Callable[[str, dict[str, Any], str], None]) -> None:
        self._store, self._tell = store, tell
        self._waiting: dict[int, asyncio.Future[str]] = {}
        for left in store.questions():
            store.close_question(left.id, "the daemon ended")

    async def ask(self, **values: Any) -> str:
        """Put a question and await its answer, however long that takes.

        Args:
            values: fields of `store.Question`.
        """
        question = self._store.ask(**values)
        self._waiting[question.id] = asyncio.get_running_loop().create_future()
        self._tell("QuestionAsked", {"question": question_json(question)}, question.campaign)
        try:
            return await self._waiting[question.id]
        finally:
            del self._waiting[question.id]
            self._store.close_question(question.id, "withdrawn")
            found = self._store.question(question.id)
            if found is not None and found.answer is None:
                self._tell("QuestionClosed", {"question": question_json(found)}, question.campaign)

    def answer(self, key: int, answer: str, by: str) -> StoredQuestion:
        """Answer a question.

        Args:
            key: its id.
            answer: as typed.
            by: who answers.

        Raises:
            KeyError: there is no such question, or it needs no answer any more.
            AnswerError: the answer doesn't fit it.
        """
        question = self._store.question(key)
        waiting = self._waiting.get(key)
        if question is None or not question.open or waiting is None or waiting.done():
            raise KeyError(key)
        meant = understood(question, answer)
        self._store.answer(key, meant, by)
        waiting.set_result(meant)
        found = self._store.question(key)
        assert found is not None
        self._tell("QuestionAnswered", {"question": question_json(found)}, question.campaign)
        return found


def understood(question: StoredQuestion, answer: str) -> str:
    """What an answer means to its question.

    Raises:
        AnswerError: nothing.
    """
    said = " ".join(answer.split())
    if question.kind != "bench":
        meant = next((o for o in question.options if o.lower() == said.lower()), None)
        if meant is not None:
            return meant
        if question.kind == "unknown":
            try:
                parse_answer(said, question.options, 1e-3 * float(question.details[LOAD]))
                return said
            except ValueError as error:
                raise AnswerError(str(error)) from None
        raise AnswerError(f"'{said}' is not an answer; answer with one of: {'; '.join(question.options)}")
    if said.lower() == GIVE_UP:
        return GIVE_UP
    if question.wants == "weight":
        try:
            typed_weight(said)
        except ValueError as error:
            raise AnswerError(str(error)) from None
        return said
    found = _WORDS[question.wants].get(said.lower())
    if found is None:
        raise AnswerError(f"'{said}' is not an answer; answer with {_WANTED[question.wants]}")
    return found


class RemoteOperator:
    """`Operator` at a rig of the daemon: whoever answers first.

    Args:
        asking: puts the questions.
        campaign, rig: that they are about.
        announced: told what moves in how many seconds.
    """

    def __init__(self, asking: Asking, campaign: str, rig: str, announced: Callable[[str, float], None]) -> None:
        self._asking, self._campaign, self._rig, self._announced = asking, campaign, rig, announced

    async def ask(self, question: BenchQuestion) -> str:
        """See `Operator.ask`.

        Raises:
            LaboratoryError: the pour is given up.
        """
        answer = await self._asking.ask(
            campaign=self._campaign,
            rig=self._rig,
            kind="bench",
            about=question.about,
            text=question.text,
            problem=question.problem,
            wants=question.wants,
            options=(),
            details=dict(question.details),
            hands=question.hands,
        )
        if answer == GIVE_UP:
            raise LaboratoryError(f"given up by the operator at: {question.text.rstrip('.')}")
        return answer

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`."""
        self._announced(text, seconds)


class RunQuestions:
    """Asks what a run has to know before it goes on: `AskOperator`.

    Args:
        asking: puts the questions.
        campaign, rig: that they are about.
        load: of every pour of the campaign [kg].
        look: says what arm and balance show now, for a pour whose outcome nobody knows; may take a while.
    """

    def __init__(
        self, asking: Asking, store: Store, campaign: str, rig: str, load: float, look: Callable[[], dict[str, str]]
    ) -> None:
        self._asking, self._store, self._campaign, self._rig = asking, store, campaign, rig
        self._load, self._look = load, look

    async def __call__(self, text: str, options: Sequence[str]) -> str:
        """Put a question with its options."""
        unknown = "lost" in options
        question, _, problem = text.partition("\n")
        details: dict[str, float | str] = {}
        if unknown:
            details[LOAD] = 1e3 * self._load
            details |= await asyncio.to_thread(self._look)
            before = [q for q in self._store.questions(only_open=False, campaign=self._campaign) if q.text == question]
            if before and before[0].answer and not problem:
                details["answered before"] = f"'{before[0].answer}' by {before[0].by}; check whether it was used"
        return await self._asking.ask(
            campaign=self._campaign,
            rig=self._rig,
            kind="unknown" if unknown else "strategy",
            about="unknown pour" if unknown else "decision",
            text=question,
            problem=problem,
            wants="option",
            options=tuple(options),
            details=details,
            hands=False,
        )


def question_json(question: StoredQuestion) -> dict[str, Any]:
    """For screens."""
    from orchestrator.daemon.event_feed import plain

    table: dict[str, Any] = plain(question)
    table.pop("type", None)
    return {**table, "open": question.open}
