"""PourTask → PourOutcome: sets the scene, runs the solver until nothing can change any more, and counts.

Light to import; Taichi starts with the first simulation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim_engine.calm import calm_until, liquid_velocity
from sim_engine.contact import describe_contact, first_contact, rotations
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.fill import fill, spacing
from sim_engine.motion import Motion, plan_motion
from sim_engine.outcome import ESCAPED_LIMIT, ParticleState, PourOutcome
from sim_engine.task import PoseError, PourTask, Scene
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.corners import equivalent_distance
from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.spec import VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

if TYPE_CHECKING:
    from sim_engine.action import Action
    from sim_engine.fluid.engine import FluidEngine

__all__ = [
    "InvalidSceneError",
    "PourSimulator",
    "RecordedFrames",
    "SimulationCancelled",
    "SimulationRun",
    "check_motion",
]

SLICE = 0.02
"""The solver is called for so much simulated time at once; curve and frames are taken between calls [s]."""

SETTLING = 0.15
"""The lattice may settle so long before the motion begins [s]."""

QUIET = 0.15
"""With nothing in flight for so long after the motion (or with an empty pourer), the pour is over [s]."""

LONGEST_TAIL = 1.0
"""The pour ends so long after the motion even if something is still in flight [s]."""

CONTACT_POSES = 121

PLANES_KEPT = 16


@dataclass(frozen=True)
class RecordedFrames:
    """Particles at some times.

    Attributes:
        times: (F,) [s].
        positions: F arrays (N, 3) float32, world [m].
        states: F arrays (N,) uint8, `sim_engine.outcome.ParticleState`.
        pourer_poses: (F, 7): x y z qw qx qy qz.
    """

    times: NDArray[np.float64]
    positions: list[NDArray[np.float32]]
    states: list[NDArray[np.uint8]]
    pourer_poses: NDArray[np.float64]


@dataclass(frozen=True)
class SimulationRun:
    """A simulated pour."""

    outcome: PourOutcome
    frames: RecordedFrames | None = None


def check_motion(
    motion: Motion, scene: Scene, action: Action, pourer: Vessel, receiver: Vessel, error: PoseError
) -> None:
    """Refuse a motion in which the vessels touch.

    Raises:
        InvalidSceneError: with where, how deep and at which tilt.
    """
    times = np.linspace(0.0, motion.duration, CONTACT_POSES)
    poses = motion.sample(times)
    poses[:, :2] -= (error.x, error.y)
    contact = first_contact(pourer, receiver, poses)
    if contact is not None:
        tilt = float(motion.tilt(times[contact.index : contact.index + 1])[0])
        text = describe_contact(contact, tilt=tilt)
        raise InvalidSceneError(f"{text} ({action.display('x_offset', 'y_offset', 'height')})")


def inside_mask(vessel: Vessel) -> NDArray[np.uint8]:
    """Where a particle counts as inside the vessel, on the grid's nodes.

    The cavity, continued into the wall up to its middle: a particle that leans on the wall stays inside.
    """
    solid = vessel.grid.values <= 0.0
    nearest = ndimage.distance_transform_edt(solid, return_distances=False, return_indices=True)
    return np.ascontiguousarray(vessel.grid.cavity[tuple(nearest)].astype(np.uint8))


class PourSimulator:
    """Simulates pours one after the other. One per process: Taichi's arrays are shared."""

    def __init__(self) -> None:
        self._vessels: dict[VesselSpec, Vessel] = {}
        self._masks: dict[VesselSpec, NDArray[np.uint8]] = {}
        self._planes: dict[tuple[VesselSpec, float], NDArray[np.float32]] = {}

    def vessel(self, spec: VesselSpec) -> Vessel:
        """A vessel, built once.

        Raises:
            VesselError: it can't be built.
        """
        if spec not in self._vessels:
            self._vessels[spec] = build_vessel(spec)
            self._masks[spec] = inside_mask(self._vessels[spec])
        return self._vessels[spec]

    def prepare(self, task: PourTask) -> Motion:
        """Everything that can be refused before anything moves: load, vessels, contact.

        Raises:
            InvalidSceneError: with the reason.
        """
        scene, error = task.scene, task.pose_error or PoseError()
        try:
            pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
            check_holds(pourer, scene.liquid.volume)
        except VesselError as problem:
            raise InvalidSceneError(str(problem)) from None
        motion = plan_motion(
            scene, task.action, pourer, receiver, tilt_error=error.tilt, speed_factor=error.speed_factor
        )
        check_motion(motion, scene, task.action, pourer, receiver, error)
        return motion

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulationRun:
        """Run one pour.

        Args:
            task: what to simulate. Recording frames does not change the outcome.
            cancelled: polled every `SLICE` of simulated time.

        Returns:
            The outcome; `outcome.invalid` says why a result must not be used (leak, divergence).

        Raises:
            InvalidSceneError: the pour can't be made.
            SimulationCancelled: `cancelled` said so.
        """
        from sim_engine.fluid.engine import engine

        motion = self.prepare(task)
        fluid = engine()
        start = calm_until(motion, self.vessel(task.scene.pourer), task.scene.liquid.volume)
        self._load(fluid, task, motion, start)
        begun = time.process_time()
        fluid.advance(start)
        course = _run(fluid, task, motion, start, cancelled)
        outcome = _outcome(fluid, task, course, time.process_time() - begun)
        return SimulationRun(outcome, course.recorded(motion))

    def _load(self, fluid: FluidEngine, task: PourTask, motion: Motion, start: float) -> None:
        """Put the scene's vessels, motion and liquid into the engine."""
        from sim_engine.fluid.engine import POSE_STEP
        from sim_engine.fluid.state import SUPPORT

        scene, parameters, error = task.scene, task.parameters, task.pose_error or PoseError()
        pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
        d = spacing(scene.liquid.volume, parameters.particles)
        poses = motion.sample(np.arange(0.0, motion.duration + LONGEST_TAIL + 0.1, POSE_STEP))
        # The lattice is laid into the upright cup; a tilt error of the grip then moves cup and liquid together.
        tilt = float(motion.tilt(np.array([start]))[0]) if start > 0.0 else 0.0
        local = fill(pourer, scene.liquid.volume, parameters.particles, task.seed, parameters.wall_distance, tilt)
        (pose,) = motion.sample(np.array([start]))
        (rotation,) = rotations(pose[None])
        fluid.load(
            (local @ rotation.T + pose[:3]).astype(np.float32),
            spacing=d,
            tension=parameters.cohesion,
            density=scene.liquid.density,
            viscosity=parameters.viscosity,
            friction=parameters.friction,
            wall_distance=parameters.wall_distance,
            lip_drop=parameters.lip_drop,
            grids=[pourer.grid, receiver.grid],
            planes=[self._plane(scene.pourer, SUPPORT * d), self._plane(scene.receiver, SUPPORT * d)],
            masks=[self._masks[scene.pourer], self._masks[scene.receiver]],
            walls=[pourer.wall_thickness, receiver.wall_thickness],
            rims=[pourer.rim_height, receiver.rim_height],
            receiver_at=np.array([error.x, error.y, 0.0]),
            spill_level=receiver.rim_height - d,
            poses=poses,
            settling=SETTLING,
            start=start,
            drift=liquid_velocity(motion, pourer, start) if start > 0.0 else None,
        )

    def _plane(self, spec: VesselSpec, support: float) -> NDArray[np.float32]:
        """The vessel's `equivalent_distance`; the last few are kept, for calibration changes θ again and again."""
        key = (spec, support)
        if key not in self._planes:
            if len(self._planes) >= PLANES_KEPT:
                self._planes.pop(next(iter(self._planes)))
            vessel = self.vessel(spec)
            self._planes[key] = equivalent_distance(vessel.grid, self._masks[spec], vessel.rim_height, support)
        return self._planes[key]

    def close(self) -> None:
        """End Taichi; compiled kernels are kept for the next process."""
        from sim_engine.fluid.engine import close_engine

        close_engine()


