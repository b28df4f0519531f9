"""Starts and ends Ray for this process: a private Ray on this machine, or an existing cluster.

A private Ray leaves nothing behind. It runs:

- with a stated amount of memory, and without dashboard, autoscaler or usage statistics.
- without the user's variables `RAY_…`, which are meant for another Ray: with `RAY_grpc_enable_http_proxy=1` or
  `RAY_USE_TLS=1` the processes do not find each other and wait for 100 s, with `RAY_REDIS_ADDRESS` this process is
  ended.
- on the loopback interface only, with its own token.
- in a short private folder that is removed at the end. `actors.runtime.ray_cleanup` removes it after this program was
  killed. Folders of programs that have ended are also removed at the next start.

A cluster is joined with the environment as it is (its token is the user's) and left running. Ray itself removes the
actors of a program that leaves the cluster or dies.

`start_ray` and `stop_ray` count their calls: the last `stop_ray` ends Ray or leaves the cluster. A private Ray whose
own processes die, or that was cut off, does not reply any more. `ray_lost` and `watch_ray` report this within seconds.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import fcntl
import logging
import os
import re
import secrets
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import START_DEADLINE, ChildProcess, own_environment, python_module
from actors.runtime.ray_cleanup import GOODBYE, MARK, end_cluster

if TYPE_CHECKING:
    import psutil  # type: ignore[import-untyped,unused-ignore]  # its stubs are a package of their own

JOIN_DEADLINE = 120.0
"""Longest time that the connection to a running Ray may take [s]. A private one has `START_DEADLINE`: it starts within
3 s on an idle machine, and within more than 120 s on one core next to twenty other programs.
"""

LOOK_INTERVAL = 2.0
"""Time between two checks whether a private Ray still treats this program as alive [s]."""

WATCH_INTERVAL = 1.0
"""Time between two checks for losses of Ray [s]."""

_LONGEST_FOLDER = 40
"""Ray puts sockets about 65 characters below its folder, and a socket's path may have 107."""

_WORKER_LOG = re.compile(r"(?:worker-|python-core-worker-).*[-_](\d+)\.(?:out|err|log)")
"""Name of a worker's log; the number is its process id."""

_PROGRAM = "decant_program"
"""Resource of a private Ray, of which this program holds all. Ray takes it back when it treats the program as dead."""

_TOKEN = secrets.token_hex(32)
"""Ray refuses users without this token. One per process, since Ray reads it only once."""

_JOIN_SETTINGS = {
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    # Ray would print this for each process that died at its task, also for those that are ended with the run. What was
    # lost by it, and what is repeated, is reported by the pool.
    "RAY_DEDUP_LOGS_SKIP_REGEX": "^A worker died or was killed while executing a task",
}

_PRIVATE_SETTINGS = {
    **_JOIN_SETTINGS,
    "RAY_AUTH_MODE": "token",
    "RAY_USAGE_STATS_ENABLED": "0",
    # By default Ray runs all its workers at nice 15. Here only simulators lower their priority, not an arm.
    "RAY_worker_niceness": "0",
    # Makes Ray use 127.0.0.1 as the node's address and listen only there. This is its default on Windows and macOS; on
    # Linux it would listen on the network.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    # Ray keeps 100,000 each of dead actors, dead workers and calls for its dashboard, which is not used here: over
    # weeks this fills memory.
    "RAY_maximum_gcs_destroyed_actor_cached_count": "50",
    "RAY_maximum_gcs_dead_worker_cached_count": "50",
    "RAY_task_events_report_interval_ms": "0",
    # Ray's own processes log about 5 MB an hour, up to gigabytes.
    "RAY_ROTATION_MAX_BYTES": "2000000",
    "RAY_ROTATION_BACKUP_COUNT": "1",
    # Limits of wall time within which Ray's processes must reach each other, 5 to 60 s: beside twenty busy processes
    # they need longer, and whether they run is monitored here anyway.
    "RAY_agent_register_timeout_ms": "600000",
    "RAY_gcs_rpc_server_connect_timeout_s": "600",
    "RAY_health_check_timeout_ms": "60000",
    "RAY_py_gcs_connect_timeout_s": "600",
    "RAY_raylet_start_wait_time_s": "600",
    "RAY_worker_register_timeout_seconds": "600",
}

