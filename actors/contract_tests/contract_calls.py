"""Shared by the contracts: a call in a thread of its own, and the time limit for results."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

EVENT_TIMEOUT = 60.0
"""Time after which an expected event counts as missing [s]."""


class Call(threading.Thread):
    """A blocking call that runs in a thread."""

    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        super().__init__(daemon=True)
        self._call, self._arguments = call, arguments
        self.value: Any = None
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        """See `threading.Thread.run`."""
        try:
            self.value = self._call(*self._arguments)
        except Exception as error:
            self.error = error

    def ended(self) -> Exception | None:
        """Wait for the end of the call; return the exception that it raised, or None."""
        self.join(EVENT_TIMEOUT)
        assert not self.is_alive(), f"the call has not come back after {EVENT_TIMEOUT:g} s"
        return self.error
