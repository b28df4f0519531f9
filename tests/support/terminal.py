"""A `decant` command in a real terminal, for tests: typed into, read from, ended with the test."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from tests.support.waiting import PATIENCE

PROMPT = "> "
"""Ends every prompt of the commands."""


class Terminal:
    """A command at a pseudo-terminal of its own; a context manager.

    Args:
        arguments: of `decant`.
        cwd: folder to run in.
    """

    def __init__(self, *arguments: str, cwd: str | None = None) -> None:
        self._keys, theirs = pty.openpty()
        code = "import sys; sys.argv[0] = 'decant'; from orchestrator.cli.app import main; main()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            cwd=cwd,
            env={**os.environ, "TERM": "dumb", "COLUMNS": "200", "PYTHONPATH": str(Path.cwd())},
            start_new_session=True,
        )
        os.close(theirs)
        self.screen = ""
        self._seen = self._typed = 0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(15)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        with contextlib.suppress(OSError):
            os.close(self._keys)

    def close(self) -> None:
        """Close the terminal's window, as its program is told."""
        os.kill(self.process.pid, signal.SIGHUP)
        os.close(self._keys)

    def expect(self, text: str, patience: float = PATIENCE) -> str:
        """Read until the screen shows a text after the one that was expected before; returns all from there to here."""
        begin, end = self._seen, time.monotonic() + patience
        while text not in self.screen[begin:]:
            if time.monotonic() > end or not self._read(0.2):
                raise AssertionError(f"'{text}' did not come; the screen:\n{self.screen}")
        self._seen = self.screen.index(text, begin) + len(text)
        return self.screen[begin : self._seen]

    def wait_for(self, condition: Callable[[], bool], *, unless: str) -> None:
        """Read until a condition holds that the screen doesn't show; fails once the screen shows another text.

        Args:
            condition: polled fifty times a second.
            unless: what the screen shows if the condition will never hold, for example the next prompt.
        """
        end = time.monotonic() + PATIENCE
        while not condition():
            if unless in self.screen[self._seen :] or time.monotonic() > end or not self._read(0.02):
                raise AssertionError(f"what was waited for did not happen; the screen:\n{self.screen}")

    def type(self, text: str) -> None:
        """Type a line once a prompt has come since the last one: what is typed before a prompt is discarded."""
        end = time.monotonic() + PATIENCE
        while PROMPT not in self.screen[self._typed :]:
            if time.monotonic() > end or not self._read(0.2):
                raise AssertionError(f"no prompt came for '{text}'; the screen:\n{self.screen}")
        self._typed = len(self.screen)
        os.write(self._keys, text.encode() + b"\n")

    def interrupt(self) -> None:
        """Ctrl-C, as the terminal would send it."""
        os.kill(self.process.pid, signal.SIGINT)

    def end(self, patience: float = PATIENCE) -> int:
        """Wait for the command's end, and give its exit code."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            if not self._read(0.2):
                break
        return self.process.wait(max(end - time.monotonic(), 1.0))

    def _read(self, wait: float) -> bool:
        """Take what has come; False once nothing more can."""
        ready, _, _ = select.select([self._keys], [], [], wait)
        if not ready:
            return self.process.poll() is None
        with contextlib.suppress(OSError):
            if data := os.read(self._keys, 65536):
                self.screen += data.decode("utf-8", "replace").replace("\r\n", "\n")
                return True
        return False
