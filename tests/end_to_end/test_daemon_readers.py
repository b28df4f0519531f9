"""Readers of a real daemon's events: those that come back, those that are slow, and many at once."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from orchestrator.daemon.api import serve_app
from orchestrator.daemon.auth import Role, Tokens, token_of
from orchestrator.daemon.client import Client
from orchestrator.daemon.settings import Settings
from orchestrator.daemon.supervisor import Supervisor
from tests.patience import PATIENCE


class Real:
    """A daemon in a thread, with a socket that anybody on this machine can reach."""

    def __init__(self, state: Path) -> None:
        self.settings = Settings(state, in_process=True, keep_free=0, quick_start=False)
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
                self.daemon.feed.tell("LogLine", {"level": "info", "text": f"{number} " + "x" * size})
                if number % 100 == 0:
                    await asyncio.sleep(0)

        asyncio.run_coroutine_threadsafe(tell(), self.loop).result(PATIENCE)

    def client(self) -> Client:
        return Client(self.url, self.settings.state)

    def token(self) -> str:
        return token_of(self.settings.tokens, Role.VIEWER) or ""

    def close(self) -> None:
        self.server.should_exit = True
        self.thread.join(PATIENCE)


@pytest.fixture
def real(tmp_path: Path) -> Iterator[Real]:
    found = Real(tmp_path / "state")
    try:
        yield found
    finally:
        found.close()


def texts(told: list[Any]) -> list[int]:
    return [int(one.data["text"].split()[0]) for one in told if one.type == "LogLine"]


def test_whoever_comes_back_has_missed_nothing_also_from_another_daemon(tmp_path: Path) -> None:
    first = Real(tmp_path / "state")
    try:
        first.tell(30)
        with first.client() as client:
            stream = client.events(0)
            seen = [next(stream) for _ in range(12)]
            stream.close()
    finally:
        first.close()
    second = Real(tmp_path / "state")
    try:
        second.tell(5)
        with second.client() as client:
            rest = list(client.events(seen[-1].id, follow=False))
        assert texts([*seen, *rest]) == [*range(30), *range(5)]
        numbers = [one.id for one in (*seen, *rest)]
        assert numbers == sorted(set(numbers))
    finally:
        second.close()


def test_last_event_id_is_understood_as_browsers_send_it(real: Real) -> None:
    import httpx

    real.tell(10)
    headers = {"Authorization": f"Bearer {real.token()}", "Last-Event-ID": str(real.daemon.feed.last - 3)}
    answer = httpx.get(f"{real.url}/api/v1/events", params={"until": "true"}, headers=headers, trust_env=False)
    assert [line for line in answer.text.splitlines() if line.startswith("id:")] == [
        f"id: {real.daemon.feed.last - back}" for back in (2, 1, 0)
    ]


def test_a_reader_that_never_reads_costs_nothing_and_holds_nobody_up(real: Real) -> None:
    slow = socket.create_connection(("127.0.0.1", real.socket.getsockname()[1]))
    try:
        request = (
            f"GET /api/v1/events?after=0 HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {real.token()}\r\n\r\n"
        )
        slow.sendall(request.encode())
        while not real.daemon.feed.readers:
            time.sleep(0.01)
        real.tell(8_000, size=2_000)  # 16 MB, more than any buffer between the two
        with real.client() as client:
            begin = time.monotonic()
            assert client.get("/status")["last_event"] == real.daemon.feed.last
            assert time.monotonic() - begin < PATIENCE
        assert len(real.daemon.feed._ring) <= 4_000
        assert real.daemon.feed.readers == 1
    finally:
        slow.close()


def test_two_hundred_read_at_once_and_a_stop_is_heard_all_the_same(real: Real) -> None:
    import httpx

    count = 200
    got = [0] * count

    async def read(client: httpx.AsyncClient, number: int) -> None:
        async with client.stream("GET", f"{real.url}/api/v1/events") as answer:
            async for line in answer.aiter_lines():
                if line.startswith("id:"):
                    got[number] += 1
                    if got[number] == 60:
                        return

    async def work() -> None:
        headers = {"Authorization": f"Bearer {real.token()}"}
        limits = httpx.Limits(max_connections=None)
        async with httpx.AsyncClient(headers=headers, limits=limits, timeout=PATIENCE, trust_env=False) as client:
            readers = [asyncio.create_task(read(client, number)) for number in range(count)]
            while real.daemon.feed.readers < count:
                await asyncio.sleep(0.02)
            await asyncio.to_thread(real.tell, 30)
            stopped = await client.post(f"{real.url}/api/v1/emergency-stop", json={})
            assert stopped.json()["emergency"]["by"] == "viewer"
            await asyncio.to_thread(real.tell, 40)
            await asyncio.gather(*readers)

    asyncio.run(work())
    assert got == [60] * count