_AGENT_PORTS = ("metrics_agent_port", "metrics_export_port", "dashboard_agent_listen_port", "runtime_env_agent_port")
"""Parameters of Ray's node, and begins of the names of the files in which its agents write these ports."""

_KEPT_SETTINGS = re.compile(r"RAY_(memory_|memory_monitor_|BACKEND_LOG_LEVEL)")
"""Variables of the user's that a private Ray gets all the same: when it ends workers for lack of memory; logging."""

_CONNECTION_SETTINGS = (
    "RAY_grpc_enable_http_proxy",
    *("RAY_USE_TLS", "RAY_TLS_SERVER_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_CA_CERT"),
    *("RAY_REDIS_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN_PATH"),
)
"""Variables that have to be the same for all programs of a cluster.

Sources: ray-project/ray pull request 23526 (gRPC follows the proxy variables if the first is set; they then also apply
to connections on this machine), issue 39191 (TLS without certificates: the start waits, then fails).
"""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass
class _PrivateRay:
    """The resources of a private Ray.

    Attributes:
        folder: everything that Ray writes.
        lock: held while this program runs.
        cleanup: the process that cleans up after this program.
        processes: Ray's own processes, by name.
        membership: the placement group that exists for as long as Ray treats this program as alive.
    """

    folder: Path
    lock: TextIOWrapper
    cleanup: ChildProcess
    processes: dict[str, psutil.Process] = field(default_factory=dict)
    membership: Any = None


@dataclass
class _Session:
    """The Ray that this process uses: a private one, or a cluster joined at its address."""

    private: _PrivateRay | None
    address: str | None
    uses: int = 1
    stop: threading.Event = field(default_factory=threading.Event)
    ready: threading.Event = field(default_factory=threading.Event)
    failure: BaseException | None = None
    cut_off: bool = False
    keeper: threading.Thread | None = None

    @property
    def dead(self) -> list[str]:
        """Ray's own processes that have died."""
        processes = {} if self.private is None else self.private.processes
        return [name for name, process in processes.items() if not _runs(process)]


@dataclass(frozen=True)
class RayStart:
    """How Ray starts.

    Attributes:
        address: host:port of a cluster to join; None for a private Ray on this machine.
        cpus: number of simulators that a private Ray runs at once.
    """

    address: str | None = None
    cpus: int = 1


OBJECT_STORE = 160 * 1024 * 1024
"""Shared memory of a private Ray for simulators' results [bytes]."""

_session: _Session | None = None
_guard = threading.RLock()


def start_ray(start: RayStart) -> None:
    """Start a private Ray, join a cluster, or use the Ray that this process has already started.

    Blocks for some seconds. From a running event loop, use `open_ray`.

    Raises:
        LaboratoryError: Ray does not start, or this process has another Ray.
    """
    global _session
    with _guard:
        if _session is not None:
            if _session.address != start.address:
                raise LaboratoryError(
                    f"this process already uses {_session.address or 'a Ray of its own'}; end it first"
                )
            _session.uses += 1
            return
        _refuse_foreign_ray()
        session = _Session(_open_private() if start.address is None else None, start.address)
        try:
            _start_keeper(session, start)
        except BaseException:
            _close(session)
            raise
        _session = session
        atexit.register(_stop_at_exit)
    keep_signals()


