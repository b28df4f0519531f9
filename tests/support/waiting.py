"""How tests wait: for a condition, with a limit that only a defect reaches."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any, TypeVar

import psutil

T = TypeVar("T")

PATIENCE = 240.0
"""Seconds until a test that waits for an event gives up: waiting is free. `make test` ends a test after 300 s, which
would hide the reason."""

POLL = 0.01
"""Interval at which a condition is tested [s]."""


def alive(pid: int) -> bool:
    """Whether a process runs. One that has ended and that nobody has waited for does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_for(found: Callable[[], T], what: str = "", patience: float = PATIENCE, poll: float = POLL) -> T:
    """Wait until a function returns something true, and return that.

    Args:
        found: polled; fails the test where it raises.
        what: names what is waited for in the error.
        patience: longest wait [s].
        poll: interval [s]; longer where a look is expensive.

    Raises:
        AssertionError: the time is over.
    """
    end = time.monotonic() + patience
    while not (value := found()):
        assert time.monotonic() < end, f"after {patience:g} s there was no {what or 'change'}"
        time.sleep(poll)
    return value


async def wait_async(found: Callable[[], T], what: str = "", patience: float = PATIENCE, poll: float = POLL) -> T:
    """As `wait_for`, within an event loop, which goes on meanwhile."""
    end = time.monotonic() + patience
    while not (value := found()):
        assert time.monotonic() < end, f"after {patience:g} s there was no {what or 'change'}"
        await asyncio.sleep(poll)
    return value


async def reach(seen: list[Any], checkpoint: str, pour: asyncio.Task[Any], tilt: float = 0.0) -> None:
    """Wait until a pour's progress has come to a checkpoint, and there to a tilt [rad].

    Raises:
        Exception: the pour's own, if it has failed before.
    """

    def there() -> bool:
        assert not pour.done(), f"the pour ended before {checkpoint}: {pour.result()}"
        return bool(seen) and seen[-1].checkpoint == checkpoint and (seen[-1].tilt or 0.0) >= tilt

    await wait_async(there, f"{checkpoint} of the pour")
