"""A Ray cluster of several nodes on this machine, started as people start one, whose nodes can be killed.

Its processes carry the mark by which `actors.runtime.ray_cleanup` finds them: a warden ends them when the test's
process is
gone, however it went.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil

from actors.runtime.child_process import child_environment
from actors.runtime.ray_cleanup import MARK, cluster_processes, end_cluster
from tests.support.waiting import PATIENCE

NOT_OURS = ("ray::IDLE", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
"""Titles of Ray's own processes and of workers that wait for work."""

START_DEADLINE = PATIENCE
"""For one node on a busy machine [s]."""


class LocalCluster:
    """Nodes on 127.0.0.2, 127.0.0.3, …; the first one is the head. To be used with `with`.

    Not on 127.0.0.1, for which Ray would take the machine's own address.
    """

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="c", dir="/tmp"))  # short, since Ray puts sockets in it
        self._token = self.folder / "token"
        self._token.write_text(secrets.token_hex(32))
        with socket.socket() as free:
            free.bind(("127.0.0.2", 0))
            self.address = f"127.0.0.2:{free.getsockname()[1]}"
        self._raylets: list[psutil.Process] = []
        self._warden = subprocess.Popen(
            [sys.executable, "-m", "actors.runtime.ray_cleanup", "folder", str(self.folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env=child_environment(),
        )

    @property
    def environment(self) -> dict[str, str]:
        """What a program needs to join."""
        settings = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(self._token), "RAY_USAGE_STATS_ENABLED": "0"}
        return {**os.environ, **settings}

    def start_node(self, *, cpus: int, bench: bool = False, cache: Path | None = None) -> int:
        """Start a node.

        Args:
            cpus: cores that it offers.
            bench: whether it offers the bench's resource.
            cache: its cache directory, as if it shared no files with this program.

        Returns:
            Its number.
        """
        number = len(self._raylets)
        port = self.address.rpartition(":")[2]
        role = (
            ["--head", f"--port={port}", "--include-dashboard=false", f"--temp-dir={self.folder}"]
            if number == 0
            else [f"--address={self.address}"]
        )
        command = [
            *(sys.executable, "-m", "ray.scripts.scripts", "start", *role),
            *(f"--node-ip-address=127.0.0.{number + 2}", f"--num-cpus={cpus}", "--disable-usage-stats"),
            *("--object-store-memory=90000000", "--min-worker-port=0", "--max-worker-port=0"),
            *(["--resources", '{"decant_bench": 1}'] if bench else []),
        ]
        known = {p.pid for p in self._raylets}
        done = subprocess.run(
            command,
            env={
                **self.environment,
                **({} if cache is None else {"DECANT_CACHE_DIR": str(cache)}),
                MARK: str(self.folder),
                # a private Ray of this program, in an earlier test, may have turned it off
                "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "1",
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=START_DEADLINE,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        mine = cluster_processes(self.folder)
        (raylet,) = [p for p in mine if p.name() == "raylet" and p.pid not in known]
        self._raylets.append(raylet)
        return number

    def kill_node(self, number: int) -> None:
        """kill -9 of a node's raylet and of all processes on it, as if the machine had lost its power."""
        raylet = self._raylets[number]
        for process in [raylet, *raylet.children(recursive=True)]:
            with contextlib.suppress(psutil.Error, OSError):
                os.kill(process.pid, signal.SIGKILL)

    def workers(self, number: int) -> list[psutil.Process]:
        """Processes of actors on a node."""
        found = []
        for process in self._raylets[number].children(recursive=True):
            with contextlib.suppress(psutil.Error):
                title = " ".join(process.cmdline())
                if title.startswith("ray::") and not title.startswith(NOT_OURS):
                    found.append(process)
        return found

    def is_alive(self) -> bool:
        """Whether the head still runs."""
        return self._raylets[0].is_running() and self._raylets[0].status() != psutil.STATUS_ZOMBIE

    def close(self) -> None:
        """End everything."""
        end_cluster(self.folder, timeout=15.0)
        assert self._warden.stdin is not None
        self._warden.stdin.close()
        self._warden.wait(timeout=30.0)

    def __enter__(self) -> LocalCluster:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
