"""Start `decant server start` for a benchmark; the daemon ends with the benchmark, even if that is killed (Linux)."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from machine import started

from orchestrator.daemon.api.daemon_client import Client

EVENT_TIMEOUT = 120.0
"""Longest time to wait for any event [s]."""


def end_in_order() -> None:
    """Handle SIGTERM like Ctrl-C, so that child processes are ended first."""

    def leave(number: int, frame: object) -> None:
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, leave)


def launched(
    folder: Path, *options: str | Path, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a daemon with its log in a folder.

    Args:
        folder: an existing folder.
        options: arguments of `decant server start`.
        environment: variables added to this process's own.
    """
    command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "server", "start", *options]
    with (folder / "log").open("a") as log:
        variables = {**os.environ, **(environment or {})}
        return started(command, stdout=log, stderr=log, start_new_session=True, env=variables)


def await_daemon(process: subprocess.Popen[bytes], folder: Path, ready: Callable[[], Any]) -> None:
    """Wait until a daemon is ready. Raises SystemExit with the end of its log if it has ended."""
    await_(lambda: process.poll() is not None or ready())
    if process.poll() is not None:
        raise SystemExit(f"the daemon did not start:\n{(folder / 'log').read_text()[-2000:]}")


def end(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> None:
    """End a daemon with a signal; kill it if that takes more than a minute."""
    process.send_signal(number)
    try:
        process.wait(60.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def serving(folder: Path, *options: str) -> Iterator[Client]:
    """Run a daemon with its state and its log in a folder."""
    process = launched(folder, *options, "--state", folder / "state", "--port", "0")
    try:
        await_daemon(process, folder, (folder / "state/url").exists)
        with Client(f"{(folder / 'state/url').read_text().strip()}", folder / "state") as client:
            await_(lambda: client.get("/status")["ready"])
            yield client
    finally:
        end(process)


def await_(happened: Callable[[], Any], timeout: float = EVENT_TIMEOUT) -> Any:
    """Wait until a function returns a true value, and return it. Raises TimeoutError."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        with contextlib.suppress(Exception):
            if found := happened():
                return found
        time.sleep(0.03)
    raise TimeoutError("it never came to that")
