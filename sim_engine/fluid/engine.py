"""Taichi's start and end, and the arrays of one process. The only place that calls `ti.init`."""

import contextlib
import io

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim_engine.cache import cache_directory
from sim_engine.fluid.forces import forces_interval
from sim_engine.fluid.kernels import cohesion_acceleration
from sim_engine.fluid.state import SUPPORT, VESSELS, FluidState
from sim_engine.fluid.step import GRAVITY, LONGEST_STEP, Stepper
from sim_engine.outcome import ParticleState
from sim_engine.vessel.sdf import SignedDistanceGrid

CAPACITY = 50_000
"""Particles of a scene; one size for all, so that kernels are compiled once. Memory that is not used is not touched."""

import os as _os
NATURAL_WALL_DISTANCE = float(_os.environ.get('NWD','0.4'))
"""Spacings at which the unshifted wall integral holds liquid off a wall, measured on a cup at rest."""

POSE_STEP = 1e-3
"""Rows of the pose table are so far apart [s]."""


@ti.data_oriented
class FluidEngine:
    """One scene's arrays, loaded and advanced from Python. One per process (`engine()`)."""

    def __init__(self) -> None:
        # Taichi says on which architecture it starts, on stdout, which is for results alone.
        with contextlib.redirect_stdout(io.StringIO()):
            ti.init(
                arch=ti.cpu,
                cpu_max_num_threads=1,
                offline_cache=True,
                offline_cache_file_path=str(cache_directory() / "kernels"),
                log_level=ti.ERROR,
                enable_fallback=False,
            )
        self.state = FluidState(1, CAPACITY)
        self.stepper = Stepper(self.state)
        self._grids = np.zeros(0, np.float32)
        self._planes = np.zeros(0, np.float32)
        self._cavities = np.zeros(0, np.uint8)
        self._poses = np.zeros((1, 2, 7), np.float32)

    def load(
        self,
        positions: NDArray[np.float32],
        *,
        spacing: float,
        tension: float,
        density: float,
        viscosity: float,
        friction: float,
        wall_distance: float,
        lip_drop: float,
        grids: list[SignedDistanceGrid],
        planes: list[NDArray[np.float32]],
        masks: list[NDArray[np.uint8]],
        walls: list[float],
        rims: list[float],
        receiver_at: NDArray[np.float64],
        spill_level: float,
        poses: NDArray[np.float64],
        settling: float,
        start: float = 0.0,
        drift: NDArray[np.float64] | None = None,
        gravity: float = GRAVITY,
        longest_step: float = LONGEST_STEP,
    ) -> None:
        """Set up a scene.

        Args:
            positions: (N, 3) in the world [m].
            spacing: d [m].
            tension: surface tension that cohesion is scaled to [N/m].
            density: of the liquid [kg/m³].
            viscosity: XSPH rate [1/s].
            friction: Coulomb coefficient.
            wall_distance: where liquid comes to rest before a wall, in spacings.
            lip_drop: rims are lower for particles by so many spacings, at most `LARGEST_LIP_DROP`.
            planes: distance of the plane that is as solid as the walls, at the grids' nodes [m].
            grids, masks, walls, rims: of pourer and receiver; a mask is 1 where a particle counts as inside; thinnest
                wall [m]; height of the lip in the vessel's frame [m].
            receiver_at: (3,) [m].
            spill_level: below it and in no vessel a particle is spilled [m].
            poses: (T, 7) of the pourer, `POSE_STEP` apart, from time 0 on.
            settling: the lattice settles for so long before `start`, in the pose of that time [s].
            start: time at which the pourer moves off [s].
            drift: velocity that all liquid is given at `start`, (3,) [m/s].
            gravity: downwards [m/s²].
            longest_step: [s]; gravity, spacing and speeds may shorten it further.
        """
        f = self.state
        count = len(positions)
        if count > f.capacity:
            raise ValueError(f"{count} particles; at most {f.capacity}")
        f.particles[0], f.spacing[0] = count, spacing
        f.attraction[0] = cohesion_acceleration(tension, density, spacing, SUPPORT * spacing)
        f.viscosity[0], f.friction[0] = viscosity, friction
        f.lip_drop[0] = lip_drop
        f.waited[0] = 0.0
        f.wait[0] = forces_interval(viscosity, tension, density, spacing)
        f.gravity[0], f.longest_step[0] = gravity, longest_step
        f.wall_shift[0] = (wall_distance - NATURAL_WALL_DISTANCE) / SUPPORT
        offset = 0
        for b in range(VESSELS):
            f.grid_offset[0, b], f.grid_size[0, b] = offset, list(grids[b].values.shape)
            f.grid_origin[0, b], f.grid_spacing[0, b] = list(grids[b].origin), grids[b].spacing
            f.wall[0, b], f.rim[0, b] = walls[b], rims[b]
            offset += grids[b].values.size
        self._grids = np.concatenate([g.values.ravel() for g in grids]).astype(np.float32, copy=False)
        self._planes = np.concatenate([p.ravel() for p in planes]).astype(np.float32, copy=False)
        self._cavities = np.concatenate([m.ravel() for m in masks]).astype(np.uint8, copy=False)
        f.origin[0, 1], f.turn[0, 1] = list(receiver_at), np.eye(3, dtype=np.float32)
        f.spill_level[0] = spill_level
        self._poses = np.ascontiguousarray(poses[None], dtype=np.float32)
        f.table_step[0], f.table_length[0] = POSE_STEP, len(poses)
        f.time[0], f.start[0], f.compression[0] = start - settling, start, 0.0
        f.drift[0] = [0.0, 0.0, 0.0] if drift is None else list(drift)
        f.steps[0], f.rebuilds[0], f.iterations[0], f.fault[0] = 0, 0, 0, 0
        self._put(np.ascontiguousarray(positions, dtype=np.float32))
        self.stepper.begin(self._poses)

    @ti.kernel
    def _put(self, positions: ti.types.ndarray(dtype=ti.f32, ndim=2)):
        f = self.state
        ti.loop_config(serialize=True)
        for i in range(positions.shape[0]):
            x = ti.Vector([positions[i, 0], positions[i, 1], positions[i, 2]])
            f.x[0, i] = x
            f.x0[0, i] = x
            f.x_listed[0, i] = x
            f.v[0, i] = ti.Vector([0.0, 0.0, 0.0])
            f.pressure[0, i] = 0.0
            f.density[0, i] = 1.0
            f.phi[0, i] = ti.Vector([0.0, 0.0])
            f.push[0, i] = ti.Vector([0.0, 0.0])
            f.home[0, i] = 0
            f.name[0, i] = i
            f.count[0, i] = 0
            f.first[0, i] = 0

    @ti.kernel
    def _get(self, positions: ti.types.ndarray(dtype=ti.f32, ndim=2), homes: ti.types.ndarray(dtype=ti.u8, ndim=1)):
        f = self.state
        ti.loop_config(serialize=True)
        for i in range(f.particles[0]):
            k = f.name[0, i]
            for c in ti.static(range(3)):
                positions[k, c] = f.x[0, i][c]
            homes[k] = ti.cast(f.home[0, i], ti.u8)

    def advance(self, until: float) -> None:
        """Run until the scene's time reaches `until` [s] or a fault stops it."""
        self.stepper.advance(until, self._grids, self._planes, self._cavities, self._poses)

    def census(self) -> NDArray[np.int32]:
        """Particles in each `ParticleState`, shape (5,)."""
        counts = np.zeros(len(ParticleState), np.int32)
        self.stepper.census(0, counts)
        return counts

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Positions (N, 3) in the world [m] and states (N,), in the order in which they were loaded."""
        n = int(self.state.particles[0])
        positions, homes = np.empty((n, 3), np.float32), np.empty(n, np.uint8)
        self._get(positions, homes)
        return positions, homes

    def velocities(self) -> NDArray[np.float32]:
        """Velocities (N, 3) [m/s], in the order in which they were loaded."""
        n = int(self.state.particles[0])
        out = np.empty((n, 3), np.float32)
        out[self.state.name.to_numpy()[0, :n]] = self.state.v.to_numpy()[0, :n]
        return out

    @property
    def time(self) -> float:
        """[s]."""
        return float(self.state.time[0])

    @property
    def steps(self) -> int:
        """Time steps so far."""
        return int(self.state.steps[0])

    @property
    def fault(self) -> str | None:
        """Why the solver stopped, if it did."""
        return {
            0: None,
            1: "neighbour lists overflowed: the liquid was compressed beyond any physical density",
            2: "a particle's velocity left all bounds: the solver diverged",
        }[int(self.state.fault[0])]

    @property
    def mean_compression(self) -> float:
        """Mean over the steps of the interior particles' max(ρ/ρ₀ − 1, 0)."""
        return float(self.state.compression[0]) / max(self.steps, 1)


_engine: FluidEngine | None = None


def engine() -> FluidEngine:
    """The process' engine; the first call starts Taichi and allocates."""
    global _engine
    if _engine is None:
        _engine = FluidEngine()
    return _engine


def close_engine() -> None:
    """End Taichi. This is also what writes compiled kernels to the cache."""
    global _engine
    if _engine is not None:
        _engine = None
        ti.reset()
