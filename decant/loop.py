"""Coroutines from plain functions, also in a notebook, whose thread has a loop already."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end: here, or where a loop is running, in a thread of its own.

    Interrupted from the keyboard in a plain program, it is cancelled, and with it the campaign comes to rest.
    """
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1, thread_name_prefix="decant") as thread:
        return thread.submit(asyncio.run, work).result()
