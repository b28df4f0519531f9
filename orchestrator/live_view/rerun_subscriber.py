"""The subscriber that records a campaign, and the process that writes the recording.

`RerunMonitor` takes events and starts the writer. `QueueThread` connects both with a bounded queue and one thread: the
recording may be delayed, but it never delays the campaign. The writer (`main`) is a separate process, since drawing and
packing take CPU time, and so that its failure does not affect the campaign. Its input is a stream of pickles:
`Opening`, events, `Missed` and `Closing`. If the parent process dies, the stream ends and the recording is completed.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pickle
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Generic, TypeVar

from actors.runtime.child_process import ChildProcess
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.live_view.viewer_server import SENDING, environment
from orchestrator.records.events import Event
from orchestrator.runs.run_folder import RECORDING
from sim_engine.resources import installed

if TYPE_CHECKING:
    from orchestrator.live_view.run_recording import CampaignRecording


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
                    exc_info=None if isinstance(error, OSError) else error,
                )


CAPACITY = 4_000
"""Largest number of waiting events: minutes of a busy campaign."""

CLOSE_TIMEOUT = 30.0
"""Longest time to wait until the recording is complete while its process does nothing [s]: a disk may hang."""


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
        self._given_up = False
        self._report: dict[str, Any] = {"failed": 0}
        self._reported = 0
        self._worker: QueueThread[Event | Opening] = QueueThread(
            self._send, self._finish, capacity=capacity, name=f"recording {self.path.name}"
        )
        self._worker.put(Opening(self.path, plan, url))

    def __call__(self, event: Event) -> None:
        """Queue an event. Returns at once."""
        if not event.internal:
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

    def close(self, timeout: float = CLOSE_TIMEOUT) -> bool:
        """Write waiting events; return False if the file could not be completed. Never raises.

        Args:
            timeout: longest time without progress of the process that writes, which a busy machine makes slow [s].
        """
        used = 0.0
        while not self._worker.close(timeout):
            if (now := self._process.cpu_time) <= used:
                self._given_up = True
                _log.warning(
                    "recording %s: could not be completed: nothing was written in %g s", self.path.name, timeout
                )
                break
            used = now
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
            line = self._process.read_line()
        except EOFError:
            if self._given_up:
                return
            raise ChildProcessError(
                f"the process that writes {self.path} has died; what it had written is kept"
            ) from None
        self._report = {"complete": True} | json.loads(line)
        if self._report["failed"]:
            _log.warning(
                "recording %s: %d event(s) could not be drawn; the first: %s",
                *(self.path.name, self._report["failed"], self._report["problem"]),
            )


def can_record(plan: CampaignPlan) -> bool:
    """Whether runs of a campaign are recorded: recording is enabled and Rerun is installed."""
    return plan.outputs.recording and installed("rerun")


def recorder_of(plan: CampaignPlan, run: Path, tell: Callable[[str], object], url: str = "") -> RerunMonitor | None:
    """Return the subscriber that writes a run's recording; None if recording is disabled or Rerun is not installed.

    Args:
        plan: plan of the campaign.
        run: folder of the run.
        tell: called with the reason if recording is enabled but impossible.
        url: see `RerunMonitor`.

    Raises:
        OSError: the recording can't be written.
    """
    if can_record(plan):
        return RerunMonitor(run / RECORDING, plan, url=url)
    if plan.outputs.recording:
        tell("no recording: it needs Rerun, which is not installed (pip install 'decant-pouring[live]')")
    return None


def _start_writer() -> ChildProcess:
    # Everything importable here must be importable there, since plug-ins may be part of the settings.
    variables = environment() | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", "from orchestrator.live_view.rerun_subscriber import main; main()"]
    return ChildProcess(command, environment=variables, errors="dropped")


def free_path(path: Path) -> Path:
    """Return `path`, or the first of name-2, name-3 … that does not exist."""
    number, candidate = 2, path
    while candidate.exists():
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return candidate


WAITING = 64
"""Largest number of events waiting here. More wait in the pipe, then at the sender, which counts dropped events."""

NICENESS = 5


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


def main() -> None:
    """Write until closed or until the parent process has ended; then print the result as JSON on stdout."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of the input ends this process
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    opening = pickle.load(sys.stdin.buffer)
    from orchestrator.live_view.run_recording import CampaignRecording

    recording = CampaignRecording(opening.path, opening.plan, url=opening.url)
    report = Writing(recording).run(sys.stdin.buffer)
    print(json.dumps(report), flush=True)
    # Rerun's threads may still wait for a server that no longer exists; everything is written.
    os._exit(0)


