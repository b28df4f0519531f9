"""A private Ray whose own processes die answers nobody any more; whoever waits for it is told within seconds."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

LOOK_INTERVAL = 1.0
"""Between looks at Ray's own processes [s]."""


async def watch_ray(died: Callable[[str], None]) -> None:
    """Wait until one of a private Ray's own processes has died, which may be never.

    Args:
        died: told once, in words for people, what died and what helps.
    """
    from actors.ray_runtime import ray_lost

    while not (lost := ray_lost()):
        await asyncio.sleep(LOOK_INTERVAL)
    died(f"Ray on this machine has died (its {lost}), and with it all that it ran; nothing can be asked of it any more")
