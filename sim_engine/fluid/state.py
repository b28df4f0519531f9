"""Arrays of the solver, apart from its algorithm. One set holds many scenes, which share one pool of particles.

`FluidState` holds the arrays, `SceneTable` writes the constants of all scenes in one kernel. Taichi compiles a kernel
for every field that Python writes or reads: for sixty fields this took a fifth of the time until a fresh machine
responded.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.scene_setup import (
    SceneSetup,
    adhesion,
    cohesion_acceleration,
    eddy_rate,
    pull_interval,
    relax_interval,
)


@ti.data_oriented
class SceneTable:
    """Fields with one value per scene, or per vessel of a scene, as the columns of a table.

    Args:
        fields: by name: numbers or vectors of shape (scenes,); numbers, vectors or matrices of shape (scenes, vessels).
    """

    def __init__(self, fields: Mapping[str, ti.Field]) -> None:
        self._begin: dict[str, tuple[int, int]] = {}
        self.of_scenes: list[tuple[ti.Field, int]] = []  # with their columns
        self.of_vessels: list[tuple[ti.Field, int, int]] = []  # with their vessels and columns
        column = 0
        for name, field in fields.items():
            begin = column
            for vessel in range(field.shape[1]) if len(field.shape) == 2 else [None]:
                for component in _components(field):
                    if vessel is None:
                        self.of_scenes.append((component, column))
                    else:
                        self.of_vessels.append((component, vessel, column))
                    column += 1
            self._begin[name] = begin, column
        self._columns = column

    def rows(self, scenes: Sequence[Mapping[str, ArrayLike]]) -> NDArray[np.float64]:
        """The table of some scenes, (scenes, columns); fields that are not named are 0.

        Args:
            scenes: values by the field's name, in the field's shape for one scene.

        Raises:
            KeyError: no such field.
            ValueError: a value of another size.
        """
        table = np.zeros((len(scenes), self._columns))
        for row, values in zip(table, scenes, strict=True):
            for name, value in values.items():
                begin, end = self._begin[name]
                row[begin:end] = np.reshape(value, end - begin)
        return table

    @ti.func
    def write(self, s, rows: ti.template()):
        """Set a scene's fields from its row of the table."""
        for component, column in ti.static(self.of_scenes):
            component[s] = rows[s, column]
        for component, vessel, column in ti.static(self.of_vessels):
            component[s, vessel] = rows[s, column]


def _components(field: ti.Field) -> list[ti.Field]:
    """Fields of numbers that share the memory of a field of vectors or matrices, row by row."""
    if not isinstance(field, ti.MatrixField):
        return [field]
    return [field.get_scalar_field(i, j) for i in range(field.n) for j in range(field.m)]


SUPPORT = 2.2
"""Kernel support h over spacing d. At 2.0 liquid at rest was crystalline, too stiff for waves (sloshing 6 % fast)."""

NATURAL_WALL_DISTANCE = 0.44
"""Distance, in spacings, at which the unshifted wall integral keeps liquid from a wall, measured on a cup at rest."""

VESSELS = 2
"""Pourer (0) and receiver (1)."""

NEIGHBOURS = 72
"""Entries in the half lists per particle of a scene; about 18 are used."""

EIGHT = 8
"""Numbers that the processor handles at a time."""

STRETCHES = 5
"""Stretches of a seat: its own column and the four following ones."""

LIST_RESERVE = 2_000
"""Entries that one particle may add before the overflow check; far more than any packing needs."""

CELLS, LEAST_CELLS = 8, 4_096
"""Cells of a scene's table: a number per particle, plus a constant. Liquid that spreads farther gets larger cells."""


