"""The daemon's process: it listens, runs the daemon, shuts down at a safe point, and restarts if Ray dies.

- `serve` is the entry point; `log_lines` configures structured logs. Routes are in `http_api`, scheduling in
  `supervisor`.
- A process that has lost its Ray can't connect to another one, since calls to the dead one may block forever.
  `RayWatch` detects Ray's death in a thread, and `DaemonRestart` executes the command line again. All state is on disk,
  as for a daemon that is killed and started again. The process id and the listening socket stay, so a service manager
  notices nothing and clients wait for some seconds instead of failing. Other crashes are left to the service manager.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any, NoReturn

import uvicorn
from fastapi import FastAPI
from pythonjsonlogger.json import JsonFormatter

from actors.interfaces import LaboratoryError
from actors.runtime.ray_cluster import check_cluster
from actors.simulators.job_runner import few_arenas
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.rigs.emergency_stop import StopProtocol
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.access_tokens import Tokens
from orchestrator.daemon.state.daemon_settings import DaemonSettings, MadsciSettings
from orchestrator.daemon.state.notifications import OCCASIONS, Notifier, NotifyError, pass_on
from orchestrator.learning.run_errors import RunError
from orchestrator.live_view.live_server import LiveView
from orchestrator.records.run_registry import make_state_directory, use_state_directory
from sim_engine.settings.plugin_registry import own_extras

LISTENING, RENEWED = "DECANT_LISTENING", "DECANT_RENEWED"
"""Environment variables for the next program: file descriptor of the socket, and times of restarts [s]."""

MOST, WITHIN = 5, 3600.0
"""Largest number of automatic restarts within a period [s]; more frequent failures need an operator."""

LOOKING = 3.0
"""Interval at which Ray is checked [s]."""

COMING_TO_REST = 20.0
"""Longest time for campaigns and services to stop [s]; journals are consistent if the program ends earlier."""

POURING = 50.0
"""The same while a pour may still be weighed: Ray ends its programs 60 s after its directory service has died."""

REAPING = 10.0
"""Longest time to wait for the previous program's child processes to end [s]."""


class DaemonRestart:
    """Hands the listening socket to the next program. Create it before anything else is started.

    Attributes:
        listening: socket of the previous program; None at the first start.
    """

    def __init__(self) -> None:
        number, times = os.environ.pop(LISTENING, None), os.environ.pop(RENEWED, "")
        self._environment = dict(os.environ)  # a copy, since Ray changes it
        now = time.time()
        self._times = [float(word) for word in times.split() if now - float(word) < WITHIN]
        self._kept: int | None = None
        self.listening: socket.socket | None = None
        if number is not None:
            self.listening = socket.socket(fileno=int(number))
            self.listening.set_inheritable(False)
            _reap()

    @property
    def possible(self) -> bool:
        """Whether the limit of restarts has not been reached."""
        return len(self._times) < MOST

    def keep(self, listening: socket.socket) -> None:
        """Keep a duplicate of the socket for the next program; it stays open when this program closes its own."""
        self._kept = os.dup(listening.fileno())

    def drop(self) -> None:
        """Close the kept socket; no program follows."""
        sockets, self._kept = self._kept, None
        if sockets is not None:
            os.close(sockets)

    def begin_anew(self) -> NoReturn:
        """Execute this process's command line again.

        Locks, pipes and files close, so Ray's cleanup process treats this program as ended.
        """
        times = " ".join(str(moment) for moment in (*self._times, time.time()))
        environment = {**self._environment, RENEWED: times}
        if self._kept is not None:
            os.set_inheritable(self._kept, True)
            environment[LISTENING] = str(self._kept)
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)


def _reap() -> None:
    """Wait for the previous program's children to end. No other child has been started yet."""
    end = time.monotonic() + REAPING
    try:
        while time.monotonic() < end:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.05)
    except ChildProcessError:
        pass


