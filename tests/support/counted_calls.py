"""The work that code does, as a number of calls: the same on every machine, whatever its load."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType


@dataclass
class Calls:
    """Calls of Python and C functions in this thread while the context lasted."""

    count: int = 0


@contextlib.contextmanager
def counted_calls() -> Iterator[Calls]:
    """Count calls, to compare them with a limit where a time would depend on the machine."""
    calls = Calls()

    def count(frame: FrameType, event: str, argument: object) -> None:
        if event in ("call", "c_call"):
            calls.count += 1

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        yield calls
    finally:
        sys.setprofile(before)
