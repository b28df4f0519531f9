"""The process of `decant serve`: it listens, runs the daemon, and shuts down at a safe point after a signal.

`serve` is the entry point; `log_lines` configures structured logs. Routes are in `http_api`, scheduling in
`supervisor`, and the restart after a failure of Ray in `restart`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn
from pythonjsonlogger.json import JsonFormatter

from orchestrator.catalogue.run_registry import make_state_directory, use_state_directory
from orchestrator.daemon.access_control import Tokens
from orchestrator.daemon.daemon_settings import DaemonSettings
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.notifications import OCCASIONS, Notifier, NotifyError, pass_on
from orchestrator.daemon.restart import DaemonRestart, RayWatch
from orchestrator.daemon.supervisor import Supervisor
from orchestrator.live_view.live_server import LiveView
from orchestrator.run_errors import RunError

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
        RunError: the state directory is in use, the tokens are readable by others, or the port is taken.
    """
    os.umask(0o077)
    use_state_directory(settings.state)
    asyncio.run(_serve(settings, ready, DaemonRestart()))


async def _serve(settings: DaemonSettings, ready: Callable[[str], None], restart: DaemonRestart) -> None:
    make_state_directory(settings.state)
    tokens = Tokens(settings.tokens)
    with contextlib.ExitStack() as opened:
        listening = opened.enter_context(restart.listening or _listen(settings))
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
    app = serve_app(daemon, tokens, ending, None if live is None else lambda campaign: live.url)
    server = _Server(
        uvicorn.Config(
            app,
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
    notifying = None if notifier is None else asyncio.create_task(pass_on(daemon.feed.read(), notifier))
    daemon.words = {} if notifier is None else notifier.counts
    url = _url(settings, listening)
    settings.address.write_text(url + "\n", encoding="utf-8")
    watch = RayWatch(daemon, restart, ending.asked.is_set)
    try:
        await daemon.start()
        _log.info("serving %s", url, extra={"url": url, "state": str(settings.state)})
        ready(url)
        until = [asyncio.ensure_future(event.wait()) for event in (ending.asked, daemon.left)]
        await asyncio.wait({serving, *until}, return_when=asyncio.FIRST_COMPLETED)
        if not daemon.left.is_set():
            _log.info("ending: what has begun comes to rest at the next safe point; once more to give it up")
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


def _listen(settings: DaemonSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((settings.host, settings.port))
    except OSError as error:
        listening.close()
        raise ServeError(
            f"{settings.host}:{settings.port}: can't listen there: {error.strerror}; is another daemon running? "
            "--port names another port, 0 a free one"
        ) from None
    return listening


def _url(settings: DaemonSettings, listening: socket.socket) -> str:
    port = listening.getsockname()[1]
    host = settings.host if settings.host not in ("0.0.0.0", "::") else socket.gethostname()
    host = f"[{host}]" if ":" in host else host
    return f"{'http' if settings.certificate is None else 'https'}://{host}:{port}"


def log_lines(stream: Any = None) -> None:
    """Configure structured logs: one JSON object per line on stdout, as service managers collect them."""
    handler = logging.StreamHandler(stream or sys.stdout)
    form = JsonFormatter(
        "{asctime}{levelname}{name}{message}",
        style="{",
        rename_fields={"asctime": "time", "levelname": "level", "name": "from"},
        json_ensure_ascii=False,
    )
    handler.setFormatter(form)
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.INFO)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "httpx"):
        logging.getLogger(name).setLevel(logging.WARNING)