class RayWatch:
    """Checks in a thread whether Ray is alive; the event loop may block in a call to a dead Ray.

    Create it in the daemon's event loop, and call `close` if the daemon ends normally.

    Args:
        daemon: daemon to notify.
        renewal: restarts the process.
        ending: returns whether a user has requested the daemon's end.
    """

    def __init__(self, daemon: Supervisor, renewal: DaemonRestart, ending: Callable[[], bool]) -> None:
        self._daemon, self._renewal, self._ending = daemon, renewal, ending
        self._loop = asyncio.get_running_loop()
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="watch over Ray", daemon=True).start()

    def close(self) -> None:
        """End the checks."""
        self._closed.set()

    def _watch(self) -> None:
        while not (lost := self._daemon.shared.warm.lost):
            if self._closed.wait(LOOKING):
                return
        if not self._renewal.possible:
            text = (
                f"Ray has lost its {lost}, and that {MOST + 1} times within {WITHIN / 3600.0:.0f} h: is this machine "
                "short of memory? End the daemon and start it again; what ran goes on from its journal"
            )
            self._loop.call_soon_threadsafe(self._daemon.shared.problem, "ray", text)
            return
        begun = time.monotonic()
        self._loop.call_soon_threadsafe(self._daemon.leave, lost)
        while time.monotonic() < begun + (POURING if self._daemon.pouring else COMING_TO_REST):
            if self._closed.wait(0.2):
                return
        if self._ending():
            _log.critical("ended without Ray, which did not let go")
            os._exit(1)
        _log.critical("begins anew without having come to rest")
        self._renewal.begin_anew()


ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

_log = logging.getLogger(__name__)


class ServeError(RunError):
    """The daemon can't listen; the message gives the reason."""

    exit_code = 2


