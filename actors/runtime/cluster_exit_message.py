"""A small process that prints a message after Ray has ended its parent.

If the head of a cluster dies, or Ray on the program's own machine, Ray ends the program immediately: no further Python
code runs. This process holds the reading end of a pipe. A parent that ends in order writes `GOODBYE` first.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys

from actors.runtime.child_process import ChildProcess, python_module

GOODBYE = b"goodbye"


def speaker(address: str) -> ChildProcess:
    """Start the process.

    Args:
        address: of the cluster.
    """
    return ChildProcess(python_module("actors.runtime.cluster_exit_message", address), output=False, errors="shown")


def dismiss(process: ChildProcess) -> None:
    """End the process without a message."""
    with contextlib.suppress(OSError):
        process.write(GOODBYE)
    process.close()


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
