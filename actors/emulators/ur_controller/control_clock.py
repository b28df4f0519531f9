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

SLOWEST_WAKE = 0.002
"""Shortest wall time between two wake-ups of the clock [s]; in scaled time, each wake-up runs several ticks."""

MOST_BEHIND = 0.1
"""Longest lag of the clock in wall time [s]; more is dropped, because a controller never runs faster to catch up."""

BUSY = 0.75
"""Share of a second's processor time above which the clock gives its priority up."""

LONGEST_WAKE = 0.05
"""Wall time after which a wake-up with more pending cycles serves the ports first [s]."""

REAL_TIME = 1
"""Real-time priority of the clock's thread: the lowest one, which is above all work that is not real-time."""

NICENESS = -10
"""Niceness of the clock's thread if real-time priority is not permitted."""


def raise_priority() -> str:
    """Raise the priority of the calling thread above other work on the machine, as far as the system permits.

    The process's other threads and its children do not get the real-time priority.

    Returns:
        The granted priority: 'real-time', 'nice -10' or 'normal'.
    """
    with contextlib.suppress(OSError, AttributeError):  # macOS has no such call
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(REAL_TIME))
        return "real-time"
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
        return f"nice {NICENESS}"
    return "normal"


def lower_priority() -> str:
    """Revert `raise_priority`. Returns 'normal'."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        if os.getpriority(os.PRIO_PROCESS, 0) < 0:
            os.setpriority(os.PRIO_PROCESS, 0, 0)
    return "normal"


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
        priority: of the clock's thread; see `raise_priority`.
    """

    ticks: int = 0
    late: int = 0
    worst: float = 0.0
    dropped: float = 0.0
    started: float = 0.0
    busy_at_start: float = 0.0
    priority: str = "normal"

    def report(self) -> dict[str, float | str]:
        """Return the statistics for logs and tests."""
        wall = max(time.monotonic() - self.started, 1e-9)
        return {
            "ticks": self.ticks,
            "late": self.late,
            "worst": self.worst,
            "dropped": self.dropped,
            "wall": wall,
            "cpu": (time.process_time() - self.busy_at_start) / wall,
            "priority": self.priority,
        }


class Host:
    """Ports and clock of one controller.

    Args:
        controller: the hosted controller.
        address: of all ports.
        prioritised: run the clock with raised priority if the system permits it. Not in time that is scaled up: there
            the clock takes much of a core.
    """

    def __init__(self, controller: Controller, address: str, *, prioritised: bool = False) -> None:
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
        self._worked = self._woke = self._wall = 0.0
        self._prioritised = prioritised and controller.time_scale <= 1.0

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
        if self._prioritised:
            self.timing.priority = raise_priority()
        self.timing.started, self.timing.busy_at_start = time.monotonic(), time.process_time()
        self._next = self._woke = asyncio.get_running_loop().time()
        self._worked = time.thread_time()
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
        if self.timing.priority != "normal" and now > self._woke + 1.0:
            worked = time.thread_time()
            if worked - self._worked > BUSY * (now - self._woke):
                # Its own work, for example a program's: other processes would get no processor time.
                self.timing.priority = lower_priority()
            self._worked, self._woke = worked, now
        try:
            while self._next <= now and loop.time() < now + LONGEST_WAKE:
                self._next += period
                if not self.halted:
                    self.timing.ticks += 1
                    self._wall += controller.dt / max(1.0, controller.time_scale)
                    controller.tick()
            if not self.halted:
                self.connections.uploads.work(0.5 * max(period, SLOWEST_WAKE))
                self.rtde.publish(self._wall)
                self.primary.publish(self._wall)
        except Exception:
            # A defect in this program: ending is better than a clock that silently stands still.
            traceback.print_exc()
            raise SystemExit(1) from None
        self._clock = loop.call_at(max(self._next, now + min(period, SLOWEST_WAKE)), self._wake)


HUNG = 20.0
"""Wall time after which a process with a blocked interpreter is ended [s]."""


async def until_orphaned(parent: int, interval: float = 0.5, hung: float = HUNG) -> None:
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
