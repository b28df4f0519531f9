"""Who answers while a command runs: the person at the terminal, or nobody."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from orchestrator.commands.speaking import BAD_INPUT, RefusalError, say

if TYPE_CHECKING:
    from actors.operator import Operator
    from actors.spec import LaboratorySpec
    from orchestrator.unknown import AskOperator


def person_at_the_terminal(
    spec: LaboratorySpec, paused: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
) -> Operator | None:
    """Who answers the bench's questions; None where a virtual operator does.

    Args:
        spec: of the laboratory.
        paused: entered while a question is open.
    """
    from actors.bench.opening import needs_person
    from orchestrator.terminal_operator import TerminalOperator

    if not needs_person(spec) or spec.arm is None:
        return None
    return TerminalOperator(spec.operator, paused=paused)


def check_somebody_is_there(spec: LaboratorySpec) -> None:
    """A bench that asks a person needs a terminal to ask at.

    Raises:
        RefusalError: there is none (exit code 2).
    """
    from actors.bench.opening import needs_person
    from orchestrator.terminal_operator import somebody_at_the_terminal

    if needs_person(spec) and not somebody_at_the_terminal():
        raise RefusalError(
            f"laboratory {spec.name} asks a person (operator: answers: person), and there is no terminal to ask at; "
            "run this in a terminal, with nothing piped into it",
            BAD_INPUT,
        )


def asked_about_unknown_pours(answer: str | None) -> AskOperator | None:
    """Who is asked about a pour whose outcome is unknown: the command line, the terminal, or nobody."""
    if answer is not None:
        return lambda question, options: answer
    return _ask_on_terminal if sys.stdin.isatty() else None


async def _ask_on_terminal(question: str, options: Sequence[str]) -> str:
    say(f"\n{question}\n  answer with one of: {' | '.join(options)}")
    return (await asyncio.to_thread(input, "> ")).strip()