class _Server(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Ignore signals here: the daemon handles them, since a pour must be finished before anything closes."""
        yield


def serve(settings: DaemonSettings, ready: Callable[[str], None] = lambda url: None) -> None:
    """Run the daemon until a signal or a client ends it.

    Args:
        settings: settings in force.
        ready: called with the URL once it is served.

    Raises:
        RunError: the Ray cluster can't be used, the state directory is in use, the tokens are readable by others, or
            the port is taken.
    """
    os.umask(0o077)
    few_arenas()
    restart = DaemonRestart()
    if settings.ray is not None and not settings.in_process:
        try:
            check_cluster(settings.ray, pours=False)
        except LaboratoryError as error:
            raise ServeError(str(error)) from None
    use_state_directory(settings.state)
    asyncio.run(_serve(settings, ready, restart))


async def _serve(settings: DaemonSettings, ready: Callable[[str], None], restart: DaemonRestart) -> None:
    make_state_directory(settings.state)
    tokens = Tokens(settings.tokens)
    with contextlib.ExitStack() as opened:
        listening = opened.enter_context(restart.listening or _socket(settings.host, settings.port, "--port"))
        restart.keep(listening)
        notifier = _notifier(settings)
        if notifier is not None:
            opened.callback(notifier.close)
        live = None if settings.live is None else LiveView(address=settings.live[0], web_port=settings.live[1])
        if live is not None:
            opened.enter_context(live)
        again = await _serve_with(settings, tokens, listening, ready, live, notifier, restart)
    if again:  # after the event loop's end would be too late: it waits for threads that hang in calls to a dead Ray
        _log.warning("begins anew")
        restart.begin_anew()
    _log.info("ended")


def _notifier(settings: DaemonSettings) -> Notifier | None:
    chosen = settings.notify
    if chosen is None or not chosen.to:
        return None
    try:
        return Notifier(
            chosen.to,
            about=OCCASIONS if chosen.about is None else chosen.about,
            silence=chosen.silence,
            page=chosen.page or "",
        )
    except NotifyError as error:
        raise ServeError(f"notify: to: {error}") from None


async def _serve_with(
    settings: DaemonSettings,
    tokens: Tokens,
    listening: socket.socket,
    ready: Callable[[str], None],
    live: LiveView | None,
    notifier: Notifier | None,
    restart: DaemonRestart,
) -> bool:
    """Serve until the end is requested or Ray dies; return True in the latter case, after all work has stopped."""
    daemon = Supervisor(settings, live)
    ending = _Ending(daemon)
    app = serve_app(daemon, tokens, ending)
    node = None if settings.madsci is None else _node_server(daemon, app, settings.madsci)
    server = _Server(
        uvicorn.Config(
            app,
            http=StopProtocol,
            ws="none",
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=2,
            ssl_certfile=settings.certificate,
            ssl_keyfile=settings.key,
            h11_max_incomplete_event_size=65536,
        )
    )
    loop = asyncio.get_running_loop()
    for number in ENDING:
        loop.add_signal_handler(number, ending)
    serving = asyncio.create_task(server.serve([listening]))
    serving_node: asyncio.Task[None] | None = None
    notifying = None if notifier is None else asyncio.create_task(pass_on(daemon.shared.feed.read(), notifier))
    daemon.shared.notification_counts = {} if notifier is None else notifier.counts
    url = _url(settings, listening)
    settings.address.write_text(url + "\n", encoding="utf-8")
    watch = RayWatch(daemon, restart, ending.asked.is_set)
    try:
        await daemon.start()
        if node is not None:
            serving_node = asyncio.create_task(node[0].serve([node[1]]))
        _log.info("serving %s", url, extra={"url": url, "state": str(settings.state)})
        ready(url)
        until = [asyncio.ensure_future(event.wait()) for event in (ending.asked, daemon.left)]
        await asyncio.wait({serving, *until}, return_when=asyncio.FIRST_COMPLETED)
        if not daemon.left.is_set():
            work = "; ".join(daemon.queue.running_work()) or "nothing, no campaign runs"
            _log.info("ending; waits for: %s. A second request or signal does not wait", work)
        await daemon.close()
        if notifying is not None:
            await notifying
    finally:
        again = daemon.left.is_set() and not ending.asked.is_set()
        if not again:
            watch.close()
            restart.drop()
            settings.address.unlink(missing_ok=True)
        server.should_exit = True
        await serving
        if node is not None:
            node[0].should_exit = True
            if serving_node is not None:
                await serving_node
            node[1].close()
        for number in ENDING:
            loop.remove_signal_handler(number)
    return again


class _Ending:
    """Shuts the daemon down: the first call at the next safe point, the second one at once."""

    def __init__(self, daemon: Supervisor) -> None:
        self._daemon = daemon
        self.asked = asyncio.Event()

    def __call__(self) -> None:
        if self.asked.is_set():
            self._daemon.hurry()
        self.asked.set()


def _socket(host: str, port: int, option: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise ServeError(
            f"{host}:{port}: can't listen there: {error.strerror}; is another daemon running? "
            f"{option} names another port, 0 a free one"
        ) from None
    return listening


def _node_server(daemon: Supervisor, app: FastAPI, settings: MadsciSettings) -> tuple[_Server, socket.socket]:
    """The server of the MADSci node, with its listening socket; the orders are those of the API.

    Raises:
        ServeError: the package of the node is not installed.
    """
    nodes = own_extras("decant.nodes", "madsci")
    if not nodes:
        raise ServeError("madsci: this installation has no node for MADSci; remove the section")
    listening = _socket(settings.host, settings.port, "madsci: port")
    node = nodes["madsci"](daemon, app.state.ordering, settings)
    config = uvicorn.Config(node, http=StopProtocol, ws="none", log_config=None, access_log=False, lifespan="off")
    return _Server(config), listening


def _url(settings: DaemonSettings, listening: socket.socket) -> str:
    port = listening.getsockname()[1]
    host = settings.host if settings.host not in ("0.0.0.0", "::") else socket.gethostname()
    host = f"[{host}]" if ":" in host else host
    return f"{'http' if settings.certificate is None else 'https'}://{host}:{port}"


class _UtcFormatter(JsonFormatter):
    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802  logging's name
        """The time with its zone, which is UTC in logs."""
        return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


@contextlib.contextmanager
def log_lines(stream: Any = None) -> Iterator[None]:
    """Write structured logs while the body runs: a JSON object per line on stdout, as service managers collect them."""
    handler = logging.StreamHandler(stream or sys.stdout)
    form = _UtcFormatter(
        "{asctime}{levelname}{name}{message}",
        style="{",
        rename_fields={"asctime": "time", "levelname": "level", "name": "from"},
        json_ensure_ascii=False,
    )
    handler.setFormatter(form)
    root = logging.getLogger()
    before = root.handlers, root.level
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "httpx"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        yield
    finally:
        root.handlers = before[0]
        root.setLevel(before[1])
