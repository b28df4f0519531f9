"""Access control of the HTTP API: roles, and limits on each request.

`RequestGuard` is ASGI middleware that checks the size and the host name of a request. `needs` makes the FastAPI
dependencies that check token and role: `Viewer`, `Operator` and `Admin`.

This module contains no routes and doesn't encrypt connections.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections import Counter
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request, Response
from fastapi.exception_handlers import http_exception_handler
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.exceptions import HTTPException as AnyHTTPException

from orchestrator.daemon.rigs.campaign_queue import CampaignQueue
from orchestrator.daemon.rigs.emergency_stop import EmergencyStops, is_stop, not_stopped, route_scope
from orchestrator.daemon.rigs.ordering import Ordering
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.state.access_tokens import Person, Role, Tokens, TooManyFailuresError
from orchestrator.daemon.state.daemon_settings import LOOPBACK

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]

BEARER = HTTPBearer(auto_error=False, description="A token of the file 'tokens' in the daemon's state directory.")


LOCAL_USER = b"decant-user"
"""Header with the name of a local user."""

MOST_WORDS = 20
"""Words of the headers `Authorization` of a stop that are compared with the tokens."""

DRAIN = 10.0
"""Longest time for which the rest of a refused body is read and dropped [s]."""


class TooLargeError(Exception):
    """The body of a request exceeds the limit."""


class RequestGuard:
    """ASGI middleware that refuses requests that are too large or use a foreign host name.

    The host name is checked because of DNS rebinding: a page of another site could reach the API through a name that
    resolves to this machine. Such a page has no token; a request that stops an arm and has a valid one may use any host
    name, or none as in HTTP/1.0. It may have any size and any form; see `route_scope`.

    Args:
        app: application to protect.
        limit: largest body [bytes].
        host: address that the API listens at; host names are checked on the loopback interface only.
        tokens: valid tokens.
        names: further host names, under which a proxy passes requests on.
        counted: takes the number of responses by status.
    """

    def __init__(
        self,
        app: Callable[[Message, Receive, Send], Awaitable[None]],
        limit: int,
        host: str,
        tokens: Tokens,
        names: Sequence[str],
        counted: Counter[tuple[str, str, str]],
    ) -> None:
        self._app, self._limit, self._tokens, self._counted = app, limit, tokens, counted
        own = (*LOOPBACK, "[::1]", host, *(name.lower() for name in names))
        self._names = frozenset(own) if host in LOOPBACK else None

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def counting(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._counted["http", str(message["status"]), ""] += 1
            await send(message)

        await self._guarded(route_scope(scope), receive, counting)

    async def _guarded(self, scope: Message, receive: Receive, send: Send) -> None:
        stop = is_stop(scope)
        headers = {name.lower(): value for name, value in scope["headers"]}
        expects = b"100-continue" in headers.get(b"expect", b"").lower()
        host = headers.get(b"host", b"").decode("latin-1").lower()
        name = host if host.startswith("[") and host.endswith("]") else host.rpartition(":")[0] or host
        foreign = self._names is not None and name not in self._names
        if foreign and not (stop and stopping_person(scope, self._tokens)):
            text = (
                "this daemon is reached as 127.0.0.1 or localhost, and not by another name. Behind a proxy, add the "
                "name to its settings: 'listen: {names: [lab.example.org]}'"
            )
            await _refuse(receive, send, 421, not_stopped(text) if stop else text, drain=not expects)
            return
        if stop:
            await self._app(scope, receive, send)
            return
        length = headers.get(b"content-length", b"0")
        if length.isdigit() and int(length) > self._limit:
            await _refuse(receive, send, 413, self._too_large, drain=not expects)
            return
        read, started = 0, False

        async def counted() -> Message:
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            if read > self._limit:
                raise TooLargeError
            return message

        async def answered(message: Message) -> None:
            nonlocal started
            if started or read <= self._limit:  # a response to a body that is too large is replaced by 413
                started = True
                await send(message)

        try:
            await self._app(scope, counted, answered)
        except TooLargeError:
            if started:
                raise
        if not started and read > self._limit:
            await _refuse(receive, send, 413, self._too_large)

    @property
    def _too_large(self) -> str:
        return f"more than {self._limit / 1e6:g} MB are not read"


async def _refuse(receive: Receive, send: Send, status: int, detail: str, *, drain: bool = True) -> None:
    """Send an error response before the request's end.

    Args:
        drain: whether the rest of the body follows; a client that expects 100-continue sends none after a refusal.
    """
    from orchestrator.daemon.state.event_feed import text

    await respond_early(receive, send, status, text({"detail": detail}).encode(), drain=drain)


async def respond_early(receive: Receive, send: Send, status: int, body: bytes, *, drain: bool = True) -> None:
    """Send a response in JSON before the request's body has ended; then read and drop the rest of the body.

    If the connection were closed with unread data, the client would get a reset and no response.
    """
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()),
               (b"connection", b"close")]  # fmt: skip
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body, "more_body": True})
    if drain:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(DRAIN):
                while (await receive()).get("more_body", False):
                    pass
    await send({"type": "http.response.body", "body": b""})


class EarlyResponse(JSONResponse):
    """A response that is sent before the request's body; a body that comes is dropped."""

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Send it, then read and drop the body, unless the client waits for 100 Continue with it."""
        expects = any(name == b"expect" for name, _ in scope["headers"])
        await respond_early(receive, send, self.status_code, bytes(self.body), drain=not expects)


async def refused(request: Request, error: Exception) -> Response:
    """Answer with a refusal; that of a stop begins with NOT STOPPED.

    Lone surrogates of the request that its text quotes are escaped, since UTF-8 has none.
    """
    assert isinstance(error, AnyHTTPException)
    text = str(error.detail).encode("utf-8", "backslashreplace").decode("utf-8")
    if isinstance(error.__cause__, UnicodeDecodeError):
        text = "the body is not text in UTF-8; send JSON in UTF-8, not compressed"
    if is_stop(request.scope):
        text = not_stopped("a stop is sent with POST" if error.status_code == 405 else text)
    return await http_exception_handler(request, HTTPException(error.status_code, text, dict(error.headers or {})))


async def invalid(request: Request, error: Exception) -> Response:
    """Answer with the problems of a request and their places, and with nothing that was sent."""
    assert isinstance(error, RequestValidationError)
    problems = [{"type": e["type"], "loc": e["loc"], "msg": _message(e)} for e in error.errors()]
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if any(e["loc"] == ("body",) for e in problems) and not re.fullmatch(r"application/(.+\+)?json", media_type):
        text = "the body is not read as JSON; send application/json: 'Content-Type: application/json'"
        return JSONResponse({"detail": text}, 422)
    body = json.dumps({"detail": problems}, ensure_ascii=True).encode()
    return Response(body, 422, media_type="application/json")


def _message(problem: dict[str, Any]) -> str:
    """The message of a problem of a request: the cause that the parser states, and the usual cause of a wrong kind."""
    if problem["type"] == "json_invalid":
        return f"{problem['msg']}: {problem['ctx']['error']}"
    if problem["type"] == "model_attributes_type" and problem["loc"] == ("body",):
        twice = "; it is a text: was it encoded twice?" if isinstance(problem["input"], str) else ""
        return f"the body should be one JSON object, {{…}}{twice}"
    return str(problem["msg"])


def stopping_person(scope: MutableMapping[str, Any], tokens: Tokens) -> Person | None:
    """Return the holder of any valid token of a stop, with the highest role.

    Proxies join two headers into one, and each of the two may be the right one.
    """
    lines = b",".join(value for name, value in scope["headers"] if name == b"authorization").decode("latin-1")
    people = [tokens.find(word) for word in re.split(r"[\s,]+", lines)[:MOST_WORDS]]
    holder = max(filter(None, people), key=lambda person: person.role, default=None)
    return None if holder is None else _named(holder, scope)


def _named(person: Person, scope: MutableMapping[str, Any]) -> Person:
    """A local user has the name that the command line sends; it is marked, since it is the account's own word."""
    if not person.local:
        return person
    sent = next((value.decode("latin-1") for name, value in scope["headers"] if name == LOCAL_USER), "")
    return replace(person, name=f"{sent if re.fullmatch('[A-Za-z0-9._-]{1,40}', sent) else 'somebody'} (local)")


