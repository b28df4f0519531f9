"""Memory that was freed goes back to the system."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys

import pytest

from actors.runtime.child_process import child_environment

PROGRAM = """
import json
import psutil
from actors.simulators.job_runner import give_back

def resident():
    return psutil.Process().memory_info().rss

before = resident()
pieces = [bytes(10_000) for _ in range(10_000)]
full = resident()
pieces[:-1] = []  # the last one stands above all others, which glibc therefore keeps
freed = resident()
given = give_back()
print(json.dumps([given, before, full, freed, resident()]))
"""


def test_what_is_freed_below_something_that_is_kept_goes_back_to_the_system() -> None:
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("another C library than glibc")
    said = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, env=child_environment()
    ).stdout
    given, before, full, freed, after = json.loads(said)
    assert given
    taken = full - before
    assert taken > 90e6
    assert full - freed < 0.2 * taken  # or there is nothing to be done
    assert after - before < 0.2 * taken
