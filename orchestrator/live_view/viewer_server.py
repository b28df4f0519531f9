"""Rerun's own server and web viewer, in a process that ends with the one that started it.

`python -m orchestrator.live_view.viewer_server ADDRESS PORT WEB_PORT MEMORY` runs it until its input ends. It is
Rerun's own
program and not its Python package, which serves the viewer's page on all addresses, asked or not.
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


def rerun_program() -> str:
    """Rerun's program, which its Python package brings.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    import rerun_cli  # type: ignore[import-untyped]

    folder = Path(rerun_cli.__file__).parent
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def environment() -> dict[str, str | None]:
    """What the environment of processes that load Rerun differs in: there it sends no usage statistics.

    Rerun 0.41 reads its settings file and `CI`; `RERUN_ANALYTICS` has no effect. With `CI` it neither reads nor writes
    that file, so that the user's own choice stays as it is.
    """
    return {"CI": "1", "RUST_LOG": "warn", "FORCE_RERUN_ANALYTICS": None}


def run_rerun(*arguments: str) -> Completed:
    """Run one of its commands to its end.

    Raises:
        OSError: it doesn't start, or takes longer than two minutes.
    """
    try:
        return run([rerun_program(), *arguments], timeout=OPTIMISING_TIME, environment=environment())
    except ModuleNotFoundError as error:
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


def main(arguments: Sequence[str]) -> None:
    """Serve until stdin ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of the input says when to end
    with contextlib.suppress(OSError):
        os.nice(5)
    address, port, web_port, memory, *shown = arguments
    command = serving(address, int(port), int(web_port), memory, shown)
    # One thread runs here, so that the kernel may be asked to end the server with it.
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