@ti.data_oriented
class FluidState:
    """Particles, neighbour lists and per-scene scalars.

    A scene s owns the particles from `begin[s]` to `begin[s] + particles[s]`; moving ones come first, sorted by cell.
    Indices in lists and cells are those of the pool.

    A **mirrored** scene holds the half y ≥ 0 of a liquid that is symmetric about the plane y = 0. Particles near the
    plane have images on its other side: that of particle i is i + particles[s]. Passes over pairs read images as they
    read particles; what they add to images is not used.

    Values of each particle:

    Attributes:
        x, x0, v: position, position before the step [m], velocity [m/s].
        pressure, dp: accumulated density multiplier and its last change [m²].
        density: ρ/ρ₀.
        phi, normal: distance [m] of the equivalent plane of each vessel's walls at the last look-up, linearised in
            between, and its gradient. Between steps phi is the signed distance.
        push: normal displacement by each wall in this step [m].
        sag: how much lower each vessel's rim is for this particle [m], see `walls.py`.
        home: see `sim_engine.outcome.ParticleState`; `name`: index in the scene before any sorting.
        cell: index of the particle's cell.
        near: particles that have images, `images` of a scene: those near the plane when lists were last built.
        seated, seat, stretch: of passes without lists (`neighbours.py`): the particle in a seat, its position in units
            of the reach, and the stretches with its possible partners: from one seat up to the one before a second,
            `STRETCHES` times a seat.
        bonds, missing, lean, pulled: of cohesion, by seat, see `tension.py`.
        gradient, squares: of a pass over pairs, a vector and a number; for the density, Σ|∇C|² of the constraint's
            gradients.
        sums: Σ∇W and Σ|∇W|² of the neighbours, without their common factor.
        place, move: position and scaled change of the multiplier; displacement [m], whose fourth component is unused.
        first, count, neighbour: neighbour lists (compressed rows), every pair once: at the particle sorted first.
        pair, share: of each pair in the lists; adjacent numbers are computed eight at a time. For the density, pair is
            the kernel's slope between the two particles at their last measured positions.
    """

    def __init__(self, scenes: int, pool: int) -> None:
        self.scenes, self.pool = scenes, pool

        def vectors():
            return ti.Vector.field(3, ti.f32, shape=pool)

        def scalars(kind=ti.f32):
            return ti.field(kind, shape=pool)

        self.x, self.x0, self.v, self.dx, self.dv, self.x_listed = (vectors() for _ in range(6))
        self.x_copy, self.v_copy = vectors(), vectors()
        self.pressure, self.dp, self.density, self.pressure_copy = (scalars() for _ in range(4))
        self.allowed = scalars()
        self.phi = ti.Vector.field(VESSELS, ti.f32, shape=pool)
        self.sag, self.sag_copy = (ti.Vector.field(VESSELS, ti.f32, shape=pool) for _ in range(2))
        self.push = ti.Vector.field(VESSELS, ti.f32, shape=pool)
        self.normal = ti.Matrix.field(VESSELS, 3, ti.f32, shape=pool)
        self.home, self.home_copy, self.name, self.name_copy = (scalars(ti.i32) for _ in range(4))
        self.cell, self.near = scalars(ti.i32), scalars(ti.i32)
        self.gradient, self.squares = vectors(), scalars()
        self.sums, self.place, self.move = (ti.Vector.field(4, ti.f32, shape=pool) for _ in range(3))
        self.first, self.count = scalars(ti.i32), scalars(ti.i32)
        entries = pool * NEIGHBOURS + scenes * LIST_RESERVE
        self.neighbour = ti.field(ti.i32, shape=entries)
        self.pair, self.share = (ti.field(ti.f32, shape=entries) for _ in range(2))
        seats = pool + EIGHT * scenes
        self.seated = ti.field(ti.i32, shape=seats)
        self.stretch = ti.Vector.field(2, ti.i32, shape=seats * STRETCHES)
        apart = ti.Layout.SOA  # each coordinate of all seats is contiguous
        self.seat, self.lean, self.pulled = (ti.Vector.field(3, ti.f32, shape=seats, layout=apart) for _ in range(3))
        self.bonds, self.missing = (ti.field(ti.f32, shape=seats) for _ in range(2))
        self.cell_start = ti.field(ti.i32, shape=pool * CELLS + scenes * (LEAST_CELLS + 2))
        # Values that stay with a particle when `neighbours.sort` gives it another index, each with room for a copy.
        self.carried = (
            (self.x, self.x_copy),
            (self.v, self.v_copy),
            (self.x0, self.dx),
            (self.pressure, self.pressure_copy),
            (self.home, self.home_copy),
            (self.sag, self.sag_copy),
            (self.name, self.name_copy),
        )

        arrays = set(vars(self))
        # Per scene: its range in the pools …
        self.begin = ti.field(ti.i32, shape=scenes)
        self.list_begin = ti.field(ti.i32, shape=scenes)
        self.list_end = ti.field(ti.i32, shape=scenes)  # end of the written part of the lists
        self.mirrored = ti.field(ti.i32, shape=scenes)  # 1: only the half y ≥ 0 is simulated
        self.apart = ti.field(ti.f32, shape=scenes)  # largest addition to distances from own images, in spacings
        self.cells_begin = ti.field(ti.i32, shape=scenes)
        self.cells = ti.field(ti.i32, shape=scenes)
        # … constants of the liquid …
        self.particles = ti.field(ti.i32, shape=scenes)
        self.spacing = ti.field(ti.f32, shape=scenes)
        self.cohesion = ti.field(ti.f32, shape=scenes)  # scale of its accelerations [m/s²]
        self.adhesion = ti.field(ti.f32, shape=scenes)  # of walls, in units of cohesion's; 0: contact angle of 90°
        self.viscosity = ti.field(ti.f32, shape=scenes)
        self.eddies = ti.field(ti.f32, shape=scenes)  # rate of relaxation over the rate at which a pair separates
        self.friction = ti.field(ti.f32, shape=scenes)
        self.kinematic = ti.field(ti.f32, shape=scenes)  # viscosity in SI [m²/s]; 0: `viscosity` alone
        self.no_slip = ti.field(ti.f32, shape=scenes)  # 1: such a liquid sticks to walls, 0: it slips
        self.gravity = ti.field(ti.f32, shape=scenes)  # downwards [m/s²]
        self.longest_step = ti.field(ti.f32, shape=scenes)  # [s]
        self.rim_correction = ti.field(ti.f32, shape=scenes)  # rims are lower for particles at rest, in spacings
        self.wall_shift = ti.field(ti.f32, shape=scenes)  # walls act as if nearer by this distance, in supports h
        self.wait = ti.field(ti.f32, shape=scenes)  # interval at which viscosity acts [s]
        self.pull_wait = ti.field(ti.f32, shape=scenes)  # longest interval at which cohesion acts [s]
        self.poses_begin = ti.field(ti.i32, shape=scenes)  # where poses of seven numbers start in the table
        self.table_step = ti.field(ti.f32, shape=scenes)  # of the pose table [s]
        self.table_length = ti.field(ti.i32, shape=scenes)
        self.start = ti.field(ti.f64, shape=scenes)  # time at which the pourer begins to move [s]
        self.drift = ti.Vector.field(3, ti.f32, shape=scenes)  # velocity of all liquid at the start [m/s]
        # Poses of the vessels at the end and at the beginning of the step: vessel frame → world.
        self.origin, self.origin0 = (ti.Vector.field(3, ti.f32, shape=(scenes, VESSELS)) for _ in range(2))
        self.turn, self.turn0 = (ti.Matrix.field(3, 3, ti.f32, shape=(scenes, VESSELS)) for _ in range(2))
        self.spill_level = ti.field(ti.f32, shape=scenes)  # below it and in no vessel: spilled [m]
        # … and values that change with time.
        self.time = ti.field(ti.f64, shape=scenes)
        self.dt = ti.field(ti.f32, shape=scenes)
        self.fastest = ti.field(ti.f32, shape=scenes)  # speed of the fastest moving particle [m/s]
        self.waited = ti.field(ti.f32, shape=scenes)  # time since viscosity acted [s]
        self.pull_waited = ti.field(ti.f32, shape=scenes)  # … and since cohesion acted [s]
        self.open = ti.field(ti.i32, shape=scenes)  # 1: a step has begun and waits for cohesion
        self.steps = ti.field(ti.i32, shape=scenes)
        self.iterations = ti.field(ti.i32, shape=scenes)
        self.passes = ti.field(ti.i32, shape=scenes)  # of conjugate gradients
        self.rebuilds = ti.field(ti.i32, shape=scenes)
        self.moving = ti.field(ti.i32, shape=scenes)
        self.images = ti.field(ti.i32, shape=scenes)
        self.stale = ti.field(ti.i32, shape=scenes)  # 1: neighbour lists must be rebuilt
        self.fault = ti.field(ti.i32, shape=scenes)  # 1: lists overflowed, 2: a position is not finite
        self.compression = ti.field(ti.f64, shape=scenes)  # sum over steps of the mean interior max(ρ/ρ₀ − 1, 0)
        # Signed distance grids: where they start in the table of values, size, origin, spacing.
        self.grid_offset = ti.field(ti.i32, shape=(scenes, VESSELS))
        self.grid_size = ti.Vector.field(3, ti.i32, shape=(scenes, VESSELS))
        self.grid_origin = ti.Vector.field(3, ti.f32, shape=(scenes, VESSELS))
        self.grid_spacing = ti.field(ti.f32, shape=(scenes, VESSELS))
        self.plane_offset = ti.field(ti.i32, shape=(scenes, VESSELS))  # … of equivalent distances, same size
        self.cavity_offset = ti.field(ti.i32, shape=(scenes, VESSELS))  # … of cavities, same size
        self.arm = ti.field(ti.f32, shape=scenes)  # largest distance of the pourer's grid from its origin [m]
        # largest displacement of a point by the vessels in this step [m]
        self.swing = ti.field(ti.f32, shape=(scenes, VESSELS))
        self.rim = ti.field(ti.f32, shape=(scenes, VESSELS))  # z of the lip in the vessel's frame [m]
        self.wall = ti.field(ti.f32, shape=(scenes, VESSELS))  # smallest thickness [m]
        self.table = SceneTable({name: field for name, field in vars(self).items() if name not in arrays})


def of_parameters(setup: SceneSetup) -> dict[str, float]:
    """θ_s of a scene as values of the fields, by name."""
    theta, density, d = setup.parameters, setup.density, setup.spacing
    tension = theta.cohesion if setup.tension is None else setup.tension
    return {
        "cohesion": cohesion_acceleration(tension, density, d),
        "adhesion": adhesion(setup.contact_angle, theta.wall_distance),
        "pull_wait": pull_interval(tension, density, d),
        "viscosity": theta.xsph_rate,
        "eddies": eddy_rate(theta.smagorinsky_constant),
        "wait": relax_interval(theta.xsph_rate),
        "friction": theta.friction,
        "kinematic": setup.viscosity,
        "no_slip": 1.0 if setup.no_slip else 0.0,
        "rim_correction": theta.rim_correction,
        "wall_shift": (theta.wall_distance - NATURAL_WALL_DISTANCE) / SUPPORT,
    }
