"""Console output of the commands: messages on stderr, results on stdout, refusals with exit codes, and progress.

- `print_message`, `print_warning` and `print_note` print on stderr; `--quiet` suppresses the last one.
- `print_json` prints a result as one line.
- `RefusalError` ends a command with a message and an exit code.
- `WaitingIndicator` and `waiting_for` report slow work: nothing for some seconds, then a line that is kept current.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from orchestrator.campaigns.yaml.file_access import why_unreadable
from sim_engine.errors import DecantError

if TYPE_CHECKING:
    from pydantic import BaseModel

FAILED, BAD_INPUT, NOT_COMPLETE, INTERRUPTED = 1, 2, 4, 130
"""Exit codes in addition to 0 (success) and 3 (an operator must answer; `RunError.exit_code`).

4: a run came to its end, and did not reach all that was wanted."""


class RefusalError(DecantError):
    """A command can't do its work; the message is printed without a traceback."""

    def __init__(self, message: str, exit_code: int = BAD_INPUT) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Refused:
    """Context manager that converts errors of given types to refusals with the same message.

    `call` prints every DecantError with its own exit code; this is for other errors, other codes, and prefixes.

    Args:
        kinds: types of errors whose messages are written for users.
        code: exit code.
        at: prefix of the message: an option, a file.
    """

    def __init__(self, *kinds: type[Exception], code: int = BAD_INPUT, at: str = "") -> None:
        self._kinds, self._code, self._at = kinds, code, at

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, self._kinds):
            raise RefusalError(f"{self._at}{error}", self._code) from None


def print_message(text: str) -> None:
    """Print a message on stderr; stdout is for results."""
    with contextlib.suppress(OSError):  # a closed terminal must not interrupt a command that moves an arm
        print(text, file=sys.stderr, flush=True)


_quiet = False


def set_quiet(quiet: bool) -> bool:
    """Set whether `print_note` prints nothing; questions, warnings of motion, and errors are always printed."""
    global _quiet
    _quiet = quiet
    return quiet


def is_quiet() -> bool:
    """Whether `--quiet` was given."""
    return _quiet


def print_warning(text: object) -> None:
    """Print a warning, also with `--quiet`."""
    print_message(f"warning: {text}")


def print_note(text: str) -> None:
    """Print a note or a progress message, unless `--quiet` was given."""
    if not _quiet:
        print_message(text)


def print_json(data: BaseModel | dict[str, Any]) -> None:
    """Print one line of JSON on stdout. Numbers without a JSON equivalent become null."""
    plain = data if isinstance(data, dict) else data.model_dump(mode="json", by_alias=True)
    print(json.dumps(_plain(plain), ensure_ascii=False), flush=True)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


@contextlib.contextmanager
def stdout_for_results() -> Iterator[None]:
    """Redirect the output of libraries to stderr, so that stdout contains only the result.

    The file descriptor itself is redirected, since some libraries print from C++ and from child processes.
    """
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)


def fail(error: DecantError) -> NoReturn:
    """Print an error and exit with its code."""
    print_message(f"decant: {error}" if error.exit_code != BAD_INPUT else str(error))
    raise SystemExit(error.exit_code)


FIRST_MESSAGE_AFTER = 2.0
"""Time before the first progress message [s]."""

EVERY = 10.0
"""Interval of messages if stderr is not a terminal, such as a log file [s]."""


def check_output(path: Path | None, option: str, suffix: str) -> None:
    """A file that a command is to write, before hours are spent on what goes into it.

    Raises:
        RefusalError: it can't be written there, or has the wrong suffix (exit code 2).
    """
    if path is None:
        return
    folder = path.absolute().parent
    if why_unreadable(path) == "is a directory; name a file in it":
        problem = "is a folder; name a file in it"
    elif path.suffix.lower() != suffix:
        problem = f"should end in {suffix}"
    elif not folder.is_dir():
        problem = "its folder does not exist"
    elif (why := _why_not_opened(path)) is not None:
        problem = f"can't be written: {why}"
    else:
        return
    raise RefusalError(f"{option} {path}: {problem}")


def _why_not_opened(path: Path) -> str | None:
    """Found out by opening it: permissions don't tell of full disks, names too long, and folders of the system."""
    exists = why_unreadable(path) != "no such file"
    try:
        with path.open("ab"):
            pass
        if not exists:
            path.unlink()
    except (OSError, ValueError) as error:
        return getattr(error, "strerror", None) or str(error)
    return None


class WaitingIndicator:
    """Reports progress of slow work. Use it as a context manager, and call it with a text as often as needed.

    Args:
        out: stream; by default stderr.
        clock: monotonic time [s].
    """

    def __init__(self, out: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._out = sys.stderr if out is None else out
        self._clock = clock
        self._next = clock() + (FIRST_MESSAGE_AFTER if self._out.isatty() else EVERY)
        self._shown = False

    def __call__(self, text: str) -> None:
        """Show the text, if it is time."""
        if is_quiet() or self._clock() < self._next:
            return
        if self._out.isatty():
            self._out.write(f"\r\x1b[K{text} …")
            self._shown = True
        else:
            self._out.write(f"{text} …\n")
            self._next = self._clock() + EVERY
        self._out.flush()

    def __enter__(self) -> WaitingIndicator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._shown:
            self._out.write("\r\x1b[K")
            self._out.flush()


@contextlib.contextmanager
def waiting_for(text: Callable[[], str], *, beat: float = 0.5) -> Iterator[None]:
    """Report progress of a call that does not return until it is done; a thread queries the text.

    Args:
        text: returns the current text; called in the thread.
        beat: interval of the queries [s].
    """
    done = threading.Event()
    with WaitingIndicator() as doing:

        def keep_current() -> None:
            while not done.wait(beat):
                doing(text())

        thread = threading.Thread(target=keep_current, name="waiting", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
