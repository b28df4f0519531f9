"""A pour whose motion is decided while it runs: poses of the pourer in, masses and particles out.

`LivePour` runs in the process' engine, beside a `PourSimulator` whose vessels it uses. It starts as late as a planned
pour does (`sim_engine.simulator`: quiescent start), which it knows once the level is about to reach the lip, from the
poses that it has kept. The liquid is bit for bit that of the same motion given beforehand.

Limitations: nothing runs down the outside of the pourer (`lip_adhesion`), because that is decided from a whole motion.
Vessels that touch are not found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_engine.errors import InvalidSceneError
from sim_engine.fluid.scene_setup import POSE_STEP
from sim_engine.outcome import ESCAPED_LIMIT, ParticleState
from sim_engine.scene import PourTask, SampledMotion
from sim_engine.simulator import FALL, SLICE, PourSimulator, calm_until, is_near_lip, with_mirror_image

if TYPE_CHECKING:
    from sim_engine.fluid.engine import FluidEngine

Floats = NDArray[np.float64]

LIVE_SLICE = SLICE / 4.0
"""Simulated time of one call of the solver [s]."""

BEHIND = 5e-3
"""Time by which the liquid stays behind the last pose [s]: the longest step of the solver and one row of its table of
poses, so that no step needs a pose that is not known yet."""

IN_PLANE = 1e-4
"""Largest displacement [m] and turn [parts of a quaternion] out of the plane of symmetry that do not count. An arm that
turns a vessel in this plane is within a tenth of it."""

LONGEST = 120.0
"""Longest live pour [s]; its table of poses takes 3 MB."""


@dataclass(frozen=True)
class LiveState:
    """Where the liquid of a live pour is.

    Attributes:
        time: reached by the liquid [s].
        in_pourer, in_flight, received, spilled: masses [kg]; their sum is the load, apart from what has escaped through
            walls.
        invalid: why the simulation must not be used; None if it may.
    """

    time: float
    in_pourer: float
    in_flight: float
    received: float
    spilled: float
    invalid: str | None = None


class LivePour:
    """One pour. While it runs, its process simulates nothing else.

    Args:
        simulator: of this process; its vessels are used.
        task: scene, placement, θ and seed; `motion` and `frame_rate` are ignored.
        pose: of the pourer at time 0, in the scene's frame (7,): x y z [m], qw qx qy qz.
        mirrored: whether only the half y ≥ 0 is simulated; the pourer then moves in the plane of symmetry, as far as
            `IN_PLANE`.

    Raises:
        InvalidSceneError: the liquid does not fit, or something of the task cannot be simulated live.
    """

    def __init__(self, simulator: PourSimulator, task: PourTask, pose: Floats, *, mirrored: bool = False) -> None:
        if task.parameters.lip_adhesion > 0.0:
            raise InvalidSceneError(
                "what runs down the outside of the pourer is decided from a whole motion, and not simulated in a pour "
                "that is decided while it runs: set lip_adhesion to 0"
            )
        self._simulator, self._task, self._mirrored = simulator, task, mirrored
        self._times, self._poses = np.zeros(1), self._possible(pose)
        self._highest, self._seen = -np.inf, 0  # of the tilts at multiples of SLICE, and their number
        self._fluid: FluidEngine | None = None
        self._load = self._slices = 0

    def advance(self, times: Floats, poses: Floats) -> LiveState:
        """Move the pourer along some more poses, and the liquid up to `BEHIND` of the last one.

        Args:
            times: increasing, after the last one given [s].
            poses: of the pourer, (T, 7); interpolated between them.

        Raises:
            ValueError: the times do not increase or are later than `LONGEST`, or a mirrored pourer left its plane.
            RuntimeError: another pour was simulated in this process meanwhile.
        """
        poses = self._possible(poses)
        before = self._times[-1]
        self._times, self._poses = np.append(self._times, times), np.concatenate([self._poses, poses])
        motion = SampledMotion(self._times, self._poses)
        if motion.duration > LONGEST:
            raise ValueError(f"a live pour lasts {LONGEST:g} s at most, not {motion.duration:.4g} s")
        if self._fluid is None:
            if not self._begins(motion):
                return self.state
            self._start(motion)
        else:
            first = int(np.ceil(before / POSE_STEP))
            rows = motion.sample(POSE_STEP * np.arange(first, int(motion.duration / POSE_STEP) + 1, dtype=float))
            self._engine.follow(first, rows)
        self._times, self._poses = self._times[-1:], self._poses[-1:]  # all that the next rows need
        while (self._slices + 1) * LIVE_SLICE <= motion.duration - BEHIND:
            self._slices += 1
            self._engine.advance(self._slices * LIVE_SLICE)
        return self.state

    @property
    def state(self) -> LiveState:
        """Where the liquid is now."""
        mass = self._task.scene.liquid.mass
        if self._fluid is None:
            return LiveState(float(self._times[-1]), mass, 0.0, 0.0, 0.0)
        counts = self._engine.census()
        shares = mass * counts / counts.sum()
        invalid = self._engine.fault()
        if invalid is None and counts[ParticleState.ESCAPED] > ESCAPED_LIMIT * counts.sum():
            invalid = "particles crossed vessel walls"
        in_pourer, in_flight, received, spilled = map(float, shares[: ParticleState.ESCAPED])
        return LiveState(self._engine.time(), in_pourer, in_flight, received, spilled, invalid)

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Positions (N, 3) in the scene's frame [m] and states (N,) of all particles."""
        if self._fluid is None:
            end = float(self._times[-1])
            motion = SampledMotion(np.append(self._times, end + 1.0), np.append(self._poses, self._poses[-1:], axis=0))
            laid = self._simulator.laid(self._task, motion, end, self._mirrored)
            particles = laid, np.full(len(laid), int(ParticleState.IN_POURER), np.uint8)
        else:
            particles = self._engine.particles()
        return with_mirror_image(*particles) if self._mirrored else particles

    def _possible(self, poses: Floats) -> Floats:
        poses = np.asarray(poses, dtype=float).reshape(-1, 7)
        if not self._mirrored:
            return poses
        inside = in_plane(poses)
        if inside is None:
            raise ValueError("a mirrored pourer moves in its plane of symmetry: y, qx and qz are 0")
        return inside

    @property
    def _engine(self) -> FluidEngine:
        assert self._fluid is not None
        if self._fluid.loads != self._load:
            raise RuntimeError("another pour was simulated in this process while a live pour ran")
        return self._fluid

    def _begins(self, motion: SampledMotion) -> bool:
        """Whether the level is near the lip, or the motion on its way back: from then on the start is known."""
        vessel, volume = self._simulator.vessel(self._task.scene.pourer), self._task.scene.liquid.volume
        grid: Floats = SLICE * np.arange(self._seen, int(motion.duration / SLICE + 1e-9) + 1, dtype=float)
        self._seen += len(grid)
        for tilt in map(float, motion.tilt(grid)):
            if self._highest - tilt > FALL:
                return True
            if tilt > self._highest and is_near_lip(vessel, volume, tilt):
                return True
            self._highest = max(self._highest, tilt)
        return False

    def _start(self, motion: SampledMotion) -> None:
        simulator, task = self._simulator, self._task
        start = calm_until(motion, simulator.vessel(task.scene.pourer), task.scene.liquid.volume)
        fluid = simulator.engine()
        fluid.load([simulator.setup(task, motion, start, self._mirrored, LONGEST)])
        self._fluid, self._load, self._slices = fluid, fluid.loads, round(start / LIVE_SLICE)


def in_plane(poses: Floats) -> Floats | None:
    """Poses (T, 7), moved into the plane of symmetry; None if one of them is farther away than `IN_PLANE`."""
    sideways = [1, 4, 6]  # y, and turns about x and z
    if np.abs(poses[:, sideways]).max() > IN_PLANE:
        return None
    inside = poses.copy()
    inside[:, sideways] = 0.0
    return inside


class LivePours(Protocol):
    """One pour after another; `actors.simulators.live_worker` has them in a process of its own."""

    def begin(self, task: PourTask, pose: Floats) -> None:
        """Begin a pour; see `LivePour`. The one before is over. It is mirrored if its scene and
        its vessels allow it; the pourer then moves in its plane of symmetry.
        """
        ...

    def advance(self, times: Floats, poses: Floats) -> LiveState:
        """See `LivePour.advance`."""
        ...

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """See `LivePour.particles`."""
        ...

    def close(self) -> None:
        """End it. May be called again."""
        ...


__all__ = ["LIVE_SLICE", "LivePour", "LivePours", "LiveState", "in_plane"]
