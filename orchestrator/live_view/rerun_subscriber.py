"""The subscriber that records a campaign, in a process of its own.

`RerunMonitor` takes events and starts the writer (`recording_writer`). `QueueThread` connects both with a bounded queue
and one thread: the recording may be delayed, but it never delays the campaign.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from actors.runtime.child_process import ChildProcess
from orchestrator.live_view.viewer_server import environment
from orchestrator.runs.events import Event
from orchestrator.strategies.campaign_plan import CampaignPlan

_log = logging.getLogger(__name__)

Item = TypeVar("Item")


class QueueThread(Generic[Item]):
    """Runs `handle` on every item in a separate thread.

    Items that arrive while the queue is full are dropped and counted. Errors of the handler are counted, and the first
    one is logged.

    Args:
        handle: called in the thread, one item after the other.
        finish: called once in the thread after the last item.
        capacity: largest number of waiting items.
        name: name of the thread, also used in log messages.
    """

    def __init__(self, handle: Callable[[Item], None], finish: Callable[[], None], *, capacity: int, name: str) -> None:
        self._handle, self._finish, self._name = handle, finish, name
        self._queue: queue.Queue[Item] = queue.Queue(maxsize=capacity)
        self._stop = threading.Event()
        self.dropped = 0
        """Items that were not handled because the queue was full or the thread had been closed."""
        self.failed = 0
        """Items whose handler raised."""
        # A daemon thread: a disk that hangs must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> bool:
        """Add an item; return False if it was dropped. Never waits, never raises."""
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
        """Handle waiting items, finish, and end the thread; return False if that takes longer than `timeout` [s]."""
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


CAPACITY = 4_000
"""Largest number of waiting events: minutes of a busy campaign."""

PATIENCE = 30.0
"""Longest time to wait until the recording is complete [s]."""


@dataclass(frozen=True)
class Opening:
    """The first message.

    Attributes:
        path: path of the `.rrd`.
        url: URL of a Rerun server to send to as well; '' for none.
    """

    path: Path
    plan: CampaignPlan
    url: str = ""


@dataclass(frozen=True)
class Missed:
    """Number of events dropped so far."""

    dropped: int


@dataclass(frozen=True)
class Closing:
    """The last message; `dropped` is the number of missing events."""

    dropped: int


class RerunMonitor:
    """Records a campaign with Rerun; a subscriber of its events.

    Events pass through a bounded queue to a thread, which pickles them for a process that draws and writes. If that
    process or its disk is too slow, hangs or dies, events are dropped and counted. The campaign never waits for the
    recording, and no error of the recording reaches it.

    Args:
        path: `.rrd` to write; if it exists (a resumed run), the next free name next to it is used.
        plan: plan of the campaign.
        url: URL of a Rerun server that gets the same rows, see `orchestrator.live_view.live_server`.
        capacity: largest number of waiting events.

    Raises:
        OSError: the file can't be written (raised before the campaign starts, while the user can fix it).

    Limitations: the recording of a resumed run contains everything in the journal, except particles of simulations
    before the interruption; the earlier recording contains these.
    """

    def __init__(self, path: Path, plan: CampaignPlan, *, url: str = "", capacity: int = CAPACITY) -> None:
        self.path = free_path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # The writer could report this only after the start of the campaign.
        self.path.open("wb").close()
        self._process = _start_writer()
        self._report: dict[str, Any] = {"failed": 0}
        self._reported = 0
        self._worker: QueueThread[Event | Opening] = QueueThread(
            self._send, self._finish, capacity=capacity, name=f"recording {self.path.name}"
        )
        self._worker.put(Opening(self.path, plan, url))

    def __call__(self, event: Event) -> None:
        """Queue an event. Returns at once."""
        self._worker.put(event)

    @property
    def pid(self) -> int:
        """Process id of the writer."""
        return self._process.pid

    @property
    def dropped(self) -> int:
        """Events that are missing from the recording because they were dropped."""
        return self._worker.dropped

    @property
    def failed(self) -> int:
        """Known number of events that couldn't be written; complete only after `close`."""
        return self._worker.failed + int(self._report["failed"])

    def close(self, timeout: float = PATIENCE) -> bool:
        """Write waiting events; return False if the file could not be completed within `timeout` [s]. Never raises."""
        if not self._worker.close(timeout):
            _log.warning("recording %s: could not be completed within %g s", self.path.name, timeout)
        self._process.kill()  # finished, or beyond recovery
        self._worker.close(1.0)
        return self._report.get("complete", False) is True

    def _send(self, item: Event | Opening | Missed | Closing) -> None:
        if (dropped := self._worker.dropped if isinstance(item, Event) else 0) > self._reported:
            self._reported = dropped
            self._send(Missed(dropped))
        self._process.write(pickle.dumps(item, protocol=pickle.HIGHEST_PROTOCOL))

    def _finish(self) -> None:
        self._send(Closing(self.dropped))
        self._process.close_input()
        try:
            said = self._process.read_line()
        except EOFError:
            raise ChildProcessError(
                f"the process that writes {self.path} has died; what it had written is kept"
            ) from None
        self._report = {"complete": True} | json.loads(said)
        if self._report["failed"]:
            _log.warning(
                "recording %s: %d event(s) could not be drawn; the first: %s",
                *(self.path.name, self._report["failed"], self._report["problem"]),
            )


def _start_writer() -> ChildProcess:
    # Everything importable here must be importable there, since plug-ins may be part of the settings.
    variables = environment() | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", "from orchestrator.live_view.recording_writer import main; main()"]
    return ChildProcess(command, environment=variables, errors="dropped")


def free_path(path: Path) -> Path:
    """Return `path`, or the first of name-2, name-3 … that does not exist."""
    number, candidate = 2, path
    while candidate.exists():
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return candidate
