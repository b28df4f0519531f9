"""One simulator as the pools use it: a plain class that translates between the engine and the laboratory's words.

Memory that a long-running program has freed, given back to the system.

What a pool has done so far.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from actors.interfaces import InvalidActionError, SimulationError
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

LONG_FIRST_JOB = 5.0
"""CPU seconds of a process' first job above which its kernels may have been compiled for it. Loaded from the cache they
cost a second or two; compiled, six to eight."""


RETRIES = 2
"""How often a job is tried again in another process after one died over it."""


class JobCancelledError(Exception):
    """The job was given up because nobody waits for it any more."""


class Simulator(Protocol):
    """What a job runner needs of the engine; `sim_engine.simulator.PourSimulator` is one."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """Run one pour."""
        ...

    def close(self) -> None:
        """End it; compiled kernels are kept for the next one."""
        ...


def pour_simulator() -> Simulator:
    """The engine's own simulator. Importing and starting it compiles kernels: do it where it is used."""
    from sim_engine.simulator import PourSimulator

    return PourSimulator()


class JobRunner:
    """Runs jobs one after the other on one simulator.

    Kernels reach the cache when a simulator is closed. A process may be killed before that, and the next one on its
    machine would compile them again: so after a long first job the simulator is closed once and made anew with the
    next job, which costs a second.

    Args:
        make: makes the simulator, with the first job: a process that is never used compiles nothing.
        long_first_job: CPU seconds from which a first job counts as long.
    """

    def __init__(
        self, make: Callable[[], Simulator] = pour_simulator, *, long_first_job: float = LONG_FIRST_JOB
    ) -> None:
        self._make = make
        self._simulator: Simulator | None = None
        self._long_first_job = long_first_job
        self._is_first = True

    def simulate(self, task: PourTask, cancelled: Callable[[], bool]) -> SimulatedPour:
        """Run one pour.

        Args:
            task: what to simulate.
            cancelled: polled between time steps.

        Raises:
            InvalidActionError: the vessels touch, or the motion is impossible.
            JobCancelledError: `cancelled` said so.
            SimulationError: anything else that the engine raises.
        """
        if cancelled():
            raise JobCancelledError  # while it waited behind another job
        begun = time.process_time()
        try:
            if self._simulator is None:
                self._simulator = self._make()
            run = self._simulator.simulate(task, cancelled=cancelled)
        except InvalidSceneError as error:
            raise InvalidActionError(str(error)) from None
        except SimulationCancelled:
            raise JobCancelledError from None
        except Exception as error:
            raise SimulationError(f"the simulator failed: {type(error).__name__}: {error}") from error
        if not isinstance(run, SimulatedPour):
            raise SimulationError(f"the simulator answered with a {type(run).__name__}, not with a simulated pour")
        if self._is_first and time.process_time() - begun > self._long_first_job:
            self.close()
        self._is_first = False
        return run

    def close(self) -> None:
        """End the simulator, if there is one."""
        simulator, self._simulator = self._simulator, None
        if simulator is not None:
            simulator.close()


def give_back() -> bool:
    """Have the C library return what it keeps of freed memory.

    A campaign's threads each take from an arena of their own, and glibc keeps what they free for itself: measured, some
    14 MB after four recorded campaigns.

    Returns:
        Whether there was anything to give back: False, too, where the C library is another one than glibc.
    """
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return False
    return bool(trim(0))


@dataclass(frozen=True)
class PoolStatistics:
    """A pool's account.

    Attributes:
        jobs: answered, refusals included.
        cancelled: given up because nobody waited any more.
        deaths: members lost and replaced.
        busy_s: wall seconds that members worked, summed over them; by their own clocks where they have told.
        busy_fraction: of the members' time since the pool was opened.
    """

    jobs: int
    cancelled: int
    deaths: int
    busy_s: float
    busy_fraction: float


@dataclass
class Account:
    """Keeps a pool's statistics."""

    size: int
    jobs: int = 0
    cancelled: int = 0
    deaths: int = 0
    _busy: float = 0.0
    _available: float = 0.0
    _resized: float = field(default_factory=time.monotonic)
    _since: dict[int, float] = field(default_factory=dict)

    def begin(self, member: int) -> None:
        """A member was given a job."""
        self._since[member] = time.monotonic()

    def end(self, member: int, worked: float | None = None) -> None:
        """It is idle again, or gone.

        Args:
            member: its number.
            worked: by its own clock [s]; else the time since `begin`.
        """
        elapsed = time.monotonic() - self._since.pop(member, time.monotonic())
        self._busy += elapsed if worked is None else worked

    def resize(self, size: int) -> None:
        """From now on there are so many members."""
        now = time.monotonic()
        self._available += (now - self._resized) * self.size
        self.size, self._resized = size, now

    def statistics(self) -> PoolStatistics:
        """As of now, jobs under way included."""
        now = time.monotonic()
        busy = self._busy + sum(now - since for since in self._since.values())
        available = max(self._available + (now - self._resized) * self.size, 1e-9)
        return PoolStatistics(self.jobs, self.cancelled, self.deaths, busy, busy / available)
