"""Start `decant server start` for a benchmark; the daemon ends with the benchmark, even if that is killed (Linux)."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from orchestrator.daemon.daemon_client import Client

PATIENCE = 120.0
"""Longest time to wait for any event [s]."""

_PR_SET_PDEATHSIG = 1


def started(command: Sequence[str | Path], **options: Any) -> subprocess.Popen[bytes]:
    """Start a process that receives SIGTERM when this one ends, even if this one is killed (Linux)."""

    def follow() -> None:
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

    return subprocess.Popen(list(command), preexec_fn=follow, **options)  # noqa: PLW1509  no thread runs yet


def end_in_order() -> None:
    """Handle SIGTERM like Ctrl-C, so that child processes are ended first."""

    def leave(number: int, frame: object) -> None:
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, leave)


@contextlib.contextmanager
def serving(folder: Path, *options: str, environment: Mapping[str, str] | None = None) -> Iterator[Client]:
    """Run a daemon with its state and its log in a folder.

    Args:
        folder: an existing folder.
        options: arguments of `decant server start`, including a settings file.
        environment: variables added to this process's own.
    """
    with (folder / "log").open("a") as log:
        command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "server", "start", *options]
        process = started(
            [*command, "--state", str(folder / "state"), "--port", "0"],
            stdout=log, stderr=log, start_new_session=True, env={**os.environ, **(environment or {})},
        )  # fmt: skip
        try:
            await_(lambda: process.poll() is not None or (folder / "state/url").exists())
            if process.poll() is not None:
                raise SystemExit(f"the daemon did not start:\n{(folder / 'log').read_text()[-2000:]}")
            with Client(f"{(folder / 'state/url').read_text().strip()}", folder / "state") as client:
                await_(lambda: client.get("/status")["ready"])
                yield client
        finally:
            process.terminate()
            try:
                process.wait(60.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def await_(happened: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait until a function returns a true value, and return it. Raises TimeoutError."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        with contextlib.suppress(Exception):
            if found := happened():
                return found
        time.sleep(0.03)
    raise TimeoutError("it never came to that")
