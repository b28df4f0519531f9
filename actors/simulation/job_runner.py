"""One simulator as the pools use it: a plain class that translates between the engine and the laboratory's words."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from actors.protocols import InvalidActionError, SimulationError
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask

LONG_FIRST_JOB = 5.0
"""CPU seconds of a process' first job above which its kernels may have been compiled for it. Loaded from the cache they
cost a second or two; compiled, six to eight."""


RETRIES = 2
"""How often a job is tried again in another process after one died over it."""


class JobCancelledError(Exception):
    """The job was given up because nobody waits for it any more."""


class Simulator(Protocol):
    """What a job runner needs of the engine; `sim_engine.pour.PourSimulator` is one."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """Run one pour."""
        ...

    def close(self) -> None:
        """End it; compiled kernels are kept for the next one."""
        ...


def pour_simulator() -> Simulator:
    """The engine's own simulator. Importing and starting it compiles kernels: do it where it is used."""
    from sim_engine.pour import PourSimulator

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
