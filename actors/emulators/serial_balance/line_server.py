"""The process of an emulated balance: commands on standard input, characters on a terminal or TCP connection.

`PtyEnd` is the balance's end of the terminal. It sends characters at the line's speed, garbles them for a client with
another speed, and can be unplugged. `TcpEnd` is a serial server with one client at a time.

The process ends when its standard input ends or its parent ends, whichever comes first. A killed test therefore leaves
no process behind.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import sys
import termios
import tty
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from actors.balance.scale_model import ScaleSettings
from actors.emulators.serial_balance.emulated_balance import EmulatedBalance, Emulation
from actors.runtime.bench_clock import DeviceClock, device_clock


class LineEnd(ABC):
    """The balance's end of a line: it sends characters one by one, at the line's speed.

    Args:
        baud: the speed; 0: characters take no time.
    """

    def __init__(self, baud: int) -> None:
        self._baud = baud
        self._queue: deque[tuple[float, int]] = deque()
        self._free_at = 0.0
        self.plug()

    @property
    @abstractmethod
    def port(self) -> str:
        """Address for clients."""

    @property
    @abstractmethod
    def descriptor(self) -> int | None:
        """File descriptor to wait for; None while unplugged."""

    @abstractmethod
    def plug(self) -> None:
        """Plug the line in."""

    @abstractmethod
    def unplug(self) -> None:
        """Unplug the line; unsent characters are lost."""

    @abstractmethod
    def receive(self) -> bytes:
        """Return the bytes from the client."""

    @abstractmethod
    def _write(self, data: bytes) -> None:
        """Send bytes now; they are lost if there is no client."""

    def send(self, data: bytes, now: float) -> None:
        """Queue bytes; they are sent character by character.

        Args:
            data: the bytes.
            now: time of the clock [s].
        """
        if self.descriptor is None:
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
            self._write(bytes(due))
        return self._queue[0][0] if self._queue else None


class PtyEnd(LineEnd):
    """A serial line.

    Args:
        link: path of the line while it is plugged in, like those under /dev/serial/by-id.
        baud: its speed; a client with another speed receives garbled characters. 0: any speed, and characters take no
            time.

    Limitations: Linux keeps neither parity nor character length of a pseudo-terminal, so their settings are not
    checked.
    """

    def __init__(self, link: Path, baud: int) -> None:
        self.link = link
        self._speed = getattr(termios, f"B{baud}") if baud else None
        self._master = self._slave = -1
        super().__init__(baud)

    @property
    def port(self) -> str:
        """See `LineEnd.port`."""
        return str(self.link)

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

    def _write(self, data: bytes) -> None:
        """See `LineEnd._write`."""
        if not self._speed_matches():
            data = bytes((37 * byte + 91) & 0xFF for byte in data)
        with contextlib.suppress(OSError):  # if the client does not read, bytes beyond the buffer are lost
            os.write(self._master, data)

    def _speed_matches(self) -> bool:
        if self._speed is None:
            return True
        with contextlib.suppress(termios.error):
            return bool(termios.tcgetattr(self._master)[5] == self._speed)
        return False


class TcpEnd(LineEnd):
    """A serial server on a loopback port of its own, which stays the same when it is unplugged and plugged in again.

    Args:
        baud: speed of the line behind it; 0: characters take no time.
    """

    def __init__(self, baud: int) -> None:
        self._address = ("127.0.0.1", 0)
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        super().__init__(baud)

    @property
    def port(self) -> str:
        """See `LineEnd.port`."""
        return f"{self._address[0]}:{self._address[1]}"

    @property
    def descriptor(self) -> int | None:
        """See `LineEnd.descriptor`."""
        waiting = self._client or self._listener
        return None if waiting is None else waiting.fileno()

    def plug(self) -> None:
        """See `LineEnd.plug`."""
        if self._listener is None:
            self._listener = socket.create_server(self._address)
            self._address = self._listener.getsockname()[:2]

    def unplug(self) -> None:
        """See `LineEnd.unplug`."""
        for end in (self._client, self._listener):
            if end is not None:
                end.close()
        self._client = self._listener = None
        self._queue.clear()

    def receive(self) -> bytes:
        """See `LineEnd.receive`; accepts a client if there is none."""
        if self._client is None:
            assert self._listener is not None
            self._client, _ = self._listener.accept()
            self._client.setblocking(False)
            return b""
        data = b""
        with contextlib.suppress(ConnectionError):
            data = self._client.recv(4096)
        if not data:  # the client has gone
            self._client.close()
            self._client = None
        return data

    def _write(self, data: bytes) -> None:
        """See `LineEnd._write`."""
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)


SHORTEST_WAIT = 0.001
"""Shortest wait of the server [s]."""

_LONGEST_WAIT = 0.05
"""Longest wait of the server, in which it also checks whether its parent is alive [s]."""

_LATEST = 0.02
"""Time after a wait within which the server acts [s]: a clock that it shares waits for a late one."""


class Server:
    """Serves one line and one stream of commands for one emulated balance.

    Args:
        line: the balance's end of the line.
        character: the emulated balance.
        clock: of the balance and its line.
    """

    def __init__(self, line: LineEnd, character: EmulatedBalance, clock: DeviceClock) -> None:
        self._line, self._balance, self._clock = line, character, clock
        self._orders = bytearray()
        self._parent = os.getppid()

    def run(self) -> None:
        """Run until the parent ends or closes its end."""
        try:
            self._serve()
        finally:
            self._clock.withdraw("balance")

    def _serve(self) -> None:
        wake: float | None = None
        while os.getppid() == self._parent:
            now = self._clock.now
            # a shared clock advances in steps, or stands
            timeout = _LONGEST_WAIT if wake is None else min(max(wake - now, SHORTEST_WAIT), _LONGEST_WAIT)
            self._clock.promise("balance", timeout + _LATEST)
            watched = [0] if self._line.descriptor is None else [0, self._line.descriptor]
            ready, _, _ = select.select(watched, [], [], timeout)
            now = self._clock.now
            if 0 in ready and not self._take_orders(now):
                return
            if self._line.descriptor is not None and self._line.descriptor in ready:
                self._balance.hear(self._line.receive(), now)
            self._line.send(self._balance.speak(now), now)
            times = [self._line.pump(now), self._balance.due(now)]
            wake = min((moment for moment in times if moment is not None), default=None)

    def _take_orders(self, now: float) -> bool:
        """Execute the commands from standard input; return False at its end."""
        data = os.read(0, 65536)
        self._orders += data
        *lines, incomplete = self._orders.split(b"\n")
        self._orders = bytearray(incomplete)
        for text in lines:
            try:
                answer = self._order(json.loads(text), now)
            except (KeyError, TypeError, ValueError, OSError) as error:
                answer = {"error": f"{type(error).__name__}: {error}"}
            tell(answer)
        return bool(data)

    def _order(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        match order.get("do"):
            case "unplug":
                self._line.unplug()
            case "plug":
                self._line.plug()
            case _:
                return self._balance.control(order, now)
        return {}


def tell(answer: dict[str, Any]) -> None:
    """Write a reply to standard output; a reader that has gone is ignored."""
    with contextlib.suppress(BrokenPipeError):
        os.write(1, json.dumps(answer).encode("ascii") + b"\n")


def serve(settings: dict[str, Any], make: Callable[[], EmulatedBalance]) -> None:
    """Serve an emulated balance until the parent ends.

    Args:
        settings: of the line, as `balance_process.FarProcess` writes them.
        make: creates the emulated balance.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent decides
    link = Path(settings["link"])
    line = TcpEnd(settings["baud"]) if settings["tcp"] else PtyEnd(link, settings["baud"])
    try:
        balance = make()
        tell({"port": line.port})
        Server(line, balance, device_clock(settings.get("clock", ""))).run()
    finally:
        line.unplug()
        with contextlib.suppress(OSError):
            link.parent.rmdir()


def emulation(settings: dict[str, Any]) -> Emulation:
    """The emulated balance of settings as `VirtualSerialBalance` writes them."""
    scale, seed = ScaleSettings(**settings["scale"]), tuple(settings["seed"])
    return Emulation(settings["dialect"], scale, settings["time_scale"], settings["latency"], seed)


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    serve(given, lambda: emulation(given))
