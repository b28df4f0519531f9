"""A daemon in a thread of the test's process, behind a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from pathlib import Path
from typing import Any

import uvicorn

from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.access_tokens import Role, Tokens, token_of
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from tests.support.waiting import PATIENCE


class Real:
    """A daemon in a thread, with a socket that anybody on this machine can reach."""

    def __init__(self, state: Path, **settings: Any) -> None:
        self.settings = DaemonSettings(state, in_process=True, keep_free=0, quick_start=False, **settings)
        state.mkdir(exist_ok=True)
        self.tokens = Tokens(self.settings.tokens)
        self.socket = socket.socket()
        self.socket.bind(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.socket.getsockname()[1]}"
        self.up = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.work()))
        self.thread.start()
        assert self.up.wait(PATIENCE)

    async def work(self) -> None:
        self.daemon = Supervisor(self.settings)
        app = serve_app(self.daemon, self.tokens, lambda: None)
        self.server = uvicorn.Server(
            uvicorn.Config(app, log_config=None, lifespan="off", timeout_graceful_shutdown=1, access_log=False)
        )
        self.server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign, assignment]
        self.loop = asyncio.get_running_loop()
        await self.daemon.start()
        serving = asyncio.create_task(self.server.serve([self.socket]))
        while not self.server.started:
            await asyncio.sleep(0.01)
        self.up.set()
        await serving
        await self.daemon.close()

    def tell(self, count: int, size: int = 10) -> None:
        async def tell() -> None:
            for number in range(count):
                self.daemon.shared.feed.publish("LogLine", {"level": "info", "text": f"{number} " + "x" * size})
                if number % 100 == 0:
                    await asyncio.sleep(0)

        asyncio.run_coroutine_threadsafe(tell(), self.loop).result(PATIENCE)

    def client(self) -> Client:
        return Client(self.url, self.settings.state)

    def token(self, role: Role = Role.VIEWER) -> str:
        return token_of(self.settings.tokens, role) or ""

    def close(self) -> None:
        self.server.should_exit = True
        self.thread.join(PATIENCE)
