"""The process around a controller: its clock, its ports, and its end.

`Host` opens the ports and runs the control cycles in wall time; `Timing` records how punctual they are.
`until_orphaned` waits for the end of the parent process.
"""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import os
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.servers import connections as script_server
from actors.emulators.ur_controller.servers import dashboard_server, primary_server, robot_api_server, rtde_server
from actors.emulators.ur_controller.servers.connections import Connections, ScriptConnection
from actors.emulators.ur_controller.servers.dashboard_server import DashboardConnection, DashboardServer
from actors.emulators.ur_controller.servers.primary_server import PrimaryConnection, PrimaryServer
from actors.emulators.ur_controller.servers.robot_api_server import RobotApiConnection
from actors.emulators.ur_controller.servers.rtde_server import RtdeConnection, RtdeServer
from actors.runtime.bench_clock import LONGEST_STAND, SharedClock

SLOWEST_WAKE = 0.002
"""Shortest wall time between two wake-ups of the clock [s]; in scaled time, each wake-up runs several ticks."""

TRANSLATION_WAKE = 0.02
"""The same while a program is translated, whose thread each wake-up interrupts."""

MOST_BEHIND = 0.1
"""Longest lag of the clock in wall time [s]; more is dropped, because a controller never runs faster to catch up."""

LONGEST_WAKE = 0.05
"""Wall time after which a wake-up with more pending cycles serves the ports first [s]."""

SILENCE = 0.2
"""Wall time after which clients get a package although the clock stands [s]: they count a longer silence as a lost
connection, the unmodified ur-rtde after 2.5 s."""


