"""Where Ray dies under the daemon, the daemon begins anew in place: its process executes its own command line again.

A program that has lost its Ray can't be given another one: calls to what is gone may hang for good. Everything that
matters is on the disk, as for a daemon that is killed and started again. The process keeps its number, so that a
service manager takes note of nothing, and the socket it listens at: who calls meanwhile waits for some seconds.
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
"""Environment variables from a program to the one that follows it: number of the socket; when this was done [s]."""

MOST, WITHIN = 5, 3600.0
"""So many times within so long [s] it begins anew by itself: what kills Ray more often has to be mended by people."""

LOOKING = 3.0
"""Between two looks whether Ray lives [s]."""

COMING_TO_REST = 20.0
"""Longest time that campaigns and all else have to come to rest [s]; journals bear the program's end at any time."""

POURING = 50.0
"""The same while a pour is under way that may still be weighed: Ray ends programs 60 s after its directory has died."""

REAPING = 10.0
"""Longest time that is waited for the processes of the former program to end [s]."""

_log = logging.getLogger(__name__)


class Losable(Protocol):
    """What the watch needs of the daemon."""

    @property
    def lost(self) -> str:
        """Which of Ray's own processes has died; '' while all is well."""
        ...

    @property
    def pouring(self) -> bool:
        """Whether a pour is under way somewhere."""
        ...

    def leave(self, lost: str) -> None:
        """Come to rest, to begin anew."""
        ...

    def problem(self, key: str, text: str | None) -> None:
        """Something that people should mend."""
        ...


class DaemonRestart:
    """What one program hands to the one that takes its place. Made before anything is started.

    Attributes:
        listening: the socket of the program before this one; None where this is the first.
    """

    def __init__(self) -> None:
        number, times = os.environ.pop(LISTENING, None), os.environ.pop(RENEWED, "")
        self._environment = dict(os.environ)  # Ray changes it
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
        """Whether it hasn't been done too often."""
        return len(self._times) < MOST

    def keep(self, listening: socket.socket) -> None:
        """The socket that the next program gets; it stays open when this one closes it."""
        self._kept = os.dup(listening.fileno())

    def drop(self) -> None:
        """There will be no next program."""
        kept, self._kept = self._kept, None
        if kept is not None:
            os.close(kept)

    def begin_anew(self) -> NoReturn:
        """Execute this process's command line again. Locks, pipes and files close: Ray's warden takes it for dead."""
        times = " ".join(str(one) for one in (*self._times, time.time()))
        environment = {**self._environment, RENEWED: times}
        if self._kept is not None:
            os.set_inheritable(self._kept, True)
            environment[LISTENING] = str(self._kept)
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def _reap() -> None:
    """Wait for the children of the program that was here before: nobody else will, and none of ours has started yet."""
    end = time.monotonic() + REAPING
    try:
        while time.monotonic() < end:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.05)
    except ChildProcessError:
        pass


class RayWatch:
    """Looks whether Ray lives, from a thread: the event loop itself may hang in a call to what has died.

    Args:
        daemon: that is told.
        renewal: how it begins anew.
        ending: whether people have told it to end.

    Use: made in the daemon's event loop, `close`d where the daemon ends in order.
    """

    def __init__(self, daemon: Losable, renewal: DaemonRestart, ending: Callable[[], bool]) -> None:
        self._daemon, self._renewal, self._ending = daemon, renewal, ending
        self._loop = asyncio.get_running_loop()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="watch over Ray", daemon=True).start()

    def close(self) -> None:
        """Look no more."""
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
