"""The operator at the terminal in which `decant run` was started: shows questions and reads the answers.

`TerminalOperator` implements `Operator`. Lines are read asynchronously, without a thread: a question can be withdrawn,
and the program can end, while it waits for input.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import sys
import termios
import textwrap
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TextIO

from actors.balance.readings import typed_weight
from actors.interfaces import LaboratoryError, OperatorQuestion, OperatorSettings

GIVE_UP = "give up"

_EXPECTED = {
    "done": f"type 'done' when it is done, or '{GIVE_UP}'",
    "weight": f"type the weight with its unit, for example '203.4 g', or '{GIVE_UP}'",
    "yes or no": f"type 'yes' or 'no', or '{GIVE_UP}'",
}
_WORDS = {
    "done": {"done": "done", "d": "done"},
    "yes or no": {"yes": "yes", "y": "yes", "no": "no", "n": "no"},
}
_WIDTH = 100
_ENDS_OF_INPUT = 3
"""Ctrl-D once may be a mistake; this many in a row mean that the terminal was closed."""


class TerminalOperator:
    """`Operator` at a terminal. Only whole words count: Enter alone, or keys pressed too early, confirm nothing.

    Args:
        spec: time limits of answers.
        stdin: file descriptor of the terminal.
        out: stream for questions; by default stderr, so that stdout contains only results.

    Attributes:
        paused: makes the context that is entered while a question is open; it pauses a live display.
    """

    def __init__(self, spec: OperatorSettings, *, stdin: int = 0, out: TextIO | None = None) -> None:
        self._spec = spec
        self.paused: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
        self._stdin = stdin
        self._out = out
        self._one_question = asyncio.Lock()
        self._reminded = 0.0
        self._counting: asyncio.Task[None] | None = None

    async def ask(self, question: OperatorQuestion) -> str:
        """See `Operator.ask`.

        Raises:
            LaboratoryError: there is no terminal, no answer came in time, or the pour is given up.
        """
        async with self._one_question:
            with self.paused(), _Lines(self._stdin) as lines:
                if self._counting is not None:
                    self._counting.cancel()  # a new question ends the countdown of a previous announcement
                self._write(f"\a\n{_worded(question)}\n{self._expected(question)}\n> ")
                self._reminded = asyncio.get_running_loop().time()
                return await self._answer(question, lines)

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`. Prints a countdown."""
        self._write(f"{text}\n")
        self._counting = asyncio.create_task(self._count_down(seconds))

    def _remind(self, question: OperatorQuestion, left: float) -> None:
        """Ring the bell and repeat the question; `left` is the time until the question is given up [s]."""
        self._reminded = asyncio.get_running_loop().time()
        self._write(f"\a\nstill waiting, {_time(left)} left: {question.text}\n{_answers(question)}\n> ")

    async def _count_down(self, seconds: float) -> None:
        end = asyncio.get_running_loop().time() + seconds
        for left in range(math.ceil(seconds) - 1, 0, -1):
            await asyncio.sleep(max(end - left - asyncio.get_running_loop().time(), 0.0))
            self._write(f"\a  {left} …\n")
        await asyncio.sleep(max(end - asyncio.get_running_loop().time(), 0.0))
        self._write("\a  now\n")

    async def _answer(self, question: OperatorQuestion, lines: _Lines) -> str:
        loop = asyncio.get_running_loop()
        begin = loop.time()
        ends = 0
        while True:
            left = begin + self._spec.deadline - loop.time()
            if left <= 0.0:
                self._write("\n")
                raise LaboratoryError(
                    f"no answer within {_time(self._spec.deadline)}: {question.text} Nothing moves until the run "
                    "is resumed"
                )
            wait = min(left, max(self._reminded + self._spec.reminder - loop.time(), 0.0))
            try:
                line = await lines.next(wait)
            except TimeoutError:
                left = begin + self._spec.deadline - loop.time()
                if left > 0.0 and loop.time() >= self._reminded + self._spec.reminder:
                    self._remind(question, left)
                continue
            except EOFError:
                ends += 1
                if ends >= _ENDS_OF_INPUT:
                    question_text = question.text.rstrip(".")
                    raise LaboratoryError(f"the terminal was closed; no answer is possible: {question_text}") from None
                self._write(f"\nThe question is still open: {self._expected(question)}\n> ")
                continue
            ends = 0
            if line.strip():
                self._reminded = loop.time()  # the operator is present
            understood = self._understood(question, line)
            if understood is not None:
                return understood

    def _understood(self, question: OperatorQuestion, line: str) -> str | None:
        """Return the answer in a line, or print the valid answers and return None."""
        words = " ".join(line.lower().split())
        if words == GIVE_UP:
            raise LaboratoryError(f"abandoned by the operator at: {question.text.rstrip('.')}")
        if question.wants == "weight":
            try:
                weight = typed_weight(line)
            except ValueError as error:
                self._write(f"{error}\n> ")
                return None
            digits = max(0, round(-math.log10(1e3 * weight.step)))
            self._write(f"  {1e3 * weight.mass:.{digits}f} g\n")
            return line.strip()
        answer = {option: option for option in question.options}.get(words) or _WORDS.get(question.wants, {}).get(words)
        if answer is None:
            unknown = f"'{line.strip()}' is not an answer; " if words else ""
            self._write(f"{unknown}{_answers(question)}\n> ")
        return answer

    def _expected(self, question: OperatorQuestion) -> str:
        return f"{_answers(question)}; nothing moves before that" if question.hands else _answers(question)

    def _write(self, text: str) -> None:
        out = self._out or sys.stderr
        with contextlib.suppress(OSError, ValueError):  # a closed terminal is detected when it is read
            out.write(text)
            out.flush()