@dataclass
class Timing:
    """Statistics of the clock's punctuality.

    Attributes:
        ticks: executed control cycles.
        late: wake-ups later than two periods.
        worst: delay of the latest wake-up [s].
        dropped: wall time that was dropped because the process was too far behind [s].
        started: start of the clock [s of `time.monotonic`].
        busy_at_start: processor time of this process at that moment [s].
    """

    ticks: int = 0
    late: int = 0
    worst: float = 0.0
    dropped: float = 0.0
    started: float = 0.0
    busy_at_start: float = 0.0

    def report(self) -> dict[str, float]:
        """Return the statistics for logs and tests."""
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
        controller: the hosted controller.
        address: of all ports.
        clock: shared with the other devices of a bench; it is advanced with the control cycles, and they wait for the
            promises of its programs. None for a controller on its own.
    """

    def __init__(self, controller: Controller, address: str, clock: SharedClock | None = None) -> None:
        self.controller = controller
        self.address = address
        self.timing = Timing()
        self.halted = False
        self.connections = Connections(controller)
        self.rtde = RtdeServer(controller, self.connections)
        self.primary = PrimaryServer(controller, self.connections)
        self.dashboard = DashboardServer(controller)
        self.messages: deque[str] = deque(maxlen=50)
        controller.listeners.append(lambda message: self.messages.append(f"{message.kind}: {message.text}"))
        self._servers: list[asyncio.Server] = []
        self._opening: asyncio.Task[None] | None = None
        self._clock: asyncio.TimerHandle | None = None
        self._next = 0.0
        self._published = self._published_wall = self._wall = 0.0
        self._shared = clock

    # ---- ports

    def _port_factories(self) -> list[tuple[int, Callable[[], asyncio.Protocol]]]:
        def primary_factory(messages: bool, writable: bool) -> Callable[[], asyncio.Protocol]:
            return lambda: PrimaryConnection(self.primary, messages=messages, writable=writable)

        return [
            (rtde_server.PORT, lambda: RtdeConnection(self.rtde)),
            (script_server.PORT, lambda: ScriptConnection(self.connections)),
            *(
                []
                if self.controller.model.polyscope_x
                else [(dashboard_server.PORT, lambda: DashboardConnection(self.connections, self.dashboard))]
            ),
            *((port, primary_factory(*kind)) for port, kind in primary_server.PORTS.items()),
        ]

    async def open(self) -> None:
        """Listen on all ports.

        Raises:
            OSError: a port is taken.
        """
        loop = asyncio.get_running_loop()
        for port, factory in self._port_factories():
            self._servers.append(await loop.create_server(factory, self.address, port))
        if self.controller.model.polyscope_x:
            self._servers.append(await self._open_robot_api(loop))

    async def _open_robot_api(self, loop: asyncio.AbstractEventLoop) -> asyncio.Server:
        def factory() -> asyncio.Protocol:
            return RobotApiConnection(self.connections)

        first, second = robot_api_server.PORTS
        try:
            return await loop.create_server(factory, self.address, first)
        except PermissionError:
            return await loop.create_server(factory, self.address, second)

    def close(self) -> None:
        """Stop listening; connections stay."""
        for server in self._servers:
            server.close()
        self._servers.clear()

    def reopen(self) -> None:
        """Listen again, after `close`."""
        if not self._servers and (self._opening is None or self._opening.done()):
            self._opening = asyncio.get_running_loop().create_task(self.open())

    def stall(self, active: bool, *, motion: bool = True) -> None:
        """Keep connections but send nothing; without `motion` the controller itself stops, too."""
        self.connections.silence(active)
        self.halted = active and not motion

    def set_remote(self, active: bool) -> None:
        """Switch between remote and local control. On the switch to local control, connections that accept programs are
        closed.
        """
        self.controller.set_remote(active)
        if self.controller.local:
            self.connections.drop(ScriptConnection)

    # ---- clock

    def start(self) -> None:
        """Start the clock."""
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
        uploads = self.connections.uploads
        try:
            while self._next <= now and loop.time() < now + LONGEST_WAKE and self._runs(period):
                self._next += period
                self._tick(period)
            if not self._runs(period):  # no time passes, and none is caught up later
                self._next = now + SLOWEST_WAKE
                if now - self._published > SILENCE:
                    self._wall += SILENCE
                    if uploads.translating:  # so that packages have new times
                        self._tick(period)
            if self._shared is not None:
                self._shared.advance(0.0)
            if not self.halted:
                uploads.work(0.5 * max(period, SLOWEST_WAKE))
                if self._wall != self._published_wall:
                    self._published, self._published_wall = now, self._wall
                    self.rtde.publish(self._wall)
                    self.primary.publish(self._wall)
        except Exception:
            # A defect in this program: ending is better than a clock that silently stands still.
            traceback.print_exc()
            raise SystemExit(1) from None
        shortest = TRANSLATION_WAKE if uploads.translating else min(period, SLOWEST_WAKE)
        self._clock = loop.call_at(max(self._next, now + shortest), self._wake)

    def _runs(self, period: float) -> bool:
        """Whether time passes: not while a program is loaded, or while the bench waits for a program that is late."""
        return not self.connections.uploads.translating and (
            self._shared is None or self.connections.silent or self._shared.may_pass(period)
        )

    def _tick(self, period: float) -> None:
        if self._shared is not None:
            self._shared.advance(period)
        if not self.halted:
            self.timing.ticks += 1
            self._wall += self.controller.dt / max(1.0, self.controller.time_scale)
            self.controller.tick()


async def until_orphaned(parent: int, interval: float = 0.5, hung: float = LONGEST_STAND) -> None:
    """Wait for the parent process to end: by the end of standard input, and by a change of the parent's id.

    The pipe alone is not enough, because a forked grandchild may hold its other end open. A blocked interpreter notices
    neither. An alarm signal, which needs no Python, therefore ends the process with a traceback unless it is postponed
    in every interval. A thread for the same purpose would have to be joined each time, and has no priority.

    Args:
        parent: its process id.
        interval: between two checks [s].
        hung: longest time that the interpreter may be blocked [s].
    """
    loop = asyncio.get_running_loop()
    gone = asyncio.Event()

    def readable() -> None:
        if not os.read(0, 4096):
            loop.remove_reader(0)
            gone.set()

    with contextlib.suppress(OSError):  # not every standard input can be polled; /dev/null cannot
        loop.add_reader(0, readable)
    faulthandler.register(signal.SIGALRM, chain=True)  # prints the traceback, then ends the process by default
    while not gone.is_set() and os.getppid() == parent:
        signal.setitimer(signal.ITIMER_REAL, hung)
        try:
            async with asyncio.timeout(interval):
                await gone.wait()
        except TimeoutError:
            continue
