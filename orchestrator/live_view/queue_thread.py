"""A bounded queue and one thread behind it: what watches may fall behind, never hold up."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

_log = logging.getLogger(__name__)

Item = TypeVar("Item")


class QueueThread(Generic[Item]):
    """Runs `handle` on every item in a thread of its own.

    Items that find the queue full are dropped and counted; a handler that raises is counted, and reported once.

    Args:
        handle: called in the thread, one item after the other.
        finish: called once in the thread after the last item.
        capacity: items that may wait.
        name: of the thread, and in reports.
    """

    def __init__(self, handle: Callable[[Item], None], finish: Callable[[], None], *, capacity: int, name: str) -> None:
        self._handle, self._finish, self._name = handle, finish, name
        self._queue: queue.Queue[Item] = queue.Queue(maxsize=capacity)
        self._stop = threading.Event()
        self.dropped = 0
        """Items that were not handled because the queue was full, or because the worker had been closed."""
        self.failed = 0
        """Items whose handler raised."""
        # A daemon: a disk that hangs must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> bool:
        """Hand over an item; False if it was dropped. Never waits, never raises."""
        if self._stop.is_set():
            self.dropped += 1
            return False
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def close(self, timeout: float) -> bool:
        """Handle what waits, finish, and end the thread; False if that took longer than `timeout` [s]."""
        self._stop.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            try:
                item = self._queue.get(timeout=0.1)
            except queue.Empty:
                if self._stop.is_set():
                    break
                continue
            self._guard(lambda item=item: self._handle(item))  # type: ignore[misc]
        self._guard(self._finish)

    def _guard(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self.failed += 1
            if self.failed == 1:
                _log.warning(
                    "%s: %s: %s (reported once; the run goes on)",
                    self._name,
                    type(error).__name__,
                    error,
                    exc_info=error,
                )
