"""Child processes: the only module of the product that starts other programs.

    child = ChildProcess(python_module("actors.emulators.ur_controller", "--address", address))
    ready = child.read_line(deadline=40.0)
    …
    child.close()

Every child has:

- an explicit copy of the environment. Without one, the system reads the C array of this process while another thread
  may change `os.environ`; the start then fails with EFAULT ('Bad address').
- its own session. Ctrl-C in the terminal reaches this program only, which ends its children in order.
- a way to notice the end of this program, however it ends: its standard input ends, or its connection does.

`ConnectedProcess` exchanges Python objects with its child. `run` starts a program and waits for its end.

This module does not restart anything: the owner of a child decides that.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import IO, Literal

Completed = subprocess.CompletedProcess[str]
"""What `run` returns: `returncode`, `stdout`, `stderr`."""

_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
"""Number of the system call by the machine's architecture."""

_SHORTEST_SLICE = 100_000
"""Shortest time slice that Linux grants [ns]."""

START_DEADLINE = 600.0
"""Longest time for a program to get ready [s]: a busy machine needs long, and one that fails ends before."""

GRACE = 10.0
"""Default time for a child to end by itself [s]."""

_ERRORS_KEPT = 2000
_PR_SET_PDEATHSIG = 1

_CRASHES = ("*** SIG", "Fatal Python error")

_hidden: dict[str, str | None] = {}
"""Previous values of variables that `own_environment` has changed."""


