"""Interpreters with other programs' packages, which are not Decant's own: $DECANT_SILA_PYTHON and the like.

An environment of its own shows that the client is unmodified, and keeps its packages from Decant's.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.runtime.child_process import child_environment
from tests.support.waiting import PATIENCE

ALONE = {"PYTHONPATH": None, "PYTHONUNBUFFERED": "1"}
"""Environment of a client: it can't import Decant."""


def python_with(package: str, name: str) -> str:
    """Interpreter of the environment with a package: $DECANT_NAME_PYTHON, or this one; skips the test without it."""
    variable = f"DECANT_{name}_PYTHON"
    if found := os.environ.get(variable):
        return found
    if importlib.util.find_spec(package.partition(".")[0]) is None:
        pytest.skip(f"no environment with {package} (${variable})")
    return sys.executable


def told(python: str, code: str | Path, *arguments: str, **environment: str | None) -> Any:
    """Run a program, given as text or as a file, and return the JSON of its line that begins with TOLD."""
    program = [str(code)] if isinstance(code, Path) else ["-c", code]
    done = subprocess.run(
        [python, *program, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
        env=child_environment({**ALONE, **environment}),
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("TOLD "))[5:])


@contextlib.contextmanager
def running(python: str, code: str | Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program next to the test, which reads its lines; it is killed at the end."""
    program = [str(code)] if isinstance(code, Path) else ["-c", code]
    process = subprocess.Popen(
        [python, *program, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=child_environment(ALONE),
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            assert stream is not None
            stream.close()


def line(process: subprocess.Popen[str], start: str) -> str:
    """The rest of the first line that begins so."""
    assert process.stdout is not None
    for text in process.stdout:
        if text.startswith(start):
            return text[len(start) :].strip()
    raise AssertionError(f"the program ended without a line '{start}'")
