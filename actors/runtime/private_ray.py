"""A private Ray on this machine, which leaves nothing behind.

It runs:

- with a stated amount of memory, and without dashboard, autoscaler or usage statistics.
- on the loopback interface only, with its own token.
- in a short private folder that is removed at the end. Folders of clusters whose program has ended are removed at the
  next start.

`ray_settings` sets the environment variables that Ray reads. `actors.runtime.ray_cleanup` cleans up after a program
that was killed. `actors.runtime.ray_runtime` decides when a private Ray starts and ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import secrets
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from actors.interfaces import LaboratoryError
from actors.laboratory_settings import LaboratorySettings
from actors.runtime.child_process import ChildProcess, python_module
from actors.runtime.ray_cleanup import MARK, end_cluster

_LONGEST_FOLDER = 40
"""Ray puts sockets about 65 characters below its folder, and a socket's path may have 107."""

_WORKER_LOG = re.compile(r"(?:worker-|python-core-worker-).*[-_](\d+)\.(?:out|err|log)")
"""Name of a worker's log; the number is its process id."""

_UNUSED_PARTS = ("start_api_server", "start_monitor", "start_log_monitor")
"""Parts of a Ray node that are not used here: the dashboard's server, the autoscaler and the log monitor."""

_TOKEN = secrets.token_hex(32)
"""Ray refuses users without this token. One per process, since Ray reads it only once."""


@dataclass
class PrivateRay:
    """The resources of a private Ray: its folder, the lock on it, and the cleanup process."""

    folder: Path
    lock: TextIOWrapper
    warden: ChildProcess

    def settings(self) -> dict[str, str]:
        """The environment variables that must be set before Ray starts (see `ray_settings`)."""
        return {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(self.folder / "token"),
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
            # By default Ray runs all its workers at nice 15. Here only simulators lower their priority, not an arm.
            "RAY_worker_niceness": "0",
            # Makes Ray use 127.0.0.1 as the node's address and listen only there. This is its default on Windows and
            # macOS; on Linux it would listen on the network.
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
            # Ray keeps 100,000 each of dead actors, dead workers and calls for its dashboard, which is not used here:
            # over weeks this fills memory.
            "RAY_maximum_gcs_destroyed_actor_cached_count": "50",
            "RAY_maximum_gcs_dead_worker_cached_count": "50",
            "RAY_task_events_report_interval_ms": "0",
            # Ray's own processes log about 5 MB an hour, up to gigabytes.
            "RAY_ROTATION_MAX_BYTES": "2000000",
            "RAY_ROTATION_BACKUP_COUNT": "1",
        }


def _root() -> Path:
    """Private folder for the clusters of this user."""
    base = Path(tempfile.gettempdir())
    name = f"decant-{os.getuid()}"
    if len(str(base / name)) > _LONGEST_FOLDER - 10:
        base = Path("/tmp")
    root = base / name
    root.mkdir(mode=0o700, exist_ok=True)
    status = root.lstat()
    if root.is_symlink() or status.st_uid != os.getuid():
        raise LaboratoryError(f"{root} belongs to somebody else; remove it or set TMPDIR to a folder of your own")
    root.chmod(0o700)
    return root


