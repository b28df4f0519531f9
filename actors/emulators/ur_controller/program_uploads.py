"""The queue of uploaded programs: they run one after the other while the controller's clock continues."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Protocol

from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.translator import LONGEST_HERE, Translated, question, read_answer
from actors.runtime.child_process import python_module, run_async

MOST_WAITING = 100
"""Number of waiting programs above which their senders are no longer read."""

STOP_PROGRAM = "stop program"
"""Command that is no program: it stops the running one. Source: the manufacturer's client library."""

TRANSLATION_TIMEOUT = 60.0
"""Longest wait for a translation in a separate process [s of wall time]."""


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
    """The queue. Short programs are translated between two cycles of the clock, long ones in a process of their own.

    The clock calls `work` with a time limit, so a flood of programs cannot delay it.

    Args:
        controller: runs them.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._waiting: deque[tuple[str, Sender]] = deque()
        self._held: set[Sender] = set()
        self._translation: asyncio.Task[None] | None = None

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
        """Run the next program, and further ones for a time [s]; none while a separate translation is pending."""
        end = time.monotonic() + seconds
        while self._waiting and (self._translation is None or self._translation.done()):
            text, sender = self._waiting.popleft()
            if not sender.privileged:
                sender.refuse()
            elif text.strip() == STOP_PROGRAM:
                self._controller.stop()
            elif len(text) <= LONGEST_HERE:
                self._controller.upload(text)
            else:
                self._translation = asyncio.get_running_loop().create_task(self._upload_translated(text, sender))
            if time.monotonic() >= end:
                break
        while self._held and len(self._waiting) < MOST_WAITING:
            self._held.pop().wait(False)

    async def _upload_translated(self, text: str, sender: Sender) -> None:
        try:
            translated = await self._translate_in_process(text)
        except Exception as error:
            self._controller.refuse(error)
            return
        if sender.privileged:
            self._controller.begin(translated)
        else:
            sender.refuse()

    async def _translate_in_process(self, text: str) -> Translated:
        request = question(text, self._controller.known_commands)
        try:
            answer = await run_async(
                python_module("actors.emulators.ur_controller.urscript.translator"),
                request,
                timeout=TRANSLATION_TIMEOUT,
            )
        except TimeoutError:
            answer = b""
        except OSError as error:
            raise ScriptError(f"no process to translate it could be started: {error}") from error
        return read_answer(answer)
