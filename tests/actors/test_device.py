"""Calls of a blocking object from the event loop."""

from __future__ import annotations

import asyncio
import gc
import threading
from typing import Any

import pytest

from actors.device import DeviceLostError, LocalDevice


class Stuck:
    """Moves until somebody lets it go, and then says that it was stopped."""

    def __init__(self) -> None:
        self.moving, self.released = threading.Event(), threading.Event()

    def move(self) -> None:
        self.moving.set()
        self.released.wait(10.0)
        raise RuntimeError("stopped on the way")


@pytest.mark.parametrize("how", ["cancelled", "given up at its deadline"])
def test_what_a_call_says_after_nobody_waits_for_it_any_more_is_no_stray_message(how: str) -> None:
    stray: list[dict[str, Any]] = []
    stuck = Stuck()

    async def play() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: stray.append(context))
        device = LocalDevice("arm", lambda: stuck)
        calling = asyncio.create_task(device.call("move", deadline=30.0 if how == "cancelled" else 0.2))
        await asyncio.to_thread(stuck.moving.wait, 5.0)
        if how == "cancelled":
            calling.cancel()
        await asyncio.wait({calling})
        stuck.released.set()
        await asyncio.sleep(0.1)
        assert calling.cancelled() or isinstance(calling.exception(), DeviceLostError)
        await device.close()
        del calling
        gc.collect()

    asyncio.run(play())
    assert [context["message"] for context in stray] == []