class Writing:
    """Passes events to a recording, and starts due playback.

    It works in rounds that are at least `SENDING` apart: viewers receive nothing earlier, and waking up for each event
    costs as much as drawing it.

    Args:
        recording: recording that handles the events.
    """

    def __init__(self, recording: CampaignRecording) -> None:
        self._recording = recording
        self._queue: queue.Queue[Any] = queue.Queue(maxsize=WAITING)
        self._hurry = threading.Event()
        self._next_round = 0.0
        self.failed = 0
        self.problem = ""

    def run(self, source: IO[bytes]) -> dict[str, Any]:
        """Process all messages until the end.

        Returns:
            'failed': number of events that could not be drawn; 'problem': the first reason.
        """
        threading.Thread(target=self._read, args=(source,), daemon=True).start()
        while True:
            for item in self._round():
                if isinstance(item, Closing):
                    self._guard(lambda item=item: self._recording.close(item.dropped))  # type: ignore[misc]
                    self._guard(lambda: optimise(self._recording.path))
                    return {"failed": self.failed, "problem": self.problem}
                if isinstance(item, Missed):
                    self._recording.missed(item.dropped)
                else:
                    self._guard(lambda item=item: self._recording.handle(item))  # type: ignore[misc]
                if not self._pause:  # many events have arrived, or drawing took long
                    self._guard(self._recording.play)
                    self._next_round = time.monotonic() + SENDING
            self._guard(self._recording.play)

    def _round(self) -> list[Any]:
        """Wait for work, and return the messages since the previous round."""
        items, wait = [], self._recording.wait
        with contextlib.suppress(queue.Empty):
            items.append(self._queue.get(timeout=None if wait is None else max(wait, self._pause)))
        if not items or not isinstance(items[0], Closing):
            self._hurry.wait(self._pause)
        self._hurry.clear()
        with contextlib.suppress(queue.Empty):
            while len(items) < WAITING:
                items.append(self._queue.get_nowait())
        self._next_round = time.monotonic() + SENDING
        return items

    @property
    def _pause(self) -> float:
        """Time until the next round [s]."""
        return max(self._next_round - time.monotonic(), 0.0)

    def _read(self, source: IO[bytes]) -> None:
        last: Any = Closing(0)
        try:
            while True:
                item = pickle.load(source)
                if isinstance(item, Closing):
                    last = item
                    return
                if self._queue.full():
                    self._hurry.set()
                self._queue.put(item)
        except (EOFError, OSError):
            return  # the sender is dead
        except Exception as error:  # an incomplete message, or one that can't be unpickled here
            self._note(error)
        finally:
            self._hurry.set()
            self._queue.put(last)
            self._hurry.set()

    def _guard(self, action: Callable[[], object]) -> None:
        try:
            action()
        except Exception as error:
            self._note(error)

    def _note(self, error: Exception) -> None:
        self.failed += 1
        if self.failed == 1:
            self.problem = "".join(traceback.format_exception(error))


def optimise(path: Path) -> None:
    """Rewrite a closed recording in few large chunks, which viewers load many times as fast.

    The file is replaced atomically; if there is no space for a second file, it remains unchanged.

    Raises:
        OSError: it can't be rewritten.
    """
    from orchestrator.live_view.viewer_server import run_rerun

    new = path.with_suffix(".optimising.rrd")
    try:
        done = run_rerun("rrd", "optimize", str(path), "-o", str(new))
        if done.returncode != 0 or not new.stat().st_size:
            raise OSError(f"{path}: could not be optimised: {done.stderr.strip()}")
        new.replace(path)
    finally:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
