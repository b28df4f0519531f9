"""PourTask → PourOutcome: sets up the scene, runs the solver until the outcome is final, and counts particles.

`PourSimulator` runs pours. Importing this module is fast; the engine starts with the first simulation.

- **Initial positions** (`fill`): a jittered lattice that fills the pourer from the bottom.
- **Time loop** (`TimeLoop`, `follow`): slices of time, recordings between them, the end of the pour, and its outcome.
- **Quiescent start** (`calm_until`): the time at which a simulation has to begin. Until then the liquid lies level in a
  slowly turning cup, and hydrostatics describes it completely.

A slow pour spends half of its time before any liquid can leave. Simulating this time costs as much as the pour and does
not affect the outcome. Therefore the lattice is laid level into the tilted cup shortly before it may spill, and moves
with it from then on. This is allowed only while the motion is slow, so that the waves it could have caused are low.

Source of the quiescent start: derived here. Limitations: waves from before the start are left out; `CALM` bounds them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim_engine.collision import contact_during, describe_contact, rotations
from sim_engine.dribbling import DribblingCourse, dribbling_course, rivulet_frames
from sim_engine.engine_package import check_engine, engine_name
from sim_engine.errors import InvalidSceneError, SimulationCancelled
from sim_engine.fluid.scene_setup import POSE_STEP, SceneSetup, SolidWalls
from sim_engine.hydrostatics import GRAVITY, level
from sim_engine.motion import Motion, plan_motion
from sim_engine.outcome import ESCAPED_LIMIT, ParticleState, PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import MIRRORED_FROM, PoseError, PourTask, Scene
from sim_engine.vessel.shapes import VesselError, VesselSpec
from sim_engine.vessel.vessel import Vessel, build_vessel, check_holds, in_cavity
from sim_engine.vessel.wall_correction import equivalent_distance, inside_mask

if TYPE_CHECKING:
    from sim_engine.action import Action
    from sim_engine.fluid.engine import FluidEngine

JITTER = 0.05
"""Largest displacement from the lattice, in spacings; it makes seeds differ and breaks the crystal order."""


def spacing(volume: float, particles: int) -> float:
    """The particle spacing d = (V/N)^(1/3) [m]."""
    return float((volume / particles) ** (1.0 / 3.0))


SYMMETRIC = 0.1
"""Largest `Vessel.asymmetry` of vessels that count as symmetric, in spacings."""


def why_whole(vessel: Vessel, volume: float, particles: int) -> str:
    """Why pours with a vessel are not simulated by half, as text; empty if its shape does not prevent it.

    Args:
        volume: of the liquid [m³].
        particles: N.
    """
    allowed = SYMMETRIC * spacing(volume, particles)
    if vessel.asymmetry <= allowed:
        return ""
    return (
        f"it differs from its mirror image in the plane of the tilt by {1e3 * vessel.asymmetry:.2g} mm, more than "
        f"{1e3 * allowed:.2g} mm: with {particles} particles whole pours are simulated, which takes twice as long"
    )


def fill(
    vessel: Vessel,
    volume: float,
    particles: int,
    seed: int,
    wall_distance: float = 0.5,
    tilt: float = 0.0,
    mirrored: bool = False,
) -> NDArray[np.float32]:
    """Positions of exactly `particles` particles of volume V/N each, or of the half of them in y > 0.

    Args:
        vessel: filled from below.
        volume: of the liquid [m³].
        particles: N.
        wall_distance: approximate distance of lattice points from solid, in spacings, as the density constraint keeps
            it.
        tilt: of the vessel when it is filled, towards +x [rad].
        seed: shifts the lattice, jitters it, and selects places of the topmost layer.
        mirrored: places half of the particles, on a lattice that is also turned at random about the vertical: along the
            plane of symmetry it would form layers.

    Returns:
        Shape (N, 3) or (N // 2, 3), float32, in the vessel's frame [m].

    Raises:
        InvalidSceneError: at this number of particles the liquid does not fit under the rim.
    """
    rng = np.random.default_rng(seed)
    d = spacing(volume, particles)
    count = particles // 2 if mirrored else particles
    # In a narrow or brimful vessel the lattice may have too few places: then it is compressed, and the solver relaxes
    # it. Rims are lower for particles, so the uppermost spacing is used only if nothing else helps.
    for top in (vessel.rim_height - d, vessel.rim_height):
        for squeeze in (1.0, 0.98, 0.96, 0.94, 0.92, 0.9, 0.87, 0.84):
            places = _lattice(vessel, d, d * squeeze, wall_distance, top, rng, mirrored)
            if len(places) >= count:
                order = np.lexsort((rng.random(len(places)), np.round(_height(places, tilt) / (d * squeeze))))
                chosen = places[order[:count]]
                chosen += rng.uniform(-JITTER, JITTER, chosen.shape) * d
                return chosen.astype(np.float32)
    raise InvalidSceneError(
        f"{vessel.name}: {1e6 * volume:.4g} mL as {particles} particles do not fit under the rim (it holds "
        f"{1e6 * vessel.capacity:.4g} mL to the brim); pour less, use more particles, or a larger vessel"
    )


def _height(places: NDArray[np.float64], tilt: float) -> NDArray[np.float64]:
    """Height of places of the vessel's frame in a tilted vessel, up to a constant (N,) [m]."""
    height: NDArray[np.float64] = places[:, 2] * np.cos(tilt) - places[:, 0] * np.sin(tilt)
    return height


def _lattice(
    vessel: Vessel, d: float, step: float, wall_distance: float, top: float, rng: np.random.Generator, mirrored: bool
) -> NDArray[np.float64]:
    """Places of a cubic lattice, shifted at random, in the cavity below `top`, shape (M, 3) [m]."""
    reach = (vessel.outer_radius + step) * (math.sqrt(2.0) if mirrored else 1.0)
    across = np.arange(-reach, reach, step)
    shift = rng.uniform(-0.5, 0.5, 2) * step
    z = np.arange(vessel.inner_floor + wall_distance * d, top, step)
    places = np.stack(np.meshgrid(across + shift[0], across + shift[1], z, indexing="ij"), axis=-1).reshape(-1, 3)
    if mirrored:
        angle = rng.uniform(0.0, 0.5 * math.pi)
        cosine, sine = math.cos(angle), math.sin(angle)
        places = places @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        places = places[places[:, 1] > 0.0]
    places = places[vessel.grid.sample(places) >= 0.9 * wall_distance * d]
    return places[in_cavity(vessel.grid, places)]


SLICE = 0.02
"""Simulated time of one call of the solver [s]; curve and frames are recorded between calls."""

QUIET = 0.15
"""Time without liquid in flight after the motion, or with an empty pourer, after which the pour has ended [s]."""

LONGEST_TAIL = 1.0
"""Time after the motion at which the pour ends even if liquid is still in flight [s]."""


@dataclass
class TimeLoop:
    """The simulation of one pour.

    Attributes:
        task, motion: of the pour.
        start: time at which the simulation begins, a multiple of `SLICE`; the liquid lies level before [s].
        mirrored: whether only the half y ≥ 0 is simulated.
        times, poured, spilled: recorded curve: [s], fractions.
        frames: time, positions (N, 3) [m], states (N,), of the simulated particles.
        dribbling: what runs down the outside of the pourer; None if that is not simulated.
        states: of the particles at the times of the curve, (N,) each, if `dribbling` is set.
        slices: time reached, in `SLICE`.
        over: whether the outcome is final.
        cpu_s: CPU time of the process for this pour [s].

    Raises:
        ValueError: it would start within a slice.
    """

    task: PourTask
    motion: Motion
    start: float
    mirrored: bool = False
    times: list[float] = field(default_factory=lambda: [0.0])
    poured: list[float] = field(default_factory=lambda: [0.0])
    spilled: list[float] = field(default_factory=lambda: [0.0])
    frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]] = field(default_factory=list)
    dribbling: DribblingCourse | None = None
    states: list[NDArray[np.uint8]] = field(default_factory=list)
    slices: int = 0
    over: bool = False
    cpu_s: float = 0.0
    _next_frame: float = 0.0
    _still_since: float | None = None

    def __post_init__(self) -> None:
        self.slices = round(self.start / SLICE)
        if abs(self.start - self.clock) > 1e-9:
            raise ValueError(f"a pour is simulated from a multiple of {SLICE:g} s on, not from {self.start:.6g} s")
        if self.dribbling is not None:
            self.states.append(np.full(self.particles, int(ParticleState.IN_POURER), np.uint8))

    @property
    def particles(self) -> int:
        """Number of simulated particles."""
        n = self.task.parameters.particles
        return n // 2 if self.mirrored else n

    @property
    def clock(self) -> float:
        """Simulated time reached [s]."""
        return self.slices * SLICE

    def look(self, fluid: FluidEngine, counts: NDArray[np.int32]) -> None:
        """Record the state between two slices, and decide whether the pour has ended.

        Args:
            fluid: the engine.
            counts: particles in each state, shape (5,).
        """
        n = int(counts.sum())
        now = fluid.time()
        if self.task.frame_rate > 0.0 and self.clock >= self._next_frame:
            self.frames.append((now, *fluid.particles()))
            while self._next_frame <= self.clock:
                self._next_frame += 1.0 / self.task.frame_rate
        if now > self.times[-1]:
            self.times.append(now)
            self.poured.append(1.0 - float(counts[ParticleState.IN_POURER]) / n)
            self.spilled.append(float(counts[ParticleState.SPILLED]) / n)
            if self.dribbling is not None:
                self.states.append(fluid.particles()[1])
        if fluid.fault() is not None or self.clock >= self.motion.duration + LONGEST_TAIL:
            self.over = True
            return
        # The pour has ended when nothing is in flight and nothing more can leave.
        if counts[ParticleState.IN_FLIGHT] > 0:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = self.clock
        done = self.clock >= self.motion.duration or counts[ParticleState.IN_POURER] == 0
        self.over = done and self._still_since is not None and self.clock - self._still_since >= QUIET