def needs(role: Role) -> Callable[..., Awaitable[Person]]:
    """Make a dependency that returns the token's holder if its role is sufficient.

    Args:
        role: lowest role that is sufficient.
    """

    async def person(
        request: Request, shown: Annotated[HTTPAuthorizationCredentials | None, Depends(BEARER)]
    ) -> Person:
        tokens: Tokens = request.app.state.tokens
        address = request.client.host if request.client is not None else ""
        holder = stopping_person(request.scope, tokens) if is_stop(request.scope) else None
        if holder is None and shown is None:
            text = "a token is needed: 'Authorization: Bearer TOKEN'"
            raise HTTPException(401, text, {"WWW-Authenticate": "Bearer"})
        try:
            holder = holder or tokens.person(shown.credentials.strip() if shown else "", address)
        except TooManyFailuresError as error:
            raise HTTPException(429, str(error), {"Retry-After": str(int(error.wait) + 1)}) from None
        if holder is None:
            text = "this token is not known, or has expired"
            raise HTTPException(401, text, {"WWW-Authenticate": "Bearer"})
        holder = _named(holder, request.scope)
        if holder.role < role:
            raise HTTPException(403, f"{holder.name} is a {holder.role.name.lower()}; this takes {role.name.lower()}")
        return holder

    return person


def part(name: str) -> Callable[..., Any]:
    """Make the dependency that returns a part of the served daemon."""

    async def found(request: Request) -> Any:  # asynchronous: a stop must not wait for a free thread
        return getattr(request.app.state, name)

    return found


Daemon = Annotated[SharedServices, Depends(part("daemon"))]
Queue = Annotated[CampaignQueue, Depends(part("queue"))]
Orders = Annotated[Ordering, Depends(part("ordering"))]
Stops = Annotated[EmergencyStops, Depends(part("stops"))]
Viewer = Annotated[Person, Depends(needs(Role.VIEWER))]
Operator = Annotated[Person, Depends(needs(Role.OPERATOR))]
Admin = Annotated[Person, Depends(needs(Role.ADMIN))]