class _Lines:
    """New lines of a terminal; input from before the question is discarded.

    Args:
        terminal: file descriptor.

    Raises:
        LaboratoryError: it isn't a terminal.
    """

    def __init__(self, terminal: int) -> None:
        self._terminal = terminal
        self._read = b""
        self._ended = False
        self._news = asyncio.Event()

    def __enter__(self) -> _Lines:
        if not _is_terminal(self._terminal):
            raise LaboratoryError(
                "a person has to answer, but there is no terminal to ask at; run Decant in a terminal, with nothing "
                "piped into it"
            )
        termios.tcflush(self._terminal, termios.TCIFLUSH)
        asyncio.get_running_loop().add_reader(self._terminal, self._take)
        return self

    def __exit__(self, *exc: object) -> None:
        asyncio.get_running_loop().remove_reader(self._terminal)

    def _take(self) -> None:
        try:
            piece = os.read(self._terminal, 4096)
        except OSError:
            piece = b""
        self._ended = not piece
        self._read += piece
        self._news.set()

    async def next(self, wait: float) -> str:
        """Return the next line, without its line break.

        Raises:
            TimeoutError: no line arrived.
            EOFError: end of input.
        """
        async with asyncio.timeout(wait):
            while b"\n" not in self._read:
                self._news.clear()
                await self._news.wait()
                if self._ended:
                    self._ended = False
                    raise EOFError
        line, _, self._read = self._read.partition(b"\n")
        return line.decode("utf-8", "replace")


def somebody_at_the_terminal(stdin: int = 0) -> bool:
    """Whether a question can be shown and answered at this terminal."""
    return _is_terminal(stdin)


def _is_terminal(descriptor: int) -> bool:
    try:
        return os.isatty(descriptor)
    except OSError:
        return False


def _answers(question: OperatorQuestion) -> str:
    """The possible answers of a question."""
    if question.options:
        return f"type {', '.join(map(repr, question.options))}, or '{GIVE_UP}'"
    return _EXPECTED[question.wants]


def _worded(question: OperatorQuestion) -> str:
    """Format the question for the screen: problem, instruction and numbers."""
    rows = []
    if question.problem:
        rows.append(textwrap.fill(f"Problem: {question.problem}", _WIDTH))
    rows.append(textwrap.fill(question.text, _WIDTH))
    for name, value in question.details.items():
        rows.append(f"  {name}: {value:.4g}" if isinstance(value, float) else f"  {name}: {value}")
    return "\n".join(rows)


def _time(seconds: float) -> str:
    return f"{round(seconds)} s" if seconds < 120.0 else f"{round(seconds / 60.0)} min"
