"""A real Chromium on a real port of a daemon, for tests and for pictures of the operator's page."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import threading
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest
import uvicorn

from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.rigs.emergency_stop import StopProtocol
from orchestrator.daemon.state.access_tokens import Role, Tokens
from tests.support.small_campaign import write_campaign
from tests.support.toy_daemon import CAMPAIGN, Make, Served, held, serving
from tests.support.waiting import PATIENCE

T = TypeVar("T")

PERSON = CAMPAIGN.replace(
    "  bench:", "  arm: {kind: simulated}\n  balance: {kind: simulated}\n  operator: {answers: person}\n  bench:"
).replace("time_scale: 0", "time_scale: 50")
"""A campaign with somebody at the bench."""

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def chromium() -> str:
    """Where it is; skips the test where there is none."""
    found = os.environ.get("DECANT_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("the operator's page was not tested: no Chromium (apt-get install chromium, or $DECANT_CHROMIUM)")
    return found


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            yield found
        finally:
            found.close()


@dataclass
class OnPort:
    """A daemon that is served on a port, from a thread of its own."""

    url: str
    served: Served
    loop: asyncio.AbstractEventLoop
    sockets: list[socket.socket]

    def do(self, work: Coroutine[Any, Any, T]) -> T:
        """Have the daemon's loop do something, and wait for it."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(PATIENCE)

    def address(self, role: Role = Role.ADMIN) -> str:
        """The page, with a token."""
        return f"{self.url}/#token={self.served.tokens[role]}"


@contextlib.contextmanager
def on_port(folder: Path, make: Make = held, campaign: str = PERSON, **settings: Any) -> Iterator[OnPort]:
    """Serve a daemon with a toy laboratory."""
    folder.mkdir(exist_ok=True)
    write_campaign(folder, campaign)
    ready: list[OnPort] = []
    up, problems = threading.Event(), []
    leave: list[Callable[[], None]] = []

    async def work() -> None:
        async with serving(folder, make, **settings) as served:
            tokens = Tokens(served.daemon.settings.tokens)
            listening = socket.create_server(("127.0.0.1", 0))
            app = serve_app(served.supervisor, tokens, lambda: None)
            config = uvicorn.Config(
                app, http=StopProtocol, ws="none", log_config=None, lifespan="off", timeout_graceful_shutdown=1
            )
            server = uvicorn.Server(config)
            server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]
            task = asyncio.create_task(server.serve([listening]))
            done, loop = asyncio.Event(), asyncio.get_running_loop()
            leave.append(lambda: loop.call_soon_threadsafe(done.set))
            ready.append(OnPort(f"http://127.0.0.1:{listening.getsockname()[1]}", served, loop, [listening]))
            up.set()
            await done.wait()
            server.should_exit = True
            await task

    def run() -> None:
        try:
            asyncio.run(work())
        except BaseException as error:
            problems.append(error)
            raise
        finally:
            up.set()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert up.wait(PATIENCE)
    assert ready, problems
    try:
        yield ready[0]
    finally:
        for go in leave:
            go()
        thread.join(PATIENCE)
