"""The process of an emulated balance: commands on standard input, characters on a pseudo-terminal.

It ends when its standard input ends or its parent ends, whichever comes first. A killed test therefore leaves no
process behind.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from pathlib import Path
from typing import Any

from actors.balance.scale_model import ScaleSettings
from actors.emulators.serial_balance.emulated_balance import EmulatedBalance, Emulation
from actors.emulators.serial_balance.pty_end import PtyEnd

_PARENT_CHECK = 1.0
"""Interval of the check whether the parent is alive [s]."""


class Server:
    """Serves one line and one stream of commands for one emulated balance.

    Args:
        line: the balance's end of the line.
        character: the emulated balance.
    """

    def __init__(self, line: PtyEnd, character: EmulatedBalance) -> None:
        self._line, self._balance = line, character
        self._orders = bytearray()
        self._parent = os.getppid()

    def run(self) -> None:
        """Run until the parent ends or closes its end."""
        wake: float | None = None
        while os.getppid() == self._parent:
            now = time.monotonic()
            timeout = _PARENT_CHECK if wake is None else min(max(wake - now, 0.0), _PARENT_CHECK)
            watched = [0] if self._line.descriptor is None else [0, self._line.descriptor]
            ready, _, _ = select.select(watched, [], [], timeout)
            now = time.monotonic()
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
        *whole, rest = self._orders.split(b"\n")
        self._orders = bytearray(rest)
        for text in whole:
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


def make_character(settings: dict[str, Any]) -> EmulatedBalance:
    """Create the emulated balance.

    Args:
        settings: as `VirtualSerialBalance` or `RecordedBalance` writes them.
    """
    if "recording" in settings:
        from actors.balance.line_recording import LineRecording
        from actors.emulators.serial_balance.pty_end import Replay

        return Replay(LineRecording.load(Path(settings["recording"])), settings["speed"])
    return Emulation(
        settings["dialect"],
        ScaleSettings(**settings["scale"]),
        settings["time_scale"],
        settings["latency"],
        tuple(settings["seed"]),
    )


def main() -> None:
    """Serve with the settings of the first argument, JSON, until the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent decides
    settings = json.loads(sys.argv[1])
    line = PtyEnd(Path(settings["link"]), settings["baud"])
    try:
        character = make_character(settings)
        tell({"port": str(line.link)})
        Server(line, character).run()
    finally:
        line.unplug()
        with contextlib.suppress(OSError):
            line.link.parent.rmdir()


if __name__ == "__main__":
    main()
