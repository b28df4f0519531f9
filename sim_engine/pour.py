"""PourTask → PourOutcome: sets the scene, runs the solver until nothing can change any more, and counts.

Light to import; Taichi starts with the first simulation.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim_engine.contact import describe_contact, first_contact
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.fill import fill, spacing
from sim_engine.motion import Motion, plan_motion
from sim_engine.outcome import ESCAPED_LIMIT, PourOutcome
from sim_engine.task import PoseError, PourTask, Scene
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.errors import VesselError
from sim_engine.vessel.spec import VesselSpec
from sim_engine.vessel.vessel import Vessel, check_holds

if TYPE_CHECKING:
    from sim_engine.action import Action

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


@dataclass(frozen=True)
class RecordedFrames:
    """Particles at some times.

    Attributes:
        times: (F,) [s].
        positions: F arrays (N, 3) float32, world [m].
        states: F arrays (N,) uint8, `sim_engine.fluid.state.ParticleState`.
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
        from sim_engine.fluid.engine import POSE_STEP, engine
        from sim_engine.fluid.kernels import cohesion_strength
        from sim_engine.fluid.state import SUPPORT, ParticleState

        motion = self.prepare(task)
        scene, parameters, error = task.scene, task.parameters, task.pose_error or PoseError()
        pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
        d = spacing(scene.liquid.volume, parameters.particles)
        latest = motion.duration + LONGEST_TAIL
        poses = motion.sample(np.arange(0.0, latest + 0.1, POSE_STEP))
        # The lattice is laid into the upright cup; a tilt error of the grip then moves cup and liquid together.
        local = fill(pourer, scene.liquid.volume, parameters.particles, task.seed, parameters.wall_distance)
        positions = _to_world(local, poses[0])
        fluid = engine()
        fluid.load(
            positions,
            spacing=d,
            pair_acceleration=cohesion_strength(parameters.cohesion, d, SUPPORT * d) / (scene.liquid.density * d**3),
            viscosity=parameters.viscosity,
            friction=parameters.friction,
            wall_distance=parameters.wall_distance,
            lip_drop=parameters.lip_drop,
            grids=[pourer.grid, receiver.grid],
            masks=[self._masks[scene.pourer], self._masks[scene.receiver]],
            walls=[pourer.wall_thickness, receiver.wall_thickness],
            rims=[pourer.rim_height, receiver.rim_height],
            receiver_at=np.array([error.x, error.y, 0.0]),
            spill_level=receiver.rim_height - d,
            poses=poses,
            start_time=-SETTLING,
        )
        n = parameters.particles
        times, poured, spilled = [0.0], [0.0], [0.0]
        frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]] = []
        next_frame = 0.0
        still_since: float | None = None
        begun = time.process_time()
        clock, slices = 0.0, 0
        fluid.advance(0.0)
        while True:
            counts = fluid.census()
            if task.record_rate > 0.0 and clock >= next_frame:
                frames.append((fluid.time, *fluid.particles()))
                next_frame += 1.0 / task.record_rate
            if slices > 0:
                times.append(fluid.time)
                poured.append(1.0 - counts[ParticleState.IN_POURER] / n)
                spilled.append(counts[ParticleState.SPILLED] / n)
            if fluid.fault is not None or clock >= latest:
                break
            # Over when nothing is in flight and nothing can start to fly.
            still = counts[ParticleState.IN_FLIGHT] == 0
            still_since = (clock if still_since is None else still_since) if still else None
            done = clock >= motion.duration or counts[ParticleState.IN_POURER] == 0
            if still_since is not None and done and clock - still_since >= QUIET:
                break
            if cancelled is not None and cancelled():
                raise SimulationCancelled
            slices += 1
            clock = slices * SLICE
            fluid.advance(clock)
        cpu = time.process_time() - begun
        counts = fluid.census()
        parts = counts / n
        invalid = fluid.fault
        if invalid is None and parts[ParticleState.ESCAPED] > ESCAPED_LIMIT:
            invalid = (
                f"{100 * parts[ParticleState.ESCAPED]:.2g} % of the particles crossed vessel walls "
                f"(at most {100 * ESCAPED_LIMIT:g} % is accepted)"
            )
        outcome = PourOutcome(
            received=float(parts[ParticleState.RECEIVED]),
            spilled=float(parts[ParticleState.SPILLED]),
            retained=float(parts[ParticleState.IN_POURER]),
            in_flight=float(parts[ParticleState.IN_FLIGHT]),
            escaped=float(parts[ParticleState.ESCAPED]),
            particles=n,
            spacing=d,
            density_error=fluid.mean_compression,
            simulated_time=fluid.time,
            steps=fluid.steps,
            cpu_s=cpu,
            seed=task.seed,
            curve_times=tuple(float(t) for t in times),
            curve_poured=tuple(float(p) for p in poured),
            curve_spilled=tuple(float(p) for p in spilled),
            invalid=invalid,
        )
        return SimulationRun(outcome, _frames(frames, motion) if frames else None)

    def close(self) -> None:
        """End Taichi; compiled kernels are kept for the next process."""
        from sim_engine.fluid.engine import close_engine

        close_engine()


def _to_world(points: NDArray[np.float32], pose: NDArray[np.float64]) -> NDArray[np.float32]:
    w, x, y, z = pose[3:]
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    moved: NDArray[np.float32] = (points @ rotation.T + pose[:3]).astype(np.float32)
    return moved


def _frames(frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]], motion: Motion) -> RecordedFrames:
    times = np.array([t for t, _, _ in frames])
    return RecordedFrames(times, [p for _, p, _ in frames], [s for _, _, s in frames], motion.sample(times))
