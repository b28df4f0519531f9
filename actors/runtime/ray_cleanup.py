"""A small process that acts after its parent has ended in any way, also by SIGKILL. Two tasks:

- `python -m actors.runtime.ray_cleanup folder FOLDER` ends every process of a private Ray and removes its folder.
  Ray's own processes notice the death of the program that started them, but some need half a minute.
- `python -m actors.runtime.ray_cleanup message ADDRESS` tells the user that the program was ended. If the head of a
  cluster dies, or Ray on the program's own machine, Ray ends the program immediately: no further Python code runs.

The process holds the reading end of a pipe; only the parent holds the writing end. When the parent ends, the pipe
closes. A parent that ends in order writes `GOODBYE` before; then there is no message.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import psutil  # type: ignore[import-untyped,unused-ignore]  # its stubs are a package of their own

MARK = "DECANT_RAY_CLUSTER"
"""Environment variable that all processes of one Ray cluster carry; its value is the cluster's folder."""

GOODBYE = b"goodbye"


def cluster_processes(folder: Path) -> list[psutil.Process]:
    """Processes of this user that belong to a cluster, except the calling process.

    Most processes carry the mark in their environment. Ray's helpers overwrite it with their titles, but they hold log
    files open.

    Args:
        folder: the cluster's folder, as in `MARK`.
    """
    import psutil

    return [p for p in psutil.process_iter() if p.pid != os.getpid() and _belongs(p, folder)]


def _belongs(process: psutil.Process, folder: Path) -> bool:
    import psutil

    with contextlib.suppress(psutil.Error, OSError):
        if process.environ().get(MARK) == str(folder):
            return True
        if "ray" in " ".join(process.cmdline()):
            return any(folder in Path(file.path).parents for file in process.open_files())
    return False


def end_cluster(folder: Path, *, timeout: float = 10.0) -> None:
    """Kill the remaining processes of a cluster and remove its folder.

    Args:
        folder: the cluster's folder.
        timeout: longest time to continue while processes still appear or do not end [s].
    """
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        processes = cluster_processes(folder)
        if not processes:
            break
        for process in processes:
            with contextlib.suppress(OSError):
                os.kill(process.pid, signal.SIGKILL)
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def main(task: str, subject: str) -> None:
    """Wait until the parent's end of the pipe (standard input) closes, then perform the task.

    Args:
        task: 'folder' or 'message'.
        subject: the cluster's folder, or its address.
    """
    for sig in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(sig, signal.SIG_IGN)  # only the end of the parent counts
    received = b""
    with contextlib.suppress(OSError):
        while data := os.read(0, 4096):
            received += data
    if task == "folder":
        end_cluster(Path(subject))
    elif received != GOODBYE:
        with contextlib.suppress(OSError):
            print(
                "decant ended in the midst of its work: it was killed, or Ray on this machine or at "
                f"{subject} died and ended it.\n"
                "what is done so far is kept: see to the cluster, then run the same command with --resume",
                file=sys.stderr,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
