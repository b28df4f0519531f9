"""PourTask → PourOutcome: sets the scene, runs the solver until nothing can change any more, and counts.

Light to import; Taichi starts with the first simulation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim_engine.backend import Backend
from sim_engine.calm import calm_until, liquid_velocity
from sim_engine.contact import contact_during, describe_contact, rotations
from sim_engine.course import LONGEST_TAIL, Course, follow, outcome
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.fill import fill, spacing
from sim_engine.fluid.setup import POSE_STEP, SceneSetup, SolidWalls
from sim_engine.motion import Motion, plan_motion
from sim_engine.outcome import ParticleState
from sim_engine.simulated import RecordedFrames, SimulatedPour
from sim_engine.task import PoseError, PourTask, Scene
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.corners import equivalent_distance, inside_mask
from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.spec import VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

if TYPE_CHECKING:
    from sim_engine.action import Action
    from sim_engine.fluid.engine import FluidEngine

__all__ = [
    "InvalidSceneError",
    "PourSimulator",
    "SimulationCancelled",
    "check_motion",
]

SETTLING = 0.15
"""The lattice may settle so long before the motion begins [s]."""

PLANES_KEPT = 16
VESSELS_KEPT = 32
"""About 3 MB each; a prediction draws the shapes of uncertain vessels anew for each of its simulations."""


def check_motion(
    motion: Motion, scene: Scene, action: Action, pourer: Vessel, receiver: Vessel, error: PoseError
) -> None:
    """Refuse a motion in which the vessels touch.

    Raises:
        InvalidSceneError: with where, how deep and at which tilt.
    """
    found = contact_during(motion, pourer, receiver, receiver_at=(error.x, error.y, error.z))
    if found is not None:
        contact, tilt = found
        text = describe_contact(contact, tilt=tilt)
        raise InvalidSceneError(f"{text} ({action.display('x_offset', 'y_offset', 'height')})")


class PourSimulator:
    """Simulates pours, one by one or many in a call. One per process: Taichi's arrays are shared.

    Args:
        backend: 'cpu' or 'cuda'.
    """

    def __init__(self, backend: Backend = "cpu") -> None:
        self.backend = backend
        self._vessels: dict[VesselSpec, Vessel] = {}
        self._masks: dict[VesselSpec, NDArray[np.uint8]] = {}
        self._planes: dict[tuple[VesselSpec, float], NDArray[np.float32]] = {}

    def vessel(self, spec: VesselSpec) -> Vessel:
        """A vessel, built once; the last few are kept.

        Raises:
            VesselError: it can't be built.
        """
        if spec not in self._vessels:
            if len(self._vessels) >= VESSELS_KEPT:
                oldest = next(iter(self._vessels))
                del self._vessels[oldest]
                self._masks.pop(oldest, None)
                self._planes = {key: kept for key, kept in self._planes.items() if key[0] != oldest}
            self._vessels[spec] = build_vessel(spec)
        return self._vessels[spec]

    def prepare(self, task: PourTask) -> Motion:
        """Everything that can be refused before anything moves: load, vessels, contact.

        Raises:
            InvalidSceneError: with the reason.
        """
        scene, error = task.scene, task.placement
        try:
            pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
            check_holds(pourer, scene.liquid.volume)
        except VesselError as problem:
            raise InvalidSceneError(str(problem)) from None
        motion: Motion = task.motion or plan_motion(
            scene, task.action, pourer, receiver, tilt_error=error.tilt, speed_factor=error.speed_factor
        )
        check_motion(motion, scene, task.action, pourer, receiver, error)
        return motion

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """Run one pour.

        Args:
            task: what to simulate. Recording frames does not change the outcome.
            cancelled: polled every `SLICE` of simulated time.

        Returns:
            The outcome; `outcome.invalid` says why a result must not be used (leak, divergence).

        Raises:
            InvalidSceneError: the pour can't be made.
            SimulationCancelled: `cancelled` said so.
            BackendError: the backend is not there.
        """
        (run,) = self.simulate_many([task], cancelled=cancelled)
        return run

    def simulate_many(
        self, tasks: Sequence[PourTask], *, cancelled: Callable[[], bool] | None = None
    ) -> list[SimulatedPour]:
        """Run many pours, of any actions, θ, vessels and seeds, in one set of kernels.

        On a CPU the pours follow each other; on a GPU they run side by side, as many as there is memory for. Every
        outcome is the one that the pour has alone.

        Args:
            tasks: what to simulate.
            cancelled: polled every `SLICE` of simulated time.

        Returns:
            As many runs, in the same order.

        Raises:
            InvalidSceneError: one of the pours can't be made; nothing was simulated.
            SimulationCancelled: `cancelled` said so.
            BackendError: the backend is not there.
        """
        from sim_engine.fluid.engine import engine

        motions = [self.prepare(task) for task in tasks]
        fluid = engine(self.backend)
        runs: list[SimulatedPour] = []
        while len(runs) < len(tasks):
            first = len(runs)
            end = first + fluid.room_for([task.parameters.particles for task in tasks[first:]])
            runs += self._batch(fluid, tasks[first:end], motions[first:end], cancelled)
        return runs

    def _batch(
        self,
        fluid: FluidEngine,
        tasks: Sequence[PourTask],
        motions: Sequence[Motion],
        cancelled: Callable[[], bool] | None,
    ) -> list[SimulatedPour]:
        """Pours that fit into one load."""
        begun = time.process_time()
        starts = [
            calm_until(motion, self.vessel(task.scene.pourer), task.scene.liquid.volume)
            for task, motion in zip(tasks, motions, strict=True)
        ]
        fluid.load([self._setup(*one) for one in zip(tasks, motions, starts, strict=True)])
        loading = (time.process_time() - begun) / len(tasks)
        courses = [
            Course(task, motion, start, scene)
            for scene, (task, motion, start) in enumerate(zip(tasks, motions, starts, strict=True))
        ]
        if fluid.backend == "cpu":
            # One after the other: a scene's arrays stay in the core's cache.
            for course in courses:
                follow(fluid, [course], cancelled)
        else:
            follow(fluid, courses, cancelled)
        for course, task, motion in zip(courses, tasks, motions, strict=True):
            if task.record_rate > 0.0:
                course.frames[:0] = self._level_frames(task, motion, course.start)
        return [
            SimulatedPour(outcome(fluid, course, loading), recorded_frames(course, motion))
            for course, motion in zip(courses, motions, strict=True)
        ]

    def _laid(self, task: PourTask, motion: Motion, at: float) -> NDArray[np.float32]:
        """Positions of the liquid at rest in the pourer as it stands at a time [s], (N, 3) in the world [m]."""
        # The lattice is laid into the upright cup; a tilt error of the grip then moves cup and liquid together.
        tilt = float(motion.tilt(np.array([at]))[0]) if at > 0.0 else 0.0
        pourer, parameters = self.vessel(task.scene.pourer), task.parameters
        volume = task.scene.liquid.volume
        local = fill(pourer, volume, parameters.particles, task.seed, parameters.wall_distance, tilt)
        (pose,) = motion.sample(np.array([at]))
        (rotation,) = rotations(pose[None])
        placed: NDArray[np.float32] = (local @ rotation.T + pose[:3]).astype(np.float32)
        return placed

    def _level_frames(
        self, task: PourTask, motion: Motion, start: float
    ) -> list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]]:
        """Frames from before the simulation began, when the liquid lay level: time, positions, states."""
        homes = np.full(task.parameters.particles, int(ParticleState.IN_POURER), np.uint8)
        times = np.arange(0.0, start - 0.5 / task.record_rate, 1.0 / task.record_rate)
        return [(float(t), self._laid(task, motion, float(t)), homes) for t in times]

    def _setup(self, task: PourTask, motion: Motion, start: float) -> SceneSetup:
        """The scene as the engine takes it, at the time from which it has to be simulated [s]."""
        from sim_engine.fluid.state import SUPPORT

        scene, parameters, error = task.scene, task.parameters, task.placement
        liquid = scene.liquid
        pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
        d = spacing(liquid.volume, parameters.particles)
        drift = liquid_velocity(motion, pourer, start) if start > 0.0 else np.zeros(3)
        return SceneSetup(
            positions=self._laid(task, motion, start),
            spacing=d,
            density=liquid.density,
            parameters=parameters,
            pourer=self._walls(scene.pourer, SUPPORT * d),
            receiver=self._walls(scene.receiver, SUPPORT * d),
            receiver_at=np.array([error.x, error.y, error.z]),
            spill_level=receiver.rim_height + error.z - d,
            poses=motion.sample(np.arange(0.0, motion.duration + LONGEST_TAIL + 0.1, POSE_STEP)),
            settling=SETTLING,
            start=start,
            drift=(float(drift[0]), float(drift[1]), float(drift[2])),
            viscosity=liquid.kinematic_viscosity * parameters.viscosity_factor if liquid.is_thick else 0.0,
            tension=liquid.surface_tension if liquid.is_thick else None,
            contact_angle=liquid.contact_angle,
        )

    def _walls(self, spec: VesselSpec, support: float) -> SolidWalls:
        """The vessel's; the last few planes are kept, for calibration changes θ again and again."""
        vessel = self.vessel(spec)
        key = (spec, support)
        if key not in self._planes:
            if len(self._planes) >= PLANES_KEPT:
                self._planes.pop(next(iter(self._planes)))
            if spec not in self._masks:
                self._masks[spec] = inside_mask(vessel.grid)
            self._planes[key] = equivalent_distance(vessel.grid, self._masks[spec], vessel.rim_height, support)
        return SolidWalls(vessel.grid, self._planes[key], self._masks[spec], vessel.wall_thickness, vessel.rim_height)

    def close(self) -> None:
        """End Taichi; compiled kernels are kept for the next process."""
        from sim_engine.fluid.engine import close_engine

        close_engine()


def recorded_frames(course: Course, motion: Motion) -> RecordedFrames | None:
    """The frames, if any were asked for."""
    if not course.frames:
        return None
    times = np.array([t for t, _, _ in course.frames])
    positions, states = [p for _, p, _ in course.frames], [s for _, _, s in course.frames]
    return RecordedFrames(times, positions, states, motion.sample(times))
