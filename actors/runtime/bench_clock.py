"""Bench time: the clock of a virtual bench, scaled against the wall clock.

- `Pace` converts bench time to wall time and waits. With a time scale of 0 it does not wait at all.
- `DeviceClock` is the clock of devices and their drivers [s], which measures their time limits. On hardware it is the
  wall clock. The devices of a virtual bench share one through a file, a `SharedClock`: the emulated controller advances
  it, never faster than the wall clock, and slower if the host delays it. It does not advance beyond what the programs
  have promised that must act in time, such as the one that writes a heartbeat.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import threading
import time
from array import array
from pathlib import Path


class Pace:
    """Waits until bench time has passed; another thread can interrupt the wait.

    Args:
        time_scale: bench seconds per wall second; 0 disables waiting.
    """

    def __init__(self, time_scale: float) -> None:
        if time_scale < 0.0:
            raise ValueError(f"time_scale must be 0 (wait for nothing) or more, got {time_scale}")
        self._scale = time_scale
        self._interrupted = threading.Event()
        self._start = time.monotonic()

    def restart(self) -> None:
        """Set bench time to 0."""
        self._start = time.monotonic()

    @property
    def now(self) -> float:
        """Bench time since `restart` [s]; infinite if waiting is disabled."""
        return (time.monotonic() - self._start) * self._scale if self._scale > 0.0 else math.inf

    def nap(self, wall: float) -> bool:
        """Wait for a wall time [s]; return at once if waiting is disabled.

        Returns:
            False if interrupted.
        """
        return not self._interrupted.wait(wall if self._scale > 0.0 else 0.0)

    def wait_until(self, moment: float) -> bool:
        """Wait until a bench time since `restart` [s].

        Returns:
            False if interrupted before that time.
        """
        left = (moment - self.now) / self._scale if self._scale > 0.0 else 0.0
        return not self._interrupted.wait(max(left, 0.0))

    def interrupt(self) -> None:
        """End current waits, and end later waits at once until `resume` is called."""
        self._interrupted.set()

    def resume(self) -> None:
        """Allow waits again after `interrupt`."""
        self._interrupted.clear()

    @property
    def interrupted(self) -> bool:
        """Whether `interrupt` was called without a later `resume`."""
        return self._interrupted.is_set()


LONGEST_STAND = 300.0
"""Wall time after which a clock that stands goes on [s]: its process or the one that it waits for hangs. On a busy host
a process was given no processor for half a minute."""

PATIENCE = 10.0
"""Factor of the wall-time limits of starting and answering processes on a virtual bench, whose host may be slow."""

PROGRAMS = ("arm", "dose", "liquid", "balance", "weighing")
"""Programs that may make a promise: the arm's worker, the control loop of a dose, the liquid that flows in it, the
emulated balance, and the driver that reads it."""

_NOW, _WRITTEN, _FIRST = 0, 1, 2


class DeviceClock:
    """The wall clock of real devices.

    Attributes:
        patience: factor of the wall-time limits of processes.
    """

    patience = 1.0

    @property
    def now(self) -> float:
        """Time of the clock [s], increasing."""
        return time.monotonic()

    def promise(self, program: str, seconds: float) -> None:
        """State that a program acts again before so much time has passed [s]; a shared clock waits for it then.

        A program that is behind by more renews its promise with a negative time while it catches up.
        """

    def withdraw(self, program: str) -> None:
        """End a program's promise."""


class SharedClock(DeviceClock):
    """The clock that the devices of a virtual bench share: numbers in a file that its processes map to memory.

    Args:
        path: of the file, which `create` has made.

    Raises:
        OSError: there is no such file.
    """

    patience = PATIENCE

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._numbers = memoryview(mmap.mmap(file.fileno(), 0)).cast("d")
        self._latest = -math.inf
        self._late: dict[str, tuple[float, float]] = {}  # promises that it waits for, and since when [s]

    @staticmethod
    def create(path: Path) -> None:
        """Make the file; the clock starts at the present time of the wall clock."""
        numbers = [time.monotonic(), time.monotonic(), *[math.inf, 0.0] * len(PROGRAMS)]
        path.write_bytes(array("d", numbers).tobytes())

    @staticmethod
    def remove(path: Path) -> None:
        """Remove the file and its folder: the bench does, or what advances the clock when the bench was killed."""
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
            path.parent.rmdir()

    @property
    def now(self) -> float:
        """See `DeviceClock.now`; as last written, and the wall time after a stand of `LONGEST_STAND`."""
        standing = time.monotonic() - self._numbers[_WRITTEN] - LONGEST_STAND
        self._latest = max(self._latest, self._numbers[_NOW] + max(standing, 0.0))
        return self._latest

    def promise(self, program: str, seconds: float) -> None:
        """See `DeviceClock.promise`."""
        place = _place(program)
        self._numbers[place + 1] = float(os.getpid())
        self._numbers[place] = self._numbers[_NOW] + seconds

    def withdraw(self, program: str) -> None:
        """See `DeviceClock.withdraw`."""
        self._numbers[_place(program)] = math.inf

    # ---- for the process that advances it

    def advance(self, seconds: float) -> None:
        """Let time pass [s]; 0 while it waits."""
        self._numbers[_NOW] += seconds
        self._numbers[_WRITTEN] = time.monotonic()

    def may_pass(self, seconds: float) -> bool:
        """Whether so much time may pass now [s]: not beyond a promise.

        The clock waits neither for a process that has ended nor longer than `LONGEST_STAND` of wall time for one that
        does not renew its promise.
        """
        after, before = self._numbers[_NOW] + seconds, self._late
        late = [program for program in PROGRAMS if self._numbers[_place(program)] < after]
        self._late = {}
        for program in late:
            promised, wall = self._numbers[_place(program)], time.monotonic()
            same, since = before.get(program, (math.nan, wall))
            self._late[program] = (promised, since if same == promised else wall)
            if wall - self._late[program][1] > LONGEST_STAND or not _lives(int(self._numbers[_place(program) + 1])):
                self.withdraw(program)
        return not late


def _place(program: str) -> int:
    return _FIRST + 2 * PROGRAMS.index(program)


def device_clock(path: str) -> DeviceClock:
    """The clock of devices: the one of this file, or the wall clock without a file (on another machine, too)."""
    with contextlib.suppress(OSError):
        if path:
            return SharedClock(Path(path))
    return DeviceClock()


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
