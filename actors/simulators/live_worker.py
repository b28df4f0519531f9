"""A pour whose motion is decided while it runs, simulated in a process of its own.

`LivePourProcess` has `sim_engine.live_pour.LivePours` in a process that it starts with the first pour; `LocalLivePours`
has them in this process.

`python -m actors.simulators.live_worker FD` is the process. It ends when its owner closes the connection or dies.
"""

from __future__ import annotations

import contextlib
import sys
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import ConnectedProcess, last_lines
from actors.simulators.job_runner import LONG_FIRST_JOB
from sim_engine.errors import EngineError, InvalidSceneError
from sim_engine.live_pour import LivePour, LiveState, in_plane
from sim_engine.scene import PourTask, SampledMotion
from sim_engine.simulator import PourSimulator

Floats = NDArray[np.float64]

ENDING = 10.0
"""Time for the process to write its kernels and end [s]."""

WARM_UP, SIDEWAYS = 0.01, np.array([0.0, 0.0, 0.2, np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
"""The first pour begins with this time [s], for a cup that lies on its side, so that all kernels are compiled then."""


class LivePourProcess:
    """`LivePours` in a child process. For one thread at a time.

    Its calls raise a LaboratoryError if the pour is impossible, the engine fails, or the process has died; the next
    pour starts another process.
    """

    def __init__(self) -> None:
        self._child: ConnectedProcess | None = None

    def ready(self, task: PourTask) -> None:
        """Start the process and its kernels, so that `begin` takes seconds: minutes if they have to be compiled."""
        if self._child is not None:
            with contextlib.suppress(LaboratoryError):  # it was killed between two pours
                self._call("ready", task)
                return
        self._child = self._child or ConnectedProcess(__name__)
        self._call("ready", task)

    def begin(self, task: PourTask, pose: Floats) -> None:
        """See `LivePours.begin`."""
        self._child = self._child or ConnectedProcess(__name__)
        self._call("begin", task, pose)

    def advance(self, times: Floats, poses: Floats) -> LiveState:
        """See `LivePours.advance`."""
        state: LiveState = self._call("advance", times, poses)
        return state

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """See `LivePours.particles`."""
        particles: tuple[NDArray[np.float32], NDArray[np.uint8]] = self._call("particles")
        return particles

    def close(self) -> None:
        """See `LivePours.close`."""
        child, self._child = self._child, None
        if child is not None:
            child.connection.close()
            child.close(ENDING)

    def _call(self, method: str, *arguments: Any) -> Any:
        child = self._child
        if child is None:
            raise LaboratoryError("the process that simulates the liquid of doses has ended")
        try:
            child.connection.send((method, arguments))
            reply = child.connection.recv()
        except (EOFError, OSError):
            self._child = None
            child.connection.close()
            child.wait(ENDING)
            problem = last_lines(child.errors_kept) or f"status {child.status}"
            child.close()
            raise LaboratoryError(f"the process that simulates the liquid of doses has died: {problem}") from None
        if isinstance(reply, Exception):
            raise reply
        return reply


class LocalLivePours:
    """`LivePours` in this process, which simulates nothing else meanwhile; its calls raise the engine's errors.

    Args:
        simulator: of this process.
    """

    def __init__(self, simulator: PourSimulator) -> None:
        self._simulator = simulator
        self._compiled: set[bool] = set()  # whether for thick liquids
        self._pour: LivePour | None = None

    def begin(self, task: PourTask, pose: Floats) -> None:
        """See `LivePours.begin`."""
        self.ready(task)
        poses = in_plane(np.array([pose, pose]))
        mirrored = poses is not None and self._simulator.mirrors(task, SampledMotion(np.array([0.0, 1.0]), poses))
        self._pour = LivePour(self._simulator, task, pose, mirrored=mirrored)

    def ready(self, task: PourTask) -> None:
        """Compile the kernels, or load them from the cache; like `JobRunner`, write those that were compiled."""
        from sim_engine.engine_package import compiling_alone

        if task.scene.liquid.is_thick in self._compiled:
            return
        begun = time.process_time()
        with compiling_alone(lambda: False):
            LivePour(self._simulator, task, SIDEWAYS).advance(np.array([WARM_UP]), SIDEWAYS)
            if time.process_time() - begun > LONG_FIRST_JOB:
                self._simulator.close()
        self._compiled.add(task.scene.liquid.is_thick)

    def advance(self, times: Floats, poses: Floats) -> LiveState:
        """See `LivePours.advance`."""
        assert self._pour is not None
        return self._pour.advance(times, poses)

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """See `LivePours.particles`."""
        assert self._pour is not None
        return self._pour.particles()

    def close(self) -> None:
        """See `LivePours.close`."""
        self._simulator.close()


def serve(connection: Connection) -> None:
    """Simulate pours until the owner closes the connection."""
    pours = LocalLivePours(PourSimulator())
    with contextlib.suppress(EOFError, OSError):
        while True:
            method, arguments = connection.recv()
            try:
                reply = getattr(pours, method)(*arguments)
            except (InvalidSceneError, EngineError, ValueError) as error:
                reply = LaboratoryError(f"the liquid of the dose cannot be simulated: {error}")
            connection.send(reply)
    pours.close()


if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])))
