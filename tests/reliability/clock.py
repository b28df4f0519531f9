"""A clock on the wall that can be set for some processes alone: a small library that is loaded before libc."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from actors.runtime.child_process import child_environment

SOURCE = Path(__file__).with_name("clock.c")


@cache
def library() -> Path | None:
    """Compiled; None without a compiler."""
    if shutil.which("cc") is None:
        return None
    path = Path(tempfile.mkdtemp(prefix="clock")) / "clock.so"
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-O1", "-o", str(path), str(SOURCE), "-ldl"], check=True, env=child_environment()
    )
    return path


@contextlib.contextmanager
def adjustable(file: Path) -> Iterator[None]:
    """Processes that are started meanwhile have such a clock.

    Args:
        file: by which it is set.
    """
    shift(file, 0.0)
    found, kept = library(), dict(os.environ)
    if found is not None:
        os.environ |= {"LD_PRELOAD": str(found), "DECANT_TEST_CLOCK": str(file)}
    try:
        yield
    finally:
        os.environ.clear()
        os.environ |= kept


def shift(file: Path, seconds: float) -> None:
    """Set it."""
    with file.open("r+b" if file.exists() else "wb") as out:
        out.write(struct.pack("d", seconds))