@dataclass
class _Course:
    """What was seen of a pour on the way."""

    times: list[float] = field(default_factory=lambda: [0.0])
    poured: list[float] = field(default_factory=lambda: [0.0])
    spilled: list[float] = field(default_factory=lambda: [0.0])
    frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]] = field(default_factory=list)

    def recorded(self, motion: Motion) -> RecordedFrames | None:
        """The frames, if any were asked for."""
        if not self.frames:
            return None
        times = np.array([t for t, _, _ in self.frames])
        positions, states = [p for _, p, _ in self.frames], [s for _, _, s in self.frames]
        return RecordedFrames(times, positions, states, motion.sample(times))


def _run(
    fluid: FluidEngine, task: PourTask, motion: Motion, start: float, cancelled: Callable[[], bool] | None
) -> _Course:
    """Advance slice by slice until nothing can change any more, or a fault stops it.

    Raises:
        SimulationCancelled: `cancelled` said so.
    """
    course = _Course()
    n = task.parameters.particles
    next_frame = 0.0
    still_since: float | None = None
    first = slices = round(start / SLICE)
    while True:
        clock = slices * SLICE
        counts = fluid.census()
        if task.record_rate > 0.0 and clock >= next_frame:
            course.frames.append((fluid.time, *fluid.particles()))
            next_frame += 1.0 / task.record_rate
        if slices > first:
            course.times.append(fluid.time)
            course.poured.append(1.0 - float(counts[ParticleState.IN_POURER]) / n)
            course.spilled.append(float(counts[ParticleState.SPILLED]) / n)
        if fluid.fault is not None or clock >= motion.duration + LONGEST_TAIL:
            return course
        # Over when nothing is in flight and nothing can start to fly.
        still = counts[ParticleState.IN_FLIGHT] == 0
        still_since = (clock if still_since is None else still_since) if still else None
        done = clock >= motion.duration or counts[ParticleState.IN_POURER] == 0
        if still_since is not None and done and clock - still_since >= QUIET:
            return course
        if cancelled is not None and cancelled():
            raise SimulationCancelled
        slices += 1
        fluid.advance(slices * SLICE)


def _outcome(fluid: FluidEngine, task: PourTask, course: _Course, cpu_s: float) -> PourOutcome:
    """Count where everybody ended."""
    n = task.parameters.particles
    received, spilled, retained, in_flight, escaped = (
        float(fluid.census()[state]) / n
        for state in (
            ParticleState.RECEIVED,
            ParticleState.SPILLED,
            ParticleState.IN_POURER,
            ParticleState.IN_FLIGHT,
            ParticleState.ESCAPED,
        )
    )
    invalid = fluid.fault
    if invalid is None and escaped > ESCAPED_LIMIT:
        invalid = (
            f"{100 * escaped:.2g} % of the particles crossed vessel walls "
            f"(at most {100 * ESCAPED_LIMIT:g} % is accepted)"
        )
    return PourOutcome(
        received=received,
        spilled=spilled,
        retained=retained,
        in_flight=in_flight,
        escaped=escaped,
        particles=n,
        spacing=spacing(task.scene.liquid.volume, n),
        density_error=fluid.mean_compression,
        simulated_time=fluid.time,
        steps=fluid.steps,
        cpu_s=cpu_s,
        seed=task.seed,
        curve_times=tuple(course.times),
        curve_poured=tuple(course.poured),
        curve_spilled=tuple(course.spilled),
        invalid=invalid,
    )