@contextlib.contextmanager
def _only_one(root: Path) -> Iterator[None]:
    """Lock: only one process at a time creates or removes cluster folders."""
    with (root / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def prune_clusters(root: Path | None = None) -> list[Path]:
    """Remove the clusters of programs that have ended, including processes left from them.

    A running program holds a lock on its cluster's `alive` file; the system releases it however the program ends.

    Returns:
        The folders removed.
    """
    root = root or _root()
    removed = []
    for folder in sorted(p for p in root.iterdir() if p.is_dir()):
        with contextlib.suppress(OSError), (folder / "alive").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            end_cluster(folder)
            removed.append(folder)
    return removed


def open_private() -> PrivateRay:
    """Create a folder, a token and a cleanup process. Ray does not run yet."""
    root = _root()
    with _only_one(root):
        prune_clusters(root)
        folder = Path(tempfile.mkdtemp(prefix="", dir=root))
        lock = (folder / "alive").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    token = folder / "token"
    token.touch(mode=0o600)
    token.write_text(_TOKEN)
    warden = ChildProcess(python_module("actors.runtime.ray_cleanup", str(folder)), output=False, errors="dropped")
    return PrivateRay(folder, lock, warden)


def close_private(private: PrivateRay) -> None:
    """End all its processes and remove its folder."""
    end_cluster(private.folder, patience=15.0)
    private.lock.close()
    private.warden.close(15.0)


def start_private(private: PrivateRay, spec: LaboratorySettings) -> None:
    """Start Ray's processes and connect to them; its settings must be in the environment. Linux ends them with this
    thread.

    Raises:
        LaboratoryError: Ray listens on an interface other than loopback.
    """
    import ray

    for attempt in range(3):
        try:
            with _bare_ray(), _marked(private.folder):
                ray.init(
                    address="local",
                    num_cpus=spec.simulator_count,
                    num_gpus=0,
                    object_store_memory=round(max(spec.object_store, 80.0)) * 1024 * 1024,
                    include_dashboard=False,
                    logging_level=logging.ERROR,
                    log_to_driver=False,
                    _temp_dir=str(private.folder),
                    _node_ip_address="127.0.0.1",
                )
            break
        except Exception:
            # Two programs that start at once may be given the same free port.
            ray.shutdown()
            if attempt == 2:
                raise
            time.sleep(1.0 + attempt)
    address = ray.util.get_node_ip_address()
    if address != "127.0.0.1":
        raise LaboratoryError(f"Ray listens on {address} instead of this machine only; was it imported too early?")


@contextlib.contextmanager
def _bare_ray() -> Iterator[None]:
    """Context in which Ray starts without a dashboard server, an autoscaler or a log monitor.

    None of them is used. The first two need 90 MB and seconds of Ray's start each; the third keeps up to 200 logs open.
    Ray has no setting for this: with `include_dashboard=False` the server still runs with fewer functions.
    """
    from ray._private.node import Node

    def left_out(node: Node, **settings: object) -> None:
        """Start nothing."""

    before = {name: getattr(Node, name) for name in _UNUSED_PARTS if hasattr(Node, name)}
    for name in before:
        setattr(Node, name, left_out)
    try:
        yield
    finally:
        for name, method in before.items():
            setattr(Node, name, method)


@contextlib.contextmanager
def _marked(folder: Path) -> Iterator[None]:
    """Context in which Ray's processes start with the cluster's mark, which their children inherit.

    This program's own environment does not get the mark: other programs that it starts meanwhile do not belong to Ray
    and must not be ended with it.
    """
    from ray._private import services

    start = services.start_ray_process

    def start_marked(*args: Any, env_updates: dict[str, str] | None = None, **settings: Any) -> Any:
        return start(*args, env_updates={**(env_updates or {}), MARK: str(folder)}, **settings)

    services.start_ray_process = start_marked
    try:
        yield
    finally:
        services.start_ray_process = start


def forget_logs(private: PrivateRay) -> int:
    """Remove the logs of Ray's workers that have ended: each bench that is opened and closed leaves some.

    Returns:
        Number of files removed.
    """
    import psutil

    removed = 0
    for path in private.folder.glob("session_*/logs/*-*"):
        found = _WORKER_LOG.fullmatch(path.name)
        if found is not None and not psutil.pid_exists(int(found[1])):
            path.unlink(missing_ok=True)
            removed += 1
    return removed


def dead_processes() -> list[str]:
    """Ray's own processes that have died; empty while all of them run, and if there is no Ray."""
    from ray._private import worker

    node = worker._global_node
    return [] if node is None else [str(name) for name, _ in node.dead_processes()]


def is_forgotten() -> bool:
    """Whether Ray treats this program as dead because its connection was cut. Ray has then ended all of its actors and
    tasks.

    Queries Ray's directory: this takes a millisecond, or a minute if the directory does not respond.
    """
    import ray
    from ray._private.state import state

    this = ray.get_runtime_context().get_job_id()
    return any(job["JobID"] == this and job["IsDead"] for job in state.job_table())


@contextlib.contextmanager
def ray_settings(**values: str) -> Iterator[None]:
    """Set environment variables for Ray, and restore their previous values afterwards.

    Ray reads most of them when it is imported. If it is already imported, this function makes Ray read them again.

    Args:
        values: values of environment variables.
    """
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    if "ray" in sys.modules:
        from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

        Config.initialize("")
        AuthenticationTokenLoader.instance().reset_cache()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
