"""A small process that speaks for its parent when Ray has ended it.

Where the head of a cluster dies, or Ray on the program's own machine, Ray ends the program on the spot: no Python code
runs any more. The process holds the reading end of a pipe; a parent that leaves in order writes `GOODBYE` first.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys

GOODBYE = b"goodbye"


def speaker(address: str) -> subprocess.Popen[bytes]:
    """Start the process.

    Args:
        address: of the cluster.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "actors.cluster.last_word", address],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C in the terminal is not meant for it
    )


def dismiss(process: subprocess.Popen[bytes]) -> None:
    """End it without a word."""
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        process.communicate(GOODBYE, timeout=10.0)


def main() -> None:
    """Wait for the parent's end of the pipe (standard input) to close."""
    for sig in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(sig, signal.SIG_IGN)  # only the end of the parent counts
    heard = b""
    with contextlib.suppress(OSError):
        while words := os.read(0, 4096):
            heard += words
    if heard != GOODBYE:
        with contextlib.suppress(OSError):
            print(
                "decant ended in the midst of its work: it was killed, or Ray on this machine or at "
                f"{sys.argv[1]} died and ended it.\n"
                "what is done so far is kept: see to the cluster, then run the same command with --resume",
                file=sys.stderr,
            )


if __name__ == "__main__":
    main()