async def open_ray(start: RayStart) -> None:
    """`start_ray` from an event loop, in its main thread if there are signal handlers to keep. May be cancelled.

    Raises:
        LaboratoryError: as for `start_ray`.
    """
    starting = asyncio.ensure_future(asyncio.to_thread(start_ray, start))
    try:
        await asyncio.shield(starting)
    except asyncio.CancelledError:
        # The start cannot be interrupted, and must not continue after its caller has ended.
        await asyncio.wait({starting})
        if starting.exception() is None:
            await asyncio.to_thread(stop_ray)
        raise
    keep_signals()


def stop_ray() -> None:
    """Undo one `start_ray`. The last call ends a private Ray with all its processes, or leaves a cluster."""
    global _session
    with _guard:
        if _session is None:
            return
        _session.uses -= 1
        if _session.uses > 0:
            return
        session, _session = _session, None
        atexit.unregister(_stop_at_exit)
        _close(session)


def ray_folder() -> Path | None:
    """Folder of the private Ray; None if there is none."""
    return None if _session is None or _session.private is None else _session.private.folder


def forget_ray_logs(folder: Path | None = None) -> int:
    """Remove the logs of Ray's workers that have ended: each bench that is opened and closed leaves some.

    Args:
        folder: of a private Ray; default: of this process's, if there is one.

    Returns:
        Number of files removed.
    """
    import psutil

    folder = folder or ray_folder()
    removed = 0
    for path in [] if folder is None else folder.glob("session_*/logs/*-*"):
        match = _WORKER_LOG.fullmatch(path.name)
        if match is not None and not psutil.pid_exists(int(match[1])):
            path.unlink(missing_ok=True)
            removed += 1
    return removed


def worker_errors(pid: int) -> str:
    """The end of a worker's standard error in a private Ray; empty on a cluster, or if it wrote nothing."""
    folder = ray_folder()
    for path in [] if folder is None else folder.glob(f"session_*/logs/worker-*-{pid}.err"):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(line for line in lines[-100:] if not line.startswith(":"))  # Ray's own marks
    return ""


def ray_lost() -> str:
    """The lost part of a private Ray, a process or its connection to this one; empty while nothing is lost."""
    session = _session
    if session is None:
        return ""
    return ", ".join(session.dead) or ("connection to this program" if session.cut_off else "")


async def watch_ray(died: Callable[[str], None]) -> None:
    """Wait until a private Ray has lost one of its own processes or its connection to this one. May wait for ever.

    Args:
        died: called once with a message that names the lost part.
    """
    while not (lost := ray_lost()):
        await asyncio.sleep(WATCH_INTERVAL)
    died(f"Ray on this machine has lost its {lost}, and with it all that it ran; nothing can be asked of it any more")


