"""The far end of a pseudo-terminal: paced characters, another speed is gibberish, and a plug that can be pulled."""

from __future__ import annotations

import contextlib
import os
import termios
import tty
from collections import deque
from pathlib import Path


class FarEnd:
    """A serial line as the balance has it.

    Args:
        link: path that leads to the line while it is plugged in, like those under /dev/serial/by-id.
        baud: its speed; a client with another one gets gibberish. 0: any speed, and no time for characters.

    Limitations: Linux keeps neither parity nor character length of a pseudo-terminal, so these can't be wrong.
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
        """To wait for; None while unplugged."""
        return self._master if self._master >= 0 else None

    def plug(self) -> None:
        """Plug it in: a new device under the same name."""
        if self._master >= 0:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # no echo before a client opens it
        os.set_blocking(self._master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Pull it out; what was under way is lost."""
        self.link.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
        self._master = self._slave = -1
        self._queue.clear()

    def receive(self) -> bytes:
        """What came from the client; nothing if it talks at another speed."""
        with contextlib.suppress(OSError):
            data = os.read(self._master, 4096)
            return data if self._understands() else b""
        return b""

    def send(self, data: bytes, now: float) -> None:
        """Say something; it leaves character by character.

        Args:
            data: what.
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
        """Let characters go whose time has come.

        Returns:
            When the next one is due; None if none is left.
        """
        due = bytearray()
        while self._queue and self._queue[0][0] <= now:
            due.append(self._queue.popleft()[1])
        if due:
            data = bytes(due) if self._understands() else bytes((37 * byte + 91) & 0xFF for byte in due)
            with contextlib.suppress(OSError):  # a client that reads nothing loses what doesn't fit
                os.write(self._master, data)
        return self._queue[0][0] if self._queue else None

    def _understands(self) -> bool:
        if self._speed is None:
            return True
        with contextlib.suppress(termios.error):
            return bool(termios.tcgetattr(self._master)[5] == self._speed)
        return False
