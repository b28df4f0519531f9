"""Starts and ends Ray: private, on this machine only, and with nothing left behind.

Ray runs with stated memory, without dashboard or usage statistics, on the loopback interface, with a token of its own,
in a short private folder that is removed at the end. Folders of clusters whose program is gone are removed at the next
start. `actors.ray_warden` cleans up behind a program that was killed.

`start_ray` and `stop_ray` count: Ray ends with the last `stop_ray`.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import logging
import os
import secrets
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import TextIOWrapper
from pathlib import Path
from types import FrameType

from actors.protocols import LaboratoryError
from actors.ray_warden import MARK, end_cluster
from actors.spec import LaboratorySpec

START_DEADLINE = 120.0
"""Longest time that Ray may take to start [s]; a busy machine with a cold disk needs twenty."""

_LONGEST_FOLDER = 40
"""Ray puts sockets some 65 characters below its folder, and a socket's path may have 107."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_TOKEN = secrets.token_hex(32)
"""Without it nobody else on this machine may talk to our Ray. One per process, since Ray reads it only once."""


def simulator_count(spec: LaboratorySpec) -> int:
    """Size of the pool: as stated, or one per core."""
    return spec.simulators or os.cpu_count() or 1


@dataclass
class _Cluster:
    """A running Ray and what holds it."""

    folder: Path
    lock: TextIOWrapper
    warden: subprocess.Popen[bytes]
    uses: int = 1
    stop: threading.Event = field(default_factory=threading.Event)
    ready: threading.Event = field(default_factory=threading.Event)
    failure: BaseException | None = None
    keeper: threading.Thread | None = None


_cluster: _Cluster | None = None
_guard = threading.RLock()


def start_ray(spec: LaboratorySpec) -> None:
    """Start Ray for a laboratory, or use the one this process has already started.

    Blocks for some seconds: call it in a thread (`asyncio.to_thread`) from a running event loop, and `keep_signals`
    afterwards in the main thread.

    Raises:
        LaboratoryError: Ray doesn't start, or this process has a Ray that isn't Decant's.
    """
    global _cluster
    with _guard:
        if _cluster is not None:
            _cluster.uses += 1
            return
        _refuse_foreign_ray()
        cluster = _open_cluster()
        try:
            _start_keeper(cluster, spec)
        except BaseException:
            _close_cluster(cluster)
            raise
        _cluster = cluster
        atexit.register(_stop_at_exit)
    keep_signals()


def stop_ray() -> None:
    """Undo one `start_ray`; the last one ends Ray with all its processes and removes its folder."""
    global _cluster
    with _guard:
        if _cluster is None:
            return
        _cluster.uses -= 1
        if _cluster.uses > 0:
            return
        cluster, _cluster = _cluster, None
        atexit.unregister(_stop_at_exit)
        _close_cluster(cluster)


def ray_folder() -> Path | None:
    """Folder of the running cluster; None while Ray is not running."""
    return None if _cluster is None else _cluster.folder


def keep_signals() -> None:
    """Put this program's signal handlers back in place after Ray has laid its own over them.

    Ray's native handler prints a stack at SIGTERM, which looks like a crash. Only the main thread may do this; from
    others it does nothing. Where SIGTERM had no handler at all, it ends the program as `sys.exit` does, so that Ray
    ends in an orderly way.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    for number in _SIGNALS:
        handler = signal.getsignal(number)
        if handler is None:
            continue
        if number == signal.SIGTERM and handler is signal.SIG_DFL:
            handler = _leave
        signal.signal(number, handler)
        # Undoing asyncio's choice that a handled signal restarts system calls would surprise the loop's wake-up.
        signal.siginterrupt(number, False)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def _stop_at_exit() -> None:
    with _guard:
        if _cluster is not None:
            _cluster.uses = 1
    stop_ray()


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
    """One process at a time makes or removes cluster folders."""
    with (root / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def prune_clusters(root: Path | None = None) -> list[Path]:
    """Remove the clusters of programs that are gone, with processes that are left of them.

    A living program holds a lock on its cluster's `alive` file; the system drops it whatever way the program ends.

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


