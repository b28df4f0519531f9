"""Access tokens of the daemon: the token file, roles, and a limit on guessing.

`Tokens` reads a file that only its owner can read, and reads it again when it has changed. `add_token`, `revoke_token`
and `list_tokens` edit it. `local_token` is the token of the command line of the same account.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import os
import re
import secrets
import stat
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from pathlib import Path

from orchestrator.learning.run_errors import RunError
from orchestrator.records.run_registry import make_state_directory

FAILURES, WINDOW = 10, 60.0
"""Number of wrong tokens per address and time window [s]; more wrong tokens are refused for as long."""

_ADDRESSES = 1000
"""Largest number of addresses whose wrong tokens are counted at a time."""


HASHED = "sha256:"
"""Begin of a token that the file has as its digest."""

SHORTEST = 20
"""Fewest characters of a token in plain text."""

LOCAL = "local"
"""Name of the file with the token of the local command line."""

_log = logging.getLogger(__name__)


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
        local: whether it is a user of the daemon's own account, who can read the state directory; the name is ''.
    """

    name: str
    role: Role
    local: bool = False


@dataclass(frozen=True)
class TokenLine:
    """One line of the token file.

    Attributes:
        role, name: of the holder.
        token: the token itself, or `sha256:` and its digest.
        expires: seconds since 1970; None: it does not expire.
    """

    role: Role
    name: str
    token: str
    expires: float | None = None

    @property
    def digest(self) -> bytes:
        """SHA-256 of the token."""
        if self.token.startswith(HASHED):
            return bytes.fromhex(self.token.removeprefix(HASHED))
        return _digest(self.token)

    @property
    def expired(self) -> bool:
        """Whether it is no longer valid."""
        return self.expires is not None and time.time() >= self.expires

    @property
    def text(self) -> str:
        """The line."""
        until = "" if self.expires is None else f" until={utc(self.expires)}"
        return f"{self.role.name.lower()} {self.name} {self.token}{until}\n"


def utc(seconds: float) -> str:
    """A time as '2030-01-31T00:00:00+00:00'."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


class Tokens:
    """The tokens of one daemon.

    The file has lines of the form `ROLE NAME TOKEN [until=TIME]`, where TOKEN may be `sha256:DIGEST`; lines that begin
    with # are comments. If the file does not exist, it is created with one token for each role. A changed file is read
    again with the next request. The file `local` next to it has the token of the command line of the same account.

    Args:
        path: path of the file.
        clock: monotonic time [s].

    Attributes:
        problems: texts about invalid lines, which have no effect, or about a file that can't be read any more, in which
            case the tokens that were read last stay in force.

    Raises:
        TokenFileError: other users can read the file.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = path, clock
        self._failures: dict[str, deque[float]] = {}
        if not path.exists():
            _make(path)
        self._lines, self.problems = _read(path)
        self._version = _version(path)
        self._local = _digest(_local_token(path.with_name(LOCAL)))

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
        holder = self.find(token)
        if holder is None:
            self._check(address)
            self._note_failure(address)
        return holder

    def find(self, token: str) -> Person | None:
        """Return the holder of a token, or None; a wrong token is not counted."""
        self._refresh()
        shown, holder = _digest(token), None
        for line in self._lines:  # compare all of them, so that the time taken reveals nothing
            if hmac.compare_digest(line.digest, shown) and not line.expired:
                holder = Person(line.name, line.role)
        return Person("", Role.ADMIN, local=True) if hmac.compare_digest(self._local, shown) else holder

    def _refresh(self) -> None:
        if (version := _version(self._path)) == self._version:
            return
        self._version = version
        try:
            self._lines, self.problems = _read(self._path)
        except TokenFileError as error:
            self.problems = [f"{error}; the tokens that were read before stay in force"]
        for problem in self.problems:
            _log.warning("%s", problem)

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
    """Return the first token in plain text in a file with this role or a higher one, or None.

    Raises:
        TokenFileError: the file can't be read.
    """
    tokens = [(line.role, line.token) for line in _lines(path)[0] if not line.token.startswith(HASHED)]
    return next((token for holder, token in sorted(tokens) if holder >= role), None)


def local_token(state: Path) -> str | None:
    """Return the token of the command line of the daemon's own account, or None if another account has it."""
    try:
        return (state / LOCAL).read_text(encoding="utf-8").strip() or None
    except OSError:
        return None


