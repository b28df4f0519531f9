"""What all scenarios need: where they begin, and patience."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from dashboard_client import DashboardClient

HOME = [0.0, -1.5707963, 1.5707963, -1.5707963, -1.5707963, 0.0]


_KEPT: list[Any] = []


def keep(interface: Any) -> Any:
    """Keep an interface until the process ends at once: its destructor would sleep for half a second."""
    _KEPT.append(interface)
    return interface


def until(condition: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Wait for something; whether it came."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return False


def arrived(read: Callable[[], list[float]], target: list[float], tolerance: float = 1e-5) -> list[float]:
    """Wait until a reading is near a target: connections run packages behind each other, on a busy machine many.

    Returns:
        The last reading, near the target or not: what it should be is judged by the test.
    """
    last: list[float] = []

    def near() -> bool:
        last[:] = read()
        return len(last) == len(target) and all(abs(a - b) <= tolerance for a, b in zip(last, target, strict=True))

    until(near, 15.0)
    return last


def attempt(call: Callable[[], Any]) -> Any:
    """A call's result, or its error as text."""
    try:
        return call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def dashboard(address: str) -> DashboardClient:
    client = keep(DashboardClient(address))
    client.connect()
    return client
