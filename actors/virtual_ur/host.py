"""The process around a controller: its clock, its ports, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import os
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from actors.virtual_ur.controller import Controller
from actors.virtual_ur.servers import dashboard_server, primary_server, rtde_server, script_server
from actors.virtual_ur.servers.connections import Connections
from actors.virtual_ur.servers.dashboard_server import Dashboard, DashboardConnection
from actors.virtual_ur.servers.primary_server import PrimaryConnection, PrimaryServer
from actors.virtual_ur.servers.rtde_server import RtdeConnection, RtdeServer
from actors.virtual_ur.servers.script_server import ScriptConnection

SLOWEST_WAKE = 0.002
"""Wall time between two wake-ups of the clock at most rate [s]; where time is scaled up each does several ticks."""

MOST_BEHIND = 0.1
"""Wall time that the clock may fall behind before it lets the rest go [s]: a controller never catches up in a rush."""


@dataclass
class Timing:
    """How well the clock kept time.

    Attributes:
        ticks: done.
        late: wake-ups later than two periods.
        worst: latest wake-up [s].
        dropped: wall time that was let go because the process was too far behind [s].
        busy: processor time used by this process [s]; `since` the start of the clock [s of wall time].
    """

    ticks: int = 0
    late: int = 0
    worst: float = 0.0
    dropped: float = 0.0
    started: float = 0.0
    busy_at_start: float = 0.0

    def report(self) -> dict[str, float]:
        """For people and tests."""
        wall = max(time.monotonic() - self.started, 1e-9)
        return {
            "ticks": self.ticks,
            "late": self.late,
            "worst": self.worst,
            "dropped": self.dropped,
            "wall": wall,
            "cpu": (time.process_time() - self.busy_at_start) / wall,
        }


class Host:
    """Ports and clock of one controller.

    Args:
        controller: what is hosted.
        address: of all ports.
    """

    def __init__(self, controller: Controller, address: str) -> None:
        self.controller = controller
        self.address = address
        self.timing = Timing()
        self.halted = False
        self.connections = Connections(controller)
        self.rtde = RtdeServer(controller, self.connections)
        self.primary = PrimaryServer(controller, self.connections)
        self.dashboard = Dashboard(controller)
        self.messages: deque[str] = deque(maxlen=50)
        controller.listeners.append(lambda message: self.messages.append(f"{message.kind}: {message.text}"))
        self._servers: list[asyncio.Server] = []
        self._opening: asyncio.Task[None] | None = None
        self._clock: asyncio.TimerHandle | None = None
        self._next = 0.0

    # ---- ports

    def _doors(self) -> list[tuple[int, Callable[[], asyncio.Protocol]]]:
        def primary_door(messages: bool, writable: bool) -> Callable[[], asyncio.Protocol]:
            return lambda: PrimaryConnection(self.primary, messages=messages, writable=writable)

        return [
            (rtde_server.PORT, lambda: RtdeConnection(self.rtde)),
            (script_server.PORT, lambda: ScriptConnection(self.connections)),
            (dashboard_server.PORT, lambda: DashboardConnection(self.connections, self.dashboard)),
            *((port, primary_door(*kind)) for port, kind in primary_server.PORTS.items()),
        ]

    async def open(self) -> None:
        """Listen on all ports.

        Raises:
            OSError: a port is taken.
        """
        loop = asyncio.get_running_loop()
        for port, factory in self._doors():
            self._servers.append(await loop.create_server(factory, self.address, port))

    def close(self) -> None:
        """Listen no more; connections stay."""
        for server in self._servers:
            server.close()
        self._servers.clear()

    def reopen(self) -> None:
        """Listen again, if that had ended."""
        if not self._servers and (self._opening is None or self._opening.done()):
            self._opening = asyncio.get_running_loop().create_task(self.open())

    def stall(self, active: bool, *, motion: bool = True) -> None:
        """Keep connections but say nothing; without `motion` the controller itself hangs too."""
        self.connections.silence(active)
        self.halted = active and not motion

    def set_remote(self, active: bool) -> None:
        """Switch between remote and local control. Into local control, connections that take programs are cut off."""
        self.controller.set_remote(active)
        if self.controller.local:
            self.connections.drop(ScriptConnection)

    # ---- clock

    def start(self) -> None:
        """Let time pass."""
        self.timing.started, self.timing.busy_at_start = time.monotonic(), time.process_time()
        self._next = asyncio.get_running_loop().time()
        self._wake()

    def _wake(self) -> None:
        loop = asyncio.get_running_loop()
        controller, now = self.controller, loop.time()
        period = controller.dt / controller.time_scale
        behind = now - self._next
        if behind > 2.0 * max(period, SLOWEST_WAKE):
            self.timing.late += 1
        self.timing.worst = max(self.timing.worst, behind)
        if behind > MOST_BEHIND:
            self.timing.dropped += behind - MOST_BEHIND
            self._next = now - MOST_BEHIND
        try:
            while self._next <= now:
                self._next += period
                if not self.halted:
                    self.timing.ticks += 1
                    controller.tick()
            if not self.halted:
                self.connections.uploads.work(0.5 * max(period, SLOWEST_WAKE))
                clock = controller.now / max(1.0, controller.time_scale)
                self.rtde.publish(clock)
                self.primary.publish(clock)
        except Exception:
            # A defect of this program: a clock that silently stood still would be worse than an end.
            traceback.print_exc()
            raise SystemExit(1) from None
        self._clock = loop.call_at(max(self._next, now + min(period, SLOWEST_WAKE)), self._wake)


HUNG = 20.0
"""Wall time after which a process whose interpreter doesn't get on is ended [s]."""


async def until_orphaned(parent: int, interval: float = 0.5, hung: float = HUNG) -> None:
    """Wait for a parent process to end: by its standard input, which ends with it, and by its number.

    The pipe alone isn't enough: a grandchild that was forked may hold its other end open. Neither is noticed by an
    interpreter that hangs; so a thread without Python in it ends the process, with a traceback, unless it is put
    off again and again.

    Args:
        parent: its number.
        interval: between two looks [s].
        hung: longest time that the interpreter may hang [s].
    """
    loop = asyncio.get_running_loop()
    gone = asyncio.Event()

    def readable() -> None:
        if not os.read(0, 4096):
            loop.remove_reader(0)
            gone.set()

    with contextlib.suppress(OSError):  # not every standard input can be waited for: /dev/null can't
        loop.add_reader(0, readable)
    while not gone.is_set() and os.getppid() == parent:
        faulthandler.dump_traceback_later(hung, exit=True)
        try:
            await asyncio.wait_for(gone.wait(), interval)
        except TimeoutError:
            continue
