"""A balance that replays a recording of its line: `python -m tests.support.recorded_balance` is its process."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from actors.balance.line_recording import LineEvent, LineRecording
from actors.emulators.serial_balance.balance_process import FarProcess
from actors.emulators.serial_balance.line_server import serve


class RecordedBalance(FarProcess):
    """Replays a recording to a client that sends queries."""

    module = "tests.support.recorded_balance"

    @classmethod
    def start(cls, recording: Path, *, speed: float = 1.0) -> RecordedBalance:
        """Start the replay; unsolicited bytes arrive at their times, replies after their queries.

        Args:
            recording: file made by `decant balance record`.
            speed: replay speed relative to the recording.
        """
        return cls({"recording": str(recording), "speed": speed}, baud=0)


class Replay:
    """See `emulated_balance.EmulatedBalance`.

    Bytes before the first recorded query are sent without a query. A query is searched among the recorded ones,
    starting at the last match and wrapping around once. The bytes recorded after it are then sent at their recorded
    pace. An unrecorded query gets no reply.

    Args:
        recording: the recording.
        speed: replay speed relative to the recording.
    """

    def __init__(self, recording: LineRecording, speed: float = 1.0) -> None:
        self._events, self._speed = recording.events, speed
        self._at = 0
        self._received = b""
        self._queue: list[tuple[float, bytes]] = []
        self._begun = False

    def hear(self, data: bytes, now: float) -> None:
        """See `EmulatedBalance.hear`."""
        self._begin(now)
        self._received += data
        while (command := self._find()) is not None:
            self._received = self._received[len(self._events[command].data) :]
            self._at = command + 1
            self._play(command, now)
        longest = max((len(e.data) for e in self._events if e.direction == "out"), default=0)
        if len(self._received) >= longest:
            self._received = b""

    def speak(self, now: float) -> bytes:
        """See `EmulatedBalance.speak`."""
        self._begin(now)
        ready = b"".join(data for at, data in self._queue if at <= now)
        self._queue = [(at, data) for at, data in self._queue if at > now]
        return ready

    def due(self, now: float) -> float | None:
        """See `EmulatedBalance.due`."""
        return min((at for at, _ in self._queue), default=None if self._begun else now)

    def control(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        """See `EmulatedBalance.control`; a recording only supports the command 'state'."""
        if order.get("do") == "state":
            return {"played": self._at, "of": len(self._events)}
        raise ValueError(f"a recording can't do {order.get('do')!r}")

    def _begin(self, now: float) -> None:
        if not self._begun:
            self._begun = True
            self._play(-1, now)

    def _find(self) -> int | None:
        """Return the index of the next recorded query that matches the input."""
        count = len(self._events)
        for step in range(count):
            index = (self._at + step) % count
            event = self._events[index]
            if event.direction == "out" and event.data and self._received.startswith(event.data):
                return index
        return None

    def _play(self, question: int, now: float) -> None:
        """Queue the bytes recorded between a query and the next one."""
        start = self._events[question].time if question >= 0 else 0.0
        following: list[LineEvent] = []
        for event in self._events[question + 1 :]:
            if event.direction == "out":
                break
            following.append(event)
        self._queue = [(now + (event.time - start) / self._speed, event.data) for event in following]


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    serve(given, lambda: Replay(LineRecording.load(Path(given["recording"])), given["speed"]))
