"""Classes as Ray's actors, each made once: Ray remembers every class that it is given for as long as a program runs."""

from __future__ import annotations

import functools
from collections.abc import Hashable
from typing import Any


@functools.cache
def actor_class(cls: Hashable, groups: tuple[tuple[str, int], ...]) -> Any:
    """A class whose objects are actors that Ray neither restarts nor asks twice.

    Args:
        cls: a class that workers can import.
        groups: concurrency groups: name and number of threads.

    Returns:
        What `.options(…).remote(…)` makes actors of.
    """
    import ray

    return ray.remote(max_restarts=0, max_task_retries=0, concurrency_groups=dict(groups))(cls)