def follow(fluid: FluidEngine, course: TimeLoop, cancelled: Callable[[], bool] | None) -> None:
    """Advance a scene slice by slice until it is over.

    Raises:
        SimulationCancelled: `cancelled` returned True.
    """
    begun, until = time.process_time(), course.start
    while True:
        fluid.advance(until)
        course.look(fluid, fluid.census())
        now = time.process_time()
        course.cpu_s += now - begun
        begun = now
        if course.over:
            return
        if cancelled is not None and cancelled():
            raise SimulationCancelled
        course.slices += 1
        until = course.clock


def outcome(fluid: FluidEngine, course: TimeLoop, loading: float) -> PourOutcome:
    """Count the particles by their final place.

    Args:
        fluid: the engine.
        course: of a pour that has ended.
        loading: CPU time of its setup [s].
    """
    n = course.particles
    counts, spilled_then, dribbled = fluid.census(), course.spilled, 0
    if course.dribbling is not None:
        states = np.array(course.states)
        dribbling = course.dribbling.select(states)
        placed, dribbled = dribbling.placed(states), len(dribbling.particles)
        counts = np.bincount(placed[-1], minlength=len(ParticleState)).astype(np.int32)
        spilled_then = list((placed == ParticleState.SPILLED).mean(axis=1))
    received, spilled, retained, in_flight, escaped = (
        float(counts[state]) / n
        for state in (
            ParticleState.RECEIVED,
            ParticleState.SPILLED,
            ParticleState.IN_POURER,
            ParticleState.IN_FLIGHT,
            ParticleState.ESCAPED,
        )
    )
    invalid = fluid.fault()
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
        particles=course.task.parameters.particles,
        spacing=spacing(course.task.scene.liquid.volume, course.task.parameters.particles),
        density_error=fluid.mean_compression(),
        simulated_time=fluid.time(),
        steps=fluid.steps(),
        cpu_s=course.cpu_s + loading,
        seed=course.task.seed,
        curve_times=tuple(course.times),
        curve_poured=tuple(course.poured),
        curve_spilled=tuple(map(float, spilled_then)),
        invalid=invalid,
        dribbled=dribbled / n,
        mirrored=course.mirrored,
    )


