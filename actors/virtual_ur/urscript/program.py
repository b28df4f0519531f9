"""A running program: its threads, each advanced once per control cycle until it gives way."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType
from typing import Any

from actors.virtual_ur.urscript import values
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.parser import parse
from actors.virtual_ur.urscript.translator import Translation

LOOPS_PER_CYCLE = 20_000
"""Turns of loops in one control cycle after which a thread counts as stuck. A controller gives up likewise."""

MOST_THREADS = 50

Steps = Generator[None, None, Any]


class _HaltedError(Exception):
    """The program asked for its own end."""


class Command:
    """What a program may call.

    Args:
        function: given the thread's number first if it `waits`; a generator function then.
        waits: whether it gives way.
    """

    def __init__(self, function: Callable[..., Any], *, waits: bool = False) -> None:
        self.function = function
        self.waits = waits


class Program:
    """One uploaded program. Made whole or not at all; run by `tick`.

    Args:
        text: the program.
        commands: what it may call.

    Attributes:
        name: from its first line.
        secondary: it was sent as `sec`: it runs beside the main program, may not move the arm, and ends soon.

    Raises:
        ScriptError: it can't be read.
    """

    def __init__(self, text: str, commands: Mapping[str, Command]) -> None:
        translated = _translate(text, frozenset((name, command.waits) for name, command in commands.items()))
        self.name = translated.name
        self.secondary = translated.secondary
        self._lines = translated.lines
        self._loops = 0
        self._threads: dict[int, Steps] = {}
        self._started = 0
        self._critical: int | None = None
        self._current = 0
        space: dict[str, Any] = {
            "__builtins__": {},
            "_add": values.add,
            "_sub": values.subtract,
            "_mul": values.multiply,
            "_div": values.divide,
            "_mod": values.modulo,
            "_xor": values.exclusive_or,
            "_neg": values.negate,
            "_copy": values.copy,
            "_index": values.index,
            "_pose": values.pose,
            "_loop": self._loop,
            "_run": self._run,
            "_kill": self._kill,
            "_join": self._join,
            "_halt": self._halt,
            "_enter_critical": self._enter_critical,
            "_exit_critical": self._exit_critical,
        }
        space.update({f"c_{name}": command.function for name, command in commands.items()})
        exec(translated.code, space)
        self._threads[0] = space["main"]()

    @property
    def current(self) -> int:
        """Number of the thread that is being advanced."""
        return self._current

    def tick(self) -> bool:
        """Advance all threads by one control cycle.

        Returns:
            Whether the program goes on.

        Raises:
            ScriptError: it can't go on.
        """
        for number in list(self._threads):
            if self._critical is not None and self._critical != number and self._critical in self._threads:
                continue
            steps = self._threads.get(number)
            if steps is None:
                continue
            self._current = number
            self._loops = LOOPS_PER_CYCLE
            try:
                next(steps)
            except StopIteration:
                self._threads.pop(number, None)
                if number == 0:
                    return False
            except _HaltedError:
                return False
            except ScriptError as error:
                raise ScriptError(error.text, error.line or self._line_of(error)) from error
            except Exception as error:
                raise ScriptError(_explain(error), self._line_of(error)) from error
        return True

    def _line_of(self, error: BaseException) -> int:
        line, trace = 0, error.__traceback__
        while trace is not None:
            if trace.tb_frame.f_code.co_filename == "<program>":
                line = self._lines[min(trace.tb_lineno, len(self._lines)) - 1]
            trace = trace.tb_next
        return line

    # ---- what programs say that concerns threads

    def _loop(self) -> None:
        self._loops -= 1
        if self._loops < 0:
            raise ScriptError("a loop without sync() doesn't give way: the runtime is too much behind")

    def _run(self, function: Callable[..., Any], *arguments: Any) -> int:
        if len(self._threads) >= MOST_THREADS:
            raise ScriptError(f"more than {MOST_THREADS} threads")
        steps = function(*arguments)
        self._started += 1
        self._threads[self._started] = steps
        return self._started

    def _kill(self, number: Any) -> None:
        if number == 0 or number not in self._threads:
            return
        if number == self._current:
            raise ScriptError("a thread can't kill itself")
        self._threads.pop(number).close()

    def _join(self, number: Any) -> Steps:
        while number in self._threads and number != self._current:
            yield

    def _halt(self) -> None:
        raise _HaltedError

    def _enter_critical(self) -> None:
        self._critical = self._current

    def _exit_critical(self) -> None:
        self._critical = None


@dataclass(frozen=True)
class _Translated:
    name: str
    secondary: bool
    lines: list[int]
    code: CodeType


@lru_cache(maxsize=8)  # clients send the same program again and again
def _translate(text: str, commands: frozenset[tuple[str, bool]]) -> _Translated:
    try:
        tree = parse(text)
        translation = Translation(tree, dict(commands))
        code = compile(translation.source, "<program>", "exec")
    except RecursionError:
        raise ScriptError("nested too deeply") from None
    except (SyntaxError, ValueError, MemoryError) as error:
        raise ScriptError(f"can't be translated: {error}") from error
    return _Translated(tree.name, tree.kind == "sec", translation.lines, code)


def _explain(error: Exception) -> str:
    if isinstance(error, NameError):
        name = (error.name or "").removeprefix("v_").removeprefix("f_")
        return f"'{name}' has no value yet"
    if isinstance(error, RecursionError):
        return "functions call each other without end"
    if isinstance(error, IndexError):
        return "a list has no such entry"
    if isinstance(error, ZeroDivisionError | OverflowError | ValueError):
        return f"can't be computed: {error}"
    return f"wrong use of a value or function: {error}".replace("v_", "").replace("f_", "").replace("c_", "")
