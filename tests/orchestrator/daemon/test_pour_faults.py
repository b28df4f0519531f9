"""The fault table of `POST /pours`: every stage × cut connection, SIGKILL, repeated call. No pour is made twice."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import pytest

from orchestrator.daemon.access_tokens import Role, token_of
from orchestrator.daemon.daemon_client import Client, DaemonError
from tests.support.station import order, setting_up
from tests.support.station_process import STAGES, station_process
from tests.support.waiting import PATIENCE


@contextlib.contextmanager
def station(folder: Path, stage: str = "none") -> Iterator[tuple[Client, subprocess.Popen[str]]]:
    with station_process(folder, stage) as (url, _, process):
        token = token_of(folder / "state/tokens", Role.ADMIN)
        with Client(url, folder / "state", token) as client:
            yield client, process


def register(client: Client) -> None:
    for path, body in setting_up():
        client.post(path, body)


def poured(folder: Path) -> int:
    path = folder / "poured"
    return len(path.read_text().splitlines()) if path.exists() else 0


def settled(client: Client, folder: Path) -> dict[str, Any]:
    """The same order until it has an outcome; a question about it is answered as an operator would."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found: dict[str, Any] = client.post("/pours?wait=1", order())
        for question in client.get("/questions"):
            client.post(f"/questions/{question['id']}/answer", {"answer": "weighed 2 60"})
        if found["state"] in ("weighed", "failed"):
            return found
    raise AssertionError(found)


def check(client: Client, folder: Path) -> dict[str, Any]:
    found = settled(client, folder)
    assert found["state"] == "weighed"
    assert poured(folder) == 1
    entries = [one for one in client.get("/materials/account") if one["pour"] == "order-1"]
    assert sorted(one["vessel"] for one in entries) == ["beaker", "vial-1"]
    assert client.post("/pours", order())["result"] == found["result"]
    assert len(client.get("/pours")) == 1
    return found


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_daemon_killed_at_any_stage_makes_the_pour_once_when_the_order_is_repeated(
    tmp_path: Path, stage: str
) -> None:
    with station(tmp_path) as (client, _):
        register(client)
    with station(tmp_path, stage) as (client, process):
        with contextlib.suppress(DaemonError):
            for _ in range(100):  # MADSci's client repeats a POST, too
                client.post("/pours?wait=600", order())
        assert process.wait(PATIENCE) == -9
    with station(tmp_path) as (client, _):
        found = check(client, tmp_path)
    if stage == "pouring":  # nobody but an operator can state its outcome
        assert found["result"]["received_g"] == pytest.approx(38.0)


def request_bytes(client: Client, body: bytes) -> bytes:
    token = client._http.headers["Authorization"]
    head = (
        f"POST /api/v1/pours HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: {token}\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body


@pytest.mark.slow
@pytest.mark.parametrize("cut", ["in the head", "in the body", "before the answer", "in the answer"])
def test_an_order_whose_connection_is_cut_is_poured_once(tmp_path: Path, cut: str) -> None:
    with station(tmp_path) as (client, _):
        register(client)
        body = json.dumps(order()).encode()
        sent = request_bytes(client, body)
        part = {"in the head": sent[:60], "in the body": sent[:-20]}.get(cut, sent)
        for _ in range(3):
            place = urlparse(client.url)
            with socket.create_connection((place.hostname, place.port), PATIENCE) as connection:
                connection.sendall(part)
                if cut == "in the answer":
                    connection.recv(5)
        check(client, tmp_path)
