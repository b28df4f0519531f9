"""The clock of runs: seconds since 1970 that do not jump while a run of this process goes on.

The system's clock may be set during a run, by a person or by a time server. All times of a run, in its journal and its
events, are therefore the system's time at the run's begin plus the time that has passed since then. Their differences
are durations. A later run, or the same one resumed, begins with the system's time again.
"""

from __future__ import annotations

import threading
import time

_guard = threading.Lock()
_runs = 0
_offset = 0.0


def run_time() -> float:
    """The time [s since 1970]; the system's while no run goes on."""
    return _offset + _passed() if _runs else time.time()


def begin_run() -> None:
    """Keep the clock steady until as many calls of `end_run`."""
    global _runs, _offset
    with _guard:
        if _runs == 0:
            _offset = time.time() - _passed()
        _runs += 1


def end_run() -> None:
    """Undo one `begin_run`."""
    global _runs
    with _guard:
        _runs -= 1


def _passed() -> float:
    """A clock that nobody sets; on Linux it also counts the time in which the machine is suspended [s]."""
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if clock is None else time.clock_gettime(clock)
