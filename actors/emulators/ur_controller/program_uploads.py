"""The queue of uploaded programs: they run one after the other while the controller's clock continues."""

from __future__ import annotations

import time
from collections import deque
from typing import Protocol

from actors.emulators.ur_controller.controller import Controller

MOST_WAITING = 100
"""Number of waiting programs above which their senders are no longer read."""

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
    """The queue. Programs are translated between two cycles of the clock.

    The clock calls `work` with a time limit, so a flood of programs cannot delay it.

    Args:
        controller: runs them.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._waiting: deque[tuple[str, Sender]] = deque()
        self._held: set[Sender] = set()

    def put(self, text: str, sender: Sender) -> None:
        """Queue a program; the sender's privilege is checked when its turn comes."""
        self._waiting.append((text, sender))
        if len(self._waiting) > MOST_WAITING and sender not in self._held:
            self._held.add(sender)
            sender.wait(True)

    def forget(self) -> None:
        """Drop the queue, as at a power cut."""
        self._waiting.clear()

    def work(self, seconds: float = 0.0) -> None:
        """Run the next program, and further ones for a time [s]."""
        end = time.monotonic() + seconds
        while self._waiting:
            text, sender = self._waiting.popleft()
            if not sender.privileged:
                sender.refuse()
            elif text.strip() == STOP_PROGRAM:
                self._controller.stop()
            else:
                self._controller.upload(text)
            if time.monotonic() >= end:
                break
        while self._held and len(self._waiting) < MOST_WAITING:
            self._held.pop().wait(False)
