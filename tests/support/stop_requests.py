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

UNREAD = "a body is not read: rig and reason belong into the query"


def query(name: str, text: str, *, note: str = "", reason: str | None = None) -> StopCase:
    return StopCase(name, path=f"{PATH}?{text}", note=note, reason=reason)


CASES = [
    StopCase("no body", reason=""),
    sized("empty body", b"", reason=""),
    query("reason", "reason=broken+glass", reason="broken glass"),
    query("long", f"reason={'x' * 501}", note="501 characters", reason="x" * 500),
    query("two reasons", "reason=glass&reason=smoke&reason=glass", reason="glass; smoke"),
    # clients send what was typed, also where it should be encoded
    query("as typed", "reason=glass on the table", reason="glass on the table"),
    query("UTF-8 as typed", "reason=Gl\xc3\xa4ser", reason="Gläser"),
    query("UTF-8", "reason=Gl%C3%A4ser", reason="Gläser"),
    query("Latin-1", "reason=Perch%E9", reason="Perch\N{REPLACEMENT CHARACTER}"),
    query("control characters", "reason=a%1b%5B2J", note="replaced", reason="a\N{REPLACEMENT CHARACTER}[2J"),
    query("malformed", "&&=%&reason=%zz", note="ignored in the query: ", reason="%zz"),
    query("another key", "reason=glass&by=ann", note="ignored in the query: by", reason="glass"),
    query("unknown rig", "rig=Nothing", note="there is no rig 'Nothing': every arm was stopped"),
    query("unknown bytes", "rig=%ff", note="there is no rig"),
    query("two rigs", "rig=a&rig=b", note="every arm was stopped"),
    sized("sound", b'{"reason": "glass"}', JSON, note=UNREAD, reason=""),
    sized("malformed body", b'{"reason": "glass', JSON, note=UNREAD, reason=""),
    sized("line end", b"\n", JSON, note=UNREAD),
    sized("null", b'{"reason": null, "rig": null}', JSON, note=UNREAD),
    sized("text", b'"stop"', JSON, note=UNREAD),
    # `curl -d` declares a form, also for JSON: github.com/dmuth/fastapi-httpbin/issues/10
    sized("form", b"reason=broken+glass", FORM, note=UNREAD, reason=""),
    sized("JSON as a form", b'{"reason": "glass"}', FORM, note=UNREAD),
    # fetch() with JSON.stringify() declares text/plain: github.com/fastapi/fastapi/issues/3373
    sized("JSON as text", b'{"reason": "glass"}', "Content-Type: text/plain;charset=UTF-8", note=UNREAD),
    sized("without a type", b'{"reason": "glass"}', note=UNREAD),
    sized("invalid type", b'{"reason": "glass"}', "Content-Type: ;;/=\xff", note=UNREAD),
    # PowerShell's Invoke-RestMethod sends Latin-1: github.com/yzwijsen/chatgpt-powershell/issues/4
    sized("Latin-1 body", '{"reason": "Perché?"}'.encode("latin-1"), JSON, note=UNREAD),
    sized("UTF-16", '{"reason": "Gläser"}'.encode("utf-16"), JSON, note=UNREAD),
    sized("lone surrogate", b'{"reason": "a\\ud800"}', JSON, note=UNREAD),
    sized("unknown rig in the body", b'{"rig": "Nothing"}', JSON, note=UNREAD),
    sized("deep", b"[" * 100_000, JSON, note=UNREAD),
    sized("5 MB", b'{"reason": "' + b"x" * 5_000_000 + b'"}', JSON, note=UNREAD),
    sized("trailing slash", b"{}", JSON, path=f"{PATH}/", note=UNREAD),
    sized("another protocol", b"{}", "Upgrade: websocket", "Connection: Upgrade", JSON, note=UNREAD),
    StopCase("bad chunks", b"zz\r\n{}\r\n", (CHUNKED, JSON), note=UNREAD),
    StopCase("bad second chunk", b'2\r\n{}\r\n-1\r\n', (CHUNKED, JSON), note=UNREAD),
    StopCase("chunks that go bad", b"", (CHUNKED, JSON), b"zz\r\n{}\r\n", note=UNREAD),
    StopCase("late", b"", ("Content-Length: 19", JSON), b'{"reason": "glass"}', note=UNREAD),
    StopCase("never ending", b'{"reason": "gl', ("Content-Length: 19", JSON), note=UNREAD),
    # curl waits for 100 Continue: github.com/Kludex/uvicorn/issues/88
    StopCase("100-continue", b"", ("Content-Length: 19", "Expect: 100-continue", JSON), note=UNREAD),
]  # fmt: skip

