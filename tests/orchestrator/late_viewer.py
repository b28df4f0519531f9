"""A viewer without a screen: Rerun's own program connects to a live view, and keeps what it is sent."""

from __future__ import annotations

import contextlib
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from actors.runtime.child_process import child_environment
from orchestrator.live_view.viewer_server import environment, rerun_program
from tests.orchestrator.recorded import Contents
from tests.patience import PATIENCE


@contextlib.contextmanager
def viewer(stream: str, kept: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Connected while the context lasts; writes to `kept`."""
    process = subprocess.Popen(
        [rerun_program(), "--save", str(kept), "--connect", stream, "--port", "auto"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=child_environment(environment()),
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def seen(kept: Path, enough: Callable[[Contents], bool]) -> Contents:
    """What a viewer has been sent, once it is enough."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        time.sleep(0.3)
        with contextlib.suppress(Exception), warnings.catch_warnings():  # half-written
            warnings.simplefilter("ignore")
            contents = Contents(kept)
            if enough(contents):
                return contents
    raise AssertionError(f"not enough came to the viewer within {PATIENCE:g} s")
