"""Questions to the operators of a daemon. Each is stored before it is shown, each answer before it is used.

`Asking` stores a question and waits for its answer, from the page, from `decant queue answer` or from another machine.
The first answer counts. `RemoteOperator` implements `Operator` for the steps at a bench; `RunQuestions` asks those of
a run. A question does not outlive its run or the daemon. If it is repeated after a crash, it shows the previous
answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from actors.balance.readings import typed_weight
from actors.interfaces import LaboratoryError
from actors.interfaces import OperatorQuestion as BenchQuestion
from orchestrator.daemon.state.daemon_store import QuestionOut, Store
from orchestrator.learning.mixtures import NO_MORE, parse_proposals
from orchestrator.runs.resume import LOAD, Facts, parse_answer

GIVE_UP = "give up"

DIAGNOSTICS = "diagnostics"
"""Detail of a question about an unknown pour: what arm and balance show now, one finding a line."""

_WORDS = {"done": {"done": "done", "d": "done"}, "yes or no": {"yes": "yes", "y": "yes", "no": "no", "n": "no"}}

_WANTED = {
    "done": f"'done' when it is done, or '{GIVE_UP}'",
    "yes or no": f"'yes' or 'no', or '{GIVE_UP}'",
    "weight": f"the weight with its unit, such as '203.4 g', or '{GIVE_UP}'",
}


class AnswerError(ValueError):
    """An answer does not fit its question; the message lists valid answers."""


class Asking:
    """Asks questions and passes the answers on.

    Args:
        store: store of the questions.
        publish: callback for events: the event's name, its data, and the campaign.
    """

    def __init__(self, store: Store, publish: Callable[[str, dict[str, Any], str], None]) -> None:
        self._store, self._publish = store, publish
        self._waiting: dict[int, asyncio.Future[str]] = {}
        for left in store.questions():
            store.close_question(left.id, "the daemon ended")

    async def ask(self, **values: Any) -> str:
        """Ask a question and await its answer, without a time limit.

        Args:
            values: fields of `QuestionOut`.
        """
        question = self._store.ask(**values)
        self._waiting[question.id] = asyncio.get_running_loop().create_future()
        self._publish("QuestionAsked", {"question": question.model_dump(mode="json")}, question.campaign)
        try:
            return await self._waiting[question.id]
        finally:
            del self._waiting[question.id]
            self._store.close_question(question.id, "withdrawn")
            stored = self._store.question(question.id)
            if stored is not None and stored.answer is None:
                self._publish("QuestionClosed", {"question": stored.model_dump(mode="json")}, question.campaign)

    def answer(self, key: int, answer: str, by: str) -> QuestionOut:
        """Answer a question.

        Args:
            key: id of the question.
            answer: text as typed.
            by: user who answers.

        Raises:
            KeyError: the question does not exist or is closed.
            AnswerError: the answer doesn't fit the question.
        """
        question = self._store.question(key)
        waiting = self._waiting.get(key)
        if question is None or not question.open or waiting is None or waiting.done():
            raise KeyError(key)
        meant = understood(question, answer)
        self._store.answer(key, meant, by)
        waiting.set_result(meant)
        open_question = self._store.question(key)
        assert open_question is not None
        self._publish("QuestionAnswered", {"question": open_question.model_dump(mode="json")}, question.campaign)
        return open_question


def understood(question: QuestionOut, answer: str) -> str:
    """Normalise an answer to its question.

    Raises:
        AnswerError: the answer is not valid for the question.
    """
    words = " ".join(answer.split())
    if question.options:
        meant = next((o for o in question.options if o.lower() == words.lower()), None)
        if meant is not None:
            return meant
        if question.kind == "mixtures":
            try:
                parse_proposals(words)
                return words
            except ValueError as error:
                raise AnswerError(str(error)) from None
        if question.kind == "unknown":
            try:
                parse_answer(words, question.options, 1e-3 * float(question.details[LOAD]))
                return words
            except ValueError as error:
                raise AnswerError(str(error)) from None
        if words.lower() == GIVE_UP and question.kind == "bench":
            return GIVE_UP
        raise AnswerError(f"'{words}' is not an answer; answer with one of: {'; '.join(question.options)}")
    if words.lower() == GIVE_UP:
        return GIVE_UP
    if question.wants == "weight":
        try:
            typed_weight(words)
        except ValueError as error:
            raise AnswerError(str(error)) from None
        return words
    meaning = _WORDS[question.wants].get(words.lower())
    if meaning is None:
        raise AnswerError(f"'{words}' is not an answer; answer with {_WANTED[question.wants]}")
    return meaning


class RemoteOperator:
    """`Operator` at a rig of the daemon; the first user who answers acts as the operator.

    Args:
        asking: asks the questions.
        campaign, rig: subject of the questions.
        announced: called with a warning before motion, and the time until it starts [s].
    """

    def __init__(self, asking: Asking, campaign: str, rig: str, announced: Callable[[str, float], None]) -> None:
        self._asking, self._campaign, self._rig, self._announced = asking, campaign, rig, announced

    async def ask(self, question: BenchQuestion) -> str:
        """See `Operator.ask`.

        Raises:
            LaboratoryError: the operator gave the pour up.
        """
        answer = await self._asking.ask(
            campaign=self._campaign,
            rig=self._rig,
            kind="bench",
            about=question.about,
            text=question.text,
            problem=question.problem,
            wants=question.wants,
            options=list(question.options),
            details=dict(question.details),
            hands=question.hands,
        )
        if answer == GIVE_UP:
            raise LaboratoryError(f"abandoned by the operator at: {question.text.rstrip('.')}")
        return answer

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`."""
        self._announced(text, seconds)


class RunQuestions:
    """Asks the questions that a run needs answered before it continues; implements `AskOperator`.

    Args:
        asking: asks the questions.
        campaign, rig: subject of the questions.
        look: reads the arm and the balance for a pour with unknown outcome; may take seconds.
    """

    def __init__(
        self, asking: Asking, store: Store, campaign: str, rig: str, look: Callable[[], dict[str, str]]
    ) -> None:
        self._asking, self._store, self._campaign, self._rig = asking, store, campaign, rig
        self._look = look

    async def __call__(self, text: str, options: Sequence[str], facts: Facts) -> str:
        """Ask a question with its options."""
        question, _, problem = text.partition("\n")
        asked = {"campaign": self._campaign, "rig": self._rig, "text": question, "problem": problem, "wants": "option"}
        if options[0] == NO_MORE:
            proposals = {"kind": "mixtures", "about": "mixtures", "options": [NO_MORE], "details": {}, "hands": False}
            return await self._asking.ask(**asked, **proposals)
        details = dict(facts)
        before = [q for q in self._store.questions(only_open=False, campaign=self._campaign) if q.text == question]
        if before and before[0].answer and not problem:
            details["answered before"] = f"'{before[0].answer}' by {before[0].by}; check whether it was used"
        diagnostics = await asyncio.to_thread(self._look)
        details[DIAGNOSTICS] = "\n".join(f"{name}: {text}" for name, text in diagnostics.items())
        return await self._asking.ask(
            **asked, kind="unknown", about="unknown pour", options=list(options), details=details, hands=False
        )
