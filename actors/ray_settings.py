"""Ray's settings, which it reads from the environment."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def ray_settings(**values: str) -> Iterator[None]:
    """Have settings in the environment, and what was there back afterwards.

    Ray reads most of them when it is imported; where that has happened already, it is made to read them again.

    Args:
        values: of environment variables.
    """
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    if "ray" in sys.modules:
        from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

        Config.initialize("")
        AuthenticationTokenLoader.instance().reset_cache()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
