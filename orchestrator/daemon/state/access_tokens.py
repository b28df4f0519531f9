"""Access tokens of the daemon: the token file, roles, and a limit on guessing.

`Tokens` reads a file that only its owner can read. `token_of` finds a token for a client on the same machine.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

from orchestrator.learning.run_errors import RunError
from orchestrator.records.run_registry import make_state_directory

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
        holder = self.find(token)
        if holder is None:
            self._check(address)
            self._note_failure(address)
        return holder

    def find(self, token: str) -> Person | None:
        """Return the holder of a token, or None; a wrong token is not counted."""
        shown, holder = _digest(token), None
        for known, person in self._known:  # compare all of them, so that the time taken reveals nothing
            if hmac.compare_digest(known, shown):
                holder = person
        return holder

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
    tokens = [(Role[line[0].upper()], line[2]) for line in _lines(path)]
    return next((token for known, token in sorted(tokens) if known >= role), None)


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
    entries = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 3 or words[0].upper() not in Role.__members__ or len(words[2]) < 20:
            roles = ", ".join(role.name.lower() for role in Role)
            raise TokenFileError(
                f"{path}:{number}: should be ROLE NAME TOKEN: a role ({roles}), a name, 20 characters or more"
            )
        entries.append((words[0], words[1], words[2]))
    return entries


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()
