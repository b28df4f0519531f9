"""Readers of a real daemon's events: those that come back, those that are slow, and many at once."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.daemon_thread import Real
from tests.support.waiting import PATIENCE, wait_for


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
    headers = {"Authorization": f"Bearer {real.token()}", "Last-Event-ID": str(real.daemon.shared.feed.last - 3)}
    answer = httpx.get(f"{real.url}/api/v1/events", params={"until": "true"}, headers=headers, trust_env=False)
    assert [line for line in answer.text.splitlines() if line.startswith("id:")] == [
        f"id: {real.daemon.shared.feed.last - back}" for back in (2, 1, 0)
    ]


def test_a_reader_that_never_reads_costs_nothing_and_holds_nobody_up(real: Real) -> None:
    slow = socket.create_connection(("127.0.0.1", real.socket.getsockname()[1]))
    try:
        request = (
            f"GET /api/v1/events?after=0 HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {real.token()}\r\n\r\n"
        )
        slow.sendall(request.encode())
        wait_for(lambda: real.daemon.shared.feed.readers, "reader")
        real.tell(8_000, size=2_000)  # 16 MB, more than any buffer between the two
        with real.client() as client:
            begin = time.monotonic()
            assert client.get("/status")["last_event"] == real.daemon.shared.feed.last
            assert time.monotonic() - begin < PATIENCE
        assert len(real.daemon.shared.feed._ring) <= 4_000
        assert real.daemon.shared.feed.readers == 1
    finally:
        slow.close()


@pytest.mark.slow
async def test_two_hundred_read_at_once_and_a_stop_is_heard_all_the_same(real: Real) -> None:
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

    headers = {"Authorization": f"Bearer {real.token()}"}
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(headers=headers, limits=limits, timeout=PATIENCE, trust_env=False) as client:
        readers = [asyncio.create_task(read(client, number)) for number in range(count)]
        while real.daemon.shared.feed.readers < count:
            await asyncio.sleep(0.02)
        await asyncio.to_thread(real.tell, 30)
        stopped = await client.post(f"{real.url}/api/v1/emergency-stop", json={})
        assert stopped.json()["emergency"]["by"] == "viewer"
        await asyncio.to_thread(real.tell, 40)
        await asyncio.gather(*readers)
    assert got == [60] * count
