"""Starts and ends Ray for this process: a private Ray (`actors.runtime.private_ray`) or an existing cluster.

- A cluster is joined with the environment as it is (its token is the user's) and left running. Ray itself removes the
  actors of a program that leaves the cluster or dies.
- `start_ray` and `stop_ray` count their calls: the last `stop_ray` ends Ray or leaves the cluster.
- A private Ray whose own processes die, or that was cut off, does not reply any more. `ray_lost` and `watch_ray` report
  this within seconds.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import logging
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from actors.interfaces import LaboratoryError
from actors.laboratory_settings import LaboratorySettings
from actors.runtime.cluster_exit_message import dismiss, speaker
from actors.runtime.private_ray import (
    PrivateRay,
    close_private,
    dead_processes,
    forget_logs,
    is_forgotten,
    open_private,
    ray_settings,
    start_private,
)

START_DEADLINE = 120.0
"""Longest time that Ray may take to start [s]; a busy machine with a cold disk needs twenty."""

LOOK_INTERVAL = 2.0
"""Time between two checks whether a private Ray still treats this program as alive [s]."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass
class _Cluster:
    """A running Ray: a private one, or a cluster joined at its address."""

    private: PrivateRay | None
    address: str | None
    uses: int = 1
    stop: threading.Event = field(default_factory=threading.Event)
    ready: threading.Event = field(default_factory=threading.Event)
    failure: BaseException | None = None
    forgotten: bool = False
    keeper: threading.Thread | None = None


_cluster: _Cluster | None = None
_guard = threading.RLock()


def start_ray(spec: LaboratorySettings) -> None:
    """Start Ray for a laboratory, join its cluster, or use the Ray that this process has already started.

    Blocks for some seconds. From a running event loop, call it in a thread (`asyncio.to_thread`), and then
    `keep_signals` in the main thread.

    Raises:
        LaboratoryError: Ray does not start, or this process has another Ray.
    """
    global _cluster
    address = None if spec.ray is None else spec.ray.address
    with _guard:
        if _cluster is not None:
            if _cluster.address != address:
                raise LaboratoryError(
                    f"this process already uses {_cluster.address or 'a Ray of its own'}; end it first"
                )
            _cluster.uses += 1
            return
        _refuse_foreign_ray()
        cluster = _Cluster(open_private() if address is None else None, address)
        try:
            _start_keeper(cluster, spec)
        except BaseException:
            _close_cluster(cluster)
            raise
        _cluster = cluster
        atexit.register(_stop_at_exit)
    keep_signals()


def stop_ray() -> None:
    """Undo one `start_ray`. The last call ends a private Ray with all its processes, or leaves a cluster."""
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
    """Folder of the private Ray; None if there is none."""
    return None if _cluster is None or _cluster.private is None else _cluster.private.folder


def forget_ray_logs() -> None:
    """Remove the logs of dead workers of a private Ray. Takes little time; may be called at any time."""
    cluster = _cluster
    if cluster is not None and cluster.private is not None:
        forget_logs(cluster.private)


def ray_lost() -> str:
    """The lost part of a private Ray, a process or its connection to this one; empty while nothing is lost."""
    cluster = _cluster
    if cluster is None or cluster.private is None:
        return ""
    return ", ".join(dead_processes()) or ("connection to this program" if cluster.forgotten else "")


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
        if _cluster is not None:
            _cluster.uses = 1
    stop_ray()


def _refuse_foreign_ray() -> None:
    ray = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        raise LaboratoryError("this process has already started a Ray of its own; end it before opening a laboratory")


def _close_cluster(cluster: _Cluster) -> None:
    cluster.stop.set()
    if cluster.keeper is not None:
        cluster.keeper.join(timeout=30.0)
    if cluster.private is not None:
        close_private(cluster.private)


def _start_keeper(cluster: _Cluster, spec: LaboratorySettings) -> None:
    """Start Ray in a thread that lives as long as Ray does.

    Linux ends Ray's processes when the *thread* that started them ends. If a thread of an executor started Ray, or a
    main thread that ends early, Ray would end with it.
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


def _keep(cluster: _Cluster, spec: LaboratorySettings) -> None:
    settings = {"RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"} if cluster.private is None else cluster.private.settings()
    with ray_settings(**settings):
        messenger = None
        try:
            if cluster.private is None:
                _join(cluster)
                messenger = speaker(str(cluster.address))
            else:
                start_private(cluster.private, spec)
        except Exception as error:
            what = "Ray does not start" if cluster.address is None else f"Ray cluster at {cluster.address}"
            cluster.failure = LaboratoryError(f"{what}: {error}")
            cluster.failure.__cause__ = error
        cluster.ready.set()
        if cluster.failure is None:
            _monitor(cluster)
        import ray

        ray.shutdown()
        if messenger is not None:
            dismiss(messenger)


def _monitor(cluster: _Cluster) -> None:
    """Monitor Ray until it is to be ended. Callers that wait for a reply use `ray_lost` to find out whether one can
    arrive.
    """
    while not cluster.stop.wait(LOOK_INTERVAL):
        if cluster.private is None or cluster.forgotten or dead_processes():
            continue
        with contextlib.suppress(Exception):  # its directory is just ending: the next check detects that
            cluster.forgotten = is_forgotten()


def _join(cluster: _Cluster) -> None:
    import ray

    ray.init(address=cluster.address, namespace="decant", logging_level=logging.ERROR, log_to_driver=False)


WATCH_INTERVAL = 1.0
"""Time between two checks for losses of Ray [s]."""


async def watch_ray(died: Callable[[str], None]) -> None:
    """Wait until a private Ray has lost one of its own processes or its connection to this one. May wait for ever.

    Args:
        died: called once with a message that names the lost part.
    """

    while not (lost := ray_lost()):
        await asyncio.sleep(WATCH_INTERVAL)
    died(f"Ray on this machine has lost its {lost}, and with it all that it ran; nothing can be asked of it any more")