def child_environment(changes: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """Return a copy of this process's environment for a child. Other threads may change `os.environ` meanwhile.

    Args:
        changes: variables to add or replace; None removes one.
    """
    while True:
        try:
            wanted: dict[str, str | None] = {**dict(os.environ), **_hidden, **(changes or {})}
            return {name: value for name, value in wanted.items() if value is not None}
        except KeyError:  # another thread removed a variable between listing the names and reading the values
            continue


@contextlib.contextmanager
def own_environment(**values: str | None) -> Iterator[None]:
    """Set environment variables for a library in this process. Children that `ChildProcess` starts do not get them.

    Args:
        values: by name; None removes a variable.
    """
    before = {name: os.environ.get(name) for name in values}
    _hidden.update(before)
    _set_environment(values)
    try:
        yield
    finally:
        _set_environment(before)
        for name in before:
            _hidden.pop(name, None)  # another thread may have ended the same change


def _set_environment(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def last_lines(text: str, count: int = 3) -> str:
    """The last lines of a program's messages as one line, for an error; a crash's stack is left out."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    crash = next((n for n, line in enumerate(lines) if line.startswith(_CRASHES)), len(lines))
    del lines[crash + 1 :]
    return " / ".join(lines[-count:])


def python_module(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module with this interpreter."""
    return [sys.executable, "-m", module, *arguments]


class ChildProcess:
    """A running program with pipes to it.

    Args:
        command: program and arguments.
        environment: variables that differ from this process's.
        input: whether its standard input is a pipe; else it is empty.
        output: whether its standard output is a pipe; else it goes to the same target as the errors.
        errors: its standard error: 'kept' for `errors_kept`, 'shown' on this process's, 'dropped', or a file.
        inherited: file descriptors that the child inherits.
        dies_with_parent: Linux kills it when this process ends, even by SIGKILL. Only for a process with one thread:
            code between fork and exec must not wait for another thread's lock, and the kernel kills the child when the
            *thread* that started it ends.
        prompt: it answers another process within a time limit, and needs little of the processor: Linux gives it
            short time slices, so that it waits less next to busy processes.

    Raises:
        OSError: it does not start.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str | None] | None = None,
        input: bool = True,  # noqa: A002 - the name that subprocess uses
        output: bool = True,
        errors: Literal["kept", "shown", "dropped"] | IO[bytes] = "kept",
        inherited: Sequence[int] = (),
        dies_with_parent: bool = False,
        prompt: bool = False,
    ) -> None:
        self._errors: IO[bytes] | None = None
        target: IO[bytes] | int | None
        if errors == "kept":
            # A file, because a pipe that is not read fills up and blocks its writer.
            target = self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with this object
        else:
            target = {"shown": None, "dropped": subprocess.DEVNULL}[errors] if isinstance(errors, str) else errors
        self._received = b""
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE if input else subprocess.DEVNULL,
            stdout=subprocess.PIPE if output else target,
            stderr=target,
            env=child_environment(environment),
            pass_fds=tuple(inherited),
            start_new_session=True,
            preexec_fn=_tied_to_parent() if dies_with_parent else None,  # noqa: PLW1509 - see `dies_with_parent`
        )
        self.pid = self._process.pid
        """Its process id."""
        if prompt:
            _shorten_slices(self.pid)

    @property
    def status(self) -> int | None:
        """Its exit status, minus the number of the signal that ended it; None while it runs."""
        return self._process.poll()

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self.status is None

    @property
    def cpu_time(self) -> float:
        """Processor time that it has used [s]; 0 once it has ended."""
        import psutil  # type: ignore[import-untyped,unused-ignore]

        try:
            used = psutil.Process(self.pid).cpu_times()
        except psutil.Error:
            return 0.0
        return float(used.user + used.system)

    @property
    def errors_kept(self) -> str:
        """The end of its standard error, and of its output if that is no pipe. Empty unless `errors` is 'kept'."""
        if self._errors is None:
            return ""
        with contextlib.suppress(OSError, ValueError):  # closed
            size = os.fstat(self._errors.fileno()).st_size
            data = os.pread(self._errors.fileno(), _ERRORS_KEPT, max(0, size - _ERRORS_KEPT))
            return data.decode("utf-8", "replace").strip()
        return ""

    @property
    def last_error(self) -> str:
        """The last line of `errors_kept`, or an empty string."""
        return (self.errors_kept.splitlines() or [""])[-1].strip()

    def write(self, data: bytes) -> None:
        """Write to its standard input.

        Raises:
            OSError: it has ended.
            ValueError: its input is closed.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(data)
        self._process.stdin.flush()

    def read_line(self, deadline: float | None = None) -> bytes:
        """The next line of its standard output, with its end.

        Args:
            deadline: longest wait [s]; 0: only data that has already arrived; None: no limit.

        Raises:
            TimeoutError: no whole line in time; a part of a line is kept for the next call.
            EOFError: the child has closed its output, usually because it has ended.
        """
        assert self._process.stdout is not None
        end = None if deadline is None else time.monotonic() + deadline
        while b"\n" not in self._received:
            left = None if end is None else max(end - time.monotonic(), 0.0)
            if not select.select([self._process.stdout], [], [], left)[0]:
                raise TimeoutError(f"no line within {deadline:g} s")
            piece = os.read(self._process.stdout.fileno(), 65536)
            if not piece:
                raise EOFError("its output has ended")
            self._received += piece
        line, newline, self._received = self._received.partition(b"\n")
        return line + newline

    def close_input(self) -> None:
        """Close its standard input; most children end then. May be called again."""
        with contextlib.suppress(OSError):  # unflushed data is lost with a child that has ended
            if self._process.stdin is not None:
                self._process.stdin.close()

    def wait(self, seconds: float) -> bool:
        """Wait for its end. Returns whether it has ended."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._process.terminate()

    def kill(self, timeout: float = 5.0) -> None:
        """Send SIGKILL and wait for the end. May be called again.

        Args:
            timeout: longest wait [s]; the kernel may delay the end, e.g. during a disk access.
        """
        self._process.kill()
        self.wait(timeout)

    def close(self, grace: float = GRACE, *, terminate: bool = False) -> None:
        """End the child: close its input, wait, kill it if it still runs, release the pipes. May be called again.

        Args:
            grace: time to end by itself [s].
            terminate: send SIGTERM as well, for a program that does not end with its input.
        """
        self.close_input()
        if terminate:
            self.terminate()
        if not self.wait(grace):
            self.kill()
        self.release()

    def release(self) -> None:
        """Close the pipes and the file of errors, whether the child has ended or not. May be called again."""
        self.close_input()
        for file in (self._process.stdout, self._errors):
            if file is not None:
                file.close()


class ConnectedProcess(ChildProcess):
    """`python -m MODULE FD`: a child that exchanges Python objects with this process.

    Its output and its errors are kept. It ends when this process closes `connection` or ends.

    Args:
        module: to run; its argument is the file descriptor of its end of the connection.
        prompt: see `ChildProcess`.

    Attributes:
        connection: to the child.
    """

    def __init__(self, module: str, *, prompt: bool = False) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            command = python_module(module, str(theirs.fileno()))
            super().__init__(command, input=False, output=False, inherited=(theirs.fileno(),), prompt=prompt)
        self.connection = Connection(ours.detach())


def run(command: Sequence[str], *, timeout: float, environment: Mapping[str, str | None] | None = None) -> Completed:
    """Run a program to its end, with empty input. Returns its status, output and errors.

    Raises:
        TimeoutError: it took longer than `timeout` [s] and was killed.
        OSError: it does not start.
    """
    try:
        return subprocess.run(
            list(command),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
            env=child_environment(environment),
        )
    except subprocess.TimeoutExpired as error:
        raise TimeoutError(str(error)) from None


def _tied_to_parent() -> Callable[[], None] | None:
    """For `preexec_fn`: the kernel kills the child when this thread ends. None if the system has no such call.

    Source: prctl(2), PR_SET_PDEATHSIG.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl, parent = ctypes.CDLL(None, use_errno=True).prctl, os.getpid()

    def tie() -> None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before the request
            os._exit(1)

    return tie


def _shorten_slices(pid: int) -> None:
    """Ask Linux for the shortest time slices for a process that has just started; its later threads get them, too.

    A thread that sleeps most of the time is due the earlier after it wakes, the shorter its slice is (EEVDF). Its share
    of the processor stays the same, and no privilege is needed. Linux before 6.12 and other systems ignore it.

    Source: sched_setattr(2); "EEVDF Scheduler" in the documentation of the Linux kernel.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if number is None or not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):  # it has ended, or this C library has no such function
        nice = os.getpriority(os.PRIO_PROCESS, pid)
        # struct sched_attr: size, policy SCHED_OTHER, flags, nice, priority, runtime [ns], deadline, period
        attributes = struct.pack("=IIQiIQQQ", 48, 0, 0, nice, 0, _SHORTEST_SLICE, 0, 0)
        ctypes.CDLL(None).syscall(number, pid, attributes, 0)
