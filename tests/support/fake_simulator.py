"""A simulator without Taichi that can take time, fail or die, and a scene for it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import PoseError, PourTask, Scene
from sim_engine.vessel.shapes import cylinder


class FakeSimulator:
    """Takes a stated time, can be cancelled, and answers with numbers that depend on the whole task.

    With a log file it writes what happens to it, so that a test sees into other processes.
    """

    def __init__(self, seconds: float = 0.0, log: Path | None = None) -> None:
        self.seconds, self.log = seconds, log
        self._note("made")

    def _note(self, what: str) -> None:
        if self.log is not None:
            with self.log.open("a") as file:
                file.write(f"{what} {os.getpid()}\n")

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        if task.scene.name == "touching":
            raise InvalidSceneError("cups touch: at tilt 37° the pourer enters the receiver by 4.1 mm")
        if task.scene.name == "broken":
            raise ZeroDivisionError("spacing")
        if task.scene.name == "odd":
            return "half a pour"  # type: ignore[return-value]
        if task.scene.name == "deadly":
            os.kill(os.getpid(), 9)
        if task.scene.name == "aborting":  # as a C++ library does
            os.write(2, b"[E core.cpp:50] Assertion failure: home != nullptr\n")
            os.abort()
        self._note("begin")
        end = time.monotonic() + (0.0 if task.scene.name == "quick" else self.seconds)
        while time.monotonic() < end:
            if cancelled is not None and cancelled():
                self._note("cancelled")
                raise SimulationCancelled
            time.sleep(0.005)
        self._note("end")
        error = task.pose_error or PoseError()
        u = np.random.default_rng([task.seed, round(1e9 * (task.action.angular_velocity + error.x + error.tilt))])
        spilled = 0.2 * float(u.random())
        outcome = PourOutcome(
            received=0.9 - spilled,
            spilled=spilled,
            retained=0.1,
            in_flight=0.0,
            escaped=0.0,
            particles=task.parameters.particles,
            spacing=4e-3,
            density_error=0.01,
            simulated_time=5.0,
            steps=100,
            cpu_s=0.1,
            seed=task.seed,
            curve_times=(0.0, 1.0, 2.0),
            curve_poured=(0.0, 0.5, 0.9),
            curve_spilled=(0.0, 0.5 * spilled, spilled),
        )
        frames = None
        if task.frame_rate > 0.0:
            frames = RecordedFrames(
                times=np.arange(3.0),
                positions=[u.random((task.parameters.particles, 3)).astype(np.float32) for _ in range(3)],
                states=[np.zeros(task.parameters.particles, np.uint8)] * 3,
                pourer_poses=np.zeros((3, 7)),
            )
        return SimulatedPour(outcome, frames)

    def close(self) -> None:
        self._note("closed")


def make_fake(seconds: float = 0.0, log: Path | None = None) -> Callable[[], FakeSimulator]:
    """What a pool makes its simulators with."""
    return partial(FakeSimulator, seconds, log)


def make_scene(name: str = "tumbler") -> Scene:
    return Scene(
        name=name,
        pourer=cylinder("beaker", inner_radius=0.035, inner_height=0.1),
        receiver=cylinder("tumbler", inner_radius=0.04, inner_height=0.1),
        liquid=Liquid(mass=0.2),
    )
