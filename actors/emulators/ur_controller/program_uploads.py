"""The queue of uploaded programs: they run one after the other while the controller's connections are served."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.translator import Translated

MOST_WAITING = 100
"""Number of waiting programs above which their senders are no longer read."""

LONG_PROGRAM = 5_000
"""Characters of a program above which a thread translates it: clients drop a connection that sends nothing meanwhile,
ur-rtde after 2.5 s. On a busy machine a translation may take longer.
"""

STOP_PROGRAM = "stop program"
"""Command that is no program: it stops the running one. Source: the manufacturer's client library."""


class Sender(Protocol):
    """The connection that a program came from."""

    @property
    def privileged(self) -> bool:
        """Whether it may send commands now."""

    def refuse(self) -> None:
        """Report that it may not send commands."""

    def wait(self, active: bool) -> None:
        """Stop reading from it, or resume."""


class Uploads:
    """The queue. Programs are translated between two cycles of the clock, long ones in a thread.

    The clock calls `work` with a time limit, so a flood of programs cannot delay it.

    Args:
        controller: runs them.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._waiting: deque[tuple[str, Sender]] = deque()
        self._held: set[Sender] = set()
        self._translation: Future[Translated | ScriptError] | None = None
        self._translator = ThreadPoolExecutor(1, "translator")

    @property
    def translating(self) -> bool:
        """Whether a program is being translated."""
        return self._translation is not None and not self._translation.done()

    def put(self, text: str, sender: Sender) -> None:
        """Queue a program; the sender's privilege is checked when its turn comes."""
        self._waiting.append((text, sender))
        if len(self._waiting) > MOST_WAITING and sender not in self._held:
            self._held.add(sender)
            sender.wait(True)

    def forget(self) -> None:
        """Drop the queue, as at a power cut."""
        self._waiting.clear()
        self._translation = None

    def work(self, seconds: float = 0.0) -> None:
        """Run the next program, and further ones for a time [s]."""
        end = time.monotonic() + seconds
        while self._waiting and not self.translating:
            text, sender = self._waiting[0]
            allowed = sender.privileged
            if allowed and self._translation is None and len(text) > LONG_PROGRAM:
                self._translation = self._translator.submit(self._controller.translated, text)
                break
            self._waiting.popleft()
            translation, self._translation = self._translation, None
            if not allowed:
                sender.refuse()
            elif text.strip() == STOP_PROGRAM:
                self._controller.stop()
            else:
                self._controller.start(
                    self._controller.translated(text) if translation is None else translation.result()
                )
            if time.monotonic() >= end:
                break
        while self._held and len(self._waiting) < MOST_WAITING:
            self._held.pop().wait(False)