def keep_signals() -> None:
    """Restore this program's signal handlers after Ray has replaced them.

    Ray's native handler prints a stack at SIGTERM, which looks like a crash. Only the main thread may set handlers; in
    other threads this function does nothing. If SIGTERM had no handler, the new one ends the program as `sys.exit`
    does, so that Ray ends in order.
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
        # signal.signal() undoes asyncio's setting that system calls restart after a signal; the loop's wake-up relies
        # on it.
        signal.siginterrupt(number, False)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def _stop_at_exit() -> None:
    with _guard:
        if _session is not None:
            _session.uses = 1
    stop_ray()


def _refuse_foreign_ray() -> None:
    ray = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        raise LaboratoryError("this process has already started a Ray of its own; end it before opening a laboratory")


def _close(session: _Session) -> None:
    session.stop.set()
    if session.keeper is not None:
        session.keeper.join(timeout=30.0)
    if session.private is not None:
        end_cluster(session.private.folder, timeout=15.0)
        session.private.lock.close()
        session.private.cleanup.close(15.0)


def _start_keeper(session: _Session, start: RayStart) -> None:
    """Start Ray in a thread that lives as long as Ray does.

    Linux ends Ray's processes when the *thread* that started them ends. If a thread of an executor started Ray, or a
    main thread that ends early, Ray would end with it.
    """
    session.keeper = threading.Thread(target=_keep, args=(session, start), name="ray-keeper", daemon=True)
    session.keeper.start()
    deadline = START_DEADLINE if session.private else JOIN_DEADLINE
    if not session.ready.wait(deadline):
        set_here = [] if session.private else [name for name in _CONNECTION_SETTINGS if os.environ.get(name)]
        hint = f" Set for the connection are {', '.join(set_here)}: are they so on the cluster?" if set_here else ""
        raise LaboratoryError(
            f"Ray did not start within {deadline:.0f} s; is this machine busy, or short of memory? Try again, or "
            f"do without Ray (--in-process).{hint}"
        )
    if session.failure is not None:
        raise session.failure


def _keep(session: _Session, start: RayStart) -> None:
    exit_message: ChildProcess | None = None
    settings: dict[str, str | None] = {**_JOIN_SETTINGS}
    if (private := session.private) is not None:
        foreign = [name for name in os.environ if name.startswith("RAY_") and not _KEPT_SETTINGS.match(name)]
        settings = {
            **dict.fromkeys(foreign),
            **_PRIVATE_SETTINGS,
            "RAY_AUTH_TOKEN_PATH": str(private.folder / "token"),
        }
    with own_environment(**settings):
        try:
            with _ray_internals(helpers=private is None):
                if private is not None:
                    with own_environment(**{MARK: str(private.folder)}):
                        _start_private(private, start)
                else:
                    _join(str(session.address))
                    command = python_module("actors.runtime.ray_cleanup", "message", str(session.address))
                    exit_message = ChildProcess(command, output=False, errors="shown")
        except Exception as error:
            problem = "Ray does not start" if session.address is None else f"Ray cluster at {session.address}"
            session.failure = LaboratoryError(f"{problem}: {error}")
            session.failure.__cause__ = error
        session.ready.set()
        if session.failure is None:
            _monitor(session)
        import ray

        ray.shutdown()
        if exit_message is not None:
            with contextlib.suppress(OSError):
                exit_message.write(GOODBYE)
            exit_message.close()


def _monitor(session: _Session) -> None:
    """Monitor Ray until it is to be ended. Callers that wait for a reply use `ray_lost` to find out whether one can
    arrive.
    """
    while not session.stop.wait(LOOK_INTERVAL):
        if session.private is None or session.cut_off or session.dead:
            continue
        with contextlib.suppress(Exception):  # Ray's directory is just ending: the next check detects that
            session.cut_off = _is_cut_off(session.private.membership)


def _join(address: str) -> None:
    import ray

    ray.init(address=address, namespace="decant", logging_level=logging.ERROR, log_to_driver=False)


# ---- a private Ray


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


def prune_clusters(root: Path) -> list[Path]:
    """Remove the clusters of programs that have ended, including processes left from them.

    A running program holds a lock on its cluster's `alive` file; the system releases it however the program ends.

    Args:
        root: contains a folder for each cluster.

    Returns:
        The folders removed.
    """
    removed = []
    for folder in sorted(p for p in root.iterdir() if p.is_dir()):
        with contextlib.suppress(OSError), (folder / "alive").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            end_cluster(folder)
            removed.append(folder)
    return removed


def _open_private() -> _PrivateRay:
    """Create a folder, a token and a cleanup process. Ray does not run yet."""
    root = _root()
    with (root / "lock").open("w") as only_one:  # only one process at a time creates or removes folders
        fcntl.flock(only_one, fcntl.LOCK_EX)
        prune_clusters(root)
        folder = Path(tempfile.mkdtemp(prefix="", dir=root))
        lock = (folder / "alive").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    token = folder / "token"
    token.touch(mode=0o600)
    token.write_text(_TOKEN)
    command = python_module("actors.runtime.ray_cleanup", "folder", str(folder))
    return _PrivateRay(folder, lock, ChildProcess(command, output=False, errors="dropped"))


def _start_private(private: _PrivateRay, start: RayStart) -> None:
    """Start Ray's processes and connect to them; its settings must be in the environment. Linux ends them with this
    thread.

    Raises:
        LaboratoryError: Ray listens on an interface other than loopback.
    """
    import psutil
    import ray
    from ray.util.placement_group import placement_group

    for attempt in range(3):
        try:
            ray.init(
                address="local",
                num_cpus=start.cpus,
                num_gpus=0,
                resources={_PROGRAM: 1},
                object_store_memory=OBJECT_STORE,
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
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.Error):  # a child of the user's program that has ended, for example
            if child.environ().get(MARK) == str(private.folder):
                private.processes[child.name()] = child
    private.membership = placement_group([{_PROGRAM: 1.0}])


def _runs(process: psutil.Process) -> bool:
    import psutil

    with contextlib.suppress(psutil.Error):
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    return False


def _is_cut_off(membership: Any) -> bool:
    """Whether Ray treats this program as dead because its connection was cut. Ray has then ended all of its actors and
    tasks, and removed its placement groups.

    Queries Ray's directory: this takes a millisecond, or a minute if the directory does not respond.
    """
    from ray.util.placement_group import placement_group_table

    return placement_group_table(membership).get("state") not in ("PENDING", "PREPARED", "CREATED")


@contextlib.contextmanager
def _ray_internals(*, helpers: bool) -> Iterator[None]:
    """Context for `ray.init`: the only place that uses Ray's private API, for what its public API lacks.

    - Ray reads most of its environment variables when it is imported. If the user's program has imported it before,
      or this process has used another Ray, Ray must read them again.
    - `ray.init` starts a dashboard server, an autoscaler and a log monitor. None of them is used here. The first two
      need 90 MB and seconds of Ray's start each; the third keeps up to 200 logs open. `include_dashboard=False`
      still starts the server, with fewer functions. The other two have options only in `ray start`, which would
      need another process.
    - A private Ray that has not registered its node within 30 s has failed, without a setting: a busy machine needs
      longer. Here it has failed if its process has ended, or at `START_DEADLINE`.
    - The node's process ends itself if its agents have not written their ports to files within 15 s, without a setting
      (`src/ray/util/port_persistence.h` of 2.60). Here they are given, and the files are written before.

    Args:
        helpers: whether to start the three processes; True for a cluster that others have started.
    """
    was_imported = "ray" in sys.modules
    from ray._private import services
    from ray._private.node import Node
    from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

    if was_imported:
        Config.initialize("")
        AuthenticationTokenLoader.instance().reset_cache()
    left_out = () if helpers else ("start_api_server", "start_monitor", "start_log_monitor")
    before = {name: getattr(Node, name) for name in left_out if hasattr(Node, name)}
    for name in before:
        setattr(Node, name, lambda node, **settings: None)
    get_node, start_processes = services.get_node, Node.start_ray_processes

    def with_ports(node: Any) -> None:
        if not helpers:
            for name, port in zip(_AGENT_PORTS, _free_ports(len(_AGENT_PORTS)), strict=True):
                setattr(node._ray_params, name, port)
                Path(node._session_dir, f"{name}_{node._node_id}").write_text(str(port))  # as the agent writes it
        start_processes(node)

    def registered(*of: Any) -> Any:
        end = time.monotonic() + START_DEADLINE
        while True:
            try:
                return get_node(*of)
            except RuntimeError:
                if helpers or time.monotonic() > end or not _raylet_runs():
                    raise
            time.sleep(0.2)

    services.get_node, Node.start_ray_processes = registered, with_ports
    try:
        yield
    finally:
        services.get_node, Node.start_ray_processes = get_node, start_processes
        for name, method in before.items():
            setattr(Node, name, method)


def _free_ports(count: int) -> list[int]:
    """Ports of the loopback interface that are free at this moment."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def _raylet_runs() -> bool:
    """Whether the node process of a private Ray that this process starts is running."""
    import psutil

    return any(child.name() == "raylet" and _runs(child) for child in psutil.Process().children())