def add_token(path: Path, role: Role, name: str, expires: float | None = None) -> str:
    """Make a token, and add its digest to the file.

    Args:
        path: the token file; created if it does not exist.
        role: permissions.
        name: of the holder, without spaces.
        expires: seconds since 1970; None: never.

    Returns:
        The token, which is stored nowhere.

    Raises:
        TokenFileError: the name is taken or invalid, or the file can't be used.
    """
    if not re.fullmatch(r"[\w.@+-]{1,60}", name):
        raise TokenFileError(f"'{name}' is no name for a token: up to 60 letters, digits, '.', '@', '+', '-' and '_'")
    if not path.exists():
        _make(path)
    if any(line.name == name for line in _lines(path)[0]):
        raise TokenFileError(f"{path}: there is a token of {name}; revoke it first, or give another name")
    token = secrets.token_urlsafe(32)
    line = TokenLine(role, name, f"{HASHED}{_digest(token).hex()}", expires)
    text = path.read_text(encoding="utf-8")
    _replace(path, text + ("" if text.endswith("\n") or not text else "\n") + line.text)
    return token


def revoke_token(path: Path, name: str) -> None:
    """Remove the tokens of a name from the file. Raises TokenFileError."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    kept = [line for line in lines if line.startswith("#") or line.split()[1:2] != [name]]
    if len(kept) == len(lines):
        raise TokenFileError(f"{path}: there is no token of {name}; 'decant server token list' shows those that are")
    _replace(path, "".join(kept))


def list_tokens(path: Path) -> tuple[list[TokenLine], list[str]]:
    """Return the lines of a token file, and the problems of invalid ones. Raises TokenFileError."""
    return _lines(path)


def _make(path: Path) -> None:
    make_state_directory(path.parent)
    lines = ["# ROLE NAME TOKEN [until=TIME], one a line; 'decant server token' adds, revokes and lists tokens.\n"]
    lines += [TokenLine(role, role.name.lower(), secrets.token_urlsafe(32)).text for role in reversed(Role)]
    _replace(path, "".join(lines))


def _local_token(path: Path) -> str:
    if not path.exists():
        _replace(path, secrets.token_urlsafe(32) + "\n")
    return path.read_text(encoding="utf-8").strip()


def _replace(path: Path, text: str) -> None:
    """Write a file that its owner alone reads; root keeps it with the owner of the state directory."""
    temporary = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
        if os.geteuid() == 0:
            owner = path.parent.stat()
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
    temporary.replace(path)


def _version(path: Path) -> tuple[int, int, int, int]:
    try:
        status = path.stat()
    except OSError:
        return 0, 0, 0, 0
    return status.st_ino, status.st_mtime_ns, status.st_size, status.st_mode


def _read(path: Path) -> tuple[list[TokenLine], list[str]]:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise TokenFileError(f"{path}: can't be read: {error.strerror}") from None
    if not stat.S_ISREG(mode) or stat.S_IMODE(mode) & 0o077:
        raise TokenFileError(f"{path}: others may read the tokens (mode {stat.S_IMODE(mode):o}); chmod 600 {path}")
    return _lines(path)


def _lines(path: Path) -> tuple[list[TokenLine], list[str]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TokenFileError(f"{path}: can't be read: {error}") from None
    lines, problems = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            lines.append(_line(words))
        except ValueError as error:
            problems.append(f"{path.name}:{number}: this line has no effect: {error}")
    return lines, problems


def _line(words: list[str]) -> TokenLine:
    """Read a line. Raises ValueError, without the token."""
    roles = ", ".join(role.name.lower() for role in Role)
    if len(words) not in (3, 4) or words[0].upper() not in Role.__members__:
        raise ValueError(f"it should be ROLE NAME TOKEN [until=TIME], with a role ({roles}) and no other spaces")
    role, name, token = Role[words[0].upper()], *words[1:3]
    if token.startswith(HASHED):
        if not re.fullmatch("[0-9a-fA-F]{64}", token.removeprefix(HASHED)):
            raise ValueError(f"after {HASHED} there should be 64 hexadecimal digits")
    elif len(token) < SHORTEST:
        raise ValueError(f"its token has fewer than {SHORTEST} characters; 'decant server token add' makes one")
    expires: float | None = None
    if len(words) == 4:
        try:
            moment = datetime.fromisoformat(words[3].removeprefix("until="))
        except ValueError:
            raise ValueError("the fourth word should be a time, such as until=2030-01-31") from None
        expires = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    return TokenLine(role, name, token, expires)


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()
