"""Restart of the daemon in place after Ray has died: the process executes its own command line again.

A process that has lost its Ray can't connect to another one, since calls to the dead one may block forever. All state
is on disk, as for a daemon that is killed and started again. The process id stays the same, so a service manager
notices nothing. The listening socket is kept, so clients wait for some seconds instead of failing.

`DaemonRestart` hands the socket over; `RayWatch` detects Ray's death in a thread of its own. Other crashes of the
daemon are left to the service manager.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import NoReturn, Protocol

LISTENING, RENEWED = "DECANT_LISTENING", "DECANT_RENEWED"
"""Environment variables for the next program: file descriptor of the socket, and times of restarts [s]."""

MOST, WITHIN = 5, 3600.0
"""Largest number of automatic restarts within a period [s]; more frequent failures need an operator."""

LOOKING = 3.0
"""Interval at which Ray is checked [s]."""

COMING_TO_REST = 20.0
"""Longest time for campaigns and services to stop [s]; journals are consistent if the program ends earlier."""

POURING = 50.0
"""The same while a pour may still be weighed: Ray ends its programs 60 s after its directory service has died."""

REAPING = 10.0
"""Longest time to wait for the previous program's child processes to end [s]."""

_log = logging.getLogger(__name__)


class Losable(Protocol):
    """The part of the daemon that `RayWatch` uses."""

    @property
    def lost(self) -> str:
        """Name of the Ray process that has died; '' if all are running."""
        ...

    @property
    def pouring(self) -> bool:
        """Whether a pour is in progress."""
        ...

    def leave(self, lost: str) -> None:
        """Stop all work in order to restart."""
        ...

    def problem(self, key: str, text: str | None) -> None:
        """Report a problem that an operator should solve."""
        ...


class DaemonRestart:
    """Hands the listening socket to the next program. Create it before anything else is started.

    Attributes:
        listening: socket of the previous program; None at the first start.
    """

    def __init__(self) -> None:
        number, times = os.environ.pop(LISTENING, None), os.environ.pop(RENEWED, "")
        self._environment = dict(os.environ)  # a copy, since Ray changes it
        now = time.time()
        self._times = [float(one) for one in times.split() if now - float(one) < WITHIN]
        self._kept: int | None = None
        self.listening: socket.socket | None = None
        if number is not None:
            self.listening = socket.socket(fileno=int(number))
            self.listening.set_inheritable(False)
            _reap()

    @property
    def possible(self) -> bool:
        """Whether the limit of restarts has not been reached."""
        return len(self._times) < MOST

    def keep(self, listening: socket.socket) -> None:
        """Keep a duplicate of the socket for the next program; it stays open when this program closes its own."""
        self._kept = os.dup(listening.fileno())

    def drop(self) -> None:
        """Close the kept socket; no program follows."""
        kept, self._kept = self._kept, None
        if kept is not None:
            os.close(kept)

    def begin_anew(self) -> NoReturn:
        """Execute this process's command line again.

        Locks, pipes and files close, so Ray's cleanup process treats this program as ended.
        """
        times = " ".join(str(one) for one in (*self._times, time.time()))
        environment = {**self._environment, RENEWED: times}
        if self._kept is not None:
            os.set_inheritable(self._kept, True)
            environment[LISTENING] = str(self._kept)
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def _reap() -> None:
    """Wait for the previous program's children to end. No other child has been started yet."""
    end = time.monotonic() + REAPING
    try:
        while time.monotonic() < end:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.05)
    except ChildProcessError:
        pass


class RayWatch:
    """Checks in a thread whether Ray is alive; the event loop may block in a call to a dead Ray.

    Create it in the daemon's event loop, and call `close` if the daemon ends normally.

    Args:
        daemon: daemon to notify.
        renewal: restarts the process.
        ending: returns whether a user has requested the daemon's end.
    """

    def __init__(self, daemon: Losable, renewal: DaemonRestart, ending: Callable[[], bool]) -> None:
        self._daemon, self._renewal, self._ending = daemon, renewal, ending
        self._loop = asyncio.get_running_loop()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="watch over Ray", daemon=True).start()

    def close(self) -> None:
        """End the checks."""
        self._closed.set()

    def _watch(self) -> None:
        while not (lost := self._daemon.lost):
            if self._closed.wait(LOOKING):
                return
        if not self._renewal.possible:
            text = (
                f"Ray has lost its {lost}, and that {MOST + 1} times within {WITHIN / 3600.0:.0f} h: is this machine "
                "short of memory? End the daemon and start it again; what ran goes on from its journal"
            )
            self._loop.call_soon_threadsafe(self._daemon.problem, "ray", text)
            return
        begun = time.monotonic()
        self._loop.call_soon_threadsafe(self._daemon.leave, lost)
        while time.monotonic() < begun + (POURING if self._daemon.pouring else COMING_TO_REST):
            if self._closed.wait(0.2):
                return
        if self._ending():
            _log.critical("ended without Ray, which did not let go")
            os._exit(1)
        _log.critical("begins anew without having come to rest")
        self._renewal.begin_anew()
