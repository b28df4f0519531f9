"""The process that writes a campaign's recording, fed by `monitor.RerunMonitor`.

It has a process of its own, for drawing and packing cost time that control doesn't have, and because whatever happens
to it happens to nobody else. Its input is a stream of pickles from the process that started it: `Opening`, events,
`Closing`. When that process dies, however it dies, the stream ends, and the recording is completed.
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
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from orchestrator.live_view.recording_sink import SENDING

if TYPE_CHECKING:
    from orchestrator.live_view.run_recording import CampaignRecording
    from orchestrator.strategies.campaign_plan import CampaignPlan

WAITING = 64
"""Events that wait in this process; more wait in the pipe, then at the sender, who counts those that he drops."""

NICENESS = 5


@dataclass(frozen=True)
class Opening:
    """The first message.

    Attributes:
        path: of the `.rrd`.
        url: of a Rerun server to send to as well; '' for none.
    """

    path: Path
    plan: CampaignPlan
    url: str = ""


@dataclass(frozen=True)
class Missed:
    """So many events were dropped until now."""

    dropped: int


@dataclass(frozen=True)
class Closing:
    """The last message; `dropped` events never came."""

    dropped: int


def main() -> None:
    """Write until told to close, or until nobody is there any more; then say on stdout how it went, as JSON."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of the input says when to end
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    opening = pickle.load(sys.stdin.buffer)
    from orchestrator.live_view.run_recording import CampaignRecording

    recording = CampaignRecording(opening.path, opening.plan, url=opening.url)
    report = Writing(recording).run(sys.stdin.buffer)
    print(json.dumps(report), flush=True)
    # Rerun's threads may still wait for a server that is gone; everything is written.
    os._exit(0)


class Writing:
    """Hands events to a recording, and what it has planned for later at its time.

    It does so in rounds, each at least `SENDING` after the one before: whoever watches is shown nothing sooner, and to
    wake up for each event costs as much as to draw it.

    Args:
        recording: that takes them.
    """

    def __init__(self, recording: CampaignRecording) -> None:
        self._recording = recording
        self._queue: queue.Queue[Any] = queue.Queue(maxsize=WAITING)
        self._hurry = threading.Event()
        self._next_round = 0.0
        self.failed = 0
        self.problem = ""

    def run(self, source: IO[bytes]) -> dict[str, Any]:
        """Everything from the source to its end.

        Returns:
            'failed': events that could not be drawn; 'problem': the first reason.
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
                if not self._pause:  # much has come, or there was much to draw
                    self._guard(self._recording.play)
                    self._next_round = time.monotonic() + SENDING
            self._guard(self._recording.play)

    def _round(self) -> list[Any]:
        """What has come since the round before, once there is something to do."""
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
        """Until the next round [s]."""
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
            return  # whoever sent is dead
        except Exception as error:  # half a message, or one that can't be read here
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
    """Rewrite a closed recording in few large pieces, which a viewer loads many times as fast.

    The file is replaced at once or not at all: where there is no room for a second one it stays as it was.

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
