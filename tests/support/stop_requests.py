"""Requests for an emergency stop as programs send them, sound or not, over a socket of their own."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from tests.support.waiting import PATIENCE

PATH = "/api/v1/emergency-stop"


@dataclass(frozen=True)
class StopCase:
    """A request for an emergency stop.

    Attributes:
        name: for people.
        body: sent with the head.
        headers: of the request, besides host and token.
        rest: sent after the arm was stopped.
        path: of the request.
        note: part of a note of the response; '' if none is expected.
        reason: that is recorded; None: any.
    """

    name: str
    body: bytes = b""
    headers: tuple[str, ...] = ()
    rest: bytes = b""
    path: str = PATH
    note: str = ""
    reason: str | None = None


def sized(
    name: str, body: bytes, *headers: str, note: str = "", reason: str | None = None, path: str = PATH
) -> StopCase:
    return StopCase(name, body, (f"Content-Length: {len(body)}", *headers), note=note, reason=reason, path=path)


JSON = "Content-Type: application/json"
FORM = "Content-Type: application/x-www-form-urlencoded"
CHUNKED = "Transfer-Encoding: chunked"

CASES = [
    sized("sound", b'{"reason": "glass"}', JSON, reason="glass"),
    sized("no body", b"", reason=""),
    sized("malformed", b'{"reason": "glass', JSON, note="neither JSON nor a form"),
    sized("line end", b"\n", JSON, reason=""),
    sized("extra key", b'{"reason": "glass", "by": "ann"}', JSON, note="ignored in the body: by", reason="glass"),
    sized("null", b'{"reason": null, "rig": null}', JSON, reason=""),
    sized("number", b'{"reason": 5}', JSON, note="not a text", reason="5"),
    sized("long", json.dumps({"reason": "x" * 501}).encode(), JSON, note="501 characters", reason="x" * 500),
    sized("text", b'"stop"', JSON, note="taken as the reason", reason="stop"),
    sized("list", b"[]", JSON, note="no JSON object", reason=""),
    # `curl -d` declares a form, also for JSON: github.com/dmuth/fastapi-httpbin/issues/10
    sized("form", b"reason=broken+glass", FORM, reason="broken glass"),
    sized("JSON as a form", b'{"reason": "glass"}', FORM, reason="glass"),
    # fetch() with JSON.stringify() declares text/plain: github.com/fastapi/fastapi/issues/3373
    sized("JSON as text", b'{"reason": "glass"}', "Content-Type: text/plain;charset=UTF-8", reason="glass"),
    sized("without a type", b'{"reason": "glass"}', reason="glass"),
    sized("invalid type", b'{"reason": "glass"}', "Content-Type: ;;/=\xff", reason="glass"),
    # PowerShell's Invoke-RestMethod sends Latin-1: github.com/yzwijsen/chatgpt-powershell/issues/4
    sized("Latin-1", '{"reason": "Perché?"}'.encode("latin-1"), JSON, note="Latin-1", reason="Perché?"),
    sized("UTF-16", '{"reason": "Gläser"}'.encode("utf-16"), JSON, reason="Gläser"),
    sized("lone surrogate", b'{"reason": "a\\ud800"}', JSON, note="replaced", reason="a\N{REPLACEMENT CHARACTER}"),
    sized("control characters", b'{"reason": "a\\u001b[2Jb\\nc"}', JSON, note="replaced"),
    sized("unknown rig", b'{"rig": "Nothing"}', JSON, note="there is no rig 'Nothing': every arm was stopped"),
    sized("rig that is a number", b'{"rig": 7}', JSON, note="there is no rig '7': every arm was stopped"),
    sized("two rigs", b'{"rig": "a", "rig": "b"}', JSON, note="every arm was stopped"),
    sized("deep", b"[" * 100_000, JSON, note="neither JSON"),
    sized("5 MB", b'{"reason": "' + b"x" * 5_000_000 + b'"}', JSON, note="longer than 1 MB"),
    sized("trailing slash", b"{}", JSON, path=f"{PATH}/"),
    sized("address that ended in a slash", b"{}", JSON, path=f"/{PATH}"),
    sized("capitals", b"{}", JSON, path="/api/v1/Emergency-Stop"),
    sized("unknown rig in the query", b"", path=f"{PATH}?rig=%ff", note="there is no rig"),
    sized("another protocol", b"{}", "Upgrade: websocket", "Connection: Upgrade", JSON),
    StopCase("bad chunks", b"zz\r\n{}\r\n", (CHUNKED, JSON), note="malformed HTTP"),
    StopCase("bad second chunk", b'2\r\n{}\r\n-1\r\n', (CHUNKED, JSON), note="malformed HTTP"),
    StopCase("chunks that go bad", b"", (CHUNKED, JSON), b"zz\r\n{}\r\n"),
    StopCase("late", b"", ("Content-Length: 19", JSON), b'{"reason": "glass"}'),
    StopCase("never ending", b'{"reason": "gl', ("Content-Length: 19", JSON), note="did not end within 0.5 s"),
    # curl waits for 100 Continue: github.com/Kludex/uvicorn/issues/88
    StopCase("100-continue", b"", ("Content-Length: 19", "Expect: 100-continue", JSON), note="did not end within 0.5"),
]  # fmt: skip


@contextlib.contextmanager
def sent(
    url: str, token: str, case: StopCase, host: str | None = None, method: str = "POST"
) -> Iterator[socket.socket]:
    """Send a request up to its body; yields the connection."""
    where = urlsplit(url)
    assert where.hostname
    assert where.port
    head = (f"{method} {case.path} HTTP/1.1", f"Host: {where.netloc if host is None else host}", *case.headers)
    token_line = (f"Authorization: Bearer {token}",) if token else ()
    with socket.create_connection((where.hostname, where.port), timeout=PATIENCE) as connection:
        connection.sendall("\r\n".join((*head, *token_line, "", "")).encode("latin-1") + case.body)
        yield connection


def response(connection: socket.socket, method: str = "POST") -> tuple[int, dict[str, Any]]:
    """Return status and content; 100 Continue is passed over."""
    with http.client.HTTPResponse(connection, method=method) as answer:
        answer.begin()
        content = answer.read()
        return answer.status, json.loads(content) if content.startswith(b"{") else {"detail": content.decode("latin-1")}


def stopped_by(url: str, token: str, case: StopCase, stopped: Callable[[], None]) -> dict[str, Any]:
    """Send a request, wait until it has stopped the arm, send the rest; return what the response says.

    Args:
        url: of the daemon.
        token: of any role.
        case: the request.
        stopped: returns as soon as the arm was stopped, and fails if that does not happen.
    """
    with sent(url, token, case) as connection:
        stopped()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(case.rest)
        status, found = response(connection)
    assert status == 200, (case.name, found)
    assert case.note in " / ".join(found["notes"]), (case.name, found["notes"])
    if not case.note and not case.rest:
        assert found["notes"] == [], case.name
    assert case.reason in (None, found["emergency"]["reason"]), case.name
    return found
