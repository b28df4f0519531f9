"""Rerun's server and web viewer, in a process that ends with the one that started it.

`python -m orchestrator.live_view.viewer_server ADDRESS PORT WEB_PORT MEMORY` runs it until its input ends. It runs
Rerun's program instead of its Python package, since the package serves the viewer's page on all addresses.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from actors.runtime.child_process import ChildProcess, Completed, run

OPTIMISING_TIME = 120.0

SENDING = 0.75
"""Time for which rows for viewers are collected: `RecordingSink.send` is called at this interval [s]."""


def rerun_program() -> str:
    """Return the path of Rerun's program, which is part of its Python package.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    import rerun_cli  # type: ignore[import-untyped]

    folder = Path(rerun_cli.__file__).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def environment() -> dict[str, str | None]:
    """Return the changes to the environment of processes that load Rerun, so that it sends no usage statistics.

    Rerun 0.41 reads its settings file and `CI`; `RERUN_ANALYTICS` has no effect. With `CI`, it neither reads nor writes
    that file, so the user's own setting is unchanged.
    """
    return {"CI": "1", "RUST_LOG": "warn", "FORCE_RERUN_ANALYTICS": None}


def run_rerun(*arguments: str) -> Completed:
    """Run one of Rerun's commands to its end.

    Raises:
        OSError: it doesn't start, or takes longer than two minutes.
    """
    try:
        return run([rerun_program(), *arguments], timeout=OPTIMISING_TIME, environment=environment())
    except ModuleNotFoundError as error:
        raise OSError(str(error)) from error


def serving(address: str, port: int, web_port: int, memory: str, shown: Sequence[str] = ()) -> list[str]:
    """Return the command line of the server.

    Args:
        address: address to listen at.
        port: port of the streams.
        web_port: port of the viewer's page.
        memory: memory limit for viewers that connect late, such as '512MiB'.
        shown: recordings to open from files.
    """
    # Late viewers of a campaign need the current state first; a file is shown from its beginning.
    order = () if shown else ("--newest-first",)
    return [
        *(rerun_program(), "--serve-web", "--bind", address, "--port", str(port), "--web-viewer-port", str(web_port)),
        *("--server-memory-limit", memory, *order, *shown),
    ]


def main(arguments: Sequence[str]) -> None:
    """Serve until stdin ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of the input ends this process
    with contextlib.suppress(OSError):
        os.nice(5)
    address, port, web_port, memory, *shown = arguments
    command = serving(address, int(port), int(web_port), memory, shown)
    # This process has one thread, so that the kernel can end the server with it.
    process = ChildProcess(
        command, environment=environment(), input=False, output=False, errors="shown", dies_with_parent=True
    )
    print(process.pid, flush=True)
    try:
        while sys.stdin.buffer.read(1024):
            pass
    finally:
        process.kill()


if __name__ == "__main__":
    main(sys.argv[1:])
