"""Access control of the HTTP API: bearer tokens, roles, and limits on each request.

`Tokens` reads a token file that only its owner can read, and limits guessing. `RequestGuard` is ASGI middleware that
checks the size and the host name of a request. `needs` makes the FastAPI dependencies that check token and role:
`Viewer`, `Operator` and `Admin`.

This module contains no routes and doesn't encrypt connections.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import os
import secrets
import stat
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from orchestrator.catalogue.run_registry import make_state_directory
from orchestrator.daemon.daemon_settings import LOOPBACK
from orchestrator.daemon.supervisor import Supervisor
from orchestrator.run_errors import RunError

FAILURES, WINDOW = 10, 60.0
"""Number of wrong tokens per address and time window [s]; more wrong tokens are refused for as long."""

_ADDRESSES = 1000
"""Largest number of addresses whose wrong tokens are counted at a time."""


class Role(IntEnum):
    """Permissions of a token; each role includes those of the lower ones."""

    VIEWER = 1
    """Reads."""
    OPERATOR = 2
    """Submits campaigns, answers questions, pauses and stops."""
    ADMIN = 3
    """Also clears an emergency stop and shuts the daemon down."""


class TokenFileError(RunError):
    """The tokens can't be used; the message gives the reason."""

    exit_code = 2


class TooManyFailuresError(Exception):
    """Too many wrong tokens from one address; `wait` is how long further wrong ones are refused [s]."""

    def __init__(self, wait: float) -> None:
        super().__init__(f"too many wrong tokens from this address; try again in {wait:.0f} s")
        self.wait = wait


@dataclass(frozen=True)
class Person:
    """The holder of a token.

    Attributes:
        name: from the token file; recorded with every action.
        role: permissions.
    """

    name: str
    role: Role


