"""A private Ray whose own processes die, or that was cut off, answers nobody; who waits is told within seconds."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

LOOK_INTERVAL = 1.0
"""Between looks at what Ray has lost [s]."""


async def watch_ray(died: Callable[[str], None]) -> None:
    """Wait until a private Ray has lost one of its own processes or the way to this one, which may be never.

    Args:
        died: told once, in words for people, what is lost.
    """
    from actors.ray_runtime import ray_lost

    while not (lost := ray_lost()):
        await asyncio.sleep(LOOK_INTERVAL)
    died(f"Ray on this machine has lost its {lost}, and with it all that it ran; nothing can be asked of it any more")