Floats = NDArray[np.float64]

LEAD = 0.3
"""Time by which the simulation begins before the level is `FREEBOARD` below the lip [s]."""

FREEBOARD = 0.12
"""Distance of the level below the lip, in opening radii: no wave that `CALM` allows reaches the lip from there."""

CALM = 0.06
"""Largest wave height, in opening radii: 2.4 mm in a cup of 40 mm, about that of a turn at 30 deg/s."""

STEP = SLICE
"""Resolution of the start [s]: a simulation begins between two slices of its time loop."""

FALL = 2e-3
"""Decrease of the tilt above which the motion is on its way back; less is tremor of an arm that was read back [rad]."""


def wave_height(velocities: Floats, step: float, radius: float) -> float:
    """Largest height of the waves in a moving cup.

    The first lateral mode is an undamped oscillator driven by accelerations, ω² = 1.84 g / R (deep liquid): |∫ a(t)
    exp(iωt) dt| / ω. A sudden start at a speed u raises u/ω, a steady acceleration a about 2 R a / (1.84 g).

    Args:
        velocities: of the cup, shape (T, 3), `step` apart; it is at rest before [m/s].
        step: [s].
        radius: R [m].

    Returns:
        Height at the wall [m].
    """
    frequency = math.sqrt(1.841 * GRAVITY / radius)
    pushes = np.diff(velocities[:, :2], axis=0, prepend=0.0)
    turned = pushes * np.exp(1j * frequency * step * np.arange(len(pushes)))[:, None]
    response = np.linalg.norm(np.abs(np.cumsum(turned, axis=0)), axis=1)
    return float(response.max()) / frequency