class Tokens:
    """The tokens of one daemon.

    The file has lines of the form `ROLE NAME TOKEN`; lines that begin with # are comments. If the file does not exist,
    it is created with one token for each role.

    Args:
        path: path of the file.
        clock: monotonic time [s].

    Raises:
        TokenFileError: other users can read the file, or a line is invalid.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: dict[str, deque[float]] = {}
        if not path.exists():
            _make(path)
        self._known = _read(path)

    def person(self, token: str, address: str) -> Person | None:
        """Return the holder of a token, or None if the token is unknown.

        A known token is always accepted, even if its address has sent wrong tokens: one program can't lock out another
        on the same machine. Known tokens are long and random, so guessing fails at any rate.

        Args:
            token: token of the request.
            address: address that the request came from.

        Raises:
            TooManyFailuresError: the token is wrong, and this address has sent too many wrong tokens before.
        """
        shown, found = _digest(token), None
        for known, person in self._known:  # compare all of them, so that the time taken reveals nothing
            if hmac.compare_digest(known, shown):
                found = person
        if found is None:
            self._check(address)
            self._note_failure(address)
        return found

    def _check(self, address: str) -> None:
        failures = self._failures.get(address)
        if failures is None:
            return
        now = self._clock()
        while failures and now - failures[0] > WINDOW:
            failures.popleft()
        if not failures:
            del self._failures[address]
        elif len(failures) >= FAILURES:
            raise TooManyFailuresError(failures[0] + WINDOW - now)

    def _note_failure(self, address: str) -> None:
        if address not in self._failures and len(self._failures) >= _ADDRESSES:
            del self._failures[next(iter(self._failures))]
        self._failures.setdefault(address, deque(maxlen=FAILURES)).append(self._clock())


def token_of(path: Path, role: Role) -> str | None:
    """Return the first token in a file with this role or a higher one, or None.

    Raises:
        TokenFileError: the file can't be read.
    """
    found = [(Role[line[0].upper()], line[2]) for line in _lines(path)]
    return next((token for known, token in sorted(found) if known >= role), None)


def _make(path: Path) -> None:
    make_state_directory(path.parent)
    lines = [
        "# ROLE NAME TOKEN, one a line. Keep this file to yourself; 'decant server start' reads it when it starts.\n"
    ]
    lines += [f"{role.name.lower()} {role.name.lower()} {secrets.token_urlsafe(32)}\n" for role in reversed(Role)]
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.writelines(lines)


def _read(path: Path) -> list[tuple[bytes, Person]]:
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) or stat.S_IMODE(mode) & 0o077:
        raise TokenFileError(f"{path}: others may read the tokens (mode {stat.S_IMODE(mode):o}); chmod 600 {path}")
    return [(_digest(token), Person(name, Role[role.upper()])) for role, name, token in _lines(path)]


def _lines(path: Path) -> list[tuple[str, str, str]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TokenFileError(f"{path}: can't be read: {error}") from None
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 3 or words[0].upper() not in Role.__members__ or len(words[2]) < 20:
            roles = ", ".join(role.name.lower() for role in Role)
            raise TokenFileError(
                f"{path}:{number}: should be ROLE NAME TOKEN: a role ({roles}), a name, 20 characters or more"
            )
        found.append((words[0], words[1], words[2]))
    return found


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()


Message = dict[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]

BEARER = HTTPBearer(auto_error=False, description="A token of the file 'tokens' in the daemon's state directory.")


DRAIN = 10.0
"""Longest time for which the rest of a refused body is read and dropped [s]."""


class TooLargeError(Exception):
    """The body of a request exceeds the limit."""


class RequestGuard:
    """ASGI middleware that refuses requests that are too large or use a foreign host name.

    The host name is checked because of DNS rebinding: a page of another site could reach the API through a name that
    resolves to this machine.

    Args:
        app: application to protect.
        limit: largest body [bytes].
        host: address that the API listens at; host names are checked on the loopback interface only.
    """

    def __init__(self, app: Callable[[Message, Receive, Send], Awaitable[None]], limit: int, host: str) -> None:
        self._app, self._limit = app, limit
        self._names = frozenset((*LOOPBACK, "[::1]", host)) if host in LOOPBACK else None

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {name.lower(): value for name, value in scope["headers"]}
        expects = b"100-continue" in headers.get(b"expect", b"").lower()
        host = headers.get(b"host", b"").decode("latin-1")
        name = host if host.startswith("[") and host.endswith("]") else host.rpartition(":")[0] or host
        if self._names is not None and name not in self._names:
            text = "this daemon is reached as 127.0.0.1 or localhost, and not by another name"
            await _refuse(receive, send, 421, text, drain=not expects)
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
        return f"more than {self._limit / 1e6:g} MB are not read (listen: body in the daemon's settings)"


async def _refuse(receive: Receive, send: Send, status: int, detail: str, *, drain: bool = True) -> None:
    """Send an error response, then read and drop the rest of the body.

    If the connection were closed with unread data, the client would get a reset and no response.

    Args:
        drain: whether a rest follows; a client that expects 100-continue sends none after a refusal.
    """
    from orchestrator.daemon.event_feed import text

    body = text({"detail": detail}).encode()
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


def needs(role: Role) -> Callable[..., Awaitable[Person]]:
    """Make a dependency that returns the token's holder if its role is sufficient."""

    async def person(
        request: Request, shown: Annotated[HTTPAuthorizationCredentials | None, Depends(BEARER)]
    ) -> Person:
        tokens: Tokens = request.app.state.tokens
        address = request.client.host if request.client is not None else ""
        if shown is None:
            raise HTTPException(401, "a token is needed: 'Authorization: Bearer TOKEN'", {"WWW-Authenticate": "Bearer"})
        try:
            found = tokens.person(shown.credentials, address)
        except TooManyFailuresError as error:
            raise HTTPException(429, str(error), {"Retry-After": str(int(error.wait) + 1)}) from None
        if found is None:
            raise HTTPException(401, "this token is not known", {"WWW-Authenticate": "Bearer"})
        if found.role < role:
            raise HTTPException(403, f"{found.name} is a {found.role.name.lower()}; this takes {role.name.lower()}")
        return found

    return person


def the_daemon(request: Request) -> Supervisor:
    """Return the daemon that the application serves."""
    found: Supervisor = request.app.state.daemon
    return found


Daemon = Annotated[Supervisor, Depends(the_daemon)]
Viewer = Annotated[Person, Depends(needs(Role.VIEWER))]
Operator = Annotated[Person, Depends(needs(Role.OPERATOR))]
Admin = Annotated[Person, Depends(needs(Role.ADMIN))]
