"""Rerun's own server and web viewer, in a process that ends with the one that started it.

`python -m orchestrator.monitor.server ADDRESS PORT WEB_PORT MEMORY` runs it until its input ends. It is Rerun's own
program and not its Python package, which serves the viewer's page on all addresses, asked or not.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

OPTIMISING_TIME = 120.0

_PR_SET_PDEATHSIG = 1


def rerun_program() -> str:
    """Rerun's program, which its Python package brings.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    import rerun_cli  # type: ignore[import-untyped]

    folder = Path(rerun_cli.__file__).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def environment() -> dict[str, str]:
    """The environment of processes that load Rerun: a copy of this one's, in which it sends no usage statistics.

    Rerun 0.41 reads its settings file and `CI`; `RERUN_ANALYTICS` has no effect. With `CI` it neither reads nor writes
    that file, so that the user's own choice stays as it is.
    """
    own = {key: value for key, value in os.environ.items() if key != "FORCE_RERUN_ANALYTICS"}
    return own | {"CI": "1", "RUST_LOG": "warn"}


def run_rerun(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run one of its commands to its end.

    Raises:
        OSError: it doesn't start, or takes longer than two minutes.
    """
    try:
        return subprocess.run(
            [rerun_program(), *arguments],
            capture_output=True,
            text=True,
            check=False,
            timeout=OPTIMISING_TIME,
            env=environment(),
            stdin=subprocess.DEVNULL,
        )
    except (subprocess.TimeoutExpired, ModuleNotFoundError) as error:
        raise OSError(str(error)) from error


def serving(address: str, port: int, web_port: int, memory: str, shown: Sequence[str] = ()) -> list[str]:
    """The command that serves.

    Args:
        address: to bind to.
        port: for streams.
        web_port: for the viewer's page.
        memory: that the server may keep for those who come late, as '512MiB'.
        shown: recordings that are opened from files.
    """
    # Whoever comes late to a campaign wants what is going on, then what was; a file is shown from its beginning.
    order = () if shown else ("--newest-first",)
    return [
        *(rerun_program(), "--serve-web", "--bind", address, "--port", str(port), "--web-viewer-port", str(web_port)),
        *("--server-memory-limit", memory, *order, *shown),
    ]


def ended_with_parent() -> Callable[[], None] | None:
    """For `subprocess.Popen(preexec_fn=)`: the kernel kills the child when this process dies, by SIGKILL even.

    Only for a process with one thread: what runs between fork and exec must not wait for a lock that another one holds,
    and the kernel means the thread that forked when it speaks of the parent. None where there is no such call: Linux
    alone has it.

    Source: prctl(2), PR_SET_PDEATHSIG.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl, parent = ctypes.CDLL(None, use_errno=True).prctl, os.getpid()

    def tie() -> None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it died before that was asked for
            os._exit(1)

    return tie


def main(arguments: Sequence[str]) -> None:
    """Serve until stdin ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of the input says when to end
    with contextlib.suppress(OSError):
        os.nice(5)
    address, port, web_port, memory, *shown = arguments
    command = serving(address, int(port), int(web_port), memory, shown)
    process = subprocess.Popen(
        command,
        env=environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=ended_with_parent(),  # noqa: PLW1509 - there is one thread here
    )
    print(process.pid, flush=True)
    try:
        while sys.stdin.buffer.read(1024):
            pass
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    main(sys.argv[1:])
