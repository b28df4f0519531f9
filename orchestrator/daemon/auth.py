"""Who may do what: bearer tokens from a file that only its owner reads, three roles, and an end to guessing."""

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

from orchestrator.errors import RunError
from orchestrator.state_directory import make_state_directory

FAILURES, WINDOW = 10, 60.0
"""Wrong tokens that one address may show within so many seconds; further wrong ones are refused for as long."""

_ADDRESSES = 1000
"""Addresses that are remembered at a time."""


class Role(IntEnum):
    """What a token is good for; each may do what the ones before it may."""

    VIEWER = 1
    """Looks."""
    OPERATOR = 2
    """Submits, answers, pauses, stops."""
    ADMIN = 3
    """Also clears an emergency stop and ends the daemon."""


class TokenFileError(RunError):
    """The tokens can't be used; the text says why."""

    exit_code = 2


class TooManyFailuresError(Exception):
    """An address has shown too many wrong tokens; `wait` is how long its wrong ones are refused [s]."""

    def __init__(self, wait: float) -> None:
        super().__init__(f"too many wrong tokens from this address; try again in {wait:.0f} s")
        self.wait = wait


@dataclass(frozen=True)
class Person:
    """Whoever holds a token.

    Attributes:
        name: as in the file of tokens: written beside what they did.
        role: what they may.
    """

    name: str
    role: Role


class Tokens:
    """The tokens of one daemon.

    A file of lines `ROLE NAME TOKEN`; lines that begin with # are notes. Made with one token for each role where there
    is none.

    Args:
        path: of the file.
        clock: seconds, monotonic.

    Raises:
        TokenFileError: others can read it, or a line is wrong.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: dict[str, deque[float]] = {}
        if not path.exists():
            _make(path)
        self._known = _read(path)

    def person(self, token: str, address: str) -> Person | None:
        """Who shows a token; None: nobody does.

        A token that is known is accepted whatever else its address has shown: wrong tokens of one program never bar
        another one next to it. Known tokens are long and random, so that guessing is hopeless at any rate.

        Args:
            token: as shown.
            address: from which.

        Raises:
            TooManyFailuresError: the token is wrong, and this address has shown too many wrong ones before.
        """
        shown, found = _digest(token), None
        for known, person in self._known:  # all of them, so that the time taken tells nothing
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
    """The first token of a role or a higher one in a file; None where there is none.

    Raises:
        TokenFileError: it can't be read.
    """
    found = [(Role[line[0].upper()], line[2]) for line in _lines(path)]
    return next((token for known, token in sorted(found) if known >= role), None)


def _make(path: Path) -> None:
    make_state_directory(path.parent)
    lines = ["# ROLE NAME TOKEN, one a line. Keep this file to yourself; 'decant serve' reads it when it starts.\n"]
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