def calm_until(motion: Motion, pourer: Vessel, volume: float) -> float:
    """Time up to which the liquid lies level, and far enough below the lip, in the turning pourer.

    Args:
        motion: of the pourer.
        pourer: the vessel.
        volume: of the liquid [m³].

    Returns:
        A multiple of `STEP` [s]; 0 if the pour has to be simulated from its start.
    """
    times = np.arange(0.0, motion.duration + STEP, STEP)
    if len(times) < 4:
        return 0.0
    tilts = motion.tilt(times)
    begin = _last_below(pourer, volume, tilts) - round(LEAD / STEP)
    if begin <= 0:
        return 0.0
    velocities = np.diff(_middles(motion, pourer, times[: begin + 2]), axis=0) / STEP
    height = wave_height(velocities, STEP, pourer.opening_radius)
    return float(begin * STEP) if height <= CALM * pourer.opening_radius else 0.0


def is_near_lip(pourer: Vessel, volume: float, tilt: float) -> bool:
    """Whether the level is so near below the lip at a tilt [rad] that a wave may pass it; see `FREEBOARD`."""
    return level(pourer, volume, tilt) > -FREEBOARD * pourer.opening_radius


def _last_below(pourer: Vessel, volume: float, tilts: Floats) -> int:
    """Index up to which the level stays below the lip by the freeboard: bisection over the first rise of the tilt."""
    falls = np.append((np.maximum.accumulate(tilts) - tilts > FALL)[1:], True)
    low, high = 0, int(np.argmax(falls))
    if is_near_lip(pourer, volume, float(tilts[0])):
        return 0
    while high - low > 1:
        middle = (low + high) // 2
        if is_near_lip(pourer, volume, float(tilts[middle])):
            high = middle
        else:
            low = middle
    return low


def liquid_velocity(motion: Motion, pourer: Vessel, time: float) -> Floats:
    """Velocity of the pourer's centre, shape (3,) [m/s]."""
    places = _middles(motion, pourer, np.array([time, time + 1e-3]))
    return np.asarray((places[1] - places[0]) / 1e-3)


def _middles(motion: Motion, pourer: Vessel, times: Floats) -> Floats:
    """The point at half height on the pourer's axis over time, shape (T, 3) [m]."""
    poses = motion.sample(times)
    w, x, y, z = poses[:, 3:7].T
    axis = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return np.asarray(poses[:, :3] + 0.5 * (pourer.inner_floor + pourer.rim_height) * axis)


__all__ = [
    "InvalidSceneError",
    "PourSimulator",
    "SimulationCancelled",
    "check_motion",
]

SETTLING = 0.15
"""Time for the lattice to settle before the motion begins [s]."""

PLANES_KEPT = 16
VESSELS_KEPT = 32
"""Number of vessels kept, about 3 MB each; a prediction draws a new shape of uncertain vessels for each simulation."""


def check_motion(
    motion: Motion, scene: Scene, action: Action, pourer: Vessel, receiver: Vessel, error: PoseError
) -> None:
    """Refuse a motion in which the vessels touch.

    Raises:
        InvalidSceneError: with position, depth and tilt.
    """
    touching = contact_during(motion, pourer, receiver, receiver_at=(error.x, error.y, error.z))
    if touching is not None:
        contact, tilt = touching
        text = describe_contact(contact, tilt=tilt)
        raise InvalidSceneError(f"{text} ({action.display('x_offset', 'y_offset', 'height')})")


