"""Questions to the operator, with reminders, a deadline and a log.

`OperatorQuestions` forwards questions to one operator and records each answer as an `AnsweredQuestion`. The wording of
the questions belongs to `consent` and `weighing_plan`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from actors.interfaces import LaboratoryError, Notice, Operator, OperatorQuestion, OperatorSettings


class NoAnswerError(LaboratoryError):
    """The deadline of a question has passed."""


@dataclass(frozen=True)
class AnsweredQuestion:
    """A question and its answer.

    Attributes:
        about: subject of the question.
        answer: as given; '' if none was.
        after: time until the answer [s of the clock].
        problem: why the question was repeated; '' the first time.
    """

    about: str
    answer: str
    after: float
    problem: str = ""


class OperatorQuestions:
    """Asks one operator.

    Args:
        operator: answers the questions.
        spec: reminder and deadline.
        tell: receives notices for the journal: questions, answers, missing answers, and problems as warnings. The
            operator's own screen shows questions with their problems, and reminders.
        time_scale: bench seconds per second of the clock; for a virtual operator the times of `spec` are divided by it.
    """

    def __init__(
        self, operator: Operator, spec: OperatorSettings, tell: Callable[[Notice], None], time_scale: float = 1.0
    ) -> None:
        self._operator, self._notify = operator, tell
        self._on_screen = spec.answers == "person"
        pace = time_scale if spec.answers == "virtual" else 1.0
        self._reminder, self._deadline = spec.reminder / pace, spec.deadline / pace
        self.log: list[AnsweredQuestion] = []

    async def ask(self, question: OperatorQuestion) -> str:
        """Ask a question and wait for the answer.

        Raises:
            NoAnswerError: no answer came before the deadline.
            LaboratoryError: the operator gave up.
        """
        if question.problem:
            self._notify(Notice("warning", question.problem, asked=self._on_screen))
        begun, answer = time.monotonic(), ""
        answering = asyncio.ensure_future(self._operator.ask(question))
        try:
            answer = await self._await(answering, question, begun)
            return answer
        finally:
            answering.cancel()
            await asyncio.wait({answering})
            if not answering.cancelled():
                answering.exception()
            after = time.monotonic() - begun
            self.log.append(AnsweredQuestion(question.about, answer, after, question.problem))
            reply = f"'{answer}' after {after:.1f} s" if answer else f"no answer within {after:.1f} s"
            self._notify(Notice("note", f"operator ({question.about}): {question.text} → {reply}"))

    async def announce(self, text: str, seconds: float) -> None:
        """Announce that something moves after the given time [s of the clock]."""
        self._notify(Notice("note", f"operator told: {text}"))
        await self._operator.announce(text, seconds)

    def take_log(self) -> list[dict[str, Any]]:
        """Return the questions and answers since the last call, JSON-ready."""
        log, self.log = self.log, []
        return [
            {k: round(v, 3) if isinstance(v, float) else v for k, v in asdict(one).items() if v != ""} for one in log
        ]

    async def _await(self, answering: asyncio.Future[str], question: OperatorQuestion, begun: float) -> str:
        while True:
            left = begun + self._deadline - time.monotonic()
            done, _ = await asyncio.wait({answering}, timeout=max(min(self._reminder, left), 0.0))
            if done:
                return answering.result()
            waited = time.monotonic() - begun
            if waited >= self._deadline:
                raise NoAnswerError(f"nobody answered within {self._deadline:g} s: '{question.text}'")
            unseen: Literal["note", "warning"] = "note" if self._on_screen else "warning"
            self._notify(Notice(unseen, f"still waiting, for {waited:.0f} s now: {question.text}"))
