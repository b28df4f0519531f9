"""`job_runner`: memory that was freed goes back to the system, and threads do not each keep some of their own."""

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

THREADS = """
import ctypes
import threading
from actors.simulators.job_runner import few_arenas

few_arenas()
ready = threading.Barrier(12)

def work():
    ready.wait()  # all of them live at once
    pieces = [bytes(10_000) for _ in range(100)]
    ready.wait()

threads = [threading.Thread(target=work) for _ in range(12)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
ctypes.CDLL(None).malloc_stats()
"""


def needs_glibc() -> None:
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("another C library than glibc")


def output(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=child_environment()
    )


def test_what_is_freed_below_something_that_is_kept_goes_back_to_the_system() -> None:
    needs_glibc()
    given, before, full, freed, after = json.loads(output(PROGRAM).stdout)
    assert given
    taken = full - before
    assert taken > 90e6
    assert full - freed < 0.2 * taken  # or there is nothing to be done
    assert after - before < 0.2 * taken


def test_threads_share_two_heaps() -> None:
    needs_glibc()
    assert 1 <= output(THREADS).stderr.count("Arena ") <= 2