class PourSimulator:
    """Simulates pours, one after another. One per process: the engine's arrays are shared.

    Before its first pour, an engine that was never checked on this machine is checked (`engine_package.check_engine`).

    Raises:
        EngineError: the chosen engine is unknown or not installed.
    """

    def __init__(self) -> None:
        engine_name()  # refuses an unknown one before anything is prepared
        self._checked = False
        self._vessels: dict[VesselSpec, Vessel] = {}
        self._masks: dict[VesselSpec, NDArray[np.uint8]] = {}
        self._planes: dict[tuple[VesselSpec, float], NDArray[np.float32]] = {}

    def vessel(self, spec: VesselSpec) -> Vessel:
        """A vessel, built once; the last few are kept.

        Raises:
            VesselError: it cannot be built.
        """
        if spec not in self._vessels:
            if len(self._vessels) >= VESSELS_KEPT:
                oldest = next(iter(self._vessels))
                del self._vessels[oldest]
                self._masks.pop(oldest, None)
                self._planes = {key: planes for key, planes in self._planes.items() if key[0] != oldest}
            self._vessels[spec] = build_vessel(spec)
        return self._vessels[spec]

    def prepare(self, task: PourTask) -> Motion:
        """Check everything that can be refused before the simulation: load, vessels, contact. Returns the motion.

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
            InvalidSceneError: the pour is impossible.
            SimulationCancelled: `cancelled` returned True.
            WrongOutcomeError: the engine gives wrong outcomes on this machine.
        """
        motion = self.prepare(task)
        return self._pour(self.engine(), task, motion, cancelled)

    def engine(self) -> FluidEngine:
        """The engine of this process, checked.

        Raises:
            WrongOutcomeError: it gives wrong outcomes on this machine.
        """
        from sim_engine.fluid.engine import engine

        fluid = engine()
        if not self._checked:
            check_engine(lambda task: self._pour(fluid, task, self.prepare(task), None).outcome)
            self._checked = True
        return fluid

    def _pour(
        self, fluid: FluidEngine, task: PourTask, motion: Motion, cancelled: Callable[[], bool] | None
    ) -> SimulatedPour:
        begun = time.process_time()
        start = calm_until(motion, self.vessel(task.scene.pourer), task.scene.liquid.volume)
        mirrored = self.mirrors(task, motion)
        fluid.load([self.setup(task, motion, start, mirrored)])
        loading = time.process_time() - begun
        course = TimeLoop(task, motion, start, mirrored, dribbling=self._dribbling(task, motion))
        follow(fluid, course, cancelled)
        if task.frame_rate > 0.0:
            course.frames[:0] = self._level_frames(course)
            if course.dribbling is not None:
                dribbling = course.dribbling.select(np.array(course.states))
                times = np.array(course.times)
                course.frames = rivulet_frames(course.dribbling, dribbling, motion, times, course.frames)
        return SimulatedPour(outcome(fluid, course, loading), recorded_frames(course, motion, task.placement))

    def mirrors(self, task: PourTask, motion: Motion) -> bool:
        """Whether only the half y ≥ 0 of a pour is simulated, and the other half is its mirror image.

        This requires a scene that allows it, `MIRRORED_FROM` particles, a motion and a receiver without a sideways
        displacement, and vessels that are symmetric about the plane of the tilt within `SYMMETRIC` spacings.
        """
        parameters, scene = task.parameters, task.scene
        if not scene.mirrored or parameters.particles < MIRRORED_FROM or task.placement.y != 0.0:
            return False
        sideways = motion.sample(np.arange(0.0, motion.duration, SLICE))[:, [1, 4, 6]]  # y, and turns about x and z
        vessels = (self.vessel(scene.pourer), self.vessel(scene.receiver))
        return not (
            sideways.any() or any(why_whole(each, scene.liquid.volume, parameters.particles) for each in vessels)
        )

    def _dribbling(self, task: PourTask, motion: Motion) -> DribblingCourse | None:
        """What runs down the outside of the pourer; None if nothing does."""
        if task.parameters.lip_adhesion == 0.0:
            return None
        scene, error = task.scene, task.placement
        course = dribbling_course(
            motion,
            scene.liquid,
            self.vessel(scene.pourer),
            self.vessel(scene.receiver),
            adhesion=task.parameters.lip_adhesion,
            receiver_at=(error.x, error.y, error.z),
        )
        return course if course is not None and course.dribbles.any() else None

    def laid(self, task: PourTask, motion: Motion, at: float, mirrored: bool) -> NDArray[np.float32]:
        """Simulated particles at rest in the pourer in its pose at a time [s], (N, 3) in the world [m]."""
        # The lattice is laid into the upright cup; a tilt error of the grip then moves cup and liquid together.
        tilt = float(motion.tilt(np.array([at]))[0]) if at > 0.0 else 0.0
        pourer, parameters = self.vessel(task.scene.pourer), task.parameters
        volume = task.scene.liquid.volume
        local = fill(pourer, volume, parameters.particles, task.seed, parameters.wall_distance, tilt, mirrored)
        (pose,) = motion.sample(np.array([at]))
        (rotation,) = rotations(pose[None])
        placed: NDArray[np.float32] = (local @ rotation.T + pose[:3]).astype(np.float32)
        return placed

    def _level_frames(self, course: TimeLoop) -> list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]]:
        """Frames from before the simulation began, when the liquid lay level: time, positions, states."""
        task, motion = course.task, course.motion
        homes = np.full(course.particles, int(ParticleState.IN_POURER), np.uint8)
        times = np.arange(0.0, course.start - 0.5 / task.frame_rate, 1.0 / task.frame_rate)
        return [(float(t), self.laid(task, motion, float(t), course.mirrored), homes) for t in times]

    def setup(
        self, task: PourTask, motion: Motion, start: float, mirrored: bool, longest: float | None = None
    ) -> SceneSetup:
        """The scene for the engine.

        Args:
            task: of the pour.
            motion: of the pourer.
            start: time at which the simulation begins [s].
            mirrored: whether only the half y ≥ 0 is simulated.
            longest: end of the table of poses [s]; None: that of the motion.
        """
        from sim_engine.fluid.state import SUPPORT

        scene, parameters, error = task.scene, task.parameters, task.placement
        liquid = scene.liquid
        pourer, receiver = self.vessel(scene.pourer), self.vessel(scene.receiver)
        d = spacing(liquid.volume, parameters.particles)
        drift = liquid_velocity(motion, pourer, start) if start > 0.0 else np.zeros(3)
        end = motion.duration if longest is None else longest
        return SceneSetup(
            positions=self.laid(task, motion, start, mirrored),
            spacing=d,
            density=liquid.density,
            parameters=parameters,
            pourer=self._walls(scene.pourer, SUPPORT * d),
            receiver=self._walls(scene.receiver, SUPPORT * d),
            receiver_at=np.array([error.x, error.y, error.z]),
            spill_level=receiver.rim_height + error.z - d,
            poses=motion.sample(np.arange(0.0, end + LONGEST_TAIL + 0.1, POSE_STEP)),
            settling=SETTLING,
            start=start,
            drift=(float(drift[0]), float(drift[1]), float(drift[2])),
            viscosity=liquid.kinematic_viscosity * parameters.viscosity_factor if liquid.is_thick else 0.0,
            tension=liquid.surface_tension if liquid.is_thick else None,
            contact_angle=liquid.contact_angle,
            mirrored=mirrored,
        )

    def _walls(self, spec: VesselSpec, support: float) -> SolidWalls:
        """The walls of a vessel; the last few planes are kept, because calibration changes θ repeatedly."""
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


def recorded_frames(course: TimeLoop, motion: Motion, error: PoseError) -> RecordedFrames | None:
    """The frames of the whole liquid, if any were requested."""
    if not course.frames:
        return None
    times = np.array([t for t, _, _ in course.frames])
    frames = [with_mirror_image(p, s) if course.mirrored else (p, s) for _, p, s in course.frames]
    at = (error.x, error.y, error.z)
    return RecordedFrames(times, [p for p, _ in frames], [s for _, s in frames], motion.sample(times), at)


def with_mirror_image(
    positions: NDArray[np.float32], states: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """All particles of a mirrored pour, from the positions (N, 3) and states (N,) of the simulated half."""
    return np.concatenate([positions, positions * np.array([1, -1, 1], np.float32)]), np.concatenate([states, states])