def _refuse_foreign_ray() -> None:
    ray = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        raise LaboratoryError("this process has already started a Ray of its own; end it before opening a laboratory")


def _open_cluster() -> _Cluster:
    root = _root()
    with _only_one(root):
        prune_clusters(root)
        folder = Path(tempfile.mkdtemp(prefix="", dir=root))
        lock = (folder / "alive").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    token = folder / "token"
    token.touch(mode=0o600)
    token.write_text(_TOKEN)
    warden = subprocess.Popen(
        [sys.executable, "-m", "actors.ray_warden", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C in the terminal is not meant for it
    )
    return _Cluster(folder, lock, warden)


def _close_cluster(cluster: _Cluster) -> None:
    cluster.stop.set()
    if cluster.keeper is not None:
        cluster.keeper.join(timeout=30.0)
    end_cluster(cluster.folder, patience=15.0)
    cluster.lock.close()
    if cluster.warden.stdin is not None:
        cluster.warden.stdin.close()
    try:
        cluster.warden.wait(timeout=15.0)
    except subprocess.TimeoutExpired:
        cluster.warden.kill()
        cluster.warden.wait()


def _start_keeper(cluster: _Cluster, spec: LaboratorySpec) -> None:
    """Start Ray in a thread that lives as long as Ray does.

    Linux ends Ray's processes when the *thread* that started them ends. A thread of an executor, or a main thread that
    hands over, would take Ray with it.
    """
    cluster.keeper = threading.Thread(target=_keep, args=(cluster, spec), name="ray-keeper", daemon=True)
    cluster.keeper.start()
    if not cluster.ready.wait(START_DEADLINE):
        raise LaboratoryError(
            f"Ray did not start within {START_DEADLINE:.0f} s; is this machine busy, or short of memory? Try again, or "
            "do without Ray (--in-process)"
        )
    if cluster.failure is not None:
        raise cluster.failure


def _keep(cluster: _Cluster, spec: LaboratorySpec) -> None:
    try:
        _init(cluster, spec)
    except Exception as error:
        cluster.failure = LaboratoryError(f"Ray does not start: {error}")
        cluster.failure.__cause__ = error
    cluster.ready.set()
    if cluster.failure is None:
        cluster.stop.wait()
    import ray

    ray.shutdown()


def _init(cluster: _Cluster, spec: LaboratorySpec) -> None:
    os.environ.update(
        RAY_AUTH_MODE="token",
        RAY_AUTH_TOKEN_PATH=str(cluster.folder / "token"),
        RAY_USAGE_STATS_ENABLED="0",
        RAY_ENABLE_UV_RUN_RUNTIME_ENV="0",
        # Makes Ray take 127.0.0.1 for the node's address and listen there only. On Windows and macOS that is its
        # habit; on Linux it would offer itself to the network.
        RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER="0",
    )
    import ray

    os.environ[MARK] = str(cluster.folder)
    try:
        for attempt in range(3):
            try:
                ray.init(
                    address="local",
                    num_cpus=simulator_count(spec),
                    num_gpus=0,
                    object_store_memory=max(spec.object_store_mb, 80) * 1024 * 1024,
                    include_dashboard=False,
                    logging_level=logging.ERROR,
                    log_to_driver=False,
                    _temp_dir=str(cluster.folder),
                    _node_ip_address="127.0.0.1",
                )
                break
            except Exception:
                # Two programs that start at once may be given the same free port.
                ray.shutdown()
                if attempt == 2:
                    raise
                time.sleep(1.0 + attempt)
    finally:
        # Programs that this one starts later are not Ray's and must not be ended with it.
        del os.environ[MARK]
    address = ray.util.get_node_ip_address()
    if address != "127.0.0.1":
        raise LaboratoryError(f"Ray listens on {address} instead of this machine only; was it imported too early?")
