"""The engine: starts and ends `ti`, and holds the arrays of one process. Only this module calls `ti.init`."""

import contextlib
import io
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_engine.collision import rotations
from sim_engine.fluid.compiler import KERNELS, NAME, ti
from sim_engine.fluid.engine_startup import imports, look_up_quickly, uncollected
from sim_engine.fluid.scene_setup import POSE_STEP, SceneSetup, pose_at
from sim_engine.resources import cache_directory

with imports(NAME):
    from sim_engine.fluid.state import CELLS, LEAST_CELLS, LIST_RESERVE, NEIGHBOURS, FluidState, of_parameters
    from sim_engine.fluid.step import FACTS, LONGEST_STEP, STATES, Stepper

POOL, MOST_SCENES = 50_000, 64
"""Capacity of a process: particles, and scenes. The largest scene has 50,000 particles, or half of them and their
images."""

FAULTS = {
    0: None,
    1: "neighbour lists overflowed: the liquid was compressed beyond any physical density",
    2: "a particle's velocity left all bounds: the solver diverged",
}


@ti.data_oriented
class FluidEngine:
    """The arrays of scenes, loaded and advanced from Python. One per process (`engine()`).

    Scenes of one load are independent: each gives bit for bit the results that it gives alone.
    """

    def __init__(self) -> None:
        start()
        self.pool, self.most_scenes = POOL, MOST_SCENES
        self.state = FluidState(self.most_scenes, self.pool)
        self.stepper = Stepper(self.state)
        self.scenes = self.loads = 0
        self._tables, self._cavities = np.zeros(1, np.float32), np.zeros(1, np.uint8)
        self._pose_tables: list[tuple[int, int]] = []
        self._thick: list[bool] = []
        self._ranges: list[tuple[int, int]] = []
        self._facts = np.zeros((0, STATES + len(FACTS)))

    def load(self, setups: Sequence[SceneSetup]) -> None:
        """Set up scenes, which replace the loaded ones.

        Raises:
            ValueError: they have more particles than there is room for.
        """
        blocks = [len(setup.positions) * (1 + setup.mirrored) for setup in setups]
        if sum(blocks) > self.pool:
            raise ValueError(f"{sum(blocks)} particles; at most {self.pool}")
        tables, insides = _Pool[np.float32](), _Pool[np.uint8]()
        begin = 0
        scenes: list[dict[str, ArrayLike]] = []
        for s, setup in enumerate(setups):
            count = len(setup.positions)
            both = (setup.pourer, setup.receiver)
            pose = pose_at(setup.poses, setup.start)
            origins, turns = [pose[:3], setup.receiver_at], [*rotations(pose[None]), np.eye(3)]
            scenes.append(
                {
                    **of_parameters(setup),
                    "begin": begin,
                    "particles": count,
                    "spacing": setup.spacing,
                    "list_begin": begin * NEIGHBOURS + s * LIST_RESERVE,
                    "cells_begin": begin * CELLS + s * (LEAST_CELLS + 2),
                    "cells": count * CELLS + LEAST_CELLS,
                    "gravity": setup.gravity,
                    "longest_step": LONGEST_STEP if setup.longest_step is None else setup.longest_step,
                    "grid_offset": [tables.add(walls.grid.values) for walls in both],
                    "plane_offset": [tables.add(walls.plane) for walls in both],
                    "cavity_offset": [insides.add(walls.inside) for walls in both],
                    "grid_size": [walls.grid.values.shape for walls in both],
                    "grid_origin": [walls.grid.origin for walls in both],
                    "grid_spacing": [walls.grid.spacing for walls in both],
                    "arm": setup.pourer.grid.reach,
                    "wall": [walls.thickness for walls in both],
                    "rim": [walls.rim for walls in both],
                    "origin": origins,
                    "origin0": origins,
                    "turn": turns,
                    "turn0": turns,
                    "spill_level": setup.spill_level,
                    "poses_begin": tables.add(setup.poses.astype(np.float32)),
                    "table_step": POSE_STEP,
                    "table_length": len(setup.poses),
                    "time": setup.start - setup.settling,
                    "start": setup.start,
                    "drift": setup.drift,
                    "mirrored": setup.mirrored,
                    "apart": setup.apart,
                    "moving": count,
                    "stale": 1,
                    "dt": LONGEST_STEP,
                }
            )
            begin += blocks[s]
        self._tables, self._cavities = tables.array(), insides.array()
        self._pose_tables = [
            (int(np.asarray(row["poses_begin"])), len(setup.poses)) for row, setup in zip(scenes, setups, strict=True)
        ]
        self.loads += 1
        self.scenes = len(setups)
        begins = np.cumsum([0, *blocks])
        self._ranges = [(int(first), len(setup.positions)) for first, setup in zip(begins, setups, strict=False)]
        self._thick = [setup.viscosity > 0.0 for setup in setups]
        positions = np.zeros((begin, 3), np.float32)
        for (first, count), setup in zip(self._ranges, setups, strict=True):
            positions[first : first + count] = setup.positions
        self._load(self.state.table.rows(scenes), positions)
        self._facts = np.full((self.scenes, STATES + len(FACTS)), np.nan)

    @ti.kernel
    def _load(
        self,
        rows: ti.types.ndarray(dtype=ti.f64, ndim=2),
        positions: ti.types.ndarray(dtype=ti.f32, ndim=2),
    ):
        f = self.state
        ti.loop_config(serialize=True)
        for s in range(rows.shape[0]):
            f.table.write(s, rows)
            for i in range(f.begin[s], f.begin[s] + f.particles[s]):
                x = ti.Vector([positions[i, 0], positions[i, 1], positions[i, 2]])
                f.x[i] = x
                f.x0[i] = x
                f.x_listed[i] = x
                f.v[i] = ti.Vector([0.0, 0.0, 0.0])
                f.pressure[i] = 0.0
                f.density[i] = 1.0
                f.phi[i] = ti.Vector([0.0, 0.0])
                f.push[i] = ti.Vector([0.0, 0.0])
                f.sag[i] = ti.Vector([0.0, 0.0])
                f.home[i] = 0
                f.name[i] = i - f.begin[s]
                f.count[i] = 0
                f.first[i] = 0

    @ti.kernel
    def _get(
        self,
        begin: ti.i32,
        count: ti.i32,
        positions: ti.types.ndarray(dtype=ti.f32, ndim=2),
        velocities: ti.types.ndarray(dtype=ti.f32, ndim=2),
        homes: ti.types.ndarray(dtype=ti.u8, ndim=1),
    ):
        f = self.state
        ti.loop_config(serialize=True)
        for i in range(begin, begin + count):
            k = f.name[i]
            for c in ti.static(range(3)):
                positions[k, c] = f.x[i][c]
                velocities[k, c] = f.v[i][c]
            homes[k] = ti.cast(f.home[i], ti.u8)

    def advance(self, until: float, scene: int = 0) -> None:
        """Advance one scene until its time reaches `until` [s] or a fault stops it."""
        self.stepper.advance(scene, until, self._tables, self._cavities, self._facts, self._thick[scene])
        while self._fact("open", scene):
            self.stepper.cohere(scene, scene + 1)
            self.stepper.advance(scene, until, self._tables, self._cavities, self._facts, self._thick[scene])

    def follow(self, first: int, poses: NDArray[np.float64], scene: int = 0) -> None:
        """Replace rows of a scene's table of poses, from one that the scene has not reached; the last one goes on.

        Args:
            first: row, of time `first` · `POSE_STEP`.
            poses: (T, 7), see `SceneSetup`.
            scene: its index.
        """
        begin, rows = self._pose_tables[scene]
        table = self._tables[begin : begin + 7 * rows].reshape(rows, 7)
        table[first : first + len(poses)] = poses
        table[first + len(poses) :] = poses[-1]

    def census(self, scene: int = 0) -> NDArray[np.int32]:
        """Particles in each `ParticleState`, shape (5,)."""
        counts: NDArray[np.int32] = self._row(scene)[:STATES].astype(np.int32)
        return counts

    def _copies(self, scene: int) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        begin, n = self._ranges[scene]
        copies = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty(n, np.uint8)
        self._get(begin, n, *copies)
        return copies

    def particles(self, scene: int = 0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Positions (N, 3) in the world [m] and states (N,), in the order in which they were loaded."""
        positions, _, homes = self._copies(scene)
        return positions, homes

    def velocities(self, scene: int = 0) -> NDArray[np.float32]:
        """Velocities (N, 3) [m/s], in the order in which they were loaded."""
        return self._copies(scene)[1]

    def _row(self, scene: int) -> NDArray[np.float64]:
        if np.isnan(self._facts[scene, 0]):
            self.advance(-np.inf, scene)
        row: NDArray[np.float64] = self._facts[scene]
        return row

    def _fact(self, name: str, scene: int) -> float:
        return float(self._row(scene)[STATES + FACTS.index(name)])

    def time(self, scene: int = 0) -> float:
        """Time of a scene [s]."""
        return self._fact("time", scene)

    def steps(self, scene: int = 0) -> int:
        """Time steps so far."""
        return int(self._fact("steps", scene))

    def iterations(self, scene: int = 0) -> int:
        """Passes over the density constraint so far."""
        return int(self._fact("iterations", scene))

    def fault(self, scene: int = 0) -> str | None:
        """Why the solver stopped, if it did."""
        return FAULTS[int(self._fact("fault", scene))]

    def mean_compression(self, scene: int = 0) -> float:
        """Mean over the steps of the interior particles' max(ρ/ρ₀ − 1, 0)."""
        return self._fact("compression", scene) / max(self.steps(scene), 1)


T = TypeVar("T", np.float32, np.uint8)


class _Pool(Generic[T]):
    """Arrays side by side, each object once."""

    def __init__(self) -> None:
        self._parts: list[NDArray[T]] = []
        self._offsets: dict[int, int] = {}
        self._size = 0

    def add(self, array: NDArray[T]) -> int:
        """Add an array and return its offset in the pool."""
        if id(array) not in self._offsets:
            self._offsets[id(array)] = self._size
            self._parts.append(array.ravel())
            self._size += array.size
        return self._offsets[id(array)]

    def array(self) -> NDArray[T]:
        """The whole pool."""
        return np.ascontiguousarray(np.concatenate(self._parts))


def start() -> None:
    """Start the compiler of the kernels on one thread of the CPU.

    There is no option for a GPU: one scene is one thread there, and simulators pour one scene at a time. See GPU in
    docs/evidence/performance.md.
    """
    look_up_quickly(NAME)
    # It prints its architecture on stdout, which is reserved for results.
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=ti.cpu,
            cpu_max_num_threads=1,
            offline_cache=True,
            offline_cache_file_path=str(cache_directory() / KERNELS),
            log_level=ti.ERROR,
            enable_fallback=False,
            # These passes over one large kernel take two thirds of its compile time, and do not make a pour faster.
            cfg_optimization=False,
            # The columns of a scene's table are meant to be unrolled.
            unrolling_limit=0,
        )


_engine: FluidEngine | None = None


def engine() -> FluidEngine:
    """The process' engine; the first call starts Taichi and allocates."""
    global _engine
    if _engine is None:
        with uncollected():
            _engine = FluidEngine()
    return _engine


def close_engine() -> None:
    """End Taichi. This also writes compiled kernels to the cache."""
    global _engine
    if _engine is not None:
        _engine = None
        ti.reset()
