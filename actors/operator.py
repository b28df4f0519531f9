"""The person at the bench, as actors know them: questions with answers. Values and a protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

Answer = Literal["done", "weight", "yes or no"]


@dataclass(frozen=True)
class Question:
    """Something to do and say, for the person at the bench.

    Attributes:
        text: what to do; whole sentences.
        wants: 'done' when it is done, a 'weight' with its unit, or 'yes' or 'no'.
        problem: why it is asked again; '' the first time.
        about: what it is about, for programs: a weighing's key, 'tare', 'start', 'recover' …
        hands: whether it invites hands into the cell; then no program runs on the controller until it is answered.
        details: numbers that belong to it, for screens and records; JSON-ready.
    """

    text: str
    wants: Answer
    problem: str = ""
    about: str = ""
    hands: bool = True
    details: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class OperatorSpec:
    """Who answers, and how long they may take.

    Attributes:
        answers: 'person', at the terminal; or 'virtual', on a virtual bench only.
        time: refilling, placing, wiping, for a virtual one [s of bench time].
        reminder: after which a person is asked again [s].
        deadline: after which the question is given up [s]; nothing moves then, and nothing is lost.
    """

    answers: Literal["person", "virtual"] = "person"
    time: float = 85.0
    reminder: float = 120.0
    deadline: float = 1800.0


class Operator(Protocol):
    """Answers questions. Nothing moves without them."""

    async def ask(self, question: Question) -> str:
        """Put a question and await the answer: 'done', a weight as typed ('12.3 g'), 'yes' or 'no'.

        Raises:
            LaboratoryError: nobody answered in time, or the pour is given up.
        """
        ...

    async def announce(self, text: str, seconds: float) -> None:
        """Say that something moves in so many seconds [s of the clock]; that needs no answer, and returns at once."""
        ...
