"""A small process that cleans up after its parent was killed.

Ray's own processes notice the death of the program that started them, but some need half a minute. The cleanup process
holds the reading end of a pipe; only the parent holds the writing end. When the parent ends for any reason, the pipe
closes. The cleanup process then ends every process that carries the cluster's mark and removes the cluster's folder.
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


def cluster_processes(folder: Path) -> list[int]:
    """Process ids of this user that belong to a cluster, except the calling process.

    Most processes carry the mark in their environment. Ray's helpers overwrite it with their titles, but they hold log
    files open.

    Args:
        folder: the cluster's folder, as in `MARK`.
    """
    import psutil

    return [p.pid for p in psutil.process_iter() if p.pid != os.getpid() and _belongs(p, folder)]


def _belongs(process: psutil.Process, folder: Path) -> bool:
    import psutil

    with contextlib.suppress(psutil.Error, OSError):
        if process.environ().get(MARK) == str(folder):
            return True
        if "ray" in " ".join(process.cmdline()):
            return any(folder in Path(file.path).parents for file in process.open_files())
    return False


def end_cluster(folder: Path, *, patience: float = 10.0) -> None:
    """Kill the remaining processes of a cluster and remove its folder.

    Args:
        folder: the cluster's folder.
        patience: longest time to continue while processes still appear or do not end [s].
    """
    end = time.monotonic() + patience
    while time.monotonic() < end:
        processes = cluster_processes(folder)
        if not processes:
            break
        for pid in processes:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Wait for the parent's end of the pipe (standard input) to close, then clean up."""
    for sig in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(sig, signal.SIG_IGN)  # only the end of the parent counts
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass
    end_cluster(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
