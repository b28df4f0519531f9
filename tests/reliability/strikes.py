"""Real faults: signals, sockets cut from outside, a disk that is full, a clock that jumps."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import psutil

from actors.runtime.child_process import child_environment

DISK_MB = 60

PAUSE = 0.7
"""A process that was stopped stands still for so long [s]: longer than any sign of life is waited for."""

DAY, HOUR = 86_400.0, 3_600.0

_PIDFD_GETFD = 438
"""The system call's number, the same on all of Linux's machines."""


def kill(pids: Iterable[int]) -> None:
    """SIGKILL."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def stop(pids: Iterable[int], pause: float = PAUSE) -> None:
    """SIGSTOP, and SIGCONT after a pause, from another process: this one may be stopped or killed."""
    struck = tuple(pids)
    names = " ".join(map(str, struck))
    subprocess.Popen(
        ["sh", "-c", f"sleep {pause}; kill -CONT {names} 2>/dev/null"], start_new_session=True, env=child_environment()
    )
    for pid in struck:
        os.kill(pid, signal.SIGSTOP)


def cut(pids: Iterable[int]) -> int:
    """Shut all connections of processes with others, as a line that is cut; their two ends find out by themselves.

    Returns:
        How many there were.
    """
    return sum(_cut(pid) for pid in pids)


def _cut(pid: int) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    handle, count = os.pidfd_open(pid), 0
    try:
        for path in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                if not path.is_socket():
                    continue
                number = libc.syscall(_PIDFD_GETFD, handle, int(path.name), 0)
                if number < 0:
                    continue
                with socket.socket(fileno=number) as line:
                    if line.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) or _with_itself(line, pid):
                        continue  # it only listens, or is how its threads wake each other
                    line.getpeername()
                    line.shutdown(socket.SHUT_RDWR)
                    count += 1
    finally:
        os.close(handle)
    return count


def _with_itself(line: socket.socket, pid: int) -> bool:
    if line.family != socket.AF_UNIX:
        return False
    peer, _, _ = struct.unpack("3i", line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return bool(peer == pid)


def connections(pid: int) -> int:
    """How many connections over the network a process has."""
    with contextlib.suppress(psutil.Error):
        return sum(one.status == psutil.CONN_ESTABLISHED for one in psutil.Process(pid).net_connections("inet"))
    return 0


def descendants(*words: str) -> list[int]:
    """Processes that this one and its children have started, by what stands on their command lines or is their name."""
    found = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if process.status() != psutil.STATUS_ZOMBIE and (
                process.name() in words or any(word in " ".join(process.cmdline()) for word in words)
            ):
                found.append(process.pid)
    return found


def shift_clock(seconds: float) -> None:
    """The clock on the wall jumps, for this process."""
    now: Callable[[], float] = time.time
    time.time = lambda: now() + seconds


@contextlib.contextmanager
def disk(place: Path) -> Iterator[None]:
    """A small disk of its own."""
    place.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(place)], check=True, env=child_environment()
    )
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True, env=child_environment())
        place.rmdir()


def can_mount(folder: Path) -> bool:
    """Whether a small disk can be had here."""
    with contextlib.suppress(subprocess.CalledProcessError, OSError), disk(folder / "probe"):
        return True
    return False


def fill(place: Path) -> None:
    """Until nothing more goes onto the disk."""
    with (place / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))


def tidy(place: Path) -> None:
    """Somebody makes room."""
    (place / "filler").unlink(missing_ok=True)
