"""The process around a controller: its clock, its ports, and its end."""

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
from actors.emulators.ur_controller.servers import dashboard_server, primary_server, rtde_server
from actors.emulators.ur_controller.servers.connections import Connections, ScriptConnection
from actors.emulators.ur_controller.servers.dashboard_server import DashboardConnection, DashboardServer
from actors.emulators.ur_controller.servers.primary_server import PrimaryConnection, PrimaryServer
from actors.emulators.ur_controller.servers.rtde_server import RtdeConnection, RtdeServer

SLOWEST_WAKE = 0.002
"""Wall time between two wake-ups of the clock at most rate [s]; where time is scaled up each does several ticks."""

MOST_BEHIND = 0.1
"""Wall time that the clock may fall behind before it lets the rest go [s]: a controller never catches up in a rush."""

LONGEST_WAKE = 0.05
"""Wall time after which a wake-up with more cycles to do serves the ports first [s]."""

REAL_TIME = 1
"""Real-time priority of the clock's thread: the lowest one, which is above all work that is not real-time."""

NICENESS = -10
"""Of the clock's thread where it may not be real-time [nice]."""


def raise_priority() -> str:
    """Let the calling thread run before other work on the machine, as far as the system permits.

    Neither the process's other threads nor its children get the real-time priority.

    Returns:
        What was granted: 'real-time', 'nice -10' or 'normal'.
    """
    with contextlib.suppress(OSError, AttributeError):  # macOS has no such call
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(REAL_TIME))
        return "real-time"
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
        return f"nice {NICENESS}"
    return "normal"


def lower_priority() -> str:
    """Give back what `raise_priority` got. Returns 'normal'."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        if os.getpriority(os.PRIO_PROCESS, 0) < 0:
            os.setpriority(os.PRIO_PROCESS, 0, 0)
    return "normal"


@dataclass
class Timing:
    """How well the clock kept time.

    Attributes:
        ticks: done.
        late: wake-ups later than two periods.
        worst: latest wake-up [s].
        dropped: wall time that was let go because the process was too far behind [s].
        busy: processor time used by this process [s]; `since` the start of the clock [s of wall time].
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
        """For people and tests."""
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
        controller: what is hosted.
        address: of all ports.
        prioritised: its clock goes before other work on the machine, where the system permits it. Not in time that is
            scaled up: there the clock takes much of a core.
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
        self._worked = self._woke = 0.0
        self._prioritised = prioritised and controller.time_scale <= 1.0

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
        worked = time.thread_time()
        if behind > MOST_BEHIND:
            self.timing.dropped += behind - MOST_BEHIND
            self._next = now - MOST_BEHIND
            if self.timing.priority != "normal" and worked - self._worked > 0.5 * (now - self._woke):
                # It is late by its own work, a program's, say: others would get no processor time at all.
                self.timing.priority = lower_priority()
        self._worked, self._woke = worked, now
        try:
            while self._next <= now and loop.time() < now + LONGEST_WAKE:
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
    interpreter that hangs; so an alarm signal, which needs no Python, ends the process with a traceback unless it is
    put off again and again. A thread that does the same would have to be waited for each time, and has no priority.

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
    faulthandler.register(signal.SIGALRM, chain=True)  # the traceback, and then what ends a process by default
    while not gone.is_set() and os.getppid() == parent:
        signal.setitimer(signal.ITIMER_REAL, hung)
        try:
            await asyncio.wait_for(gone.wait(), interval)
        except TimeoutError:
            continue
