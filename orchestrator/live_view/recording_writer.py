"""The process that writes a campaign's recording; `RerunMonitor` starts it and sends events.

A separate process is used, since drawing and packing take CPU time, and so that its failure does not affect the
campaign. The input is a stream of pickles, whose messages `rerun_subscriber` declares. If the parent process dies, the
stream ends and the recording is completed.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from orchestrator.live_view.recording_sink import SENDING
from orchestrator.live_view.rerun_subscriber import Closing, Missed

if TYPE_CHECKING:
    from orchestrator.live_view.run_recording import CampaignRecording

WAITING = 64
"""Largest number of events waiting here. More wait in the pipe, then at the sender, which counts dropped events."""

NICENESS = 5


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