FORMS = {
    # what clients send that have a proxy setting: RFC 9112, section 3.2.2
    "absolute form": "POST http://{host}{path} HTTP/1.1|Host: {host}|{token}",
    "absolute form of another name": "POST HTTPS://ann@lab.example:1{path}?rig= HTTP/1.1|Host: {host}|{token}",
    # github.com/curl/curl/issues/6769: the host of the target has its port, that of the header has none
    "absolute form, Host without port": "POST http://{host}{path} HTTP/1.1|Host: 127.0.0.1|{token}",
    "HTTP/1.0": "POST {path} HTTP/1.0|{token}",
    "HTTP/1.0 that stays open": "POST {path} HTTP/1.0|Connection: keep-alive|{token}",
    "another name": "POST {path} HTTP/1.1|Host: lab.example|{token}",
    "empty name": "POST {path} HTTP/1.1|Host:|{token}",
    "slashes": "POST //api//v1/emergency-stop/// HTTP/1.1|Host: {host}|{token}",
    "dots": "POST /api/v1/./x/../emergency-stop HTTP/1.1|Host: {host}|{token}",
    "capitals": "POST /API/v1/Emergency-Stop HTTP/1.1|Host: {host}|{token}",
    "encoded": "POST /api/v1/%65mergency%2Dstop HTTP/1.1|Host: {host}|{token}",
    "encoded question mark": "POST {path}%3Frig= HTTP/1.1|Host: {host}|{token}",
    "behind a prefix": "POST /decant{path} HTTP/1.1|Host: {host}|{token}",
    # what proxies make of two headers
    "joined tokens": "POST {path} HTTP/1.1|Host: {host}|Authorization: Bearer a, {bearer}",
    "joined tokens, the first is right": "POST {path} HTTP/1.1|Host: {host}|{token}, Bearer a",
    "two headers": "POST {path} HTTP/1.1|Host: {host}|Authorization: Basic YTpi|{token}",
    "two headers, the first is right": "POST {path} HTTP/1.1|Host: {host}|{token}|Authorization: Basic YTpi",
    "one scheme": "POST {path} HTTP/1.1|Host: {host}|authorization:\tbEARER \t a,{bare}",
    "folded": "POST {path} HTTP/1.1|Host: {host}|Authorization: Bearer| {bare}",
    "put": "PUT {path} HTTP/1.1|Host: {host}|{token}",
    "patch": "PATCH {path}/ HTTP/1.1|Host: {host}|{token}",
    "lower case": "post {path} HTTP/1.1|Host: {host}|{token}",
    "empty lines before it": "||POST {path} HTTP/1.1|Host: {host}|{token}",
    "HTTP/2 offered": "POST {path} HTTP/1.1|Host: {host}|Connection: Upgrade, HTTP2-Settings|Upgrade: h2c|"
    "HTTP2-Settings: AAMAAABkAAQAAP__|{token}",
}  # fmt: skip
"""Heads of requests that are legal, or that clients and proxies send; '|' ends a line."""


def head_of(form: str, url: str, token: str) -> bytes:
    """Return the head of a request."""
    fields = {"host": urlsplit(url).netloc, "path": PATH, "bare": token, "bearer": f"Bearer {token}"}
    text = form.format(**fields, token=f"Authorization: Bearer {token}")
    return f"{text}||".replace("|", "\r\n").encode("latin-1")


@contextlib.contextmanager
def connected(url: str) -> Iterator[socket.socket]:
    """A connection to the daemon."""
    where = urlsplit(url)
    assert where.hostname
    assert where.port
    with socket.create_connection((where.hostname, where.port), timeout=PATIENCE) as connection:
        yield connection


@contextlib.contextmanager
def sent(
    url: str, token: str, case: StopCase, host: str | None = None, method: str = "POST"
) -> Iterator[socket.socket]:
    """Send a request up to its body; yields the connection."""
    head = (f"{method} {case.path} HTTP/1.1", f"Host: {urlsplit(url).netloc if host is None else host}", *case.headers)
    token_line = (f"Authorization: Bearer {token}",) if token else ()
    with connected(url) as connection:
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
