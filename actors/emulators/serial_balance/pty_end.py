"""The balance's end of a pseudo-terminal, and the replay of a recording on it.

`PtyEnd` sends characters at the line's speed, garbles them for a client with another speed, and can be unplugged.
`Replay` is an `EmulatedBalance` that gives each query the recorded reply.
"""

from __future__ import annotations

import contextlib
import os
import termios
import tty
from collections import deque
from pathlib import Path
from typing import Any

from actors.balance.line_recording import LineEvent, LineRecording


class PtyEnd:
    """The balance's end of a serial line.

    Args:
        link: path of the line while it is plugged in, like those under /dev/serial/by-id.
        baud: its speed; a client with another speed receives garbled characters. 0: any speed, and characters take no
            time.

    Limitations: Linux keeps neither parity nor character length of a pseudo-terminal, so their settings are not
    checked.
    """

    def __init__(self, link: Path, baud: int) -> None:
        self.link, self._baud = link, baud
        self._speed = getattr(termios, f"B{baud}") if baud else None
        self._master = self._slave = -1
        self._queue: deque[tuple[float, int]] = deque()
        self._free_at = 0.0
        self.plug()

    @property
    def descriptor(self) -> int | None:
        """File descriptor to wait for; None while unplugged."""
        return self._master if self._master >= 0 else None

    def plug(self) -> None:
        """Plug the line in: a new device under the same path."""
        if self._master >= 0:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # no echo before a client opens it
        os.set_blocking(self._master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Unplug the line; unsent characters are lost."""
        self.link.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._master = self._slave = -1
        self._queue.clear()

    def receive(self) -> bytes:
        """Return the bytes from the client; none if it uses another speed."""
        with contextlib.suppress(OSError):
            data = os.read(self._master, 4096)
            return data if self._speed_matches() else b""
        return b""

    def send(self, data: bytes, now: float) -> None:
        """Queue bytes; they are sent character by character.

        Args:
            data: the bytes.
            now: time of the clock [s].
        """
        if self._master < 0:
            return
        time_each = 10.0 / self._baud if self._baud else 0.0
        at = max(now, self._free_at)
        for byte in data:
            at += time_each
            self._queue.append((at, byte))
        self._free_at = at

    def pump(self, now: float) -> float | None:
        """Send the characters that are due.

        Returns:
            Time of the next character; None if none is left.
        """
        due = bytearray()
        while self._queue and self._queue[0][0] <= now:
            due.append(self._queue.popleft()[1])
        if due:
            data = bytes(due) if self._speed_matches() else bytes((37 * byte + 91) & 0xFF for byte in due)
            with contextlib.suppress(OSError):  # if the client does not read, bytes beyond the buffer are lost
                os.write(self._master, data)
        return self._queue[0][0] if self._queue else None

    def _speed_matches(self) -> bool:
        if self._speed is None:
            return True
        with contextlib.suppress(termios.error):
            return bool(termios.tcgetattr(self._master)[5] == self._speed)
        return False


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
        while (found := self._find()) is not None:
            self._received = self._received[len(self._events[found].data) :]
            self._at = found + 1
            self._play(found, now)
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
