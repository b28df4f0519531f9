"""How verbs speak to people and to other programs, and how they end.

What is being done, for people who wait: nothing for some seconds, then a line that is kept current.
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
from typing import Any, NoReturn, TextIO

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
"""Exit codes beside 0 (done) and 3 (a person has to answer; `RunError.exit_code`)."""


class RefusalError(Exception):
    """A command can't do what was asked; printed as it is, without a traceback."""

    def __init__(self, message: str, code: int = FAILED) -> None:
        super().__init__(message)
        self.code = code


class Refused:
    """Whatever of some kinds is raised inside is a refusal, in its own words.

    Args:
        kinds: of errors whose text is for the person who can mend it.
        code: exit code.
        at: what stands before the text: an option, a file.
    """

    def __init__(self, *kinds: type[Exception], code: int = BAD_INPUT, at: str = "") -> None:
        self._kinds, self._code, self._at = kinds, code, at

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, self._kinds):
            raise RefusalError(f"{self._at}{error}", self._code) from None


def say(text: str) -> None:
    """A line for people: stderr, so that stdout stays for results."""
    with contextlib.suppress(OSError):  # a terminal that was closed is not a reason to leave an arm where it is
        print(text, file=sys.stderr, flush=True)


_quiet = False


def hush(quiet: bool) -> bool:
    """Whether from now on `mention` says nothing; questions, warnings of what moves, and errors are still told."""
    global _quiet
    _quiet = quiet
    return quiet


def is_quiet() -> bool:
    """Whether only results and what has to be known are wanted."""
    return _quiet


def mention(text: str) -> None:
    """A line for people who want to know what goes on: left out with `--quiet`."""
    if not _quiet:
        say(text)


def print_json(data: dict[str, Any]) -> None:
    """One line of JSON on stdout. Numbers that JSON has no word for become null."""
    print(json.dumps(_plain(data), ensure_ascii=False), flush=True)


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
    """While libraries are at work, whatever they print goes to stderr: stdout is for the result alone.

    Done to the file descriptor, since some of them print from C++ and from processes of their own.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def fail(refusal: RefusalError) -> NoReturn:
    """Print a refusal and leave with its code."""
    say(f"decant: {refusal}" if refusal.code != BAD_INPUT else str(refusal))
    raise SystemExit(refusal.code)


PATIENCE = 2.0
"""Nobody asks within this time [s]."""

EVERY = 10.0
"""Between two lines where stderr is not a terminal, such as a log file [s]."""


class WaitingIndicator:
    """Call it with what is being done, as often as one likes. Use as a context manager.

    Args:
        out: by default stderr.
        clock: seconds, monotonic.
    """

    def __init__(self, out: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._out = sys.stderr if out is None else out
        self._clock = clock
        self._next = clock() + (PATIENCE if self._out.isatty() else EVERY)
        self._shown = False

    def __call__(self, text: str) -> None:
        """Show it, if it is time."""
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
    """The same around something that never comes back to say what it is doing: a thread asks every now and then.

    Args:
        text: what is being done; called in that thread.
        beat: how often it is asked [s].
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
