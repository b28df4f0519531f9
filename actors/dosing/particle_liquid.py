"""Particles as the liquid of a dose: `ParticleFlow` follows poses of the pourer.

`ParticleLiquid` pours them on `actors.dosing.virtual_dosing_bench`, whose arm turns the cup. Cup, receiver and
placement are those of a scene: what misses the receiver is spilled, and nothing else is assumed about the flow.
`dose_task` is the `PourTask` of a dose.

The balance feels the weight of what has arrived and the impact of what arrives, as a scale under a stream does: in a
steady flow the impact weighs as much as the liquid in the air.

Limitations: every dose begins with an empty receiver, which does not run over; what falls onto a tray has no impact; a
film thinner than a particle does not flow.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from actors.dosing.virtual_dosing_bench import TIME_STEP, VirtualDosingBench
from actors.interfaces import InvalidActionError, LaboratoryError
from sim_engine.action import Action
from sim_engine.collision import rotations
from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import SimulationParameters
from sim_engine.live_pour import LivePours
from sim_engine.motion import recorded_motion
from sim_engine.outcome import RecordedFrames
from sim_engine.scene import PoseError, PourTask, SampledMotion, Scene
from sim_engine.vessel.vessel import build_vessel

Floats = NDArray[np.float64]

CALM, UNMOVED = 1.0, 1e-6
"""A pourer that has stood still, while nothing flowed, for so long [s] needs no simulation until it moves by more [m
and parts of a quaternion]."""

LANDING, LANDING_STEP = 0.5, 0.02
"""Longest time after a dose until everything has landed, and its steps [s]."""

FRAME_INTERVAL = 0.1
"""Time between two frames of the particles for the live view [s]."""

IMPACT_TIME = 0.1
"""Time over which the impact of single particles is averaged [s]."""

LEAST_PARTICLES = 30
"""Smallest number of particles of a dose; one of them is then 3 % of the amount."""


def dose_task(
    scene: Scene, action: Action, content: float, theta: SimulationParameters, error: PoseError, seed: int
) -> PourTask:
    """The pour of a dose. Its particles have the same size however full the source is.

    Args:
        scene: with the load of a full source.
        action: whose placement the pourer has, if its poses do not come from elsewhere.
        content: of the source now [kg].
        theta: of the bench; its particles are those of a full source.
        error: of the placement; the tilt is that of the poses.
        seed: of the first positions.
    """
    info = SimulationParameters.info()["particles"]
    particles = round(theta.particles * content / scene.liquid.mass)
    liquid = scene.liquid.model_copy(update={"mass": content})
    theta = theta.model_copy(update={"particles": int(min(max(particles, info.lower), info.upper))})
    half = replace(scene, liquid=liquid, mirrored=True)  # if it may be: see `PourSimulator.mirrors`
    return PourTask(half, action, theta, seed, pose_error=PoseError(x=error.x, y=error.y, z=error.z))


def check_particles(scene: Scene, amount: float, theta: SimulationParameters) -> None:
    """Check that a dose has enough particles.

    Args:
        scene: with the load of a full source.
        amount: of the smallest dose [kg].
        theta: of the bench.

    Raises:
        InvalidActionError: it has less than `LEAST_PARTICLES`.
    """
    one = scene.liquid.mass / theta.particles
    if amount < LEAST_PARTICLES * one:
        needed = math.ceil(1e-2 * LEAST_PARTICLES * scene.liquid.mass / amount) * 100
        raise InvalidActionError(
            f"a dose of {1e3 * amount:.4g} g is {amount / one:.1f} particles of the bench's liquid, of which "
            f"{scene.pourer.name} holds {theta.particles} in {1e3 * scene.liquid.mass:.4g} g, and needs "
            f"{LEAST_PARTICLES}: set 'particles' in 'bench.liquid' to {needed} or more, or 'doses: formula' in 'bench'"
        )


class ParticleFlow:
    """Particles of one dose that follow poses of the pourer. While it stands still and nothing flows, no time passes in
    the simulation.

    Args:
        task: scene with the true content, placement, θ and seed.
        pours: simulates them.
        pose: of the pourer at first (7,).
        watched: whether frames of the particles are kept for a live view.

    Attributes:
        received, spilled, left: masses in the receiver, next to it, and in the pourer [kg].

    Raises:
        LaboratoryError: the pour is impossible.
    """

    def __init__(self, task: PourTask, pours: LivePours, pose: Floats, *, watched: bool = False) -> None:
        self._pours, self._watched = pours, watched
        pours.begin(task, pose)
        self._pose, self._time, self._skipped = pose, 0.0, 0.0
        self._active = 0.0  # last time at which the pourer moved or liquid flowed
        self._in_flight = self.received = self.spilled = 0.0
        self.left = self._content = task.scene.liquid.mass
        self._lip = build_vessel(task.scene.pourer).meridians[:, -1]  # points of its crest
        placed = task.placement
        self._receiver_at = (placed.x, placed.y, placed.z)
        self._opening = build_vessel(task.scene.receiver).rim_height + placed.z
        self._arrived = deque([(0.0, 0.0)])  # times [s] and masses in the receiver [kg]
        self._next_frame = 0.0
        self._frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8], Floats]] = []

    def follow(self, times: Floats, poses: Floats) -> float:
        """Pour along poses (T, 7) of the pourer at times since the begin [s].

        Returns:
            Load on the balance without the receiver, with the impact of the stream [kg].

        Raises:
            LaboratoryError: the simulation failed.
        """
        if np.abs(poses - self._pose).max() > UNMOVED:
            self._active = float(times[-1])
        if times[-1] - self._active > CALM:
            self._skipped += float(times[-1]) - self._time
        else:
            self._advance(times - self._skipped, poses)
        self._time, self._pose = float(times[-1]), poses[-1]
        if self._watched and self._time >= self._next_frame:
            self._next_frame = self._time + FRAME_INTERVAL
            self._frames.append((self._time, *self._pours.particles(), self._pose))
        return self.received + self._impact()

    def land(self) -> None:
        """Let everything land that still falls. A drop that hangs is left. Raises like `follow`."""
        end = self._time + LANDING
        while self._in_flight > 0.0 and self._time < end:
            self._time += LANDING_STEP
            self._advance(np.array([self._time - self._skipped]), self._pose[None])
        self.left = self._content - self.received - self.spilled

    def frames(self) -> RecordedFrames | None:
        """Frames since the last call; None without new ones."""
        frames, self._frames = self._frames, []
        if not frames:
            return None
        times, positions, states, poses = zip(*frames, strict=True)
        return RecordedFrames(np.array(times), list(positions), list(states), np.array(poses), self._receiver_at)

    def _impact(self) -> float:
        """Force on the receiver from what has just entered its opening, as a mass [kg]."""
        # m' v / g with v = √(2 g h): a free fall from rest at the lip's lowest point to the opening; what is below the
        # opening counts with its whole weight, also while it falls
        arrived = self._arrived
        arrived.append((self._time, self.received))
        while len(arrived) > 2 and arrived[1][0] <= self._time - IMPACT_TIME + 1e-9:
            arrived.popleft()
        (begin, before), (end, now) = arrived[0], arrived[-1]
        if now <= before:
            return 0.0
        lip = float(self._pose[2] + (self._lip @ rotations(self._pose[None])[0].T)[:, 2].min())
        return (now - before) / (end - begin) * math.sqrt(2.0 * max(lip - self._opening, 0.0) / GRAVITY)

    def _advance(self, times: Floats, poses: Floats) -> None:
        state = self._pours.advance(times, poses)
        if state.invalid is not None:
            raise LaboratoryError(f"the liquid of the dose could not be simulated: {state.invalid}")
        if (state.in_flight, state.in_pourer) != (self._in_flight, self.left):  # a drop that hangs changes neither
            self._active = float(times[-1]) + self._skipped
        self._in_flight, self.received, self.spilled = state.in_flight, state.received, state.spilled
        self.left = state.in_pourer


class ParticleLiquid:
    """The liquid of one dose of a `VirtualDosingBench`, in steps of `TIME_STEP`.

    Args:
        bench: whose cup's content changes.
        pours: simulates it.
        task: scene with the bench's content, placement, θ and seed. The pourer turns about the scene's pivot.
        show: receives frames of the particles for a live view.

    Attributes:
        received, spilled: in the receiver and next to it [kg].
        flow: past the lip in the last 0.1 s [kg/s].
        first_flow, last_flow: times of the first and the last outflow [s]; infinity before.
    """

    def __init__(
        self,
        bench: VirtualDosingBench,
        pours: LivePours,
        task: PourTask,
        show: Callable[[RecordedFrames], None] | None = None,
    ) -> None:
        self._bench, self._task, self._show = bench, task, show
        self._vessels = build_vessel(task.scene.pourer), build_vessel(task.scene.receiver)
        self._tilt = -bench.grip
        self._k = 0
        self._particles = ParticleFlow(task, pours, self._moved(self._tilt).poses[0], watched=show is not None)
        self._out = [0.0] * max(round(0.1 / TIME_STEP), 1)
        self.received = self.spilled = self.flow = 0.0
        self.first_flow = self.last_flow = math.inf

    def step(self, tilt: float, turned: float, *, missed: bool = False) -> float:
        """See `actors.dosing.virtual_dosing_bench.PouredLiquid`.

        Raises:
            LaboratoryError: the simulation failed.
        """
        assert not missed, "where the stream lands is simulated"
        self._k += 1
        moved = self._moved(tilt - self._bench.grip)
        load = self._particles.follow(moved.times[1:], moved.poses[1:])
        if self._show is not None and (frames := self._particles.frames()) is not None:
            self._show(frames)
        self._note()
        return load

    def at_rest(self) -> float:
        """See `actors.dosing.virtual_dosing_bench.PouredLiquid`."""
        self._particles.land()
        self._note()
        return self.received

    def _moved(self, tilt: float) -> SampledMotion:
        """The motion of the cup to its next tilt in a step; the first pose is the present one."""
        tilts, self._tilt = np.array([self._tilt, tilt]), tilt
        task, times = self._task, np.array([0.0, TIME_STEP])
        motion = recorded_motion(task.scene, task.action, *self._vessels, times, tilts)
        return SampledMotion(motion.times + (self._k - 1) * TIME_STEP, motion.poses)

    def _note(self) -> None:
        particles, time = self._particles, self._k * TIME_STEP
        out = self._task.scene.liquid.mass - particles.left
        if out > self._out[-1]:
            self.first_flow, self.last_flow = min(self.first_flow, time), time
        self.flow = (out - self._out[0]) / (TIME_STEP * len(self._out))
        self._out = [*self._out[1:], out]
        self.received, self.spilled = particles.received, particles.spilled
        self._bench.volume = particles.left / self._bench.liquid.density
