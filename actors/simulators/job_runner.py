"""One simulator as a worker uses it: `JobRunner` runs the pool's tasks on the engine and translates its errors.

`give_back` returns freed memory to the system; `few_arenas` has a process keep less of it.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import time
from collections.abc import Callable
from typing import Protocol

from actors.interfaces import InvalidActionError, LaboratoryError, SimulationError
from sim_engine.engine_package import compiling_alone
from sim_engine.errors import EngineError, InvalidSceneError, SimulationCancelled
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask

LONG_FIRST_JOB = 5.0
"""CPU time [s] of a process's first job above which its kernels may have been compiled. Loading them from the cache
takes a second or two; compiling takes six to eight."""


ARENAS = 2
"""Heaps of a daemon's process. Its threads hold Python's global lock when they allocate, so they hardly wait."""

_M_ARENA_MAX = -8  # of malloc.h


class JobCancelledError(Exception):
    """The job was cancelled, because its result is not needed any more."""


class Simulator(Protocol):
    """The engine's interface for a job runner; `sim_engine.shared_simulator.SharedSimulator` implements it."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """Run one pour."""
        ...

    def close(self) -> None:
        """Close it; compiled kernels are kept for the next one."""
        ...


def pour_simulator() -> Simulator:
    """Create the engine's simulator, which threads of a process can share. Importing and starting it compiles kernels,
    so call this in the process that uses it.
    """
    from sim_engine.shared_simulator import SharedSimulator

    return SharedSimulator()


class JobRunner:
    """Runs jobs one after another on one simulator.

    Kernels are written to the cache when a simulator is closed. If a process is killed before that, the next one on its
    machine compiles them again. Therefore the simulator is closed once after a long first job and created again with
    the next job, which costs a second. Processes that start together compile one after the other, so that all but the
    first load its kernels.

    Args:
        make: creates the simulator at the first job, so that an unused process compiles nothing.
        long_first_job: CPU time above which a first job counts as long [s].
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
            JobCancelledError: `cancelled` returned True.
            LaboratoryError: the engine cannot be used, or gives wrong outcomes on this machine.
            SimulationError: any other error of the engine.
        """
        if cancelled():
            raise JobCancelledError  # cancelled while it waited behind another job
        if not self._is_first:
            return self._simulated(task, cancelled)
        with compiling_alone(cancelled):
            if cancelled():
                raise JobCancelledError
            begun = time.process_time()
            run = self._simulated(task, cancelled)
            if time.process_time() - begun > self._long_first_job:
                self.close()
        self._is_first = False
        return run

    def _simulated(self, task: PourTask, cancelled: Callable[[], bool]) -> SimulatedPour:
        try:
            if self._simulator is None:
                self._simulator = self._make()
            run = self._simulator.simulate(task, cancelled=cancelled)
        except InvalidSceneError as error:
            raise InvalidActionError(str(error)) from None
        except SimulationCancelled:
            raise JobCancelledError from None
        except EngineError as error:
            raise LaboratoryError(str(error)) from None
        except Exception as error:
            raise SimulationError(f"the simulator failed: {type(error).__name__}: {error}") from error
        if not isinstance(run, SimulatedPour):
            raise SimulationError(f"the simulator answered with a {type(run).__name__}, not with a simulated pour")
        return run

    def close(self) -> None:
        """Close the simulator, if there is one."""
        simulator, self._simulator = self._simulator, None
        if simulator is not None:
            simulator.close()


def few_arenas() -> None:
    """Have all threads of this process share glibc's heaps, of which there are else eight per core.

    A daemon's threads take turns at large work, and every heap keeps what the largest work of its threads has left
    between live pieces. Call it before other threads start; C libraries other than glibc are left as they are.
    """
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, ARENAS)


def give_back() -> bool:
    """Collect garbage, and return freed memory, which the C library keeps, to the system.

    What a campaign leaves consists of reference cycles, few objects that hold much. Python collects them when the
    number of objects has grown by a quarter, which takes dozens of campaigns where a simulator is loaded.

    Returns:
        Whether memory was returned; always False for C libraries other than glibc.
    """
    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return False
    return bool(trim(0))
