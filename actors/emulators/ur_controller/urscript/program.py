"""A running program: its threads, each advanced once per control cycle until it yields.

`Program` runs the translated code with a limit on its work in a cycle. A `Command` is a function that programs call.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Generator, Mapping
from typing import Any

from actors.emulators.ur_controller.urscript import script_values as values
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.translator import Translated

WORK_PER_CYCLE = 100_000
"""Limit of work in one control cycle; a program above it counts as stuck, as on a controller. The unit is one node of
an expression, which takes about 0.3 µs."""

COMMAND_WORK = 30
"""Work of a command call, in addition to the entries of its list arguments."""

MOST_THREADS = 50

Steps = Generator[None, None, Any]


class _HaltedError(Exception):
    """The program requested its own end."""


class Command:
    """A function that a program can call.

    Args:
        function: a generator function if it `waits`.
        waits: whether it yields.
    """

    def __init__(self, function: Callable[..., Any], *, waits: bool = False) -> None:
        self.function = function
        self.waits = waits


def waiting(commands: Mapping[str, Command]) -> frozenset[tuple[str, bool]]:
    """Return the translator's view of the commands: their names, and whether they yield."""
    return frozenset((name, command.waits) for name, command in commands.items())


class Program:
    """One uploaded program. It is created completely or not at all; `tick` runs it.

    Args:
        translated: the program, by `translate`.
        commands: the commands that it can call.

    Attributes:
        name: from its first line.
        secondary: whether it was sent as `sec`: it runs in parallel to the main program, may not move the arm, and ends
            soon.
    """

    def __init__(self, translated: Translated, commands: Mapping[str, Command]) -> None:
        self.name = translated.name
        self.secondary = translated.secondary
        self._work = 0
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
            "_neg": values.negate,
            "_copy": self._copy,
            "_index": values.index,
            "_pose": values.pose,
            "_spend": self._spend,
            "_run": self._run,
            "_kill": self._kill,
            "_halt": self._halt,
            "_enter_critical": self._enter_critical,
            "_exit_critical": self._exit_critical,
        }
        space.update({f"c_{name}": self._counted(command) for name, command in commands.items()})
        exec(translated.code, space)
        self._threads[0] = space["main"]()

    @property
    def current(self) -> int:
        """Number of the thread that is being advanced."""
        return self._current

    def tick(self) -> bool:
        """Advance all threads by one control cycle.

        Returns:
            Whether the program continues.

        Raises:
            ScriptError: it cannot continue.
        """
        self._work = WORK_PER_CYCLE
        for number in list(self._threads):
            if self._critical is not None and self._critical != number and self._critical in self._threads:
                continue
            steps = self._threads.get(number)
            if steps is None:
                continue
            self._current = number
            try:
                next(steps)
            except StopIteration:
                self._threads.pop(number, None)
                if number == 0:
                    return False
            except _HaltedError:
                return False
            except ScriptError as error:
                raise ScriptError(error.text, error.line or self._line_of_error(error)) from error
            except Exception as error:
                raise ScriptError(_explain(error), self._line_of_error(error)) from error
        return True

    def _line_of_error(self, error: BaseException) -> int:
        frames = traceback.extract_tb(error.__traceback__)
        return next((frame.lineno or 0 for frame in reversed(frames) if frame.filename == "<program>"), 0)

    def _spend(self, work: int) -> None:
        self._work -= work
        if self._work < 0:
            raise ScriptError("too much in one cycle without sync(): the runtime is too much behind")

    def _copy(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        self._spend(values.size(value))
        return values.copy(value)

    def _counted(self, command: Command) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            self._spend(COMMAND_WORK + sum(len(a) for a in arguments if isinstance(a, list)))
            return command.function(*arguments, **named)

        return call

    # ---- statements about threads

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

    def _halt(self) -> None:
        raise _HaltedError

    def _enter_critical(self) -> None:
        self._critical = self._current

    def _exit_critical(self) -> None:
        self._critical = None


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
