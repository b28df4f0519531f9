"""`pour_orders`: the fault table of `POST /pours`: every stage × cut connection, SIGKILL, repeated call. No pour is
made twice.
"""

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

import httpx
import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.rigs.submissions import pack
from orchestrator.daemon.state.access_tokens import Role, token_of
from tests.support.station import order, setting_up
from tests.support.station_process import STAGES, station_process
from tests.support.toy_daemon import campaign_in
from tests.support.waiting import PATIENCE, wait_for


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


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["submitting", "submitted"])
def test_a_campaign_whose_daemon_is_killed_before_it_answers_is_queued_once(tmp_path: Path, stage: str) -> None:
    text, files = pack(load_campaign(campaign_in(tmp_path)))
    body = {"id": "study-1", "text": text, "files": files, "rig": "left"}
    with station(tmp_path) as (client, _):
        client.post("/queue/pause")
    with station(tmp_path, stage) as (client, process):
        with pytest.raises(DaemonError):
            client.post("/campaigns", body)
        assert process.wait(PATIENCE) == -9
    with station(tmp_path) as (client, _):
        assert len(client.get("/campaigns")) == (1 if stage == "submitted" else 0)
        first, second = client.post("/campaigns", body), client.post("/campaigns", body)
        assert [one["id"] for one in client.get("/campaigns")] == [first["id"]] == [second["id"]]


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["submitting", "submitted"])
def test_a_campaign_of_madsci_whose_daemon_is_killed_before_it_answers_is_queued_once(
    tmp_path: Path, stage: str
) -> None:
    path = campaign_in(tmp_path)
    action = "/action/run_campaign"
    with station_process(tmp_path, stage) as (_, node, process):
        with httpx.Client(base_url=node, timeout=PATIENCE) as http:
            key = http.post(action, json={"args": {"path": path.name, "rig": "left"}}).json()["action_id"]
            with pytest.raises(httpx.TransportError):
                http.post(f"{action}/{key}/start")
        assert process.wait(PATIENCE) == -9
    with station_process(tmp_path, "none") as (_, node, _), httpx.Client(base_url=node, timeout=PATIENCE) as http:
        found = http.get(f"/action/{key}/status").json()
        assert (found == "not_started") == (stage == "submitting")
        for _ in range(2):
            http.post(f"{action}/{key}/start")
        going = ("not_started", "running")
        wait_for(lambda: http.get(f"/action/{key}/status").json() not in going, "the end of the campaign")
        # its verdict is incomplete, since no action is recommended: that is no success
        assert http.get(f"/action/{key}/status").json() == "failed"
    assert poured(tmp_path) == 3


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
