"""What is being done, for people who wait: nothing for some seconds, then a line that is kept current."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import TextIO

from orchestrator.commands.speaking import is_quiet

PATIENCE = 2.0
"""Nobody asks within this time [s]."""

EVERY = 10.0
"""Between two lines where stderr is not a terminal, such as a log file [s]."""


class Waiting:
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

    def __enter__(self) -> Waiting:
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
    with Waiting() as doing:

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
